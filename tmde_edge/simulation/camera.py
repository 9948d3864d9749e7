"""The simulated camera: a pinhole of its own, independent of the code it is used to judge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class SimCamera:
    """Pinhole intrinsics and mounting; pixel centres at integers. Pitch positive nose down, roll clockwise, yaw right."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    height_m: float = 1.3  # of the lens above the road
    pitch_rad: float = 0.0  # resting attitude, as a calibration would know it
    roll_rad: float = 0.0
    yaw_rad: float = 0.0
    to_bumper_m: float = 0.0

    @property
    def matrix(self) -> Array:
        """K (3, 3)."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])


def hd_camera(fx_px: float = 1400.0, width_px: int = 1280, height_px: int = 720, **more: float) -> SimCamera:
    """A camera with square pixels and a centred principal point."""
    return SimCamera(
        width_px=width_px, height_px=height_px, fx_px=fx_px, fy_px=fx_px, cx_px=(width_px - 1) / 2,
        cy_px=(height_px - 1) / 2, **more,
    )


def level_from_camera(pitch_rad: float, roll_rad: float, yaw_rad: float = 0.0) -> Array:
    """Rotation (3, 3) of camera vectors into the level frame (x right, y down, z forward along the vehicle)."""
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, cp, sp], [0.0, -sp, cp]])
    roll = np.array([[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]])
    out: Array = heading_rotation(yaw_rad) @ pitch @ roll
    return out


def heading_rotation(yaw_rad: float, tilt_rad: float = 0.0, roll_rad: float = 0.0) -> Array:
    """Rotation (3, 3) of a body's axes into the level frame: heading to the right, then tilt (nose down), then roll."""
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    yaw = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    if tilt_rad == 0.0 and roll_rad == 0.0:
        return yaw
    out: Array = yaw @ level_from_camera(tilt_rad, roll_rad)
    return out


@dataclass(frozen=True, slots=True)
class View:
    """A camera at one attitude; its optical centre is the origin of the level frame."""

    camera: SimCamera
    level_from_camera: Array

    def project(self, points_m: Array) -> Array:
        """Pixels (n, 2) of level-frame points (n, 3); NaN for points not in front of the lens."""
        inside = np.asarray(points_m, np.float64) @ self.level_from_camera  # = R^T p, row-wise
        z = inside[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self.camera.cx_px + self.camera.fx_px * inside[:, 0] / z
            v = self.camera.cy_px + self.camera.fy_px * inside[:, 1] / z
        out = np.stack([u, v], axis=1)
        out[z <= 1e-6] = np.nan
        return out


def view_of(camera: SimCamera, pitch_rad: float = 0.0, roll_rad: float = 0.0, yaw_rad: float = 0.0) -> View:
    """The view at the resting attitude plus these changes."""
    return View(
        camera, level_from_camera(camera.pitch_rad + pitch_rad, camera.roll_rad + roll_rad, camera.yaw_rad + yaw_rad)
    )
