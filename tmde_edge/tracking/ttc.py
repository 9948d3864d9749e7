"""Time to collision and required deceleration from a filtered state."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def plain_ttc_s(gap_m: float, range_rate_mps: float) -> float | None:
    """gap / closing speed (paper: TTC = D / -v); None when not closing."""
    if range_rate_mps >= -1e-3 or not math.isfinite(gap_m):
        return None
    return max(gap_m, 0.0) / -range_rate_mps


def braking_ttc_s(
    gap_m: float, range_rate_mps: float, lead_accel_mps2: float, lead_speed_mps: float | None
) -> float | None:
    """TTC that counts the lead's braking: gap + v t + a t^2 / 2 = 0; a braking lead stops, it does not reverse.

    lead_accel_mps2 counts only where negative (a lead that speeds up gets no credit). None when no collision follows.
    """
    gap = max(gap_m, 0.0)
    a, v = min(lead_accel_mps2, 0.0), range_rate_mps
    if a > -1e-3:
        return plain_ttc_s(gap_m, range_rate_mps)
    root = v * v - 2.0 * a * gap
    t = (-v - math.sqrt(root)) / a
    if lead_speed_mps is not None:
        stop_s = max(lead_speed_mps, 0.0) / -a
        if t > stop_s:  # the lead stands by then: the rest at our own speed
            ego = lead_speed_mps - v
            if ego <= 1e-3:
                return None
            return (gap + max(lead_speed_mps, 0.0) ** 2 / (-2.0 * a)) / ego
    return t if t >= 0 else None


def ttc_sigma_s(gap_m: float, range_rate_mps: float, covariance: NDArray[np.float64]) -> float | None:
    """First-order sigma of the plain TTC from the covariance (>= 2, >= 2) of distance and speed."""
    if range_rate_mps >= -1e-3:
        return None
    grad = np.array([-1.0 / range_rate_mps, max(gap_m, 0.0) / range_rate_mps**2])
    return float(math.sqrt(max(grad @ covariance[:2, :2] @ grad, 0.0)))


def required_decel_mps2(gap_m: float, range_rate_mps: float) -> float:
    """v_rel^2 / (2 gap), the constant deceleration that just avoids contact; 0 when not closing."""
    if range_rate_mps >= 0:
        return 0.0
    return range_rate_mps**2 / (2.0 * max(gap_m, 0.05))
