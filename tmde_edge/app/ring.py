"""The ring of drive logs: numbered parts of numbered drives in one folder, the oldest removed by size and age.

A file is `000012-20261122T063012Z-0003.mcap`: drive 12, which began then, its part 3. Numbers, not times, give the order: a board
without a battery clock begins in the past. The disk is never filled: recording pauses while less than `min_free_mb` is free.
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from tmde_edge.app.drive_log import Begins, DriveLogWriter, Json, Part
from tmde_edge.config import RecordConfig
from tmde_edge.errors import InputDataError, InputMissingError
from tmde_edge.messages import Event, Output, RangeReference

_log = logging.getLogger(__name__)
_NAME = re.compile(r"(\d{6})-(\d{8}T\d{6}Z)-(\d{4,})\.mcap")
_MB = 1_000_000
_LOOK_S = 5.0  # between looks at the folder, and between tries of a disk that failed
_SEGMENTS_IN_RING = 8  # a part is at most this fraction of the ring, so that removing one is a small loss
_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Segment:
    """One file of the ring."""

    path: Path
    drive: int
    number: int

    @property
    def size(self) -> int:
        """Bytes; 0 where it is gone."""
        try:
            return self.path.stat().st_size
        except OSError:
            return 0


def readable(folder: Path) -> Path:
    """A folder of recordings that is there and ours to read. Raises InputMissingError."""
    try:
        os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        raise InputMissingError(f"{folder}: no such folder of recordings; name it, or set record.folder") from None
    except PermissionError:
        raise InputMissingError(
            f"{folder}: not yours to read; join the group (sudo usermod -aG tmde-edge $USER, then log in again) or use sudo"
        ) from None
    return folder


def segments(folder: Path) -> list[Segment]:
    """The files of a ring, oldest first; empty where there is no folder."""
    try:
        names = os.listdir(folder)
    except FileNotFoundError:
        return []
    found = [Segment(folder / name, int(m[1]), int(m[3])) for name in names if (m := _NAME.fullmatch(name)) is not None]
    return sorted(found, key=lambda s: (s.drive, s.number))


def parts_before(path: Path) -> list[Path]:
    """The parts of a drive from its beginning up to this file. Raises InputDataError where some are gone."""
    match = _NAME.fullmatch(path.name)
    if match is None:
        return [path]
    drive, last = int(match[1]), int(match[3])
    have = {s.number: s.path for s in segments(path.parent) if s.drive == drive}
    missing = next((n for n in range(last + 1) if n not in have), None)
    if missing is not None:
        raise InputDataError(
            f"{path}: part {missing} of drive {drive} is not beside it any more; a replay needs a drive from its beginning"
        )
    return [have[n] for n in range(last + 1)]


def utc_name(wall_ns: int) -> str:
    """20261122T063012Z"""
    return datetime.fromtimestamp(wall_ns * 1e-9, timezone.utc).strftime("%Y%m%dT%H%M%SZ")


def free_mb(folder: Path) -> float:
    """Free space of the disk that holds a folder. Raises OSError."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize / _MB


class Ring:
    """Writes steps into the ring; after an error of the disk it begins anew as soon as it can. Used by one thread."""

    def __init__(
        self,
        settings: RecordConfig,
        config: Json,
        *,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._s, self._config = settings, config
        self._folder = Path(settings.folder)
        self._monotonic_ns, self._wall_ns = monotonic_ns, wall_ns
        self._writer: DriveLogWriter | None = None
        self._drive: int | None = None
        self._name = ""
        self._segment = 0
        self._begun_ns = self._looked_ns = 0
        self._next_try_ns = 0
        self._gap = False
        self.problem: str | None = None  # in words; None: it records

    @property
    def path(self) -> Path | None:
        """The file being written."""
        return self._folder / self._file_name() if self._writer is not None else None

    def write(self, event: Event, outputs: tuple[Output, ...]) -> None:
        """Logs one step; never raises."""
        self._guarded(lambda writer: writer.write(event, outputs), may_turn=True)

    def picture(self, t_ns: int, jpeg: bytes) -> None:
        """Logs a frame."""
        self._guarded(lambda writer: writer.picture(t_ns, jpeg))

    def reference(self, reference: RangeReference) -> None:
        """Logs what another instrument measured."""
        self._guarded(lambda writer: writer.reference(reference))

    def lost(self) -> None:
        """Steps were lost before they came here: what follows cannot be replayed with what was before."""
        if self._writer is not None:
            self._close()
            self._segment += 1
        self._gap = True

    def flush(self) -> None:
        """Puts everything on the disk."""
        self._guarded(lambda writer: writer.flush())

    def close(self) -> None:
        """Finishes the file."""
        if self._writer is not None:
            self._close()

    # -- inside -------------------------------------------------------------------------------------------------------

    def _guarded(self, act: Callable[[DriveLogWriter], None], *, may_turn: bool = False) -> None:
        now_ns = self._monotonic_ns()
        try:
            if now_ns - self._looked_ns > _LOOK_S * 1e9 and self._writer is not None:
                self._look(now_ns)
            if may_turn and self._writer is not None and self._full(now_ns):
                self._close()
                self._segment += 1
            if self._writer is None and not (may_turn and self._open(now_ns)):
                self._gap = self._gap or self._drive is not None
                return
            if self._writer is not None:
                act(self._writer)
        except OSError as error:
            self._fail(error.strerror or str(error), now_ns)

    def _full(self, now_ns: int) -> bool:
        size = self._writer.bytes_written if self._writer is not None else 0
        return now_ns - self._begun_ns > self._s.segment_s * 1e9 or size > self._s.max_mb * _MB / _SEGMENTS_IN_RING

    def _open(self, now_ns: int) -> bool:
        if now_ns < self._next_try_ns:
            return False
        self._folder.mkdir(parents=True, exist_ok=True)
        wall_ns = self._wall_ns()
        if self._drive is None:
            self._drive = max((s.drive for s in segments(self._folder)), default=0) + 1
            self._name = utc_name(wall_ns)
        self._look(now_ns)
        begins: Begins = "gap" if self._gap else "continued" if self._segment else "start"
        part = Part(drive=self._drive, segment=self._segment, begins=begins, wall_ns=wall_ns, monotonic_ns=now_ns)
        self._writer = DriveLogWriter(self._folder / self._file_name(), self._config, part=part)
        self._begun_ns, self._gap = now_ns, False
        if self.problem is not None:
            _log.warning("recording works again: %s", self._folder / self._file_name())
        self.problem = None
        return True

    def _file_name(self) -> str:
        return f"{self._drive or 0:06d}-{self._name}-{self._segment:04d}.mcap"

    def _look(self, now_ns: int) -> None:
        """Keeps the ring within its limits. Raises OSError where the disk is nearly full."""
        self._looked_ns = now_ns
        prune(self._folder, self._s.max_mb, self._s.max_age_days, self._wall_ns() * 1e-9, keep=self.path)
        free = free_mb(self._folder)
        if free < self._s.min_free_mb:
            raise OSError(f"only {free:.0f} MB free on the disk of {self._folder}, record.min_free_mb = {self._s.min_free_mb}")

    def _close(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            try:
                writer.close()
            except OSError as error:
                writer.abandon()
                self._fail(error.strerror or str(error), self._monotonic_ns())

    def _fail(self, reason: str, now_ns: int) -> None:
        if self._writer is not None:
            self._writer.abandon()
            self._writer = None
            self._segment += 1
        self._gap = True
        self._next_try_ns = now_ns + round(_LOOK_S * 1e9)
        if self.problem is None:
            _log.error("recording pauses (%s); everything else goes on", reason)
        self.problem = reason


def prune(folder: Path, max_mb: float, max_age_days: float, wall_s: float, keep: Path | None = None) -> list[Path]:
    """Removes the oldest files of a ring until it holds its limits; never the file being written. Returns what went."""
    found = [s for s in segments(folder) if s.path != keep]
    total = sum(s.size for s in found) + (keep.stat().st_size if keep is not None and keep.exists() else 0)
    gone = []
    for segment in found:
        try:
            stat = segment.path.stat()
            if total > max_mb * _MB or wall_s - stat.st_mtime > max_age_days * _DAY_S:
                segment.path.unlink()
                total -= stat.st_size
                gone.append(segment.path)
        except FileNotFoundError:  # someone else tidied up
            continue
    return gone
