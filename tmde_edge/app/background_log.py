"""Hands every step to the recorder on a thread of its own, so that a slow disk never delays a decision."""

from __future__ import annotations

import logging
import queue
import threading
from typing import Protocol, TypeAlias

from tmde_edge.messages import Event, Frame, Output, RangeReference

_log = logging.getLogger(__name__)
_STEPS = 4000  # some ten seconds of a drive
_FRAMES = 8  # beyond this many steps waiting the pictures would fill the memory; the steps themselves are kept
_IDLE_S = 0.25  # a recorder that has nothing to do is given time this often

_Step: TypeAlias = "tuple[Event, tuple[Output, ...], Frame | None]"


class StepSink(Protocol):
    """What records (app/recorder.py). Used by one thread; its errors are its own affair: it says them in `problem`."""

    @property
    def problem(self) -> str | None:
        """Why nothing is recorded at the moment; None: all is well."""
        ...

    def write(self, event: Event, outputs: tuple[Output, ...], frame: Frame | None = None) -> None:
        """Takes one step."""
        ...

    def reference(self, reference: RangeReference) -> None:
        """Takes what another instrument measured."""
        ...

    def lost(self) -> None:
        """Steps were lost here."""
        ...

    def idle(self) -> None:
        """Nothing came for a moment."""
        ...

    def close(self) -> None:
        """Finishes everything."""
        ...


class BackgroundLog:
    """Queues steps in order. Where the recorder falls behind, steps are lost and it is told: no silent gaps."""

    def __init__(self, sink: StepSink, *, keep_frames: bool = False) -> None:
        self._sink = sink
        self._keep_frames = keep_frames
        self._queue: queue.Queue[_Step | RangeReference | None] = queue.Queue(_STEPS)
        self._overrun = False
        self._crashed = False
        self.dropped = 0
        self._thread = threading.Thread(target=self._write_all, name="drive-log", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str | None:
        """Why not everything is recorded; None: all is well."""
        if self._crashed:
            return "the recorder has crashed"
        return "the disk is too slow" if self._overrun else self._sink.problem

    @property
    def waiting(self) -> int:
        """Steps in the queue."""
        return self._queue.qsize()

    def write(self, event: Event, outputs: tuple[Output, ...], frame: Frame | None = None) -> None:
        """Takes one step and returns at once."""
        keep = self._keep_frames and self._queue.qsize() < _FRAMES
        self._put((event, outputs, frame if keep else None))

    def reference(self, reference: RangeReference) -> None:
        """Takes what another instrument measured; from any thread."""
        self._put(reference)

    def close(self, timeout_s: float = 3.0) -> None:
        """Writes what is queued and finishes the files; gives up on a disk that does not answer."""
        if self._thread.is_alive():
            try:
                self._queue.put(None, timeout=timeout_s)
            except queue.Full:
                return
            self._thread.join(timeout_s)

    def _put(self, item: _Step | RangeReference) -> None:
        if self._overrun or self._crashed:  # one hole, not a sieve: until the queue is empty again
            self.dropped += 1
            return
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self.dropped += 1
            self._overrun = True
            _log.error("recording has a hole (the disk is too slow); everything else goes on")

    def _write_all(self) -> None:
        try:
            while True:
                try:
                    item = self._queue.get(timeout=_IDLE_S)
                except queue.Empty:
                    if self._overrun:
                        self._sink.lost()
                        self._overrun = False
                    self._sink.idle()
                    continue
                if item is None:
                    break
                if isinstance(item, RangeReference):
                    self._sink.reference(item)
                else:
                    self._sink.write(*item)
                if self._overrun and self._queue.empty():
                    self._sink.lost()
                    self._overrun = False
            self._sink.close()
        except Exception:  # a thread's top; a service that cannot record still warns
            _log.exception("the recorder has crashed; everything else goes on")
            self._crashed = True
