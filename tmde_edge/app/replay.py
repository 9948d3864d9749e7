"""Replay of a drive log: the estimation decides again from the logged inputs, and every output field is compared."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Protocol

from tmde_edge.app.drive_log import DriveLogReader, LogEntry
from tmde_edge.app.ring import parts_before
from tmde_edge.errors import InputDataError
from tmde_edge.messages import Event, Output

TOLERANCE = 1e-9  # absolute below 1, relative above; same platform


class Decider(Protocol):
    """What replay needs of the estimation."""

    def step(self, event: Event) -> tuple[Output, ...]:
        """Takes one event and returns what follows from it."""
        ...


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where the replay differs from the log."""

    event_number: int  # from 0
    t_ns: int
    field: str  # e.g. FrameResult.lead.distance_m
    expected: Any
    got: Any

    def __str__(self) -> str:
        where = f"event {self.event_number} at {self.t_ns * 1e-9:.6f} s: {self.field}"
        return f"{where}: logged {self.expected!r}, replayed {self.got!r}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a replay found; `torn` says why the end of the log could not be read, where it could not."""

    events: int
    outputs: int
    difference: Difference | None
    torn: str | None


def replay(path: Path, make_estimation: Callable[[dict[str, Any]], Decider], tolerance: float = TOLERANCE) -> Outcome:
    """Runs a drive log again up to the first difference; of a part of a ring, the drive from its beginning.

    Raises InputMissingError or InputDataError.
    """
    logs = [DriveLogReader(part) for part in parts_before(path)] if path.is_file() else [DriveLogReader(path)]
    estimation = make_estimation(logs[0].config)
    events = outputs = 0
    for i, log in enumerate(logs):
        if log.part.begins in ("gap", "cut") or (i > 0 and logs[i - 1].torn is not None):
            where = "was cut out of a drive" if log.part.begins == "cut" else "begins where steps are missing"
            raise InputDataError(f"{path}: {where}; a replay needs a drive from its beginning; use --dry-run on its frames")
        for entry in log.entries():
            got = estimation.step(entry.event)
            difference = _compare(entry, got, events, tolerance)
            if difference is not None:
                return Outcome(events, outputs, difference, log.torn)
            events += 1
            outputs += len(got)
    torn = logs[-1].torn
    if events == 0:
        raise InputDataError(f"{path}: no event in this drive log{f' ({torn})' if torn else ''}")
    return Outcome(events, outputs, None, torn)


def _compare(entry: LogEntry, got: tuple[Output, ...], number: int, tolerance: float) -> Difference | None:
    expected = entry.outputs
    if not entry.complete:  # its last outputs may be lost
        got = got[: len(expected)]
    if len(expected) != len(got):
        names = [[type(o).__name__ for o in outputs] for outputs in (expected, got)]
        return Difference(number, entry.event.t_ns, "outputs", *names)
    for want, have in zip(expected, got, strict=True):
        found = first_difference(want, have, type(want).__name__, tolerance)
        if found is not None:
            return Difference(number, entry.event.t_ns, *found)
    return None


def first_difference(want: Any, have: Any, path: str, tolerance: float = TOLERANCE) -> tuple[str, Any, Any] | None:
    """The first differing field of two messages as (path, expected, got); floats within the tolerance are equal."""
    if isinstance(want, (int, float)) and isinstance(have, (int, float)) and not isinstance(want, bool):
        same = want == have or math.isclose(want, have, rel_tol=tolerance, abs_tol=tolerance)
        if isinstance(want, int) and isinstance(have, int):
            same = want == have
        return None if same else (path, want, have)
    if type(want) is not type(have):
        return path, want, have
    if is_dataclass(want):
        for field in fields(want):
            found = first_difference(getattr(want, field.name), getattr(have, field.name), f"{path}.{field.name}", tolerance)
            if found is not None:
                return found
        return None
    if isinstance(want, dict):
        if want.keys() != have.keys():
            return path, sorted(want), sorted(have)
        return _first(first_difference(want[k], have[k], f"{path}[{k!r}]", tolerance) for k in want)
    if isinstance(want, (tuple, list)):
        if len(want) != len(have):
            return f"{path} (length)", len(want), len(have)
        pairs = enumerate(zip(want, have, strict=True))
        return _first((first_difference(a, b, f"{path}[{i}]", tolerance) for i, (a, b) in pairs))
    return None if want == have else (path, want, have)


def _first(found: Any) -> tuple[str, Any, Any] | None:
    return next((f for f in found if f is not None), None)
