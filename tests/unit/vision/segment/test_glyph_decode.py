"""Maps painted from known characters decode to those characters, in source pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.vision.segment.glyph_crop import canvas_from_source, invert_affine
from tmde_edge.vision.segment.glyph_decode import BOX_SCALE_PX, STRIDE_X_PX, STRIDE_Y_PX, decode

ROWS, COLS = 16, 96
PLATE = np.array([[200.0, 300.0], [260.0, 303.0], [259.0, 317.0], [199.0, 314.0]])
CORNERS = np.array([[22.0, 14.0], [170.0, 14.0], [170.0, 49.0], [22.0, 49.0]], np.float32)
Box = tuple[float, float, float, float]  # left, right, top, bottom, canvas px


def paint(boxes: list[Box], small: list[bool] | None = None, scores: list[float] | None = None) -> np.ndarray:
    """A glyph map as a perfect network would draw it."""
    out = np.zeros((6, ROWS, COLS), np.float32)
    x = (np.arange(COLS) + 0.5) * STRIDE_X_PX - 0.5
    y = ((np.arange(ROWS) + 0.5) * STRIDE_Y_PX - 0.5)[:, None]
    heat = np.full((ROWS, COLS), 1e-4)
    for k, (left, right, top, bottom) in enumerate(boxes):
        near = np.exp(-0.5 * (((x - (left + right) / 2) / 2) ** 2 + ((y - (top + bottom) / 2) / 2.5) ** 2))
        near = near * (scores[k] if scores else 0.98)
        mine = near > heat
        heat = np.maximum(heat, near)
        values = (4.0 if small and small[k] else -4.0, x - left + 0 * y, right - x + 0 * y, y - top + 0 * x, bottom - y + 0 * x)
        for channel, value in enumerate(values, start=1):
            scaled = value if channel == 1 else value / BOX_SCALE_PX
            out[channel] = np.where(mine, scaled, out[channel])
    out[0] = np.log(heat / (1 - heat))
    return out


def row_of(
    count: int, *, left: float = 30.0, pitch: float = 15.0, width: float = 10.0, top: float = 22.0, height: float = 20.0
) -> list[Box]:
    return [(left + k * pitch, left + k * pitch + width, top, top + height) for k in range(count)]


TAIL = np.array([0.0, 0.0, 0.0, 0.0, 3.0, -2.0], np.float32)


@settings(max_examples=40, deadline=None)
@given(
    count=st.integers(3, 9), pitch=st.floats(12.5, 16), width=st.floats(5, 10), top=st.floats(16, 26), height=st.floats(14, 24),
    left=st.floats(24, 34),
)
def test_every_painted_character_comes_back_to_a_hundredth_pixel(
    count: int, pitch: float, width: float, top: float, height: float, left: float
) -> None:
    boxes = row_of(count, left=left, pitch=pitch, width=width, top=top, height=height)
    forward = canvas_from_source(PLATE)
    reading = decode(paint(boxes), CORNERS, TAIL, forward)
    assert reading.count == count
    back = invert_affine(forward)
    for glyph, (x0, x1, y0, y1) in zip(reading.glyphs, boxes, strict=True):
        centre_x, centre_y = (x0 + x1) / 2, (y0 + y1) / 2
        for found, point in (
            (glyph.left_px, (x0, centre_y)), (glyph.right_px, (x1, centre_y)), (glyph.top_px, (centre_x, y0)),
            (glyph.bottom_px, (centre_x, y1)),
        ):
            np.testing.assert_allclose(found, back[:, :2] @ np.array(point) + back[:, 2], atol=0.01)


def test_rows_are_numbered_from_above_and_read_from_the_left() -> None:
    upper, lower = row_of(3, top=12, height=16), row_of(4, top=34, height=16, left=34)
    reading = decode(paint(lower + upper), CORNERS, TAIL, canvas_from_source(PLATE))
    assert [g.row for g in reading.glyphs] == [0] * 3 + [1] * 4
    for row in (0, 1):
        xs = [g.left_px[0] for g in reading.glyphs if g.row == row]
        assert xs == sorted(xs)


def test_small_letters_on_one_line_stay_in_the_row_and_are_marked() -> None:
    boxes: list[Box] = [(30, 38, 26, 42), (44, 54, 21, 42), (58, 68, 21, 42), (72, 82, 21, 42)]
    boxes += [(88, 96, 26, 42), (100, 108, 26, 42), (130, 138, 18, 34)]
    small = [True, False, False, False, True, True, True]
    reading = decode(paint(boxes, small), CORNERS, TAIL, canvas_from_source(PLATE))
    assert [g.main for g in reading.glyphs] == [not s for s in small]
    assert {g.row for g in reading.glyphs} == {0}


def test_one_character_seen_twice_counts_once() -> None:
    boxes = row_of(6)
    double = [(boxes[2][0] + 2.4, boxes[2][1] + 2.6, boxes[2][2] + 4.2, boxes[2][3] + 4.0)]
    reading = decode(paint(boxes + double, scores=[0.95] * 6 + [0.6]), CORNERS, TAIL, canvas_from_source(PLATE))
    assert reading.count == 6


def test_a_faint_speck_is_no_character() -> None:
    reading = decode(paint([*row_of(6), (140, 146, 53, 58)], scores=[0.95] * 6 + [0.4]), CORNERS, TAIL, canvas_from_source(PLATE))
    assert reading.count == 6


def test_nothing_painted_is_no_character_but_still_a_reading() -> None:
    forward = canvas_from_source(PLATE)
    reading = decode(paint([]), CORNERS, TAIL, forward)
    assert reading.glyphs == ()
    assert reading.platehood == pytest.approx(1 / (1 + np.exp(-3.0)))
    assert not reading.light_on_dark
    back = invert_affine(forward)
    np.testing.assert_allclose(reading.corners_px, CORNERS @ back[:, :2].T + back[:, 2])
    assert reading.sigma_px.shape == (4,)
    assert (reading.sigma_px > 0).all()


@pytest.mark.parametrize("where", [0, 1, 2])
def test_outputs_that_are_not_finite_raise(where: int) -> None:
    outputs = [paint(row_of(5)), CORNERS.copy(), TAIL.copy()]
    outputs[where].flat[0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        decode(outputs[0], outputs[1], outputs[2], canvas_from_source(PLATE))
