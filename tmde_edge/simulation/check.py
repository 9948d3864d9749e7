"""Judges the records of a dry run against a scenario's truth and what was expected of it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.drive import FrameTruth, VehicleTruth
from tmde_edge.simulation.scenario import Expectation

_LATE_FRAMES = 2  # a record's alert may be this many frames younger than the truth it answers
_ENTERING_M = 2.2  # a vehicle this near to our path may already be warned of
_BRAKING_MPS2 = 1.0  # a driver who slows down so much has understood
_NEEDLESS_S = 2.0  # an alert may stand so long after what it told of has gone
_GONE = 1.5  # ... which is a TTC above warn_ttc_max_s times this, or none


def check(records: Sequence[dict[str, Any]], truth: Sequence[FrameTruth], expectation: Expectation) -> list[str]:
    """What is wrong, one line each; empty: all as expected. Records as in the contract, one a frame."""
    if len(records) != len(truth) or not truth:
        return [f"{len(records)} records for {len(truth)} frames"]
    out = [f"frame {r['frame']}: {r['error']}" for r in records if "error" in r]
    good = [(r, t) for r, t in zip(records, truth, strict=True) if "error" not in r]
    warnings = [(r, t) for r, t in good if r["alert"]["level"] == "warning"]
    cautions = [(r, t) for r, t in good if r["alert"]["level"] == "caution" and _alarmed(r)]
    if expectation.no_warning and warnings:
        out.append(f"warning where none may come: {_where(*warnings[0])}, in {len(warnings)} frames")
    if expectation.no_ttc_caution and cautions:
        out.append(f"caution where none may come: {_where(*cautions[0])}, in {len(cautions)} frames")
    if expectation.warn_ttc_min_s is not None:
        out += _due(warnings, truth, expectation.warn_ttc_min_s)
        out += _given_up(good, expectation.warn_ttc_min_s)
    out += _needless(good, _GONE * expectation.warn_ttc_max_s)
    if not expectation.no_warning:
        out += _early(good, expectation)
    if expectation.no_lead:
        seen = sum(1 for r, _ in good if r["lead"] is not None or any(p["in_path"] for p in r["plates"]))
        if seen > 0.02 * len(good):
            out.append(f"a lead or a plate in the path in {seen} of {len(good)} frames of an empty road")
    if expectation.max_relative_error is not None:
        out += _distances(good, expectation.max_relative_error, expectation.wide_px)
    if expectation.min_lead_share is not None:
        out += _led(good, expectation.min_lead_share)
    if expectation.min_plate_share is not None:
        out += _seen(good, expectation.min_plate_share, expectation.wide_px)
    return out


def _alarmed(record: dict[str, Any]) -> bool:
    """Any alert but a caution by headway."""
    alert = record["alert"]
    return bool(alert["level"] == "warning" or (alert["level"] == "caution" and alert["reason"] != "headway"))


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


def _given_up(good: list[tuple[dict[str, Any], FrameTruth]], least_s: float) -> list[str]:
    """Who was warned stays warned while the TTC is below the one at which that was due and we do not slow down."""
    warned = False
    silent: list[FrameTruth] = []
    for (_, before), (record, now) in pairwise(good):
        ttc = _ttc(now)
        warning = record["alert"]["level"] == "warning"
        warned |= warning and ttc is not None
        slowing = before.ego_speed_mps - now.ego_speed_mps > _BRAKING_MPS2 * (now.t_s - before.t_s)
        if warned and not warning and not slowing and ttc is not None and ttc < least_s:
            silent.append(now)
    if not silent:
        return []
    return [f"warning given up: first at {silent[0].t_s:.2f} s, TTC {_seconds(_ttc(silent[0]))}, in {len(silent)} frames"]


def _needless(good: list[tuple[dict[str, Any], FrameTruth]], gone_s: float) -> list[str]:
    """An alert that stands on although no vehicle in or near the path is closing in."""
    since_s: float | None = None
    for record, now in good:
        if not _alarmed(record) or any(t <= gone_s for t in _near_ttcs(now)):
            since_s = None
        elif since_s is None:
            since_s = now.t_s
        elif now.t_s - since_s > _NEEDLESS_S:
            alert = record["alert"]
            return [f"{alert['level']} does not end: nothing closes in since {since_s:.2f} s ({alert['reason']})"]
    return []


def _near_ttcs(truth: FrameTruth) -> list[float]:
    """TTC of the closing vehicles in or near the path."""
    near = (v.ttc_braking_s for v in truth.vehicles if abs(v.path_offset_m) < _ENTERING_M)
    return [ttc for ttc in near if ttc is not None]


def _early(good: list[tuple[dict[str, Any], FrameTruth]], expectation: Expectation) -> list[str]:
    """The beginning of each alert by TTC needs a vehicle in or near the path whose TTC is at most the limit."""
    out: list[str] = []
    before = False
    for index, (record, _) in enumerate(good):
        alert = record["alert"]
        alarmed = _alarmed(record)
        if alarmed and not before:
            recent = [t for _, t in good[max(0, index - _LATE_FRAMES) : index + 1]]
            times = [ttc for t in recent for ttc in _near_ttcs(t)]
            if not times or min(times) > expectation.warn_ttc_max_s:
                true = _seconds(min(times)) if times else "none"
                out.append(f"{alert['level']} too early: at {recent[-1].t_s:.2f} s ({alert['reason']}), TTC {true}")
        before = alarmed
    return out


def _distances(good: list[tuple[dict[str, Any], FrameTruth]], limit: float, wide_px: float) -> list[str]:
    """Median relative error of the reported lead where its plate is wide enough."""
    judged = [(r, t.lead) for r, t in good if t.lead is not None and _is_wide(t.lead, wide_px)]
    errors = [abs(r["lead"]["distance_m"] / lead.distance_m - 1.0) for r, lead in judged if _is_led(r)]
    if not judged:
        return [f"no frame with a lead's plate of {wide_px:.0f} px or more: its distance was never judged"]
    if len(errors) < 0.5 * len(judged):
        return [f"a lead with a distance in only {len(errors)} of {len(judged)} frames with a plate of {wide_px:.0f} px or more"]
    median = float(np.median(errors))
    # a NaN is no distance either
    return [] if median <= limit else [f"median distance error {100 * median:.2f} %, at most {100 * limit:.1f} % wanted"]


def _led(good: list[tuple[dict[str, Any], FrameTruth]], share: float) -> list[str]:
    """The lead is followed: reported with a distance in at least this share of the frames that have one."""
    there = [r for r, t in good if t.lead is not None]
    led = sum(_is_led(r) for r in there)
    if there and led >= share * len(there):
        return []
    return [f"a lead with a distance in only {led} of {len(there)} frames with one, {100 * share:.0f} % wanted"]


def _seen(good: list[tuple[dict[str, Any], FrameTruth]], share: float, wide_px: float) -> list[str]:
    """Plates are found: of the wide ones, in the path or beside it, at least this share."""
    found = [_is_found(r, v) for r, t in good for v in t.vehicles if _is_wide(v, wide_px)]
    if found and sum(found) >= share * len(found):
        return []
    return [f"only {sum(found)} of {len(found)} plates of {wide_px:.0f} px or more found, {100 * share:.0f} % wanted"]


def _is_led(record: dict[str, Any]) -> bool:
    return record["lead"] is not None and record["lead"]["distance_m"] is not None


def _is_wide(vehicle: VehicleTruth, wide_px: float) -> bool:
    """Its whole plate is to be seen, at least as wide."""
    if vehicle.plate_corners_px is None or vehicle.plate_visible < 0.99:
        return False
    top_left, top_right = _corners(vehicle)[:2]
    return float(np.hypot(*(top_right - top_left))) >= wide_px


def _is_found(record: dict[str, Any], vehicle: VehicleTruth) -> bool:
    """A reported plate's middle lies within the true one, by half its width."""
    true = _corners(vehicle)
    reach_px = float(np.hypot(*(true[1] - true[0]))) / 2
    return any(np.hypot(*(np.mean(p["corners"], axis=0) - true.mean(axis=0))) < reach_px for p in record["plates"])


def _corners(vehicle: VehicleTruth) -> NDArray[np.float64]:
    return np.array(vehicle.plate_corners_px, np.float64).reshape(4, 2)
