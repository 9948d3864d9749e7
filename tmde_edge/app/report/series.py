"""The records of a recording as columns: what the plots are drawn from."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmde_edge.app.records import Record

Array = NDArray[np.float64]
LEVELS = ("none", "caution", "warning")
_NAN = math.nan


@dataclass(frozen=True, slots=True)
class Change:
    """Something began or ended: what the list of events is made of."""

    frame: int
    t_s: float
    kind: str  # "caution", "warning", "alert over", "lead", "lead lost", "fault", "fault over", "error"
    text: str


@dataclass(slots=True)
class Series:
    """Columns by frame, NaN where there is nothing. Built record by record, so that a long drive needs little memory."""

    _columns: dict[str, list[float]] = field(default_factory=dict)
    _cues: dict[str, list[tuple[float, float, float]]] = field(default_factory=dict)  # t, distance, lead's distance
    _timing: dict[str, list[float]] = field(default_factory=dict)
    _plates: list[tuple[float, float, float, float]] = field(default_factory=list)  # centre x, y, width, 1 where the lead's
    changes: list[Change] = field(default_factory=list)
    standards: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)  # frames
    sources: Counter[str] = field(default_factory=Counter)  # frames by the lead's source
    frames: int = 0
    errors: int = 0
    with_plate: int = 0
    _level: str = "none"
    _lead: bool = False
    _faults: tuple[str, ...] = ()

    def add(self, record: Record) -> list[Change]:
        """Takes the next record; returns what changed with it."""
        self.frames += 1
        before = len(self.changes)
        row: dict[str, float] = {"frame": record["frame"], "t": record["t"]}
        if "error" in record:
            self.errors += 1
            self._change(record, "error", record["error"])
        else:
            self._take(record, row)
            self._watch(record)
        self._append(row)
        return self.changes[before:]

    def _take(self, record: Record, row: dict[str, float]) -> None:
        lead, ego, pose, depth = record["lead"], record["ego"], record["pose"], record["depth"]
        self.with_plate += bool(record["plates"])
        self.faults.update(record["faults"])
        if lead is not None:
            self.sources[lead["source"]] += 1
            keys = ("distance_m", "sigma_m", "range_rate_mps", "range_rate_sigma_mps", "ttc_s", "headway_s", "coasting_s")
            row |= {k: _number(lead.get(k)) for k in keys}
            row["has_lead"] = 1.0
        if ego is not None:
            row["speed_mps"], row["yaw_rate_radps"] = _number(ego["speed_mps"]), _number(ego["yaw_rate_radps"])
        if pose["source"] != "none":
            row["pitch_rad"] = _number(pose["pitch_rad"])
        if depth is not None:
            row["depth_m"] = _number(depth["distance_m"])
        row["level"] = float(LEVELS.index(record["alert"]["level"]))
        for plate in record["plates"]:
            self._plate(plate, record["t"], lead, row)
        for stage, ms in record["timing_ms"].items():
            self._timing.setdefault(stage, []).append(ms)
            if stage == "total":
                row["total_ms"] = ms

    def _plate(self, plate: dict[str, Any], t_s: float, lead: Record | None, row: dict[str, float]) -> None:
        corners = np.array(plate["corners"], dtype=np.float64)
        x, y = corners.mean(axis=0)
        width_px = float(np.hypot(*(corners[1] + corners[2] - corners[0] - corners[3])) / 2)
        self._plates.append((float(x), float(y), width_px, float(plate["lead"])))
        if plate["standard"] is not None:
            self.standards[plate["standard"]] += 1
        if not plate["lead"]:
            return
        row["characters"], row["char_height_px"] = float(plate["characters"]), _number(plate["char_height_px"])
        row["plate_m"], row["plate_sigma_m"] = _number(plate["distance_m"]), _number(plate["sigma_m"])
        base = _number(lead["distance_m"]) if lead is not None else _NAN
        for cue in plate["cues"]:
            self._cues.setdefault(cue["cue"], []).append((t_s, _number(cue["distance_m"]), base))

    def _watch(self, record: Record) -> None:
        alert, lead = record["alert"], record["lead"]
        if alert["level"] != self._level:
            ttc = f", TTC {alert['ttc_s']:.1f} s" if alert["ttc_s"] is not None else ""
            over = alert["level"] == "none"
            self._change(
                record,
                "alert over" if over else alert["level"],
                f"{self._level} over" if over else f"{alert['level']} ({alert['reason']}{ttc})",
            )
            self._level = alert["level"]
        if (lead is not None) != self._lead:
            self._lead = lead is not None
            where = f" at {lead['distance_m']:.1f} m" if lead is not None and lead["distance_m"] is not None else ""
            self._change(
                record,
                "lead" if self._lead else "lead lost",
                f"vehicle ahead{where}" if self._lead else "no vehicle ahead any more",
            )
        faults = tuple(record["faults"])
        for name in faults:
            if name not in self._faults:
                self._change(record, "fault", f"fault: {name}")
        for name in self._faults:
            if name not in faults:
                self._change(record, "fault over", f"fault over: {name}")
        self._faults = faults

    def _change(self, record: Record, kind: str, text: str) -> None:
        self.changes.append(Change(record["frame"], record["t"], kind, text))

    def _append(self, row: dict[str, float]) -> None:
        for name in row:
            if name not in self._columns:
                self._columns[name] = [_NAN] * (self.frames - 1)
        for name, column in self._columns.items():
            column.append(row.get(name, _NAN))

    # -- reading --------------------------------------------------------------------------------------------------------

    def __getitem__(self, name: str) -> Array:
        """(frames,) of one column; all NaN where nothing ever came."""
        return np.array(self._columns.get(name, [_NAN] * self.frames), dtype=np.float64)

    def has(self, name: str) -> bool:
        """Whether a column holds any value."""
        return bool(np.isfinite(self[name]).any())

    def cues(self) -> dict[str, Array]:
        """(n, 3) by cue: time, its distance, the lead's distance."""
        return {name: np.array(rows, dtype=np.float64) for name, rows in self._cues.items()}

    def timing(self) -> dict[str, Array]:
        """Milliseconds by stage, in order of first appearance."""
        return {stage: np.array(values, dtype=np.float64) for stage, values in self._timing.items()}

    def plates(self) -> Array:
        """(n, 4): centre x, y, width in source pixels, and 1 for the lead's."""
        return np.array(self._plates, dtype=np.float64).reshape(-1, 4)

    def spans(self, level: str) -> Iterator[tuple[float, float]]:
        """Times from and to of every stretch with that alert level."""
        t, at = self["t"], self["level"] == LEVELS.index(level)
        start: float | None = None
        for k in range(self.frames):
            if at[k] and start is None:
                start = float(t[k])
            if not at[k] and start is not None:
                yield start, float(t[k])
                start = None
        if start is not None:
            yield start, float(t[-1])


def _number(value: float | None) -> float:
    return _NAN if value is None else float(value)
