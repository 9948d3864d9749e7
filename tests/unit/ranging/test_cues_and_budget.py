import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plate_scenes import CAMERA

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.plates.standard import load_standards, select
from tmde_edge.ranging import cues, fuse
from tmde_edge.ranging.budget import one_line, range_budget, reach_m

STANDARDS = load_standards()


def test_the_papers_table_1() -> None:
    """f = 83.92 px, H = 0.07 m and the seven average heights of the paper's Table 1; the camera stood at 0.030 m."""
    heights = np.array([186.5, 177.1, 181.9, 182.3, 179.9, 186.9, 174.7])
    d = np.array([cues.Cue("char_height", h / 83.92, 0.0, 0.07, 0.0).distance_m for h in heights])
    error = d - 0.030
    assert d.mean() == pytest.approx(0.03241, abs=5e-6)
    assert d.std() == pytest.approx(0.00075, abs=1e-5)
    assert d.std() / d.mean() == pytest.approx(0.023, abs=5e-4)
    assert np.abs(error).mean() == pytest.approx(0.00241, abs=5e-6)
    assert np.sqrt((error**2).mean()) == pytest.approx(0.00253, abs=1e-5)


@given(st.floats(0.5, 50), st.floats(0.01, 0.5), st.floats(0.001, 0.05))
def test_a_cues_sigma_is_its_distance_times_the_relative_errors(distance: float, size: float, relative: float) -> None:
    cue = cues.Cue("plate_width", size / distance, size / distance * relative, size, 0.0)
    assert cue.distance_m == pytest.approx(distance)
    assert cue.noise_m == pytest.approx(distance * relative)
    both = cues.Cue("plate_width", size / distance, size / distance * relative, size, size * relative)
    assert both.sigma_m == pytest.approx(distance * relative * 2**0.5)


@given(st.lists(st.tuples(st.floats(1, 100), st.floats(0.01, 5)), min_size=1, max_size=6))
def test_fusion_is_never_worse_than_its_best_cue_and_lies_between_them(items: list[tuple[float, float]]) -> None:
    d, s = zip(*items, strict=True)
    mean, sigma = fuse.inverse_variance(d, s)
    assert sigma <= min(s) * (1 + 1e-9)
    assert min(d) - 1e-9 <= mean <= max(d) + 1e-9


def test_a_mixture_of_distant_answers_is_wide() -> None:
    mean, sigma = fuse.mixture([1, 1], [9.0, 11.0], [0.1, 0.1])
    assert mean == pytest.approx(10)
    assert sigma == pytest.approx(np.hypot(1.0, 0.1))


def test_the_budget_grows_with_distance_and_ends_with_a_reason() -> None:
    rows = range_budget(CAMERA, select(["de-1line"]))
    known = [r for r in rows if r.sigma_m is not None]
    assert len(known) >= 5
    relative = [r.sigma_m / r.distance_m for r in known if r.sigma_m is not None]
    assert relative == sorted(relative)
    assert 0.005 < relative[0] < 0.02
    assert {"char_height", "plate_width"} <= {c.cue for c in known[0].cues}
    assert rows[-1].sigma_m is None
    assert rows[-1].reason
    assert rows[4].plate_width_px == pytest.approx(1400 * 0.520 / rows[4].distance_m, rel=1e-6)


def test_twice_the_focal_length_reaches_twice_as_far() -> None:
    tele = Camera(width_px=1920, height_px=1080, fx_px=2800, fy_px=2800, cx_px=959.5, cy_px=539.5)
    wide, far = reach_m(CAMERA, select(["us-mi"])), reach_m(tele, select(["us-mi"]))
    assert 15 < wide < 45
    assert far == pytest.approx(2 * wide, rel=0.02)


def test_the_start_up_line_names_standard_and_reach() -> None:
    line = one_line(CAMERA, select(["us-mi"]))
    assert "us-mi" in line
    assert "at 10 m" in line
    assert f"no range beyond {reach_m(CAMERA, select(['us-mi'])):g} m" in line


def test_a_cue_without_a_true_size_is_absent() -> None:
    rows = range_budget(CAMERA, [STANDARDS["it-rear"]], distances_m=(5.0,))
    assert {c.cue for c in rows[0].cues} == {"plate_width", "plate_height"}
