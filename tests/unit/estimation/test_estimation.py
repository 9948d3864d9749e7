"""The deciding object on made-up sightings: distances, TTC, alerts, faults, and steady CAN output."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from tmde_edge.app.wiring import build_estimation
from tmde_edge.config import load
from tmde_edge.estimation import Estimation
from tmde_edge.messages import CanFrame, FrameResult, GlyphSighting, PlateSighting, Sighting, Tick

F_PX, W, H = 2000.0, 1280, 720
SPEED_ID = 0x123
CALIBRATED = [f"camera.fx_px={F_PX}", 'plates.expect=["de-mittel"]']
VEHICLE = [
    f"can.vehicle.speed.id={SPEED_ID}", "can.vehicle.speed.start_bit=0", "can.vehicle.speed.length=16",
    "can.vehicle.speed.scale=0.01", "can.vehicle.speed.unit=m/s",
]  # fmt: skip


def plate(distance_m: float, track_id: int = 1, lateral_m: float = 0.0, noise_px: float = 0.0, seed: int = 0) -> PlateSighting:
    """A German plate (520 x 110 mm, eight 75 mm characters) seen straight on."""
    rng = np.random.default_rng(seed)
    s = F_PX / distance_m / 1000.0
    cx, cy = (W - 1) / 2 + F_PX * lateral_m / distance_m, (H - 1) / 2

    def at(x_mm: float, y_mm: float) -> tuple[float, float]:
        dx, dy = rng.normal(0, noise_px, 2) if noise_px else (0.0, 0.0)
        return float(cx + x_mm * s + dx), float(cy + y_mm * s + dy)

    glyphs = tuple(
        GlyphSighting(
            left_px=at(x - 23, 0),
            right_px=at(x + 23, 0),
            top_px=at(x, -37.5),
            bottom_px=at(x, 37.5),
            sigma_tb_px=0.2,
            sigma_lr_px=0.4,
        )
        for x in np.linspace(-165, 215, 8)
    )
    return PlateSighting(
        track_id=track_id,
        corners_px=(at(-260, -55), at(260, -55), at(260, 55), at(-260, 55)),
        corners_sigma_px=0.5,
        score=0.95,
        glyphs=glyphs,
        char_height_px=75 * s,
    )


def sighting(k: int, *plates: PlateSighting, fps: float = 30.0) -> Sighting:
    return Sighting(
        t_ns=round(k * 1e9 / fps), frame_index=k, width_px=W, height_px=H, status="ok" if plates else "no_plate", plates=plates
    )


def result_of(outputs: tuple[FrameResult | CanFrame, ...]) -> FrameResult:
    return next(o for o in outputs if isinstance(o, FrameResult))


def make(*overrides: str) -> Estimation:
    from pathlib import Path

    return build_estimation(load(None, list(overrides)), Path())


def approach(e: Estimation, start_m: float, speed_mps: float, frames: int, noise_px: float = 0.05) -> list[FrameResult]:
    out = []
    for k in range(frames):
        d = start_m - speed_mps * k / 30
        out.append(result_of(e.step(sighting(k, plate(d, noise_px=noise_px, seed=k)))))
    return out


def test_approach_is_measured_and_warned() -> None:
    results = approach(make(*CALIBRATED), 40.0, 10.0, 90)
    last = results[-1]
    true_m = 40.0 - 10.0 * 89 / 30
    assert last.lead is not None
    assert last.lead.distance_m == pytest.approx(true_m, rel=0.02)
    assert last.lead.range_rate_mps == pytest.approx(-10.0, abs=0.5)
    assert last.lead.ttc_s == pytest.approx(true_m / 10.0, rel=0.05)
    assert last.alert.level == "warning"
    first = next(i for i, r in enumerate(results) if r.alert.level == "warning")
    ttc = (40.0 - 10.0 * first / 30) / 10.0
    assert 2.0 < ttc < 4.0


def test_following_says_nothing() -> None:
    e = make(*CALIBRATED)
    results = [result_of(e.step(sighting(k, plate(20.0, noise_px=0.1, seed=k)))) for k in range(150)]
    assert {r.alert.level for r in results} == {"none"}
    assert results[-1].lead is not None
    assert results[-1].plates[0].lead


def test_sigma_keeps_the_law_tolerance() -> None:
    """Frames average pixel noise away, never the question how tall German characters really are (+2/-1 of 75 mm)."""
    e = make(*CALIBRATED)
    last = [result_of(e.step(sighting(k, plate(20.0, noise_px=0.1, seed=k)))) for k in range(150)][-1]
    assert last.lead is not None
    assert last.lead.sigma_m is not None
    assert last.lead.sigma_m > 0.004 * 20.0


def test_uncalibrated_gives_ttc_without_metres() -> None:
    results = approach(make('plates.expect=["de-mittel"]'), 40.0, 10.0, 90)
    last = results[-1]
    assert "uncalibrated" in last.faults
    assert last.lead is not None
    assert last.lead.distance_m is None
    assert last.lead.range_rate_mps is None
    assert last.plates[0].range is None
    assert last.lead.ttc_s == pytest.approx((40.0 - 10.0 * 89 / 30) / 10.0, rel=0.1)
    assert last.alert.level == "warning"


@pytest.mark.parametrize("focal_px", [0.45 * W, 0.55 * W, 0.9 * W, 1.6 * W])
@pytest.mark.parametrize(("lead_mps", "lead_brakes_mps2", "brakes_mps2"), [(0.0, 0.0, 0.0), (12.0, 6.0, 3.0)])
def test_uncalibrated_own_speed_changes_no_warning(
    focal_px: float, lead_mps: float, lead_brakes_mps2: float, brakes_mps2: float
) -> None:
    """Metres of an unknown lens and true metres a second must not meet: a standing car would come towards us."""

    def drive(can: bool) -> list[FrameResult]:
        e = make('plates.expect=["de-mittel"]', *VEHICLE)
        gap_m, own, lead, out = 35.0 if lead_mps == 0.0 else 14.0, 12.0, lead_mps, []
        for k in range(60):
            if can:
                e.step(speed_frame(k / 30, own))
            out.append(result_of(e.step(sighting(k, plate(gap_m * F_PX / focal_px, noise_px=0.02, seed=k)))))
            gap_m += (lead - own) / 30
            own, lead = own - brakes_mps2 / 30, max(lead - lead_brakes_mps2 / 30, 0.0)
        return out

    with_can, without = drive(True), drive(False)
    assert with_can[-1].ego is not None
    assert without[-1].ego is None
    assert [r.alert for r in with_can] == [r.alert for r in without]
    assert [r.lead is not None for r in with_can] == [r.lead is not None for r in without]
    assert with_can[-1].alert.level == "warning"


def test_dropout_is_bridged_with_growing_sigma_then_ends() -> None:
    e = make(*CALIBRATED)
    for k in range(60):
        e.step(sighting(k, plate(20.0, noise_px=0.1, seed=k)))
    gone = [result_of(e.step(sighting(k))) for k in range(60, 150)]
    leads = [r.lead for r in gone if r.lead is not None]
    assert 5 < len(leads) < 90
    sigmas = [lead.sigma_m for lead in leads if lead.sigma_m is not None]
    assert all(b >= a for a, b in itertools.pairwise(sigmas))
    assert leads[-1].coasting_s > 0.15
    assert gone[-1].lead is None


def test_blind_is_a_fault_beside_the_alert() -> None:
    e = make(*CALIBRATED)
    approach(e, 40.0, 10.0, 75)
    s = Sighting(t_ns=round(75e9 / 30), frame_index=75, width_px=W, height_px=H, status="blind")
    r = result_of(e.step(s))
    assert "blind" in r.faults
    assert r.alert.level == "warning"


def test_silence_of_the_camera_is_blindness_on_the_bus() -> None:
    e = make(*CALIBRATED)
    approach(e, 40.0, 1.0, 30)
    status = [o for k in range(40) for o in e.step(Tick(t_ns=1_000_000_000 + k * 50_000_000)) if isinstance(o, CanFrame)]
    ids = {f.can_id for f in status}
    assert 0x6D2 in ids
    last = [f for f in status if f.can_id == 0x6D2][-1]
    assert last.data[2] & 1  # Status_Blind
    assert last.data[0] & 7 == 3  # Status_State: fault
    assert len([f for f in status if f.can_id == 0x6D0]) >= 38  # ALERT keeps its 20 Hz


def speed_frame(t_s: float, speed_mps: float) -> CanFrame:
    return CanFrame(t_ns=round(t_s * 1e9), can_id=SPEED_ID, data=round(speed_mps * 100).to_bytes(2, "little") + bytes(6))


def test_headway_and_lost_can() -> None:
    e = make(*CALIBRATED, *VEHICLE)
    last = None
    for k in range(60):
        e.step(speed_frame(k / 30, 25.0))
        last = result_of(e.step(sighting(k, plate(12.0, noise_px=0.1, seed=k))))
    assert last is not None
    assert last.ego is not None
    assert last.lead is not None
    assert last.lead.headway_s == pytest.approx(12.0 / 25.0, rel=0.05)
    assert (last.alert.level, last.alert.reason) == ("caution", "headway")
    for k in range(60, 200):
        last = result_of(e.step(sighting(k, plate(12.0, noise_px=0.1, seed=k))))
    assert "can_lost" in last.faults
    assert last.ego is None


def test_headway_ends_at_the_own_bumper() -> None:
    """A plate measured a little nearer than the bumper is at no distance, not behind it."""
    e = make(*CALIBRATED, *VEHICLE, "camera.to_bumper_m=2.0")
    told = []
    for k in range(60):
        e.step(speed_frame(k / 30, 5.0))
        told.append(result_of(e.step(sighting(k, plate(2.5 - 0.6 * k / 60, noise_px=0.05, seed=k)))))
    headways = [r.lead.headway_s for r in told if r.lead is not None and r.lead.headway_s is not None]
    assert min(headways) == 0.0
    assert told[-1].lead is not None
    assert told[-1].lead.distance_m is not None
    assert told[-1].lead.distance_m < 2.0


@pytest.mark.parametrize("lost_s", [(0.0, 0.1), (0.9, 1.4)])
def test_a_gap_on_can_is_no_reason_to_warn_of_a_parked_car(lost_s: tuple[float, float]) -> None:
    """Beside our path nothing is said of it; straight ahead it is warned of when it would have been without the gap."""

    def levels(lateral_m: float, lost_s: tuple[float, float]) -> list[str]:
        e, out = make(*CALIBRATED, *VEHICLE), []
        for k in range(100):
            for step in range(3):
                t_s = (k * 3 + step) / 90
                if not lost_s[0] <= t_s < lost_s[1]:
                    e.step(speed_frame(t_s, 12.0))
            seen = plate(48.0 - 12.0 * k / 30, lateral_m=lateral_m, noise_px=0.05, seed=k)
            out.append(result_of(e.step(replace(sighting(k, seen), t_ns=round((k * 3 + 2) / 90 * 1e9)))).alert.level)
        return out

    assert set(levels(1.0, lost_s)) == {"none"}
    gapless = levels(0.0, (-1.0, -1.0))
    assert "warning" in gapless
    assert levels(0.0, lost_s).index("warning") == gapless.index("warning")


def test_way_that_nobody_counted_is_no_wrong_calibration() -> None:
    """Braking towards three standing cars until we stand, while the bus falls silent for half a second each time."""
    e, k, without = make(*CALIBRATED, *VEHICLE), 0, 0
    for car in range(3):
        first, d, v = k, 50.0, 12.0
        while k - first < 200:
            t_s = (k - first) / 30
            for n in (2, 1, 0) if not 2.5 <= t_s < 3.0 else ():
                e.step(speed_frame(k / 30 - n / 100, v))
            r = result_of(e.step(sighting(k, plate(d, noise_px=0.05, seed=k, track_id=car + 1))))
            without += r.ego is None
            assert "calibration" not in r.faults
            before, v = v, max(v - (3.5 / 30 if t_s > 2.0 else 0.0), 0.0)
            d, k = d - (before + v) / 60, k + 1
        k += 100
    assert without > 3 * 10


def test_own_braking_is_not_the_lead_fleeing() -> None:
    """With CAN the braking counts at once; the lead at constant 10 m/s keeps its speed in the estimate."""
    e = make(*CALIBRATED, *VEHICLE)
    d, v, result = 25.0, 15.0, None
    for k in range(75):
        e.step(speed_frame(k / 30, v))
        result = result_of(e.step(sighting(k, plate(d, noise_px=0.05, seed=k))))
        v_next = max(v - 3.0 / 30, 0)
        d += (10.0 - (v + v_next) / 2) / 30
        v = v_next
    assert result is not None
    assert result.lead is not None
    assert result.lead.range_rate_mps == pytest.approx(10.0 - v, abs=0.5)


def test_two_runs_are_identical() -> None:
    a = approach(make(*CALIBRATED), 30.0, 5.0, 60)
    b = approach(make(*CALIBRATED), 30.0, 5.0, 60)
    assert a == b
