"""JSON records of the contract from results; the one place where field names of the outside are spelled."""

from __future__ import annotations

import math
from typing import Any

from tmde_edge.messages import FrameResult, LeadEstimate, PlateResult, Sighting

Record = dict[str, Any]


def _number(value: float | None, digits: int = 5) -> float | None:
    """Rounded for reading; a value that is not finite must never have come this far."""
    if value is None:
        return None
    if not math.isfinite(value):
        raise ValueError(f"a record would hold {value}")
    return round(float(value), digits)


def plate_record(plate: PlateResult) -> Record:
    """One entry of `plates`."""
    seen, found = plate.sighting, plate.range
    record: Record = {
        "corners": [[_number(x, 3), _number(y, 3)] for x, y in seen.corners_px],
        "score": _number(seen.score, 4),
        "standard": found.standard if found is not None else None,
        "characters": len(seen.glyphs),
        "char_height_px": _number(seen.char_height_px, 3),
        "distance_m": _number(found.distance_m) if found is not None else None,
        "sigma_m": _number(found.sigma_m) if found is not None else None,
        "cues": [
            {"cue": c.cue, "distance_m": _number(c.distance_m), "sigma_m": _number(c.sigma_m), "used": c.used}
            for c in (found.cues if found is not None else ())
        ],
        "in_path": plate.in_path,
        "lead": plate.lead,
        "track": seen.track_id,
        "source": seen.source,
        "cut": seen.cut,
    }
    if found is not None:
        record["lateral_m"] = _number(found.lateral_m)
        record["yaw_rad"] = _number(found.yaw_rad)
        record["belief"] = _number(found.belief, 4)
    if plate.not_ranged is not None:
        record["not_ranged"] = plate.not_ranged
    return record


def lead_record(lead: LeadEstimate | None) -> Record | None:
    """The `lead` object."""
    if lead is None:
        return None
    return {
        "distance_m": _number(lead.distance_m),
        "sigma_m": _number(lead.sigma_m),
        "range_rate_mps": _number(lead.range_rate_mps),
        "range_rate_sigma_mps": _number(lead.range_rate_sigma_mps),
        "ttc_s": _number(lead.ttc_s, 4),
        "ttc_sigma_s": _number(lead.ttc_sigma_s, 4),
        "headway_s": _number(lead.headway_s, 4),
        "coasting_s": _number(lead.coasting_s, 4),
        "source": lead.source,
        "lateral_m": _number(lead.lateral_m) if lead.distance_m is not None else None,
        "accel_mps2": _number(lead.accel_mps2),
        "track": lead.track_id,
    }


def frame_record(result: FrameResult, sighting: Sighting | None, timing_ms: dict[str, float]) -> Record:
    """One line of --dry-run; `sighting` None: no frame came, what is decided is decided blind."""
    ego, pose, depth = result.ego, result.pose, result.depth
    return {
        "frame": result.frame_index,
        "t": _number(result.t_ns * 1e-9, 6),
        "plates": [plate_record(p) for p in result.plates],
        "lead": lead_record(result.lead),
        "ego": {"speed_mps": _number(ego.speed_mps), "yaw_rate_radps": _number(ego.yaw_rate_radps)}
        if ego is not None
        else None,
        "pose": {"pitch_rad": _number(pose.pitch_rad, 6), "roll_rad": _number(pose.roll_rad, 6), "source": pose.source},
        "depth": {
            "distance_m": _number(depth.distance_m),
            "sigma_m": _number(depth.sigma_m),
            "age_s": _number(depth.age_s, 4),
        }
        if depth is not None
        else None,
        "alert": {
            "level": result.alert.level,
            "reason": result.alert.reason,
            "ttc_s": _number(result.alert.ttc_s, 4),
        },
        "faults": list(result.faults),
        "status": sighting.status if sighting is not None else "blind",
        "mode": result.mode,
        "timing_ms": {k: _number(v, 3) for k, v in timing_ms.items()},
    }


def error_record(frame_index: int, t_ns: int, message: str) -> Record:
    """A frame that could not be used."""
    return {"frame": frame_index, "t": _number(t_ns * 1e-9, 6), "error": message}
