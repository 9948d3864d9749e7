"""How far the picture moved up or down since the last frame: the camera's pitching, without any lane.

Blocks of the picture round the horizon are followed by Lucas-Kanade; what is far away moves only when the camera
turns. The median of the blocks is not led astray by single vehicles, and what grows round the vanishing point while
driving moves up above it and down below it, so that blocks centred on its row keep no part of that.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from tmde_edge.messages import Point, TiltChange
from tmde_edge.pose.edges import FloatArray, Image

_BAND = 64  # height of the band round the horizon, pixels of the working image
_WINDOW = (40, 32)  # of one block
_COUNT = 12
_LEAST = 4  # blocks that must agree
_SIGMA_PX = 0.12  # of the median, in working pixels: texture, and growth that is not symmetric
_MAX_MOVE_PX = 16.0
_LIKE = 0.6  # correlation of the band with itself a frame later, at a quarter of its columns
_MAX_GAP_NS = 400_000_000


class TiltMeter:
    """Compares each frame with the one before it; remembers nothing else."""

    def __init__(self, working_width_px: int = 640) -> None:
        self._width_px = working_width_px
        self._before: tuple[int, tuple[int, int, int], Image] | None = None

    def see(self, image: Image, t_ns: int, vanishing_px: Point | None) -> TiltChange | None:
        """The movement since the last call, in source pixels; None at first, after gaps and without texture.

        `vanishing_px` is where the calibration expects the road to vanish (default: the centre).
        """
        height, width = image.shape[:2]
        shrink = max(1, round(width / self._width_px))
        row = (height - 1) / 2 if vanishing_px is None else vanishing_px[1]
        top = round(row - 0.5 * _BAND * shrink)
        top = min(max(top, 0), height - _BAND * shrink)
        if top < 0 or width < 3 * _BAND * shrink:
            self._before = None
            return None
        band = image[top : top + _BAND * shrink, : width // shrink * shrink]
        if shrink > 1:
            band = np.asarray(cv2.resize(band, (width // shrink, _BAND), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if band.ndim == 3:
            band = np.asarray(cv2.cvtColor(band, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        shape = height, width, top
        before, self._before = self._before, (t_ns, shape, band)
        if before is None or before[1] != shape or not 0 < t_ns - before[0] <= _MAX_GAP_NS:
            return None
        moved = _moved(before[2], band, 0.0)
        if moved is None:  # a bump may have thrown the picture farther than the blocks are looked for
            jump = _jump(before[2], band)
            moved = None if jump is None else _moved(before[2], band, jump)
        if moved is None:
            return None
        down_w, sigma_w = moved
        return TiltChange(t_from_ns=before[0], down_px=down_w * shrink, sigma_px=sigma_w * shrink)


def _moved(old: Image, new: Image, guess: float) -> tuple[float, float] | None:
    """Movement down and its sigma, near a guess (working pixels); None where the blocks do not agree."""
    margin = _WINDOW[0] / 2
    columns = np.linspace(margin, old.shape[1] - 1 - margin, _COUNT)
    start = np.stack([columns, np.full(_COUNT, 0.5 * (_BAND - 1))], axis=1).astype(np.float32)
    there = start + np.array([0.0, guess], np.float32)
    end, status, _ = cv2.calcOpticalFlowPyrLK(
        old, new, start.reshape(-1, 1, 2), there.reshape(-1, 1, 2), winSize=_WINDOW, maxLevel=2,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.01), flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=5e-4,
    )  # fmt: skip
    step: FloatArray = np.asarray(end, dtype=np.float64).reshape(-1, 2) - start
    kept = (np.asarray(status).ravel() == 1) & (np.abs(step - (0.0, guess)) < _MAX_MOVE_PX).all(axis=1)
    moves = step[kept, 1]
    if len(moves) < _LEAST:
        return None
    down = float(np.median(moves))
    spread = 1.4826 * float(np.median(np.abs(moves - down)))
    sigma = math.hypot(1.25 * spread / math.sqrt(len(moves)), _SIGMA_PX)
    return (down, sigma) if math.isfinite(down + sigma) and spread < 1.5 else None


def _jump(old: Image, new: Image) -> float | None:
    """Whole working pixels by which most of the band moved down, by its likeness; None where nothing is like it."""
    reach, side = _BAND // 4, 4
    size = old.shape[1] // 4, _BAND
    then, now = (np.asarray(cv2.resize(i, size, interpolation=cv2.INTER_AREA)) for i in (old, new))
    likeness = cv2.matchTemplate(now, then[reach : _BAND - reach, side : size[0] - side], cv2.TM_CCOEFF_NORMED)
    _, best, _, (_, row) = cv2.minMaxLoc(likeness)
    return float(row - reach) if best >= _LIKE else None
