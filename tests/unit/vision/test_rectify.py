"""Corner order and rectification."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.vision.rectify import (
    apply_homography,
    homography_source_from_rectified,
    is_convex,
    order_corners,
    rectify,
    rectify_grey,
    size_px,
    steadied,
    to_grey,
)

BOX = np.array([[10.0, 20.0], [110.0, 22.0], [108.0, 47.0], [9.0, 44.0]])


@given(
    st.permutations([0, 1, 2, 3]), st.floats(-0.6, 0.6), st.floats(1.3, 6.0), st.floats(20, 500), st.floats(-200, 2000),
    st.floats(-200, 2000),
)
def test_any_order_of_points_comes_back_as_tl_tr_br_bl(order, angle, aspect, width, x, y):
    half = np.array([[-1, -1 / aspect], [1, -1 / aspect], [1, 1 / aspect], [-1, 1 / aspect]]) * width / 2
    c, s = np.cos(angle), np.sin(angle)
    true = half @ np.array([[c, s], [-s, c]]) + (x, y)
    assert order_corners(true[list(order)]) == pytest.approx(true)


def test_points_without_area_are_refused():
    with pytest.raises(ValueError, match="convex"):
        order_corners(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    assert not is_convex(BOX[::-1])


@given(st.integers(8, 600), st.integers(8, 300))
def test_rectified_corners_lie_half_a_pixel_outside_the_corner_pixels(width, height):
    h = homography_source_from_rectified(BOX, width, height)
    flat = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])
    assert apply_homography(h, flat) == pytest.approx(BOX, abs=1e-3)


def test_rectify_reads_the_right_pixels():
    ramp = np.tile(np.arange(200, dtype=np.uint8), (80, 1))
    flat, h = rectify(ramp, np.array([[19.5, 9.5], [119.5, 9.5], [119.5, 59.5], [19.5, 59.5]]), 100, 50)
    assert flat[25, 10] == 30
    assert apply_homography(h, np.array([[10.0, 25.0]]))[0] == pytest.approx([30, 35], abs=1e-3)


def test_grey_and_colour_rectify_alike_at_the_edge_of_the_image():
    rng = np.random.default_rng(3)
    grey = rng.integers(0, 255, (60, 120), dtype=np.uint8)
    colour = np.repeat(grey[:, :, None], 3, axis=2)
    corners = np.array([[80.0, 30.0], [130.0, 32.0], [131.0, 70.0], [79.0, 68.0]])
    a, ha = rectify_grey(grey, corners, 60, 40)
    b, hb = rectify_grey(colour, corners, 60, 40)
    assert np.array_equal(a, b)
    assert np.array_equal(ha, hb)
    assert np.array_equal(to_grey(colour), grey)


def test_size():
    assert size_px(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 4.0], [0.0, 4.0]])) == (10.0, 4.0)


@given(st.floats(15, 600), st.floats(1.8, 5.0), st.integers(0, 99))
def test_steadied_corners_are_nearer_the_truth_and_large_plates_stay(width, aspect, seed):
    rng = np.random.default_rng(seed)
    half = np.array([[-1, -1 / aspect], [1, -1 / aspect], [1, 1 / aspect], [-1, 1 / aspect]]) * width / 2
    errors = []
    for _ in range(20):
        noisy = half + rng.normal(0, 1.0, (4, 2))
        better = steadied(noisy, 1.0)
        errors.append((np.square(better - half).sum(), np.square(noisy - half).sum()))
        assert better.mean(axis=0) == pytest.approx(noisy.mean(axis=0))
    assert np.mean(errors, axis=0)[0] <= np.mean(errors, axis=0)[1] + 1e-9
    assert steadied(half * 100, 0.1) == pytest.approx(half * 100, abs=0.01)
