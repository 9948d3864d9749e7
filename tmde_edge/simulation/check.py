"""Judges the records of a dry run against a scenario's truth and what was expected of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tmde_edge.simulation.drive import FrameTruth
from tmde_edge.simulation.scenario import Expectation

_LATE_FRAMES = 2  # a record's alert may be this many frames younger than the truth it answers
_ENTERING_M = 2.2  # a vehicle this near to our path may already be warned of
_WIDE_PX = 60.0


def check(records: Sequence[dict[str, Any]], truth: Sequence[FrameTruth], expectation: Expectation) -> list[str]:
    """What is wrong, one line each; empty: all as expected. Records as in the contract, one a frame."""
    if len(records) != len(truth):
        return [f"{len(records)} records for {len(truth)} frames"]
    out = [f"frame {r['frame']}: {r['error']}" for r in records if "error" in r]
    good = [(r, t) for r, t in zip(records, truth, strict=True) if "error" not in r]
    warnings = [(r, t) for r, t in good if r["alert"]["level"] == "warning"]
    cautions = [(r, t) for r, t in good if r["alert"]["level"] == "caution" and r["alert"]["reason"] != "headway"]
    if expectation.no_warning and warnings:
        out.append(f"warning where none may come: {_where(*warnings[0])}, in {len(warnings)} frames")
    if expectation.no_ttc_caution and cautions:
        out.append(f"caution where none may come: {_where(*cautions[0])}, in {len(cautions)} frames")
    if expectation.warn_ttc_min_s is not None:
        out += _due(warnings, truth, expectation.warn_ttc_min_s)
    if not expectation.no_warning:
        out += _early(good, expectation)
    if expectation.no_lead:
        seen = sum(1 for r, _ in good if r["lead"] is not None or any(p["in_path"] for p in r["plates"]))
        if seen > 0.02 * len(good):
            out.append(f"a lead or a plate in the path in {seen} of {len(good)} frames of an empty road")
    if expectation.max_relative_error is not None:
        out += _distances(good, expectation.max_relative_error)
    return out


def _where(record: dict[str, Any], truth: FrameTruth) -> str:
    alert = record["alert"]
    lead = truth.lead
    true = "no lead" if lead is None else f"true distance {lead.distance_m:.1f} m, TTC {_seconds(lead.ttc_braking_s)}"
    return f"first at {truth.t_s:.2f} s ({alert['reason']}, {true})"


def _seconds(value: float | None) -> str:
    return "none" if value is None else f"{value:.2f} s"


def _due(warnings: list[tuple[dict[str, Any], FrameTruth]], truth: Sequence[FrameTruth], least_s: float) -> list[str]:
    """The first warning that has a vehicle to warn of, against the TTC at which it was due at the latest."""
    overdue = next((t for t in truth if _ttc(t) is not None and (_ttc(t) or 0.0) < least_s), None)
    first = next((t for _, t in warnings if _ttc(t) is not None), None)
    if first is None:
        return [f"no warning; it was due at TTC {least_s} s" + (f" ({overdue.t_s:.2f} s)" if overdue else "")]
    ttc = _ttc(first)
    if overdue is not None and first.t_s > overdue.t_s:
        return [f"warning late: at {first.t_s:.2f} s, TTC {_seconds(ttc)}; due at TTC {least_s} s ({overdue.t_s:.2f} s)"]
    return []


def _ttc(truth: FrameTruth) -> float | None:
    return None if truth.lead is None else truth.lead.ttc_braking_s


def _early(good: list[tuple[dict[str, Any], FrameTruth]], expectation: Expectation) -> list[str]:
    """The beginning of each alert by TTC needs a vehicle in or near the path whose TTC is at most the limit."""
    out: list[str] = []
    before = False
    for index, (record, _) in enumerate(good):
        alert = record["alert"]
        alarmed = alert["level"] == "warning" or (alert["level"] == "caution" and alert["reason"] != "headway")
        if alarmed and not before:
            recent = [t for _, t in good[max(0, index - _LATE_FRAMES) : index + 1]]
            times = [
                v.ttc_braking_s for t in recent for v in t.vehicles
                if abs(v.path_offset_m) < _ENTERING_M and v.ttc_braking_s is not None
            ]
            if not times or min(times) > expectation.warn_ttc_max_s:
                true = _seconds(min(times)) if times else "none"
                out.append(f"{alert['level']} too early: at {recent[-1].t_s:.2f} s ({alert['reason']}), TTC {true}")
        before = alarmed
    return out


def _distances(good: list[tuple[dict[str, Any], FrameTruth]], limit: float) -> list[str]:
    """Median relative error of the reported lead where its plate is wide enough."""
    errors = []
    frames = 0
    for record, truth in good:
        lead = truth.lead
        if lead is None or lead.plate_corners_px is None or lead.plate_visible < 0.99:
            continue
        corners = np.array(lead.plate_corners_px).reshape(4, 2)
        if np.hypot(*(corners[1] - corners[0])) < _WIDE_PX:
            continue
        frames += 1
        if record["lead"] is not None and record["lead"]["distance_m"] is not None:
            errors.append(abs(record["lead"]["distance_m"] / lead.distance_m - 1.0))
    if frames == 0:
        return []
    if len(errors) < 0.5 * frames:
        return [f"a lead with a distance in only {len(errors)} of {frames} frames with a plate of {_WIDE_PX:.0f} px or more"]
    median = float(np.median(errors))
    return [f"median distance error {100 * median:.2f} %, at most {100 * limit:.1f} % wanted"] if median > limit else []
