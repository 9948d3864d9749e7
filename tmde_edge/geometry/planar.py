"""Pose of a known flat rectangle from its corners: both solutions of the planar ambiguity.

Collins and Bartoli, "Infinitesimal Plane-Based Pose Estimation", IJCV 2014 (cv2.SOLVEPNP_IPPE).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tmde_edge.geometry.pinhole import Camera, rotation_from_vector, turn_clockwise

Floats = NDArray[np.float64]

_EYE, _NO_DISTORTION = np.eye(3), np.zeros(4)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanarPose:
    """camera_from_plate: X_camera = rotation @ X_plate + translation; the plate's z axis points away from us."""

    rotation: Floats  # (3, 3)
    translation_mm: Floats  # (3,)
    rms_px: float

    @property
    def yaw_rad(self) -> float:
        """Heading of the plate's carrier against ours, positive to the right: the plate's right edge is nearer."""
        return float(-np.arctan2(self.rotation[2, 0], self.rotation[0, 0]))


def rectangle_mm(width_mm: float, height_mm: float) -> Floats:
    """Corners (4, 2) TL, TR, BR, BL of a rectangle about the origin, y down."""
    w, h = width_mm / 2, height_mm / 2
    return np.array([[-w, -h], [w, -h], [w, h], [-w, h]])


def planar_poses(points_mm: ArrayLike, points_px: ArrayLike, camera: Camera) -> tuple[PlanarPose, ...]:
    """Both IPPE solutions for n >= 4 coplanar points (n, 2) mm and their pixels, the better first.

    Empty when the points are degenerate (collinear, not finite) or lie behind the camera.
    """
    return poses_of_rays(points_mm, camera.rays(points_px)[:, :2], camera.focal_px)


def poses_of_rays(points_mm: ArrayLike, rays: ArrayLike, focal_px: float = 1.0) -> tuple[PlanarPose, ...]:
    """As `planar_poses`, from normalised image points (n, 2) in any camera-like frame; errors are times focal_px."""
    plane = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
    xy = np.ascontiguousarray(np.asarray(rays, dtype=np.float64).reshape(-1, 2))
    if not np.all(np.isfinite(xy)) or len(plane) < 4:
        return ()
    flat = np.column_stack([plane, np.zeros(len(plane))])
    try:
        count, rotations, translations, _ = cv2.solvePnPGeneric(flat, xy, _EYE, _NO_DISTORTION, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # a singular homography: no pose, not a fault of ours
        return ()
    found = [
        (rotation_from_vector(r), np.asarray(t, dtype=np.float64).reshape(3))
        for r, t in zip(rotations[:count], translations[:count], strict=True)
    ]
    if not all(np.isfinite(t).all() for _, t in found):
        found = _facing(plane, xy)  # OpenCV divides by zero for a plane that faces the camera exactly
    poses = []
    for rotation, translation in found:
        where = plane @ rotation[:, :2].T + translation
        if not np.all(np.isfinite(where)) or float(where[:, 2].min()) <= 0:
            continue
        error = where[:, :2] / where[:, 2:] - xy
        rms = focal_px * float(np.sqrt(np.mean(error**2)))
        poses.append(PlanarPose(rotation=rotation, translation_mm=translation, rms_px=rms))
    return tuple(sorted(poses, key=lambda p: p.rms_px))


def _facing(plane: Floats, xy: Floats) -> list[tuple[Floats, Floats]]:
    """The similarity from the plane to the image as a pose parallel to it; none when the points coincide."""
    p, q = plane - plane.mean(axis=0), xy - xy.mean(axis=0)
    along, across = float(np.sum(p * q)), float(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))
    scale = float(np.hypot(along, across)) / max(float(np.sum(p * p)), 1e-300)
    if not scale > 0:
        return []
    rotation = turn_clockwise(float(np.arctan2(across, along)))
    centre = np.append(xy.mean(axis=0), 1.0) / scale
    return [(rotation, centre - rotation @ np.append(plane.mean(axis=0), 0.0))]
