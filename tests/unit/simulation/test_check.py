"""The judge of scenarios: each kind of wrong record is named, right ones pass."""

from __future__ import annotations

from typing import Any

import pytest

from tmde_edge.simulation.check import check
from tmde_edge.simulation.drive import FrameTruth, frame_truth
from tmde_edge.simulation.scenarios import build


@pytest.fixture(scope="module")
def truth() -> list[FrameTruth]:
    scenario = build("stopped")
    return [frame_truth(scenario, f) for f in range(scenario.frame_count)]


def records(truth: list[FrameTruth], warn_from_ttc_s: float | None, factor: float = 1.0) -> list[dict[str, Any]]:
    out = []
    for t in truth:
        assert t.lead is not None
        ttc = t.lead.ttc_braking_s
        warned = warn_from_ttc_s is not None and ttc is not None and ttc <= warn_from_ttc_s
        out.append({
            "frame": t.frame, "lead": {"distance_m": t.lead.distance_m * factor}, "plates": [],
            "alert": {"level": "warning" if warned else "none", "reason": "ttc" if warned else ""},
        })
    return out


def test_right_records_pass(truth: list[FrameTruth]) -> None:
    assert check(records(truth, 2.4), truth, build("stopped").expectation) == []


@pytest.mark.parametrize(
    ("ttc", "factor", "word"), [(None, 1.0, "no warning"), (1.2, 1.0, "late"), (4.8, 1.0, "too early"), (2.4, 1.05, "distance")]
)
def test_wrong_records_are_named(truth: list[FrameTruth], ttc: float | None, factor: float, word: str) -> None:
    wrong = check(records(truth, ttc, factor), truth, build("stopped").expectation)
    assert len(wrong) == 1
    assert word in wrong[0]


def test_quiet_scenario_allows_headway_caution_only(truth: list[FrameTruth]) -> None:
    quiet = build("follow").expectation
    quiet_records = records(truth, None)
    quiet_records[5]["alert"] = {"level": "caution", "reason": "headway"}
    assert check(quiet_records, truth, quiet) == []
    quiet_records[6]["alert"] = {"level": "caution", "reason": "ttc"}
    assert "caution" in check(quiet_records, truth, quiet)[0]
    quiet_records[6]["alert"] = {"level": "warning", "reason": "ttc"}
    assert "warning" in check(quiet_records, truth, quiet)[0]


def test_missing_frames_and_error_records_are_named(truth: list[FrameTruth]) -> None:
    some = records(truth, 2.4)
    assert "records" in check(some[:-1], truth, build("stopped").expectation)[0]
    some[3] = {"frame": 3, "error": "cannot be decoded"}
    assert "cannot be decoded" in check(some, truth, build("stopped").expectation)[0]
