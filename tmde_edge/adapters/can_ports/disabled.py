"""No bus and no GPS: the same calls, nothing behind them."""

from __future__ import annotations

from tmde_edge.adapters.can_ports.bus import CanCounters
from tmde_edge.messages import CanFrame


class DisabledCanPort:
    """What `can.enabled = false` gives."""

    def __init__(self) -> None:
        self.counters = CanCounters()

    @property
    def faults(self) -> tuple[str, ...]:
        """Never any: nothing is expected."""
        return ()

    def start(self) -> None:
        """Nothing to open."""

    def send(self, frame: CanFrame) -> None:
        """Counted as held back."""
        self.counters.silent += 1

    def close(self) -> None:
        """Nothing to close."""
