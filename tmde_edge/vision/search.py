"""Where in an image, and at which scale, a finder looks: frames of a drive, regions round tracks, the fovea, stills.

A network never runs on a huge image as it is: the scale of every look is chosen so that plates have the size it was made
for, and the number of looks is bounded.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import cv2
import numpy as np

from tmde_edge.messages import Mode
from tmde_edge.vision.detect.contour import ContourFinder, box_iou, without_doubles
from tmde_edge.vision.protocols import Image, PlateCandidate, PlateFinder
from tmde_edge.vision.rectify import Array, bounds
from tmde_edge.vision.settings import DetectorSettings

Region = tuple[int, int, int, int]  # x0, y0, x1, y1, half open, inside the image
TILE_PX = (640, 384)  # one look of a network, in scaled pixels
TILE_OVERLAP = 0.2
NEAR_SCALE = 0.4  # of the whole view's scale: plates that fill half of the picture and more
TALLEST_ASPECT = 0.75  # height / width; taller pictures are searched at a smaller scale
CLOSER_PX = (48.0, 96.0)  # plate widths in network pixels, one for each of its heads
CLOSER_ENLARGED = 2.0  # at most; more would show nothing new
CLOSER_MARGIN = 0.6  # plate widths round the place
CLOSER_IOU = 0.3  # overlap with the place asked about
CLOSER_FLOOR = 0.02  # the score of a place where nothing is found
PLAIN_STILL_WIDTH_PX = 1600  # finders without a scale of their own see stills scaled down to this


class PlateSearch(Protocol):
    """What perception asks. Every answer is in source pixels; an empty list means: looked, no plate."""

    def frame(self, image: Image, mode: Mode) -> list[PlateCandidate]:
        """A full search of one frame of a drive."""
        ...

    def region(self, image: Image, region_px: Region, plate_width_px: float | None, mode: Mode) -> list[PlateCandidate]:
        """A part of the frame; plate_width_px: the width to expect, None: full resolution."""
        ...

    def still(self, image: Image, mode: Mode) -> Iterator[list[PlateCandidate]]:
        """Looks at one still, from the whole to finer parts; the caller stops when it has seen enough."""
        ...

    def closer(self, image: Image, corners_px: Array) -> float | None:
        """How sure the finder is (0..1) of one place by itself, at the size it judges best; None: it has no such size."""
        ...


class ScaledDetector(Protocol):
    """A detector that takes region and scale (network pixels per source pixel) with every call."""

    def detect(
        self, image: Image, *, region_px: Region | None = None, scale: float = 1.0, score_min: float = 0.5
    ) -> list[PlateCandidate]:
        """Candidates in source pixels."""
        ...


class NetworkSearch:
    """Looks of a network that takes any input size."""

    def __init__(self, detector: ScaledDetector, settings: DetectorSettings) -> None:
        self._detector = detector
        self._settings = settings

    def frame(self, image: Image, mode: Mode) -> list[PlateCandidate]:
        """The frame at search width; where that shows nothing, also smaller, for plates that fill it."""
        scale, score_min = self._whole_scale(image.shape[1], image.shape[0]), self._score_min(mode)
        found = self._detector.detect(image, scale=scale, score_min=score_min)
        return found or self._detector.detect(image, scale=scale * NEAR_SCALE, score_min=score_min)

    def region(self, image: Image, region_px: Region, plate_width_px: float | None, mode: Mode) -> list[PlateCandidate]:
        scale = 1.0 if plate_width_px is None else min(1.0, self._settings.region_plate_px / plate_width_px)
        return self._detector.detect(image, region_px=region_px, scale=scale, score_min=self._score_min(mode))

    def still(self, image: Image, mode: Mode) -> Iterator[list[PlateCandidate]]:
        """The whole image at search width; smaller, for plates that fill it; then tiles at ever higher resolution."""
        width, height = image.shape[1], image.shape[0]
        scale = self._whole_scale(width, height)
        least = min(self._settings.still_score_min, self._score_min(mode))
        yield self._detector.detect(image, scale=scale, score_min=least)
        if not self._settings.still_second_look:
            return
        yield self._detector.detect(image, scale=scale * NEAR_SCALE, score_min=least)
        looks = self._settings.still_tiles_max
        while scale < 1.0 and looks > 0:
            scale = min(1.0, 2 * scale)
            regions = tiles(width, height, scale)[:looks]
            looks -= len(regions)
            found: list[PlateCandidate] = []
            for region in regions:
                found += self._detector.detect(image, region_px=region, scale=scale, score_min=least)
            yield without_doubles(found)

    def closer(self, image: Image, corners_px: Array) -> float | None:
        """The mean log odds of looks at CLOSER_PX."""
        x0, y0, x1, y1 = bounds(corners_px)
        logits = []
        for width_px in CLOSER_PX:
            scale = min(CLOSER_ENLARGED, width_px / max(x1 - x0, 1.0))
            margin = CLOSER_MARGIN * (x1 - x0)
            region = (
                max(0, int(x0 - margin)), max(0, int(y0 - margin)),
                min(image.shape[1], int(x1 + margin)), min(image.shape[0], int(y1 + margin)),
            )
            if region[2] - region[0] < 8 or region[3] - region[1] < 8:
                return CLOSER_FLOOR
            found = self._detector.detect(image, region_px=region, scale=scale, score_min=CLOSER_FLOOR)
            score = max((c.score for c in found if box_iou(c.corners_px, corners_px) > CLOSER_IOU), default=CLOSER_FLOOR)
            score = min(score, 1.0 - 1e-6)
            logits.append(np.log(score / (1.0 - score)))
        return float(1.0 / (1.0 + np.exp(-np.mean(logits))))

    def _whole_scale(self, width_px: int, height_px: int) -> float:
        """The whole image at search width, but at no more pixels than a landscape picture of that width has."""
        wide = self._settings.search_width_px
        return min(1.0, wide / width_px, wide * float(np.sqrt(TALLEST_ASPECT / (width_px * height_px))))

    def _score_min(self, mode: Mode) -> float:
        return self._settings.score_min if mode == "strict" else self._settings.permissive_score_min


class PlainSearch:
    """Looks of a finder without a scale of its own: the paper's, or a network with a fixed input size."""

    def __init__(self, finder: PlateFinder, settings: DetectorSettings) -> None:
        self._finder = finder
        self._settings = settings

    def frame(self, image: Image, mode: Mode) -> list[PlateCandidate]:
        return self._find(image, None, mode)

    def region(self, image: Image, region_px: Region, plate_width_px: float | None, mode: Mode) -> list[PlateCandidate]:
        return self._find(image, region_px, mode)

    def still(self, image: Image, mode: Mode) -> Iterator[list[PlateCandidate]]:
        """The image itself; huge ones scaled down."""
        scale = PLAIN_STILL_WIDTH_PX / image.shape[1]
        if scale >= 1:
            yield self._find(image, None, mode)
            return
        small = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        sx, sy = image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]
        yield [
            PlateCandidate(corners_px=(c.corners_px + 0.5) * np.array([sx, sy]) - 0.5, score=c.score)
            for c in self._find(small, None, mode)
        ]

    def closer(self, image: Image, corners_px: Array) -> float | None:
        return None

    def _find(self, image: Image, region_px: Region | None, mode: Mode) -> list[PlateCandidate]:
        if isinstance(self._finder, ContourFinder):
            self._finder.mode = mode
            return self._finder.find(image, region_px=region_px)
        score_min = self._settings.score_min if mode == "strict" else self._settings.permissive_score_min
        return [c for c in self._finder.find(image, region_px=region_px) if c.score >= score_min]


def tiles(width_px: int, height_px: int, scale: float) -> list[Region]:
    """Overlapping windows of TILE_PX scaled pixels over an image, those nearest its middle first."""
    size = [int(np.ceil(t / scale)) for t in TILE_PX]
    starts = []
    for full, tile in zip((width_px, height_px), size, strict=True):
        if tile >= full:
            starts.append([0])
            continue
        n = int(np.ceil((full - tile) / (tile * (1 - TILE_OVERLAP)))) + 1
        starts.append([round(i * (full - tile) / (n - 1)) for i in range(n)])
    regions = [
        (x, y, min(x + size[0], width_px), min(y + size[1], height_px)) for y in starts[1] for x in starts[0]
    ]
    mid_x, mid_y = width_px / 2, height_px / 2
    return sorted(regions, key=lambda r: ((r[0] + r[2]) / 2 - mid_x) ** 2 + ((r[1] + r[3]) / 2 - mid_y) ** 2)


def fovea_region(
    width_px: int, height_px: int, centre_px: tuple[float, float] | None, settings: DetectorSettings
) -> Region:
    """The full-resolution window round the driving path's far end (None: the middle of the image), inside the image."""
    w, h = min(settings.fovea_width_px, width_px), min(settings.fovea_height_px, height_px)
    cx, cy = centre_px if centre_px is not None else (width_px / 2, height_px / 2)
    x0 = int(np.clip(round(cx - w / 2), 0, width_px - w))
    y0 = int(np.clip(round(cy - h / 2), 0, height_px - h))
    return x0, y0, x0 + w, y0 + h
