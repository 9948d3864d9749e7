"""Labels of a patch -> score and corner maps that the network must give, for every head."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from net import STRIDES, UNITS_PX

WIDTHS_PX = ((0.0, 96.0), (64.0, 1e9))  # plates whose width lies here are a head's own
SOFT = 0.72  # widths this far outside are neither right nor wrong for the head
CORNER_FROM = 0.4  # corners are learnt where the score's bell is at least this high


class Maps:
    """heat, keep: (H,W); offsets: (8,H,W) in units; weight (H,W) and size (2,H,W) of the corner loss, px."""

    def __init__(self, side_px: int, stride: int) -> None:
        n = side_px // stride
        self.heat = np.zeros((n, n), np.float32)
        self.keep = np.ones((n, n), np.float32)
        self.offsets = np.zeros((8, n, n), np.float32)
        self.weight = np.zeros((n, n), np.float32)
        self.size = np.ones((2, n, n), np.float32)


def encode(labels: list[tuple[list[list[float]], float, int]], side_px: int, head: int) -> Maps:
    """labels: (corners (4,2) px, corner weight, kind: 0 plate, 1 ignore)."""
    stride, unit = STRIDES[head], UNITS_PX[head]
    lo, hi = WIDTHS_PX[head]
    maps = Maps(side_px, stride)
    n = side_px // stride
    at = (np.arange(n) + 0.5) * stride - 0.5
    for corners, corner_weight, kind in labels:
        q = np.asarray(corners, np.float64)
        x0, y0, x1, y1 = *q.min(0), *q.max(0)
        w, h = x1 - x0, y1 - y0
        c = q.mean(0)
        mine = lo <= w <= hi
        if kind == 1 or not mine:
            if kind == 1 or lo * SOFT <= w <= hi / SOFT:
                gx, gy = (0.1 * w + 4, 0.1 * h + 4) if kind == 1 else (0.0, 0.0)
                maps.keep[np.ix_((at >= y0 - gy) & (at <= y1 + gy), (at >= x0 - gx) & (at <= x1 + gx))] = 0
            continue
        sx, sy = max(0.16 * w, 0.55 * stride), max(0.22 * h, 0.55 * stride)
        j, i = int(np.clip(round((c[0] + 0.5) / stride - 0.5), 0, n - 1)), int(np.clip(round((c[1] + 0.5) / stride - 0.5), 0, n - 1))
        rj, ri = int(3 * sx / stride) + 1, int(3 * sy / stride) + 1
        js, is_ = np.arange(max(j - rj, 0), min(j + rj + 1, n)), np.arange(max(i - ri, 0), min(i + ri + 1, n))
        slope = np.arctan2(q[1, 1] - q[0, 1] + q[2, 1] - q[3, 1], q[1, 0] - q[0, 0] + q[2, 0] - q[3, 0])
        dx, dy = (js[None, :] - j) * stride, (is_[:, None] - i) * stride
        u, v = dx * np.cos(slope) + dy * np.sin(slope), -dx * np.sin(slope) + dy * np.cos(slope)
        bell = np.exp(-0.5 * ((u / sx) ** 2 + (v / sy) ** 2)).astype(np.float32)
        win = np.ix_(is_, js)
        better = bell > maps.heat[win]
        maps.heat[win] = np.maximum(maps.heat[win], bell)
        maps.keep[i, j] = 1
        own = better & (bell >= CORNER_FROM)
        for k in range(4):
            for axis, cells in ((0, np.broadcast_to(at[js][None, :], bell.shape)), (1, np.broadcast_to(at[is_][:, None], bell.shape))):
                part = maps.offsets[2 * k + axis][win]
                part[own] = ((q[k, axis] - cells) / unit)[own]
                maps.offsets[2 * k + axis][win] = part
        weight = maps.weight[win]
        weight[own] = (bell * corner_weight)[own]
        maps.weight[win] = weight
        for axis, s in ((0, np.sqrt(w * h)), (1, h)):
            part = maps.size[axis][win]
            part[own] = max(s, 2.0)
            maps.size[axis][win] = part
    return maps


def batch_maps(metas: list[list[list]], side_px: int, head: int) -> list[NDArray[np.float32]]:  # type: ignore[type-arg]
    """Stacked heat, keep, offsets, weight, size."""
    maps = [encode(m, side_px, head) for m in metas]  # type: ignore[arg-type]
    return [np.stack([getattr(m, k) for m in maps]) for k in ("heat", "keep", "offsets", "weight", "size")]
