"""Cameras through a GStreamer pipeline, where OpenCV was built with GStreamer (JetPack's is, the wheels of PyPI are not).

The pipeline ends in an appsink that gives BGR, and keeps only the newest frame:

    nvarguscamerasrc ! video/x-raw(memory:NVMM),width=1280,height=720,framerate=30/1 ! nvvidconv ! video/x-raw,format=BGRx !
    videoconvert ! video/x-raw,format=BGR ! appsink drop=true max-buffers=1 sync=false
"""

from __future__ import annotations

import contextlib
import queue
import re
import threading
import time
import zlib
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.errors import ConfigError, DeviceError

_STOP_S = 2.0


def has_gstreamer(information: str | None = None) -> bool:
    """Whether this OpenCV can run pipelines, from its build information."""
    text = cv2.getBuildInformation() if information is None else information
    return re.search(r"GStreamer:\s+YES", text) is not None


class GstCamera:
    """A pipeline; OpenCV's `read` blocks without a limit, so it runs on a thread of its own."""

    ended = False
    name = "GStreamer camera"

    def __init__(
        self,
        pipeline: str,
        *,
        make: Callable[[str], Any] | None = None,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Raises ConfigError: no pipeline, no appsink in it, an OpenCV without GStreamer. `make` opens it, for tests."""
        if "appsink" not in pipeline:
            raise ConfigError(f"camera.pipeline = {pipeline!r}: a pipeline must end in an appsink; see docs/service.md")
        if make is None and not has_gstreamer():
            raise ConfigError(
                f'camera.kind = "gstreamer": this OpenCV ({cv2.__version__}) was built without GStreamer; use the one of JetPack '
                'or of Debian (python3-opencv), or camera.kind = "v4l2"'
            )
        self._pipeline = pipeline
        self._make = make or (lambda text: cv2.VideoCapture(text, cv2.CAP_GSTREAMER))
        self._monotonic_ns = monotonic_ns
        self._frames: queue.Queue[Captured | None] = queue.Queue(1)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._count = 0

    def open(self) -> None:
        """Starts the pipeline. Raises DeviceError."""
        capture = self._make(self._pipeline)
        if not capture.isOpened():
            raise DeviceError(f"camera.pipeline: cannot be started; try it: gst-launch-1.0 {self._pipeline[:80]} ...")
        self._stop, self._frames = threading.Event(), queue.Queue(1)
        self._thread = threading.Thread(
            target=self._read_all, args=(capture, self._stop, self._frames), name="gstreamer", daemon=True
        )
        self._thread.start()

    def read(self, timeout_s: float) -> Captured | None:
        """The newest frame. Raises DeviceError when the pipeline ended."""
        try:
            captured = self._frames.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if captured is None:
            raise DeviceError("camera.pipeline: ended (the camera is gone, or an element failed)")
        return captured

    def close(self) -> None:
        """Stops; a pipeline that hangs is left to its thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_STOP_S)
            self._thread = None

    def _read_all(self, capture: Any, stop: threading.Event, frames: queue.Queue[Captured | None]) -> None:
        try:
            while not stop.is_set():
                good, image = capture.read()
                t_ns = self._monotonic_ns()
                captured = self._captured(image, t_ns) if good and image is not None else None
                with contextlib.suppress(queue.Empty):
                    frames.get_nowait()  # the newest wins
                frames.put_nowait(captured)
                if captured is None:
                    return
        finally:
            capture.release()

    def _captured(self, image: Any, t_ns: int) -> Captured:
        pixels = np.ascontiguousarray(image, dtype=np.uint8)
        self._count += 1
        return Captured(t_ns=t_ns, index=self._count - 1, decode=lambda: pixels, fingerprint=zlib.crc32(pixels[::8].tobytes()))
