"""One side of a plate as a line through the sub-pixel places of its edge, with its sigma and the edge's spread."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from tmde_edge.vision.edge_profiles import MIN_STEP_GREY, SMOOTH_PX, STEP_PX, Array

PIECES = 10  # a side is measured in this many pieces
FLOOR_PX = 0.05  # of one side's sigma: sampling and lens, which no residual shows


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """A line as offsets along the outward normal at the side's two ends."""

    at_start_px: float
    at_end_px: float
    sigma_px: float
    blur_px: float | None  # None: not measured


def measured_side(along: Array, offsets: Array, slope: Array, line_px: tuple[float, float]) -> Side | None:
    """Sub-pixel offsets of the pieces of a line by the parabola through the slope's peak, then a Tukey line fit."""
    if len(along) < 2 * PIECES:
        return None
    middle = len(offsets) // 2
    sign = 1.0 if slope[:, middle - 2 : middle + 3].mean() >= 0 else -1.0
    rows = len(along) // PIECES * PIECES  # a few rows at the end are left out
    window = sign * slope[:rows, middle - 6 : middle + 7]
    pieces = window.reshape(PIECES, -1, window.shape[1]).mean(axis=1)
    k = pieces.argmax(axis=1)
    piece = np.arange(PIECES)
    top = pieces[piece, k]
    good = (k > 0) & (k < pieces.shape[1] - 1) & (top >= MIN_STEP_GREY / 8)
    if good.sum() < max(4, PIECES // 2):
        return None
    piece, k, top = piece[good], k[good], top[good]
    before, after = pieces[piece, k - 1], pieces[piece, k + 1]
    x = along[:rows].reshape(PIECES, -1).mean(axis=1)[piece]
    peak = offsets[middle - 6 + k] + 0.5 * (before - after) / (before - 2 * top + after) * STEP_PX
    y = line_px[0] + x * line_px[1] + peak
    fit = _tukey_line(x, y, np.sqrt(top))
    if fit is None:
        return None
    at, tilt, sigma = fit
    peak_slope = window.mean(axis=0)
    spread = float(np.clip(peak_slope, 0, None).sum() * STEP_PX / (np.sqrt(2 * np.pi) * max(peak_slope.max(), 1e-6)))
    return Side(
        at_start_px=at - 0.5 * tilt,
        at_end_px=at + 0.5 * tilt,
        sigma_px=float(np.hypot(sigma, FLOOR_PX)),
        blur_px=float(np.sqrt(max(spread**2 - SMOOTH_PX**2, 0.0))),
    )


def _tukey_line(x: Array, y: Array, weight: Array) -> tuple[float, float, float] | None:
    """Robust line y = at + tilt x: (at, tilt, sigma of the line at its ends); None where fewer than 4 points agree."""
    points = list(zip(x.tolist(), y.tolist(), weight.tolist(), strict=True))  # ten numbers: quicker by themselves than as arrays
    n = len(points)
    at, tilt, robust = 0.0, 0.0, [1.0] * n
    for _ in range(5):
        w = [p[2] * r for p, r in zip(points, robust, strict=True)]
        total = sum(w)
        mx = sum(v * p[0] for v, p in zip(w, points, strict=True)) / total
        my = sum(v * p[1] for v, p in zip(w, points, strict=True)) / total
        sxx = sum(v * (p[0] - mx) ** 2 for v, p in zip(w, points, strict=True))
        sxy = sum(v * (p[0] - mx) * (p[1] - my) for v, p in zip(w, points, strict=True))
        tilt = sxy / sxx if sxx > 1e-12 else 0.0
        at = my - tilt * mx
        residual = [abs(p[1] - at - tilt * p[0]) for p in points]
        reach = 4.685 * max(1.4826 * sorted(residual)[n // 2], 0.03)
        robust = [max(1 - (r / reach) ** 2, 0.0) ** 2 for r in residual]
        if sum(r > 0.2 for r in robust) < 4:
            return None
    used = [(p[0], p[1] - at - tilt * p[0]) for p, r in zip(points, robust, strict=True) if r > 0.2]
    middle = sum(u for u, _ in used) / len(used)
    rms = sqrt(sum(r * r for _, r in used) / (len(used) - 2))
    leverage = 1 / len(used) + 0.25 / max(sum((u - middle) ** 2 for u, _ in used), 1e-6)
    return at, tilt, rms * sqrt(leverage * n / len(used))
