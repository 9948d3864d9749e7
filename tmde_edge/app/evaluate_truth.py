"""Truth of recordings and labelled stills, and what a record is worth against it: one row a true plate and frame."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmde_edge.app.evaluate_metrics import MATCH_IOU, Row
from tmde_edge.app.records import Record
from tmde_edge.errors import InputDataError, InputMissingError

Floats = NDArray[np.float64]

LEAST_WIDTH_PX = 20.0  # smaller true plates are not asked for
_CORNERS = ("tl_x_px", "tl_y_px", "tr_x_px", "tr_y_px", "br_x_px", "br_y_px", "bl_x_px", "bl_y_px")


@dataclass(frozen=True, slots=True, kw_only=True)
class TruePlate:
    """One plate that is there; corners (4, 2) exact, or of a box only."""

    box: tuple[float, float, float, float]  # left, top, right, bottom
    corners_px: Floats | None = None
    characters: int | None = None
    char_height_px: float | None = None
    distance_m: float | None = None


@dataclass(slots=True, kw_only=True)
class TrueFrame:
    """What is known of one frame or still."""

    plates: list[TruePlate] = field(default_factory=list)
    ignored: list[TruePlate] = field(default_factory=list)  # hidden or tiny: finding them is neither right nor wrong
    lead_m: float | None = None
    no_lead: bool = False  # known to have none; without a lead_m and without this nobody knows


def read_rows(path: Path) -> list[dict[str, str]]:
    """A CSV file's rows. Raises InputMissingError, InputDataError."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as f:
            return [{k: v or "" for k, v in row.items() if k} for row in csv.DictReader(f)]
    except FileNotFoundError:
        raise InputMissingError(f"{path}: no such truth file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise InputDataError(f"{path}: cannot be read as CSV ({e})") from None


def recording_truth(folder: Path) -> dict[int, TrueFrame]:
    """truth.csv (the lead) and, where there is one, vehicles.csv (every plate) by frame. Raises InputDataError."""
    frames: dict[int, TrueFrame] = {}
    path = folder / "truth.csv"
    rows = read_rows(path)
    for i, row in enumerate(rows):
        frame = frames.setdefault(_int(row.get("frame", ""), path, i) if row.get("frame") else i, TrueFrame())
        distance_m = _float(row.get("distance_m") or row.get("lidar_z_plate_m") or "", path, i)
        frame.lead_m = distance_m
        frame.no_lead = distance_m is None and row.get("in_path", "").strip() == "0"
    everyone = folder / "vehicles.csv"
    if everyone.exists():
        path, rows = everyone, read_rows(everyone)
    for i, row in enumerate(rows):
        number = _int(row.get("frame", ""), path, i) if row.get("frame") else i
        plate = _plate(row, path, i)
        if plate is not None and number in frames:
            visible = _float(row.get("plate_visible", ""), path, i)
            wide = plate.box[2] - plate.box[0] >= LEAST_WIDTH_PX
            (frames[number].plates if wide and (visible is None or visible > 0.99) else frames[number].ignored).append(plate)
    return frames


def still_labels(path: Path) -> dict[str, TrueFrame]:
    """Labels by image name: `image` with x,y,w,h or eight corner columns, and text or characters, distance_m as known.

    A row without a box says: no plate in this image. Raises InputMissingError, InputDataError.
    """
    rows = read_rows(path)
    if not rows or "image" not in rows[0]:
        found = ", ".join(rows[0]) if rows else "nothing"
        raise InputDataError(f"{path}: needs a column image, and x,y,w,h or {_CORNERS[0]} ...; found {found}")
    frames: dict[str, TrueFrame] = {}
    for i, row in enumerate(rows):
        frame = frames.setdefault(row["image"], TrueFrame())
        plate = _plate(row, path, i)
        if plate is not None:
            frame.plates.append(plate)
    return frames


def _plate(row: dict[str, str], path: Path, i: int) -> TruePlate | None:
    corners: Floats | None = None
    if all(row.get(c) for c in _CORNERS):
        corners = np.array([_float(row[c], path, i) for c in _CORNERS], np.float64).reshape(4, 2)
        low, high = corners.min(axis=0), corners.max(axis=0)
        box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    elif all(row.get(c) for c in ("x", "y", "w", "h")):
        x, y, w, h = (_float(row[c], path, i) or 0.0 for c in ("x", "y", "w", "h"))
        box = (x, y, x + w, y + h)
    else:
        return None
    count = row.get("glyph_count") or row.get("characters") or ""
    text = "".join(row.get("text", "").split())
    return TruePlate(
        box=box, corners_px=corners, characters=_int(count, path, i) if count else len(text) or None,
        char_height_px=_float(row.get("char_height_px", ""), path, i), distance_m=_float(row.get("distance_m", ""), path, i),
    )


def _float(text: str, path: Path, i: int) -> float | None:
    if not text.strip():
        return None
    try:
        value = float(text)
    except ValueError:
        raise InputDataError(f"{path} line {i + 2}: {text!r} is not a number") from None
    return value if np.isfinite(value) else None


def _int(text: str, path: Path, i: int) -> int:
    value = _float(text, path, i)
    if value is None:
        raise InputDataError(f"{path} line {i + 2}: {text!r} is not a whole number")
    return int(value)


def rows_of(record: Record, truth: TrueFrame, base: Row, has_images: bool = True) -> list[Row]:
    """Rows of one record: one a true plate, or one for a frame without any; frame-wide numbers stand in the first.

    has_images False (a replayed drive log): what was seen is as it was, only ranges and the lead are judged.
    """
    rows: list[Row] = []
    if "error" in record:
        rows = [_missed(plate, {**base, "error": record["error"]}, has_images) for plate in truth.plates]
        rows = rows or [{**base, "error": record["error"]}]
        if truth.lead_m is not None:
            rows[0] |= {"lead_true_m": truth.lead_m, "lead_reported": 0.0}
        return rows
    found = list(record["plates"])
    boxes = [_box(p["corners"]) for p in found]
    used: set[int] = set()
    for plate in truth.plates:
        row = _missed(plate, base, has_images)
        overlaps = [(_iou(b, plate.box), k) for k, b in enumerate(boxes) if k not in used]
        best, k = max(overlaps, default=(0.0, -1))
        if has_images:
            row.update(found=float(best > MATCH_IOU), iou=best)
        if best > MATCH_IOU:
            used.add(k)
            row.update(_against(found[k], plate))
        rows.append(row)
    rest = [b for k, b in enumerate(boxes) if k not in used]
    false = [b for b in rest if not any(_iou(b, p.box) > 0.1 for p in (*truth.plates, *truth.ignored))]
    if not rows:
        rows = [dict(base)]
    if has_images:
        rows[0]["false_plates"] = float(len(false))
    lead = record.get("lead")
    if truth.lead_m is not None:
        measured = lead["distance_m"] if lead is not None else None
        rows[0]["lead_true_m"] = truth.lead_m
        rows[0]["lead_reported"] = float(measured is not None)
        if lead is not None and measured is not None:
            rows[0]["lead_m"] = measured
            rows[0]["lead_error"] = measured / truth.lead_m - 1
            rows[0]["lead_sigma"] = lead["sigma_m"] / truth.lead_m
    elif truth.no_lead:
        rows[0]["lead_false"] = float(lead is not None)
    return rows


def _missed(plate: TruePlate, base: Row, has_images: bool) -> Row:
    """The row of a true plate of which nothing was seen; ranging is asked for only where the truth knows the distance."""
    row: Row = {**base, "true_m": plate.distance_m, "true_width_px": plate.box[2] - plate.box[0]}
    if has_images:
        row["found"] = 0.0
    if plate.distance_m:
        row["ranged"] = 0.0
    return row


def _against(plate: dict[str, Any], true: TruePlate) -> Row:
    row: Row = {"characters": plate["characters"], "distance_m": plate["distance_m"], "sigma_m": plate["sigma_m"],
                "standard": plate["standard"]}  # fmt: skip
    if true.corners_px is not None:
        off = np.hypot(*(np.array(plate["corners"]) - true.corners_px).T)
        sides = np.hypot(*(true.corners_px[[3, 2]] - true.corners_px[[0, 1]]).T)
        row["corner_error"] = float(off.mean() / max(float(sides.mean()), 1e-6))
    if true.characters is not None:
        row["count_exact"] = float(plate["characters"] == true.characters)
    if true.char_height_px and plate["char_height_px"]:
        row["char_height_error"] = plate["char_height_px"] / true.char_height_px - 1
    if true.distance_m:
        row["ranged"] = float(plate["distance_m"] is not None)
        if plate["distance_m"] is not None:
            row["range_error"] = plate["distance_m"] / true.distance_m - 1
            row["range_sigma"] = plate["sigma_m"] / true.distance_m
    return row


def _box(corners: list[list[float]]) -> tuple[float, float, float, float]:
    x, y = [p[0] for p in corners], [p[1] for p in corners]
    return min(x), min(y), max(x), max(y)


def _iou(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    inside = max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - inside
    return inside / union if union > 0 else 0.0
