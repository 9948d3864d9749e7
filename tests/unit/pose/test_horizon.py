"""What the horizon network sees of a picture, and what its answer means."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Pose
from tmde_edge.pose.attitude import AttitudeEstimator
from tmde_edge.pose.compensate import vanishing_point_px
from tmde_edge.pose.horizon import HEIGHT, OFFSETS_PX, SLOPES, WIDTH, horizon_of, network_picture, network_view
from tmde_edge.pose.settings import PoseSettings

CAMERA = Camera(width_px=1280, height_px=720, fx_px=1400.0, fy_px=1400.0, cx_px=639.5, cy_px=359.5)


def answer(offset_px: float, slope: float, sigma_px: float = 0.8, sigma_slope: float = 0.012) -> np.ndarray:
    return np.concatenate([
        -0.5 * ((OFFSETS_PX - offset_px) / sigma_px) ** 2, -0.5 * ((SLOPES - slope) / sigma_slope) ** 2
    ])  # fmt: skip


@given(
    width=st.sampled_from([640, 960, 1242, 1280, 1920]), f=st.floats(500.0, 3000.0), x=st.floats(0.3, 0.7), y=st.floats(0.3, 0.7),
    row=st.floats(-12.0, 12.0),
)  # fmt: skip
@settings(deadline=None, max_examples=30)
def test_an_edge_comes_back_where_it_is(width: int, f: float, x: float, y: float, row: float) -> None:
    """A bright sky over a dark road: the edge's row in the network's picture, decoded, is its row in the source."""
    height = round(width * 0.5625)
    expected = x * width, y * height
    view = network_view(width, height, f, expected)
    edge_px = view.centre_px[1] + row / view.scale
    if not 4.0 < edge_px < height - 5.0:
        return
    image = np.zeros((height, width, 3), np.uint8)
    image[: round(edge_px + 0.5)] = 200  # rows above the edge
    edge_px = round(edge_px + 0.5) - 0.5
    picture = network_picture(image, view)
    assert picture.shape == (HEIGHT, WIDTH)
    column = picture[:, WIDTH // 2].astype(float)
    found = float(column.sum() / 200.0) - 0.5 - (HEIGHT - 1) / 2 if column[0] > 150 else 0.0
    seen = horizon_of(answer(found, 0.0), view, expected, width)
    assert seen is not None
    assert seen.vanishing_px[1] == pytest.approx(edge_px, abs=0.15 / view.scale)


def test_slope_is_roll_with_its_sign() -> None:
    """Roll clockwise lifts the right of the horizon (docs/pose.md)."""
    view = network_view(1280, 720, 1400.0, (639.5, 359.5))
    seen = horizon_of(answer(0.0, -0.06), view, (639.5, 359.5), 1280)
    assert seen is not None
    assert seen.roll_rad == pytest.approx(0.06, abs=0.002)
    assert seen.source == "network"


def test_a_vague_or_broken_answer_is_none() -> None:
    view = network_view(1280, 720, 1400.0, None)
    assert horizon_of(answer(0.0, 0.0, sigma_px=20.0), view, None, 1280) is None
    broken = answer(0.0, 0.0)
    broken[3] = math.nan
    assert horizon_of(broken, view, None, 1280) is None
    assert horizon_of(broken[:5], view, None, 1280) is None


@given(pitch=st.floats(-0.035, 0.035))
@settings(deadline=None, max_examples=25)
def test_the_pose_names_the_network_and_follows_it(pitch: float) -> None:
    e = AttitudeEstimator(PoseSettings(), CAMERA)
    expected = vanishing_point_px(e.rest, CAMERA)
    view = network_view(1280, 720, 1400.0, expected)
    true_px = vanishing_point_px(Pose(pitch_rad=pitch, roll_rad=0.0), CAMERA)
    pose = None
    for k in range(12):
        seen = horizon_of(answer((true_px[1] - view.centre_px[1]) * view.scale, 0.0), view, expected, 1280)
        pose = e.update(seen, k * 200_000_000, None)
    assert pose is not None
    assert pose.source == "network"
    assert abs(pose.pitch_rad - pitch) < max(0.006, 2.0 * pose.pitch_sigma_rad)
    assert not e.resting.blocks_rad  # it never teaches the mounting


def test_crops_smaller_than_the_network_are_enlarged() -> None:
    image = cv2.resize(np.arange(100, dtype=np.uint8).reshape(10, 10), (120, 90))
    assert network_picture(np.asarray(image, np.uint8), network_view(120, 90, None, None)).shape == (HEIGHT, WIDTH)
