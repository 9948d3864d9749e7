"""Sub-pixel sizes on a rectified grey picture: box edges at half contrast, stroke width, border thickness."""

from __future__ import annotations

from math import ceil, floor, hypot, inf, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image

Array = NDArray[np.float64]
NEIGHBOURS = np.ones((3, 3), np.uint8)
INK_SHARE = 0.12  # of a row's (or column's) pixels that make its ink level: about one stroke


def box_edges(flat: Image, boxes: Array, light_on_dark: bool) -> tuple[Array, Array]:
    """(n, 4) boxes with their edges moved to the half-contrast crossing of the ink, and (n, 2) sigma of tb and lr edges.

    An edge without a clear crossing keeps its place, with the sigma of a whole pixel's rounding and threshold bias.
    """
    ink = flat if light_on_dark else np.asarray(255 - flat, dtype=np.uint8)
    out = boxes.copy()
    sigma = np.full((len(boxes), 2), 0.0)
    for i, (left, top, right, bottom) in enumerate(boxes.tolist()):
        x0, x1 = max(0, ceil(left)), min(flat.shape[1] - 1, floor(right))
        y0, y1 = max(0, ceil(top)), min(flat.shape[0] - 1, floor(bottom))
        if x1 - x0 < 2 or y1 - y0 < 4:
            sigma[i] = 1.0
            continue
        reach = max(2, round(0.14 * (y1 - y0)))
        ya, yb = max(0, y0 - reach), min(flat.shape[0] - 1, y1 + reach)
        tall = _strongest(ink[ya : yb + 1, x0 : x1 + 1], axis=1)
        above, below = _ground(tall, top - ya, rising=True), _ground(tall, bottom - ya, rising=False)
        out[i, 1], s_top = _crossing(tall, top - ya, reach, ya, above, rising=True)
        out[i, 3], s_bottom = _crossing(tall, bottom - ya, reach, ya, below, rising=False)
        xa, xb = max(0, x0 - reach), min(flat.shape[1] - 1, x1 + reach)
        wide = _strongest(ink[y0 : y1 + 1, xa : xb + 1], axis=0)
        # blur fills the gap to a neighbour: half of what is left of its contrast would lie inside the character
        paper = min(above, below, _ground(wide, left - xa, rising=True), _ground(wide, right - xa, rising=False))
        out[i, 0], s_left = _crossing(wide, left - xa, reach, xa, paper, rising=True)
        out[i, 2], s_right = _crossing(wide, right - xa, reach, xa, paper, rising=False)
        sigma[i] = hypot(s_top, s_bottom) / sqrt(2), hypot(s_left, s_right) / sqrt(2)
    return out, sigma


def _strongest(ink: Image, axis: int) -> list[float]:
    """Mean of the inkiest pixels of each row (axis 1) or column (axis 0)."""
    n = ink.shape[axis]
    k = max(1, round(INK_SHARE * n))
    part = np.partition(ink, n - k, axis=axis)
    inkiest = part[:, n - k :] if axis else part[n - k :]
    means: list[float] = (inkiest.sum(axis=axis, dtype=np.float64) / k).tolist()
    return means


def _ground(profile: list[float], at: float, *, rising: bool) -> float:
    """The profile's minimum outside of an edge at `at`."""
    return min(profile[: max(1, int(at) + 1)] if rising else profile[min(len(profile) - 1, ceil(at)) :])


def _crossing(
    profile: list[float], at: float, reach: int, start: int, ground: float, *, rising: bool
) -> tuple[float, float]:
    """Where the profile crosses half contrast nearest to `at` (index units), plus start; and its sigma.

    Levels: the profile's median in the glyph's middle third is ink; `ground` is given.
    A short list of numbers: plain arithmetic is several times quicker here than arrays.
    """
    n = len(profile)
    body = sorted(profile[n // 3 : n - n // 3])
    ink = body[len(body) // 2]
    contrast = ink - ground
    if contrast < 10:
        return at + start, 1.0
    level = ground + contrast / 2
    best, away, slope = 0.0, inf, 0.0
    for i in range(max(0, floor(at - reach) - 1), min(n - 1, ceil(at + reach) + 1)):
        a, b = profile[i], profile[i + 1]
        if (a < b and a <= level <= b) if rising else (a > b and a >= level >= b):
            place = i + (level - a) / (b - a)
            if abs(place - at) < away:
                best, away, slope = place, abs(place - at), abs(b - a)
    if away > reach:
        return at + start, 1.0
    # 6 grey levels of doubt about the level itself (uneven light, shot noise of the two levels)
    return best + start, min(1.0, hypot(6.0 / slope, 0.25))


def stroke_width(mask: NDArray[np.uint8]) -> float:
    """Stroke of one character's ink mask, pixels: twice the distance to the ground along the strokes' middle lines."""
    padded = cv2.copyMakeBorder(mask, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=0)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 5)
    on_ridge = distance[(padded > 0) & (distance >= cv2.dilate(distance, NEIGHBOURS))]
    # an odd width w has its ridge at (w + 1) / 2, an even one at w / 2
    return 2 * float(np.sort(on_ridge)[len(on_ridge) // 2]) - 0.5 if len(on_ridge) else 0.0


def ink_mask(flat: Image, box: Array, light_on_dark: bool) -> NDArray[np.uint8]:
    """One character's ink inside its box by Otsu's threshold, 0 or 1."""
    left, top, right, bottom = box.tolist()
    x0, y0 = max(0, ceil(left)), max(0, ceil(top))
    part = flat[y0 : max(y0, int(bottom)) + 1, x0 : max(x0, int(right)) + 1]
    if part.size == 0:
        return np.zeros((1, 1), np.uint8)
    kind = cv2.THRESH_BINARY if light_on_dark else cv2.THRESH_BINARY_INV
    return np.asarray(cv2.threshold(part, 0, 1, kind | cv2.THRESH_OTSU)[1], dtype=np.uint8)


def border_thickness(flat: Image, light_on_dark: bool) -> float | None:
    """Thickness of the line that runs round the plate, rectified pixels; None where no such line stands clear.

    A side counts when its mean profile goes ground, ink, ground within the outer 14 % of the height; the thickness is
    the ink under that line, divided by the contrast of ink to ground.
    """
    grey = flat.astype(np.float64)
    ink = grey if light_on_dark else 255.0 - grey
    h, w = ink.shape
    depth = max(4, round(0.14 * h))
    middle_x, middle_y = slice(int(0.12 * w), int(0.88 * w)), slice(int(0.2 * h), int(0.8 * h))
    core = np.sort(ink[int(0.3 * h) : int(0.7 * h), middle_x], axis=None)
    ink_level = float(core[int(0.97 * (len(core) - 1))])
    profiles = (
        _median(ink[:depth, middle_x], 1), _median(ink[h - depth :, middle_x], 1)[::-1],
        _median(ink[middle_y, :depth], 0), _median(ink[middle_y, w - depth :], 0)[::-1],
    )  # fmt: skip
    found = [t for p in profiles if (t := _line(p, ink_level)) is not None]
    return float(np.median(found)) if len(found) >= 2 else None


def _median(values: Array, axis: int) -> Array:
    """The upper median along an axis; numpy's own spends longer on checks than on sorting."""
    return np.asarray(np.sort(values, axis=axis).take(values.shape[axis] // 2, axis=axis))


def _line(profile: Array, ink_level: float) -> float | None:
    """Equivalent width of one ink line in a profile from the outside inwards; None where it is not a line on ground."""
    peak = int(np.argmax(profile))
    if peak == 0 or peak == len(profile) - 1:
        return None
    inner, outer = float(profile[peak:].min()), float(profile[: peak + 1].min())
    ground = max(inner, outer)
    contrast = ink_level - min(inner, outer)
    if contrast < 25 or float(profile[peak]) - ground < 0.4 * contrast:
        return None
    end = peak + int(np.argmin(profile[peak:]))
    begin = int(np.argmin(profile[: peak + 1]))
    return float(np.clip(profile[begin : end + 1] - ground, 0, None).sum() / (ink_level - ground))
