"""The renderer's ink lies where the description says, to a tenth of a pixel."""

from __future__ import annotations

import string

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.simulation.plate_face import FaceSpec, GlyphSpec, Mark, face_alpha, render_face

CHARS = string.ascii_uppercase + string.digits + "-.Ö京あ"


def one_glyph(char: str, *, left: float, top: float, width: float, height: float, stroke: float) -> FaceSpec:
    glyph = GlyphSpec(char=char, left_mm=left, top_mm=top, width_mm=width, height_mm=height, stroke_mm=stroke)
    return FaceSpec(width_mm=100, height_mm=110, glyphs=(glyph,), background_bgr=(255, 255, 255), ink_bgr=(0, 0, 0))


def ink_box_px(face: np.ndarray) -> tuple[float, float, float, float]:
    """Left, top, right, bottom of the ink in the picture's continuous coordinates (pixel i covers i..i+1)."""
    cover = 1.0 - face[..., 0].astype(float) / 255.0
    cols, rows = cover.max(axis=0), cover.max(axis=1)

    def span(profile: np.ndarray) -> tuple[float, float]:
        full = np.flatnonzero(profile > 0.02)
        first, last = full[0], full[-1]
        return first + 1.0 - profile[first], last + profile[last]

    left, right = span(cols)
    top, bottom = span(rows)
    return left, top, right, bottom


@pytest.mark.parametrize("char", CHARS)
@pytest.mark.parametrize(("width", "height", "stroke"), [(44.53, 75.21, 10.0), (33.3, 63.5, 14.2), (50.0, 79.0, 6.0)])
def test_ink_fills_its_box_exactly(char: str, width: float, height: float, stroke: float) -> None:
    px_per_mm = 4.0
    face = render_face(one_glyph(char, left=-23.17, top=-31.06, width=width, height=height, stroke=stroke), px_per_mm)
    left, top, right, bottom = ink_box_px(face)
    expected = np.array([-23.17 + 50, -31.06 + 55, -23.17 + 50 + width, -31.06 + 55 + height]) * px_per_mm
    np.testing.assert_allclose([left, top, right, bottom], expected, atol=0.1)


@settings(max_examples=30, deadline=None)
@given(
    left=st.floats(-40, 0), top=st.floats(-40, -20), width=st.floats(20, 40), height=st.floats(40, 70),
    char=st.sampled_from("EHBD8"), px_per_mm=st.floats(1.0, 6.0),
)
def test_ink_box_at_any_scale(
    left: float, top: float, width: float, height: float, char: str, px_per_mm: float
) -> None:
    face = render_face(one_glyph(char, left=left, top=top, width=width, height=height, stroke=8), px_per_mm)
    expected = np.array([left + 50, top + 55, left + 50 + width, top + 55 + height]) * px_per_mm
    np.testing.assert_allclose(ink_box_px(face), expected, atol=0.1)


def test_stroke_width_is_the_stroke_of_the_description() -> None:
    face = render_face(one_glyph("H", left=-20, top=-30, width=40, height=60, stroke=9.3), 5.0)
    row = 1.0 - face[((55 - 30 + 10) * 5), :, 0] / 255.0
    assert row.sum() == pytest.approx(2 * 9.3 * 5, abs=0.2)


def test_size_and_position_of_the_first_pixel() -> None:
    spec = FaceSpec(
        width_mm=100, height_mm=50, glyphs=(), background_bgr=(200, 200, 200), ink_bgr=(0, 0, 0),
        marks=(Mark(kind="rect", left_mm=-50, top_mm=-25, width_mm=10, height_mm=50, colour_bgr=(255, 0, 0)),),
    )
    face = render_face(spec, 2.0)
    assert face.shape == (100, 200, 3)
    assert face.dtype == np.uint8
    assert (face[:, :20] == (255, 0, 0)).all()
    assert (face[:, 20:] == 200).all()


def test_border_is_a_frame_of_its_width_at_its_inset() -> None:
    spec = FaceSpec(
        width_mm=100, height_mm=60, glyphs=(), background_bgr=(255, 255, 255), ink_bgr=(0, 0, 0), border_mm=4,
        border_inset_mm=2,
    )
    middle = 1.0 - render_face(spec, 3.0)[90, :, 0] / 255.0
    assert middle[:6].max() == pytest.approx(0.0)
    assert middle[6:18].min() == pytest.approx(1.0)
    assert middle.sum() == pytest.approx(24, abs=0.1)


def test_marks_lie_under_or_over_the_characters() -> None:
    disc = {"left_mm": -10, "top_mm": -10, "width_mm": 20, "height_mm": 20, "colour_bgr": (0, 0, 255)}
    glyph = GlyphSpec(char="-", left_mm=-20, top_mm=-5, width_mm=40, height_mm=10, stroke_mm=10)
    for above, colour in ((False, (0, 0, 0)), (True, (0, 0, 255))):
        spec = FaceSpec(
            width_mm=60, height_mm=40, glyphs=(glyph,), background_bgr=(255, 255, 255), ink_bgr=(0, 0, 0),
            marks=(Mark(kind="disc", above=above, **disc),),  # type: ignore[arg-type]
        )
        assert tuple(render_face(spec, 2.0)[40, 60]) == colour


def test_alpha_cuts_only_the_corners() -> None:
    spec = one_glyph("A", left=0, top=0, width=20, height=30, stroke=5)
    alpha = face_alpha(spec, 3.0)
    assert alpha[0, 0] == 0.0
    assert alpha[0, 150] == 1.0
    assert alpha[150, 0] == 1.0
    assert alpha.mean() == pytest.approx(1 - (4 - np.pi) * 8**2 / (100 * 110), abs=2e-3)


def test_a_polygon_lies_where_its_points_say() -> None:
    mark = Mark(
        kind="poly", left_mm=10, top_mm=-20, width_mm=30, height_mm=24, colour_bgr=(0, 0, 0), points=((0, 0), (1, 0), (1, 1))
    )
    spec = FaceSpec(
        width_mm=100, height_mm=110, glyphs=(), background_bgr=(255, 255, 255), ink_bgr=(0, 0, 0), marks=(mark,)
    )
    cover = 1.0 - render_face(spec, 3.0)[..., 0].astype(float) / 255.0
    rows, cols = np.indices(cover.shape)
    x_mm, y_mm = ((i + 0.5) / 3.0 for i in (cols, rows))
    assert cover.sum() / 9 == pytest.approx(360, rel=0.04)  # mm^2
    assert (cover * (x_mm - 50)).sum() / cover.sum() == pytest.approx(30, abs=0.3)
    assert (cover * (y_mm - 55)).sum() / cover.sum() == pytest.approx(-12, abs=0.3)


def test_unknown_mark_kind_is_an_error() -> None:
    mark = Mark(kind="star", left_mm=0, top_mm=0, width_mm=1, height_mm=1, colour_bgr=(0, 0, 0))
    spec = FaceSpec(width_mm=10, height_mm=10, glyphs=(), background_bgr=(9, 9, 9), ink_bgr=(0, 0, 0), marks=(mark,))
    with pytest.raises(ValueError, match="star"):
        render_face(spec, 1.0)


@pytest.mark.parametrize("char", "O0S8BCG&")
def test_a_letter_no_wider_than_its_stroke_is_still_ink(char: str) -> None:
    face = render_face(one_glyph(char, left=-5, top=-30, width=8, height=60, stroke=8), 4.0)
    assert ink_box_px(face) == pytest.approx((180, 100, 212, 340), abs=0.2)
