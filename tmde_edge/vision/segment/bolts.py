"""Bolts, or the empty holes for them: pairs of dark spots in the margins above and below a plate's characters.

North American plates hang on bolts 7 inches apart, whatever frame hides their edges. A hole is dark, and so is the shadow that a
bolt's head throws. A spot alone could be print; two that are alike, level, round, about as far apart as bolts are, and that stand
out more than the print between them, hardly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import BoltPair
from tmde_edge.vision.rectify import apply_homography
from tmde_edge.vision.segment.paper import FlatView

Array = NDArray[np.float64]
Response = NDArray[np.float32]

LEAST_WIDTH_PX = 60.0  # of a plate in the image: below, a bolt is a pixel or two
ASPECT_SLACK = 1.3  # the plate's height over its width may differ by this factor
MARGIN = 0.02, 0.26  # from the upper or lower edge, in plate heights: there bolts stand, clear of the characters
# In shares of the bolts' spacing (177.8 mm: 3.2, 6.4, 9, 10, 8, 3.5, 3.5 mm).
SPOT, AROUND = 0.018, 0.036  # one sigma of the two blurs whose difference a spot of a bolt's size moves most
LOOK = 0.05  # half the side of the squares that are compared with each other
OFF_PLACE, OFF_MIDDLE, OFF_LEVEL = 0.056, 0.045, 0.02  # a spot from its place, the pair's middle from the plate's, level to level
LEVEL = 0.02  # of the print between them, up and down
OFF_SPACING = 0.07
DEPTH = 0.1  # of a spot, in the contrast of the whole plate
ALIKE_DEPTH, ALIKE = 0.4, 0.6  # the shallower over the deeper; correlation of the two squares
ROUND = 0.3  # least over greatest curvature: the edge of a frame is a line
OUTSTANDING, QUIET = 1.2, 0.9  # depth over that of all but the strongest tenth of what lies between the two
SPOTS = 4  # of the deepest near each place
SIGMA_PX = 0.25  # of a spot's place: rendered stills 0.1, the rest for shadows that fall a little differently on the two


@dataclass(frozen=True, slots=True, kw_only=True)
class BoltPlaces:
    """Where a plate's bolts are: their spacing over the plate's width, and the plate's height over its width."""

    spacing: float
    aspect: float


@dataclass(frozen=True, slots=True)
class _Spot:
    x: float
    y: float
    depth: float


def find_bolts(view: FlatView, characters: Array, places: Sequence[BoltPlaces]) -> tuple[BoltPair, ...]:
    """At most one pair above and one below the characters of a rectified plate; none where nothing stands out.

    characters: (n, 4) left, top, right, bottom of boxes in the rectified picture.
    """
    height, width = view.grey.shape
    fitting = [p for p in places if 1 / ASPECT_SLACK < height / width / p.aspect < ASPECT_SLACK]
    if not fitting or width / view.per_px < LEAST_WIDTH_PX:
        return ()
    spacing = min(fitting, key=lambda p: abs(height / width - p.aspect)).spacing * width
    grey = view.grey.astype(np.float32)
    coarse = view.grey[::4, ::4]
    contrast = float(np.subtract(*np.quantile(coarse, (0.92, 0.08))))
    near, far = (share * height for share in MARGIN)
    tops, bottoms = np.append(characters[:, 1], far), np.append(characters[:, 3], height - far)
    rows = (int(near), int(min(far, np.median(tops)))), (int(max(height - far, np.median(bottoms))), int(height - near))
    pairs = (_pair(grey, *r, spacing, contrast) for r in rows)
    found = [np.array([[a.x, a.y], [b.x, b.y]]) for a, b in (p for p in pairs if p is not None)]
    in_source = (apply_homography(view.source_from_flat, p) for p in found)
    return tuple(BoltPair(left_px=a, right_px=b, sigma_px=SIGMA_PX) for a, b in in_source)


def _pair(grey: Response, top: int, bottom: int, spacing: float, contrast: float) -> tuple[_Spot, _Spot] | None:
    """The deepest pair of spots between two rows that passes every test."""
    height, width = grey.shape
    if bottom - top < 3:
        return None
    start, end = max(0, top - round(AROUND * spacing)), min(height, bottom + round(AROUND * spacing))
    strip = grey[start:end]
    around, spot = (cv2.GaussianBlur(strip, (0, 0), s * spacing) for s in (AROUND, SPOT))
    dark = np.asarray(around - spot, dtype=np.float32)[top - start : bottom - start]
    middle, reach = (width - 1) / 2, OFF_PLACE * spacing
    left, right = middle - spacing / 2, middle + spacing / 2
    between = np.abs(dark[:, int(left + reach) + 2 : int(right - reach) - 1])
    lefts, rights = (_spots(dark, int(at - reach), int(at + reach) + 2, DEPTH * contrast) for at in (left, right))
    pairs = [(a, b) for a in lefts for b in rights if _fits(a, b, spacing, middle)]
    pairs = [(a, b) for a, b in pairs if _stands_out(a, b, between, LEVEL * spacing)]
    half = max(2, round(LOOK * spacing))
    alike = [(a, b) for a, b in pairs if _correlation(_square(grey, a, top, half), _square(grey, b, top, half)) > ALIKE]
    if not alike:
        return None
    a, b = max(alike, key=lambda p: min(p[0].depth, p[1].depth))
    return _Spot(a.x, a.y + top, a.depth), _Spot(b.x, b.y + top, b.depth)


def _fits(a: _Spot, b: _Spot, spacing: float, middle: float) -> bool:
    return (
        abs(b.x - a.x - spacing) < OFF_SPACING * spacing
        and abs((a.x + b.x) / 2 - middle) < OFF_MIDDLE * spacing
        and abs(a.y - b.y) < OFF_LEVEL * spacing
        and min(a.depth, b.depth) > ALIKE_DEPTH * max(a.depth, b.depth)
    )


def _stands_out(a: _Spot, b: _Spot, between: Response, reach: float) -> bool:
    """Whether two spots are deeper than what is printed between them on their level."""
    level = (a.y + b.y) / 2
    print_ = between[max(0, int(level - reach)) : int(level + reach) + 2]
    return print_.size > 0 and min(a.depth, b.depth) > OUTSTANDING * float(np.quantile(print_, QUIET))


def _spots(dark: Response, x0: int, x1: int, least: float) -> list[_Spot]:
    """The deepest round spots between two columns, to a fraction of a pixel; those at the upper or lower end are none."""
    x0, x1 = max(x0, 1), min(x1, dark.shape[1] - 1)
    part = dark[1:-1, x0:x1]
    if part.size == 0:
        return []
    peaks = cv2.dilate(dark, np.ones((3, 3), np.uint8))[1:-1, x0:x1]
    ys, xs = np.nonzero((part >= peaks) & (part > least))
    deepest = np.argsort(-part[ys, xs])[:SPOTS]
    found = []
    for y, x in zip((ys[deepest] + 1).tolist(), (xs[deepest] + x0).tolist(), strict=True):
        (a, b, c), (d, e, f), (g, h, i) = dark[y - 1 : y + 2, x - 1 : x + 2].tolist()
        xx, yy, xy = f - 2 * e + d, h - 2 * e + b, (i - g - c + a) / 4
        mean, apart = (xx + yy) / 2, hypot((xx - yy) / 2, xy)
        if mean + apart >= ROUND * (mean - apart):  # the flattest curvature; both are negative at a peak
            continue
        det = xx * yy - xy * xy
        dx, dy = (f - d) / 2, (h - b) / 2
        right, down = (xy * dy - yy * dx) / det, (xy * dx - xx * dy) / det
        found.append(_Spot(x + min(max(right, -1.0), 1.0), y + min(max(down, -1.0), 1.0), e))
    return found


def _square(grey: Response, spot: _Spot, top: int, half: int) -> Response:
    side = 2 * half + 1
    return np.asarray(cv2.getRectSubPix(grey, (side, side), (spot.x, spot.y + top)), dtype=np.float32)


def _correlation(a: Response, b: Response) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-6))
