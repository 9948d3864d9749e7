"""Scenarios of traffic in which nothing is to be warned of."""

from __future__ import annotations

import csv
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from tmde_edge.errors import InputMissingError
from tmde_edge.simulation.camera import Array, hd_camera
from tmde_edge.simulation.ground import Marking
from tmde_edge.simulation.scenario import Actor, Expectation, Prop, Scenario
from tmde_edge.simulation.scenarios import BUMPER_M, Look, base, scenario
from tmde_edge.simulation.world import Motion, Recorded, Road, recorded

QUIET = Expectation(no_warning=True, no_ttc_caution=True)
THREE_LANES = (
    Marking(lateral_m=-5.25, width_m=0.15), Marking(lateral_m=-1.75, dash_m=6.0, gap_m=12.0, width_m=0.15),
    Marking(lateral_m=1.75, dash_m=6.0, gap_m=12.0, width_m=0.15), Marking(lateral_m=5.25, width_m=0.25),
)


@scenario("follow", "city: following at 1.5 to 2 s with gentle changes of speed; nothing to warn of")
def follow(look: Look) -> Scenario:
    speed = look.near(12.0, 0.08)
    lead = Actor(
        name="lead",
        motion=Motion(start_m=speed * 1.8, speed_mps=speed, accels=((2.0, -0.8), (4.0, 0.0), (5.5, 0.8), (7.5, 0.0))),
        body=look.body(), face=look.face(),
    )
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((2.8, -0.8), (4.8, 0.0), (6.3, 0.8), (8.3, 0.0)))
    return base(
        look, "follow", duration_s=10.0, ego=ego, actors=(lead,), pitch_amplitude_rad=0.003,
        expectation=replace(QUIET, max_relative_error=0.03, wide_px=30.0, min_lead_share=0.9),
    )


@scenario("pitching", "following on a bad road: the camera pitches by 2 degrees, with motion blur")
def pitching(look: Look) -> Scenario:
    speed = look.near(11.0, 0.05)
    lead = Actor(name="lead", motion=Motion(start_m=18.0, speed_mps=speed), body=look.body(), face=look.face())
    return base(
        look, "pitching", duration_s=8.0, ego=Motion(start_m=0.0, speed_mps=speed), actors=(lead,),
        pitch_amplitude_rad=float(np.radians(2.0)), pitch_hz=look.near(1.2, 0.2), subframes=3, exposure_time_s=0.008,
        expectation=replace(QUIET, max_relative_error=0.03, wide_px=30.0, min_lead_share=0.8),
    )


@scenario("adjacent", "motorway: we pass slower cars in the next lanes; nothing is in our path")
def adjacent(look: Look) -> Scenario:
    speed = look.near(25.0, 0.04)
    style = replace(look.road(skyline="trees"), markings=THREE_LANES, left_m=-6.0, right_m=6.2)
    left = Actor(name="left", motion=Motion(start_m=40.0, speed_mps=speed - 5.0), lateral=((0.0, -3.5),), body=look.body(),
                 face=look.face())
    right = Actor(name="right", motion=Motion(start_m=62.0, speed_mps=speed - 6.0), lateral=((0.0, 3.5),),
                  body=look.body("van", "suv"), face=look.face(text="K LM 321"))
    return base(
        look, "adjacent", duration_s=9.0, ego=Motion(start_m=0.0, speed_mps=speed), actors=(left, right), style=style,
        expectation=replace(QUIET, min_plate_share=0.8),
    )


@scenario("curve", "town: a left bend with cars parked along its outer kerb")
def curve(look: Look) -> Scenario:
    speed = look.near(10.5, 0.05)
    style = replace(look.road(skyline="town"), right_m=4.3)
    bend = 1.0 / look.near(70.0, 0.1)
    road = Road(curvature=((25.0, 0.0), (40.0, -bend), (110.0, -bend), (125.0, 0.0)))
    cars = tuple(
        Actor(name=f"parked{k}", motion=Motion(start_m=s, speed_mps=0.0), lateral=((0.0, 3.1),), body=look.body(),
              face=look.face(text=f"D PK {100 + 37 * k}"))
        for k, s in enumerate((48.0, 55.0, 63.0, 78.0, 86.0, 95.0))
    )
    return base(
        look, "curve", duration_s=9.5, ego=Motion(start_m=0.0, speed_mps=speed), actors=cars, road=road, style=style,
        expectation=replace(QUIET, min_plate_share=0.8),
    )


@scenario("crest", "following over a crest: the lead sinks from sight and comes back")
def crest(look: Look) -> Scenario:
    speed = look.near(13.0, 0.05)
    road = Road(elevation=((20.0, 0.0), (55.0, 3.4), (65.0, 3.4), (105.0, -1.5)))
    lead = Actor(name="lead", motion=Motion(start_m=34.0, speed_mps=speed), body=look.body(), face=look.face())
    return base(
        look, "crest", duration_s=9.0, ego=Motion(start_m=0.0, speed_mps=speed), actors=(lead,), road=road,
        style=look.road(skyline="hills"), expectation=replace(QUIET, min_lead_share=0.5),
    )


@scenario("empty", "an empty road with signs, boards and lettering, and an oncoming lane; no plate anywhere")
def empty(look: Look) -> Scenario:
    speed = look.near(13.9, 0.05)
    style = look.road(skyline="town")
    texts = ("AB 1234 KM|CENTRUM 3", "HOTEL 24H|PARK 300 M", "BAKERY 1897|OPEN 7-19", "B 96 NORD|A 10 RING")
    boards = tuple(
        Prop(kind="board", variant=k, s_m=28.0 + 24.0 * k, lateral_m=6.8 if k % 3 else -9.0, text=texts[k % 4])
        for k in range(9)
    )
    made = base(look, "empty", duration_s=9.0, ego=Motion(start_m=0.0, speed_mps=speed), style=style,
                expectation=replace(QUIET, no_lead=True))
    return replace(made, props=(*made.props, *boards))


@scenario("tunnel", "following out of a tunnel: glare, then the exposure adapts")
def tunnel(look: Look) -> Scenario:
    speed = look.near(14.0, 0.05)
    out_s = 4.0
    lead = Actor(name="lead", motion=Motion(start_m=20.0, speed_mps=speed), body=look.body(), face=look.face())
    return base(
        look, "tunnel", duration_s=8.0, ego=Motion(start_m=0.0, speed_mps=speed), actors=(lead,),
        tunnel_exit_m=out_s * speed, exposure=((out_s - 1.2, 2.4), (out_s + 0.9, 1.0)),
        expectation=replace(QUIET, min_lead_share=0.8),
    )


@scenario("hidden", "following, the plate covered for 0.6 s")
def hidden(look: Look) -> Scenario:
    speed = look.near(11.0, 0.05)
    lead = Actor(
        name="lead", motion=Motion(start_m=15.0, speed_mps=speed - 0.7), body=look.body(), face=look.face(),
        hidden=((3.0, 0.0), (3.05, 1.0), (3.65, 1.0), (3.7, 0.0)),
    )
    return base(
        look, "hidden", duration_s=6.0, ego=Motion(start_m=0.0, speed_mps=speed), actors=(lead,),
        expectation=replace(QUIET, max_relative_error=0.03, min_lead_share=0.9),
    )


def _gap(look: Look, name: str, ego: Motion, lead: Motion, gap: tuple[float, float], road: Road | None = None) -> Scenario:
    """A drive in which the plate is covered for a while; nothing to warn of."""
    actor = Actor(
        name="lead", motion=lead, body=look.body(), face=look.face(),
        hidden=((gap[0] - 0.05, 0.0), (gap[0], 1.0), (gap[1], 1.0), (gap[1] + 0.05, 0.0)),
    )
    return base(look, name, duration_s=gap[1] + 2.0, ego=ego, actors=(actor,), road=road or Road(),
                expectation=replace(QUIET, min_lead_share=0.8))


@scenario("gap-steady", "following, the plate covered for 1 s")
def gap_steady(look: Look) -> Scenario:
    v = look.near(11.0, 0.05)
    return _gap(look, "gap-steady", Motion(start_m=0.0, speed_mps=v), Motion(start_m=14.0, speed_mps=v), (4.0, 5.0))


@scenario("gap-braking", "the lead brakes gently while its plate is covered for 1.5 s")
def gap_braking(look: Look) -> Scenario:
    v = look.near(11.0, 0.05)
    lead = Motion(start_m=20.0, speed_mps=v, accels=((4.2, -1.2), (5.4, 0.0)))
    ego = Motion(start_m=0.0, speed_mps=v, accels=((5.0, -1.4), (6.4, 0.0)))
    return _gap(look, "gap-braking", ego, lead, (4.0, 5.5))


@scenario("gap-away", "the lead pulls away while its plate is covered for 1.5 s")
def gap_away(look: Look) -> Scenario:
    v = look.near(9.0, 0.05)
    lead = Motion(start_m=11.0, speed_mps=v, accels=((4.1, 1.6), (6.0, 0.0)))
    return _gap(look, "gap-away", Motion(start_m=0.0, speed_mps=v), lead, (4.0, 5.5))


@scenario("gap-closing", "we close in slowly while the plate is covered for 2 s")
def gap_closing(look: Look) -> Scenario:
    v = look.near(10.0, 0.05)
    lead = Motion(start_m=22.0, speed_mps=v - 1.0, accels=((4.3, -0.7), (5.3, 0.7), (6.3, 0.0)))
    return _gap(look, "gap-closing", Motion(start_m=0.0, speed_mps=v, accels=((6.0, -1.0), (7.5, 0.0))), lead, (4.0, 6.0))


@scenario("gap-curve", "following through a bend, the plate covered for 1.5 s")
def gap_curve(look: Look) -> Scenario:
    v = look.near(10.0, 0.05)
    road = Road(curvature=((20.0, 0.0), (45.0, 1 / 140), (110.0, 1 / 140)))
    lead = Motion(start_m=15.0, speed_mps=v, accels=((4.2, -0.9), (5.2, 0.9), (6.2, 0.0)))
    return _gap(look, "gap-curve", Motion(start_m=0.0, speed_mps=v), lead, (4.0, 5.5), road)


@scenario("no-plate", "following a lead without a plate")
def no_plate(look: Look) -> Scenario:
    speed = look.near(12.0, 0.05)
    lead = Actor(name="lead", motion=Motion(start_m=20.0, speed_mps=speed), body=look.body(), face=None)
    return base(look, "no-plate", duration_s=6.0, ego=Motion(start_m=0.0, speed_mps=speed), actors=(lead,), expectation=QUIET)


@scenario("away", "from a standstill: the lead pulls away faster than we do")
def away(look: Look) -> Scenario:
    lead = Actor(name="lead", motion=Motion(start_m=6.0, speed_mps=0.0, accels=((1.0, look.near(2.4, 0.1)), (6.0, 0.4))),
                 body=look.body(), face=look.face())
    ego = Motion(start_m=0.0, speed_mps=0.0, accels=((1.8, 1.9), (6.5, 0.3)))
    return base(
        look, "away", duration_s=9.0, ego=ego, actors=(lead,), expectation=replace(QUIET, min_lead_share=0.8)
    )


@scenario("real", "real kinematics: speed, yaw and lead distance of a RAV4 over 60 s (needs the shared recordings)")
def real(look: Look) -> Scenario:
    t_s, speed, yaw_radps, distance = _rav4()
    true_yaw = yaw_radps - np.radians(-0.43)  # its sensor's known zero offset, left positive
    ego = recorded(t_s, speed)
    # right positive curvature along the way, from what the car did
    bend = -_smooth(true_yaw, 10) / np.maximum(speed, 2.0)
    keys = tuple((float(s), float(k)) for s, k in zip(ego.place_m[::5], bend[::5], strict=True))
    jump = int(np.argmax(np.abs(np.diff(distance)))) + 1  # there the first lead turns off and a farther one is seen
    first = _lead_motion(t_s, ego, distance, 0, jump)
    second = _lead_motion(t_s, ego, distance, jump, len(t_s))
    leaves = float(t_s[jump])
    style = replace(look.road(skyline="trees"), markings=THREE_LANES, left_m=-6.0, right_m=6.2)
    cars = (
        Actor(name="first", motion=first, lateral=((leaves - 2.5, 0.0), (leaves, 3.6)), body=look.body(), face=look.face()),
        Actor(name="second", motion=second, body=look.body(), face=look.face(text="S UV 606")),
    )
    made = base(
        look, "real", duration_s=float(t_s[-1]) - 0.1, ego=Motion(start_m=0.0, speed_mps=1.0), actors=cars,
        camera=hd_camera(fx_px=2400.0, height_m=1.3, to_bumper_m=BUMPER_M, pitch_rad=0.015), style=style,
        road=Road(curvature=keys), rate_hz=20.0,
        measured_yaw=(tuple(map(float, t_s)), tuple(map(float, yaw_radps))),
        expectation=replace(QUIET, min_lead_share=0.7),
    )
    return replace(made, ego=ego, props=look.props(style, ego.place_m[-1]))


def _rav4() -> tuple[Array, Array, Array, Array]:
    """Time, wheel speed, yaw rate (rad/s, left positive, with its offset) and lead distance (m) at 20 Hz."""
    path = Path(os.environ.get("TMDE_SHARED", "../shared")) / "data" / "can_rav4" / "lead_gt_20hz.csv"
    if not path.exists():
        raise InputMissingError(f"{path}: not there; scenario 'real' needs the shared recordings (set TMDE_SHARED)")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    t, v, yaw = (np.array([float(r[k]) for r in rows]) for k in ("t_boot_s", "v_wheel_mps", "yaw_rate_can_dps"))
    distance = np.array([float(r["lead_dist_m"] or "nan") for r in rows])
    known = np.isfinite(distance)
    distance = np.interp(t, t[known], distance[known])
    return t - t[0], v, np.radians(yaw), distance


def _smooth(values: Array, half: int) -> Array:
    """Mean over 2 half + 1 samples, ends held."""
    padded = np.pad(values, half, mode="edge")
    return np.asarray(np.convolve(padded, np.ones(2 * half + 1) / (2 * half + 1), mode="valid"), np.float64)


def _lead_motion(t_s: Array, ego: Recorded, distance_m: Array, first: int, last: int) -> Recorded:
    """A lead's travel from the radar's distances of rows [first, last); before and after it keeps its speed."""
    t = t_s[first:last]
    place = np.asarray(ego.place_m)[first:last] + _smooth(distance_m[first:last], 8) + BUMPER_M
    speed = _smooth(np.gradient(place, t), 8)
    lead = recorded(t, speed, float(place[0]))
    drift = place - np.asarray(lead.place_m)  # what smoothing the speed moved
    places = np.asarray(lead.place_m) + _smooth(drift, 20)
    before, after = float(t_s[0]) - 1.0, float(t_s[-1]) + 1.0
    return Recorded(
        t_s=(before, *map(float, t), after), speed_mps=(float(speed[0]), *map(float, speed), float(speed[-1])),
        place_m=(float(places[0] - speed[0] * (t[0] - before)), *map(float, places),
                 float(places[-1] + speed[-1] * (after - t[-1]))),
    )
