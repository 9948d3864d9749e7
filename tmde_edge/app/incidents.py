"""`tmde-edge incident`: which seconds, and where they go."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from tmde_edge.app.bundle import S, find_last_alert, find_time, kept_incident, unpack, write_bundle
from tmde_edge.app.drive_log import DriveLogReader
from tmde_edge.app.incident import incident_folders
from tmde_edge.app.ring import readable, segments, utc_name
from tmde_edge.app.status import ask, socket_path
from tmde_edge.errors import InputDataError, UsageError


@dataclass(frozen=True, slots=True)
class TakenOut:
    """A bundle that was made."""

    out: Path
    what: str
    counts: dict[str, int]


def take_out(
    folder: Path, *, out: Path | None, at: str | None, kept: str | None, before_s: float, after_s: float
) -> TakenOut:
    """Writes a bundle from a kept incident (`kept`), from a moment of the ring (`at`), else of the last alert there is.

    Raises InputMissingError, InputDataError, UsageError.
    """
    if not 0 <= before_s <= 600 or not 0 <= after_s <= 600:
        raise UsageError(f"--before {before_s:g} --after {after_s:g}: give seconds between 0 and 600")
    readable(folder)
    found = find_time(folder, _time(at)) if at is not None else find_last_alert(folder) if kept is None else None
    if found is None:
        path = kept_incident(folder, kept or None)
        out = out or Path(f"incident-{path.name}")
        return TakenOut(out, path.name, unpack(path, out))
    start = DriveLogReader(found.logs[0]).part
    wall_ns = found.t_ns - start.monotonic_ns + start.wall_ns
    out = out or Path(f"incident-{utc_name(wall_ns)}")
    counts = write_bundle(out, found.logs, found.t_ns - round(before_s * S), found.t_ns + round(after_s * S))
    return TakenOut(out, found.text, counts)


def list_lines(folder: Path) -> Iterator[str]:
    """The ring in a line, and a line a kept incident. Raises InputMissingError."""
    readable(folder)
    parts = segments(folder)
    size_mb = sum(p.size for p in parts) / 1e6
    drives = len({p.drive for p in parts})
    yield f"ring: {drives} drives, {len(parts)} files, {size_mb:.0f} MB" + (f", from {parts[0].path.name[7:23]}" if parts else "")
    for path in incident_folders(folder):
        try:
            info = json.loads((path / "incident.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            info = {}
        ttc = f"TTC {info['ttc_s']:.1f} s" if isinstance(info.get("ttc_s"), (int, float)) else ""
        said = "said" if info.get("transmitted") else "would have been said"
        yield f"{path.name}  {info.get('reason', '?'):12} {ttc:10} {said}  {info.get('verdict', 'not judged')}"


def ask_now(configured_socket: str, note: str) -> str:
    """Asks the running service to keep the last seconds. Raises InputMissingError, InputDataError."""
    answer = ask(socket_path(configured_socket), {"request": "incident", "note": note})
    folder = answer.get("folder")
    if not isinstance(folder, str):
        raise InputDataError("the service gave an answer that makes no sense; is it of another version?")
    return f"the last seconds and the next ones go into {folder}/incidents"


def _time(text: str) -> datetime:
    try:
        when = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        raise UsageError(f"--at {text}: not a time; write it as 2026-11-22T06:35:12Z") from None
    return when if when.tzinfo is not None else when.astimezone()
