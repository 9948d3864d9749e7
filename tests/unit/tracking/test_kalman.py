"""Range filter: exact in dt, consistent, robust."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.tracking.kalman import RangeFilter, transition
from tmde_edge.tracking.settings import TrackerSettings

S = TrackerSettings()


@given(a=st.floats(0.001, 0.4), b=st.floats(0.001, 0.4), model=st.sampled_from(["singer", "cv"]))
@settings(max_examples=60, deadline=None)
def test_two_steps_are_one(a: float, b: float, model: str) -> None:
    fa, qa = transition(model, a, 1.2, 2.0)
    fb, qb = transition(model, b, 1.2, 2.0)
    f, q = transition(model, a + b, 1.2, 2.0)
    np.testing.assert_allclose(fb @ fa, f, atol=1e-12)
    np.testing.assert_allclose(fb @ qa @ fb.T + qb, q, atol=1e-12)


def test_singer_matches_its_stationary_variance() -> None:
    f, q = transition("singer", 60.0, 1.2, 2.0)
    assert q[2, 2] == pytest.approx(1.44, rel=1e-9)
    assert f[2, 2] == pytest.approx(0.0, abs=1e-9)


def test_ego_braking_is_not_the_lead_fleeing() -> None:
    """The lead drives 10 m/s, we brake from 10 to 0: the lead's own speed stays 10."""
    f = RangeFilter(S, distance_m=20.0, noise_m=0.05, ego_speed_mps=10.0)
    d, v, dt = 20.0, 10.0, 1 / 30
    for _ in range(90):
        v_next = max(v - 4.0 * dt, 0.0)
        travel = (v + v_next) / 2 * dt
        d += 10.0 * dt - travel
        f.set_ego_speed(v_next)
        f.predict(dt, travel)
        f.update_range(d, 0.05)
        v = v_next
    assert f.lead_speed_mps == pytest.approx(10.0, abs=0.1)
    assert f.range_rate_mps == pytest.approx(10.0 - v, abs=0.1)


def test_ego_speed_appearing_keeps_the_closing_speed() -> None:
    f = RangeFilter(S, distance_m=20.0, noise_m=0.05)
    for k in range(1, 60):
        f.predict(1 / 30)
        f.update_range(20.0 - 3.0 * k / 30, 0.05)
    before = f.range_rate_mps
    f.set_ego_speed(15.0)
    assert f.range_rate_mps == pytest.approx(before, abs=1e-9)
    assert f.lead_speed_mps == pytest.approx(15.0 + before, abs=1e-9)
    f.set_ego_speed(None)
    assert f.range_rate_mps == pytest.approx(before, abs=1e-9)


def test_single_wild_range_is_not_used_but_a_lasting_one_is() -> None:
    f = RangeFilter(S, distance_m=20.0, noise_m=0.1)
    for _ in range(30):
        f.predict(1 / 30)
        f.update_range(20.0, 0.1)
    f.predict(1 / 30)
    assert not f.update_range(9.0, 0.1).accepted
    assert f.distance_m == pytest.approx(20.0, abs=0.1)
    for _ in range(S.gate_rejects):
        f.predict(1 / 30)
        f.update_range(9.0, 0.1)
    assert f.distance_m == pytest.approx(9.0, abs=0.2)


def test_sigma_grows_while_nothing_is_measured() -> None:
    f = RangeFilter(S, distance_m=20.0, noise_m=0.1)
    for _ in range(30):
        f.predict(1 / 30)
        f.update_range(20.0, 0.1)
    sigmas = []
    for _ in range(10):
        f.predict(0.1)
        sigmas.append(float(f.covariance[0, 0]))
    assert all(b > a for a, b in itertools.pairwise(sigmas))


def test_nees_is_consistent_on_singer_drives() -> None:
    """Truth drawn from the model itself: 90 % of normalised errors inside the chi-square band (3 dof: 6.25)."""
    rng = np.random.default_rng(7)
    inside = total = 0
    f_step, q_step = transition("singer", 1 / 30, S.accel_sigma_mps2, S.accel_tau_s)
    root = np.linalg.cholesky(q_step + 1e-15 * np.eye(3))
    for _ in range(40):
        x = np.array([20.0, rng.normal(0, 3), rng.normal(0, S.accel_sigma_mps2)])
        f = RangeFilter(S, distance_m=float(x[0] + rng.normal(0, 0.1)), noise_m=0.1)
        for k in range(90):
            x = f_step @ x + root @ rng.normal(size=3)
            f.predict(1 / 30)
            f.update_range(float(x[0] + rng.normal(0, 0.1)), 0.1)
            if k >= 30 and k % 10 == 0:
                e = x - np.array([f.distance_m, f.range_rate_mps, f.accel_mps2])
                inside += float(e @ np.linalg.solve(f.covariance, e)) < 6.25
                total += 1
    assert 0.84 < inside / total < 0.96


def test_inverse_ttc_pulls_the_speed() -> None:
    f = RangeFilter(S, distance_m=20.0, noise_m=0.5)
    for _ in range(10):
        f.predict(1 / 30)
        f.update_inverse_ttc(-0.2, 0.01)
    assert f.range_rate_mps == pytest.approx(-4.0, abs=0.3)


def _relative_sigma(f: RangeFilter) -> float:
    return float(f.covariance[0, 0]) ** 0.5 / f.distance_m


def test_growth_carries_the_distance_and_its_error() -> None:
    """Plate for 1 s, then growth alone: the range rate stays right, the distance keeps the error it had and gains little."""
    rng = np.random.default_rng(4)
    dt, noise = 1 / 30, 0.05
    z_growth, z_coast = [], []
    for _ in range(200):
        t, true_d, v, a = 0.0, 20.0, rng.normal(0, 2), 0.0
        f, blind = (RangeFilter(S, distance_m=true_d + rng.normal(0, noise), noise_m=noise) for _ in range(2))
        f.set_anchor(0)
        anchor_d, anchor_ns = true_d, 0
        for k in range(1, 91):
            a += -a * dt / 2.0 + rng.normal(0, (2 * 1.2**2 / 2.0 * dt) ** 0.5)
            true_d, v, t = true_d + v * dt, v + a * dt, t + dt
            f.predict(dt)
            blind.predict(dt)
            if k <= 30:
                measured = true_d + rng.normal(0, noise)
                f.update_range(measured, noise)
                blind.update_range(measured, noise)
            if k % 6 == 0:
                ratio = anchor_d / true_d
                seen = f.update_growth(ratio + rng.normal(0, 1e-3), 1e-3, anchor_ns)
                assert seen is not None
                f.set_anchor(k)
                anchor_d, anchor_ns = true_d, k
        z_growth.append((f.distance_m - true_d) / float(f.covariance[0, 0]) ** 0.5)
        z_coast.append((blind.distance_m - true_d) / float(blind.covariance[0, 0]) ** 0.5)
        assert _relative_sigma(f) < 0.3 * _relative_sigma(blind)
    for z in (np.array(z_growth), np.array(z_coast)):
        assert 0.75 < z.std() < 1.25
        assert abs(z.mean()) < 0.3


def test_growth_since_another_time_says_nothing() -> None:
    f = RangeFilter(S, distance_m=20.0, noise_m=0.1)
    f.set_anchor(5)
    assert f.update_growth(1.1, 0.001, 4) is None
    assert f.distance_m == 20.0


def test_repeated_growth_from_one_good_range_never_sharpens_it() -> None:
    """All of these distances hang on the same first range: its error stays."""
    f = RangeFilter(S, distance_m=20.0, noise_m=0.4)
    for k in range(60):
        f.set_anchor(k)
        f.predict(0.2)
        f.update_growth(1.0, 1e-4, k)
    assert float(f.covariance[0, 0]) ** 0.5 > 0.39


def test_a_speed_that_wild_first_ranges_made_up_starts_anew_from_growth() -> None:
    f = RangeFilter(TrackerSettings(), distance_m=25.7, noise_m=2.7, ego_speed_mps=7.0)
    for distance_m in (32.2, 32.0, 31.8, 31.9):  # truth: 29 m, closing at 7 m/s
        f.predict(1 / 30, 7.0 / 30)
        f.update_range(distance_m, 1.4)
    assert f.range_rate_mps > 2  # what the ranges alone make of it: the lead flees
    f.restart_closing(-7.0 / 29.0, 0.01)
    assert f.range_rate_mps == pytest.approx(-7.0, abs=1.0)
    assert 0.5 < float(f.covariance[1, 1]) ** 0.5 < 2.0


def test_ranges_that_jump_do_not_become_closing() -> None:
    """Glare changes what is measured: 21 m become 18.5 m; one wild growth of the image must not make a collision of it."""
    f = RangeFilter(S, distance_m=21.0, noise_m=0.3, ego_speed_mps=14.0)
    for k in range(60):
        f.predict(1 / 30, 14.0 / 30)
        f.update_range(21.0, 0.3)
        if k % 6 == 0:
            f.update_inverse_ttc(0.0, 0.01)
    for _ in range(8):
        f.predict(1 / 30, 14.0 / 30)
        f.update_range(18.6, 0.3)
    assert f.distance_m == pytest.approx(18.6, abs=0.4)
    f.update_inverse_ttc(-7.0 / 18.6, 0.01)
    assert f.range_rate_mps > -2.0
