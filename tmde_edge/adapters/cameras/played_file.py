"""A recording played in real time in place of a camera: `camera.kind = "video_file"`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.adapters.cameras.sources import SourceItem, open_source
from tmde_edge.errors import DeviceError, InputDataError, InputMissingError
from tmde_edge.messages import Frame


class PlayedFile:
    """Frames appear when their time has come; late ones are skipped, as a camera would. `loop` begins again at the end."""

    def __init__(
        self,
        spec: str,
        *,
        loop: bool = False,
        fps: float = 30.0,
        threads: int = 1,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self._spec, self._loop, self._fps, self._threads = spec, loop, fps, threads
        self._clock_ns, self._sleep = clock_ns, sleep
        self._items: Iterator[SourceItem] | None = None
        self._ahead: SourceItem | None = None
        self._start_ns = 0
        self._step_ns = round(1e9 / fps)
        self._last_ns = 0
        self._count = 0
        self._offset = 0
        self.ended = False

    @property
    def name(self) -> str:
        """The file."""
        return f"played file {Path(self._spec).name}"

    def open(self) -> None:
        """Starts from the beginning. Raises DeviceError."""
        try:
            self._items = iter(open_source(self._spec, self._fps, threads=self._threads))
            self._ahead = next(self._items, None)
        except (InputMissingError, InputDataError) as error:
            raise DeviceError(str(error)) from error
        self._start_ns = self._clock_ns()
        self._last_ns = 0
        self._offset = self._count

    def read(self, timeout_s: float) -> Captured | None:
        """The newest frame that is due. Raises DeviceError when the file turns out unreadable.

        The frame after it is decoded by the next call, not before this one is given away: that would delay it.
        """
        deadline_ns = self._clock_ns() + round(timeout_s * 1e9)
        newest: Captured | None = None
        while not self.ended:
            ahead = self._ahead = self._ahead or self._decoded()
            if ahead is None:
                if newest is not None:
                    break
                self._at_end()
                continue
            due_ns = self._start_ns + ahead.t_ns
            now_ns = self._clock_ns()
            if due_ns > now_ns:
                if newest is not None or due_ns > deadline_ns:
                    break
                self._sleep((due_ns - now_ns) * 1e-9)
                continue
            newest = self._captured(ahead, due_ns)
            step_ns = ahead.t_ns - self._last_ns or self._step_ns
            self._last_ns, self._ahead = ahead.t_ns, None
            if now_ns < due_ns + step_ns or now_ns >= deadline_ns:  # none after it is due; or decoding takes too long
                break
        if newest is None:
            self._sleep(max(deadline_ns - self._clock_ns(), 0) * 1e-9)
        return newest

    def close(self) -> None:
        """Lets the file go."""
        self._items = self._ahead = None

    def _captured(self, item: SourceItem, due_ns: int) -> Captured:
        self._count = self._offset + item.index + 1
        image = item.image if isinstance(item, Frame) else None
        return Captured(t_ns=due_ns, index=self._count - 1, decode=lambda: image)

    def _decoded(self) -> SourceItem | None:
        try:
            return next(self._items, None) if self._items is not None else None
        except InputDataError as error:
            raise DeviceError(str(error)) from error

    def _at_end(self) -> None:
        if self._items is None or not self._loop:
            self.ended = True
            return
        start_ns = self._start_ns + self._last_ns + self._step_ns
        self.open()
        # The first frame follows the last at the usual distance, or as soon as the file is open again: that loses no frame.
        self._start_ns = max(start_ns, self._start_ns)
