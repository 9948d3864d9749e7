"""Which track is the lead, and what happens when identities change."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tmde_edge.messages import EgoState, RangeMeasurement, ScaleChange
from tmde_edge.tracking.kalman import RangeFilter
from tmde_edge.tracking.lead import LeadTracker, _grow
from tmde_edge.tracking.path import OwnPath
from tmde_edge.tracking.settings import TrackerSettings

S = TrackerSettings()
DT_NS = 33_333_333


def measured(track_id: int, t_ns: int, distance_m: float, lateral_m: float = 0.0) -> RangeMeasurement:
    return RangeMeasurement(
        track_id=track_id, t_ns=t_ns, distance_m=distance_m, sigma_m=0.1, noise_m=0.05, scale_sigma=0.01,
        lateral_m=lateral_m, lateral_sigma_m=0.05, down_m=0.5,
    )  # fmt: skip


def drive(tracker: LeadTracker, start: int, frames: int, seen: dict[int, tuple[float, float]]) -> list[int | None]:
    chosen = []
    for k in range(start, start + frames):
        t = k * DT_NS
        tracker.predict(t)
        for track_id, (d, y) in seen.items():
            tracker.update(measured(track_id, t, d, y), "plate")
        lead = tracker.choose(t)
        chosen.append(lead.track_id if lead is not None else None)
    return chosen


def test_nearest_in_path_and_not_the_neighbour() -> None:
    t = LeadTracker(S)
    assert drive(t, 0, 30, {1: (30.0, 0.2), 2: (12.0, 3.2), 3: (20.0, -0.3)})[-1] == 3


def test_one_range_is_no_lead() -> None:
    assert drive(LeadTracker(S), 0, 1, {1: (20.0, 0.0)}) == [None]


def test_a_nearer_one_takes_over_only_after_a_while() -> None:
    t = LeadTracker(S)
    drive(t, 0, 30, {1: (30.0, 0.0), 2: (15.0, 3.0)})
    after = drive(t, 30, 30, {1: (30.0, 0.0), 2: (15.0, 0.2)})
    assert after[0] == 1
    assert after[-1] == 2


def test_curve_moves_the_path() -> None:
    """Turning left at 15 m/s with 0.15 rad/s: at 25 m the path is 3.1 m to the left."""
    t = LeadTracker(S)
    for k in range(60):
        t.set_ego(EgoState(t_ns=k * DT_NS, speed_mps=15.0, yaw_rate_radps=0.15))
        t.predict(k * DT_NS)
        t.update(measured(1, k * DT_NS, 25.0, -3.1), "plate")
        t.update(measured(2, k * DT_NS, 25.0, 0.0), "plate")
        lead = t.choose(k * DT_NS)
    assert lead is not None
    assert lead.track_id == 1


def test_new_identity_continues_the_same_vehicle() -> None:
    t = LeadTracker(S)
    drive(t, 0, 30, {1: (20.0, 0.0)})
    t.predict(31 * DT_NS)
    t.predict(33 * DT_NS)
    track = t.update(measured(7, 33 * DT_NS, 20.05, 0.1), "plate")
    assert track.hits > 20
    lead = t.choose(33 * DT_NS)
    assert lead is not None
    assert lead.track_id == 7


def test_two_at_once_are_never_merged() -> None:
    t = LeadTracker(S)
    drive(t, 0, 5, {1: (20.0, 0.0), 2: (20.1, 0.3)})
    assert set(t.tracks) == {1, 2}


def test_tracks_end() -> None:
    t = LeadTracker(S)
    drive(t, 0, 30, {1: (20.0, 0.0)})
    for k in range(30, 120):
        t.predict(k * DT_NS)
    assert not t.tracks


def test_scale_sigma_is_never_averaged_away() -> None:
    t = LeadTracker(S)
    drive(t, 0, 300, {1: (20.0, 0.0)})
    assert t.tracks[1].sigma_m == pytest.approx(0.2, rel=0.05)
    assert t.tracks[1].sigma_m >= 0.2


def towards(tracker: LeadTracker, *, closing_mps: float, lateral_m: float, ego_mps: float = 14.0, yaw_to_radps: float = 0.0,
            seconds: float = 1.5, lost_s: tuple[float, float] = (-1.0, -1.0)) -> list[bool]:
    """In the path or not, frame by frame, of one vehicle that begins 50 m ahead; the wheel turns over the last half second.

    In the time lost_s our own speed is not known.
    """
    inside = []
    frames = round(seconds * 30)
    for k in range(frames):
        t = k * DT_NS
        share = max(0.0, (k - (frames - 15)) / 15)
        known = not lost_s[0] <= k / 30 < lost_s[1]
        tracker.set_ego(EgoState(t_ns=t, speed_mps=ego_mps, yaw_rate_radps=yaw_to_radps * share) if known else None)
        tracker.predict(t)
        track = tracker.update(measured(1, t, 50.0 - closing_mps * t * 1e-9, lateral_m), "plate")
        tracker.choose(t)
        inside.append(track.in_path)
    return inside


def test_what_stands_must_overlap_half_of_us_what_drives_need_not() -> None:
    assert not any(towards(LeadTracker(S), closing_mps=14.0, lateral_m=1.05)[10:])
    assert all(towards(LeadTracker(S), closing_mps=8.0, lateral_m=1.05)[15:])
    assert all(towards(LeadTracker(S), closing_mps=14.0, lateral_m=0.3)[10:])


def test_a_vehicle_that_drove_is_no_parked_one_when_it_stops() -> None:
    t = LeadTracker(S)
    towards(t, closing_mps=4.0, lateral_m=0.0)
    track = t.tracks[1]
    assert track.moved
    assert not track.stands
    still = LeadTracker(S)
    towards(still, closing_mps=14.0, lateral_m=0.0)
    assert still.tracks[1].stands


def test_the_first_wild_ranges_of_a_far_parked_car_make_it_no_driver() -> None:
    """For a tenth of a second they say that it drives away, then its growth tells its speed."""
    t, v, first = LeadTracker(S), 11.5, [39.0, 39.2, 39.5, 39.8]
    for k in range(45):
        at = k * DT_NS
        t.set_ego(EgoState(t_ns=at, speed_mps=v, yaw_rate_radps=0.0))
        t.predict(at)
        distance_m = first[k] if k < len(first) else 40.6 - v * k / 30
        t.update(replace(measured(1, at, distance_m, 1.0), noise_m=0.2), "plate")
        if k == 5:
            t.grow(ScaleChange(track_id=1, t_from_ns=0, ratio=1 / (1 - v * k / 30 / 40.6), sigma=0.004), at)
        t.choose(at)
    assert not t.tracks[1].moved
    assert t.tracks[1].filter.lead_speed_mps == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("lost_s", [(0.0, 0.03), (0.0, 0.15), (0.5, 0.65), (0.5, 1.3), (0.5, 2.2)])
def test_losing_our_own_speed_for_a_moment_makes_no_parked_car_drive(lost_s: tuple[float, float]) -> None:
    t = LeadTracker(S)
    assert not any(towards(t, closing_mps=14.0, lateral_m=1.0, seconds=2.5, lost_s=lost_s)[6:])
    assert t.tracks[1].stands
    ahead = LeadTracker(S)
    assert all(towards(ahead, closing_mps=14.0, lateral_m=0.2, seconds=2.5, lost_s=lost_s)[6:])
    slower = LeadTracker(S)
    assert all(towards(slower, closing_mps=8.0, lateral_m=1.0, seconds=2.5, lost_s=lost_s)[15:])  # half a second
    assert not slower.tracks[1].stands


def test_nor_does_it_make_a_lead_of_the_oncoming() -> None:
    t = LeadTracker(S)
    assert not any(towards(t, closing_mps=22.0, lateral_m=0.0, seconds=2.0, lost_s=(0.8, 1.6))[10:])


def test_what_is_not_known_for_long_may_drive() -> None:
    """A car that stood may have driven off since: the wide path and the early thresholds again, until we know better."""
    t = LeadTracker(S)
    inside = towards(t, closing_mps=10.0, lateral_m=1.0, ego_mps=10.0, seconds=4.0, lost_s=(1.0, 3.5))
    assert not any(inside[6:85])
    assert inside[100]
    assert not any(inside[106:])
    assert t.tracks[1].stands
    coming = towards(LeadTracker(S), closing_mps=8.0, lateral_m=0.0, ego_mps=2.0, seconds=4.0, lost_s=(1.0, 3.5))
    assert not any(coming[10:85])
    assert coming[100]


def test_the_turning_wheel_takes_what_stands_ahead_out_of_the_path_before_the_arc_does() -> None:
    """Half a second into a bend: 6 deg/s at 14 m/s is an arc that is 0.1 m off at 5 m, but the bend goes on."""
    straight = towards(LeadTracker(S), closing_mps=14.0, lateral_m=0.0)
    turning = towards(LeadTracker(S), closing_mps=14.0, lateral_m=0.0, yaw_to_radps=-0.05)
    assert straight[-1]
    assert turning[20]
    assert not turning[-1]


def test_the_oncoming_are_never_the_lead() -> None:
    assert not any(towards(LeadTracker(S), closing_mps=27.0, lateral_m=0.0)[10:])
    # a size that is wrong by a quarter makes a standing car seem to come: it stays
    assert any(towards(LeadTracker(S), closing_mps=17.0, lateral_m=0.0)[10:])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_what_stands_beside_a_sharp_bend_stands(sign: float) -> None:
    """A circle of 20 m at 5.5 m/s; a car parked 3.1 m outside of it, a third of the circle ahead at first."""
    t, v, radius = LeadTracker(S), 5.5, 20.0
    for k in range(60):
        ahead = 1.3 - v / radius * k / 30
        z = (radius + 3.1) * math.sin(ahead)
        x = sign * (radius - (radius + 3.1) * math.cos(ahead))  # right positive; sign 1: a bend to the right
        t.set_ego(EgoState(t_ns=k * DT_NS, speed_mps=v, yaw_rate_radps=-sign * v / radius))
        t.predict(k * DT_NS)
        if k < 45:
            t.update(measured(1, k * DT_NS, z, x), "plate")
        assert t.choose(k * DT_NS) is None
        track = t.tracks[1]
        if k > 15:
            assert not track.moved
            assert track.filter.lead_speed_mps == pytest.approx(0.0, abs=0.6)
            assert track.filter.range_rate_mps == pytest.approx(-v * math.cos(ahead) * (radius + 3.1) / radius, abs=0.6)
            assert track.lateral_m == pytest.approx(x, abs=0.5)  # also while it is not seen
            assert t.path_offset_m(track)[0] == pytest.approx(-sign * 3.1, abs=0.5)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_offset_of_an_arc(sign: float) -> None:
    path = OwnPath()
    for k in range(40):
        path.set_ego(EgoState(t_ns=k * DT_NS, speed_mps=10.0, yaw_rate_radps=sign * 0.2))
    offset, sigma = path.offset_m(0, 0.0, 0.0, 20.0)
    assert offset == pytest.approx(sign * (math.hypot(50.0, 20.0) - 50.0))
    assert 0.05 < sigma < 0.5
    path.set_ego(None)
    assert path.offset_m(0, 0.7, 0.1, 20.0)[0] == 0.7


def _hidden_plate(settings: TrackerSettings) -> tuple[LeadTracker, float]:
    """A plate ranged for 1 s at 20 m and closing at 2 m/s, then hidden for 2 s while its rear goes on growing."""
    tracker, growth_ns, then_m, true_m = LeadTracker(settings), 0, 20.0, 20.0
    for k in range(91):
        t_ns = round(k / 30 * 1e9)
        true_m = 20.0 - 2.0 * k / 30
        tracker.predict(t_ns)
        if k <= 30:
            tracker.update(
                RangeMeasurement(track_id=1, t_ns=t_ns, distance_m=true_m, sigma_m=0.2, noise_m=0.05, scale_sigma=0.01,
                                 lateral_m=0.0, lateral_sigma_m=0.05, down_m=0.0), "plate"
            )  # fmt: skip
        if k and k % 6 == 0:
            change = ScaleChange(track_id=1, t_from_ns=growth_ns, ratio=then_m / true_m, sigma=1e-3)
            tracker.grow(change, t_ns)
            growth_ns, then_m = t_ns, true_m
    return tracker, true_m


def test_the_vehicle_carries_a_hidden_plates_distance() -> None:
    tracker, true_m = _hidden_plate(TrackerSettings())
    (track,) = tracker.tracks.values()
    assert track.source == "vehicle"
    assert abs(track.filter.distance_m - true_m) < 0.05
    assert track.filter.range_rate_mps == pytest.approx(-2.0, abs=0.1)
    assert 0.01 * true_m < track.sigma_m < 0.02 * true_m  # the plate's own scale, and little more
    assert tracker.carries(1, track.measured_ns)


@pytest.mark.parametrize(("closing_mps", "believed"), [(25.0, False), (4.0, True)])
def test_a_hidden_vehicle_may_brake_hard_but_its_speed_does_not_jump(closing_mps: float, believed: bool) -> None:
    """What the rear's pixels settle on when the vehicle is lost grows at any speed: no warning may come of it."""
    tracker, true_m = _hidden_plate(TrackerSettings())
    (track,) = tracker.tracks.values()
    then_m, then_ns = true_m, round(3e9)
    for k in range(1, 4):
        now_m, t_ns = max(true_m - closing_mps * 0.2 * k, 1.0), round((3.0 + 0.2 * k) * 1e9)
        tracker.predict(t_ns)
        change = ScaleChange(track_id=1, t_from_ns=then_ns, ratio=then_m / now_m, sigma=1e-3)
        tracker.grow(change, t_ns)
        then_m, then_ns = now_m, t_ns
    assert (track.filter.range_rate_mps == pytest.approx(-closing_mps, abs=0.5)) == believed
    assert believed or track.filter.range_rate_mps == pytest.approx(-2.0, abs=0.5)


def test_without_vehicle_scale_a_hidden_plate_coasts() -> None:
    tracker, _ = _hidden_plate(TrackerSettings(vehicle_scale=False))
    (track,) = tracker.tracks.values()
    assert track.source == "plate"
    assert (track.t_ns - track.measured_ns) * 1e-9 == pytest.approx(2.0)
    assert track.sigma_m > 0.5
    assert not tracker.carries(1, track.t_ns)


def test_one_growth_that_contradicts_a_settled_speed_is_not_believed_two_are() -> None:
    f = RangeFilter(TrackerSettings(), distance_m=20.0, noise_m=0.2, ego_speed_mps=10.0)
    step_ns = 200_000_000

    def see(k: int, ratio: float) -> bool:
        change = ScaleChange(track_id=1, t_from_ns=k * step_ns, ratio=ratio, sigma=0.002)
        return _grow(f, change, 0.002, (k + 1) * step_ns).accepted

    f.set_anchor(0)
    for k in range(20):
        f.predict(0.2, 2.0)
        f.update_range(20.0, 0.2)
        assert see(k, 1.0)
    f.predict(0.2, 2.0)
    assert not see(20, 1.1)
    assert abs(f.range_rate_mps) < 0.5
    f.predict(0.2, 2.0)
    assert not see(21, 1.1)
    assert f.range_rate_mps == pytest.approx(-20.0 * 0.4766, abs=1.0)


def test_the_lane_ahead_decides_before_the_wheel_is_turned() -> None:
    """Driving straight towards a left bend: what stands straight ahead is off the lane, what stands in the bend is on it."""
    path = OwnPath()
    z = np.linspace(5.0, 40.0, 12)
    bend = np.column_stack([z, -np.maximum(z - 10.0, 0.0) ** 2 / 140, np.full(12, 0.1)])
    for k in range(20):
        path.set_ego(EgoState(t_ns=k * DT_NS, speed_mps=10.0, yaw_rate_radps=0.0))
    now = 19 * DT_NS
    assert path.offset_m(now, 0.0, 0.1, 30.0)[0] == 0.0
    path.set_course(now, bend)
    assert path.offset_m(now, 0.0, 0.1, 30.0)[0] == pytest.approx(400 / 140, abs=0.05)
    assert path.offset_m(now, -400 / 140, 0.1, 30.0)[0] == pytest.approx(0.0, abs=0.05)
    assert path.lane_seen(now, 39.0)
    assert not path.lane_seen(now, 45.0)  # not seen so far
    # 0.3 s later we are 3 m further; after half a second it is too old
    later = now + 300_000_000
    assert path.offset_m(later, 0.0, 0.1, 27.0)[0] == pytest.approx(400 / 140, abs=0.05)
    assert path.offset_m(now + 600_000_000, 0.0, 0.1, 27.0)[0] == 0.0
