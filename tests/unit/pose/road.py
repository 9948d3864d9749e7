"""A small exact road picture for these tests: stripes on a plane, projected by the camera, drawn with supersampling."""

from __future__ import annotations

import cv2
import numpy as np

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Pose
from tmde_edge.pose.compensate import FloatArray, view_from_vehicle

CAMERA = Camera(width_px=1280, height_px=720, fx_px=1000.0, fy_px=1000.0, cx_px=639.5, cy_px=359.5)
HEIGHT_M = 1.3
SHIFT = 6  # fractional bits of cv2.fillPoly


def projected(points_vehicle_m: FloatArray, pose: Pose, camera: Camera = CAMERA) -> FloatArray:
    return camera.project(points_vehicle_m @ view_from_vehicle(pose).T)


def picture(
    pose: Pose, *, stripes_m: tuple[float, ...] = (-5.3, -1.75, 1.75, 5.2), dashes: bool = True, noise: float = 3.0,
    car: bool = False, camera: Camera = CAMERA, seed: int = 0, skyline: bool = False,
) -> np.ndarray:  # fmt: skip
    """BGR image of a straight road: pale sky, dark road, stripes 15 cm wide at these lateral places."""
    image = np.full((camera.height_px, camera.width_px), 190.0, np.float32)
    horizon = projected(np.array([[-300.0, HEIGHT_M, 300.0], [300.0, HEIGHT_M, 300.0]]), pose, camera)
    side = 5 * camera.width_px
    slope = (horizon[1, 1] - horizon[0, 1]) / (horizon[1, 0] - horizon[0, 0])
    ground = [[-side, horizon[0, 1] + slope * (-side - horizon[0, 0])], [side, horizon[0, 1] + slope * (side - horizon[0, 0])],
              [side, side], [-side, side]]  # fmt: skip
    _fill(image, np.array(ground), 70.0)
    if skyline:
        houses = np.random.default_rng(99)  # the same town in every picture, 400 m away
        for x_m in np.arange(-400.0, 400.0, 11.0):
            top_m, level = houses.uniform(2.0, 40.0), houses.uniform(40.0, 160.0)
            wall = np.array([[x_m, HEIGHT_M, 400.0], [x_m, HEIGHT_M - top_m, 400.0], [x_m + 10, HEIGHT_M - top_m, 400.0],
                             [x_m + 10, HEIGHT_M, 400.0]])  # fmt: skip
            _fill(image, projected(wall, pose, camera), float(level))
    for lateral_m in stripes_m:
        solid = not dashes or lateral_m in (stripes_m[0], stripes_m[-1])
        ends = [(3.0, 90.0)] if solid else [(4.0 + 9 * k, 7.0 + 9 * k) for k in range(8)]
        for near_m, far_m in ends:
            x0, x1 = lateral_m - 0.075, lateral_m + 0.075
            corners = np.array([[x0, HEIGHT_M, near_m], [x0, HEIGHT_M, far_m], [x1, HEIGHT_M, far_m], [x1, HEIGHT_M, near_m]])
            _fill(image, projected(corners, pose, camera), 200.0)
    if car:
        for level, box in ((30.0, (-0.9, -0.2, 0.9, 1.25)), (120.0, (-0.7, -0.1, 0.7, 0.4)), (200.0, (-0.26, 0.6, 0.26, 0.71))):
            x0, y0, x1, y1 = box
            face = np.array([[x0, y0, 9.0], [x1, y0, 9.0], [x1, y1, 9.0], [x0, y1, 9.0]])
            _fill(image, projected(face, pose, camera), level)
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(image, (0, 0), 0.6) + rng.normal(0.0, noise, image.shape)
    return cv2.cvtColor(np.clip(image, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def _fill(image: np.ndarray, corners_px: FloatArray, level: float) -> None:
    points = np.round(np.clip(corners_px, -20000, 20000) * (1 << SHIFT)).astype(np.int32)
    cv2.fillPoly(image, [points], level, cv2.LINE_8, SHIFT)
