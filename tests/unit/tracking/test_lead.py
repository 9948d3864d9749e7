"""Which track is the lead, and what happens when identities change."""

from __future__ import annotations

import pytest

from tmde_edge.messages import EgoState, RangeMeasurement
from tmde_edge.tracking.lead import LeadTracker
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
