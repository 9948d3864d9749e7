import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.geometry.pinhole import (
    Camera,
    rotation_from_vector,
    turn_clockwise,
    turn_down,
    turn_right,
    vehicle_from_view,
    view_from_vehicle,
)


def camera(**changes: object) -> Camera:
    values = {"width_px": 1280, "height_px": 720, "fx_px": 900.0, "fy_px": 905.0, "cx_px": 641.0, "cy_px": 355.0}
    return Camera(**{**values, **changes})  # type: ignore[arg-type]


LENSES = [(), (-0.3, 0.12, 0.001, -0.0005), (-0.35, 0.15, 0.001, -0.001, -0.03), (0.2, -0.1, 0.0, 0.0, 0.02, 0.3, 0.01, 0.0)]


@pytest.mark.parametrize("lens", LENSES)
def test_rays_undo_projection_to_a_millionth_of_a_pixel_even_at_the_rim(lens: tuple[float, ...]) -> None:
    cam = camera(distortion=lens)
    x, y = np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 719, 7))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    assert np.abs(cam.project(7.0 * cam.rays(pixels)) - pixels).max() < 1e-6


@pytest.mark.parametrize("lens", LENSES[1:])
def test_projection_agrees_with_opencv(lens: tuple[float, ...]) -> None:
    cam = camera(distortion=lens)
    points = np.random.default_rng(1).uniform([-3, -1, 4], [3, 1, 9], (20, 3))
    matrix = np.array([[cam.fx_px, 0, cam.cx_px], [0, cam.fy_px, cam.cy_px], [0, 0, 1]])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(lens))[0].reshape(-1, 2)
    assert np.abs(cam.project(points) - theirs).max() < 1e-8


def test_scaling_keeps_the_direction_of_every_pixel_area() -> None:
    cam = camera()
    half = cam.scaled_to(640, 360)
    # the corner shared by four big pixels is the centre of ... the small pixel that covers them
    assert np.allclose(half.rays([[10.0, 20.0]]), cam.rays([[20.5, 40.5]]), atol=1e-12)
    assert cam.scaled_to(1280, 720) is cam


def test_a_cropped_image_is_refused_with_both_sizes() -> None:
    with pytest.raises(ValueError, match=r"1280x960 does not fit the calibration 1280x720"):
        camera().scaled_to(1280, 960)
    assert camera().scaled_to(1281, 720).width_px == 1281  # rounding of odd sizes is no crop


@pytest.mark.parametrize(
    "bad", [{"fx_px": 0.0}, {"fy_px": float("nan")}, {"width_px": 0}, {"distortion": (0.1,)}, {"focal_sigma": -1.0}]
)
def test_impossible_intrinsics_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        camera(**bad)


def test_points_behind_the_camera_have_no_pixel() -> None:
    assert np.isnan(camera().project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])).all()


def test_attitude_signs() -> None:
    ahead, right = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    assert (view_from_vehicle(pitch_rad=0.1) @ ahead)[1] < 0  # nose down: the horizon rises in the image
    assert (view_from_vehicle(yaw_rad=0.1) @ ahead)[0] < 0  # turned right: ahead moves left
    assert (view_from_vehicle(roll_rad=0.1) @ right)[1] < 0  # rolled clockwise: the right side rises in the image
    assert (vehicle_from_view(roll_rad=0.1) @ right)[1] > 0


@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_rotations_chain_and_invert(pitch: float, roll: float, yaw: float) -> None:
    there, back = view_from_vehicle(pitch, roll, yaw), vehicle_from_view(pitch, roll, yaw)
    assert np.allclose(there @ back, np.eye(3), atol=1e-12)
    assert np.allclose(back, turn_right(yaw) @ turn_down(pitch) @ turn_clockwise(roll))
    assert np.isclose(np.linalg.det(there), 1.0)


@settings(max_examples=30)
@given(st.tuples(*[st.floats(-1.5, 1.5)] * 3))
def test_rotation_vector_agrees_with_opencv(vector: tuple[float, float, float]) -> None:
    assert np.allclose(rotation_from_vector(vector), cv2.Rodrigues(np.array(vector))[0], atol=1e-9)
