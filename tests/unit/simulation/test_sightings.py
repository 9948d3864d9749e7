"""Tracking and warnings on sightings drawn from the truth: scenarios that hold nothing to look at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tmde_edge.app import simulate_check
from tmde_edge.app.simulate_check import check_without_pictures, check_without_video
from tmde_edge.cli import main
from tmde_edge.simulation.drive import frame_truth
from tmde_edge.simulation.scenarios import build
from tmde_edge.simulation.sightings import Eyesight, sightings


def test_what_it_sees_is_the_truth_within_its_errors() -> None:
    scenario = build("follow")
    eyes = Eyesight()
    errors, found = [], 0
    for sighting in sightings(scenario, eyes):
        lead = frame_truth(scenario, sighting.frame_index).lead
        for plate in sighting.plates:
            assert lead is not None
            assert lead.plate_corners_px is not None
            errors.append(np.array(plate.corners_px).ravel() - np.array(lead.plate_corners_px))
            found += 1
        if sighting.frame_index == 60:
            break
    assert found > 50
    spread = float(np.std(np.array(errors)))
    assert 0.25 < spread < 0.6  # hypot(0.25, 0.3) px
    assert abs(float(np.mean(np.array(errors)))) < 0.15


@pytest.mark.parametrize("name", ["nhtsa-decelerating", "curve", "cut-in"])
def test_the_right_alerts_without_pictures(name: str, tmp_path: Path) -> None:
    (outcome,) = check_without_pictures(tmp_path, names=[name], seeds=[1], overrides=["runtime.threads=1"])
    assert outcome.faults == ()
    assert (outcome.first_warning_s is None) == (name == "curve")


def test_a_late_warning_is_seen_by_the_judge(tmp_path: Path) -> None:
    late = ["alerts.warning_ttc_s=1.5", "alerts.warning_decel_mps2=50.0", "runtime.threads=1"]
    (outcome,) = check_without_pictures(tmp_path, names=["nhtsa-decelerating"], seeds=[1], overrides=late)
    assert any("warning late" in f for f in outcome.faults)


def test_rendered_pictures_are_judged_without_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short = replace(build("parking"), duration_s=0.4)
    monkeypatch.setattr(simulate_check, "build", lambda name, **_: short)
    (outcome,) = check_without_video(tmp_path, names=["parking"], overrides=["runtime.threads=1"])
    assert outcome.faults == ()
    assert outcome.median_error is not None
    assert outcome.median_error < 0.02
    assert not list(tmp_path.glob("*.mp4"))


@pytest.mark.parametrize(("name", "frames"), [("nhtsa-slower", 46), ("stopped", 189)])
def test_a_drive_ends_after_the_warning_where_only_that_is_judged(
    name: str, frames: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def warns_after_1_s(source: Any, *_: Any, **__: Any) -> Iterator[Any]:
        for k in range(source.frame_count):
            level = "warning" if k >= 30 else "none"
            record = {"frame": k, "t": k / 30, "alert": {"level": level, "reason": "ttc"}, "lead": None}
            yield SimpleNamespace(record=record)

    judged = []
    monkeypatch.setattr(simulate_check, "dry_run", warns_after_1_s)
    monkeypatch.setattr(simulate_check, "judge", lambda made, records: judged.append((made, records)))
    list(check_without_video(tmp_path, names=[name], overrides=["runtime.threads=1"]))
    ((made, records),) = judged
    assert len(records) == len(made.truth) == frames


@pytest.mark.parametrize("warned", [True, False])
def test_a_run_that_breaks_off_is_a_fault(warned: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks_off(*_: Any, **__: Any) -> Iterator[Any]:
        for k in range(20):
            alert = {"level": "warning" if warned and k >= 10 else "none", "reason": "ttc"}
            yield SimpleNamespace(record={"frame": k, "t": k / 30, "alert": alert, "lead": None, "plates": []})

    monkeypatch.setattr(simulate_check, "dry_run", breaks_off)
    (outcome,) = check_without_video(tmp_path, names=["nhtsa-slower"], overrides=["runtime.threads=1"])
    assert outcome.faults == ("20 records for 186 frames",)


def test_the_plate_asked_for_is_the_one_judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenarios: list[Any] = []
    ask = ["simulate", "parking", "--check", "--plate", "us-mi", "--out", str(tmp_path)]
    outcome = simulate_check.Outcome(name="parking", seed=0, faults=())
    monkeypatch.setattr(simulate_check, "judge", lambda made, records: scenarios.append(made.scenario) or outcome)
    for records, how in (("rendered_records", "--no-video"), ("sighting_records", "--no-pictures"), ("desk_records", "-q")):
        monkeypatch.setattr(simulate_check, records, lambda made, overrides: [])
        if how == "-q":
            few = partial(simulate_check.simulate, max_frames=1)
            monkeypatch.setattr(simulate_check, "simulate", few)
        assert main([*ask, how]) == 0
    assert [s.expect for s in scenarios] == [("us-mi",)] * 3
    assert main([*ask, "--no-pictures", "--plate", "atlantis"]) == 2


def test_a_named_scenario_that_cannot_be_run_is_no_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TMDE_SHARED", str(tmp_path / "nowhere"))
    assert main(["simulate", "real", "--check", "--no-pictures", "--out", str(tmp_path)]) == 66
    assert "lead_gt_20hz.csv" in capsys.readouterr().err
    monkeypatch.setattr(simulate_check, "list_scenarios", lambda: [("real", "")])
    assert main(["simulate", "--all", "--check", "--no-pictures", "--out", str(tmp_path)]) == 0
    assert "real                 seed 0  skipped" in capsys.readouterr().out


def test_a_false_warning_is_told_with_its_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    false = {"alert": {"level": "warning", "reason": "ttc"}, "lead": None, "plates": []}
    monkeypatch.setattr(
        simulate_check, "sighting_records", lambda made, _: [{"frame": t.frame, "t": t.t_s, **false} for t in made.truth]
    )
    assert main(["simulate", "empty", "--check", "--no-pictures", "--out", str(tmp_path)]) == 1
    assert "first warning at 0.00 s, no lead closing" in capsys.readouterr().out
