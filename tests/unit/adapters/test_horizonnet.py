"""The packaged horizon network: its contract, and that it finds the horizon of drawn roads without markings."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tmde_edge.adapters.detectors.horizonnet import MODEL_PATH, HorizonNet
from tmde_edge.errors import ModelError
from tmde_edge.simulation.camera import hd_camera, level_from_camera
from tmde_edge.simulation.ground import RoadStyle, horizon_row
from tmde_edge.simulation.scene import View, render
from tmde_edge.simulation.stills import flat_road, street


@pytest.fixture(scope="module")
def net() -> HorizonNet:
    return HorizonNet()


def test_size() -> None:
    assert MODEL_PATH.stat().st_size <= 1_000_000


def test_drawn_roads_without_markings(net: HorizonNet) -> None:
    """Pitch of +-2 deg about the expected horizon, no lane in sight: within 0.5 deg (rms), and the sigma says so."""
    error_deg, sigma_deg = [], []
    rng = np.random.default_rng(11)
    for k in range(12):
        camera = hd_camera(pitch_rad=0.02 + math.radians(float(rng.uniform(-2, 2))))
        style = RoadStyle(markings=(), skyline=("trees", "town", "hills")[k % 3], sky=("day", "overcast")[k % 2], seed=k % 4)
        view = View(camera, level_from_camera(camera.pitch_rad, 0.0))
        image = render(view, camera.pitch_rad, 0.0, flat_road(camera, 40.0 * k), style, [], street(rng, camera, style))
        seen = net.see(image, 1400.0, (639.5, 359.5 - 1400.0 * math.tan(0.02)))
        assert seen is not None
        error_deg.append(math.degrees((seen.vanishing_px[1] - horizon_row(camera, camera.pitch_rad)) / 1400.0))
        sigma_deg.append(math.degrees(seen.sigma_y_px / 1400.0))
    assert math.sqrt(np.mean(np.square(error_deg))) < 0.5
    assert np.mean(np.abs(error_deg) < 2.0 * np.array(sigma_deg)) >= 0.9


def test_grey_and_colour_agree(net: HorizonNet) -> None:
    grey = np.random.default_rng(0).integers(0, 256, (360, 640), np.uint8)
    a, b = net.see(grey, 700.0, None), net.see(np.repeat(grey[..., None], 3, axis=2), 700.0, None)
    assert (a is None) == (b is None)


def test_a_missing_or_foreign_file_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="missing"):
        HorizonNet(tmp_path / "no.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(ModelError, match="cannot load"):
        HorizonNet(tmp_path / "text.onnx")
    other = MODEL_PATH.with_name("platenet.onnx")
    with pytest.raises(ModelError, match="not a HorizonNet"):
        HorizonNet(other)
