from __future__ import annotations

import math

import numpy as np
import pytest
from road import CAMERA, picture

from tmde_edge.messages import Pose
from tmde_edge.pose.compensate import vanishing_point_px
from tmde_edge.pose.lanes import LaneFinder
from tmde_edge.pose.settings import PoseSettings

LEVEL = vanishing_point_px(Pose(pitch_rad=0.0, roll_rad=0.0), CAMERA)


def pose(pitch_deg: float, yaw_deg: float = 0.0, roll_deg: float = 0.0) -> Pose:
    return Pose(pitch_rad=math.radians(pitch_deg), roll_rad=math.radians(roll_deg), yaw_rad=math.radians(yaw_deg))


@pytest.mark.parametrize("pitch_deg", [-2.0, -0.7, 0.0, 1.3, 2.0])
@pytest.mark.parametrize("car", [False, True])
def test_vanishing_point_of_a_road_within_its_sigma(pitch_deg: float, car: bool) -> None:
    true = pose(pitch_deg, yaw_deg=0.8)
    found = LaneFinder(PoseSettings()).see(picture(true, car=car), 0, LEVEL)
    x_px, y_px = vanishing_point_px(true, CAMERA)
    assert found is not None
    assert abs(found.vanishing_px[1] - y_px) < min(3.0 * found.sigma_y_px, 2.5)
    assert abs(found.vanishing_px[0] - x_px) < min(3.0 * found.sigma_x_px, 4.0)


def test_nose_down_puts_the_horizon_above_the_centre() -> None:
    found = LaneFinder(PoseSettings()).see(picture(pose(1.5)), 0, LEVEL)
    assert found is not None
    assert found.vanishing_px[1] < CAMERA.cy_px - 15.0


def test_grey_and_half_size_images_give_the_same_source_pixels() -> None:
    image = picture(pose(0.5))
    whole = LaneFinder(PoseSettings()).see(image, 0, LEVEL)
    grey = LaneFinder(PoseSettings()).see(image[:, :, 1], 0, LEVEL)
    half = image.reshape(360, 2, 640, 2, 3).mean(axis=(1, 3)).astype(np.uint8)
    small = LaneFinder(PoseSettings()).see(half, 0, LEVEL, 0.5)
    assert whole is not None
    assert grey is not None
    assert small is not None
    assert grey.vanishing_px == pytest.approx(whole.vanishing_px, abs=0.3)
    assert small.vanishing_px == pytest.approx(whole.vanishing_px, abs=0.6)
    assert small.sigma_y_px == pytest.approx(whole.sigma_y_px, rel=0.3)


def test_borders_of_the_own_lane_at_the_bottom_row() -> None:
    found = LaneFinder(PoseSettings()).see(picture(pose(0.0), dashes=False), 0, LEVEL)
    assert found is not None
    # The bottom row sees the road at z = f h / (row - cy); a stripe's middle is at cx +- f 1.75 / z.
    off_px = 1.75 * (719 - CAMERA.cy_px) / 1.3
    assert found.left_bottom_px == pytest.approx(CAMERA.cx_px - off_px, abs=35)  # either edge of the stripe
    assert found.right_bottom_px == pytest.approx(CAMERA.cx_px + off_px, abs=35)


def test_empty_road_and_noise_are_none() -> None:
    finder = LaneFinder(PoseSettings())
    assert finder.see(picture(pose(0.0), stripes_m=()), 0, LEVEL) is None
    assert finder.see(np.full((720, 1280, 3), 90, np.uint8), 0, LEVEL) is None
    noise = np.random.default_rng(0).integers(0, 256, (720, 1280)).astype(np.uint8)
    assert finder.see(noise, 0, LEVEL) is None


def test_one_stripe_alone_is_no_vanishing_point() -> None:
    assert LaneFinder(PoseSettings()).see(picture(pose(0.0), stripes_m=(1.75,)), 0, LEVEL) is None


@pytest.mark.parametrize("size", [(10, 10), (24, 3000), (480, 12)])
def test_odd_sizes_are_none_not_errors(size: tuple[int, int]) -> None:
    assert LaneFinder(PoseSettings()).see(np.zeros(size, np.uint8), 0, None) is None


def test_papers_method_and_none() -> None:
    image = picture(pose(1.0), dashes=False)
    found = LaneFinder(PoseSettings(method="paper")).see(image, 0, LEVEL)
    assert found is not None
    assert found.vanishing_px[1] == pytest.approx(vanishing_point_px(pose(1.0), CAMERA)[1], abs=8.0)
    assert LaneFinder(PoseSettings(method="none")).see(image, 0, LEVEL) is None


def test_two_runs_are_identical() -> None:
    image = picture(pose(0.3), car=True)
    assert LaneFinder(PoseSettings()).see(image, 0, LEVEL) == LaneFinder(PoseSettings()).see(image, 1, LEVEL)
