"""Video files by PyAV (FFmpeg): exact time stamps, damaged parts reported in their place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from tmde_edge.errors import InputDataError, InputMissingError
from tmde_edge.messages import Frame

_GREY_FORMATS = frozenset(("gray", "gray10le", "gray12le", "gray16le", "gray16be", "monow", "monob"))
_MAX_ERRORS_IN_A_ROW = 300  # then the rest of the file is given up


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceError:
    """A frame that is there but cannot be read; it takes the frame's place, index and time."""

    index: int
    t_ns: int
    message: str


@dataclass(slots=True)
class _Clock:
    """Source time from presentation stamps: 0 at the first frame, always growing, also over missing stamps."""

    time_base: Fraction
    step_ns: int
    start_ns: int | None = None
    frame_ns: int | None = None  # of the frame before
    errors_since: int = 0

    def of_frame(self, pts: int | None) -> int:
        t_ns = self._expected_ns()
        if pts is not None:
            pts_ns = round(pts * self.time_base * 1_000_000_000)
            if self.start_ns is None or (self.frame_ns is not None and pts_ns - self.start_ns <= self.frame_ns):
                self.start_ns = pts_ns - t_ns
            t_ns = pts_ns - self.start_ns
        self.frame_ns, self.errors_since = t_ns, 0
        return t_ns

    def of_error(self) -> int:
        t_ns = self._expected_ns()
        self.errors_since += 1
        return t_ns

    def _expected_ns(self) -> int:
        before_ns = -self.step_ns if self.frame_ns is None else self.frame_ns
        return before_ns + (1 + self.errors_since) * self.step_ns


class VideoSource:
    """A video file, read from its beginning at each iteration.

    `default_fps` times frames only where the file has neither stamps nor a rate.
    Raises InputMissingError or InputDataError when it cannot be opened as a video.
    """

    def __init__(self, path: Path, *, default_fps: float = 30.0, threads: int = 1) -> None:
        self.name = str(path)
        self._path = path
        self._default_fps = default_fps
        self._threads = threads
        with self._open() as container:
            stream = _video_stream(container, path)
            self.frame_count: int | None = int(stream.frames) or None
            self.width_px, self.height_px = int(stream.codec_context.width), int(stream.codec_context.height)
            self.rate_hz = float(stream.guessed_rate or stream.average_rate or default_fps)

    def _open(self) -> Any:
        if not self._path.exists():
            raise InputMissingError(f"{self.name}: no such file")
        try:
            # Only local files: a playlist must not make us open a network connection.
            return av.open(self.name, options={"protocol_whitelist": "file"})
        except (av.FFmpegError, OSError, ValueError) as error:
            raise InputDataError(f"{self.name}: cannot be read as a video ({_reason(error)})") from error

    def __iter__(self) -> Iterator[Frame | SourceError]:
        """Frames and, in their places, SourceErrors. Raises InputDataError at the end when no frame could be read."""
        with self._open() as container:
            stream = _video_stream(container, self._path)
            context = stream.codec_context
            context.thread_count = self._threads
            context.options = {"err_detect": "explode"}  # a smeared picture must not be measured
            clock = _Clock(Fraction(stream.time_base), round(1e9 / self.rate_hz))
            index = frames = 0
            for item in _decoded(container, stream, self.name):
                if isinstance(item, str):
                    yield SourceError(index=index, t_ns=clock.of_error(), message=item)
                else:
                    frames += 1
                    yield Frame(t_ns=clock.of_frame(item.pts), index=index, image=_to_array(item))
                index += 1
            if frames == 0:
                raise InputDataError(f"{self.name}: no frame of this video can be decoded")
            if self.frame_count is not None and index < self.frame_count:
                message = f"{self.name}: ends after {index} of {self.frame_count} frames"
                yield SourceError(index=index, t_ns=clock.of_error(), message=message)


def _video_stream(container: Any, path: Path) -> Any:
    if not container.streams.video:
        raise InputDataError(f"{path}: has no video in it")
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise InputDataError(f"{path}: its video codec is not known")
    return stream


def _decoded(container: Any, stream: Any, name: str) -> Iterator[Any | str]:
    """Decoded frames, and a line of text for each that is damaged.

    What follows a damaged frame is built on it, although the decoder does not say so: it counts as damaged up to the
    next key frame.
    """
    packets = container.demux(stream)
    errors_in_a_row = 0
    built_on_damage = False
    while errors_in_a_row < _MAX_ERRORS_IN_A_ROW:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except (av.FFmpegError, OSError) as error:
            yield f"{name}: the rest cannot be read ({_reason(error)})"
            return
        try:
            decoded = packet.decode()
        except (av.FFmpegError, OSError) as error:
            errors_in_a_row += 1
            built_on_damage = True
            yield f"{name}: damaged frame ({_reason(error)})"
            continue
        for frame in decoded:
            errors_in_a_row = 0
            built_on_damage = built_on_damage and not frame.key_frame
            if built_on_damage or frame.is_corrupt:
                yield f"{name}: damaged frame (it builds on a damaged one)"
            else:
                yield frame
    yield f"{name}: given up after {errors_in_a_row} damaged frames in a row"


def _to_array(frame: Any) -> NDArray[np.uint8]:
    """Upright uint8 pixels: grey (h, w) where the video is grey, else BGR (h, w, 3)."""
    kind = "gray" if frame.format.name in _GREY_FORMATS else "bgr24"
    image: NDArray[np.uint8] = frame.to_ndarray(format=kind)
    quarter_turns = round(getattr(frame, "rotation", 0) / 90) % 4  # phones; degrees counter-clockwise
    return np.ascontiguousarray(np.rot90(image, quarter_turns))


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)
