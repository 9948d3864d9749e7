"""The simulated depth track: true geometry underneath, and a scale and shift that nobody is told."""

from __future__ import annotations

import numpy as np
import pytest

from tmde_edge.simulation.depth import GRID, DepthTrack, inverse_depth
from tmde_edge.simulation.drive import instant
from tmde_edge.simulation.scenarios import build


def test_cells_on_the_lead_and_on_the_road_have_their_inverse_distance() -> None:
    scenario = build("follow")
    now = instant(scenario, 0.0, scenery=False)
    grid = inverse_depth(now, GRID)
    vehicle = now.vehicles[0]
    x, y = now.view.project(np.array([[vehicle.x_m, vehicle.down_m - 0.9, vehicle.z_m]]))[0]
    camera = scenario.camera
    cell = grid[int(y / camera.height_px * GRID[1]), int(x / camera.width_px * GRID[0])]
    assert cell == pytest.approx(1 / vehicle.z_m, rel=0.04)
    # the road in the lowest row, 5.5 px above the frame's lower edge on average
    row = camera.height_px * (1 - 0.5 / GRID[1]) - 0.5
    angle = np.arctan((row - camera.cy_px) / camera.fy_px) + now.pitch_rad
    along_axis = camera.height_m / np.sin(angle) * np.cos(angle - now.pitch_rad)
    assert grid[-1, 5] == pytest.approx(1 / along_axis, rel=0.02)
    assert grid[0, 0] == 0.0


def test_track_is_repeatable_and_hides_its_scale() -> None:
    scenario = build("follow", seed=2)
    first, again = DepthTrack(scenario), DepthTrack(scenario)
    for frame in range(7):
        first.add(frame)
        again.add(frame)
    assert first.t_ns == [0, 100_000_000, 200_000_000]
    assert all((a == b).all() for a, b in zip(first.grids, again.grids, strict=True))
    true = inverse_depth(instant(scenario, 0.0), GRID)
    scale, shift = np.polyfit(true.ravel(), first.grids[0].ravel(), 1)
    assert scale > 1000
    assert shift > 10
    assert np.corrcoef(true.ravel(), first.grids[0].ravel())[0, 1] > 0.98
