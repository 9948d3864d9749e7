"""Recorded sources for the desk: a video file, a folder of images in name order, a printf pattern or a glob."""

from __future__ import annotations

import csv
import glob
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.adapters.cameras.video_file import SourceError, VideoSource
from tmde_edge.errors import InputDataError, InputMissingError, UsageError
from tmde_edge.messages import Frame

_SUFFIXES = "avif bmp dib jp2 jpe jpeg jpg pbm pgm png pnm ppm ras sr tif tiff webp"
IMAGE_SUFFIXES = frozenset(f".{suffix}" for suffix in _SUFFIXES.split())
_TIMES = "frames.csv"
SourceItem: TypeAlias = "Frame | SourceError"


class FrameSource(Protocol):
    """Frames of one recording in order; iterating again starts again. The first frame has t_ns = 0."""

    @property
    def name(self) -> str:
        """What the user named."""
        ...

    @property
    def frame_count(self) -> int | None:
        """How many frames there should be; None where the container does not say."""
        ...

    def __iter__(self) -> Iterator[SourceItem]:
        """Raises InputDataError at the end when not one frame could be read."""
        ...


@dataclass(frozen=True, slots=True)
class ImageSequence:
    """Image files at the times of their frames.csv, else at a fixed rate; an unreadable one becomes a SourceError."""

    name: str
    paths: tuple[Path, ...]
    fps: float
    times_ns: tuple[int, ...] | None = None  # of each path, increasing

    @property
    def frame_count(self) -> int | None:
        return len(self.paths)

    def __iter__(self) -> Iterator[SourceItem]:
        readable = False
        for index, path in enumerate(self.paths):
            t_ns = self.times_ns[index] if self.times_ns is not None else round(index * 1e9 / self.fps)
            image = read_image(path)
            if isinstance(image, str):
                yield SourceError(index=index, t_ns=t_ns, message=image)
            else:
                readable = True
                yield Frame(t_ns=t_ns, index=index, image=image)
        if not readable:
            raise InputDataError(f"{self.name}: none of its {len(self.paths)} images can be read")


def read_image(path: Path) -> NDArray[np.uint8] | str:
    """One image file as uint8 BGR or grey, turned upright as its EXIF says; a string says why it cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        return f"{path}: {error.strerror or error}"
    if not data:
        return f"{path}: empty file"
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR)
    except cv2.error as error:  # absurd sizes and the like
        return f"{path}: cannot be decoded ({' '.join(str(error.err or error).split())})"
    if image is None:
        return f"{path}: not an image that can be decoded"
    return np.ascontiguousarray(image, dtype=np.uint8)


def open_source(spec: str, fps: float = 30.0, *, threads: int = 1) -> FrameSource:
    """The recording that `spec` names: an existing file or folder wins, then a printf pattern, then a glob.

    `fps` times images without a frames.csv (columns file, t_s; among the images, or beside their folder where that is named
    frames), and videos that carry neither time stamps nor a rate. `threads` bounds the video decoder.
    Raises InputMissingError (nothing there, no image in it), InputDataError (no readable video, no such times), UsageError (fps).
    """
    if not (math.isfinite(fps) and 0.0 < fps <= 1e6):
        raise UsageError(f"--fps {fps:g}: give a rate in frames per second, greater than 0")
    path = Path(spec).expanduser()
    if path.is_dir():
        return _sequence(spec, sorted(path.iterdir(), key=lambda p: p.name), fps, f"no images in {spec}")
    if path.exists():
        if path.suffix.lower() in IMAGE_SUFFIXES:
            return ImageSequence(spec, (path,), fps)
        return VideoSource(path, default_fps=fps, threads=threads)
    if re.search(r"%0?\d*d", path.name):
        return _sequence(spec, _printf_files(path), fps, f"no image matches {spec}")
    if any(character in spec for character in "*?["):
        found = sorted(glob.glob(str(path), recursive=True))
        return _sequence(spec, [Path(name) for name in found], fps, f"no image matches {spec}")
    raise InputMissingError(f"{spec}: no such file or folder")


def image_files(folder: Path) -> list[Path]:
    """The images of a folder in name order; hidden files and files that are no images are left out."""
    return [p for p in sorted(folder.iterdir(), key=lambda p: p.name) if _is_image_name(p)]


def _sequence(spec: str, candidates: list[Path], fps: float, missing: str) -> ImageSequence:
    paths = tuple(p for p in candidates if _is_image_name(p))
    if not paths:
        raise InputMissingError(f"{missing} (known kinds: {' '.join(sorted(IMAGE_SUFFIXES))})")
    return ImageSequence(spec, paths, fps, _times_ns(paths))


def _times_ns(paths: tuple[Path, ...]) -> tuple[int, ...] | None:
    """When each image was taken, by the frames.csv of its folder (`tmde-edge incident` writes one); None where there is none.

    Time zero is the first line's, so that a CAN log beside it fits even where the first images are gone. Raises InputDataError.
    """
    folder = paths[0].parent
    places = [folder / _TIMES, *([folder.parent / _TIMES] if folder.name == "frames" else [])]
    table = next((place for place in places if place.is_file()), None)
    if table is None:
        return None
    times_s: dict[str, float] = {}
    try:
        with table.open(newline="", encoding="utf-8-sig") as f:
            rows = csv.DictReader(f)
            if not {"file", "t_s"} <= set(rows.fieldnames or ()):
                return None  # someone else's
            for row in rows:
                times_s[row["file"]] = t_s = float(row["t_s"])
                if not math.isfinite(t_s):
                    raise ValueError(f"t_s {t_s} is no time")
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise InputDataError(f"{table}: cannot be read as columns file, t_s ({error}); correct or remove it") from None
    missing = next((path.name for path in paths if path.name not in times_s), None)
    if missing is not None:
        raise InputDataError(f"{table}: says no time of {missing}; add its line, or remove the table to use --fps")
    zero_s = next(iter(times_s.values()))
    times_ns = tuple(round((times_s[path.name] - zero_s) * 1e9) for path in paths)
    for path, before_ns, t_ns in zip(paths[1:], times_ns, times_ns[1:], strict=False):
        if t_ns <= before_ns:
            raise InputDataError(f"{table}: {path.name} is not later than the image before it; correct or remove the table")
    return times_ns


def _is_image_name(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _printf_files(pattern: Path) -> list[Path]:
    """Files that a pattern such as img_%04d.png names, by their number."""
    head, width, tail = re.split(r"%0?(\d*)d", pattern.name, maxsplit=1)
    digits = rf"\d{{{int(width)},}}" if width else r"\d+"
    shape = re.compile(re.escape(head.replace("%%", "%")) + f"({digits})" + re.escape(tail.replace("%%", "%")))
    if not pattern.parent.is_dir():
        return []
    numbered = [(int(m.group(1)), p) for p in pattern.parent.iterdir() if (m := shape.fullmatch(p.name))]
    return [p for _, p in sorted(numbered)]
