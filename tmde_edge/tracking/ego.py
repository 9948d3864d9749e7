"""The own vehicle's way between two times, from its speed samples."""

from __future__ import annotations

from collections import deque

from tmde_edge.messages import EgoState


class EgoMotion:
    """Integrates speed over the last seconds (trapezoid between samples, constant beyond the last)."""

    def __init__(self, keep_s: float = 5.0) -> None:
        self._keep_ns = round(keep_s * 1e9)
        self._samples: deque[tuple[int, float, float]] = deque()  # t_ns, speed_mps, travelled_m up to then

    def add(self, ego: EgoState) -> None:
        """Takes a speed sample; one that is older than the newest changes nothing."""
        travelled = 0.0
        if self._samples:
            t_ns, speed, before = self._samples[-1]
            if ego.t_ns <= t_ns:
                return
            travelled = before + (ego.t_ns - t_ns) * 1e-9 * (speed + ego.speed_mps) / 2
        self._samples.append((ego.t_ns, ego.speed_mps, travelled))
        while self._samples[-1][0] - self._samples[0][0] > self._keep_ns:
            self._samples.popleft()

    def clear(self) -> None:
        """Forgets everything (the speed was lost)."""
        self._samples.clear()

    def _travelled_m(self, t_ns: int) -> float:
        newest_t, newest_v, newest_s = self._samples[-1]
        if t_ns >= newest_t:
            return newest_s + newest_v * (t_ns - newest_t) * 1e-9
        after = self._samples[-1]
        for before in reversed(self._samples):
            if before[0] <= t_ns:
                dt = (t_ns - before[0]) * 1e-9
                span = (after[0] - before[0]) * 1e-9
                slope = (after[1] - before[1]) / span if span > 0 else 0.0
                return before[2] + before[1] * dt + slope * dt * dt / 2
            after = before
        first_t, first_v, first_s = self._samples[0]
        return first_s - first_v * (first_t - t_ns) * 1e-9

    def braking_mps2(self) -> float:
        """Own deceleration over the last half second, 0 where we do not brake or it is not known."""
        recent = [(t * 1e-9, v) for t, v, _ in self._samples if self._samples[-1][0] - t <= 500_000_000]
        if len(recent) < 4 or recent[-1][0] - recent[0][0] < 0.25:
            return 0.0
        mean_t, mean_v = (sum(x) / len(recent) for x in zip(*recent, strict=True))
        spread = sum((t - mean_t) ** 2 for t, _ in recent)
        slope = sum((t - mean_t) * (v - mean_v) for t, v in recent) / spread
        return max(0.0, -float(slope))

    def travel_m(self, from_ns: int, to_ns: int) -> float:
        """Metres covered between two times; 0 where no speed is known."""
        if not self._samples:
            return 0.0
        return self._travelled_m(to_ns) - self._travelled_m(from_ns)
