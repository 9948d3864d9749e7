"""PlateNet's maps -> plate candidates with sub-pixel corners. The network itself runs in adapters/detectors/platenet.py."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import PlateCandidate

STRIDES_PX = (4, 16)  # of the two heads: plates up to about 96 px wide, and from about 64 px on
UNITS_PX = (16.0, 64.0)  # corner offsets come in these units, from the cell's centre
CHANNELS = 9  # score logit, then x, y of TL, TR, BR, BL
MAX_PEAKS = 128
SAME_PLATE = 0.45  # part of the smaller quad that lies in the other one: above it both are one plate ...
OTHER_THING = 6.0  # ... unless their areas differ by this factor: a sign or a bumper must not hide the plate on it

Maps = NDArray[np.float32]  # (CHANNELS, rows, cols)
Quads = NDArray[np.float64]  # (n, 4, 2)


def decode(
    maps: tuple[Maps, ...],
    *,
    score_min: float,
    scale_xy: tuple[float, float] = (1.0, 1.0),
    origin_px: tuple[float, float] = (0.0, 0.0),
    max_candidates: int = 32,
) -> list[PlateCandidate]:
    """Candidates, best first, in source pixels.

    maps: one (9, H/stride, W/stride) array a head. scale_xy: network pixels per source pixel. origin_px: the source pixel
    coordinates of the cropped region's first pixel. With pixel centres at integers, source = (net + 0.5) / scale - 0.5 + origin.
    Raises ValueError for maps of another shape, for what is not finite, and for a score_min outside 0..1.
    """
    if not 0.0 < score_min < 1.0:
        raise ValueError(f"score_min {score_min}: must lie between 0 and 1")
    if len(maps) != len(STRIDES_PX) or any(m.ndim != 3 or m.shape[0] != CHANNELS for m in maps):
        raise ValueError(f"PlateNet gives {len(STRIDES_PX)} maps of {CHANNELS} channels, got shapes {[m.shape for m in maps]}")
    if not all(np.isfinite(m[0]).all() for m in maps):
        raise ValueError("the network's scores are not finite")
    logit_min = float(np.log(score_min / (1.0 - score_min)))
    found = [_peaks(m, s, u, logit_min) for m, s, u in zip(maps, STRIDES_PX, UNITS_PX, strict=True)]
    quads, scores = np.concatenate([q for q, _ in found]), np.concatenate([s for _, s in found])
    if not np.isfinite(quads).all():
        raise ValueError("the network's corners are not finite")
    order = np.argsort(-scores, kind="stable")
    kept = suppress(quads[order], max_candidates)
    scale, origin = np.array(scale_xy), np.array(origin_px)
    return [
        PlateCandidate(corners_px=(quads[order[i]] + 0.5) / scale - 0.5 + origin, score=float(scores[order[i]])) for i in kept
    ]


def _peaks(maps: Maps, stride_px: int, unit_px: float, logit_min: float) -> tuple[Quads, NDArray[np.float64]]:
    """Local maxima of the score and their corners in network pixels, averaged over the peak's neighbours by score."""
    logit = np.ascontiguousarray(maps[0])
    rows, cols = np.nonzero((logit > logit_min) & (logit >= cv2.dilate(logit, np.ones((3, 3), np.uint8))))
    if len(rows) > MAX_PEAKS:
        best = np.argsort(-logit[rows, cols], kind="stable")[:MAX_PEAKS]
        rows, cols = rows[best], cols[best]
    step = np.arange(-1, 2)
    r = np.clip(rows[:, None, None] + step[:, None], 0, logit.shape[0] - 1)
    c = np.clip(cols[:, None, None] + step[None, :], 0, logit.shape[1] - 1)
    r, c = np.broadcast_arrays(r, c)  # (n, 3, 3); cells at the border come twice, which only weights them
    near = _sigmoid(logit[r, c].astype(np.float64))
    score = near[:, 1, 1]
    weight = np.where(near > 0.5 * score[:, None, None], near, 0.0)
    at = np.stack([c, r], -1)[..., None, :] * float(stride_px) + (stride_px - 1) / 2  # (n, 3, 3, 1, 2)
    offsets = maps[1:, r, c].astype(np.float64).transpose(1, 2, 3, 0).reshape(*r.shape, 4, 2) * unit_px
    quads = ((at + offsets) * weight[..., None, None]).sum((1, 2)) / weight.sum((1, 2))[:, None, None]
    return quads, score


def _sigmoid(logit: NDArray[np.float64]) -> NDArray[np.float64]:
    out: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-np.clip(logit, -40.0, 40.0)))
    return out


def suppress(quads: Quads, max_kept: int) -> list[int]:
    """Indices kept of quads (n, 4, 2) sorted best first: of two that mostly cover each other, or lie nested, the better stays.

    Of very different areas both stay: the reader behind tells which one is the plate.
    """
    lo, hi = quads.min(1, initial=np.inf), quads.max(1, initial=-np.inf)
    area = np.array([abs(cv2.contourArea(q.astype(np.float32))) for q in quads])
    kept: list[int] = []
    for i in range(len(quads)):
        if len(kept) == max_kept:
            break
        if area[i] < 1e-6 or not cv2.isContourConvex(quads[i].astype(np.float32)):
            continue
        k = np.array(kept, np.intp)
        touching = k[((lo[k] < hi[i]) & (hi[k] > lo[i])).all(1)] if kept else k
        near = [j for j in touching if max(area[i], area[j]) < OTHER_THING * min(area[i], area[j])]
        if not any(_overlap_px2(quads[i], quads[j]) > SAME_PLATE * min(area[i], area[j]) for j in near):
            kept.append(i)
    return kept


def _overlap_px2(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Area in which two convex quads overlap."""
    return float(cv2.intersectConvexConvex(a.astype(np.float32), b.astype(np.float32))[0])
