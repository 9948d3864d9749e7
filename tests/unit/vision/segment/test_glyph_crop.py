"""The canvas maps points exactly and shows what is there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.vision.segment.glyph_crop import (
    CANVAS_H_PX,
    CANVAS_W_PX,
    apply_affine,
    canvas_from_source,
    cut_canvas,
    invert_affine,
    normalise,
    spans_area,
)

reals = st.floats(-0.05, 0.05)


@settings(max_examples=60, deadline=None)
@given(
    width=st.floats(15, 600), aspect=st.floats(1.2, 6.0), angle=st.floats(-0.4, 0.4), x=st.floats(0, 1900), y=st.floats(0, 1000),
    wobble=st.lists(reals, min_size=8, max_size=8),
)
def test_map_inverts_and_keeps_the_plate_inside(
    width: float, aspect: float, angle: float, x: float, y: float, wobble: list[float]
) -> None:
    rotate = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    quad = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, width / 2 / aspect) @ rotate.T + (x, y)
    quad = quad + np.array(wobble).reshape(4, 2) * width / aspect
    forward = canvas_from_source(quad)
    np.testing.assert_allclose(apply_affine(invert_affine(forward), apply_affine(forward, quad)), quad, atol=1e-6)
    inside = apply_affine(forward, quad)
    assert (inside > 0).all()
    assert (inside < (CANVAS_W_PX - 1, CANVAS_H_PX - 1)).all()
    assert inside[1, 0] - inside[0, 0] > 0.6 * CANVAS_W_PX


@pytest.mark.parametrize("width", [40, 150, 420])
def test_edges_land_where_the_map_says(width: int) -> None:
    """A dark bar in the source, at any scale: its 50 % crossings lie on its mapped edges within 0.15 canvas pixels."""
    source = np.full((400, 800), 200, np.uint8)
    quad = np.array([[100, 80], [100 + width, 80], [100 + width, 80 + width / 3], [100, 80 + width / 3]], np.float64)
    left, right = 100 + round(0.3 * width), 100 + round(0.6 * width)
    source[:, left:right] = 40  # covers left - 0.5 .. right - 0.5 in pixel-centre coordinates
    forward = canvas_from_source(quad)
    row = cut_canvas(source, forward)[32].astype(float)
    edges = apply_affine(forward, np.array([[left - 0.5, 90.0], [right - 0.5, 90.0]]))[:, 0]
    dark = row < 120
    first, last = int(np.flatnonzero(dark)[0]), int(np.flatnonzero(dark)[-1])
    found = [
        first - 1 + (row[first - 1] - 120) / (row[first - 1] - row[first]),
        last + (120 - row[last]) / (row[last + 1] - row[last]),
    ]
    np.testing.assert_allclose(found, edges, atol=0.15)


def test_a_fine_pattern_is_averaged_not_aliased() -> None:
    source = (np.indices((900, 1600)).sum(axis=0) % 2 * 255).astype(np.uint8)
    quad = np.array([[100, 100], [1300, 100], [1300, 500], [100, 500]], np.float64)
    assert cut_canvas(source, canvas_from_source(quad)).std() < 12


def test_a_crop_over_the_image_border_repeats_the_border() -> None:
    source = np.full((50, 50), 77, np.uint8)
    quad = np.array([[-20, -5], [30, -5], [30, 10], [-20, 10]], np.float64)
    assert (cut_canvas(source, canvas_from_source(quad)) == 77).all()


def test_corners_without_area_are_refused() -> None:
    line = np.array([[0, 0], [10, 0], [10, 0], [0, 0]], np.float64)
    mirrored = np.array([[10, 0], [0, 0], [0, 5], [10, 5]], np.float64)
    for bad in (line, mirrored, np.full((4, 2), np.nan)):
        assert not spans_area(bad)
        with pytest.raises(ValueError, match="span no plate"):
            canvas_from_source(bad)


def test_normalise_removes_brightness_and_contrast() -> None:
    rng = np.random.default_rng(0)
    canvas = cv2.GaussianBlur(rng.uniform(60, 120, (CANVAS_H_PX, CANVAS_W_PX)).astype(np.uint8), (0, 0), 1)
    brighter = (canvas.astype(int) + 60).astype(np.uint8)
    first, second = normalise(np.stack([canvas, brighter]))
    np.testing.assert_allclose(first, second, atol=1e-4)
    assert first.shape == (1, CANVAS_H_PX, CANVAS_W_PX)
