"""H.264 video files by PyAV, with the time stamps of the frames themselves."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.errors import writing

_TICKS_PER_S = 90_000


class VideoWriter:
    """Writes an mp4 that plays everywhere (H.264, yuv420p, index in front); the first picture sets the size.

    An odd size grows by one repeated row or column; pictures of another size are scaled to the first one's.
    Raises UsageError when the file cannot be written.
    """

    def __init__(self, path: Path, rate_hz: float = 30.0, *, crf: int = 21, threads: int = 1) -> None:
        self._path = path
        self._rate = Fraction(rate_hz).limit_denominator(1001)
        self._options = {"crf": str(crf), "preset": "veryfast"}
        self._threads = threads
        self._stream: Any = None
        self._last_pts = -1
        with writing(self._path, av.FFmpegError):
            path.open("wb").close()  # FFmpeg itself opens it only with the first picture
            self._container: Any = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def write(self, image: NDArray[np.uint8], t_ns: int) -> None:
        """Adds one picture, uint8 BGR (h, w, 3) or grey (h, w), shown from t_ns on."""
        picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
        if self._stream is None:
            self._start(picture.shape[1] + picture.shape[1] % 2, picture.shape[0] + picture.shape[0] % 2)
        width_px, height_px = self._stream.width, self._stream.height
        missing_x, missing_y = width_px - picture.shape[1], height_px - picture.shape[0]
        if 0 <= missing_x <= 1 and 0 <= missing_y <= 1:
            picture = cv2.copyMakeBorder(picture, 0, missing_y, 0, missing_x, cv2.BORDER_REPLICATE)
        else:
            picture = cv2.resize(picture, (width_px, height_px), interpolation=cv2.INTER_AREA)
        frame = av.VideoFrame.from_ndarray(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420), format="yuv420p")
        self._last_pts = max(self._last_pts + 1, round(t_ns * _TICKS_PER_S / 1e9))
        frame.pts, frame.time_base = self._last_pts, Fraction(1, _TICKS_PER_S)
        with writing(self._path, av.FFmpegError):
            self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finishes the file; closing twice is harmless. A writer that got no picture leaves no file."""
        if self._container is None:
            return
        container, self._container = self._container, None
        with writing(self._path, av.FFmpegError):
            try:
                if self._stream is not None:
                    container.mux(self._stream.encode())
            finally:
                container.close()
        if self._stream is None:
            self._path.unlink(missing_ok=True)

    def _start(self, width_px: int, height_px: int) -> None:
        self._stream = self._container.add_stream("libx264", rate=self._rate)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width_px, height_px, "yuv420p"
        context = self._stream.codec_context
        context.time_base = Fraction(1, _TICKS_PER_S)
        context.thread_count = self._threads
        context.options = self._options
