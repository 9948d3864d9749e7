"""A second, closer look at a calibration plate's outline: sides that show one clear edge, and corners only between those."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import Corners, PlateSighting
from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import is_convex, size_px
from tmde_edge.vision.refine import refine_outline

Floats = NDArray[np.float64]

CLEAR_SIGMA_PX = 0.45  # a side less certain than this is no measurement: two edges lie side by side (band, border, holder)
MOVED_SIGMAS = 3.0
LEAST_SIGMA_PX = 0.15
MISSING = (float("nan"), float("nan"))
MIN_HEIGHT_PX = 18.0  # of the plate: below, lip, border and margin melt into one shoulder
_PIECES = 8  # of a side, each measured by itself
_ENDS = 0.12  # of a side's length left out at each end: round corners
_STEP_PX = 0.25
_WEAK = 0.35  # an edge weaker than this share of the strongest one of its kind is another thing
_LEAST_STEP_GREY = 4.0  # a pixel, after smoothing


def sharpened(image: Image, plate: PlateSighting) -> PlateSighting:
    """The sighting with corners where two clear sides meet; others are left out (NaN) as long as two are there.

    Driving needs some outline in every frame; a calibration can leave out what is in doubt. Unchanged where fewer than
    two corners are clear.
    """
    given = np.array(plate.corners_px, dtype=np.float64)
    if not np.isfinite(given).all() or not is_convex(given) or size_px(given)[1] < MIN_HEIGHT_PX:
        return plate
    doubt = max(1.0, plate.corners_sigma_px)
    fit = refine_outline(image, given, doubt, plate.light_on_dark)
    grey = _grey(image)
    lines: list[tuple[Floats, Floats, float] | None] = []
    for i in range(4):
        a, b = given[i], given[(i + 1) % 4]
        if len(fit.side_sigma_px) == 4 and fit.side_sigma_px[i] <= CLEAR_SIGMA_PX:
            lines.append((fit.corners_px[i], fit.corners_px[(i + 1) % 4], fit.side_sigma_px[i]))
        else:
            lines.append(_outermost(grey, a, b, MOVED_SIGMAS * doubt, plate.light_on_dark))
    corners: list[Floats | None] = []
    for i in range(4):
        before, after = lines[i - 1], lines[i]
        at = _crossing(before, after) if before is not None and after is not None else None
        far = at is None or float(np.abs(at - given[i]).max()) > MOVED_SIGMAS * doubt
        corners.append(None if far else at)
    if sum(c is not None for c in corners) < 2:
        return plate
    sigma = float(np.hypot(LEAST_SIGMA_PX, np.sqrt(np.mean([line[2] ** 2 for line in lines if line is not None]))))
    tl, tr, br, bl = ((float(c[0]), float(c[1])) if c is not None else MISSING for c in corners)
    found: Corners = (tl, tr, br, bl)
    return replace(plate, corners_px=found, corners_sigma_px=sigma, side_sigma_px=(), refined=True, blur_px=fit.blur_px)


def _outermost(
    grey: NDArray[np.float32], a: Floats, b: Floats, reach_px: float, light_on_dark: bool
) -> tuple[Floats, Floats, float] | None:
    """The outermost edge, brighter inside (darker for light characters on a dark plate), near the side a-b, as a line.

    Pieces of the side are measured each by itself; their scatter about the line is its sigma.
    """
    along = b - a
    length = float(np.hypot(*along))
    if length < 12:
        return None
    along = along / length
    out = np.array([along[1], -along[0]])  # corners TL TR BR BL, y down: left of the way is outside
    offsets = np.arange(-reach_px, reach_px + _STEP_PX / 2, _STEP_PX)
    places = np.linspace(_ENDS * length, (1 - _ENDS) * length, _PIECES * max(3, int(length / (2 * _PIECES))))
    at = a + places[:, None, None] * along + offsets[None, :, None] * out
    values = cv2.remap(grey, at[..., 0].astype(np.float32), at[..., 1].astype(np.float32), cv2.INTER_LINEAR,
                       borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    pieces = np.asarray(values, np.float64).reshape(_PIECES, -1, len(offsets)).mean(axis=1)
    x = places.reshape(_PIECES, -1).mean(axis=1)
    slope = np.gradient(pieces, _STEP_PX, axis=1)
    slope = cv2.GaussianBlur(slope, (0, 0), 1.5, sigmaY=0.01) * (1.0 if light_on_dark else -1.0)  # falls outward: plate ends
    strongest = np.median(slope.max(axis=1))
    if strongest < _LEAST_STEP_GREY:
        return None
    y = np.full(_PIECES, np.nan)
    for k, row in enumerate(slope):
        peaks = [j for j in range(1, len(row) - 1) if row[j] >= row[j - 1] and row[j] > row[j + 1] and row[j] > _WEAK * strongest]
        if peaks:
            j = peaks[-1]
            y[k] = offsets[j] + 0.5 * (row[j - 1] - row[j + 1]) / (row[j - 1] - 2 * row[j] + row[j + 1]) * _STEP_PX
    good = np.isfinite(y)
    for _ in range(3):
        if good.sum() < _PIECES // 2:
            return None
        line = np.polyfit(x[good], y[good], 1)
        left = y - np.polyval(line, x)
        scatter = max(1.4826 * float(np.median(np.abs(left[good]))), 0.05)
        good = np.isfinite(y) & (np.abs(left) < 3 * scatter)
    if good.sum() < _PIECES // 2 or scatter > CLEAR_SIGMA_PX:
        return None
    start, end = np.polyval(line, 0.0), np.polyval(line, length)
    return a + start * out, b + end * out, float(scatter / good.sum() ** 0.5 + 0.1)


def _grey(image: Image) -> NDArray[np.float32]:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.asarray(grey, dtype=np.float32)


def _crossing(first: tuple[Floats, Floats, float], second: tuple[Floats, Floats, float]) -> Floats | None:
    (p, q, _), (r, s, _) = first, second
    d, e = q - p, s - r
    det = float(d[0] * e[1] - d[1] * e[0])
    if abs(det) < 1e-9:
        return None
    t = float((r[0] - p[0]) * e[1] - (r[1] - p[1]) * e[0]) / det
    return np.asarray(p + t * d, dtype=np.float64)
