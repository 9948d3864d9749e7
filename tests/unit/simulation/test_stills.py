"""Stills carry their own exact truth."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tmde_edge.errors import UsageError
from tmde_edge.plates.standard import load_standards
from tmde_edge.simulation.camera import hd_camera
from tmde_edge.simulation.standard_face import standard_face
from tmde_edge.simulation.stills import calibration_captures, render_still

SMALL = hd_camera(700.0, 640, 360, height_m=1.3)


def test_width_asked_for_is_the_width_of_the_plate() -> None:
    still = render_still(width_px=60.0, seed=4, camera=SMALL)
    assert still.width_px == pytest.approx(60.0, rel=1e-6)
    assert still.distance_m == pytest.approx(700 * 0.52 / 60.0)
    assert still.image.shape == (360, 640, 3)
    assert still.char_height_px == pytest.approx(700 * 0.075 / still.distance_m, rel=1e-6)
    assert len(still.glyph_boxes_px) == len(still.face.spec.glyphs) == 7


def test_distance_is_along_the_vehicle_s_axis_also_for_a_pitched_camera() -> None:
    still = render_still(
        distance_m=10.0, camera=replace(SMALL, pitch_rad=0.05), lateral_m=0.5, yaw_rad=0.2, seed=4, scenery=False
    )
    assert still.centre_m == pytest.approx([0.5, still.centre_m[1], 10.0])
    middle = still.corners_px.mean(axis=0)
    assert middle[0] == pytest.approx(still.view.project(still.centre_m[None])[0, 0], abs=0.6)


def test_same_seed_same_picture_and_another_seed_another() -> None:
    a, b, c = (render_still(width_px=40.0, seed=s, scenery=False, camera=SMALL) for s in (4, 4, 6))
    assert (a.image == b.image).all()
    assert (a.image != c.image).any()


def test_either_distance_or_width() -> None:
    with pytest.raises(ValueError, match="exactly one"):
        render_still(width_px=40.0, distance_m=3.0)


def test_calibration_captures_stand_at_their_distances() -> None:
    captures = calibration_captures((2.0, 5.0), seed=3, reference_offset_m=0.1, camera=SMALL)
    assert [c.distance_m for c in captures] == pytest.approx([2.1, 5.1])
    assert all(abs(c.yaw_rad) <= 0.17 and abs(c.tilt_rad) <= 0.17 for c in captures)


@pytest.mark.parametrize("name", sorted(load_standards()))
def test_faces_have_the_standard_s_own_sizes(name: str) -> None:
    standard = load_standards()[name]
    face = standard_face(name)
    if standard.plate_width is not None and standard.plate_width.mm is not None:
        assert face.spec.width_mm == standard.plate_width.mm
    height = standard.main_class.height
    if height is not None:
        assert face.main_height_mm == pytest.approx(height.belief("glyph_height")[0])
    assert len(face.spec.glyphs) in standard.char_counts
    half_w, half_h = face.spec.width_mm / 2, face.spec.height_mm / 2
    for glyph in face.spec.glyphs:
        assert -half_w < glyph.left_mm
        assert glyph.left_mm + glyph.width_mm < half_w
        assert -half_h < glyph.top_mm
        assert glyph.top_mm + glyph.height_mm < half_h
    edges = sorted((g.row, g.left_mm, g.left_mm + g.width_mm) for g in face.spec.glyphs)
    for a, b in pairwise(edges):
        assert a[0] != b[0] or a[2] < b[1], "characters overlap"


def test_drawn_sizes_stay_within_the_law() -> None:
    heights = [standard_face("de-mittel", seed=s).main_height_mm for s in range(30)]
    assert min(heights) >= 74
    assert max(heights) <= 77
    assert np.std(heights) > 0.2


def test_bolts_stand_on_their_holes_and_play_in_them_where_sizes_are_drawn() -> None:
    def apart_mm(seed: int | None) -> list[float]:
        marks = standard_face("us-mi", seed=seed).spec.marks
        left_up, left_low, right_up, right_low = (m.left_mm for m in marks if m.kind == "disc")
        return [right_up - left_up, right_low - left_low]

    assert apart_mm(None) == pytest.approx([177.8, 177.8])
    drawn = np.array([apart_mm(s) for s in range(200)])
    assert drawn.mean(axis=0) == pytest.approx([177.8, 177.8], abs=0.6)
    assert drawn.std(axis=0) == pytest.approx([2.55, 2.55], rel=0.2)  # 2 x (1.5^2 + 1.0^2)
    assert np.corrcoef(drawn.T)[0, 1] == pytest.approx(0.69, abs=0.15)


def test_russian_plate_has_two_heights_and_the_digits_are_main() -> None:
    face = standard_face("ru-1")
    assert face.main_height_mm == 76
    assert {g.height_mm for g, m in zip(face.spec.glyphs, face.main, strict=True) if not m} == {58}


def test_unknown_standard_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="xx"):
        standard_face("xx")
