"""CSI cameras on Raspberry Pi OS through Picamera2 (libcamera), installed by `sudo apt install python3-picamera2`.

Written after the Picamera2 manual (Raspberry Pi Ltd, 2022-2024): `create_video_configuration` (4.2), `capture_request` (6.4),
metadata SensorTimestamp (nanoseconds of CLOCK_BOOTTIME at the first line) and ExposureTime (us), controls (appendix C).
"""

from __future__ import annotations

import concurrent.futures
import importlib
import logging
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.adapters.cameras.v4l2 import V4l2Settings
from tmde_edge.errors import DeviceError

_log = logging.getLogger(__name__)
_BUFFERS = 4
_MAX_AGE_NS = 2_000_000_000
_AF_MANUAL = 0  # libcamera controls::AfModeManual


class PiCamera:
    """Camera number `device` ("0", "1") of Picamera2. RGB888 is BGR in memory there, as OpenCV wants it."""

    ended = False

    def __init__(
        self,
        settings: V4l2Settings,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        boottime_ns: Callable[[], int] = lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME),
    ) -> None:
        self._s = settings
        self._monotonic_ns, self._boottime_ns = monotonic_ns, boottime_ns
        self._camera: Any = None
        self._count = 0
        self._job: Any = None

    @property
    def name(self) -> str:
        """For people."""
        return f"Pi camera {self._number}"

    @property
    def _number(self) -> str:
        return self._s.device if self._s.device.isdecimal() else "0"

    def open(self) -> None:
        """Configures size, rate and locks, starts. Raises DeviceError."""
        try:
            picamera2 = importlib.import_module("picamera2")
        except ImportError as error:
            raise DeviceError(
                f'camera.kind = "picamera2": Picamera2 is not there ({error}); sudo apt install python3-picamera2, and make the '
                "environment with --system-site-packages"
            ) from None
        s = self._s
        frame_us = round(1e6 / s.rate_hz)
        controls: dict[str, Any] = {"FrameDurationLimits": (frame_us, frame_us)}
        if s.exposure_us is not None:
            controls |= {"AeEnable": False, "ExposureTime": round(s.exposure_us)}
        if s.gain is not None:
            controls |= {"AeEnable": False, "AnalogueGain": float(s.gain)}
        if s.focus is not None:  # dioptres
            controls |= {"AfMode": _AF_MANUAL, "LensPosition": float(s.focus)}
        try:
            self._camera = picamera2.Picamera2(int(self._number))
            known = getattr(self._camera, "camera_controls", controls)
            for name in [n for n in controls if n not in known]:
                _log.warning("%s has no control %s; it is left out", self.name, name)
                del controls[name]
            configuration = self._camera.create_video_configuration(
                main={"size": (s.width_px, s.height_px), "format": "RGB888"}, controls=controls, buffer_count=_BUFFERS,
                queue=False,
            )  # fmt: skip
            self._camera.configure(configuration)
            self._camera.start()
        except (RuntimeError, IndexError, ValueError, OSError) as error:
            self.close()
            raise DeviceError(f"{self.name}: cannot be started ({error}); is the cable right? `rpicam-hello` shows it") from None

    def read(self, timeout_s: float) -> Captured | None:
        """The newest frame. Raises DeviceError when the camera failed."""
        if self._camera is None:
            raise DeviceError(f"{self.name}: is not open")
        try:
            # An unanswered job stays for the next call: two would take two frames.
            self._job = self._job or self._camera.capture_request(wait=False)
            request = self._camera.wait(self._job, timeout=timeout_s)
        except (TimeoutError, concurrent.futures.TimeoutError):  # two classes before Python 3.11
            return None
        except RuntimeError as error:
            raise DeviceError(f"{self.name}: failed ({error})") from None
        self._job = None
        try:
            image = np.array(request.make_array("main"), dtype=np.uint8)  # a copy: the buffer goes back
            metadata = request.get_metadata()
        finally:
            request.release()
        self._count += 1
        return Captured(
            t_ns=self._stamp_ns(metadata), index=self._count - 1, decode=lambda: image,
            fingerprint=hash(image[::16, ::16].tobytes()),
        )  # fmt: skip

    def close(self) -> None:
        """Stops and lets the camera go."""
        camera, self._camera, self._job = self._camera, None, None
        if camera is None:
            return
        try:
            camera.stop()
            camera.close()
        except (RuntimeError, OSError) as error:
            _log.debug("%s: stopping: %s", self.name, error)

    def _stamp_ns(self, metadata: dict[str, Any]) -> int:
        """Monotonic time of the middle of the exposure, where the driver tells plausibly."""
        now_ns = self._monotonic_ns()
        stamp = metadata.get("SensorTimestamp")
        if stamp is None:
            return now_ns
        asleep_ns = self._boottime_ns() - now_ns  # boottime also counts suspended time
        t_ns = int(stamp) - asleep_ns - int(metadata.get("ExposureTime", 0)) * 500
        return t_ns if now_ns - _MAX_AGE_NS <= t_ns <= now_ns else now_ns
