"""The lane followed into a bend, on rendered roads, against the road's own course."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tmde_edge.pose.course import find_course
from tmde_edge.simulation.camera import hd_camera
from tmde_edge.simulation.drive import instant, picture
from tmde_edge.simulation.ground import RoadStyle
from tmde_edge.simulation.scenario import Scenario
from tmde_edge.simulation.stills import TWO_LANES
from tmde_edge.simulation.world import Motion, Road


def drive(curvature: tuple[tuple[float, float], ...], fx_px: float = 1400.0, lateral_m: float = 0.0) -> Scenario:
    camera = hd_camera(fx_px=fx_px, height_m=1.3, to_bumper_m=1.5, pitch_rad=0.02)
    return Scenario(
        name="course", text="", duration_s=1.0, camera=camera, ego=Motion(start_m=0.0, speed_mps=12.0),
        style=RoadStyle(markings=TWO_LANES, skyline="trees"), road=Road(curvature=curvature),
        ego_lateral=((0.0, lateral_m),),
    )  # fmt: skip


def course_m(scenario: Scenario, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Z and X of the course found, by the camera's own geometry; and X of the road's middle there, from where we are."""
    camera = scenario.camera
    now = instant(scenario, frame / scenario.rate_hz)
    horizon = camera.cy_px - camera.fy_px * np.tan(now.pitch_rad)
    points = np.array(find_course(picture(scenario, frame), (camera.cx_px, horizon), camera.fx_px))
    if len(points) == 0:
        return np.zeros(0), np.zeros(0)
    n = points[:, 1] - horizon
    z = camera.fx_px * camera.height_m / n
    x = (points[:, 0] - camera.cx_px) / n * camera.height_m
    true = np.interp(z, now.ahead.z_m, now.ahead.x_m) - float(np.interp(0.5, now.ahead.z_m, now.ahead.x_m))
    return z, x - true


@pytest.mark.parametrize("radius_m", [-60.0, -120.0, 90.0, 400.0, 1e9])
@pytest.mark.parametrize("fx_px", [1400.0, 2400.0])
def test_a_bend_that_begins_ahead_is_seen(radius_m: float, fx_px: float) -> None:
    z, error = course_m(drive(((15.0, 0.0), (27.0, 1 / radius_m)), fx_px), 3)
    assert z[-1] > 25.0
    assert np.abs(error[z < 25.0]).max() < 0.5
    assert np.abs(error[z < 12.0]).max() < 0.2


@pytest.mark.parametrize("lateral_m", [-0.6, 0.6])
def test_our_place_in_the_lane_does_not_matter(lateral_m: float) -> None:
    z, error = course_m(drive(((0.0, 1 / 150), (200.0, 1 / 150)), lateral_m=lateral_m), 3)
    assert z[-1] > 25.0
    assert np.abs(error[z < 25.0]).max() < 0.5


def test_no_line_no_course() -> None:
    bare = drive(())
    bare = replace(bare, style=replace(bare.style, markings=()))
    image = picture(bare, 3)
    assert find_course(image, (bare.camera.cx_px, bare.camera.cy_px - 28.0), bare.camera.fx_px) == ()
    assert find_course(image[:60], (640.0, 55.0), 1400.0) == ()
    rng = np.random.default_rng(1)
    noise = rng.integers(60, 110, (720, 1280, 3), dtype=np.uint8)
    found = find_course(noise, (639.5, 340.0), 1400.0)
    assert len(found) == 0 or max(p[2] for p in found) > 0
