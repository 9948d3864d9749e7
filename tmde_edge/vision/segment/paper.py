"""Character segmentation after the paper's Algorithm 2: two thresholds, five geometric filters, median and 2 sigma.

All sizes come back in source pixels: each box edge is carried through the homography, so that the size of the rectified
picture does not change a height. docs/paper.md lists where this departs from the paper and why.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import CharacterBox, Image, PlateCandidate, PlateReading
from tmde_edge.vision.rectify import apply_homography, is_convex, rectify_grey, size_px
from tmde_edge.vision.refine import OutlineFit, refine_outline
from tmde_edge.vision.segment.measure import border_thickness, box_edges, stroke_width
from tmde_edge.vision.settings import SegmenterSettings

MIN_HEIGHT_PX = 100  # rectified pictures lower than this are enlarged
MAX_HEIGHT_PX = 240  # and near plates are segmented at no more than this: time, and noise between pixels
CLAHE_CLIP, CLAHE_TILES = 2.0, (8, 8)
# The five geometric filters, in units of the rectified plate (h its height, w its width).
HEIGHT_OF_PLATE = (0.28, 0.92)  # 1: box height / h; two-row plates have 0.35, US 0.46, EU 0.69
ASPECT = (0.08, 1.05)  # 2: box width / box height; a 1 or I has 0.15, a W 0.9
AREA_OF_PLATE = (0.004, 0.16)  # 3: box area / (w h)
FILL = (0.15, 0.95)  # 4: ink in the box; a bare I fills it, so narrow boxes are excused from the upper bound
CENTRE_OF_PLATE = (0.02, 0.98)  # 5: box centre, along both axes; and the box must not touch top and bottom at once
SIGMA_FLOOR = 0.04  # of the median height: pixel rounding alone must not make an outlier
CLASS_RATIO = 0.87  # characters lower than this part of the tallest class are not main (RU letters 0.76)


@dataclass(frozen=True, slots=True, kw_only=True)
class Segmentation:
    """Characters of one rectified picture. boxes (n, 4): left, top, right, bottom edges in its pixels."""

    boxes: NDArray[np.float64]
    masks: tuple[NDArray[np.uint8], ...]  # each character's ink inside its integer box
    light_on_dark: bool
    method: str  # "adaptive" or "otsu"

    @property
    def count(self) -> int:
        return len(self.boxes)


def enlargement(height_px: float) -> float:
    """How much a rectified picture is enlarged: max(2, 100 / h) below 100 px, else 1."""
    return max(2.0, MIN_HEIGHT_PX / height_px) if height_px < MIN_HEIGHT_PX else 1.0


def segment_characters(flat: Image) -> Segmentation:
    """Algorithm 2 from CLAHE on, for a grey rectified picture that is already large enough (`enlargement`)."""
    clear = cv2.createCLAHE(clipLimit=CLAHE_CLIP, tileGridSize=CLAHE_TILES).apply(flat)
    block = max(11, flat.shape[0] // 2 | 1)
    best: Segmentation | None = None
    for light_on_dark in (False, True):
        kind = cv2.THRESH_BINARY if light_on_dark else cv2.THRESH_BINARY_INV
        offset = -8 if light_on_dark else 8
        adaptive = cv2.adaptiveThreshold(clear, 255, cv2.ADAPTIVE_THRESH_GAUSSIAN_C, kind, block, offset)
        _, otsu = cv2.threshold(clear, 0, 255, kind | cv2.THRESH_OTSU)
        for method, ink in (("adaptive", adaptive), ("otsu", otsu)):
            found = _characters(np.asarray(ink, dtype=np.uint8), light_on_dark, method)
            if best is None or _better(found, best):
                best = found
    if best is None:  # pragma: no cover - the loops above always run
        raise RuntimeError("no threshold was tried")
    return best


def _better(a: Segmentation, b: Segmentation) -> bool:
    """More characters kept; among equals, heights that agree better."""
    return (a.count, -_spread(a)) > (b.count, -_spread(b))


def _spread(s: Segmentation) -> float:
    if s.count == 0:
        return 1.0
    heights = s.boxes[:, 3] - s.boxes[:, 1]
    return float(heights.std() / heights.mean())


def _characters(ink: NDArray[np.uint8], light_on_dark: bool, method: str) -> Segmentation:
    kernel = np.ones((3, 3), np.uint8)
    ink = np.asarray(cv2.morphologyEx(ink, cv2.MORPH_OPEN, kernel), dtype=np.uint8)
    ink = np.asarray(cv2.morphologyEx(ink, cv2.MORPH_CLOSE, kernel), dtype=np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(ink, connectivity=8)
    parts = np.asarray(stats[1:], dtype=np.int32)
    rows = geometric_filters(parts, ink.shape[1], ink.shape[0])
    kept = parts[rows]
    names = np.flatnonzero(rows) + 1
    inliers = height_inliers(kept[:, cv2.CC_STAT_HEIGHT].astype(np.float64))
    kept, names = kept[inliers], names[inliers]
    in_rows = _in_rows(kept)
    kept, names = kept[in_rows], names[in_rows]
    order = np.argsort(kept[:, cv2.CC_STAT_LEFT])
    boxes, masks = [], []
    for i in order:
        x, y, w, h = (int(v) for v in kept[i, :4])
        boxes.append((x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5))
        masks.append((labels[y : y + h, x : x + w] == names[i]).astype(np.uint8))
    return Segmentation(
        boxes=np.array(boxes, np.float64).reshape(-1, 4), masks=tuple(masks), light_on_dark=light_on_dark, method=method
    )


def geometric_filters(stats: NDArray[np.int32], width_px: int, height_px: int) -> NDArray[np.bool_]:
    """(n,) which components (cv2 statistics: left, top, width, height, ink) pass the five filters."""
    x, y, w, h, ink = (stats[:, i].astype(np.float64) for i in range(5))
    height = h / height_px
    aspect = w / np.maximum(h, 1)
    area = w * h / (width_px * height_px)
    fill = ink / np.maximum(w * h, 1)
    cx, cy = (x + w / 2) / width_px, (y + h / 2) / height_px
    through = (y <= 0) & (y + h >= height_px)
    return np.asarray(
        (height >= HEIGHT_OF_PLATE[0]) & (height <= HEIGHT_OF_PLATE[1])
        & (aspect >= ASPECT[0]) & (aspect <= ASPECT[1])
        & (area >= AREA_OF_PLATE[0]) & (area <= AREA_OF_PLATE[1])
        & (fill >= FILL[0]) & ((fill <= FILL[1]) | (aspect < 0.35))
        & (cx >= CENTRE_OF_PLATE[0]) & (cx <= CENTRE_OF_PLATE[1])
        & (cy >= CENTRE_OF_PLATE[0]) & (cy <= CENTRE_OF_PLATE[1]) & ~through
    )  # fmt: skip


def height_inliers(heights: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) heights within 2 sigma of the median."""
    if len(heights) == 0:
        return np.zeros(0, np.bool_)
    median = float(np.median(heights))
    sigma = max(float(heights.std()), SIGMA_FLOOR * median)
    return np.asarray(np.abs(heights - median) <= 2 * sigma)


def _in_rows(stats: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(n,) components that share their row with another one: a lone mark above or below is no character."""
    y, h = stats[:, cv2.CC_STAT_TOP].astype(float), stats[:, cv2.CC_STAT_HEIGHT].astype(float)
    if len(y) < 2:
        return np.ones(len(y), np.bool_)
    overlap = np.minimum(y[:, None] + h[:, None], y + h) - np.maximum(y[:, None], y)
    return np.asarray((overlap > 0.6 * np.minimum(h[:, None], h)).sum(axis=1) >= 2)


def rows_of(tops: NDArray[np.float64], bottoms: NDArray[np.float64]) -> NDArray[np.int64]:
    """(n,) the row (0 the upper) of each character; characters whose middles overlap belong together."""
    rows = np.zeros(len(tops), np.int64)
    if len(tops) == 0:
        return rows
    middles = (tops + bottoms) / 2
    order = np.argsort(middles)
    half = 0.6 * float(np.median(bottoms - tops))
    for a, b in pairwise(order):
        rows[b] = rows[a] + (1 if middles[b] - middles[a] > half else 0)
    return rows


def main_class(heights: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) members of the tallest height class that has at least two members."""
    if len(heights) < 2:
        return np.ones(len(heights), np.bool_)
    tall = np.sort(heights)[-2]  # one stray tall box makes no class
    return np.asarray((heights >= CLASS_RATIO * tall) & (heights <= tall / CLASS_RATIO))


class PaperReader:
    """Outline refinement and Algorithm 2 behind the `PlateReader` interface."""

    def __init__(self, settings: SegmenterSettings, rectified_height_px: int | None = None) -> None:
        """rectified_height_px: of the picture that is segmented; None: the plate's own, enlarged as the paper has it."""
        self._settings = settings
        self._height_px = rectified_height_px

    def read(self, image: Image, candidates: list[PlateCandidate]) -> list[PlateReading]:
        """One reading per candidate, in order, in source pixels."""
        return [self._read(image, c) for c in candidates]

    def _read(self, image: Image, candidate: PlateCandidate) -> PlateReading:
        corners = candidate.corners_px
        if self._settings.refine:
            fit = refine_outline(image, corners)
        else:
            fit = OutlineFit(corners_px=corners, sigma_px=1.0, refined=False, blur_px=None)
        if not is_convex(fit.corners_px):
            return PlateReading(corners_px=corners, corners_sigma_px=fit.sigma_px, refined=False, characters=())
        return read_characters(image, fit, self._height_px)


def read_characters(image: Image, fit: OutlineFit, rectified_height_px: int | None = None) -> PlateReading:
    """Algorithm 2 on one outline. Heights, strokes and border in source pixels."""
    view = flatten(image, fit.corners_px, rectified_height_px)
    if view is None:
        return PlateReading(corners_px=fit.corners_px, corners_sigma_px=fit.sigma_px, refined=False, characters=())
    found = segment_characters(view.grey)
    edges, sigma = box_edges(view.grey, found.boxes, found.light_on_dark)
    strokes = [stroke_width(m) / view.per_px for m in found.masks]
    border = border_thickness(view.grey, found.light_on_dark)
    return PlateReading(
        corners_px=fit.corners_px,
        corners_sigma_px=fit.sigma_px,
        refined=fit.refined,
        characters=_in_source(edges, view.source_from_flat, sigma / view.per_px, strokes),
        light_on_dark=found.light_on_dark,
        stroke_px=float(np.median(strokes)) if strokes else None,
        border_px=None if border is None else border / view.per_px,
        blur_px=fit.blur_px,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FlatView:
    """A rectified grey plate, how to get back, and its pixels per source pixel."""

    grey: Image
    source_from_flat: NDArray[np.float64]
    per_px: float


def flatten(image: Image, corners_px: NDArray[np.float64], rectified_height_px: int | None = None) -> FlatView | None:
    """The plate rectified at the size it is segmented at (None: as the paper enlarges it); None for a speck."""
    width_px, height_px = size_px(corners_px)
    if width_px < 4 or height_px < 4 or not is_convex(corners_px):
        return None
    scale = min(enlargement(height_px), MAX_HEIGHT_PX / height_px)
    if rectified_height_px:
        scale = rectified_height_px / height_px
    flat_w, flat_h = max(8, round(width_px * scale)), max(8, round(height_px * scale))
    grey, source_from_flat = rectify_grey(image, corners_px, flat_w, flat_h)
    return FlatView(grey=grey, source_from_flat=source_from_flat, per_px=flat_h / height_px)


def _in_source(
    edges: NDArray[np.float64], source_from_flat: NDArray[np.float64], sigma_px: NDArray[np.float64], strokes_px: list[float]
) -> tuple[CharacterBox, ...]:
    """Boxes (n, 4) of the rectified picture as edge middles in the source image; sigma_px (n, 2) across tb and lr edges."""
    if len(edges) == 0:
        return ()
    left, top, right, bottom = edges.T
    cx, cy = (left + right) / 2, (top + bottom) / 2
    points = [np.column_stack(p) for p in ((left, cy), (right, cy), (cx, top), (cx, bottom))]
    l_px, r_px, t_px, b_px = (apply_homography(source_from_flat, p) for p in points)
    heights = np.hypot(*(b_px - t_px).T)
    main, rows = main_class(heights), rows_of(top, bottom)
    return tuple(
        CharacterBox(
            left_px=l_px[i], right_px=r_px[i], top_px=t_px[i], bottom_px=b_px[i], main=bool(main[i]), row=int(rows[i]),
            sigma_tb_px=float(sigma_px[i, 0]), sigma_lr_px=float(sigma_px[i, 1]), stroke_px=strokes_px[i],
        )
        for i in range(len(edges))
    )  # fmt: skip
