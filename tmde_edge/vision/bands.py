"""Blue bands at a plate's left and right end (EU and the like): they belong to the plate, but in grey they look like a dark body.

Across each of the two sides the blueness (blue over the larger of green and red) is sampled outwards. A run that is bluer
than the ground inside and than what lies beyond is a band; the plate ends where the run ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import bounds, size_px

Array = NDArray[np.float64]
HEIGHTS_PX = (7.0, 12.0)  # of plates: on the lower ones a band is 1.5 to 3 px wide, and blur pales it
LEAST_BLUE = (20.0, 30.0)  # grey levels: twice as much over the ground's own blueness, so much over what lies beyond
LEAST_WIDTH_PX = (1.0, 2.0)  # of a band
WIDTH = (0.09, 0.65)  # of the plate's height
SURROUND, SURROUND_PX = 0.07, 1.5  # so far above and below the plate no band goes on, in plate heights, or pixels
INSIDE, OUTSIDE = 0.9, 0.75  # sampled so far into the plate and out of it, in plate heights
ROWS, STEPS = 15, 56


@dataclass(frozen=True, slots=True)
class Banded:
    """Corners (4, 2) with the bands inside, and how far outside of its right and left side a band ends; None: there is none."""

    corners_px: Array
    right_px: float | None
    left_px: float | None


def with_bands(image: Image, corners_px: Array, slack_px: float) -> Banded:
    """Corners moved outwards over blue bands that they leave out by more than slack_px; a grey image has none."""
    none = Banded(corners_px, right_px=None, left_px=None)
    if image.ndim != 3 or image.shape[2] < 3:
        return none
    height_px = size_px(corners_px)[1]
    if not np.isfinite(height_px) or height_px < 3:
        return none
    blue = _blueness(image, corners_px, (OUTSIDE + 0.5) * height_px + 2)
    if blue is None:
        return none
    patch, origin = blue
    out = corners_px.copy()
    ends_px: list[float | None] = []
    for a, b in ((1, 2), (3, 0)):
        end_px = _band_end(patch, corners_px[a] - origin, corners_px[b] - origin, height_px)
        ends_px.append(end_px)
        if end_px is not None and end_px > slack_px:
            ends_px[-1] = 0.0
            d = (corners_px[b] - corners_px[a]) / np.hypot(*(corners_px[b] - corners_px[a]))
            # along the upper and lower edge, not across the side: a turned plate's ends are not upright
            for k, other in ((a, 0 if a == 1 else 2), (b, 3 if b == 2 else 1)):
                along = corners_px[k] - corners_px[other]
                along /= np.hypot(*along)
                out[k] = corners_px[k] + along * end_px / max(abs(float(along @ (d[1], -d[0]))), 0.5)
    return Banded(out, right_px=ends_px[0], left_px=ends_px[1])


def _blueness(image: Image, corners_px: Array, margin_px: float) -> tuple[NDArray[np.float32], Array] | None:
    h, w = image.shape[:2]
    x0, y0, x1, y1 = bounds(corners_px)
    left, right = max(0, int(x0 - margin_px)), min(w, int(x1 + margin_px) + 2)
    up_px = max(SURROUND * (y1 - y0), SURROUND_PX) + 2
    top, bottom = max(0, int(y0 - up_px)), min(h, int(y1 + up_px) + 2)
    if right - left < 4 or bottom - top < 3:
        return None
    part = image[top:bottom, left:right].astype(np.float32)
    blue = part[..., 0] - np.maximum(part[..., 1], part[..., 2])
    return np.asarray(blue, dtype=np.float32), np.array([left, top], np.float64)


def _band_end(patch: NDArray[np.float32], a: Array, b: Array, height_px: float) -> float | None:
    """Outward offset at which the band of this side ends; None without one."""
    d = (b - a) / np.hypot(*(b - a))
    outward = np.array([d[1], -d[0]])
    across = np.linspace(-INSIDE * height_px, OUTSIDE * height_px, STEPS)
    along = np.linspace(-0.32, 0.32, ROWS)
    at = ((a + b) / 2 + along[:, None, None] * (b - a) + across[:, None] * outward).astype(np.float32)
    inside = (at >= 0).all(axis=2) & (at[..., 0] <= patch.shape[1] - 1) & (at[..., 1] <= patch.shape[0] - 1)
    rows = inside.all(axis=1)
    if rows.sum() < 5:
        return None
    seen = cv2.remap(patch, at[rows, :, 0], at[rows, :, 1], cv2.INTER_LINEAR)
    profile = np.sort(seen, axis=0)[len(seen) // 4 : len(seen) - len(seen) // 4].mean(axis=0)  # without stars and letters
    ground = max(0.0, float(np.sort(profile[: STEPS // 3])[STEPS // 9]))  # a yellow ground makes anything look blue
    top = int(profile.argmax())
    strength, least = float(profile[top]) - ground, float(np.interp(height_px, HEIGHTS_PX, LEAST_BLUE))
    beyond = max(ground, float(profile[top:].min()))  # a blue body, or the shadow round a plate on one, is blue too
    if strength < 2 * least or profile[top] - beyond < least:
        return None
    inner, outer = ground + strength / 2, (float(profile[top]) + beyond) / 2
    begin, end = top, top
    while begin > 0 and profile[begin - 1] > inner:
        begin -= 1
    while end < STEPS - 1 and profile[end + 1] > outer:
        end += 1
    step = float(across[1] - across[0])
    width_px = (end - begin + 1) * step
    least_px = max(float(np.interp(height_px, HEIGHTS_PX, LEAST_WIDTH_PX)), WIDTH[0] * height_px)
    if begin == 0 or end == STEPS - 1 or not least_px < width_px < WIDTH[1] * height_px:
        return None  # a blue ground, a blue body, or a mark
    if across[end] < -0.25 * height_px:  # inside the plate: a picture or a print
        return None
    outside = 0.5 + max(SURROUND, SURROUND_PX / height_px)
    for beside in (-outside, outside):
        row = ((a + b) / 2 + beside * (b - a) + across[begin : end + 1, None] * outward).astype(np.float32)[None]
        if outer < float(np.median(cv2.remap(patch, row[..., 0], row[..., 1], cv2.INTER_LINEAR))) < profile[top] + least:
            return None  # a blue frame or recess goes on round the corner
    last, after = float(profile[end]), float(profile[end + 1])
    return float(across[end]) + step * (last - outer) / max(last - after, 1e-6)
