"""Zero offset of the yaw rate sensor: learned at standstill, on long straight driving and from the lane."""

from __future__ import annotations

import math

_DEG = math.pi / 180
_PRIOR_RADPS = 0.5 * _DEG  # one sigma of what real sensors show
_DRIFT_RADPS2_S = (0.002 * _DEG) ** 2  # variance a second: warming up moves it by some 0.1 deg/s an hour
_WINDOW_NS = 2_000_000_000
_STANDSTILL_MPS = 0.1
_STANDSTILL_SIGMA = 0.05 * _DEG  # of one window
_STRAIGHT_MPS = 8.0
_STRAIGHT_SIGMA = 0.6 * _DEG  # of one window: a road that looks straight still bends a little
_STEADY_RADPS = 0.5 * _DEG  # more spread within a window is steering
_ROBUST = 1.5  # innovations beyond this many sigma lose weight (a long bend is not an offset)
_GAP_NS = 500_000_000


class YawOffset:
    """Scalar Kalman filter of the offset in rad/s, fed with windows of two seconds; time comes with the readings."""

    def __init__(self) -> None:
        self._mean = 0.0
        self._variance = _PRIOR_RADPS**2
        self._t_ns: int | None = None
        self._start_ns: int | None = None
        self._last_ns = 0
        self._count = 0
        self._sum = 0.0
        self._squares = 0.0
        self._slowest = math.inf
        self._fastest = 0.0
        self._latest_raw: tuple[int, float] | None = None

    @property
    def offset_radps(self) -> float:
        """What to subtract from the raw yaw rate."""
        return self._mean

    @property
    def sigma_radps(self) -> float:
        """One sigma of the offset."""
        return math.sqrt(self._variance)

    def observe(self, t_ns: int, raw_radps: float, speed_mps: float) -> None:
        """One raw yaw rate (positive left) with the speed of the same moment."""
        self._latest_raw = (t_ns, raw_radps)
        if self._start_ns is None or t_ns < self._last_ns or t_ns - self._last_ns > _GAP_NS:
            self._begin(t_ns)
        self._last_ns = t_ns
        self._count += 1
        self._sum += raw_radps
        self._squares += raw_radps * raw_radps
        self._slowest = min(self._slowest, abs(speed_mps))
        self._fastest = max(self._fastest, abs(speed_mps))
        if self._start_ns is not None and t_ns - self._start_ns >= _WINDOW_NS:
            self._close(t_ns)
            self._begin(t_ns)

    def observe_lane_yaw(self, t_ns: int, yaw_rate_radps: float, sigma_radps: float) -> None:
        """A yaw rate known from the lane at about the time of the newest raw reading."""
        if self._latest_raw is None or abs(t_ns - self._latest_raw[0]) > _GAP_NS:
            return
        if math.isfinite(yaw_rate_radps) and math.isfinite(sigma_radps) and sigma_radps > 0:
            self._update(t_ns, self._latest_raw[1] - yaw_rate_radps, max(sigma_radps, _STANDSTILL_SIGMA))

    def _begin(self, t_ns: int) -> None:
        self._start_ns, self._count, self._sum, self._squares = t_ns, 0, 0.0, 0.0
        self._slowest, self._fastest = math.inf, 0.0

    def _close(self, t_ns: int) -> None:
        if self._count < 5:
            return
        mean = self._sum / self._count
        spread = math.sqrt(max(self._squares / self._count - mean * mean, 0.0))
        if spread > _STEADY_RADPS:
            return
        if self._fastest < _STANDSTILL_MPS:
            self._update(t_ns, mean, _STANDSTILL_SIGMA)
        elif self._slowest > _STRAIGHT_MPS:
            self._update(t_ns, mean, _STRAIGHT_SIGMA)

    def _update(self, t_ns: int, offset: float, sigma: float) -> None:
        if self._t_ns is not None and t_ns > self._t_ns:
            self._variance += _DRIFT_RADPS2_S * (t_ns - self._t_ns) * 1e-9
        self._variance = min(self._variance, _PRIOR_RADPS**2)
        self._t_ns = t_ns
        innovation = offset - self._mean
        spread = math.sqrt(self._variance + sigma * sigma)
        excess = max(abs(innovation) / spread / _ROBUST, 1.0)
        noise = sigma * sigma * excess**4  # redescending: a far value hardly moves the mean
        gain = self._variance / (self._variance + noise)
        self._mean += gain * innovation
        self._variance *= 1 - gain
