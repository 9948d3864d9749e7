"""What one needs to know while turning and focusing a camera: where the horizon lies, where plates will be, how sharp it is."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.geometry.pinhole import Camera, view_from_vehicle
from tmde_edge.messages import Pose

Image = NDArray[np.uint8]
DISTANCES_M = (5.0, 10.0, 20.0, 40.0)
HALF_LANE_M = 1.3  # a lead's plate is hardly ever further from the middle of the own path
PLATE_LOW_M, PLATE_HIGH_M = 0.3, 1.1  # rear plates of cars, vans and lorries above the road
NOMINAL_FOCAL_PER_WIDTH = 0.9  # where the camera is not calibrated yet: for aiming that is near enough
NOMINAL_HEIGHT_M = 1.3
FOCUS_SHARE = 0.5  # the middle of the picture whose sharpness counts
DARK, BRIGHT = 5, 250  # grey levels that count as black and as burnt out


def nominal_camera(width_px: int, height_px: int) -> Camera:
    """A guess for a camera that is not calibrated: good enough to aim by, never to measure."""
    f = NOMINAL_FOCAL_PER_WIDTH * width_px
    return Camera(width_px=width_px, height_px=height_px, fx_px=f, fy_px=f, cx_px=(width_px - 1) / 2, cy_px=(height_px - 1) / 2)


def aim(camera: Camera, pose: Pose, height_m: float | None) -> dict[str, Any]:
    """Horizon and plate zones as shares of the picture (0..1), and whether the aim is good.

    horizon: two points; zones: one box (left, top, right, bottom) a distance; advice: words, "" when all is well.
    """
    view = view_from_vehicle(pose.pitch_rad, pose.roll_rad, pose.yaw_rad)
    half = 0.8 * math.atan(camera.width_px / (2 * camera.fx_px))
    ends = _shares(camera, view @ np.array([[math.tan(-half), math.tan(half)], [0.0, 0.0], [1.0, 1.0]]))
    above_m = NOMINAL_HEIGHT_M if height_m is None else height_m
    zones = []
    for distance_m in DISTANCES_M:
        x = np.array([-HALF_LANE_M, HALF_LANE_M, HALF_LANE_M, -HALF_LANE_M])
        y = above_m - np.array([PLATE_HIGH_M, PLATE_HIGH_M, PLATE_LOW_M, PLATE_LOW_M])
        corners = _shares(camera, view @ np.stack([x, y, np.full(4, distance_m)]))
        if corners is not None:
            (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
            zones.append({"distance_m": distance_m, "box": [round(float(v), 4) for v in (left, top, right, bottom)]})
    return {
        "horizon": [[round(float(v), 4) for v in p] for p in ends] if ends is not None else None,
        "zones": zones,
        "advice": _advice(ends, zones, camera),
    }


def _shares(camera: Camera, points_view: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """(n, 2) of the picture's width and height; None where a point cannot be seen by this lens at all."""
    points = camera.project(points_view.T)
    if not np.isfinite(points).all():
        return None
    return np.asarray((points + 0.5) / (camera.width_px, camera.height_px), dtype=np.float64)


def _advice(ends: NDArray[np.float64] | None, zones: list[dict[str, Any]], camera: Camera) -> str:
    if ends is None:
        return "the horizon is not in view: aim forward"
    middle = float(ends[:, 1].mean())
    degrees = math.degrees(2 * math.atan(camera.height_px / (2 * camera.fy_px)))
    if middle < 0.25:
        return f"aim up by about {(0.42 - middle) * degrees:.0f} deg: the horizon is near the top"
    if middle > 0.6:
        return f"aim down by about {(middle - 0.42) * degrees:.0f} deg: near plates fall out of the picture below"
    if abs(float(ends[1, 1] - ends[0, 1])) > 0.05:
        return "turn the camera level: the horizon leans"
    near = next((z["box"] for z in zones if z["distance_m"] == DISTANCES_M[0]), None)
    if near is not None and near[3] > 1.0:
        return "plates nearer than 5 m fall out of the picture below: aim down a little, or move the camera back"
    return ""


def sharpness(image: Image) -> float:
    """Energy of fine detail in the middle of a picture over its contrast: grows until the lens is in focus."""
    h, w = image.shape[:2]
    top, left = round(h * (1 - FOCUS_SHARE) / 2), round(w * (1 - FOCUS_SHARE) / 2)
    part = image[top : h - top, left : w - left]
    grey = part if part.ndim == 2 else part[:, :, 1]  # green has most of the light
    fine = cv2.Laplacian(grey, cv2.CV_16S, ksize=1)
    contrast = float(cv2.meanStdDev(grey)[1][0, 0])
    return float(cv2.meanStdDev(fine)[1][0, 0]) / max(contrast, 4.0)


def exposure(image: Image) -> dict[str, Any]:
    """Mean grey level, shares of black and of burnt out pixels, and a word for it."""
    grey = image[::4, ::4] if image.ndim == 2 else image[::4, ::4, 1]
    mean, dark, bright = float(grey.mean()), float((grey <= DARK).mean()), float((grey >= BRIGHT).mean())
    word = "good"
    if mean > 190 or bright > 0.15:
        word = "too bright"
    elif mean < 45 or dark > 0.4:
        word = "too dark"
    return {"mean": round(mean, 1), "dark": round(dark, 4), "bright": round(bright, 4), "word": word}
