"""Lucas-Kanade tracking: place, growth and their sigmas against a known warp."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import plate_still

from tmde_edge.vision.flow import fit_similarity, follow, follow_rear, grow, make_template
from tmde_edge.vision.settings import FlowSettings

FLOW = FlowSettings()


@given(st.floats(0.8, 1.25), st.floats(-0.3, 0.3), st.floats(-40, 40), st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_similarity_survives_a_third_of_wild_points(scale, angle, shift, seed):
    rng = np.random.default_rng(seed)
    p = rng.uniform(0, 100, (30, 2))
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    q = p @ np.array([[c, s], [-s, c]]) + shift + rng.normal(0, 0.02, p.shape)
    q[:9] += rng.uniform(5, 30, (9, 2))
    fit = fit_similarity(p, q, 0.01)
    assert fit is not None
    assert fit.ratio == pytest.approx(scale, abs=0.003)


def test_no_fit_from_too_few_or_disagreeing_points():
    rng = np.random.default_rng(0)
    assert fit_similarity(np.zeros((2, 2)), np.ones((2, 2)), 0.01) is None
    assert fit_similarity(np.zeros((5, 2)), np.zeros((5, 2)), 0.01) is None
    wild = fit_similarity(rng.uniform(0, 100, (40, 2)), rng.uniform(0, 100, (40, 2)), 0.01)
    assert wild is None or wild.residual_px > 5


@pytest.mark.parametrize("width_px", [30, 90, 400])
def test_growth_and_place_of_a_warped_frame(width_px):
    dense, sigmas = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        still = plate_still("us-mi", width_px, seed=seed)
        k, centre, shift = 1 + rng.uniform(-0.04, 0.04), still.corners_px.mean(axis=0), rng.uniform(-5, 5, 2)
        warp = np.array([[k, 0, centre[0] * (1 - k) + shift[0]], [0, k, centre[1] * (1 - k) + shift[1]]])
        size = (still.image.shape[1], still.image.shape[0])
        later = cv2.warpAffine(still.image, warp, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        now, then = (
            np.clip(i + rng.normal(0, 2, i.shape), 0, 255).astype(np.uint8) for i in (later, still.image)
        )
        template = make_template(then, still.corners_px, FLOW)
        assert template is not None
        step = follow(template, now, still.corners_px, FLOW)
        assert step is not None
        true = still.corners_px @ warp[:, :2].T + warp[:, 2]
        assert np.abs(step.corners_px - true).max() < max(0.25, 0.002 * width_px)
        rear = grow(template, now, step.corners_px, FLOW)
        assert rear is not None
        dense.append((rear.ratio - k) / rear.sigma)
        sigmas.append(rear.sigma)
    assert np.sqrt(np.mean(np.square(dense))) < 2.0
    assert np.median(sigmas) < 0.35 / width_px  # the floor that compressed video asks for


def test_nothing_to_follow_gives_none():
    flat = np.full((200, 300), 90, np.uint8)
    corners = np.array([[100.0, 80.0], [180.0, 80.0], [180.0, 100.0], [100.0, 100.0]])
    template = make_template(flat, corners, FLOW)
    assert template is not None
    assert follow(template, flat, corners, FLOW) is None
    assert grow(template, flat, corners, FLOW) is None
    assert make_template(flat, corners + 1000, FLOW) is None


@pytest.mark.parametrize("grey", [128, 40])
def test_a_blank_picture_is_no_vehicle_that_stands_still(grey):
    """A template without contrast explains it perfectly: fog, a hand, a wiper's water would say "it does not come nearer"."""
    still = plate_still("us-mi", 120, seed=2)
    template = make_template(still.image, still.corners_px, FlowSettings())
    blank = np.full_like(still.image, grey)
    assert template is not None
    assert grow(template, blank, still.corners_px, FlowSettings()) is None
    assert follow_rear(template, blank, still.corners_px, FlowSettings()) is None
    faint = np.asarray(128 + 0.3 * (still.image.astype(np.float32) - 128), np.uint8)
    assert grow(template, faint, still.corners_px, FlowSettings()) is not None


def test_the_template_is_a_copy():
    still = plate_still("us-mi", 100)
    template = make_template(still.image, still.corners_px, FLOW)
    assert template is not None
    before = template.grey.copy()
    still.image[:] = 0
    assert np.array_equal(template.grey, before)
