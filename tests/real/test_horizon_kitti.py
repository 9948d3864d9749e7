"""The horizon against lidar, on a drive that was never used to tune anything."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.pose.attitude import AttitudeEstimator
from tmde_edge.pose.compensate import vanishing_point_px
from tmde_edge.pose.lanes import LaneFinder
from tmde_edge.pose.settings import PoseSettings
from tmde_edge.pose.tilt import TiltMeter

SHARED = Path(os.environ.get("TMDE_SHARED", Path(__file__).resolve().parents[3] / "shared"))
DRIVE = SHARED / "data" / "drive_kitti"
CAMERA = Camera(width_px=1242, height_px=375, fx_px=721.5377, fy_px=721.5377, cx_px=609.5593, cy_px=172.854)
pytestmark = pytest.mark.real


def test_horizon_row_beats_the_constant_row_of_the_calibration() -> None:
    if not DRIVE.is_dir():
        pytest.skip(f"{DRIVE} is not there: no lidar ground plane to compare with")
    with (DRIVE / "ground_plane.csv").open(newline="") as f:
        truth_px = np.array([float(r["horizon_row_px_at_cx"]) for r in csv.DictReader(f)])
    settings = PoseSettings()
    estimator, finder, meter = AttitudeEstimator(settings, CAMERA), LaneFinder(settings), TiltMeter()
    rows_px, sigmas_px, sources = [], [], []
    for k in range(len(truth_px)):
        image = cv2.imread(str(DRIVE / f"{k:010d}.png"))
        t_ns = k * 100_000_000
        expected = vanishing_point_px(estimator.rest, CAMERA)
        lanes, tilt = finder.see(image, t_ns, expected), meter.see(image, t_ns, expected)
        pose = estimator.update(lanes, t_ns, None, None, tilt)
        rows_px.append(CAMERA.cy_px - CAMERA.fy_px * math.tan(pose.pitch_rad))
        sigmas_px.append(pose.pitch_sigma_rad * CAMERA.fy_px)
        sources.append(pose.source)
    error_px = np.abs(np.array(rows_px) - truth_px)
    constant_px = np.abs(truth_px - CAMERA.cy_px)
    assert np.mean([s != "none" for s in sources]) >= 0.7
    assert np.median(error_px) <= 0.8 * np.median(constant_px)
    assert np.percentile(error_px, 90) <= 0.8 * np.percentile(constant_px, 90)
    assert np.mean(error_px < sigmas_px) > 0.68
    assert np.mean(error_px < 2.0 * np.array(sigmas_px)) > 0.95
