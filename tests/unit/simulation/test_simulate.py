"""`simulate`: the files fit each other, are the same for the same seed, and are read back by our own code."""

from __future__ import annotations

import csv
from pathlib import Path

import av
import numpy as np
import pytest

from tmde_edge import config
from tmde_edge.app.simulate import Made, can_lines, list_scenarios, simulate
from tmde_edge.errors import InputMissingError, UsageError
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
    assert float(row["ttc_s"]) == pytest.approx(float(row["gap_m"]) / -float(row["range_rate_mps"]), abs=1e-4)


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


@pytest.mark.parametrize(("name", "text"), list_scenarios())
def test_every_scenario_builds_and_has_a_line(name: str, text: str) -> None:
    try:
        scenario = build(name, seed=3)
    except InputMissingError as error:
        pytest.skip(str(error))
    assert scenario.frame_count > 10
    assert scenario.text == text != ""


def test_unknown_scenario_is_a_usage_error_that_names_the_known() -> None:
    with pytest.raises(UsageError, match="approach"):
        build("nonsense")
