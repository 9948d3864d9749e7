"""The depth network's plumbing on a graph of MiDaS v2.1 small's size and contract with random weights: never accuracy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tmde_edge.adapters.depth.manifest import ModelSpec
from tmde_edge.adapters.depth.onnx_depth import OnnxDepth
from tmde_edge.app.quantize import calibration_frames, quantize_model
from tmde_edge.messages import Frame

SHARED = Path(os.environ.get("TMDE_SHARED", Path(__file__).resolve().parents[3] / "shared"))
pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def standin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tool = SHARED / "tools" / "midas_standin.py"
    if not tool.is_file():
        pytest.skip(f"{tool} is not there: no stand-in for MiDaS")
    pytest.importorskip("onnx", reason="the package onnx (an extra) is not installed")
    path = tmp_path_factory.mktemp("midas") / "standin.onnx"
    subprocess.run([sys.executable, str(tool), str(path)], check=True, capture_output=True)
    return path


def test_contract_and_one_reading(standin: Path) -> None:
    network = OnnxDepth(ModelSpec(name="midas", file=standin.name), standin)
    image = np.random.default_rng(0).integers(0, 256, (720, 1280, 3)).astype(np.uint8)
    reading = network.infer(Frame(t_ns=1, index=0, image=image))
    assert (reading.grid_columns, reading.grid_rows) == (64, 48)
    assert np.isfinite(reading.inverse_depth).all()
    assert np.ptp(reading.inverse_depth) > 0


def test_int8_is_small_fast_and_judged(standin: Path) -> None:
    """Random weights amplify rounding, so the bar on agreement is put aside; size, speed and the judgement are real."""
    images = SHARED / "data" / "roads" / "test_images"
    if not images.is_dir():
        pytest.skip(f"{images} is not there: no calibration frames")
    made = quantize_model(
        str(standin), standin.parent, calibration_frames([str(images)], 8), min_correlation=0.5, max_relative_difference=1.0
    )
    assert made.bytes < 20_000_000
    assert made.agreement.int8_ms <= 0.6 * made.agreement.float_ms
    assert 0.5 < made.agreement.correlation < 1.0
