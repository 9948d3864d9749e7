"""TTC forms and the own vehicle's way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.messages import EgoState
from tmde_edge.tracking.ego import EgoMotion
from tmde_edge.tracking.ttc import braking_ttc_s, plain_ttc_s, required_decel_mps2, ttc_sigma_s


def test_plain() -> None:
    assert plain_ttc_s(20.0, -5.0) == pytest.approx(4.0)
    assert plain_ttc_s(20.0, 0.0) is None
    assert plain_ttc_s(20.0, 3.0) is None
    assert plain_ttc_s(-0.5, -1.0) == 0.0


@given(gap=st.floats(1, 100), v=st.floats(-20, 5), a=st.floats(-8, -0.1))
def test_braking_solves_its_equation(gap: float, v: float, a: float) -> None:
    t = braking_ttc_s(gap, v, a, None)
    assert t is not None
    assert gap + v * t + a * t * t / 2 == pytest.approx(0.0, abs=1e-6 * (1 + gap))


def test_braking_lead_stops_and_does_not_reverse() -> None:
    """Lead at 5 m/s braking 5 m/s2 stands after 1 s and 2.5 m; we come at 10 m/s over 30 + 2.5 m."""
    assert braking_ttc_s(30.0, -5.0, -5.0, 5.0) == pytest.approx(3.25)


def test_lead_speeding_up_gets_no_credit() -> None:
    assert braking_ttc_s(20.0, -5.0, 3.0, None) == plain_ttc_s(20.0, -5.0)


def test_nhtsa_decelerating_case() -> None:
    """45 mph both, 30 m, 0.3 g: by the braking-counted TTC of 2.4 s the plain ratio reads about 3.8 s (the issue's number)."""
    v, a = 20.12, -0.3 * 9.81
    for t in np.arange(0, 4, 0.001):
        gap, rate = 30 + a * t * t / 2, a * t
        if (ttc := braking_ttc_s(gap, rate, a, v + a * t)) is not None and ttc <= 2.4:
            assert plain_ttc_s(gap, rate) == pytest.approx(3.8, abs=0.3)
            return
    pytest.fail("never reached 2.4 s")


def test_sigma_is_the_first_order_one() -> None:
    cov = np.diag([0.04, 0.25, 1.0])
    rng = np.random.default_rng(1)
    d, v = 20 + 0.2 * rng.normal(size=20000), -8 + 0.5 * rng.normal(size=20000)
    sigma = ttc_sigma_s(20.0, -8.0, cov)
    assert sigma == pytest.approx(np.std(d / -v), rel=0.05)


def test_required_decel() -> None:
    assert required_decel_mps2(25.0, -10.0) == pytest.approx(2.0)
    assert required_decel_mps2(25.0, 1.0) == 0.0


def _ego(t_s: float, v: float) -> EgoState:
    return EgoState(t_ns=round(t_s * 1e9), speed_mps=v, yaw_rate_radps=None)


def test_travel_integrates_speed() -> None:
    ego = EgoMotion()
    for k in range(101):
        ego.add(_ego(k * 0.02, 10 - 2 * k * 0.02))
    assert ego.travel_m(500_000_000, 1_510_000_000) == pytest.approx(10 * 1.01 - (1.51**2 - 0.5**2), abs=1e-6)
    assert ego.travel_m(2_000_000_000, 2_100_000_000) == pytest.approx(0.6)


def test_old_samples_change_nothing() -> None:
    ego = EgoMotion()
    ego.add(_ego(1.0, 10))
    ego.add(_ego(0.5, 99))
    assert ego.travel_m(1_000_000_000, 2_000_000_000) == pytest.approx(10.0)
    ego.clear()
    assert ego.travel_m(0, 1_000_000_000) == 0.0


@pytest.mark.parametrize("decel", [-1.0, 0.0, 2.0, 6.0])
def test_own_braking(decel: float) -> None:
    motion = EgoMotion()
    assert motion.braking_mps2() == 0.0
    for k in range(50):
        motion.add(EgoState(t_ns=k * 20_000_000, speed_mps=15.0 - decel * k * 0.02, yaw_rate_radps=None))
    assert motion.braking_mps2() == pytest.approx(max(decel, 0.0), abs=1e-6)
