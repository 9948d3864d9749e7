"""CAN log files in and out: candump (own reader: fast, names the bad line), and .asc, .blf, .trc by python-can; all also .gz."""

from __future__ import annotations

import gzip
import io
import re
import struct
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, cast

from tmde_edge.errors import DeviceError, InputDataError, InputMissingError
from tmde_edge.messages import CanFrame

# (1436509052.249713) vcan0 044#2A366C2BBA    id 3 or 8 hex digits; ##<flags> CAN FD; #R remote; trailing R or T: direction
_LINE = re.compile(
    r"\s*\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(?:#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{2})*|R[0-9]?)(?:\s+[RT])?\s*"
)
_ERROR_FLAG = 0x20000000
_KINDS = {".log": "candump", ".asc": "asc", ".blf": "blf", ".trc": "trc"}
_BROKEN = (  # what python-can's readers meet in a damaged file
    ValueError, LookupError, TypeError, AssertionError, ArithmeticError, AttributeError, NotImplementedError,
    struct.error, zlib.error,
)  # fmt: skip
_FRACTION = [10 ** (9 - digits) for digits in range(10)]


def iter_can_log(path: Path) -> Iterator[CanFrame]:
    """Data frames of a log in file order; t_ns counts from the first line. Remote and error frames are left out.

    Raises InputMissingError (no such file), InputDataError (not readable: which line, what stands there). A last line that
    was cut off (power lost while logging) ends the log.
    """
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise InputMissingError(f"CAN log {path}: {what}; give a candump .log, .asc, .blf or .trc (also .gz)")
    kind, packed = _kind(path)
    any_frame = False
    try:
        with _open(path, packed) as file:
            frames = _candump(path, file) if kind == "candump" else _python_can(path, file, kind)
            for frame in frames:
                any_frame = True
                yield frame
    except (EOFError, zlib.error, gzip.BadGzipFile) as e:
        raise InputDataError(f"CAN log {path}: damaged gzip file ({e}); unpack what is left with `gzip -dc`") from None
    except OSError as e:
        raise InputDataError(f"CAN log {path}: cannot be read ({e.strerror or e})") from None
    if not any_frame:
        raise InputDataError(f"CAN log {path}: no CAN frame in it (read as {kind}); give a candump .log, .asc, .blf or .trc")


class CandumpWriter:
    """Writes `candump -L` lines: `(seconds.micros) channel ID#DATA`; path "-" is standard output."""

    def __init__(self, path: str | Path, channel: str = "can0") -> None:
        """Raises DeviceError where the file cannot be written, as do write and close."""
        self._channel = channel
        self._path, self._own = path, str(path) != "-"
        if not self._own:
            self._file: IO[str] = sys.stdout
            return
        try:
            self._file = open(path, "w", encoding="ascii")  # noqa: SIM115 (closed by close)
        except OSError as e:
            raise self._refused(e) from None

    def write(self, frame: CanFrame) -> None:
        """One line; times before zero (a negative offset) are written as zero, which candump's format needs."""
        try:
            self._file.write(candump_line(frame, self._channel))
        except OSError as e:
            raise self._refused(e) from None

    def close(self) -> None:
        """Flushes; closes a file of its own."""
        try:
            if self._own:
                self._file.close()
            else:
                self._file.flush()
        except OSError as e:
            raise self._refused(e) from None

    def _refused(self, error: OSError) -> Exception:
        if not self._own:  # a pipe whose reader has seen enough
            return error
        return DeviceError(f"--can-out {self._path}: cannot be written ({error.strerror}); give a file that can be written")

    def __enter__(self) -> CandumpWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def candump_line(frame: CanFrame, channel: str = "can0") -> str:
    """One line with its line feed, rounded to whole microseconds."""
    seconds, micros = divmod((max(frame.t_ns, 0) + 500) // 1000, 1_000_000)
    digits = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    fd = "#1" if len(frame.data) > 8 else ""  # CAN FD, bit rate switched
    return f"({seconds:010d}.{micros:06d}) {frame.channel or channel} {digits}#{fd}{frame.data.hex().upper()}\n"


def _open(path: Path, packed: bool) -> IO[bytes]:
    return cast("IO[bytes]", gzip.open(path)) if packed else path.open("rb")


def _kind(path: Path) -> tuple[str, bool]:
    """Format and whether it is packed: by suffix, else by the first bytes."""
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    suffixes = [s.lower() for s in path.suffixes]
    suffix = suffixes[-2] if suffixes[-1:] == [".gz"] and len(suffixes) > 1 else suffixes[-1] if suffixes else ""
    if suffix in _KINDS:
        return _KINDS[suffix], packed
    try:
        with _open(path, packed) as file:
            head = file.read(64)
    except (OSError, EOFError, zlib.error):
        head = b""
    if head.startswith(b"LOGG"):
        return "blf", packed
    if head.startswith(b";"):
        return "trc", packed
    return ("asc" if head[:5].lower() == b"date " else "candump"), packed


def _candump(path: Path, file: IO[bytes]) -> Iterator[CanFrame]:
    first_ns: int | None = None
    match = _LINE.fullmatch
    for number, raw in enumerate(file, start=1):
        line = raw.decode("latin-1")
        found = match(line)
        if found is None:
            if not line.strip():
                continue
            if not line.endswith("\n") and first_ns is not None:
                return  # cut off while it was written
            shown = line.strip()[:60]
            raise InputDataError(
                f"CAN log {path}: line {number}: {shown!r} is not a candump line such as "
                "'(0.000100) can0 0B4#0000000000000000'; record with `candump -L`"
            )
        seconds, fraction, channel, digits, data = found.groups()
        t_ns = int(seconds) * 1_000_000_000 + int(fraction) * _FRACTION[len(fraction)]
        if first_ns is None:
            first_ns = t_ns
        can_id = int(digits, 16)
        if data[:1] == "R" or (len(digits) == 8 and can_id & _ERROR_FLAG):
            continue
        extended = len(digits) == 8
        if (extended and can_id > 0x1FFFFFFF) or (not extended and can_id > 0x7FF) or len(data) > 128:
            raise InputDataError(f"CAN log {path}: line {number}: {line.strip()[:60]!r}: id or length is not CAN's")
        yield CanFrame(t_ns=t_ns - first_ns, can_id=can_id, data=bytes.fromhex(data), extended=extended, channel=channel)


def _python_can(path: Path, file: IO[bytes], kind: str) -> Iterator[CanFrame]:
    import can  # slow to import: only for these formats
    from can.io.blf import BLFParseError

    text = file if kind == "blf" else io.TextIOWrapper(file, encoding="utf-8", errors="replace")
    reader: Any = None
    first_s: float | None = None
    count = 0
    try:
        reader = {"blf": can.BLFReader, "asc": can.ASCReader, "trc": can.TRCReader}[kind](text)
        for message in reader:
            if first_s is None:
                first_s = message.timestamp
            count += 1
            if message.is_error_frame or message.is_remote_frame:
                continue
            yield CanFrame(
                t_ns=round((message.timestamp - first_s) * 1e9),
                can_id=message.arbitration_id,
                data=bytes(message.data),
                extended=message.is_extended_id,
                channel="" if message.channel is None else str(message.channel),
            )
    except (*_BROKEN, can.CanError, BLFParseError) as e:
        raise InputDataError(
            f"CAN log {path}: not readable as {kind} after {count} frames ({type(e).__name__}: {' '.join(str(e).split())[:80]}); "
            f"check that it is a .{kind} file"
        ) from None
