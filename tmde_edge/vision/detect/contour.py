"""The paper's Algorithm 1: plates as contours of the adaptively thresholded frame, in strict and permissive modes."""

from __future__ import annotations

from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import Mode
from tmde_edge.vision.protocols import Image, PlateCandidate
from tmde_edge.vision.rectify import order_corners, rectify, size_px, to_grey
from tmde_edge.vision.segment.paper import enlargement, segment_characters
from tmde_edge.vision.settings import DetectorSettings

Array = NDArray[np.float64]
BLOCK_PX, OFFSET = 11, 2  # adaptive Gaussian threshold
CLOSE_X, CLOSE_Y = 0.2, 0.1  # closing kernel, of the contour's box; at least 3 px
SMALL_HEIGHT_PX = 80  # rectified plates lower than this are accepted on their characters alone
MIN_CHARACTERS = 3
# VerifyPlateRegion (ours: the paper names it and leaves it open)
EDGE_DENSITY = (0.04, 0.3)  # Canny pixels / all; plates have 0.1 to 0.2
MIN_CONTRAST = 25.0  # standard deviation, grey levels
STEPS_PER_ROW = (6, 60)  # ink to ground crossings along the middle rows: three characters make at least six
VERIFY_HEIGHT_PX = 100  # regions are verified at this height at most
MAX_TILT_RAD = 0.7  # a plate lies along the image's rows


class ContourFinder:
    """`PlateFinder` by Algorithm 1. `mode` is set by perception, which owns the strict/permissive state machine."""

    ASPECT: ClassVar[dict[Mode, tuple[float, float]]] = {"strict": (1.5, 4.0), "permissive": (1.2, 5.0)}

    def __init__(self, settings: DetectorSettings, aspect_range: tuple[float, float] | None = None) -> None:
        """aspect_range: smallest and largest width / height of the expected plates; None: the paper's own limits."""
        self._settings = settings
        self._aspect_range = aspect_range
        self.mode: Mode = "strict"

    def aspect_limits(self) -> tuple[float, float]:
        """The paper's limits of this mode, widened to hold the expected plates with the margin a tilted view needs."""
        low, high = self.ASPECT[self.mode]
        if self._aspect_range is not None:
            margin = 1.15 if self.mode == "strict" else 1.35
            low, high = min(low, self._aspect_range[0] / margin), max(high, self._aspect_range[1] * margin)
        return low, high

    def find(self, image: Image, *, region_px: tuple[int, int, int, int] | None = None) -> list[PlateCandidate]:
        """Candidates in source pixels, best first."""
        x0, y0, x1, y1 = region_px or (0, 0, image.shape[1], image.shape[0])
        grey = to_grey(image[y0:y1, x0:x1])
        if min(grey.shape) < BLOCK_PX:
            return []
        kind = cv2.THRESH_BINARY_INV
        dark = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_GAUSSIAN_C, kind, BLOCK_PX, OFFSET)
        ink = np.asarray(dark, dtype=np.uint8)
        contours, _ = cv2.findContours(ink, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        largest = sorted(contours, key=cv2.contourArea, reverse=True)[: self._settings.max_contours]
        boxes = [cv2.boundingRect(c) for c in largest]
        found = []
        for x, y, w, h in boxes:
            if w * h < self._settings.a_min_px:
                continue
            corners = self._largest_rectangle(ink[y : y + h, x : x + w])
            if corners is None:
                continue
            score = self._score(grey, corners + np.array([x, y]))
            if score > 0:
                found.append(PlateCandidate(corners_px=corners + np.array([x + x0, y + y0]), score=score))
        return without_doubles(found)

    def _largest_rectangle(self, ink: NDArray[np.uint8]) -> Array | None:
        """Closing, largest sub-contour, rotated rectangle: corners in the region's pixels; None outside the limits."""
        h, w = ink.shape
        # odd sizes: an even kernel's closing moves everything by a pixel
        kernel = np.ones((max(3, round(CLOSE_Y * h)) | 1, max(3, round(CLOSE_X * w)) | 1), np.uint8)
        # the closing must not be stopped by the region's own edge
        py, px = kernel.shape
        padded = cv2.copyMakeBorder(ink, py, py, px, px, cv2.BORDER_CONSTANT, value=0)
        closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)
        parts, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        if not parts:
            return None
        largest = max(parts, key=cv2.contourArea)
        points = np.asarray(cv2.boxPoints(cv2.minAreaRect(largest)), dtype=np.float64) - (px, py)
        try:
            corners = order_corners(points)
        except ValueError:  # a contour without area
            return None
        width, height = size_px(corners)
        if width < 1 or height < 1:
            return None
        # contours run through pixel centres: the outline lies half a pixel further out on each side
        along, down = (corners[1] - corners[0]) / width, (corners[3] - corners[0]) / height
        corners = corners + 0.5 * np.array([-along - down, along - down, along + down, down - along])
        width, height = width + 1, height + 1
        low, high = self.aspect_limits()
        if abs(float(np.arctan2(along[1], along[0]))) > MAX_TILT_RAD:
            return None
        too_small = width < self._settings.min_width_px or height < self._settings.min_height_px
        return None if too_small or not low <= width / height <= high else corners

    def _score(self, grey: Image, corners_px: Array) -> float:
        """0 for a region that is no plate; else 0.5 and more with each character."""
        width, height = size_px(corners_px)
        scale = enlargement(height) if height < VERIFY_HEIGHT_PX else VERIFY_HEIGHT_PX / height
        flat, _ = rectify(grey, corners_px, round(width * scale), round(height * scale))
        characters = segment_characters(flat).count
        accepted = height < SMALL_HEIGHT_PX and characters >= MIN_CHARACTERS
        if not accepted and not verify_plate_region(flat, characters):
            return 0.0
        return min(0.5 + 0.07 * characters, 0.95)


def verify_plate_region(flat: Image, characters: int) -> bool:
    """VerifyPlateRegion: edge density, contrast and character evidence of a rectified grey region, all three needed.

    Character evidence is three characters of the segmentation, or two where rows also cross between ink and ground as
    often as lettering does.
    """
    small = cv2.resize(flat, (max(8, round(flat.shape[1] * 80 / flat.shape[0])), 80), interpolation=cv2.INTER_AREA)
    if float(small.std()) < MIN_CONTRAST:
        return False
    density = float((cv2.Canny(small, 60, 150) > 0).mean())
    if not EDGE_DENSITY[0] <= density <= EDGE_DENSITY[1]:
        return False
    if characters != 2:
        return characters >= MIN_CHARACTERS
    _, ink = cv2.threshold(small[28:52], 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    steps = (np.diff(np.asarray(ink, dtype=np.int16), axis=1) != 0).sum(axis=1)
    return bool(STEPS_PER_ROW[0] <= float(np.median(steps)) <= STEPS_PER_ROW[1])


def without_doubles(candidates: list[PlateCandidate], overlap: float = 0.3) -> list[PlateCandidate]:
    """Candidates by falling score without those whose upright box overlaps a better one's (intersection over union)."""
    kept: list[PlateCandidate] = []
    for c in sorted(candidates, key=lambda c: -c.score):
        if all(box_iou(c.corners_px, k.corners_px) <= overlap for k in kept):
            kept.append(c)
    return kept


def box_iou(a_px: Array, b_px: Array) -> float:
    """Intersection over union of the upright boxes round two quadrilaterals."""
    low = np.maximum(a_px.min(axis=0), b_px.min(axis=0))
    high = np.minimum(a_px.max(axis=0), b_px.max(axis=0))
    common = float(np.prod(np.clip(high - low, 0, None)))
    areas = [float(np.prod(np.ptp(q, axis=0))) for q in (a_px, b_px)]
    return common / max(sum(areas) - common, 1e-9)
