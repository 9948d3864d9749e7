"""A network on source time, for the desk: frames at the configured rate, each result ready a fixed latency later."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from tmde_edge.adapters.depth.recorded import Pace
from tmde_edge.messages import DepthReading, Frame


class Network(Protocol):
    """What turns a frame into a reading (OnnxDepth)."""

    def infer(self, frame: Frame, ready_t_ns: int | None = None) -> DepthReading: ...


class PacedDepth:
    """Deterministic: runs in the caller's thread, whatever it costs; two runs are identical."""

    def __init__(self, network: Network, *, rate_hz: float, latency_s: float) -> None:
        self._network = network
        self._pace = Pace(rate_hz)
        self._latency_ns = round(latency_s * 1e9)
        self._waiting: list[DepthReading] = []

    def submit(self, frame: Frame) -> None:
        """Runs the network where a frame is due. Raises ModelError."""
        if self._pace.is_due(frame.t_ns):
            self._pace.took(frame.t_ns)
            self._waiting.append(self._network.infer(frame, frame.t_ns + self._latency_ns))

    def ready(self, t_ns: int) -> Iterator[DepthReading]:
        """Readings available by t_ns, in order."""
        while self._waiting and self._waiting[0].ready_t_ns <= t_ns:
            yield self._waiting.pop(0)
