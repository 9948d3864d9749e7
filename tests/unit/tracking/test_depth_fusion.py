"""Depth in the range filter: late readings are moved to now, errors that last are not averaged away, alerts never rest on it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.messages import RangeMeasurement
from tmde_edge.tracking.kalman import RangeFilter
from tmde_edge.tracking.lead import LeadTracker, Track
from tmde_edge.tracking.settings import TrackerSettings

S = TrackerSettings()


def seen(distance_m: float, rate_mps: float = 0.0, noise_m: float = 0.05, seconds: float = 2.0) -> RangeFilter:
    """A filter that has followed a plate at 30 Hz; distance_m is where it is now."""
    f = RangeFilter(S, distance_m=distance_m - rate_mps * seconds, noise_m=noise_m)
    n = round(30 * seconds)
    for k in range(1, n + 1):
        f.predict(seconds / n)
        f.update_range(distance_m - rate_mps * (seconds - k * seconds / n), noise_m)
    return f


def test_a_late_reading_is_moved_to_now() -> None:
    for age_s in (0.0, 0.2, 0.5):
        f = seen(20.0, rate_mps=-5.0)
        before = f.distance_m
        innovation = f.update_depth(20.0 + 5.0 * age_s, 1.0, age_s, 0.0)
        assert innovation.accepted
        assert innovation.residual == pytest.approx(0.0, abs=0.05)
        assert f.distance_m == pytest.approx(before, abs=0.02)


def test_own_travel_since_the_reading_counts() -> None:
    f = RangeFilter(S, distance_m=20.0, noise_m=0.05, ego_speed_mps=10.0)
    for _ in range(60):
        f.predict(1 / 30, ego_travel_m=10.0 / 30)
        f.update_range(20.0, 0.05)  # the lead drives at 10 m/s too
    assert f.update_depth(20.0, 1.0, 0.3, 3.0).residual == pytest.approx(0.0, abs=0.05)


@given(st.integers(1, 40), st.floats(5.0, 40.0))
@settings(deadline=None)
def test_a_lasting_error_is_never_averaged_away(count: int, distance_m: float) -> None:
    """However many readings of one network come at once, the distance is not known better than the error they share."""
    f = RangeFilter(S, distance_m=distance_m, noise_m=10.0)
    for _ in range(count):
        f.update_depth(distance_m, 0.05 * distance_m, 0.0, 0.0)
    sigma_m = math.sqrt(float(f.covariance[0, 0]))
    expected_m = 1.0 / math.hypot(1.0 / 10.0, 1.0 / (0.05 * distance_m))
    assert sigma_m >= 0.95 * expected_m


def test_while_the_plate_is_seen_wrong_depth_moves_next_to_nothing() -> None:
    f, g = seen(20.0), seen(20.0)
    for _ in range(30):
        for x in (f, g):
            x.predict(0.25)
            x.update_range(20.0, 0.05)
        f.update_depth(21.5, 1.0, 0.15, 0.0)  # 7.5 % off
    assert abs(f.distance_m - g.distance_m) < 0.02


def test_what_was_learnt_while_seen_helps_when_hidden() -> None:
    """Depth that was 6 % long all the time is corrected by that in the gap."""
    f = seen(20.0)
    for _ in range(12):
        f.predict(0.25)
        f.update_range(20.0, 0.05)
        f.update_depth(21.2, 1.0, 0.0, 0.0)
    for k in range(1, 7):  # the lead brakes: 20 m become 18 m in 1.5 s
        f.predict(0.25)
        f.update_depth((20.0 - 2.0 * (k / 6) ** 2) * 1.06, 1.0, 0.0, 0.0)
    assert 18.0 < f.distance_m < 19.5  # without depth 20; taken at its word, the depth would end at 19.1 from 21.2
    error_m, sigma_m = f.distance_m - 18.0, math.sqrt(float(f.covariance[0, 0]))
    assert error_m < 2.5 * sigma_m


def test_outlines_only_carried_along_cannot_agree_with_themselves() -> None:
    """A half-covered outline that flow repeats in every frame says 26 m at 20 m: it never takes over; real ranges do."""
    for guessed, expected_m in ((True, 20.0), (False, 26.0)):
        f = seen(20.0)
        for _ in range(8):
            f.predict(1 / 30)
            f.update_range(26.0, 0.4, guessed=guessed)
        assert f.distance_m == pytest.approx(expected_m, abs=0.3)


def test_a_reading_far_off_is_left_out() -> None:
    f = seen(20.0)
    before = f.distance_m
    assert not f.update_depth(60.0, 3.0, 0.0, 0.0).accepted
    assert f.distance_m == before


def measured(t_s: float, distance_m: float) -> RangeMeasurement:
    return RangeMeasurement(
        track_id=1, t_ns=round(t_s * 1e9), distance_m=distance_m, sigma_m=0.1, noise_m=0.05, scale_sigma=0.0, lateral_m=0.0,
        lateral_sigma_m=0.1, down_m=0.0,
    )  # fmt: skip


def followed(tracker: LeadTracker, until_s: float) -> Track:
    for k in range(round(until_s * 30) + 1):
        tracker.predict(round(k / 30 * 1e9))
        tracker.update(measured(k / 30, 20.0), "plate")
    return tracker.tracks[1]


def test_an_outline_carried_along_for_a_second_invents_no_closing_speed() -> None:
    """Thirty times one guess, 4 m too near at 20 m: as thirty ranges they are a lead that comes at us."""
    rates = {}
    for guessed in (True, False):
        tracker = LeadTracker(TrackerSettings())
        followed(tracker, 3.0)
        for k in range(91, 121):
            tracker.predict(round(k / 30 * 1e9))
            tracker.update(replace(measured(k / 30, 16.0), noise_m=1.6), "flow", guessed=guessed)
        rates[guessed] = tracker.tracks[1].filter.range_rate_mps
    assert rates[False] < -1.0
    assert abs(rates[True]) < 0.25 * abs(rates[False])


def test_alerts_rest_on_what_is_known_without_depth() -> None:
    """Depth says that the hidden lead rushes at us; the evidence for alerts does not follow."""
    tracker = LeadTracker(S)
    track = followed(tracker, 2.0)
    for k in range(1, 7):
        t_ns = round((2.0 + 0.25 * k) * 1e9)
        tracker.predict(t_ns)
        tracker.update_depth(track, 20.0 - 0.5 * k, 0.5, t_ns - 100_000_000, t_ns)
    assert track.source == "depth"
    assert track.filter.distance_m < 18.5
    assert track.filter.range_rate_mps < -0.5
    assert track.evidence.distance_m == pytest.approx(20.0, abs=0.1)
    assert abs(track.evidence.range_rate_mps) < 0.1
    for k in range(6):  # seen again: the plate leads, and soon alerts rest on one filter again
        t_s = 3.5 + (k + 1) / 30
        tracker.predict(round(t_s * 1e9))
        tracker.update(measured(t_s, 20.0), "plate")
    assert track.source == "plate"
    assert track.without_depth is None


def test_depth_carries_a_lead_beyond_coasting_but_not_for_ever() -> None:
    tracker = LeadTracker(S)
    track = followed(tracker, 1.0)
    alive_s = 0.0
    for k in range(1, 40):
        t_ns = round((1.0 + 0.1 * k) * 1e9)
        tracker.predict(t_ns)
        if 1 not in tracker.tracks:
            break
        alive_s = 0.1 * k
        if alive_s <= 2.5 and k % 2 == 0:
            tracker.update_depth(track, 20.0, 1.0, t_ns, t_ns)
    assert S.coast_s < alive_s <= 2.5 + 0.7


def test_no_depth_no_change() -> None:
    """The fourth state does not touch the others while no depth comes."""
    f = seen(15.0, rate_mps=-3.0)
    assert np.allclose(f._kf.P[3, :3], 0.0)
