"""The learnt resting pose over restarts: whole or not at all, only for its own mounting, and exact in a replay."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import pytest

from tmde_edge.app import pose_state
from tmde_edge.app.drive_log import DriveLogWriter
from tmde_edge.app.pose_state import PoseKeeper, from_tree, load_resting, save_resting, state_path, to_tree
from tmde_edge.app.wiring import build_estimation, log_config, replay_log
from tmde_edge.config import Config, load
from tmde_edge.messages import FrameResult, LaneSighting, Sighting
from tmde_edge.pose.resting import BLOCK_SAMPLES, RestingPose


def config(*more: str) -> Config:
    return load(None, ["camera.fx_px=1000", "camera.pitch_rad=0.02", *more])


def learnt(samples: int = 6 * BLOCK_SAMPLES + 7, pitch_rad: float = 0.031) -> RestingPose:
    pose = RestingPose()
    for k in range(samples):
        pose = pose.with_sample(pitch_rad + 0.001 * math.sin(k), 0.004)
    return pose


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    save_resting(path, learnt(), config())
    assert load_resting(path, config()) == learnt()
    kept = json.loads(path.read_text())
    assert kept["percent"] == 100
    assert 0.0 < kept["spread_rad"] < 0.001
    assert [p.name for p in tmp_path.iterdir()] == ["pose.json"]


def test_another_mounting_makes_it_void(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    save_resting(path, learnt(), config())
    assert load_resting(path, config("camera.pitch_rad=0.03")) is None
    assert load_resting(path, config("camera.fx_px=1001")) is None


@pytest.mark.parametrize("content", ["", "{", "[]", '{"version": 1}', '{"version": 2, "resting": {}}', "\x00\xff"])
def test_a_damaged_file_is_told_and_ignored(tmp_path: Path, content: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "pose.json"
    path.write_text(content, encoding="latin-1")
    assert load_resting(path, config()) is None
    assert "learning anew" in caplog.text


@pytest.mark.parametrize(
    "broken", [{"blocks_rad": [[math.nan, 0.0]]}, {"blocks_rad": [[1.5, 0.0]]}, {"samples": -1}, {"blocks_rad": 3}]
)
def test_angles_of_no_mounting_are_refused(broken: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="no resting pose"):
        from_tree({**to_tree(learnt()), **broken})


def test_a_cut_while_writing_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "pose.json"
    save_resting(path, learnt(), config())

    def cut(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", cut)
    with pytest.raises(OSError, match="space"):
        save_resting(path, learnt(pitch_rad=0.05), config())
    assert load_resting(path, config()) == learnt()


def test_the_keeper_saves_blocks_at_the_end_and_tells_a_refusal_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    now = [learnt(3)]
    keeper = PoseKeeper(tmp_path / "state" / "pose.json", config(), lambda: now[0], period_s=0.01)
    keeper.start()
    now[0] = learnt()
    keeper.close()
    assert load_resting(tmp_path / "state" / "pose.json", config()) == learnt()
    (tmp_path / "file").write_text("")
    refused = PoseKeeper(tmp_path / "file" / "pose.json", config(), lambda: now[0], period_s=0.01)
    now[0] = learnt(pitch_rad=0.04)
    for _ in range(3):
        refused._save()
    assert caplog.text.count("cannot be written") == 1


def test_a_default_installation_keeps_it_in_the_service_s_state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).parents[3]
    unit = (root / "systemd" / "tmde-edge.service").read_text()
    folder = next(line.partition("=")[2] for line in unit.splitlines() if line.startswith("StateDirectory="))
    monkeypatch.setenv("STATE_DIRECTORY", f"/var/lib/{folder}")
    shipped = load(root / "config" / "tmde-edge.toml")
    assert state_path(shipped.pose.state_file, Path("/etc/tmde-edge")) == Path("/var/lib/tmde-edge/pose.json")
    assert state_path("", tmp_path) is None
    assert state_path("own.json", tmp_path) == tmp_path / "own.json"
    monkeypatch.delenv("STATE_DIRECTORY")
    assert state_path("auto", tmp_path) is None


def lanes(k: int, pitch_rad: float) -> Sighting:
    seen = LaneSighting(vanishing_px=(639.5, 359.5 - 1000.0 * math.tan(pitch_rad)), sigma_x_px=2.0, sigma_y_px=1.0)
    found = seen if k % 7 else None
    return Sighting(t_ns=k * 100_000_000, frame_index=k, width_px=1280, height_px=720, status="no_plate", lanes=found)


def test_a_replay_begins_with_the_same_resting_pose(tmp_path: Path) -> None:
    """The log holds it; a replay without it would differ."""
    path = tmp_path / "drive.mcap"
    started = build_estimation(config(), tmp_path, learnt())
    assert started.resting == learnt()
    with DriveLogWriter(path, log_config(config(), tmp_path, learnt())) as log:
        for k in range(20):
            event = lanes(k, 0.03 + 0.002 * math.sin(k))
            log.write(event, started.step(event))
    outcome = replay_log(path)
    assert outcome.difference is None
    assert outcome.events == 20
    without = build_estimation(config(), tmp_path).step(lanes(0, 0.03))
    with_it = build_estimation(config(), tmp_path, learnt()).step(lanes(0, 0.03))
    a, b = (next(o for o in out if isinstance(o, FrameResult)).pose.pitch_rad for out in (without, with_it))
    assert abs(a - b) > 0.005
    assert pose_state.VERSION == 1
