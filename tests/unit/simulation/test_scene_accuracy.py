"""Plates land where the pinhole model puts them: measured in clean renders against the projected truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tmde_edge.simulation.camera import View, hd_camera, view_of
from tmde_edge.simulation.plate_face import FaceSpec, GlyphSpec
from tmde_edge.simulation.scene import DAY, VehicleAt, paint_plate, plate_corners_px, plate_pose
from tmde_edge.simulation.stills import glyph_corners_px
from tmde_edge.simulation.vehicle import Body

BLANK = FaceSpec(
    width_mm=520, height_mm=110, background_bgr=(240, 240, 240), ink_bgr=(20, 20, 20), corner_radius_mm=0.0,
    glyphs=(GlyphSpec(char="I", left_mm=-200, top_mm=-37.5, width_mm=10, height_mm=75, stroke_mm=10),
            GlyphSpec(char="I", left_mm=100, top_mm=-37.5, width_mm=100, height_mm=75, stroke_mm=60)),
)


def edge_line(grey: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64], reach_px: float) -> NDArray[np.float64]:
    """Line (n_x, n_y, c) of the step edge near the segment a-b: n x = c, from area-exact profiles across it."""
    along = (b - a) / np.hypot(*(b - a))
    horizontal = abs(along[0]) > abs(along[1])
    points = []
    lo, hi = (a, b) if (b - a)[0 if horizontal else 1] > 0 else (b, a)
    axis = 0 if horizontal else 1
    start, stop = lo[axis] + 0.25 * (hi - lo)[axis], lo[axis] + 0.75 * (hi - lo)[axis]
    for k in range(int(np.ceil(start)), int(np.floor(stop)) + 1):
        t = (k - lo[axis]) / (hi - lo)[axis]
        middle = (lo + t * (hi - lo))[1 - axis]
        m0, m1 = round(float(middle) - reach_px), round(float(middle) + reach_px)
        profile = grey[m0 : m1 + 1, k] if horizontal else grey[k, m0 : m1 + 1]
        left, right = profile[0], profile[-1]
        share = (profile - right).sum() / (left - right)  # pixels of the left side's level
        place = m0 - 0.5 + share
        points.append((k, place) if horizontal else (place, k))
    p = np.array(points)
    if horizontal:
        slope, offset = np.polyfit(p[:, 0], p[:, 1], 1)
        return np.array([-slope, 1.0, offset])
    slope, offset = np.polyfit(p[:, 1], p[:, 0], 1)
    return np.array([1.0, -slope, offset])


def measured_corners(grey: NDArray[np.float64], near: NDArray[np.float64], reach_px: float) -> NDArray[np.float64]:
    lines = [edge_line(grey, near[i], near[(i + 1) % 4], reach_px) for i in range(4)]
    out = []
    for i in range(4):
        first, second = lines[i - 1], lines[i]
        out.append(np.linalg.solve(np.array([first[:2], second[:2]]), np.array([first[2], second[2]])))
    return np.array(out)


@pytest.mark.parametrize(
    ("width_px", "yaw", "tilt", "roll", "pitch", "camera_roll"),
    [(24, 0.0, 0.0, 0.0, 0.0, 0.0),
     (60, 0.0, 0.0, 0.0, 0.0, 0.0), (120, 0.2, 0.05, 0.02, 0.0, 0.0), (180, -0.3, -0.05, -0.02, 0.01, 0.02),
     (400, 0.1, 0.0, 0.01, 0.02, -0.01), (600, 0.0, 0.0, 0.0, 0.0, 0.0)],
)
def test_plate_corners_within_a_twentieth_of_a_pixel(
    width_px: float, yaw: float, tilt: float, roll: float, pitch: float, camera_roll: float
) -> None:
    camera = hd_camera(height_m=1.0)
    distance = camera.fx_px * 0.52 / width_px
    body = Body(kind="truck", colour_bgr=(40, 40, 40), plate_up_m=0.95)
    probe = VehicleAt(body=body, face=BLANK, x_m=0.0, down_m=1.0, z_m=0.0, yaw_rad=yaw, plate_tilt_rad=tilt,
                      plate_roll_rad=roll)
    offset, _ = plate_pose(probe)
    vehicle = replace(probe, x_m=0.031 - float(offset[0]), z_m=distance - float(offset[2]))
    view = view_of(camera, pitch, camera_roll)
    truth = plate_corners_px(view, vehicle)
    plain = replace(vehicle, face=replace(BLANK, glyphs=()))
    error = np.hypot(*(measured_corners(clean(view, plain), truth, min(4.0, 0.08 * width_px)) - truth).T)
    assert error.max() < 0.05
    if width_px >= 180:
        bar = glyph_corners_px(view, vehicle, BLANK)[1]
        error = np.hypot(*(measured_corners(clean(view, vehicle), bar, 4.0) - bar).T)
    assert error.max() < 0.05


def clean(view: View, vehicle: VehicleAt) -> NDArray[np.float64]:
    image = np.full((view.camera.height_px, view.camera.width_px, 3), 40, np.uint8)
    paint_plate(image, view, vehicle, DAY)
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float64)
