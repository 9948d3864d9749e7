"""How far the picture moved up or down since the last frame: the camera's pitching, without any lane.

Blocks of the picture round the horizon are compared by phase correlation; what is far away moves only when the camera
turns. The median of the blocks is not led astray by single vehicles, and what grows round the vanishing point while
driving moves up above it and down below it, so that blocks centred on its row keep no part of that.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import Point, TiltChange
from tmde_edge.pose.edges import FloatArray, Image

_BLOCK = 48  # pixels of the working image
_COUNT = 10
_LEAST = 4  # blocks that must agree
_RESPONSE = 0.15  # of the correlation peak; below it a block says nothing
_SIGMA_PX = 0.2  # of the median, in working pixels: texture, and growth that is not symmetric
_MAX_GAP_NS = 400_000_000


class TiltMeter:
    """Compares each frame with the one before it; remembers nothing else."""

    def __init__(self, working_width_px: int = 640) -> None:
        self._width_px = working_width_px
        self._window = np.asarray(cv2.createHanningWindow((_BLOCK, _BLOCK), cv2.CV_32F), dtype=np.float32)
        self._before: tuple[int, tuple[int, int, int], list[NDArray[np.float32]]] | None = None

    def see(self, image: Image, t_ns: int, vanishing_px: Point | None) -> TiltChange | None:
        """The movement since the last call, in source pixels; None at first, after gaps and without texture.

        `vanishing_px` is where the calibration expects the road to vanish (default: the centre).
        """
        height, width = image.shape[:2]
        shrink = max(1, round(width / self._width_px))
        row = (height - 1) / 2 if vanishing_px is None else vanishing_px[1]
        top = round(row - 0.5 * _BLOCK * shrink)
        top = min(max(top, 0), height - _BLOCK * shrink)
        if top < 0 or width < 2 * _BLOCK * shrink:
            self._before = None
            return None
        band = image[top : top + _BLOCK * shrink, : width // shrink * shrink]
        if shrink > 1:
            band = np.asarray(cv2.resize(band, (width // shrink, _BLOCK), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if band.ndim == 3:
            band = np.asarray(cv2.cvtColor(band, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        lefts = np.linspace(0, band.shape[1] - _BLOCK, _COUNT).astype(int)
        blocks = [band[:, x : x + _BLOCK].astype(np.float32) for x in lefts]
        shape = height, width, top
        before, self._before = self._before, (t_ns, shape, blocks)
        if before is None or before[1] != shape or not 0 < t_ns - before[0] <= _MAX_GAP_NS:
            return None
        moved = self._moved(before[2], blocks)
        if moved is None:
            return None
        down_w, sigma_w = moved
        return TiltChange(t_from_ns=before[0], down_px=down_w * shrink, sigma_px=sigma_w * shrink)

    def _moved(self, old: list[NDArray[np.float32]], new: list[NDArray[np.float32]]) -> tuple[float, float] | None:
        found = []
        for a, b in zip(old, new, strict=True):
            if float(a.std()) < 2.0:  # sky or fog
                continue
            (_, dy), response = cv2.phaseCorrelate(a, b, self._window)
            if response >= _RESPONSE and abs(dy) <= 0.25 * _BLOCK:
                found.append(float(dy))
        if len(found) < _LEAST:
            return None
        moves: FloatArray = np.array(found)
        down = float(np.median(moves))
        spread = 1.4826 * float(np.median(np.abs(moves - down)))
        sigma = math.hypot(1.25 * spread / math.sqrt(len(found)), _SIGMA_PX)
        return (down, sigma) if math.isfinite(down + sigma) and spread < 1.5 else None
