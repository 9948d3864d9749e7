"""Scenarios in which the ego closes in on the lead."""

from __future__ import annotations

from dataclasses import replace

from tmde_edge.simulation.camera import hd_camera
from tmde_edge.simulation.scenario import Actor, Expectation, Scenario
from tmde_edge.simulation.scenarios import BUMPER_M, Look, base, scenario
from tmde_edge.simulation.scene import NIGHT
from tmde_edge.simulation.sensor import Sensor
from tmde_edge.simulation.world import Motion, Road

MPH_45 = 45 * 0.44704
_TELE = hd_camera(fx_px=4886.0, width_px=1920, height_px=1080, height_m=1.3, to_bumper_m=BUMPER_M, pitch_rad=0.012)
US = "us-openalpr"


@scenario("approach", "city: a standing car 30 m ahead, we roll up to 4 m and brake late")
def approach(look: Look) -> Scenario:
    speed = look.near(7.0, 0.06)
    decel = 2.6
    cruise_s = (30.0 - 4.0 - speed**2 / (2 * decel)) / speed
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((cruise_s, -decel),))
    lead = Actor(name="lead", motion=Motion(start_m=30.0, speed_mps=0.0), body=look.body(), face=look.face())
    return base(
        look, "approach", duration_s=round(cruise_s + speed / decel + 1.0, 1), ego=ego, actors=(lead,),
        expectation=Expectation(warn_ttc_min_s=1.8, max_relative_error=0.03),
    )


@scenario("stopped", "city: 50 km/h towards a standing car, no braking until late; a warning is due")
def stopped(look: Look) -> Scenario:
    speed = look.near(13.9, 0.05)
    start = 5.5 * speed + BUMPER_M
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((4.4, -9.0),))
    lead = Actor(name="lead", motion=Motion(start_m=start, speed_mps=0.0), body=look.body(), face=look.face())
    return base(
        look, "stopped", duration_s=6.3, ego=ego, actors=(lead,),
        expectation=Expectation(warn_ttc_min_s=1.6, max_relative_error=0.03),
    )


def _nhtsa(look: Look, name: str, duration_s: float, gap_m: float, lead: Motion, least_ttc_s: float) -> Scenario:
    """45 mph on a straight road with a 16 mm lens (NHTSA FCW confirmation test)."""
    speed = look.near(MPH_45, 0.01)
    placed = replace(lead, start_m=gap_m + BUMPER_M)
    actor = Actor(name="lead", motion=placed, body=look.body("sedan", "suv"), face=look.face(US))
    return base(
        look, name, duration_s=duration_s, ego=Motion(start_m=0.0, speed_mps=speed), actors=(actor,), camera=_TELE,
        expect=(look.plate or US,), expectation=Expectation(warn_ttc_min_s=least_ttc_s),
    )


@scenario("nhtsa-stopped", "NHTSA FCW 1: 45 mph towards a stopped lead, 16 mm lens; warning at or before TTC 2.1 s")
def nhtsa_stopped(look: Look) -> Scenario:
    return _nhtsa(look, "nhtsa-stopped", 6.6, 7.6 * MPH_45, Motion(start_m=0.0, speed_mps=0.0), 2.1)


@scenario("nhtsa-decelerating", "NHTSA FCW 2: 45 mph, 30 m behind a lead that brakes with 0.3 g; TTC 2.4 s")
def nhtsa_decelerating(look: Look) -> Scenario:
    lead = Motion(start_m=0.0, speed_mps=MPH_45, accels=((2.5, -0.3 * 9.81),))
    return _nhtsa(look, "nhtsa-decelerating", 6.2, 30.0, lead, 2.4)


@scenario("nhtsa-slower", "NHTSA FCW 3: 45 mph towards a lead at 20 mph, 16 mm lens; warning at or before TTC 2.0 s")
def nhtsa_slower(look: Look) -> Scenario:
    lead_speed = 20 * 0.44704
    return _nhtsa(look, "nhtsa-slower", 6.2, 7.2 * (MPH_45 - lead_speed), Motion(start_m=0.0, speed_mps=lead_speed), 2.0)


@scenario("ccrb", "Euro-NCAP-like CCRb: both at 50 km/h, 40 m apart, the lead brakes with 6 m/s^2")
def ccrb(look: Look) -> Scenario:
    speed = look.near(50 / 3.6, 0.01)
    lead = Motion(start_m=40.0 + BUMPER_M, speed_mps=50 / 3.6, accels=((2.0, -6.0),))
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((5.2, -9.0),))
    actor = Actor(name="lead", motion=lead, body=look.body(), face=look.face())
    return base(
        look, "ccrb", duration_s=6.5, ego=ego, actors=(actor,), expectation=Expectation(warn_ttc_min_s=1.7)
    )


@scenario("cut-in", "a slower car from the left lane pulls in close ahead")
def cut_in(look: Look) -> Scenario:
    speed = look.near(20.0, 0.03)
    style = look.road(skyline="trees")
    lead = Actor(
        name="cutter", motion=Motion(start_m=31.0 + BUMPER_M, speed_mps=speed - 5.5), lateral=((1.5, -3.5), (4.0, 0.0)),
        body=look.body(), face=look.face(),
    )
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((4.9, -9.0),))
    return base(
        look, "cut-in", duration_s=6.4, ego=ego, actors=(lead,), style=style, expectation=Expectation(warn_ttc_min_s=1.4)
    )


@scenario("cut-out", "the lead leaves the lane and uncovers a standing car")
def cut_out(look: Look) -> Scenario:
    speed = look.near(12.5, 0.03)
    lead = Actor(
        name="leaving", motion=Motion(start_m=16.0 + BUMPER_M, speed_mps=speed), lateral=((2.0, 0.0), (4.0, -3.5)),
        body=look.body("sedan", "hatch"), face=look.face(),
    )
    standing = Actor(name="standing", motion=Motion(start_m=7.0 * speed + BUMPER_M, speed_mps=0.0), body=look.body("suv"),
                     face=look.face(text="B CD 4567"))
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((5.8, -9.0),))
    return base(
        look, "cut-out", duration_s=7.2, ego=ego, actors=(lead, standing), expectation=Expectation(warn_ttc_min_s=1.5)
    )


@scenario("two-leads", "a car in the next lane brakes first, then our own lead does")
def two_leads(look: Look) -> Scenario:
    speed = look.near(13.9, 0.02)
    own = Actor(name="own", motion=Motion(start_m=26.0 + BUMPER_M, speed_mps=speed, accels=((4.5, -5.5),)), body=look.body(),
                face=look.face())
    other = Actor(
        name="next-lane", motion=Motion(start_m=16.0 + BUMPER_M, speed_mps=speed, accels=((1.5, -6.0),)),
        lateral=((0.0, -3.5),), body=look.body(), face=look.face(text="HH XY 987"),
    )
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((6.9, -9.0),))
    return base(
        look, "two-leads", duration_s=8.0, ego=ego, actors=(own, other), expectation=Expectation(warn_ttc_min_s=1.5)
    )


@scenario("bend", "town: a car stands in our lane round a bend, where it comes in sight late; a warning is due")
def bend(look: Look) -> Scenario:
    speed = look.near(12.0, 0.05)
    start = 75.0
    curvature = 1 / look.near(80.0, 0.1)
    contact_s = (start - BUMPER_M) / speed
    car = Actor(name="standing", motion=Motion(start_m=start, speed_mps=0.0), body=look.body(), face=look.face())
    return base(
        look, "bend", duration_s=round(contact_s + 0.2, 1), actors=(car,), style=look.road(skyline="town"),
        ego=Motion(start_m=0.0, speed_mps=speed, accels=((contact_s - 0.9, -9.0),)),
        road=Road(curvature=((40.0, 0.0), (50.0, curvature), (200.0, curvature))),
        expectation=Expectation(warn_ttc_min_s=1.5),
    )


@scenario("night", "night: own headlamps on the plate, lit tail lamps, towards a slower car")
def night(look: Look) -> Scenario:
    speed = look.near(14.0, 0.04)
    lead = Actor(name="lead", motion=Motion(start_m=44.0, speed_mps=6.0), body=look.body(), face=look.face())
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((4.4, -6.0),))
    return base(
        look, "night", duration_s=8.5, ego=ego, actors=(lead,), light=NIGHT, style=look.road(sky="night"), subframes=2,
        exposure_time_s=0.016, sensor=Sensor(blur_px=0.8, noise=5.0), pitch_amplitude_rad=0.002,
        expectation=Expectation(warn_ttc_min_s=1.4),
    )


@scenario("parking", "parking: from 3 m to 0.4 m, the plate fills and leaves the picture")
def parking(look: Look) -> Scenario:
    speed = 0.8
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((2.65, -0.667),))
    lead = Actor(name="lead", motion=Motion(start_m=3.02, speed_mps=0.0), body=replace(look.body(), plate_up_m=0.82),
                 face=look.face())
    camera = hd_camera(height_m=0.9, to_bumper_m=0.0, pitch_rad=0.0)
    return base(
        look, "parking", duration_s=4.8, ego=ego, actors=(lead,), camera=camera, dive_rad_per_mps2=0.0,
        expectation=Expectation(no_warning=True, max_relative_error=0.02, min_lead_share=0.7),
    )
