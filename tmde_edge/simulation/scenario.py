"""What a scenario is: road, ego, other vehicles, light and camera over time, and what the warner must make of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tmde_edge.simulation.camera import SimCamera
from tmde_edge.simulation.ground import RoadStyle
from tmde_edge.simulation.scene import DAY, Light
from tmde_edge.simulation.sensor import Sensor
from tmde_edge.simulation.standard_face import StandardFace
from tmde_edge.simulation.vehicle import Body
from tmde_edge.simulation.world import Keys, Motion, Recorded, Road, eased


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What must and must not be told. TTC is the true one of the gap, the lead's braking counted where it brakes.

    At least one of warn_ttc_min_s, max_relative_error, min_lead_share, min_plate_share wherever there is something to see:
    nothing else fails a program that sees nothing.
    """

    warn_ttc_min_s: float | None = None  # a warning is due at or before the TTC falls to this
    warn_ttc_max_s: float = 4.0  # and no warning or caution by TTC comes above it
    no_warning: bool = False
    no_ttc_caution: bool = False
    no_lead: bool = False  # no lead and no plate in the path may be reported in more than 2 % of the frames
    max_relative_error: float | None = None  # median of |distance error| of the lead, where its plate is wide
    min_lead_share: float | None = None  # of the frames with a vehicle in the path: a lead with a distance is reported
    min_plate_share: float | None = None  # of the wide plates, of the lead or of others: found
    wide_px: float = 60.0  # a plate from this width on is wide


@dataclass(frozen=True, slots=True, kw_only=True)
class Actor:
    """Another vehicle; `motion` moves its rear along the road, lateral is against the middle of the ego lane."""

    name: str
    motion: Motion | Recorded
    body: Body
    face: StandardFace | None
    lateral: Keys = ((0.0, 0.0),)  # (t_s, m)
    hidden: Keys = ()  # (t_s, share of the plate's width covered)
    braking_lamps: bool = True
    plate_tilt_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Prop:
    """Scenery at a place along the road."""

    kind: str
    variant: int
    s_m: float
    lateral_m: float
    text: str = ""


SPRINGS_S = 0.4  # how long the body's springs take to follow braking


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One drive. The camera travels with `ego`; times in seconds from the first frame."""

    name: str
    text: str
    duration_s: float
    camera: SimCamera
    ego: Motion | Recorded
    style: RoadStyle
    actors: tuple[Actor, ...] = ()
    props: tuple[Prop, ...] = ()
    road: Road = field(default_factory=Road)
    rate_hz: float = 30.0
    ego_lateral: Keys = ((0.0, 0.0),)
    pitch_amplitude_rad: float = 0.0
    pitch_hz: float = 1.3
    dive_rad_per_mps2: float = 0.0025  # nose down when braking
    light: Light = DAY
    exposure: Keys = ()  # (t_s, gain of the sensor), 1 where empty
    sensor: Sensor = field(default_factory=Sensor)
    exposure_time_s: float = 0.0  # with subframes > 1: motion blur
    subframes: int = 1
    tunnel_exit_m: float | None = None  # arc length of the portal; before it is tunnel
    expect: tuple[str, ...] = ()  # plates.expect of the configuration
    expectation: Expectation = field(default_factory=Expectation)
    yaw_offset_radps: float = 0.0  # zero error of the yaw rate sensor
    measured_yaw: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # (t_s, rad/s left positive) as recorded
    seed: int = 0

    @property
    def frame_count(self) -> int:
        """Frames are taken at i / rate_hz."""
        return round(self.duration_s * self.rate_hz)

    def pitch_rad(self, t_s: float) -> float:
        """Change of the camera's pitch against its rest: oscillation, and the dive of braking."""
        # the springs follow the mean of the last moments, and not the noise of a recorded speed
        ago = [d * SPRINGS_S / 8 for d in range(5)]
        gained = [self.ego.state(t_s - d)[1] - self.ego.state(t_s - d - SPRINGS_S / 2)[1] for d in ago]
        accel = float(np.mean(gained)) / (SPRINGS_S / 2)
        wave = self.pitch_amplitude_rad * np.sin(2 * np.pi * self.pitch_hz * t_s)
        return float(wave - self.dive_rad_per_mps2 * accel)

    def heading_rad(self, t_s: float) -> float:
        """The ego's heading against the road, right positive, from its lateral motion."""
        speed = self.ego.state(t_s)[1]
        if speed < 0.5:
            return 0.0
        drift = (eased(self.ego_lateral, t_s + 0.01) - eased(self.ego_lateral, t_s - 0.01)) / 0.02
        return float(np.arctan2(drift, speed))

    def yaw_rate_radps(self, t_s: float) -> float:
        """True yaw rate of the ego, LEFT positive as on every vehicle bus (ISO 8855)."""
        s, v, _ = self.ego.state(t_s)
        turn = v * float(self.road.curvature_at(np.array([s]))[0])
        turn += (self.heading_rad(t_s + 0.02) - self.heading_rad(t_s - 0.02)) / 0.04
        return -turn
