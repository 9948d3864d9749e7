"""Where the time of one frame goes."""

from __future__ import annotations

from collections.abc import Callable


class Timing:
    """Milliseconds by stage of one frame, by the given clock; it decides nothing."""

    def __init__(self, clock_ns: Callable[[], int]) -> None:
        self._clock_ns = clock_ns
        self._start_ns = self._last_ns = clock_ns()
        self._stages: dict[str, float] = {}

    def done(self, stage: str) -> None:
        """What passed since the last call belongs to this stage."""
        now = self._clock_ns()
        self._stages[stage] = self._stages.get(stage, 0.0) + (now - self._last_ns) * 1e-6
        self._last_ns = now

    def total_ms(self) -> dict[str, float]:
        """`total` since the start, and every stage."""
        return {"total": (self._clock_ns() - self._start_ns) * 1e-6, **self._stages}
