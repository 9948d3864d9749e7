"""What a live camera is, and the watch over it: lost, stalled, frozen and garbled cameras are named and opened again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tmde_edge.adapters.can_ports.retry import BackOff
from tmde_edge.errors import DeviceError

_log = logging.getLogger(__name__)

CameraFault: TypeAlias = Literal["camera_lost", "camera_stalled", "camera_frozen", "camera_garbled"]
_ADVICE: dict[CameraFault, str] = {
    "camera_lost": "cannot be used",
    "camera_stalled": "gives no frames",
    "camera_frozen": "gives the same frame again and again",
    "camera_garbled": "gives frames that cannot be decoded",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Captured:
    """One frame as the device gave it; pixels come only when asked for, so that skipped frames cost nothing."""

    t_ns: int  # CLOCK_MONOTONIC of the exposure, as near as the device tells
    index: int  # the device's own count: gaps are frames lost on the way
    decode: Callable[[], NDArray[np.uint8] | None]  # uint8 BGR (h, w, 3) or grey (h, w); None: garbled
    fingerprint: int | None = None  # equal for identical frames; None: not known


class LiveCamera(Protocol):
    """A device that gives frames in real time."""

    @property
    def name(self) -> str:
        """For people."""
        ...

    @property
    def ended(self) -> bool:
        """True where no frame will come any more (a played file at its end)."""
        ...

    def open(self) -> None:
        """Opens or opens again. Raises DeviceError, ConfigError."""
        ...

    def read(self, timeout_s: float) -> Captured | None:
        """The newest frame, None when none came in time. Raises DeviceError when the device failed."""
        ...

    def close(self) -> None:
        """Never raises; closing a closed camera is harmless."""
        ...


@dataclass(slots=True)
class CameraCounters:
    """What happened since the start."""

    captured: int = 0
    lost: int = 0  # gaps in the device's own count
    garbled: int = 0
    frozen: int = 0
    opened: int = 0


class WatchedCamera:
    """Reads a camera for ever: names what is wrong with it, opens it again with growing pauses.

    `fault` is None only while good frames come. One thread calls `next`, another may call `good` and `garbled`.
    """

    def __init__(
        self,
        camera: LiveCamera,
        *,
        stall_s: float = 1.0,
        frozen_s: float = 1.0,
        clock_s: Callable[[], float] = time.monotonic,
        pause: Callable[[float], object] = time.sleep,
        back_off: BackOff | None = None,
    ) -> None:
        self.camera = camera
        self.counters = CameraCounters()
        self.fault: CameraFault | None = "camera_lost"
        self._stall_s, self._frozen_s = stall_s, frozen_s
        self._clock_s, self._pause = clock_s, pause
        self._back_off = back_off or BackOff(0.25, 2.0)
        self._is_open = False
        self._told: str | None = None
        self._frame_s = 0.0  # the last new frame came then
        self._good_s = 0.0  # the last frame that could be decoded
        self._garbled_run = 0  # frames since then that could not
        self._fingerprint: int | None = None
        self._index: int | None = None

    def next(self, timeout_s: float) -> Captured | None:
        """The newest frame that is worth looking at; None when there is none yet."""
        if not self._is_open and not self._open():
            return None
        try:
            captured = self.camera.read(timeout_s)
        except DeviceError as error:
            self._reopen("camera_lost", str(error))
            return None
        now_s = self._clock_s()
        if captured is None:
            if now_s - self._frame_s > self._stall_s and not self.camera.ended:
                self._reopen("camera_stalled", f"no frame for {self._stall_s:.1f} s")
            return None
        if captured.fingerprint is not None and captured.fingerprint == self._fingerprint:
            self.counters.frozen += 1
            if now_s - self._frame_s > self._frozen_s:
                self._reopen("camera_frozen", f"identical frames for {self._frozen_s:.1f} s")
            return None
        self._fingerprint, self._frame_s = captured.fingerprint, now_s
        if self._index is not None:
            self.counters.lost += max(captured.index - self._index - 1, 0)
        self._index = captured.index
        self.counters.captured += 1
        if self._garbled_run > 0 and now_s - self._good_s > self._stall_s:
            self._reopen("camera_garbled", f"no good frame for {self._stall_s:.1f} s")
            return None
        return captured

    def good(self) -> None:
        """The last frame could be decoded: the camera works."""
        self._good_s = self._clock_s()
        self._garbled_run = 0
        self._back_off.reset()
        if self.fault is not None and self._is_open:
            if self._told is not None:
                _log.warning("%s: works again", self.camera.name)
            self.fault = self._told = None

    def garbled(self) -> None:
        """The last frame could not be decoded."""
        self.counters.garbled += 1
        self._garbled_run += 1

    def close(self) -> None:
        """Closes the device."""
        self._is_open = False
        self.camera.close()

    def _open(self) -> bool:
        try:
            self.camera.open()
        except DeviceError as error:
            self.camera.close()
            self._tell("camera_lost", str(error))
            self._pause(self._back_off.pause_s())
            return False
        self.counters.opened += 1
        self._is_open = True
        self._frame_s = self._good_s = self._clock_s()
        self._garbled_run = 0
        self._index = None  # the fingerprint stays: a camera that froze may still be frozen
        return True

    def _reopen(self, fault: CameraFault, text: str) -> None:
        self.close()
        self._tell(fault, text)
        self._pause(self._back_off.pause_s())

    def _tell(self, fault: CameraFault, text: str) -> None:
        self.fault = fault
        if self._told != fault:  # once for a lasting fault
            _log.error("%s: %s (%s); trying again", self.camera.name, _ADVICE[fault], text)
        self._told = fault
