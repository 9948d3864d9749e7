"""The paper's Table 1 from its own numbers: f = 83.92 px, H = 0.07 m, seven average heights, true distance 0.030 m."""

from __future__ import annotations

import numpy as np
import pytest

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


def test_the_focal_length_of_the_paper_is_none_of_a_camera():
    """83.92 px would see 1280 px of image through 165 degrees; a lens of 65 degrees has 1000 px."""
    assert 2 * np.degrees(np.arctan(640 / FOCAL_PX)) == pytest.approx(165, abs=1)
