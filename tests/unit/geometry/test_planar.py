import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.geometry.pinhole import Camera, turn_clockwise, turn_down, turn_right
from tmde_edge.geometry.planar import planar_poses, rectangle_mm

CAMERA = Camera(width_px=1280, height_px=720, fx_px=1000, fy_px=1000, cx_px=640, cy_px=360, distortion=(-0.2, 0.05, 0.0, 0.0))
PLATE = rectangle_mm(520, 110)


def seen(yaw: float, lean: float, roll: float, where_mm: tuple[float, float, float]) -> np.ndarray:
    rotation = turn_right(yaw) @ turn_down(lean) @ turn_clockwise(roll)
    return CAMERA.project((PLATE @ rotation[:, :2].T + where_mm) / 1000)


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.7, 0.7), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(-0.3, 0.3), st.floats(1500, 12000))
def test_project_then_pose_is_the_identity(yaw: float, lean: float, roll: float, bearing: float, distance: float) -> None:
    where = (bearing * distance, 0.1 * distance, distance)
    pixels = seen(yaw, lean, roll, where)
    start = planar_poses(PLATE, pixels, CAMERA)[0]
    # OpenCV divides by zero where the plate faces the line of sight exactly, and loses digits near it: a similarity stands in
    assert start.rms_px < 0.4
    assert np.allclose(start.translation_mm, where, rtol=4e-3, atol=2.0)


def test_a_turned_plate_comes_back_exactly() -> None:
    where = (300.0, 500.0, 5000.0)
    start = planar_poses(PLATE, seen(0.3, -0.1, 0.05, where), CAMERA)[0]
    assert start.rms_px < 1e-4
    assert np.allclose(start.translation_mm, where, rtol=1e-5, atol=0.05)


def test_both_solutions_come_with_their_errors_and_mirror_the_heading() -> None:
    poses = planar_poses(PLATE, seen(0.35, 0.05, 0.0, (0, 0, 9000)), CAMERA)
    assert len(poses) == 2
    assert poses[0].rms_px < 1e-6 < poses[1].rms_px < 0.5
    assert abs(poses[0].yaw_rad - 0.35) < 1e-4
    assert poses[1].yaw_rad < -0.2
    assert abs(poses[1].translation_mm[2] / 9000 - 1) < 0.01  # ambiguous in heading, hardly in distance


def test_heading_is_positive_when_the_right_edge_is_nearer() -> None:
    corners = seen(0.4, 0.0, 0.0, (0, 0, 3000))
    left, right = corners[3, 1] - corners[0, 1], corners[2, 1] - corners[1, 1]
    assert right > left
    assert planar_poses(PLATE, corners, CAMERA)[0].yaw_rad > 0


def test_degenerate_points_give_no_pose() -> None:
    assert planar_poses(PLATE, np.zeros((4, 2)), CAMERA) == () or planar_poses(PLATE, np.zeros((4, 2)), CAMERA)[0].rms_px > 1e-9
    assert planar_poses(PLATE, np.full((4, 2), np.nan), CAMERA) == ()
