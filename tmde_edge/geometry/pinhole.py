"""The pinhole camera with lens distortion, and rotations that compose by name."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

ASPECT_TOLERANCE = 0.01  # an image whose aspect differs by more was cropped: its intrinsics are not known
_DISTORTION_LENGTHS = (0, 4, 5, 8)
_NEWTON_STEPS = 12

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Intrinsics of a width x height image, pixel centres at integers; camera frame x right, y down, z forward.

    distortion: OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]] (Brown-Conrady and the rational model); () is none.
    focal_sigma: relative one-sigma uncertainty of the focal length.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    focal_sigma: float = 0.005

    def __post_init__(self) -> None:
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.focal_sigma, *self.distortion)
        if not np.all(np.isfinite(numbers)):
            raise ValueError(f"camera intrinsics must be finite numbers, got {numbers}")
        if self.width_px < 1 or self.height_px < 1 or self.fx_px <= 0 or self.fy_px <= 0 or self.focal_sigma < 0:
            raise ValueError(
                f"camera needs a positive size and focal length, got {self.width_px}x{self.height_px} px, "
                f"fx_px {self.fx_px}, fy_px {self.fy_px}, focal_sigma {self.focal_sigma}"
            )
        if len(self.distortion) not in _DISTORTION_LENGTHS:
            raise ValueError(f"camera distortion takes 0, 4, 5 or 8 numbers, got {len(self.distortion)}")

    @property
    def focal_px(self) -> float:
        """Geometric mean of both focal lengths."""
        return float(np.sqrt(self.fx_px * self.fy_px))

    def scaled_to(self, width_px: int, height_px: int) -> Camera:
        """The same camera read out at another size; pixel areas map, so centres shift by half a pixel.

        Raises ValueError when the aspect differs by more than 1 %: the image was cropped, not scaled.
        """
        if (width_px, height_px) == (self.width_px, self.height_px):
            return self
        if width_px < 1 or height_px < 1:
            raise ValueError(f"image size {width_px}x{height_px} is empty")
        sx, sy = width_px / self.width_px, height_px / self.height_px
        if abs(sx / sy - 1.0) > ASPECT_TOLERANCE:
            raise ValueError(
                f"image {width_px}x{height_px} does not fit the calibration {self.width_px}x{self.height_px}: "
                f"aspect {width_px / height_px:.3f} against {self.width_px / self.height_px:.3f}; "
                "calibrate this mode of the camera or set [camera] for it"
            )
        return replace(
            self, width_px=width_px, height_px=height_px, fx_px=self.fx_px * sx, fy_px=self.fy_px * sy,
            cx_px=(self.cx_px + 0.5) * sx - 0.5, cy_px=(self.cy_px + 0.5) * sy - 0.5,
        )

    def rays(self, points_px: ArrayLike) -> Floats:
        """Undistorted viewing rays (n, 3) with z = 1 of points (n, 2)."""
        points = np.asarray(points_px, dtype=np.float64).reshape(-1, 2)
        out = np.ones((len(points), 3))
        out[:, 0] = (points[:, 0] - self.cx_px) / self.fx_px
        out[:, 1] = (points[:, 1] - self.cy_px) / self.fy_px
        if self.distortion:
            out[:, :2] = self._undistort(out[:, :2])
        return out

    def project(self, points_m: ArrayLike) -> Floats:
        """Pixels (n, 2) of points (n, 3) in the camera frame; NaN rows for points that are not in front."""
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
        z = np.where(points[:, 2] > 1e-9, points[:, 2], np.nan)
        xy: Floats = points[:, :2] / z[:, None]
        if self.distortion:
            xy = self._distort(xy)
        out: Floats = xy * [self.fx_px, self.fy_px] + [self.cx_px, self.cy_px]
        return out

    def _distort(self, xy: Floats) -> Floats:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *(0.0,) * (8 - len(self.distortion)))
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        out: Floats = np.empty_like(xy)
        out[:, 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        out[:, 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return out

    def _undistort(self, target: Floats) -> Floats:
        """Newton on the distortion model; OpenCV's five fixed-point steps leave pixels at the rim of wide lenses."""
        xy: Floats = target.copy()
        eps = 1e-6
        right, down = np.array([eps, 0.0]), np.array([0.0, eps])
        for _ in range(_NEWTON_STEPS):
            error = self._distort(xy) - target
            dx = (self._distort(xy + right) - self._distort(xy - right)) / (2 * eps)
            dy = (self._distort(xy + down) - self._distort(xy - down)) / (2 * eps)
            det = dx[:, 0] * dy[:, 1] - dy[:, 0] * dx[:, 1]
            det = np.where(np.abs(det) < 1e-9, 1e-9, det)
            step = np.stack(
                [(dy[:, 1] * error[:, 0] - dy[:, 0] * error[:, 1]) / det,
                 (dx[:, 0] * error[:, 1] - dx[:, 1] * error[:, 0]) / det], axis=1,
            )
            xy -= np.clip(step, -0.5, 0.5)
            if float(np.abs(step).max(initial=0.0)) < 1e-12:
                break
        return xy


def view_from_vehicle(pitch_rad: float = 0.0, roll_rad: float = 0.0, yaw_rad: float = 0.0) -> Floats:
    """Rotation (3, 3) from the vehicle's frame (x right, y down, z forward, level) to the camera's.

    Attitude of the camera in the vehicle: pitch positive nose down, roll positive clockwise seen from behind, yaw
    positive to the right; the camera is rolled about its own axis, then pitched, then yawed.
    """
    return np.ascontiguousarray(vehicle_from_view(pitch_rad, roll_rad, yaw_rad).T)


def vehicle_from_view(pitch_rad: float = 0.0, roll_rad: float = 0.0, yaw_rad: float = 0.0) -> Floats:
    """Rotation (3, 3) from the camera's frame to the vehicle's: the transpose of `view_from_vehicle`."""
    out: Floats = turn_right(yaw_rad) @ turn_down(pitch_rad) @ turn_clockwise(roll_rad)
    return out


def turn_right(angle_rad: float) -> Floats:
    """Rotation about the down axis: forward turns to the right."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def turn_down(angle_rad: float) -> Floats:
    """Rotation about the right axis: forward turns down."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])


def turn_clockwise(angle_rad: float) -> Floats:
    """Rotation about the forward axis: right turns down."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_from_vector(vector_rad: ArrayLike) -> Floats:
    """Rodrigues: rotation (3, 3) about `vector_rad` (3,) by its length."""
    v = np.asarray(vector_rad, dtype=np.float64).reshape(3)
    angle = float(np.sqrt(v @ v))
    k = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    first, second = (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2) if angle > 1e-8 else (1.0, 0.5)
    out: Floats = np.eye(3) + first * k + second * (k @ k)
    return out
