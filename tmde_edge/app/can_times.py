"""CAN log lines on the video's time: t_video = t_can - t_first_line + offset."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from tmde_edge.messages import CanFrame


class CanTimeline:
    """Hands out a log's frames up to a time, in order; a log whose times step back is clamped, not reordered."""

    def __init__(self, frames: Iterator[CanFrame], offset_s: float) -> None:
        self._frames = frames
        self._offset_ns = round(offset_s * 1e9)
        self._first_ns: int | None = None
        self._newest_ns: int | None = None
        self._next = self._pull()

    def _pull(self) -> CanFrame | None:
        frame = next(self._frames, None)
        if frame is None:
            return None
        if self._first_ns is None:
            self._first_ns = frame.t_ns
        t_ns = frame.t_ns - self._first_ns + self._offset_ns
        if self._newest_ns is not None:
            t_ns = max(t_ns, self._newest_ns)
        self._newest_ns = t_ns
        return replace(frame, t_ns=t_ns)

    def until(self, t_ns: int) -> Iterator[CanFrame]:
        """All frames not later than t_ns that were not handed out yet."""
        while self._next is not None and self._next.t_ns <= t_ns:
            yield self._next
            self._next = self._pull()
