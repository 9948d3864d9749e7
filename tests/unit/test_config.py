"""Configuration: defaults, overrides, and errors that say what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from tmde_edge.config import from_tree, load, to_tree
from tmde_edge.errors import ConfigError


def test_defaults_need_no_file() -> None:
    config = load(None)
    assert config.camera.camera() is None
    assert config.plates.expect == ["auto"]


def test_round_trip() -> None:
    config = load(None, ["camera.fx_px=1200", 'plates.expect=["de", "us-mi"]'])
    assert from_tree(to_tree(config), "again") == config


def test_overrides_are_toml_and_bare_words_are_strings() -> None:
    config = load(None, ["camera.fx_px=1200.5", "detector.kind=contour", "camera.distortion=[0.1,0,0,0]", "can.transmit=true"])
    camera = config.camera.camera()
    assert camera is not None
    assert camera.fx_px == camera.fy_px == 1200.5
    assert (camera.cx_px, camera.cy_px) == (639.5, 359.5)
    assert config.detector.kind == "contour"
    assert config.can.transmit


def test_overrides_win_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[camera]\nfx_px = 1000\nwidth_px = 640\n")
    config = load(file, ["camera.fx_px=1100"])
    assert (config.camera.fx_px, config.camera.width_px) == (1100, 640)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("[camera]\nfx_pix = 1000\n", ["camera.fx_pix", "did you mean camera.fx_px?"]),
        ("[camra]\nfx_px = 1000\n", ["camra", "did you mean camera?"]),
        ("[can.vehicle.speed]\nmesage = 'SPEED'\n", ["can.vehicle.speed.mesage", "message"]),
        ("[camera]\nfx_px = 'far'\n", ["camera.fx_px = 'far'", "float"]),
        ("[camera]\nfx_px = nan\n", ["camera.fx_px", "not a finite number"]),
        ("[camera]\ndistortion = [0.1, inf, 0, 0]\n", ["camera.distortion[1]", "not a finite number"]),
        ("[camera]\nfx_px = -5\n", ["camera.fx_px = -5"]),
        ("[camera]\nfy_px = 900\n", ["camera.fx_px", "calibrate"]),
        ("[camera]\nfx_px = 900\ndistortion = [0.1]\n", ["distortion has 1 values"]),
        ("[detector]\nkind = 'yolo'\n", ["detector.kind = 'yolo'"]),
        ("[detector]\nscore_min = 1.0\n", ["detector.score_min = 1.0", "< 1.0"]),
        ("[detector]\npermissive_score_min = 0\n", ["detector.permissive_score_min = 0", "> 0.0"]),
        ("[detector]\nstill_score_min = 0.0\n", ["detector.still_score_min = 0.0", "> 0.0"]),
        ("[detector]\nonnx_mean = [1.0, 2.0]\n", ["detector.onnx_mean has 2 values", "one a channel"]),
        ("[detector]\nonnx_format = 'yolo-corners'\nonnx_class = 1\n", ["onnx_class = 1", "onnx_classes = 1", "from 0"]),
        ("[alerts]\ncaution_ttc_s = 1.0\n", ["caution_ttc_s", "warning_ttc_s"]),
        ("[alerts]\nmax_ttc_s = 1.0\n", ["alerts.caution_ttc_s = 3.6", "alerts.max_ttc_s = 1.0", "raise it"]),
        ("[alerts]\ninactive_speed_mps = 9\n", ["alerts.inactive_speed_mps = 9", "alerts.active_speed_mps = 4.2"]),
        ("[alerts]\nhysteresis = 0.5\n", ["alerts.hysteresis = 0.5", ">= 1"]),
        ("[tracker]\npath_leave_m = 0.5\n", ["tracker.path_half_width_m = 1.1", "tracker.path_leave_m = 0.5"]),
        ("[tracker]\nstanding_half_width_m = 1.5\n", ["tracker.standing_half_width_m = 1.5", "tracker.standing_leave_m"]),
        ("[ranging]\nmax_distance_m = 0.1\n", ["ranging.min_distance_m = 0.15", "ranging.max_distance_m = 0.1"]),
        ("[can]\nlead_id = 0x6D0\n", ["can.alert_id", "can.lead_id", "0x6D0", "id of its own"]),
        ("[can]\nstatus_id = 0x6D1\n", ["can.lead_id", "can.status_id", "0x6D1"]),
        ("[camera\n", ["not TOML"]),
    ],
)
def test_errors_name_key_value_and_remedy(tmp_path: Path, text: str, parts: list[str]) -> None:
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as e:
        load(file)
    message = str(e.value)
    assert "\n" not in message
    assert str(file) in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize("text", ["camera.fx_px", "fx_px=3", "=3", "plates.expect=[de"])
def test_bad_overrides(text: str) -> None:
    with pytest.raises(ConfigError, match="--set"):
        load(None, [text])


def test_missing_file() -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load(Path("/nowhere/c.toml"))
