"""Patches show what their frame says, at every scale; edges move by what the network says."""

from __future__ import annotations

import numpy as np
import pytest

from tmde_edge.vision.segment.glyph_decode import Glyph
from tmde_edge.vision.segment.refine_glyphs import GLYPH_H_PX, cut_patch, move_edges, patch_frame


def upright(left: float, top: float, width: float, height: float, angle: float = 0.0) -> Glyph:
    u, v = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    centre = np.array([left + width / 2, top + height / 2])
    return Glyph(
        left_px=centre - width / 2 * u, right_px=centre + width / 2 * u, top_px=centre - height / 2 * v,
        bottom_px=centre + height / 2 * v, score=1.0, main=True, row=0,
    )  # fmt: skip


@pytest.mark.parametrize("height", [6.0, 17.3, 30.0, 61.7, 140.0])
def test_a_bar_fills_its_box_on_the_patch_at_any_scale(height: float) -> None:
    """Edges of a soft dark bar cross half level on the patch where the frame puts the box, to a few hundredths of a pixel."""
    y = np.arange(300, dtype=float)
    top = 80.37
    cover = 1 / (1 + np.exp(-(y - top) / 0.4)) - 1 / (1 + np.exp(-(y - top - height) / 0.4))
    grey = np.repeat((200 - 150 * cover)[:, None], 300, axis=1).astype(np.uint8)
    frame = patch_frame(upright(120.0, top, 0.6 * height, height))
    assert frame is not None
    column = cut_patch(grey, frame)[:, 20].astype(float)
    dark = np.flatnonzero(column < 125)
    first, last = int(dark[0]), int(dark[-1])
    a = first - (125 - column[first]) / (column[first - 1] - column[first])
    b = last + (125 - column[last]) / (column[last + 1] - column[last])
    middle = (48 - 1) / 2
    assert (a, b) == pytest.approx((middle - GLYPH_H_PX / 2, middle + GLYPH_H_PX / 2), abs=0.08 + 0.03 * GLYPH_H_PX / height)


def test_edges_move_in_the_glyphs_own_directions() -> None:
    glyph = upright(50, 40, 12, 20, angle=0.2)
    frame = patch_frame(glyph)
    assert frame is not None
    per = 20 / GLYPH_H_PX
    moved = move_edges(glyph, frame, np.array([-1.0, 2.0, 3.0, -1.5], np.float32), np.log(np.full(4, 0.1, np.float32)))
    assert np.hypot(*(moved.right_px - moved.left_px)) == pytest.approx(12 + 3 * per, abs=1e-5)
    assert np.hypot(*(moved.bottom_px - moved.top_px)) == pytest.approx(20 - 4.5 * per, abs=1e-5)
    v = np.array([-np.sin(0.2), np.cos(0.2)])
    assert (moved.top_px - glyph.top_px) @ v == pytest.approx(3 * per, abs=1e-5)
    assert (moved.bottom_px - glyph.bottom_px) @ v == pytest.approx(-1.5 * per, abs=1e-5)
    assert moved.sigma_tb_px == pytest.approx(np.sqrt(2) * 0.1 * per, rel=1e-5)


def test_no_movement_leaves_the_glyph() -> None:
    glyph = upright(50, 40, 12, 20, angle=-0.1)
    frame = patch_frame(glyph)
    assert frame is not None
    same = move_edges(glyph, frame, np.zeros(4, np.float32), np.zeros(4, np.float32))
    for name in ("left_px", "right_px", "top_px", "bottom_px"):
        np.testing.assert_allclose(getattr(same, name), getattr(glyph, name), atol=1e-9)


def test_boxes_too_small_or_flat_have_no_frame() -> None:
    assert patch_frame(upright(50, 40, 12, 1.0)) is None
    flat = Glyph(
        left_px=np.array([0.0, 0.0]), right_px=np.array([0.0, 8.0]), top_px=np.array([0.0, 0.0]), bottom_px=np.array([0.0, 8.0]),
        score=1.0, main=True, row=0,
    )  # fmt: skip
    assert patch_frame(flat) is None


def test_a_patch_over_the_border_repeats_it() -> None:
    grey = np.full((30, 30), 90, np.uint8)
    frame = patch_frame(upright(-8, 20, 10, 18))
    assert frame is not None
    assert (cut_patch(grey, frame) == 90).all()


def test_output_that_is_not_finite_raises() -> None:
    glyph = upright(50, 40, 12, 20)
    frame = patch_frame(glyph)
    assert frame is not None
    with pytest.raises(ValueError, match="not finite"):
        move_edges(glyph, frame, np.array([0, np.nan, 0, 0], np.float32), np.zeros(4, np.float32))
