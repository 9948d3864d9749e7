from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from road import CAMERA, HEIGHT_M, projected

from tmde_edge.messages import Pose
from tmde_edge.pose.compensate import (
    cosine_ratio,
    ground_range,
    height_above_road,
    pitch_and_yaw,
    plate_ground_range,
    plate_height_possible,
    to_vehicle,
    vanishing_point_px,
    view_from_vehicle,
)

angles = st.floats(-0.2, 0.2)


@given(pitch=angles, roll=angles, yaw=angles)
def test_vanishing_point_and_roll_give_the_pose_back(pitch: float, roll: float, yaw: float) -> None:
    pose = Pose(pitch_rad=pitch, roll_rad=roll, yaw_rad=yaw)
    ray = CAMERA.rays(np.array([vanishing_point_px(pose, CAMERA)]))[0]
    assert pitch_and_yaw(ray, roll) == pytest.approx((pitch, yaw), abs=1e-9)


def test_signs() -> None:
    """Nose down lifts the road's vanishing point, yaw right moves it left, roll clockwise lifts the right of the horizon."""
    assert vanishing_point_px(Pose(pitch_rad=0.02, roll_rad=0.0), CAMERA)[1] < CAMERA.cy_px - 15
    assert vanishing_point_px(Pose(pitch_rad=0.0, roll_rad=0.0, yaw_rad=0.02), CAMERA)[0] < CAMERA.cx_px - 15
    far = projected(np.array([[-50.0, 0.0, 100.0], [50.0, 0.0, 100.0]]), Pose(pitch_rad=0.0, roll_rad=0.05))
    assert far[1, 1] < far[0, 1]


@given(pitch=st.floats(-0.05, 0.05), roll=st.floats(-0.05, 0.05), yaw=angles, z=st.floats(4.0, 60.0), side=st.floats(-0.4, 0.4))
def test_project_then_range_is_identity(pitch: float, roll: float, yaw: float, z: float, side: float) -> None:
    pose = Pose(pitch_rad=pitch, roll_rad=roll, yaw_rad=yaw)
    spot = np.array([[side * z, HEIGHT_M, z]])
    at = projected(spot, pose)[0]
    found = ground_range((float(at[0]), float(at[1])), CAMERA, pose, HEIGHT_M)
    assert found is not None
    assert found[0] == pytest.approx(z, rel=1e-9)
    assert to_vehicle(spot @ view_from_vehicle(pose).T, pose) == pytest.approx(spot)


def test_sigma_is_what_the_pitch_error_does() -> None:
    pose = Pose(pitch_rad=0.0, roll_rad=0.0, pitch_sigma_rad=0.002)
    at = projected(np.array([[0.0, HEIGHT_M, 30.0]]), pose)[0]
    distance_m, sigma_m = ground_range((at[0], at[1]), CAMERA, pose, HEIGHT_M, contact_sigma_px=0.0, height_sigma_m=0.0) or (0, 0)
    off = ground_range((at[0], at[1]), CAMERA, Pose(pitch_rad=0.0002, roll_rad=0.0), HEIGHT_M)
    assert off is not None
    assert sigma_m == pytest.approx(10.0 * abs(off[0] - distance_m), rel=0.02)


def test_above_the_horizon_or_too_near_it_is_no_range() -> None:
    level = Pose(pitch_rad=0.0, roll_rad=0.0, pitch_sigma_rad=0.002)
    assert ground_range((640.0, 300.0), CAMERA, level, HEIGHT_M) is None
    assert ground_range((640.0, 360.5), CAMERA, level, HEIGHT_M) is None
    assert ground_range((640.0, 359.5), CAMERA, level, HEIGHT_M) is None


def test_compensated_ground_range_within_five_per_cent_at_30_m() -> None:
    """The contact point under +-2 deg of pitch, the pitch known to 0.1 deg: within 5 %; uncompensated: useless."""
    rng = np.random.default_rng(0)
    with_pitch, without = [], []
    for _ in range(200):
        true = Pose(pitch_rad=math.radians(rng.uniform(-2, 2)), roll_rad=0.0)
        at = projected(np.array([[0.0, HEIGHT_M, 30.0]]), true)[0]
        known = Pose(pitch_rad=true.pitch_rad + math.radians(rng.normal(0.0, 0.05)), roll_rad=0.0, pitch_sigma_rad=1e-3)
        a = ground_range((at[0], at[1]), CAMERA, known, HEIGHT_M)
        b = ground_range((at[0], at[1]), CAMERA, Pose(pitch_rad=0.0, roll_rad=0.0), HEIGHT_M)
        assert a is not None
        with_pitch.append(abs(a[0] / 30.0 - 1.0))
        without.append(abs(b[0] / 30.0 - 1.0) if b is not None else 1.0)
    assert np.median(with_pitch) < 0.05
    assert np.median(without) > 0.2


def test_plate_row_and_legal_height_give_a_weak_range() -> None:
    """A plate 0.9 m up at 20 m: its row says about that, within the large sigma; a low camera knows nothing."""
    pose = Pose(pitch_rad=0.01, roll_rad=0.0, pitch_sigma_rad=0.001)
    at = projected(np.array([[0.0, HEIGHT_M - 0.9, 20.0]]), pose)[0]
    found = plate_ground_range((float(at[0]), float(at[1])), CAMERA, pose, HEIGHT_M)
    assert found is not None
    assert found[0] == pytest.approx(20.0 * (HEIGHT_M - 0.75) / (HEIGHT_M - 0.9))
    assert abs(found[0] - 20.0) < found[1]
    assert found[1] > 0.3 * 20.0
    assert plate_ground_range((float(at[0]), float(at[1])), CAMERA, pose, 0.9) is None


def test_paper_cosine_ratio_is_a_fraction_of_a_per_cent() -> None:
    rest = Pose(pitch_rad=0.0, roll_rad=0.0)
    assert cosine_ratio(Pose(pitch_rad=math.radians(2.0), roll_rad=0.0), rest) == pytest.approx(0.99939, abs=1e-5)


@pytest.mark.parametrize(
    ("height_m", "possible"), [(-3.0, False), (0.3, True), (0.7, True), (1.6, True), (4.0, True), (9.0, False)]
)
def test_plate_height_gate(height_m: float, possible: bool) -> None:
    pose = Pose(pitch_rad=0.01, roll_rad=0.0, pitch_sigma_rad=0.004)
    at = projected(np.array([[1.0, HEIGHT_M - height_m, 20.0]]), pose)[0]
    centre = float(at[0]), float(at[1])
    got, sigma_m = height_above_road(centre, 20.0, CAMERA, pose, HEIGHT_M)
    assert got == pytest.approx(height_m)
    assert sigma_m == pytest.approx(0.08, rel=0.05)
    assert plate_height_possible(centre, 20.0, 0.5, CAMERA, pose, HEIGHT_M) is possible
