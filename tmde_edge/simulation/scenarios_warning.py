"""Scenarios in which the ego closes in on the lead."""

from __future__ import annotations

from tmde_edge.simulation.scenario import Actor, Expectation, Scenario
from tmde_edge.simulation.scenarios import Look, base, scenario
from tmde_edge.simulation.world import Motion


@scenario("approach", "city: a standing car 30 m ahead, we roll up to 4 m and brake late")
def approach(look: Look) -> Scenario:
    # 25 km/h, then 2.2 m/s^2 to a stop 4 m from its plate
    speed = look.near(7.0, 0.06)
    decel = 2.6
    braking_m = speed**2 / (2 * decel)
    cruise_s = (30.0 - 4.0 - braking_m) / speed
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((cruise_s, -decel),))
    lead = Actor(name="lead", motion=Motion(start_m=30.0, speed_mps=0.0), body=look.body(), face=look.face())
    return base(
        look, "approach", duration_s=round(cruise_s + speed / decel + 1.0, 1), ego=ego, actors=(lead,),
        expectation=Expectation(max_relative_error=0.03),
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
        expectation=Expectation(no_warning=True, no_ttc_caution=True, max_relative_error=0.03),
    )


@scenario("stopped", "city: 50 km/h towards a standing car, no braking until late; a warning is due")
def stopped(look: Look) -> Scenario:
    speed = look.near(13.9, 0.05)
    start = 5.5 * speed + 1.5
    ego = Motion(start_m=0.0, speed_mps=speed, accels=((4.4, -9.0),))
    lead = Actor(name="lead", motion=Motion(start_m=start, speed_mps=0.0), body=look.body(), face=look.face())
    return base(
        look, "stopped", duration_s=6.3, ego=ego, actors=(lead,),
        expectation=Expectation(warn_ttc_min_s=1.6, max_relative_error=0.03),
    )
