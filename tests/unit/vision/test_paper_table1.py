"""The paper's Table 1 from its own numbers: f = 83.92 px, H = 0.07 m, seven average heights, true distance 0.030 m."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tmde_edge.calibration.plate import PlateCalibration, PlatePose
from tmde_edge.calibration.quality import check_calibration, fatal
from tmde_edge.ranging.cues import Cue

HEIGHTS_PX = np.array([186.5, 177.1, 181.9, 182.3, 179.9, 186.9, 174.7])
FOCAL_PX, HEIGHT_M, TRUE_M = 83.92, 0.07, 0.030


def _distances_m() -> np.ndarray:
    """D = f H / h by the cue that ranges plates (lengths there are pixels over the focal length)."""
    cues = [Cue("char_height", float(h) / FOCAL_PX, 1.0 / FOCAL_PX, HEIGHT_M, 0.0) for h in HEIGHTS_PX]
    return np.array([c.distance_m for c in cues])


def test_distances_of_table_1():
    assert _distances_m() == pytest.approx([0.03150, 0.03317, 0.03230, 0.03222, 0.03265, 0.03143, 0.03363], abs=6e-6)


def test_statistics_of_table_1():
    d = _distances_m()
    assert d.mean() == pytest.approx(0.03241, abs=5e-6)
    assert d.std() == pytest.approx(0.00075, abs=5e-6)  # population: the sample's is 0.00081
    assert d.std() / d.mean() == pytest.approx(0.023, abs=5e-4)
    assert np.abs(d - TRUE_M).mean() == pytest.approx(0.00241, abs=5e-6)
    assert np.sqrt(((d - TRUE_M) ** 2).mean()) == pytest.approx(0.00253, abs=5e-6)


def test_the_mean_error_is_all_bias():
    """Every one of the seven is too far: an error of scale (8.0 %), which more frames do not average away."""
    d = _distances_m()
    assert (d > TRUE_M).all()
    assert np.abs(d - TRUE_M).mean() == pytest.approx(d.mean() - TRUE_M)


def test_sigma_of_one_range_is_the_papers():
    """sigma_D = D / h sigma_h."""
    cue = Cue("char_height", 180.0 / FOCAL_PX, 2.0 / FOCAL_PX, HEIGHT_M, 0.0)
    assert cue.sigma_m == pytest.approx(cue.distance_m / 180.0 * 2.0)


def test_a_calibration_with_the_papers_focal_length_is_refused():
    """At 1280 px it would be a field of view of 165 degrees (docs/paper.md)."""
    nothing_known = PlatePose(pitch_rad=None, pitch_sigma_rad=None, roll_rad=0.0, roll_sigma_rad=1.0, lens_above_plate_m=None)
    said = PlateCalibration(
        width_px=1280, height_px=720, f_px=FOCAL_PX, sigma=0.005, captures=(), residuals=(), offset_m=None, offset_sigma_m=None,
        trend_m=0.0, trend_sigma_m=1.0, pose=nothing_known,
    )
    assert "focal_range" in {p.kind for p in fatal(check_calibration(said))}
    assert "focal_range" not in {p.kind for p in check_calibration(replace(said, f_px=1000.0))}
