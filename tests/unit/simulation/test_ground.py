"""Lane markings and the road lie where the camera projects them: pitched, rolled, in curves and over crests."""

from __future__ import annotations

import numpy as np
import pytest

from tmde_edge.simulation.camera import hd_camera, view_of
from tmde_edge.simulation.ground import Marking, RoadStyle, horizon_row, rows_of
from tmde_edge.simulation.scene import render
from tmde_edge.simulation.world import Road, surroundings

CAMERA = hd_camera(700.0, 640, 360, height_m=1.3)
PLAIN = RoadStyle(markings=(), skyline="none")
CURVE = Road(curvature=((0.0, 0.01), (500.0, 0.01)))


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.03, 0.0), (-0.02, 0.0), (0.02, 0.03), (0.02, -0.02)])
@pytest.mark.parametrize("road", [Road(), CURVE], ids=["straight", "curve"])
def test_marking_s_middle_is_its_projection(pitch: float, roll: float, road: Road) -> None:
    lateral = 1.2
    here = surroundings(road, 0.0, 0.3, 0.01, CAMERA.height_m)
    view = view_of(CAMERA, pitch, roll)
    marking = Marking(lateral_m=lateral, width_m=0.3, colour_bgr=(255.0, 255.0, 255.0))
    bare, marked = (
        render(view, pitch, roll, here.ahead(), RoadStyle(markings=m, skyline="none"), [], [])[..., 1].astype(float)
        for m in ((), (marking,))
    )
    added = np.clip(marked - bare, 0, None)
    checked = 0
    for s in (9.0, 12.0, 18.0):
        x, down, z, _ = here.place(s, lateral)
        u, v = view.project(np.array([[x, down, z]]))[0]
        row = round(float(v))
        if not (0 <= row < 360 and 30 < u < 610):
            continue
        line = added[row]
        middle = float((line * np.arange(640)).sum() / line.sum())
        # the marking's middle in this row, a fraction of a row off the projected point
        ahead = view.project(np.array([here_point(here, s + 0.05, lateral)]))[0]
        slope = (ahead[0] - u) / (ahead[1] - v)
        assert middle == pytest.approx(float(u + (row - v) * slope), abs=0.25)
        checked += 1
    assert checked >= 2


def here_point(here: object, s: float, lateral: float) -> tuple[float, float, float]:
    x, down, z, _ = here.place(s, lateral)  # type: ignore[attr-defined]
    return x, down, z


def test_rows_know_their_distance() -> None:
    ahead = surroundings(Road(), 50.0, 0.0, 0.0, 1.3).ahead()
    rows = rows_of(CAMERA, 0.02, ahead)
    view = view_of(CAMERA, 0.02)
    for k in (0.3, 0.6, 0.95):
        i = int(k * len(rows.z_m))
        v = view.project(np.array([[0.0, 1.3, rows.z_m[i]]]))[0, 1]
        assert v == pytest.approx(rows.first + i, abs=0.02)
        assert rows.s_near_m[i] - 50.0 < rows.z_m[i] < rows.s_far_m[i] - 50.0
    assert rows.first == pytest.approx(horizon_row(CAMERA, 0.02), abs=2.0)


def test_dashes_cover_their_share_of_the_road() -> None:
    here = surroundings(Road(), 0.0, 0.0, 0.0, 1.3)
    view = view_of(CAMERA)
    solid, dashed, bare = (
        render(view, 0.0, 0.0, here.ahead(), RoadStyle(markings=m, skyline="none"), [], [])[..., 1].astype(float)
        for m in ((Marking(lateral_m=1.0),), (Marking(lateral_m=1.0, dash_m=3.0, gap_m=6.0),), ())
    )
    far = slice(195, 215)  # from 17 m on: several periods
    share = (dashed - bare)[far].sum() / (solid - bare)[far].sum()
    assert share == pytest.approx(1 / 3, abs=0.08)


def test_a_crest_hides_the_road_behind_it() -> None:
    crest = Road(elevation=((10.0, 0.0), (40.0, 2.0), (60.0, 2.0), (90.0, -4.0)))
    here = surroundings(crest, 30.0, 0.0, 0.0, 1.3)
    rows = rows_of(CAMERA, 0.0, here.ahead())
    seen = rows.z_m
    assert not ((seen > 48) & (seen < 70)).any()  # the far slope
    assert (seen < 45).any()
