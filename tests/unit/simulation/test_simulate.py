"""`simulate`: the files fit each other, are the same for the same seed, and are read back by our own code."""

from __future__ import annotations

import csv
import errno
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from tmde_edge import config
from tmde_edge.app import simulate as made_by
from tmde_edge.app.simulate import YAW_ID, Made, can_frames, can_lines, list_scenarios, simulate
from tmde_edge.errors import InputMissingError, UsageError
from tmde_edge.simulation.drive import frame_truth
from tmde_edge.simulation.scenarios import build


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return simulate("approach", tmp_path_factory.mktemp("sim") / "a", max_frames=3)


def test_video_has_the_camera_s_size_and_frame_times(made: Made) -> None:
    with av.open(str(made.video)) as container:
        times = [float(f.time) for f in container.decode(video=0)]
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (1280, 720)
    assert np.allclose(times, [0, 1 / 30, 2 / 30], atol=1e-4)


def test_configuration_loads_and_knows_the_camera(made: Made) -> None:
    loaded = config.load(made.config)
    camera = loaded.camera.camera()
    assert camera is not None
    assert camera.fx_px == made.scenario.camera.fx_px
    assert loaded.can.vehicle.speed is not None
    assert loaded.plates.expect == ["de-mittel"]


def test_truth_has_a_row_a_frame_with_the_pinhole_s_corners(made: Made) -> None:
    with made.truth_csv.open() as file:
        rows = list(csv.DictReader(file))
    assert [int(r["frame"]) for r in rows] == [0, 1, 2]
    row = rows[0]
    assert float(row["distance_m"]) == pytest.approx(29.98, abs=1e-6)  # the plate stands 2 cm proud of the rear
    camera = made.scenario.camera
    across = float(row["tr_x_px"]) - float(row["tl_x_px"])
    # seen by a camera pitched down: 520 mm at the depth along the optical axis
    assert across == pytest.approx(camera.fx_px * 0.52 / 29.98, rel=2e-3)
    assert int(row["glyph_count"]) == 7
    for k, row in enumerate(rows):  # 7 m/s towards a standing car, the lens 1.5 m behind the own bumper
        assert float(row["range_rate_mps"]) == pytest.approx(-7.0, abs=1e-5)
        assert float(row["gap_m"]) == pytest.approx(28.48 - 7.0 * k / 30, abs=1e-5)
        assert float(row["ttc_s"]) == pytest.approx((28.48 - 7.0 * k / 30) / 7.0, abs=1e-5)


def test_same_seed_same_bytes(made: Made, tmp_path: Path) -> None:
    again = simulate("approach", tmp_path / "b", max_frames=3)
    for name in ("video.mp4", "can.log", "truth.csv", "vehicles.csv", "config.toml"):
        assert (again.folder / name).read_bytes() == (made.folder / name).read_bytes(), name


def test_can_log_tells_the_ego_s_speed() -> None:
    scenario = build("approach")
    frames = [line.split() for line in can_lines(scenario)]
    assert frames[0][0] == "(1700000000.000000)"
    speeds = [int(data[4:8], 16) * 0.01 / 3.6 for _, _, data in frames if data.startswith("0B4#")]
    truth = [scenario.ego.state(k / 50)[1] for k in range(len(speeds))]
    assert np.abs(np.array(speeds) - truth).max() < 0.03


def test_a_left_bend_is_a_positive_yaw_rate_on_the_bus() -> None:
    scenario = build("curve")
    raw = [int.from_bytes(data[:2], "big", signed=True) for _, can_id, data in can_frames(scenario) if can_id == YAW_ID]
    yaw_radps = np.radians(0.01 * np.array(raw))
    offset = scenario.yaw_offset_radps
    assert yaw_radps[:100].mean() == pytest.approx(offset, abs=1e-3)  # the bend begins at 25 m, after 2.4 s
    assert yaw_radps[250:300].mean() == pytest.approx(10.5 / 70.0 + offset, abs=2e-3)


def test_place_from_the_own_path_does_not_bend_with_the_road() -> None:
    parked = [v for v in frame_truth(build("curve"), 60).vehicles if v.name.startswith("parked")]
    assert len(parked) == 6
    assert [v.path_offset_m for v in parked] == pytest.approx([3.1] * 6)
    assert not any(v.in_path for v in parked)
    assert abs(parked[-1].lateral_m - 3.1) > 10.0  # the road bends away to the left
    assert parked[-1].lateral_m < 0
    cutter = [frame_truth(build("cut-in"), f).vehicles[0] for f in (0, 150)]
    assert [v.path_offset_m for v in cutter] == pytest.approx([-3.5, 0.0], abs=1e-9)
    assert [v.in_path for v in cutter] == [False, True]
    drifted = replace(build("follow"), ego_lateral=((0.0, 0.9),))
    assert frame_truth(drifted, 0).vehicles[0].path_offset_m == pytest.approx(-0.9)


def test_share_of_a_plate_that_is_to_be_seen() -> None:
    def share(name: str, t_s: float, vehicle: str = "lead") -> float:
        (truth,) = [v for v in frame_truth(build(name), round(t_s * 30)).vehicles if v.name == vehicle]
        return truth.plate_visible

    assert share("hidden", 2.9) == 1.0
    assert share("hidden", 3.3) == 0.0  # a board before it
    assert share("parking", 0.0) == 1.0
    assert 0.5 < share("parking", 4.5) < 1.0  # 0.4 m away it is wider than the picture
    assert share("no-plate", 0.0) == 0.0
    assert share("cut-out", 0.0, "standing") == 0.0  # behind the lead
    assert share("cut-out", 4.2, "standing") == 1.0  # uncovered
    crest = [share("crest", t / 2) for t in range(18)]
    assert min(crest) == 0.0  # behind the top of the hill
    assert crest[0] == crest[-1] == 1.0


def test_a_disk_that_is_full_is_a_usage_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(made_by, "write_truth", full)
    with pytest.raises(UsageError, match="No space left"):
        simulate("approach", tmp_path / "a", max_frames=1)


@pytest.mark.parametrize(("name", "text"), list_scenarios())
def test_every_scenario_builds_and_has_a_line(name: str, text: str) -> None:
    try:
        scenario = build(name, seed=3)
    except InputMissingError as error:
        pytest.skip(str(error))
    assert scenario.frame_count > 10
    assert scenario.text == text != ""


def test_plates_of_another_standard_are_judged_from_the_same_distance_on() -> None:
    assert build("hidden").expectation.wide_px == 60.0
    assert build("hidden", plate="us-mi").expectation.wide_px == pytest.approx(60.0 * 304.8 / 520.0, rel=5e-3)


def test_unknown_scenario_is_a_usage_error_that_names_the_known() -> None:
    with pytest.raises(UsageError, match="approach"):
        build("nonsense")
