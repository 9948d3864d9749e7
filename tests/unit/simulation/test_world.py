"""Kinematics against their closed forms, and against stepwise integration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.simulation.world import Motion, Road, eased, recorded, surroundings, ttc_counting_accel


@settings(deadline=None, max_examples=40)
@given(
    speed=st.floats(0, 40), accels=st.lists(st.tuples(st.floats(0, 8), st.floats(-9, 4)), max_size=4),
    t=st.floats(0, 10),
)
def test_motion_is_the_integral_of_its_speed_and_never_reverses(
    speed: float, accels: list[tuple[float, float]], t: float
) -> None:
    motion = Motion(start_m=3.0, speed_mps=speed, accels=tuple(sorted(accels)))
    times = np.linspace(0, t, 801)
    speeds = np.array([motion.state(float(x))[1] for x in times])
    assert (speeds >= 0).all()
    travelled = float(np.sum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(times)))
    assert motion.state(t)[0] - 3.0 == pytest.approx(travelled, abs=0.02)


def test_braking_car_stops_where_v_squared_over_2a_says() -> None:
    motion = Motion(start_m=0.0, speed_mps=10.0, accels=((1.0, -5.0),))
    assert motion.state(20.0) == (pytest.approx(10.0 + 10.0), 0.0, 0.0)


def test_recorded_travel_keeps_places_and_speeds() -> None:
    t = np.linspace(0, 10, 201)
    v = 10 + 3 * np.sin(t)
    ride = recorded(t, v)
    s, speed, accel = ride.state(5.0)
    assert s == pytest.approx(50 + 3 * (1 - np.cos(5.0)), abs=2e-3)
    assert speed == pytest.approx(10 + 3 * np.sin(5.0), abs=1e-3)
    assert accel == pytest.approx(3 * np.cos(5.0), abs=0.1)


def test_curve_places_points_on_its_circle() -> None:
    here = surroundings(Road(curvature=((0.0, 0.02), (500.0, 0.02))), 100.0, 0.0, 0.0, 1.3)
    x, down, z, heading = here.place(130.0, 0.0)
    assert (x, z) == (pytest.approx(50 * (1 - np.cos(0.6)), abs=0.01), pytest.approx(50 * np.sin(0.6), abs=0.01))
    assert heading == pytest.approx(0.6, abs=1e-6)
    assert down == 1.3
    side = here.place(130.0, 2.0)
    assert np.hypot(50 - side[0], side[2]) == pytest.approx(48.0, abs=0.02)  # right of a right bend: nearer its middle


def test_level_frame_follows_the_slope_under_the_ego() -> None:
    climb = Road(elevation=((0.0, 0.0), (100.0, 8.0), (200.0, 8.0)))
    here = surroundings(climb, 50.0, 0.0, 0.0, 1.3)
    assert here.place(50.0, 0.0)[1] == pytest.approx(1.3, abs=1e-3)
    assert here.slope == pytest.approx(np.pi / 2 * 0.08, rel=0.01)
    assert here.place(90.0, 0.0)[1] > 1.5  # the road ahead flattens: it falls away below our tangent


def test_eased_passes_smoothly() -> None:
    keys = ((1.0, 0.0), (3.0, 4.0))
    assert [eased(keys, t) for t in (0.0, 1.0, 2.0, 3.0, 9.0)] == pytest.approx([0, 0, 2, 4, 4])


@settings(deadline=None, max_examples=60)
@given(
    gap=st.floats(1, 100), ego=st.floats(0, 30), lead=st.floats(0, 30), ego_accel=st.floats(-6, 2),
    lead_accel=st.floats(-8, 2),
)
def test_ttc_with_braking_agrees_with_stepping_through_time(
    gap: float, ego: float, lead: float, ego_accel: float, lead_accel: float
) -> None:
    found = ttc_counting_accel(gap, ego, ego_accel, lead, lead_accel)
    a = Motion(start_m=0.0, speed_mps=ego, accels=((0.0, ego_accel),))
    b = Motion(start_m=gap, speed_mps=lead, accels=((0.0, lead_accel),))
    times = np.linspace(0.0, 15.0, 1501)
    gaps = np.array([b.state(float(t))[0] - a.state(float(t))[0] for t in times])
    if found is not None and found < 15:
        assert b.state(found)[0] - a.state(found)[0] == pytest.approx(0.0, abs=1e-3)
        assert (gaps[times < found - 1e-3] > -1e-6).all()
    else:
        assert (gaps > -1e-3).all()


def test_nhtsa_decelerating_case_has_the_known_ttc() -> None:
    # 30 m, both 45 mph, lead brakes with 0.3 g: sqrt(2 * 30 / 2.943)
    assert ttc_counting_accel(30.0, 20.1168, 0.0, 20.1168, -2.943) == pytest.approx(4.515, abs=1e-3)
