"""Where the own vehicle will go: an arc of yaw rate over speed, and how sure that is while the steering wheel turns."""

from __future__ import annotations

import math
from collections import deque

from tmde_edge.messages import EgoState

_SLOPE_NS = 400_000_000  # the turning of the wheel shows in the yaw rate over this time
_LEAST_SPEED_MPS = 3.0  # below it yaw rate over speed says little about the way ahead
_HEADING_RAD = 0.004  # how well the camera's own direction against the vehicle's is known
_STEERING_S = 1.0  # a wheel that turns now goes on turning about this long
_LEAST_SLOPE_RADPS2 = 0.035  # 2 deg/s2: less than this is keeping the lane


class OwnPath:
    """Fed with ego states; offsets are lateral, right positive; yaw rates left positive."""

    def __init__(self) -> None:
        self._ego: EgoState | None = None
        self._recent: deque[tuple[int, float]] = deque()  # t_ns, yaw rate

    def set_ego(self, ego: EgoState | None) -> None:
        """The newest ego state; None when it is not known (any more)."""
        if ego is None or ego.yaw_rate_radps is None:
            self._recent.clear()
        else:
            if self._recent and ego.t_ns <= self._recent[-1][0]:
                self._recent[-1] = self._recent[-1][0], ego.yaw_rate_radps
            else:
                self._recent.append((ego.t_ns, ego.yaw_rate_radps))
            while ego.t_ns - self._recent[0][0] > _SLOPE_NS:
                self._recent.popleft()
        self._ego = ego

    def offset_m(self, lateral_m: float, lateral_sigma_m: float, distance_m: float) -> tuple[float, float]:
        """Offset of a place from the path, and its sigma.

        The arc moves the path by kappa D^2 / 2. A wheel that turns just now bends it further; how far is not known, so
        half of it is expected and half of it is doubt.
        """
        sigma_m = math.hypot(lateral_sigma_m, _HEADING_RAD * distance_m)
        ego = self._ego
        if ego is None or ego.yaw_rate_radps is None or ego.speed_mps < _LEAST_SPEED_MPS:
            return lateral_m, sigma_m
        v = ego.speed_mps
        shift_m = ego.yaw_rate_radps / v * distance_m**2 / 2
        more_m = self._turning() / v**2 * _ramp_m3(distance_m, _STEERING_S * v)
        sigma_m = math.hypot(sigma_m, ego.yaw_rate_sigma_radps / v * distance_m**2 / 2, more_m / 2)
        return lateral_m + shift_m + more_m / 2, sigma_m

    def _turning(self) -> float:
        """Yaw acceleration (rad/s2) by least squares over the last moments; 0 where it is within lane keeping."""
        if len(self._recent) < 5 or self._recent[-1][0] - self._recent[0][0] < 0.5 * _SLOPE_NS:
            return 0.0
        t = [(a - self._recent[0][0]) * 1e-9 for a, _ in self._recent]
        y = [b for _, b in self._recent]
        mean_t, mean_y = sum(t) / len(t), sum(y) / len(y)
        spread = sum((a - mean_t) ** 2 for a in t)
        slope = sum((a - mean_t) * (b - mean_y) for a, b in zip(t, y, strict=True)) / spread
        return math.copysign(max(abs(slope) - _LEAST_SLOPE_RADPS2, 0.0), slope)


def _ramp_m3(distance_m: float, ramp_m: float) -> float:
    """Lateral shift at a distance per unit of curvature change a metre, which goes on over ramp_m and then stays."""
    near = min(distance_m, ramp_m)
    far = max(distance_m - ramp_m, 0.0)
    return near**3 / 6 + far * near**2 / 2 + near * far**2 / 2
