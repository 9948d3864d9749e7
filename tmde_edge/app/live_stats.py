"""Rates and latencies of the live loop: what `status` shows and what load shedding goes by."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from tmde_edge.app.shedding import Load

RECENT_NS = 2_000_000_000


class LiveStats:
    """Written by the deciding thread; `perceived` by the perception thread, which writes nothing else."""

    def __init__(self) -> None:
        self._decided: deque[tuple[int, int]] = deque(maxlen=240)  # (when, shutter to decision), ns
        self._busy_ns = 0  # of perception, since the start
        self._took: deque[int] = deque(maxlen=120)
        self._before = (0, 0, 0, 0, 0)

    def perceived(self, took_ns: int) -> None:
        """Perception spent this long on a frame."""
        self._busy_ns += took_ns
        self._took.append(took_ns)

    def decided(self, shutter_ns: int, now_ns: int) -> None:
        """A frame was decided on."""
        self._decided.append((now_ns, now_ns - shutter_ns))

    def rate_hz(self, now_ns: int) -> float:
        """Decisions a second, over the last two."""
        recent = [t for t, _ in list(self._decided) if now_ns - t < RECENT_NS]
        span_s = (recent[-1] - recent[0]) * 1e-9 if len(recent) > 1 else 0.0
        return (len(recent) - 1) / span_s if span_s > 0 else 0.0

    def load(self, now_ns: int, *, sightings: int, skipped: int, inbox_dropped: int, hot: bool) -> Load:
        """How it went since the last call; the counters are those since the start."""
        then_ns, was_sightings, was_skipped, was_dropped, was_busy = self._before
        self._before = (now_ns, sightings, skipped, inbox_dropped, self._busy_ns)
        if then_ns == 0 or now_ns <= then_ns:
            return Load(hot=hot)
        late = [late_ns for t, late_ns in list(self._decided) if t > then_ns]
        frames = sightings - was_sightings + skipped - was_skipped
        return Load(
            skipped=(skipped - was_skipped) / frames if frames > 0 else 0.0,
            busy=min((self._busy_ns - was_busy) / (now_ns - then_ns), 1.0),
            late_s=float(np.percentile(late, 90)) * 1e-9 if late else 0.0,
            dropped=inbox_dropped > was_dropped,
            hot=hot,
        )

    def record(self, now_ns: int) -> dict[str, Any]:
        """For `status`: rate, latencies and how busy perception is."""
        late = [late_ns * 1e-6 for t, late_ns in list(self._decided) if now_ns - t < 10_000_000_000]
        took = [t * 1e-6 for t in list(self._took)]
        rate_hz = self.rate_hz(now_ns)
        return {
            "rate_hz": round(rate_hz, 2),
            "latency_p50_ms": _percentile(late, 50),
            "latency_p99_ms": _percentile(late, 99),
            "perception_p50_ms": _percentile(took, 50),
            "perception_p99_ms": _percentile(took, 99),
            "busy": round(min(rate_hz * float(np.mean(took)) * 1e-3, 1.0), 3) if took else None,
        }


def _percentile(values: list[float], percent: float) -> float | None:
    return round(float(np.percentile(values, percent)), 2) if values else None
