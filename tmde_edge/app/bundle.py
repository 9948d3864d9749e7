"""A plain folder of some seconds of a drive: frames, CAN, decisions, configuration and calibration, truth where there is one.

    frames/000000.jpg ...   frames.csv (file, seconds)   can.log (candump)   decisions.jsonl   config.toml   truth.csv

`tmde-edge --dry-run FOLDER/frames --can-log FOLDER/can.log -c FOLDER/config.toml` runs on it, each frame at the
time that frames.csv says.
"""

from __future__ import annotations

import csv
import json
import logging
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from tmde_edge.adapters.can_ports.log_files import candump_line
from tmde_edge.app.drive_log import DriveLogReader, DriveLogWriter, LogEntry, Part
from tmde_edge.app.incident import incident_folders
from tmde_edge.app.records import frame_record
from tmde_edge.app.ring import Segment, segments
from tmde_edge.app.toml_out import write_config
from tmde_edge.errors import InputDataError, InputMissingError, UsageError
from tmde_edge.messages import CanFrame, FrameResult, RangeReference, Sighting

_log = logging.getLogger(__name__)
S = 1_000_000_000
_REFERENCE_NEAR_NS = 100_000_000  # a frame takes the truth of a line this near in time


@dataclass(frozen=True, slots=True)
class Found:
    """A moment of a recorded drive."""

    logs: list[Path]  # the parts that may hold its seconds, in order
    t_ns: int
    text: str


def find_last_alert(folder: Path) -> Found | None:
    """The beginning of the last caution or warning in a ring; None where there is none."""
    parts = _readable(folder)
    for segment, log in reversed(parts):
        level, found = "none", None
        for entry in log.entries():
            for output in entry.outputs:
                if isinstance(output, FrameResult):
                    if output.alert.level != "none" and level == "none":
                        found = (output.t_ns, output.alert)
                    level = output.alert.level
        if found is not None:
            return Found(_drive(parts, segment.drive), found[0], f"{found[1].level} ({found[1].reason})")
    return None


def find_time(folder: Path, when: datetime) -> Found:
    """A moment by the clock on the wall. Raises InputMissingError where nothing was recorded then."""
    wall_ns = round(when.astimezone(timezone.utc).timestamp() * 1e9)
    best: tuple[int, Found] | None = None
    parts = _readable(folder)
    for segment, log in parts:
        part = log.part
        if part.wall_ns <= wall_ns and (best is None or part.wall_ns > best[0]):
            t_ns = wall_ns - part.wall_ns + part.monotonic_ns
            best = part.wall_ns, Found(_drive(parts, segment.drive), t_ns, when.isoformat())
    if best is None:
        raise InputMissingError(f"{folder}: nothing was recorded at {when.isoformat()}; see `tmde-edge incident --list`")
    return best[1]


def _readable(folder: Path) -> list[tuple[Segment, DriveLogReader]]:
    """The parts of a ring, oldest first; one that a power cut left empty, or that was removed just now, is said and left out."""
    parts = []
    for segment in segments(folder):
        try:
            parts.append((segment, DriveLogReader(segment.path)))
        except (InputDataError, InputMissingError) as error:
            _log.warning("left out: %s", error)
    return parts


def _drive(parts: list[tuple[Segment, DriveLogReader]], number: int) -> list[Path]:
    return [segment.path for segment, _ in parts if segment.drive == number]


def write_bundle(out: Path, logs: list[Path], from_ns: int, to_ns: int) -> dict[str, Any]:
    """The steps of some drive logs between two times as plain files; returns counts. Raises UsageError, InputDataError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise UsageError(f"{out}: is not empty; name a new folder with --out")
        (out / "frames").mkdir()
    except OSError as error:
        raise UsageError(f"{out}: cannot be written ({error.strerror or error}); name another folder with --out") from None
    readers = [DriveLogReader(log) for log in logs]
    write_config(out, readers[0].config)
    counts = {"frames": 0, "decisions": 0, "can_frames": 0, "references": 0}
    times: list[int] = []
    with (out / "frames.csv").open("w", newline="") as f:
        table = csv.writer(f)
        table.writerow(["file", "t_s"])
        for t_ns, jpeg in (p for r in readers for p in r.images() if from_ns <= p[0] <= to_ns):
            name = f"{counts['frames']:06d}.jpg"
            (out / "frames" / name).write_bytes(jpeg)
            table.writerow([name, f"{(t_ns - from_ns) * 1e-9:.6f}"])
            times.append(t_ns)
            counts["frames"] += 1
    origin_ns = times[0] if times else from_ns
    head = readers[0].part
    part = Part(begins="cut", wall_ns=head.wall_ns, monotonic_ns=head.monotonic_ns)
    with (
        DriveLogWriter(out / "drive.mcap", readers[0].config, part=part) as log,
        (out / "can.log").open("w", encoding="ascii") as can,
        (out / "decisions.jsonl").open("w", encoding="utf-8") as decisions,
    ):
        can.write(candump_line(CanFrame(t_ns=0, can_id=0x7FF, data=b""), "mark"))  # time zero is the first frame's
        for entry in _between(readers, from_ns, to_ns):
            log.write(entry.event, entry.outputs)
            if isinstance(entry.event, CanFrame):
                if entry.event.t_ns >= origin_ns:
                    can.write(candump_line(_shifted(entry.event, origin_ns)))
                counts["can_frames"] += 1
            for output in entry.outputs:
                if isinstance(output, FrameResult) and isinstance(entry.event, Sighting):
                    record = frame_record(output, entry.event, entry.event.timing_ms)
                    record["t"] = round((output.t_ns - origin_ns) * 1e-9, 6)
                    decisions.write(json.dumps(record, allow_nan=False) + "\n")
                    counts["decisions"] += 1
        references = [r for reader in readers for r in reader.references() if from_ns <= r.t_ns <= to_ns]
        for reference in references:
            log.reference(reference)
    counts["references"] = len(references)
    if references:
        _write_truth(out / "truth.csv", times, references)
    if not counts["decisions"]:
        shutil.rmtree(out)
        raise InputDataError(f"{logs[-1]}: nothing was recorded between these times")
    return counts


def kept_incident(folder: Path, name: str | None) -> Path:
    """A kept incident by its name or number; None: the newest. Raises InputMissingError."""
    found = incident_folders(folder)
    for path in reversed(found):
        if name is None or path.name == name or path.name.startswith(f"{name:0>6}-"):
            return path
    raise InputMissingError(f"{folder}: no incident {name or ''} is kept there; `tmde-edge incident --list` names them")


def unpack(kept: Path, out: Path) -> dict[str, Any]:
    """A kept incident as plain files. Raises InputDataError, UsageError."""
    counts = write_bundle(out, [kept / "drive.mcap"], 0, 2**63 - 1)
    for name in ("incident.json", "before.jpg", "alert.jpg", "after.jpg"):
        if (kept / name).exists():
            shutil.copyfile(kept / name, out / name)
    return counts


def _between(readers: list[DriveLogReader], from_ns: int, to_ns: int) -> Iterator[LogEntry]:
    for reader in readers:
        for entry in reader.entries():
            if from_ns <= entry.event.t_ns <= to_ns:
                yield entry


def _shifted(frame: CanFrame, origin_ns: int) -> CanFrame:
    return replace(frame, t_ns=frame.t_ns - origin_ns, channel=frame.channel or "can0")


def _write_truth(path: Path, times: list[int], references: list[RangeReference]) -> None:
    """truth.csv for --truth: each frame with the nearest line of the instrument."""
    ranged = [(r.t_ns, r.distance_m) for r in references if r.distance_m is not None]
    with path.open("w", newline="") as f:
        table = csv.writer(f)
        table.writerow(["frame", "distance_m"])
        for i, t_ns in enumerate(times):
            nearest = min(ranged, key=lambda r: abs(r[0] - t_ns), default=None)
            if nearest is not None and abs(nearest[0] - t_ns) <= _REFERENCE_NEAR_NS:
                table.writerow([i, f"{nearest[1]:.4f}"])
