"""What the attitude is used for: rays in the vehicle's frame, the ground-plane range, the gate on a plate's height.

Frames: view (camera) and vehicle both have x right, y down, z forward; the vehicle's are level with the road and
along its forward axis.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.geometry.pinhole import view_from_vehicle as turn_to_view
from tmde_edge.messages import Point, Pose

FloatArray = NDArray[np.float64]

LOWEST_PLATE_M = -0.15  # a plate's centre cannot hang below the road; the allowance is for hollows and crests
HIGHEST_PLATE_M = 5.0
PLATE_UP_M, PLATE_UP_SIGMA_M = 0.75, 0.22  # where a plate's centre usually hangs


def view_from_vehicle(pose: Pose) -> FloatArray:
    """(3, 3) rotation from the vehicle's frame to the camera's."""
    return turn_to_view(pose.pitch_rad, pose.roll_rad, pose.yaw_rad)


def pitch_and_yaw(forward_view: FloatArray, roll_rad: float) -> tuple[float, float]:
    """The pitch and yaw (rad) that map the vehicle's forward axis to this ray of the view frame, roll known."""
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    x = cr * float(forward_view[0]) - sr * float(forward_view[1])
    y = sr * float(forward_view[0]) + cr * float(forward_view[1])
    z = float(forward_view[2])
    return math.atan2(-y, z), math.atan2(-x, math.hypot(y, z))


def vanishing_point_px(pose: Pose, camera: Camera) -> Point:
    """Where the vehicle's forward axis vanishes in the image."""
    x_px, y_px = camera.project(view_from_vehicle(pose)[:, 2])[0]
    return float(x_px), float(y_px)


def to_vehicle(points_view_m: FloatArray, pose: Pose) -> FloatArray:
    """(..., 3) points or rays of the view frame in the vehicle's frame: its z is the distance along the forward axis."""
    turned: FloatArray = np.asarray(points_view_m, dtype=np.float64) @ view_from_vehicle(pose)
    return turned


def cosine_ratio(pose: Pose, rest: Pose) -> float:
    """The paper's correction as a factor of the distance: cos(pitch)/cos(rest pitch), and the same for roll.

    Its whole effect is 1 - cos(2 deg) = 0.06 % at 2 deg, 0.4 % at 5 deg: far below every cue's sigma. What pitch really
    moves is the ray's direction (ground_range_m, plate_height_m), which `correction = "rotate"` accounts for.
    """
    pitch = math.cos(pose.pitch_rad) / math.cos(rest.pitch_rad)
    roll = math.cos(pose.roll_rad) / math.cos(rest.roll_rad)
    return pitch * roll


def ground_range(
    contact_px: Point, camera: Camera, pose: Pose, camera_height_m: float, *, contact_sigma_px: float = 1.0,
    height_sigma_m: float = 0.05,
) -> tuple[float, float] | None:
    """Distance along the forward axis (m) and its sigma of a point of the road; None at or above the horizon.

    Flat road: D = h z/y of the ray in the vehicle's frame; dD = (D^2 + h^2)/h of the angle, so that 0.1 deg of pitch
    is 4 % at 30 m from 1.3 m: a weak cue.
    """
    ray = to_vehicle(camera.rays(np.array([contact_px], dtype=np.float64)), pose)[0]
    x, y, z = (float(v) for v in ray)
    if y <= 0.0 or z <= 0.0:
        return None
    distance_m = camera_height_m * z / y
    angle_sigma = math.hypot(pose.pitch_sigma_rad, contact_sigma_px / camera.fy_px)
    angle_sigma = math.hypot(angle_sigma, pose.roll_sigma_rad * x / z)  # roll lifts a point off the middle
    by_angle_m = (distance_m**2 + camera_height_m**2) / camera_height_m * angle_sigma
    sigma_m = math.hypot(by_angle_m, distance_m * height_sigma_m / camera_height_m)
    if not math.isfinite(distance_m) or sigma_m >= distance_m:  # knows nothing: the horizon is within one sigma
        return None
    return distance_m, sigma_m


def plate_ground_range(centre_px: Point, camera: Camera, pose: Pose, camera_height_m: float) -> tuple[float, float] | None:
    """Distance (m) and sigma of a plate by its row alone, from where plates may legally hang; None where that says nothing.

    The ground-plane range of its centre against a plane as high as plates hang: lower edge 0.30 m or more, upper edge 1.20 m or
    less above the road (Regulation (EU) 1003/2010, Annex II; other countries are alike). A very large sigma, but free of sizes.
    """
    return ground_range(
        centre_px, camera, pose, camera_height_m - PLATE_UP_M, height_sigma_m=PLATE_UP_SIGMA_M
    ) if camera_height_m > PLATE_UP_M + PLATE_UP_SIGMA_M else None  # fmt: skip


def height_above_road(
    point_px: Point, distance_m: float, camera: Camera, pose: Pose, camera_height_m: float
) -> tuple[float, float]:
    """Height (m) above a flat road of a point seen at distance_m along the forward axis, and its sigma from the pose."""
    x, y, z = (float(v) for v in to_vehicle(camera.rays(np.array([point_px], dtype=np.float64)), pose)[0])
    if z <= 0.0:
        return math.inf, 0.0
    sigma_m = distance_m * math.hypot(pose.pitch_sigma_rad, pose.roll_sigma_rad * x / z)
    return camera_height_m - distance_m * y / z, sigma_m


def plate_height_possible(
    centre_px: Point, distance_m: float, distance_sigma_m: float, camera: Camera, pose: Pose, camera_height_m: float,
    *, slope_sigma: float = 0.02,
) -> bool:
    """The gate: False for what would hang below the road or more than 5 m above it by more than two sigma.

    `slope_sigma` is how far the road ahead may rise or fall against the road under the car (one sigma, as a ratio).
    """
    height_m, pose_sigma_m = height_above_road(centre_px, distance_m, camera, pose, camera_height_m)
    if not math.isfinite(height_m):
        return False
    by_range_m = abs(camera_height_m - height_m) * distance_sigma_m / max(distance_m, 1e-6)
    sigma_m = math.sqrt(pose_sigma_m**2 + by_range_m**2 + (slope_sigma * distance_m) ** 2)
    return LOWEST_PLATE_M - 2.0 * sigma_m <= height_m <= HIGHEST_PLATE_M + 2.0 * sigma_m
