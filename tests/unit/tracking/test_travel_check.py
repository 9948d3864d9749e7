"""Whether ranges shrink as far as we travel: a wrong focal length is found, a moving lead is not taken for one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tmde_edge.tracking.travel_check import TravelCheck

DT_S = 1 / 30


def drive(
    check: TravelCheck, *, seconds: float, ego: Callable[[float], float], lead: Callable[[float], float], start_m: float,
    k: float = 1.0, track_id: int = 1, noise: float = 0.004, seed: int = 0, yaw: float = 0.0,
    far_bias: float = 0.0, far_sigma: float = 0.012,
) -> TravelCheck:
    """Ego and lead speeds over time; k: true focal length over the configured one. Errors last over ten frames."""
    rng = np.random.default_rng((seed, track_id))
    d, lasting = start_m, 0.0
    for i in range(round(seconds / DT_S)):
        t = i * DT_S
        lasting = 0.9 * lasting + 0.44 * rng.normal()
        far = min(d / start_m, 1.0)
        measured = d / k * (1 + far_bias * far + noise * (0.5 * lasting + 0.8 * rng.normal()))
        scale = 0.012 + (far_sigma - 0.012) * far
        check.add(track_id, round(t * 1e9) + track_id * 10**11, measured, noise * d, scale, ego(t) * DT_S if i else 0.0, yaw)
        d += (lead(t) - ego(t)) * DT_S
        if d < 3.0:
            break
    return check


def braking(v: float, at_s: float, decel: float) -> Callable[[float], float]:
    return lambda t: max(v - decel * max(t - at_s, 0.0), 0.0)


def still(t: float) -> float:
    return 0.0


@pytest.mark.parametrize("k", [0.90, 0.96, 1.04, 1.10])
@pytest.mark.parametrize("seed", range(5))
def test_one_approach_to_a_standing_lead_finds_the_focal_length(k: float, seed: int) -> None:
    check = drive(TravelCheck(), seconds=7, ego=braking(12.0, 2.0, 3.5), lead=still, start_m=50.0, k=k, seed=seed)
    assert check.mismatch is not None
    assert check.mismatch.off == pytest.approx(k - 1, abs=3 * check.mismatch.sigma)
    assert check.mismatch.sigma < 0.02
    assert "focal length looks" in check.mismatch.text


@pytest.mark.parametrize("seed", range(20))
def test_a_right_calibration_is_let_alone(seed: int) -> None:
    check = TravelCheck()
    for track_id in range(1, 6):
        drive(check, seconds=6, ego=braking(12.0, 3.0, 4.0), lead=still, start_m=48.0, track_id=track_id, seed=seed)
        drive(check, seconds=4, ego=lambda t: 10.0, lead=still, start_m=45.0, track_id=10 + track_id, seed=seed)
        assert check.mismatch is None


MOVING = {
    "follows": (lambda t: 12.0, lambda t: 12.0 + np.sin(t)),
    "closing in": (lambda t: 14.0, lambda t: 9.0),
    "creeps": (lambda t: 12.0, lambda t: 1.6),
    "brakes with us": (braking(12.0, 1.0, 3.0), braking(10.5, 0.8, 2.8)),
    "brakes to a stop before us": (braking(12.0, 2.0, 3.0), braking(8.0, 0.0, 4.0)),
    "pulls away": (lambda t: 3.0 + t, lambda t: 2.0 * t),
    "comes": (lambda t: 10.0, lambda t: -10.0),
}


@pytest.mark.parametrize("name", MOVING)
@pytest.mark.parametrize("seed", range(5))
def test_a_moving_lead_is_no_mismatch(name: str, seed: int) -> None:
    ego, lead = MOVING[name]
    check = drive(TravelCheck(), seconds=6, ego=ego, lead=lead, start_m=35.0, seed=seed)
    assert check.mismatch is None


def test_parked_cars_at_steady_speed_need_several() -> None:
    check = TravelCheck()
    raised = []
    for track_id in range(1, 9):
        drive(check, seconds=4, ego=lambda t: 13.0, lead=still, start_m=45.0, k=1.06, track_id=track_id)
        raised.append(check.mismatch is not None)
    assert not raised[0]
    assert raised[-1]
    assert check.mismatch is not None
    assert check.mismatch.off == pytest.approx(0.06, abs=0.03)


def test_it_ends_when_later_approaches_fit() -> None:
    check = drive(TravelCheck(), seconds=7, ego=braking(12.0, 2.0, 3.5), lead=still, start_m=50.0, k=1.06)
    assert check.mismatch is not None
    for track_id in range(2, 9):
        drive(check, seconds=7, ego=braking(12.0, 2.0, 3.5), lead=still, start_m=50.0, track_id=track_id)
    assert check.mismatch is None


def test_bends_say_nothing() -> None:
    check = drive(TravelCheck(), seconds=7, ego=braking(12.0, 2.0, 3.5), lead=still, start_m=50.0, k=1.2, yaw=0.2)
    assert check.mismatch is None


@pytest.mark.parametrize("far_bias", [-0.05, 0.05])
def test_ranges_of_a_small_plate_that_share_an_error_are_no_mismatch(far_bias: float) -> None:
    check = drive(
        TravelCheck(), seconds=7, ego=braking(12.0, 2.0, 3.5), lead=still, start_m=50.0, far_bias=far_bias, far_sigma=0.04
    )
    assert check.mismatch is None
