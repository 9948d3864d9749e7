import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.geometry.pinhole import Camera, turn_clockwise, turn_down, turn_right
from tmde_edge.geometry.planar import planar_poses, projection_jacobian, rectangle_mm, refine_pose

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
    assert start.rms_px < 0.05  # OpenCV loses digits where the plate nearly faces the camera
    best = refine_pose(start, PLATE, pixels, CAMERA)
    assert best.rms_px < 1e-4
    assert np.allclose(best.translation_mm, where, rtol=1e-3, atol=0.05)


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


def test_refinement_is_hardly_moved_by_one_wild_point() -> None:
    grid = np.array([(x, y) for x in (-260, -130, 0, 130, 260) for y in (-55, 0, 55)], dtype=float)
    rotation = turn_right(0.2) @ turn_down(0.1)
    pixels = CAMERA.project((grid @ rotation[:, :2].T + (300, 100, 5000)) / 1000)
    pixels[3] += (6.0, -8.0)
    start = planar_poses(grid, pixels, CAMERA)[0]
    refined = refine_pose(start, grid, pixels, CAMERA, sigma_px=0.2)
    assert abs(refined.translation_mm[2] / 5000 - 1) < 0.004
    assert abs(refined.translation_mm[2] - 5000) < 0.4 * abs(start.translation_mm[2] - 5000)


def test_jacobian_is_the_derivative() -> None:
    rng = np.random.default_rng(3)
    arms, rays = rng.normal(0, 100, (5, 3)), rng.normal(0, 0.1, (5, 2))
    where = np.array([100.0, -50.0, 4000.0])
    error, jacobian = projection_jacobian(arms + where, arms, rays)
    for i in range(3):
        moved = where.copy()
        moved[i] += 1e-3
        numeric = (projection_jacobian(arms + moved, arms, rays)[0] - error) / 1e-3
        assert np.allclose(numeric, jacobian[:, :, 3 + i], rtol=1e-5, atol=1e-10)
        turned = arms + 1e-6 * np.cross(np.eye(3)[i], arms)
        numeric = (projection_jacobian(turned + where, arms, rays)[0] - error) / 1e-6
        assert np.allclose(numeric, jacobian[:, :, i], rtol=1e-4, atol=1e-8)


def test_degenerate_points_give_no_pose() -> None:
    assert planar_poses(PLATE, np.zeros((4, 2)), CAMERA) == () or planar_poses(PLATE, np.zeros((4, 2)), CAMERA)[0].rms_px > 1e-9
    assert planar_poses(PLATE, np.full((4, 2), np.nan), CAMERA) == ()
