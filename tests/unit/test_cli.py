"""The command line's promises: exit codes, one-line errors, JSON lines that are nothing but JSON."""

from __future__ import annotations

import errno
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tmde_edge.adapters.cameras.sources import open_source
from tmde_edge.app.drive_log import DriveLogReader, DriveLogWriter
from tmde_edge.cli import main
from tmde_edge.messages import Sighting


@pytest.fixture
def street(tmp_path: Path) -> Path:
    """A folder of three textured pictures without a plate, a text file and a broken image."""
    folder = tmp_path / "street"
    folder.mkdir()
    rng = np.random.default_rng(0)
    base = cv2.GaussianBlur(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8), (0, 0), 5)
    for k in range(3):
        cv2.imwrite(str(folder / f"{k:03}.png"), np.roll(base, 2 * k, axis=1))
    (folder / "notes.txt").write_text("not an image")
    return folder


def run(capsys: pytest.CaptureFixture[str], *args: str) -> tuple[int, str, str]:
    try:
        code = main(list(args))
    except SystemExit as e:  # argparse
        code = int(e.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def bad(tmp_path: Path, name: str, text: bytes) -> str:
    (tmp_path / name).write_bytes(text)
    return str(tmp_path / name)


DBC = '[can.vehicle]\ndbc = "car.dbc"\nspeed = {message = "SPEED", signal = "SPEED", unit = "km/h"}\n'


@pytest.mark.parametrize(
    ("what", "code", "says"),
    [
        ("missing file", 66, "no such file"),
        ("empty folder", 66, "no images"),
        ("corrupt video", 65, "bad.mp4"),
        ("wrong config key", 78, "did you mean camera.fx_px"),
        ("wrong type", 78, "camera.fx_px = 'far'"),
        ("NaN in config", 78, "not a finite number"),
        ("unknown plate", 78, "atlantis"),
        ("missing DBC", 78, "car.dbc"),
        ("unreadable DBC", 78, "car.dbc"),
        ("no pipeline", 78, "camera.pipeline"),
        ("no detector file", 69, "detector.onnx_path"),
        ("CAN log of another format", 65, "x.log"),
        ("missing CAN log", 66, "nowhere.log"),
        ("missing truth", 66, "nowhere.csv"),
        ("bad --fps", 2, "--fps"),
        ("offset without log", 2, "--can-offset"),
        ("log without configuration", 65, "carries no configuration"),
        ("calibration that cannot be read", 65, "cannot be read (Input/output error)"),
    ],
)
def test_bad_input_is_one_line_and_the_right_code(
    what: str, code: int, says: str, tmp_path: Path, street: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    (tmp_path / "empty").mkdir()
    dry = ["--dry-run", str(street), "-q"]
    config = str(tmp_path / "c.toml")
    Path(config).write_text(DBC)
    DriveLogWriter(tmp_path / "d.mcap", {}).close()
    monkeypatch.setattr(Path, "read_text", _refusing(Path.read_text, "cam.yaml"))
    args = {
        "missing file": ["--dry-run", str(tmp_path / "no.mp4")],
        "empty folder": ["--dry-run", str(tmp_path / "empty")],
        "corrupt video": ["--dry-run", bad(tmp_path, "bad.mp4", b"\x00\x01not a video" * 50)],
        "wrong config key": [*dry, "--set", "camera.fx_pix=900"],
        "wrong type": [*dry, "--set", "camera.fx_px='far'"],
        "NaN in config": [*dry, "--set", "camera.fx_px=nan"],
        "unknown plate": [*dry, "--set", 'plates.expect=["atlantis"]'],
        "missing DBC": ["check-config", "-c", config],
        "unreadable DBC": ["check-config", "-c", config],
        "no pipeline": ["check-config", "--set", "camera.kind=gstreamer"],
        "no detector file": ["check-config", "--set", "detector.kind=onnx"],
        "CAN log of another format": [*dry, "--can-log", bad(tmp_path, "x.log", b"time,id,data\n1,2,3\n")],
        "missing CAN log": [*dry, "--can-log", str(tmp_path / "nowhere.log")],
        "missing truth": [*dry, "--truth", str(tmp_path / "nowhere.csv")],
        "bad --fps": [*dry, "--fps", "0"],
        "offset without log": [*dry, "--can-offset", "1"],
        "log without configuration": ["replay", str(tmp_path / "d.mcap")],
        "calibration that cannot be read": ["calibrate", "--import", bad(tmp_path, "cam.yaml", b"x: 1")],
    }[what]
    if what == "unreadable DBC":
        bad(tmp_path, "car.dbc", b"\x00\xff this is no DBC \xfe")
    got, out, err = run(capsys, *args)
    assert got == code, err
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    assert says in err
    assert "Traceback" not in err


def test_a_known_camera_is_not_said_to_be_uncalibrated(capsys: pytest.CaptureFixture[str]) -> None:
    _, _, err = run(capsys, "check-config", "--set", 'camera.prior="pi-v3"')
    assert "f = 940 px by its data sheet, +- 5%" in err
    assert "distances stay null" not in err
    assert "distances stay null" in run(capsys, "check-config")[2]


def _refusing(read: Callable[..., str], name: str) -> Callable[..., str]:
    def reads(path: Path, *args: object, **more: object) -> str:
        if path.name == name:
            raise OSError(errno.EIO, "Input/output error")
        return read(path, *args, **more)

    return reads


def test_wrong_usage_is_2(capsys: pytest.CaptureFixture[str], street: Path) -> None:
    for number in ("nan", "-inf", "1e999"):
        code, _, err = run(capsys, "--dry-run", str(street), "--can-log", "x.log", f"--can-offset={number}")
        assert code == 2
        assert f"--can-offset: invalid number value: '{number}'" in err
    code, _, err = run(capsys, "calibrate", "--check", str(street / "000.png"), "--distances", "3", "--tolerance", "nan")
    assert code == 2
    assert "--tolerance: invalid number value" in err
    assert run(capsys, "--no-such-option")[0] == 2
    assert run(capsys, "--dry-run", str(street), "measure", "x.png")[0] == 2
    assert run(capsys, "simulate")[0] == 2
    for wrong in (["--seed", "-1"], ["--check", "--seeds", "0"], ["--check", "--seeds", "-2"], ["--seed", "one"]):
        code, _, err = run(capsys, "simulate", "approach", "--out", str(street / "no"), *wrong)
        assert code == 2
        assert f"{wrong[-1]!r} is not a whole number from" in err
    assert run(capsys, "evaluate", str(street), "--seed", "-1")[0] == 2
    for how in ([], ["--no-pictures"], ["--no-video"]):
        code, _, err = run(capsys, "simulate", "parking", "--check", "--out", str(street / "notes.txt" / "x"), *how)
        assert (code, "cannot be" in err) == (2, True)


def test_dry_run_writes_only_json_lines_to_stdout(capsys: pytest.CaptureFixture[str], street: Path) -> None:
    (street / "001.png").write_bytes(b"broken")
    code, out, _ = run(capsys, "--dry-run", str(street), "--fps", "10", "--jsonl", "-", "--set", "runtime.threads=1")
    records = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert [r["frame"] for r in records] == [0, 1, 2]
    assert [r["t"] for r in records] == [0.0, 0.1, 0.2]
    assert "error" in records[1]
    for r in (records[0], records[2]):
        assert set(r) >= {"plates", "lead", "ego", "pose", "depth", "alert", "faults", "mode", "timing_ms"}
        assert r["plates"] == []
        assert "uncalibrated" in r["faults"]
        assert r["alert"]["level"] == "none"


def test_sizes_that_do_not_fit_the_calibration_are_error_records(capsys: pytest.CaptureFixture[str], street: Path) -> None:
    cv2.imwrite(str(street / "001.png"), np.full((200, 320, 3), 90, np.uint8))
    fits = ["--set", "camera.fx_px=900", "--set", "camera.width_px=640", "--set", "camera.height_px=480"]
    code, out, _ = run(capsys, "measure", str(street), "--jsonl", "-", *fits)
    records = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert ["error" in r for r in records] == [False, True, False]
    assert "320x200" in records[1]["error"]


def test_a_recording_that_fits_nowhere_is_an_error_not_an_empty_road(capsys: pytest.CaptureFixture[str], street: Path) -> None:
    wide = ["--set", "camera.fx_px=900", "--set", "camera.width_px=1280", "--set", "camera.height_px=720"]
    code, out, err = run(capsys, "--dry-run", str(street), "--jsonl", "-", "-q", *wide)
    assert code == 65
    assert ["error" in json.loads(line) for line in out.splitlines()] == [True] * 3
    assert err.count("\n") == 1
    assert "not one frame could be used: image 320x240 does not fit the calibration 1280x720" in err


def test_what_was_made_before_an_error_stays_whole(capsys: pytest.CaptureFixture[str], street: Path, tmp_path: Path) -> None:
    log = bad(tmp_path, "x.log", b"(0000000000.000000) can0 0B4#00\n(0000000000.010000) can0 0B4#00\nnothing\n")
    (street / "003.png").write_bytes((street / "000.png").read_bytes())
    video, report, drive = tmp_path / "v.mp4", tmp_path / "report", tmp_path / "d.mcap"
    outputs = ["--video-out", str(video), "--report", str(report), "--record", str(drive), "--can-out", str(tmp_path / "out.log")]
    code, _, err = run(capsys, "--dry-run", str(street), "--fps", "100", "--can-log", log, "-q", *outputs)
    assert code == 65
    assert "line 3" in err
    assert [item.t_ns for item in open_source(str(video))] == [0]
    assert "<html" in (report / "index.html").read_text()
    assert len((report / "records.jsonl").read_text().splitlines()) == 1
    assert any(isinstance(e.event, Sighting) for e in DriveLogReader(drive).entries())


@pytest.mark.parametrize("option", ["--jsonl", "--can-out", "--record", "--video-out"])
def test_a_full_disk_is_one_line_that_names_its_own_output(
    capsys: pytest.CaptureFixture[str], street: Path, tmp_path: Path, option: str
) -> None:
    full = tmp_path / "full"
    full.symlink_to("/dev/full")
    others = [] if option == "--jsonl" else ["--jsonl", str(tmp_path / "a.jsonl")]
    code, _, err = run(capsys, "--dry-run", str(street), "-q", "--set", "can.transmit=true", *others, option, str(full))
    assert code == (74 if option == "--can-out" else 2)
    assert err.count("\n") == 1
    assert f"{full}: cannot be written (No space left on device)" in err


def test_measure_exits_65_only_when_nothing_could_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "measure", bad(tmp_path, "a.png", b"no"), bad(tmp_path, "b.png", b"no"), "-q")
    assert code == 65
    assert "none of 2 images" in err


def test_two_dry_runs_are_identical_but_for_timing(capsys: pytest.CaptureFixture[str], street: Path) -> None:
    def once() -> list[dict[str, object]]:
        _, out, _ = run(capsys, "--dry-run", str(street), "--jsonl", "-")
        records = [json.loads(line) for line in out.splitlines()]
        for r in records:
            del r["timing_ms"]
        return records

    assert once() == once()


def test_recorded_dry_run_replays_identically(capsys: pytest.CaptureFixture[str], street: Path, tmp_path: Path) -> None:
    log = tmp_path / "drive.mcap"
    assert run(capsys, "--dry-run", str(street), "--record", str(log), "-q")[0] == 0
    code, _, err = run(capsys, "replay", str(log))
    assert code == 0
    assert "identical" in err


def test_plates_list_names_every_standard(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "plates", "list")
    assert code == 0
    assert len(out.splitlines()) >= 50
    assert "de-mittel" in out


def test_check_config_says_what_it_read_of_the_dbc(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "car.dbc").write_text(
        'VERSION ""\nBU_: A\nBO_ 180 SPEED: 8 A\n SG_ SPEED : 47|16@0+ (0.01,0) [0|250] "km/h" A\n\nBO_ 36 YAW: 8 A\n'
        ' SG_ YAW : 7|10@0+ (0.244,-125) [0|250] "deg/s" A\n\nBO_ 99 OTHER: 8 A\n SG_ X : 7|8@0+ (1,0) [0|1] "" A\n'
    )
    config = tmp_path / "c.toml"
    config.write_text('[can.vehicle]\ndbc = "car.dbc"\nspeed = { message = "SPEED", signal = "SPEED", unit = "km/h" }\n')
    code, out, err = run(capsys, "check-config", "-c", str(config))
    assert code == 0, err
    assert "car.dbc: 1 of 3 messages read" in out + err


def test_udp_multicast_without_its_package_is_a_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "msgpack" else find(name, *a))
    config = tmp_path / "c.toml"
    config.write_text('[can]\ninterface = "udp_multicast"\nchannel = "239.0.0.1"\n')
    code, _, err = run(capsys, "check-config", "-c", str(config))
    assert code == 78
    assert "tmde-edge[udp]" in err


def test_a_configuration_that_simulate_would_not_use_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "stopped", "--check", "-c", str(tmp_path / "mine.toml")]) == 2
    assert "--set" in capsys.readouterr().err
