"""No depth: the same interface, nothing ever ready."""

from __future__ import annotations

from collections.abc import Iterator

from tmde_edge.messages import DepthReading, Frame


class DisabledDepth:
    """Takes frames and gives nothing."""

    def submit(self, frame: Frame) -> None:
        """Ignores the frame."""

    def ready(self, t_ns: int) -> Iterator[DepthReading]:
        """Never has a reading."""
        return iter(())
