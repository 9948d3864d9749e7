"""calibrate as a user meets it: stills, video, prompts, check, priors, files; on small rendered captures with known f."""

from __future__ import annotations

import json
from datetime import datetime, timezone
from pathlib import Path

import cv2
import numpy as np
import pytest

from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.adapters.video_out import VideoWriter
from tmde_edge.app.calibrate_files import export_camera, read_camera, write_config
from tmde_edge.app.calibrate_sources import live_shots, still_stretches
from tmde_edge.app.eyes import Eyes
from tmde_edge.app.wiring import build_eyes
from tmde_edge.cli import main
from tmde_edge.config import from_tree, load
from tmde_edge.errors import ConfigError, InputDataError, InputMissingError
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.simulation.camera import hd_camera
from tmde_edge.simulation.stills import render_still

F = 700.0
CAMERA = hd_camera(F, 640, 360, height_m=0.9)
DISTANCES = (1.5, 2.5, 4.0)
PLATE = ["--standard", "de-mittel", "--plate-mm", "520x110", "--set", "runtime.threads=1"]
NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=timezone.utc)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [render_still(distance_m=d, yaw_rad=y, lateral_m=0.05, seed=3, camera=CAMERA, scenery=False).image
            for d, y in zip(DISTANCES, (0.1, -0.08, 0.05), strict=True)]  # fmt: skip


@pytest.fixture(scope="module")
def files(images: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("captures")
    for d, image in zip(DISTANCES, images, strict=True):
        cv2.imwrite(str(folder / f"{d}.png"), image)
    return [str(folder / f"{d}.png") for d in DISTANCES]


@pytest.fixture(scope="module")
def eyes() -> Eyes:
    return build_eyes(from_tree({"runtime": {"threads": 1}}, "test"), lambda: 0)


def test_stills_into_a_configuration_and_a_check(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "c.toml"
    text = "# my car\n[camera]\nwidth_px = 640  # small\nheight_px = 360\n\n[alerts]\nwarning_ttc_s = 2.0\n"
    file.write_text(text)
    base = ["calibrate", "-c", str(file), *PLATE]
    assert main([*base, "--images", *files, "--distances", *map(str, DISTANCES), "--camera-id", "bonnet"]) == 0
    new = load(file)
    assert new.camera.fx_px == pytest.approx(F, rel=0.01)
    assert abs((new.camera.fx_px or 0) / F - 1) < 2.5 * new.camera.focal_sigma
    assert "# my car" in file.read_text()
    assert "# small" in file.read_text()
    assert new.alerts.warning_ttc_s == 2.0
    record = new.camera.calibration
    assert record is not None
    assert (record.method, record.camera_id, record.distances_m, len(record.residuals)) == ("plate", "bonnet", [1.5, 2.5, 4.0], 3)
    (kept,) = tmp_path.glob("c.toml.bak-*")
    assert kept.read_text() == text
    assert "joint fit" in capsys.readouterr().err
    check = [*base, "--check", "--images", files[1]]
    assert main([*check, "--distances", "2.5"]) == 0
    assert capsys.readouterr().out.startswith("calibration check passed: measured 2.")
    assert main([*check, "--distances", "2.8"]) == 1
    assert "calibration check FAILED: measured 2." in capsys.readouterr().err


def test_bad_captures_change_nothing(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "c.toml"
    base = ["calibrate", "-c", str(file), *PLATE, "--images", *files]
    assert main([*base, "--distances", "1.8", "2.8", "4.3"]) == 1  # the tape began 30 cm behind the lens
    assert "behind the lens" in capsys.readouterr().err
    assert not file.exists()
    assert main([*base, "--distances", "1.8", "2.8", "4.3", "--fit-offset"]) == 0
    assert load(file).camera.fx_px == pytest.approx(F, rel=0.02)
    assert main([*base, "--distances", "2", "5"]) == 2
    assert "3 captures but 2 --distances" in capsys.readouterr().err
    assert main(["calibrate", "--images", *files, "--distances", "1", "2", "3"]) == 2
    assert "which plate is it?" in capsys.readouterr().err


def test_a_video_in_which_the_plate_stands_still(images: list[np.ndarray], tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "walk.mp4", 5.0) as video:
        for k in range(18):
            video.write(images[k // 6], round(k * 0.2e9))
    file = tmp_path / "c.toml"
    base = ["calibrate", "-c", str(file), *PLATE, "--video", str(tmp_path / "walk.mp4"), "-q"]
    assert main([*base, "--distances", "1.5", "2.5"]) == 1  # three stretches, two distances
    assert main([*base, "--distances", *map(str, DISTANCES)]) == 0
    assert load(file).camera.fx_px == pytest.approx(F, rel=0.015)


def test_still_stretches() -> None:
    t = np.arange(0, 9, 0.2)
    w = np.interp(t, [0, 2, 4, 6, 7, 9], [5.0, 5.0, 4.2, 4.2, 3.7, 3.7])
    found = still_stretches(t, w + 0.002 * np.sin(40 * t))
    assert [(round(float(t[a])), round(float(t[b - 1]))) for a, b in found] == [(0, 2), (4, 6), (7, 9)]
    assert still_stretches(t, 5 - 0.2 * t) == []


class Pictures:
    """A camera that shows one picture after another."""

    name, ended = "pictures", False

    def __init__(self, pictures: list[np.ndarray]) -> None:
        self.pictures, self.now, self.opened = pictures, -1, 0

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None:
        self.opened -= 1

    def read(self, timeout_s: float) -> Captured | None:
        picture = self.pictures[self.now]
        return Captured(t_ns=0, index=0, decode=lambda: picture)


def test_prompts(eyes: Eyes, images: list[np.ndarray]) -> None:
    camera = Pictures([*images, np.full((360, 640), 90, np.uint8)])
    answers = iter([(3, ""), (0, "nonsense"), (0, "1.5"), (1, ""), (2, "4"), (0, "")])
    told: list[str] = []

    def ask(prompt: str) -> str:
        camera.now, answer = next(answers)
        told.append(prompt)
        return answer

    shots = live_shots(eyes, camera, (2.0, 2.5, 5.0), ask, told.append)
    assert [s.distance_m for s in shots] == [1.5, 2.5, 4.0]
    assert camera.opened == 0
    assert any("not taken: the picture is black, white or empty" in t or "no plate" in t for t in told)
    assert any("'nonsense' is no distance" in t for t in told)
    assert told[-1].startswith("one more?")


def test_priors_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "c.toml"
    assert main(["calibrate", "-c", str(file), "--camera", "hq", "--lens-mm", "6"]) == 0
    camera = load(file).camera
    assert camera.calibration is not None
    assert (camera.prior, camera.lens_mm, camera.calibration.method) == ("hq", 6.0, "prior")
    pinhole = camera.camera()
    assert pinhole is not None
    assert pinhole.focal_sigma == 0.05
    assert main(["calibrate", "--camera", "list"]) == 0
    assert "pi-v3-wide" in capsys.readouterr().out
    assert main(["calibrate", "--camera", "imx296"]) == 78
    assert main(["calibrate", "--camera", "pi-v3", "--set", "camera.fx_px=900"]) == 2


def test_a_prior_s_five_per_cent_are_in_every_distance(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    size = ["--set", "camera.width_px=640", "--set", "camera.height_px=360", "--set", 'plates.expect=["de-mittel"]']
    ranges = []
    for camera in (["--set", "camera.prior=c920"], ["--set", "camera.fx_px=453.33"]):
        assert main(["measure", files[1], "--jsonl", "-", "-q", *size, *camera]) == 0
        ranges.append(json.loads(capsys.readouterr().out)["plates"][0])
    prior, calibrated = ranges
    assert prior["distance_m"] == pytest.approx(calibrated["distance_m"], rel=1e-3)
    expected = np.hypot(calibrated["sigma_m"], np.sqrt(0.05**2 - 0.005**2) * calibrated["distance_m"])
    assert prior["sigma_m"] == pytest.approx(expected, rel=1e-3)
    assert all(c["sigma_m"] >= 0.05 * c["distance_m"] for c in prior["cues"])


@pytest.mark.parametrize("kind", ["ros", "opencv"])
@pytest.mark.parametrize("lens", [(), (-0.25, 0.05, 0.001, -0.002, 0.01), (0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6)])
def test_other_programs_files_round_trip(kind: str, lens: tuple[float, ...], tmp_path: Path) -> None:
    camera = Camera(width_px=1280, height_px=720, fx_px=1158.76, fy_px=1154.06, cx_px=669.6, cy_px=388.2, distortion=lens)
    export_camera(tmp_path / "cam.yaml", camera, "front", kind)
    back, name = read_camera(tmp_path / "cam.yaml", camera.focal_sigma)
    assert back == camera
    assert name == ("front" if kind == "ros" else "")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image_width: 10\nimage_height: 10\n", "no camera_matrix"),
        ("a: [", "not YAML"),
        ("- 1\n", "not a camera_info"),
        ("image_width: 640\nimage_height: 480\ndistortion_model: equidistant\n", "equidistant"),
        ("image_width: 640\nimage_height: 480\ncamera_matrix: {data: [1, 0, 0, 0, .nan, 0, 0, 0, 1]}\n", "finite"),
        ("image_width: 640\nimage_height: 480\ncamera_matrix: {data: [a, b]}\n", "numbers"),
        ("%YAML:1.0\n---\nimage_width: 640\n", "no "),
        ("%YAML:1.0\n---\n]]]", "OpenCV cannot read it"),
    ],
)
def test_bad_files_are_one_clear_error(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "cam.yaml").write_text(text)
    with pytest.raises(InputDataError, match=message):
        read_camera(tmp_path / "cam.yaml", 0.005)
    with pytest.raises(InputMissingError):
        read_camera(tmp_path / "none.yaml", 0.005)


def test_a_broken_configuration_stays_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[camera\n")
    with pytest.raises(ConfigError):
        write_config(file, {"fx_px": 900.0}, NOW)
    file.write_text("camera = 5\n")
    with pytest.raises(ConfigError):
        write_config(file, {"fx_px": 900.0}, NOW)
    assert file.read_text() == "camera = 5\n"
    assert list(tmp_path.iterdir()) == [file]


def test_writing_twice_keeps_both_old_files(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    assert write_config(file, {"fx_px": 900.0, "calibration": {"method": "plate", "date": "x", "width_px": 1, "height_px": 1,
                                                               "sigma": 0.01}}, NOW) is None  # fmt: skip
    kept = write_config(file, {"fx_px": 901.0}, NOW.replace(second=6))
    assert kept is not None
    assert "900" in kept.read_text()
    assert load(file).camera.fx_px == 901.0
    assert load(file).camera.calibration is not None
