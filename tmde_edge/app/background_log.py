"""Writes the drive log on a thread of its own, so that a slow disk never delays a decision."""

from __future__ import annotations

import logging
import queue
import threading
from typing import Protocol

from tmde_edge.messages import Event, Frame, Output

_log = logging.getLogger(__name__)
_STEPS = 2000  # some ten seconds of a drive
_STEPS_WITH_FRAMES = 30  # beyond this the pictures would fill the memory; the steps themselves are kept


class StepWriter(Protocol):
    """The drive log."""

    def write(self, event: Event, outputs: tuple[Output, ...], frame: Frame | None = None) -> None:
        """Logs one step. Raises OSError when the disk refuses."""
        ...

    def close(self) -> None:
        """Finishes the file."""
        ...


class BackgroundLog:
    """Queues steps in order. When the disk fails or falls behind, recording ends and `failed` says so: no gaps."""

    def __init__(self, writer: StepWriter, *, keep_frames: bool = False) -> None:
        self._writer = writer
        self._keep_frames = keep_frames
        self._queue: queue.Queue[tuple[Event, tuple[Output, ...], Frame | None] | None] = queue.Queue(_STEPS)
        self.failed = False
        self._thread = threading.Thread(target=self._write_all, name="drive-log", daemon=True)
        self._thread.start()

    def write(self, event: Event, outputs: tuple[Output, ...], frame: Frame | None = None) -> None:
        """Takes one step and returns at once."""
        if self.failed:
            return
        keep = self._keep_frames and self._queue.qsize() < _STEPS_WITH_FRAMES
        try:
            self._queue.put_nowait((event, outputs, frame if keep else None))
        except queue.Full:
            self._fail("the disk is too slow")

    def close(self, timeout_s: float = 3.0) -> None:
        """Writes what is queued and finishes the file; gives up on a disk that does not answer."""
        if self._thread.is_alive():
            try:
                self._queue.put(None, timeout=timeout_s)
            except queue.Full:
                return
            self._thread.join(timeout_s)

    def _write_all(self) -> None:
        try:
            while (step := self._queue.get()) is not None:
                if not self.failed:
                    self._writer.write(*step)
        except OSError as error:
            self._fail(str(error))
        try:
            self._writer.close()
        except OSError as error:
            self._fail(str(error))

    def _fail(self, reason: str) -> None:
        if not self.failed:
            _log.error("recording ends (%s); everything else goes on", reason)
        self.failed = True
