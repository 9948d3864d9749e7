"""Edges of characters by half contrast, where their neighbours are near."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tmde_edge.vision.segment.measure import box_edges

BARS = ((30, 60), (66, 96), (102, 132), (170, 200))  # the last one stands free


def _row(blur_px):
    """Four bars 60 high on paper, three of them with gaps of 6 px."""
    flat = np.full((100, 240), 230, np.uint8)
    for left, right in BARS:
        flat[20:80, left:right] = 30
    boxes = np.array([(a - 0.5, 19.5, b - 0.5, 79.5) for a, b in BARS])
    return cv2.GaussianBlur(flat, (0, 0), blur_px), boxes


@pytest.mark.parametrize("blur_px", [1.0, 2.5, 3.2])
def test_a_gap_that_blur_has_filled_moves_no_character_from_its_neighbour(blur_px):
    flat, true = _row(blur_px)
    edges, _ = box_edges(flat, true + np.array([0.8, 0.5, -0.8, -0.5]), light_on_dark=False)
    centres, expected = edges[:, [0, 2]].mean(axis=1), true[:, [0, 2]].mean(axis=1)
    assert np.abs(centres - expected).max() < 0.6
    assert np.abs(edges[:, [1, 3]] - true[:, [1, 3]]).max() < 0.3


def test_a_flat_picture_leaves_the_boxes_where_they_are():
    _, boxes = _row(1.0)
    edges, sigma = box_edges(np.full((100, 240), 128, np.uint8), boxes, light_on_dark=False)
    assert np.array_equal(edges, boxes)
    assert sigma == pytest.approx(1.0)
