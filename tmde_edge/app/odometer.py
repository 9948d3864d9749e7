"""How far and how long it watched, what it said, what the driver did then: `odometer.jsonl`, the basis of every rate.

A line a minute holds sums (`Watched`), a line an incident its verdict: that stays when the incident's folder had to make room.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tmde_edge.app.ring import utc_name
from tmde_edge.messages import FrameResult

_log = logging.getLogger(__name__)
NAME = "odometer.jsonl"
_PERIOD_NS = 60_000_000_000
_LONGEST_STEP_S = 1.0  # a longer silence is not time that was watched
_MOVING_MPS = 1.0
_BLIND = frozenset({"blind", "camera_lost"})


@dataclass(slots=True)
class Watched:
    """Sums over some time."""

    watched_s: float = 0.0
    moving_s: float = 0.0
    speed_known_s: float = 0.0
    distance_m: float = 0.0
    blind_s: float = 0.0
    lead_s: float = 0.0
    alerts: dict[str, int] = field(default_factory=dict)  # "warning ttc": how many began

    def add(self, other: Watched) -> None:
        """Adds another sum."""
        for name in ("watched_s", "moving_s", "speed_known_s", "distance_m", "blind_s", "lead_s"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for key, count in other.alerts.items():
            self.alerts[key] = self.alerts.get(key, 0) + count

    def began(self, level: str) -> int:
        """How many alerts of a level began."""
        return sum(n for key, n in self.alerts.items() if key.split()[0] == level)


class Odometer:
    """Sums results and appends a line a minute; used by one thread, never raises OSError."""

    def __init__(
        self,
        folder: Path,
        *,
        transmits: bool,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._folder, self._transmits = folder, transmits
        self._monotonic_ns, self._wall_ns = monotonic_ns, wall_ns
        self._sum = Watched()
        self._last: FrameResult | None = None
        self._tick_ns: int | None = None
        self._written_ns = monotonic_ns()
        self.problem: str | None = None

    def take(self, result: FrameResult) -> None:
        """Takes one result."""
        last, self._last = self._last, result
        began = result.alert.level != "none" and (last is None or _rank(result.alert.level) > _rank(last.alert.level))
        if began:
            key = f"{result.alert.level} {result.alert.reason}".strip()
            self._sum.alerts[key] = self._sum.alerts.get(key, 0) + 1
        if last is not None:
            dt_s = (result.t_ns - last.t_ns) * 1e-9
            if 0 < dt_s <= _LONGEST_STEP_S:
                self._sum.watched_s += dt_s
                self._sum.blind_s += dt_s if _BLIND & set(result.faults) else 0.0
                self._sum.lead_s += dt_s if result.lead is not None else 0.0
                if result.ego is not None:
                    speed_mps = abs(result.ego.speed_mps)
                    self._sum.speed_known_s += dt_s
                    self._sum.distance_m += speed_mps * dt_s
                    self._sum.moving_s += dt_s if speed_mps > _MOVING_MPS else 0.0
        if began or self._monotonic_ns() - self._written_ns > _PERIOD_NS:
            self._write()

    def wait(self, t_ns: int) -> None:
        """Takes a Tick's time: before the first picture nothing else tells that time passes, unwatched."""
        last_ns, self._tick_ns = self._tick_ns, t_ns
        if self._last is not None or last_ns is None:
            return
        dt_s = (t_ns - last_ns) * 1e-9
        if 0 < dt_s <= _LONGEST_STEP_S:
            self._sum.watched_s += dt_s
            self._sum.blind_s += dt_s
        if self._monotonic_ns() - self._written_ns > _PERIOD_NS:
            self._write()

    def close(self) -> None:
        """Writes what is left."""
        self._write()

    def _write(self) -> None:
        self._written_ns = self._monotonic_ns()
        s = self._sum
        if s.watched_s == 0.0 and not s.alerts:
            return
        line = {
            "time": utc_name(self._wall_ns()), "transmits": self._transmits, "watched_s": round(s.watched_s, 3),
            "moving_s": round(s.moving_s, 3), "speed_known_s": round(s.speed_known_s, 3), "distance_m": round(s.distance_m, 1),
            "blind_s": round(s.blind_s, 3), "lead_s": round(s.lead_s, 3), "alerts": s.alerts,
        }  # fmt: skip
        try:
            _append(self._folder, line)
        except OSError as error:
            if self.problem is None:
                _log.error("the odometer cannot be written (%s)", error)
            self.problem = f"odometer: {error.strerror or error}"
            return  # the sums go into the next line
        self.problem = None
        self._sum = Watched()


def write_verdict(folder: Path, incident: str, verdict: str, warnings: int, wall_ns: int) -> None:
    """Appends what was judged of an incident, and of how many warnings. Raises OSError."""
    _append(folder, {"time": utc_name(wall_ns), "incident": incident, "verdict": verdict, "warnings": warnings})


def read_verdicts(folder: Path) -> dict[str, tuple[str, int]]:
    """Verdict and number of warnings of every incident that was judged, kept or not, by its name."""
    found = {}
    for values in _lines(folder):
        try:
            found[str(values["incident"])] = str(values["verdict"]), int(values["warnings"])
        except (ValueError, KeyError, TypeError):
            continue
    return found


def read_odometer(folder: Path) -> Iterator[tuple[dict[str, Any], Watched]]:
    """Every readable line of sums; torn lines are left out."""
    for values in _lines(folder):
        try:
            sums = {k: float(values[k]) for k in ("watched_s", "moving_s", "speed_known_s", "distance_m", "blind_s", "lead_s")}
            alerts = {str(k): int(n) for k, n in values["alerts"].items()}
        except (ValueError, KeyError, TypeError, AttributeError):
            continue
        yield values, Watched(**sums, alerts=alerts)


def _lines(folder: Path) -> Iterator[dict[str, Any]]:
    try:
        text = (folder / NAME).read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return
    for line in text.splitlines():
        try:
            values = json.loads(line)
        except ValueError:
            continue
        if isinstance(values, dict):
            yield values


def _append(folder: Path, line: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / NAME).open("a", encoding="utf-8") as f:
        if f.tell() and not _ends_with_newline(folder / NAME):
            f.write("\n")  # the last line was torn by a power cut
        f.write(json.dumps(line, separators=(",", ":")) + "\n")
        f.flush()
        os.fsync(f.fileno())


def _rank(level: str) -> int:
    return ("none", "caution", "warning").index(level)


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as f:
        f.seek(-1, os.SEEK_END)
        return f.read(1) == b"\n"
