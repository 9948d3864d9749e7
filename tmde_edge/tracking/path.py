"""Where the own vehicle will go: an arc of yaw rate over speed, and how sure that is while the steering wheel turns."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import EgoState

Array = NDArray[np.float64]

_SLOPE_NS = 400_000_000  # the turning of the wheel shows in the yaw rate over this time
_LEAST_SPEED_MPS = 3.0  # below it yaw rate over speed says little about the way ahead
_HEADING_RAD = 0.004  # how well the camera's own direction against the vehicle's is known
_STEERING_S = 1.0  # a wheel that turns now goes on turning about this long
_COURSE_NS = 500_000_000  # a lane seen longer ago is not used
_COURSE_BEYOND = 1.2  # nor beyond this part of how far it was seen
_COURSE_SIGMA_M = 0.8  # nor where it is less certain than this
_LEAST_SLOPE_RADPS2 = 0.035  # 2 deg/s2: less than this is keeping the lane


class OwnPath:
    """Fed with ego states; offsets are lateral, right positive; yaw rates left positive."""

    def __init__(self) -> None:
        self._ego: EgoState | None = None
        self._recent: deque[tuple[int, float]] = deque()  # t_ns, yaw rate
        self._course: Array = np.zeros((0, 3))  # Z, X, sigma of X in metres, near to far
        self._course_ns: int | None = None

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

    def set_course(self, t_ns: int, points_m: Array) -> None:
        """Our way if we follow the lane: (n, 3) of Z, X (right positive) and its sigma, Z increasing, as seen at t_ns."""
        if len(points_m) > 1:
            self._course, self._course_ns = points_m, t_ns

    def near_curvature(self) -> tuple[float, float] | None:
        """Curvature (1/m, right positive) of the lane within 30 m, and its sigma; None where it is not seen to 15 m."""
        z, x, sigma = self._course.T
        near = z < 30.0
        if near.sum() < 4 or z[near][-1] < 15.0:
            return None
        weight = 1.0 / np.maximum(sigma[near], 0.02)
        design = np.column_stack([z[near], z[near] ** 2 / 2]) * weight[:, None]
        covariance = np.linalg.inv(design.T @ design)
        solved = covariance @ (design.T @ (x[near] * weight))
        # all points come of one fit: they are not independent
        return float(solved[1]), float(math.sqrt(covariance[1, 1] * near.sum()))

    def _on_course(self, t_ns: int, distance_m: float) -> tuple[float, float] | None:
        """X of the lane's course at a distance, and its sigma; None where it is not seen so far, or was too long ago."""
        if self._course_ns is None or not 0 <= t_ns - self._course_ns <= _COURSE_NS:
            return None
        dt_s = (t_ns - self._course_ns) * 1e-9
        v = self._ego.speed_mps if self._ego is not None else 0.0
        yaw = (self._ego.yaw_rate_radps or 0.0) if self._ego is not None else 0.0
        at_m = distance_m + v * dt_s
        z, x, sigma = self._course.T
        if at_m > _COURSE_BEYOND * z[-1]:
            return None
        slope = (x[-1] - x[-2]) / max(z[-1] - z[-2], 1e-6)
        beyond_m = max(at_m - z[-1], 0.0)
        here = float(np.interp(at_m, z, x)) + float(slope) * beyond_m
        start = float(np.interp(v * dt_s, [0.0, *z], [0.0, *x]))  # we went along it meanwhile
        return here - start + yaw * dt_s * distance_m, float(np.interp(at_m, z, sigma)) + 0.1 * beyond_m

    def lane_seen(self, t_ns: int, distance_m: float) -> bool:
        """Whether the lane itself tells where the path is at this distance."""
        seen = self._on_course(t_ns, distance_m)
        return seen is not None and seen[1] <= _COURSE_SIGMA_M and distance_m <= float(self._course[-1, 0])

    def offset_m(self, t_ns: int, lateral_m: float, lateral_sigma_m: float, distance_m: float) -> tuple[float, float]:
        """Offset of a place from the path, and its sigma: along the lane where it is seen that far, else along the arc."""
        seen = self._on_course(t_ns, distance_m)
        if seen is not None and seen[1] <= _COURSE_SIGMA_M:
            return lateral_m - seen[0], math.hypot(lateral_sigma_m, _HEADING_RAD * distance_m, seen[1])
        return self.arc_offset_m(lateral_m, lateral_sigma_m, distance_m)

    def arc_offset_m(self, lateral_m: float, lateral_sigma_m: float, distance_m: float) -> tuple[float, float]:
        """Offset from the arc of yaw rate over speed, and its sigma.

        Against a circle of curvature kappa (right positive) the offset is (2 x - kappa r^2) / (1 + distance from its centre
        in radii), r^2 = x^2 + D^2: exact also where it has turned far. A wheel that turns just now bends it further; how
        far is not known, so half of it is expected and half of it is doubt.
        """
        sigma_m = math.hypot(lateral_sigma_m, _HEADING_RAD * distance_m)
        ego = self._ego
        if ego is None or ego.yaw_rate_radps is None or ego.speed_mps < _LEAST_SPEED_MPS:
            return lateral_m, sigma_m
        v = ego.speed_mps
        kappa = -ego.yaw_rate_radps / v
        radii = math.hypot(1.0 - kappa * lateral_m, kappa * distance_m)
        offset_m = (2.0 * lateral_m - kappa * (lateral_m**2 + distance_m**2)) / (1.0 + radii)
        more_m = self._turning() / v**2 * _ramp_m3(distance_m, _STEERING_S * v)
        sigma_m = math.hypot(sigma_m, ego.yaw_rate_sigma_radps / v * distance_m**2 / 2, more_m / 2)
        return offset_m + more_m / 2, sigma_m

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
