"""Measured against true distances of a recording: the numbers of the paper's Tables 1 and 2."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tmde_edge.app.records import Record
from tmde_edge.errors import InputDataError, InputMissingError

DISTANCE_COLUMNS = ("distance_m", "lidar_z_plate_m")  # our simulator's name first


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthRow:
    """What is known of one frame."""

    distance_m: float
    characters: int | None = None
    ttc_s: float | None = None


def read_truth(path: Path) -> dict[int, TruthRow]:
    """Rows by frame number (column `frame`, else the line's number). Raises InputMissingError, InputDataError."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as f:
            rows = list(csv.DictReader(f))
    except FileNotFoundError:
        raise InputMissingError(f"{path}: no such truth file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise InputDataError(f"{path}: cannot be read as CSV ({e})") from None
    column = next((c for c in DISTANCE_COLUMNS if rows and c in rows[0]), None)
    if column is None:
        found = ", ".join(rows[0]) if rows else "nothing"
        raise InputDataError(f"{path}: no column {DISTANCE_COLUMNS[0]}; found {found}")
    truth = {}
    for i, row in enumerate(rows):
        try:
            distance_m = float(row[column] or "nan")
            if np.isfinite(distance_m):
                frame = int(row["frame"]) if row.get("frame") else i
                count, ttc = row.get("glyph_count"), row.get("ttc_s")
                truth[frame] = TruthRow(
                    distance_m=distance_m, characters=int(count) if count else None, ttc_s=float(ttc) if ttc else None
                )
        except (ValueError, TypeError) as e:
            raise InputDataError(f"{path} line {i + 2}: {e}") from None
    return truth


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorStats:
    """Errors of one series; the paper's Table 1 (MAE, RMSE, CV of measured/true)."""

    count: int
    median_abs: float  # of |error| / true
    bias: float
    sd: float
    p95_abs: float
    mae_m: float
    rmse_m: float
    cv: float  # spread of measured / true over its mean: the paper's coefficient of variation where the plate stands still
    inside_1_sigma: float | None = None
    inside_2_sigma: float | None = None


def stats(measured_m: np.ndarray, true_m: np.ndarray, sigma_m: np.ndarray | None = None) -> ErrorStats | None:
    """Statistics of finite pairs; None where there is none."""
    ok = np.isfinite(measured_m) & np.isfinite(true_m)
    if not ok.any():
        return None
    error_m = measured_m[ok] - true_m[ok]
    relative = error_m / true_m[ok]
    inside = None if sigma_m is None else [float((np.abs(error_m) <= k * sigma_m[ok]).mean()) for k in (1, 2)]
    return ErrorStats(
        count=int(ok.sum()),
        median_abs=float(np.median(np.abs(relative))),
        bias=float(relative.mean()),
        sd=float(relative.std()),
        p95_abs=float(np.quantile(np.abs(relative), 0.95)),
        mae_m=float(np.abs(error_m).mean()),
        rmse_m=float(np.sqrt((error_m**2).mean())),
        cv=float(relative.std() / max(abs(1.0 + relative.mean()), 1e-9)),
        inside_1_sigma=inside[0] if inside else None,
        inside_2_sigma=inside[1] if inside else None,
    )


class TruthComparison:
    """Collects what the records say beside the truth."""

    def __init__(self, truth: dict[int, TruthRow]) -> None:
        self._truth = truth
        self._rows: list[dict[str, float]] = []

    def add(self, record: Record) -> None:
        """Takes one record of the dry run."""
        true = self._truth.get(record["frame"])
        if true is None or "error" in record:
            return
        row = {"true": true.distance_m, "t": record["t"]}
        if true.characters is not None:
            row["characters_true"] = float(true.characters)
        lead = record["lead"]
        if lead is not None and lead["distance_m"] is not None:
            row["lead"], row["sigma"] = lead["distance_m"], lead["sigma_m"]
        plate = next((p for p in record["plates"] if p["lead"]), None)
        if plate is not None:
            row |= {c["cue"]: c["distance_m"] for c in plate["cues"]}
            if plate["char_height_px"] is not None:
                row["char_height_px"] = plate["char_height_px"]
            if true.characters is not None:
                row["characters_right"] = float(plate["characters"] == true.characters)
        self._rows.append(row)

    @property
    def count(self) -> int:
        """Frames with a true distance so far."""
        return len(self._rows)

    def column(self, name: str) -> np.ndarray:
        """(n,) of one series, NaN where absent."""
        return np.array([r.get(name, np.nan) for r in self._rows], dtype=np.float64)

    def lines(self) -> list[str]:
        """The comparison for people; character height against plate width is the paper's Table 2."""
        if not self._rows:
            return ["truth: no frame of the recording has a true distance"]
        true = self.column("true")
        out = [f"truth: {len(true)} frames with a true distance"]
        for name, label in (("lead", "lead"), ("char_height", "character height alone"), ("plate_width", "plate width alone")):
            s = stats(self.column(name), true, self.column("sigma") if name == "lead" else None)
            if s is None:
                out.append(f"  {label}: never measured")
                continue
            text = (
                f"  {label}: {s.count} frames, median |error| {100 * s.median_abs:.2f} %, bias {100 * s.bias:+.2f} %, "
                f"sd {100 * s.sd:.2f} %, p95 {100 * s.p95_abs:.2f} %, "
                f"CV {100 * s.cv:.2f} %, MAE {s.mae_m:.3f} m, RMSE {s.rmse_m:.3f} m"
            )
            if s.inside_1_sigma is not None and s.inside_2_sigma is not None:
                text += f", inside 1/2 sigma {100 * s.inside_1_sigma:.0f}/{100 * s.inside_2_sigma:.0f} %"
            out.append(text)
        right = self.column("characters_right")
        if np.isfinite(right).any():
            out.append(f"  characters: count right in {100 * np.nanmean(right):.0f} % of {int(np.isfinite(right).sum())} frames")
        return out
