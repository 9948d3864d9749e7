"""What estimation makes of depth readings and of the camera's attitude."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_estimation import CALIBRATED, F_PX, H, W, approach, make, plate, result_of, sighting

from tmde_edge.estimation import Estimation
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import DepthReading, FrameResult, LaneSighting, Pose, VehicleBox
from tmde_edge.pose.compensate import view_from_vehicle
from tmde_edge.tracking.lead import Track

DEPTH = ['depth.kind="recorded"', 'depth.path="none.npz"']
GRID = (64, 48)


def reading(t_s: float, distance_m: float, late_s: float = 0.1) -> DepthReading:
    """m = 1000/D over the middle of the picture, small elsewhere."""
    grid = np.full(GRID[::-1], 8.0)
    grid[16:40, 24:40] = 1000.0 / distance_m
    return DepthReading(
        t_ns=round(t_s * 1e9), ready_t_ns=round((t_s + late_s) * 1e9), width_px=W, height_px=H, grid_columns=GRID[0],
        grid_rows=GRID[1], inverse_depth=tuple(float(v) for v in grid.ravel()),
    )  # fmt: skip


def gap(e: Estimation, *, depth: bool, rate_mps: float = -2.0, hidden_s: float = 1.5) -> list[FrameResult]:
    """3 s of a lead 20 m ahead; then its plate is hidden, and it moves at this rate. Readings at 5 Hz."""
    out = []
    for k in range(90 + round(hidden_s * 30)):
        t_s = k / 30
        distance_m = 20.0 + (rate_mps * (t_s - 3.0) if t_s > 3.0 else 0.0)
        if depth and k % 6 == 3 and k > 3:
            at_s = (k - 3) / 30
            e.step(reading(at_s, 20.0 + (rate_mps * (at_s - 3.0) if at_s > 3.0 else 0.0)))
        plates = (plate(distance_m, noise_px=0.05, seed=k),) if t_s <= 3.0 else ()
        out.append(result_of(e.step(sighting(k, *plates))))
    return out


def test_depth_carries_a_hidden_lead() -> None:
    with_depth, without = gap(make(*CALIBRATED, *DEPTH), depth=True), gap(make(*CALIBRATED), depth=False)
    a, b = with_depth[-1].lead, without[-1].lead
    assert a is not None
    assert a.distance_m is not None
    assert b is not None
    assert b.distance_m is not None
    assert a.source == "depth"
    assert b.source == "plate"
    true_m = 20.0 - 2.0 * 1.5 + 2.0 / 30
    assert abs(a.distance_m - true_m) < 0.75 * abs(b.distance_m - true_m)
    assert a.coasting_s == pytest.approx(b.coasting_s)
    assert with_depth[60].lead is not None
    assert with_depth[60].lead.source == "plate"


def test_depth_alone_raises_no_alert(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hidden lead comes at us, as depth sees it: nobody is told, however easily the policy is alarmed."""
    alarmed = ["alerts.max_ttc_s=60", "alerts.caution_ttc_s=50", "alerts.warning_ttc_s=45", "alerts.confidence_sigma=0",
               "alerts.min_closing_mps=0.1"]  # fmt: skip

    def levels() -> set[str]:
        told = gap(make(*CALIBRATED, *DEPTH, *alarmed), depth=True, rate_mps=-4.0, hidden_s=1.8)
        assert min(r.lead.ttc_s for r in told if r.lead is not None and r.lead.ttc_s is not None) < 25.0
        return {r.alert.level for r in told}

    assert levels() == {"none"}
    monkeypatch.setattr(Track, "evidence", property(lambda track: track.filter))
    assert "warning" in levels()  # it is not for want of alarm


def test_a_warning_is_not_ended_by_depth_either() -> None:
    """Alerts in a gap are those without depth, frame by frame."""

    def alerts(e: Estimation, depth: bool) -> list[str]:
        out = [r.alert.level for r in approach(e, 40.0, 9.0, 75)]
        for k in range(75, 120):
            if depth and k % 6 == 3:
                e.step(reading((k - 3) / 30, 40.0))  # "nothing is near"
            out.append(result_of(e.step(sighting(k))).alert.level)
        return out

    assert alerts(make(*CALIBRATED, *DEPTH), True) == alerts(make(*CALIBRATED), False)


def test_each_reading_is_taken_once() -> None:
    """One reading, many frames: the distance moves once."""
    e = make(*CALIBRATED, *DEPTH)
    for k in range(60):
        if k in (6, 12, 18):
            e.step(reading((k - 3) / 30, 20.0))
        e.step(sighting(k, plate(20.0, noise_px=0.05, seed=k)))
    e.step(reading(59 / 30, 18.0))
    rates = []
    for k in range(60, 75):
        lead = result_of(e.step(sighting(k))).lead
        assert lead is not None
        rates.append(lead.range_rate_mps or 0.0)
    assert np.ptp(rates[1:]) < 0.02  # coasting: only a further reading would change it


@pytest.mark.parametrize(("row_px", "ranged"), [((H - 1) / 2, True), (20.0, False), (700.0, False)])
def test_plate_height_gate(row_px: float, ranged: bool) -> None:
    """A plate far up in the sky or below the road is none; without the camera's height nobody knows."""
    low = plate(60.0)
    down = row_px - (H - 1) / 2

    def moved(p: tuple[float, float]) -> tuple[float, float]:
        return p[0], p[1] + down

    there = replace(
        low, corners_px=tuple(moved(c) for c in low.corners_px),  # type: ignore[arg-type]
        glyphs=tuple(replace(g, left_px=moved(g.left_px), right_px=moved(g.right_px), top_px=moved(g.top_px),
                             bottom_px=moved(g.bottom_px)) for g in low.glyphs),
    )  # fmt: skip
    with_height = result_of(make(*CALIBRATED, "camera.height_m=1.3").step(sighting(0, there))).plates[0]
    assert (with_height.range is not None) is ranged
    if not ranged:
        assert with_height.not_ranged == "height above the road"
    assert result_of(make(*CALIBRATED).step(sighting(0, there))).plates[0].range is not None


def test_ground_cue_stands_beside_the_others_and_moves_nothing() -> None:
    def last(*more: str) -> FrameResult:
        e = make(*CALIBRATED, "camera.pitch_rad=0.02", *more)
        out = None
        for k in range(5):
            s = replace(sighting(k, plate(20.0)), lanes=lanes_at(0.02))
            out = result_of(e.step(s))
        assert out is not None
        return out

    with_height, without = last("camera.height_m=1.5").plates[0].range, last().plates[0].range
    assert with_height is not None
    assert without is not None
    assert with_height.distance_m == without.distance_m
    ground = [c for c in with_height.cues if c.cue == "ground"]
    assert len(ground) == 1
    assert not ground[0].used
    assert ground[0].sigma_m > 0.25 * ground[0].distance_m
    assert not [c for c in without.cues if c.cue == "ground"]


def lanes_at(pitch_rad: float) -> LaneSighting:
    row = (H - 1) / 2 - F_PX * math.tan(pitch_rad)
    return LaneSighting(vanishing_px=((W - 1) / 2, row), sigma_x_px=1.0, sigma_y_px=1.0)


@pytest.mark.parametrize("pitch_deg", [-2.0, -1.0, 1.0, 2.0])
def test_pitching_leaves_a_plates_range_alone(pitch_deg: float) -> None:
    """The same plate 20 m ahead and 0.5 m below the lens, the camera nodding by +-2 deg: within 0.3 %."""

    def measured(pitch_rad: float) -> float:
        turn = view_from_vehicle(Pose(pitch_rad=pitch_rad, roll_rad=0.0))
        camera = Camera(width_px=W, height_px=H, fx_px=F_PX, fy_px=F_PX, cx_px=(W - 1) / 2, cy_px=(H - 1) / 2)
        flat = plate(20.0)

        def moved(p: tuple[float, float]) -> tuple[float, float]:
            point = np.array([[(p[0] - (W - 1) / 2) * 20.0 / F_PX, (p[1] - (H - 1) / 2) * 20.0 / F_PX + 0.5, 20.0]])
            x_px, y_px = camera.project(point @ turn.T)[0]
            return float(x_px), float(y_px)

        glyphs = tuple(
            replace(g, left_px=moved(g.left_px), right_px=moved(g.right_px), top_px=moved(g.top_px), bottom_px=moved(g.bottom_px))
            for g in flat.glyphs
        )
        seen = replace(flat, corners_px=tuple(moved(c) for c in flat.corners_px), glyphs=glyphs)  # type: ignore[arg-type]
        e, last = make(*CALIBRATED, "pose.pitch_spread_rad=0.05"), None
        for k in range(20):
            last = result_of(e.step(replace(sighting(k, seen), lanes=lanes_at(pitch_rad))))
        assert last is not None
        assert last.plates[0].range is not None
        return last.plates[0].range.distance_m

    assert measured(math.radians(pitch_deg)) / measured(0.0) == pytest.approx(1.0, abs=0.003)


def test_the_papers_correction_is_a_cosine() -> None:
    """At 5 deg the cosine takes 0.4 %; rotating rays gives the distance along the vehicle's axis."""
    found = {}
    for name in ("rotate", "paper", "none"):
        e = make(*CALIBRATED, f'pose.correction="{name}"', "pose.pitch_spread_rad=0.1")
        last = None
        for k in range(30):
            last = result_of(e.step(replace(sighting(k, plate(20.0)), lanes=lanes_at(math.radians(5.0)))))
        assert last is not None
        assert last.pose.pitch_rad == pytest.approx(math.radians(5.0), abs=0.003)
        assert last.plates[0].range is not None
        found[name] = last.plates[0].range.distance_m
    assert found["paper"] / found["none"] == pytest.approx(math.cos(math.radians(5.0)), abs=3e-4)
    assert found["rotate"] / found["none"] == pytest.approx(math.cos(math.radians(5.0)), abs=5e-3)


@pytest.mark.parametrize("correction", ["rotate", "paper", "none"])
def test_plate_and_vehicle_stand_in_one_frame_whatever_the_correction(correction: str) -> None:
    """A camera that looks to the right: the car straight ahead of us is the lead, its plate seen or hidden."""
    yaw_rad = 0.08
    ahead_px = (W - 1) / 2 - F_PX * math.tan(yaw_rad)
    seen = plate(20.0, lateral_m=-20.0 * math.tan(yaw_rad))
    box = VehicleBox(
        track_id=1, left_px=ahead_px - 80, right_px=ahead_px + 80, top_px=250.0, bottom_px=400.0, sigma_px=2.0
    )  # fmt: skip
    e = make(*CALIBRATED, f"camera.yaw_rad={yaw_rad}", f'pose.correction="{correction}"')
    for k in range(33):
        hidden = k >= 30
        r = result_of(e.step(replace(sighting(k, *(() if hidden else (seen,))), vehicles=(box,) if hidden else ())))
        if not hidden:
            assert r.plates[0].range is not None
            assert r.plates[0].range.lateral_m == pytest.approx(0.0, abs=0.02)
        if k > 5:
            assert r.lead is not None
            assert r.lead.lateral_m == pytest.approx(0.0, abs=0.05)
