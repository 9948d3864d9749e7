"""The judge of scenarios: each kind of wrong record is named, right ones pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tmde_edge.errors import InputMissingError
from tmde_edge.simulation.check import check
from tmde_edge.simulation.drive import FrameTruth, frame_truth
from tmde_edge.simulation.scenario import Expectation
from tmde_edge.simulation.scenarios import build, names


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


def dead(truth: list[FrameTruth]) -> list[dict[str, Any]]:
    """What a program says that sees nothing."""
    return [{"frame": t.frame, "lead": None, "plates": [], "alert": {"level": "none", "reason": ""}} for t in truth]


@pytest.mark.parametrize("name", [name for name, _ in names() if name not in ("empty", "no-plate")])
def test_a_program_that_sees_nothing_fails_wherever_there_is_something_to_see(name: str) -> None:
    try:
        scenario = build(name)
    except InputMissingError as error:
        pytest.skip(str(error))
    some = [frame_truth(scenario, f) for f in range(0, scenario.frame_count, 20)]
    assert check(dead(some), some, scenario.expectation) != []


def test_the_share_of_frames_with_a_lead_is_judged(truth: list[FrameTruth]) -> None:
    wanted = Expectation(min_lead_share=0.9)
    some = records(truth, None)
    for r in some[:18]:
        r["lead"] = None
    assert check(some, truth, wanted) == []
    some[18]["lead"] = {"distance_m": None}  # uncalibrated: no distance
    assert "only 170 of 189 frames with one, 90 % wanted" in check(some, truth, wanted)[0]
    no_lead = [replace(t, lead=None) for t in truth]
    assert "only 0 of 0" in check(some, no_lead, wanted)[0]


def test_plates_beside_the_path_are_to_be_found(truth: list[FrameTruth]) -> None:
    wanted = Expectation(min_plate_share=0.9)
    some = dead(truth)
    for r, t in zip(some, truth, strict=True):
        assert t.lead is not None
        assert t.lead.plate_corners_px is not None
        corners = np.array(t.lead.plate_corners_px).reshape(4, 2)
        r["plates"] = [{"corners": (corners + 0.4 * (corners[1] - corners[0])).tolist(), "in_path": False}]
    assert check(some, truth, wanted) == []
    for r in some:
        r["plates"][0]["corners"] = [[x + 200, y] for x, y in r["plates"][0]["corners"]]
    assert "only 0 of" in check(some, truth, wanted)[0]


def test_a_lead_seldom_reported_and_one_never_wide_enough_are_named(truth: list[FrameTruth]) -> None:
    expectation = Expectation(max_relative_error=0.03)
    assert "a lead with a distance in only 0 of" in check(dead(truth), truth, expectation)[0]
    assert "never judged" in check(records(truth, None), truth, replace(expectation, wide_px=1000.0))[0]
    assert "median distance error nan" in check(records(truth, None, float("nan")), truth, expectation)[0]
    assert check(records(truth, None, 1.029), truth, expectation) == []


def test_an_empty_road_stays_empty(truth: list[FrameTruth]) -> None:
    wanted = build("empty").expectation
    for what in ({"lead": {"distance_m": 20.0}}, {"plates": [{"in_path": True}]}):
        some = dead(truth)
        for r in some[:3]:
            r.update(what)
        assert check(some, truth, wanted) == []  # 3 of 189: not above 2 %
        some[3].update(what)
        assert "in 4 of 189 frames" in check(some, truth, wanted)[0]


@pytest.mark.parametrize("lasts", [lambda k: k == 0, lambda k: k % 2 == 0, lambda k: k != 70], ids=["once", "flickers", "a gap"])
def test_a_warning_that_does_not_last_is_named(truth: list[FrameTruth], lasts: Callable[[int], bool]) -> None:
    some = records(truth, 3.9)
    first = next(r["frame"] for r in some if r["alert"]["level"] == "warning")
    for r in some[first:]:
        if r["alert"]["level"] == "warning" and not lasts(r["frame"] - first):
            r["alert"] = {"level": "caution", "reason": "ttc"}
    (fault,) = check(some, truth, build("stopped").expectation)
    assert "warning given up" in fault


def test_a_warning_may_end_when_we_brake(truth: list[FrameTruth]) -> None:
    some = records(truth, 2.4)
    for r, t in zip(some, truth, strict=True):
        if t.t_s > 4.44:  # 9 m/s^2 from 4.4 s on
            r["alert"] = {"level": "none", "reason": ""}
    assert check(some, truth, build("stopped").expectation) == []


def test_a_warning_that_never_ends_is_named() -> None:
    scenario = build("night")
    truth = [frame_truth(scenario, f) for f in range(0, scenario.frame_count, 3)]
    some = records(truth, 2.4)
    assert check(some, truth, scenario.expectation) == []
    first = next(k for k, r in enumerate(some) if r["alert"]["level"] == "warning")
    for r in some[first:]:
        r["alert"] = {"level": "warning", "reason": "ttc"}
    (fault,) = check(some, truth, scenario.expectation)
    assert "warning does not end" in fault


def test_missing_frames_and_error_records_are_named(truth: list[FrameTruth]) -> None:
    some = records(truth, 2.4)
    assert "records" in check(some[:-1], truth, build("stopped").expectation)[0]
    assert "0 records" in check([], [], build("stopped").expectation)[0]
    some[3] = {"frame": 3, "error": "cannot be decoded"}
    assert "cannot be decoded" in check(some, truth, build("stopped").expectation)[0]
