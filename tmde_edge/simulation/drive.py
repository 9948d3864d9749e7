"""A scenario at one instant: the picture, and the exact truth beside it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tmde_edge.simulation.camera import Array, View, view_of
from tmde_edge.simulation.compose import Image
from tmde_edge.simulation.ground import RoadAhead, horizon_row
from tmde_edge.simulation.scenario import Actor, Scenario
from tmde_edge.simulation.scene import (
    CardAt,
    VehicleAt,
    face_corners_mm,
    on_plate,
    plate_corners_px,
    plate_pose,
    render,
)
from tmde_edge.simulation.sensor import Sensor, expose
from tmde_edge.simulation.stills import glyph_corners_px
from tmde_edge.simulation.vehicle import body_size, outline_m
from tmde_edge.simulation.world import eased, surroundings, ttc_counting_accel

IN_PATH_M = 1.4  # a vehicle whose rear's middle is nearer than this to the ego's own track is in its path
_HIDDEN_BY_M = 8.0


@dataclass(frozen=True, slots=True)
class Instant:
    """Everything placed, ready to be painted or measured."""

    view: View
    pitch_rad: float  # whole attitude of the camera against the road
    roll_rad: float
    ahead: RoadAhead
    vehicles: tuple[VehicleAt, ...]  # as scenario.actors that are in front
    actors: tuple[Actor, ...]
    cards: tuple[CardAt, ...]
    slope: float
    tunnel_z_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleTruth:
    """One vehicle in one frame; pixels of the image, metres in the level frame; None: no plate."""

    frame: int
    t_s: float
    name: str
    distance_m: float  # lens to plate centre (or where it would be) along the forward axis
    range_rate_mps: float
    gap_m: float
    ttc_s: float | None  # of the gap at the present rate
    ttc_braking_s: float | None  # with the lead's braking counted, and ours not: nobody brakes until warned
    lateral_m: float
    path_offset_m: float  # of its rear from the ego's own track
    in_path: bool
    plate_corners_px: tuple[float, ...] | None
    char_height_px: float | None
    glyph_count: int | None
    plate_visible: float  # share of the plate in the frame and not covered
    speed_mps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTruth:
    """One frame: the ego, the camera's attitude, and all vehicles; the lead is the nearest in the path."""

    frame: int
    t_s: float
    ego_speed_mps: float
    yaw_rate_radps: float  # left positive
    pitch_rad: float
    roll_rad: float
    horizon_px: float  # row of the road plane's horizon at the principal column
    lead: VehicleTruth | None
    vehicles: tuple[VehicleTruth, ...]


def instant(scenario: Scenario, t_s: float, *, scenery: bool = True) -> Instant:
    """Places everything at a time; without its scenery where only the truth is asked for."""
    camera = scenario.camera
    s, _, _ = scenario.ego.state(t_s)
    heading = scenario.heading_rad(t_s)
    here = surroundings(scenario.road, s, eased(scenario.ego_lateral, t_s), heading, camera.height_m)
    change = scenario.pitch_rad(t_s)
    night = scenario.light.ambient < 0.6
    vehicles: list[VehicleAt] = []
    actors: list[Actor] = []
    for actor in scenario.actors:
        place, speed, accel = actor.motion.state(t_s)
        if place - s < -_HIDDEN_BY_M:
            continue
        lateral = eased(actor.lateral, t_s)
        drift = (eased(actor.lateral, t_s + 0.01) - eased(actor.lateral, t_s - 0.01)) / 0.02
        x, down, z, road_heading = here.place(place, lateral)
        braking = actor.braking_lamps and (accel < -0.7 or (speed < 0.1 and actor.motion.state(t_s - 2.0)[1] > 0.1))
        vehicles.append(
            VehicleAt(
                body=actor.body, face=actor.face.spec if actor.face else None, x_m=x, down_m=down, z_m=z,
                yaw_rad=road_heading + (float(np.arctan2(drift, speed)) if speed > 0.5 else 0.0),
                plate_tilt_rad=actor.plate_tilt_rad, lamps="brake" if braking else "on" if night else "off",
                hidden=eased(actor.hidden, t_s),
            )
        )
        actors.append(actor)
    cards: list[CardAt] = []
    for prop in scenario.props if scenery else ():
        if not 1.0 < prop.s_m - s < 220.0:
            continue
        x, down, z, _ = here.place(prop.s_m, prop.lateral_m)
        cards.append(CardAt(kind=prop.kind, variant=prop.variant, x_m=x, down_m=down, z_m=z, text=prop.text))
    tunnel = None if scenario.tunnel_exit_m is None else here.place(scenario.tunnel_exit_m, 0.0)[2]
    return Instant(
        view=view_of(camera, change), pitch_rad=camera.pitch_rad + change, roll_rad=camera.roll_rad, ahead=here.ahead(),
        vehicles=tuple(vehicles), actors=tuple(actors), cards=tuple(cards), slope=here.slope, tunnel_z_m=tunnel,
    )


def picture(scenario: Scenario, frame: int) -> Image:
    """The image of a frame; motion blur by averaging sub-frames centred on the frame's time."""
    t_s = frame / scenario.rate_hz
    count = max(scenario.subframes, 1)
    if count == 1 or scenario.exposure_time_s <= 0:
        clean = _clean(scenario, t_s)
    else:
        total = np.zeros((scenario.camera.height_px, scenario.camera.width_px, 3), np.float32)
        for k in range(count):
            cv2.accumulate(_clean(scenario, t_s + scenario.exposure_time_s * ((k + 0.5) / count - 0.5)), total)
        clean = np.rint(total / count).astype(np.uint8)
    gain = eased(scenario.exposure, t_s) if scenario.exposure else 1.0
    base = scenario.sensor
    sensor = Sensor(blur_px=base.blur_px, noise=base.noise, gain=base.gain * gain)
    return expose(clean, sensor, np.random.default_rng((scenario.seed, frame)))


def _clean(scenario: Scenario, t_s: float) -> Image:
    now = instant(scenario, t_s)
    return render(
        now.view, now.pitch_rad, now.roll_rad, now.ahead, scenario.style, list(now.vehicles), list(now.cards),
        scenario.light, slope=now.slope, tunnel_z_m=now.tunnel_z_m,
    )


def frame_truth(scenario: Scenario, frame: int) -> FrameTruth:
    """The exact truth of a frame."""
    t_s = frame / scenario.rate_hz
    now = instant(scenario, t_s, scenery=False)
    near = 1e-3
    before, after = instant(scenario, t_s - near, scenery=False), instant(scenario, t_s + near, scenery=False)
    vehicles = tuple(
        _vehicle_truth(scenario, frame, t_s, now, i, before, after, near) for i in range(len(now.actors))
        if now.vehicles[i].z_m > 0.05
    )
    ahead = [v for v in vehicles if v.in_path]
    return FrameTruth(
        frame=frame, t_s=t_s, ego_speed_mps=scenario.ego.state(t_s)[1], yaw_rate_radps=scenario.yaw_rate_radps(t_s),
        pitch_rad=now.pitch_rad, roll_rad=now.roll_rad, horizon_px=horizon_row(scenario.camera, now.pitch_rad),
        lead=min(ahead, key=lambda v: v.distance_m) if ahead else None, vehicles=vehicles,
    )


def _vehicle_truth(
    scenario: Scenario, frame: int, t_s: float, now: Instant, index: int, before: Instant, after: Instant, near_s: float
) -> VehicleTruth:
    actor, vehicle = now.actors[index], now.vehicles[index]
    centre, _ = plate_pose(vehicle)
    distance = float(centre[2])

    def at(other: Instant) -> float | None:
        names = [a.name for a in other.actors]
        return float(plate_pose(other.vehicles[names.index(actor.name)])[0][2]) if actor.name in names else None

    first, last = at(before), at(after)
    rate = (last - first) / (2 * near_s) if first is not None and last is not None else 0.0
    ego_speed = scenario.ego.state(t_s)[1]
    _, speed, accel = actor.motion.state(t_s)
    gap = distance - scenario.camera.to_bumper_m
    # the ego's own track is the road shifted by its lateral place: compare lateral places on the road
    offset = eased(actor.lateral, t_s) - eased(scenario.ego_lateral, t_s)
    face = vehicle.face
    height = corners = None
    if actor.face is not None and face is not None:
        quad = plate_corners_px(now.view, vehicle)
        if np.isfinite(quad).all():
            corners = tuple(float(v) for v in quad.ravel())
            boxes = glyph_corners_px(now.view, vehicle, face)[np.array(actor.face.main)]
            middle = (boxes[:, 0] + boxes[:, 1] - boxes[:, 2] - boxes[:, 3]) / 2
            height = float(np.hypot(middle[:, 0], middle[:, 1]).mean())
    ttc = gap / -rate if rate < -1e-6 and gap > 0 else None
    return VehicleTruth(
        frame=frame, t_s=t_s, name=actor.name, distance_m=distance, range_rate_mps=rate, gap_m=gap, ttc_s=ttc,
        ttc_braking_s=ttc_counting_accel(gap, ego_speed, 0.0, speed, min(accel, 0.0)), lateral_m=float(centre[0]),
        path_offset_m=offset, in_path=abs(offset) < IN_PATH_M, plate_corners_px=corners, char_height_px=height,
        glyph_count=sum(g.counted for g in face.glyphs) if face is not None else None,
        plate_visible=visible_share(now, index), speed_mps=speed,
    )


def visible_share(now: Instant, index: int) -> float:
    """Share of a plate that is in the frame and covered by nothing, from a grid of points on it."""
    vehicle = now.vehicles[index]
    if vehicle.face is None:
        return 0.0
    u = (np.arange(21) + 0.5) / 21
    v = (np.arange(7) + 0.5) / 7
    corners = face_corners_mm(vehicle.face)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    points = on_plate(vehicle, corners[0] + grid * (corners[2] - corners[0]))
    pixels = now.view.project(points)
    camera = now.view.camera
    seen = np.isfinite(pixels).all(axis=1)
    seen &= (pixels[:, 0] > -0.5) & (pixels[:, 0] < camera.width_px - 0.5)
    seen &= (pixels[:, 1] > -0.5) & (pixels[:, 1] < camera.height_px - 0.5)
    seen &= grid[:, 0] > vehicle.hidden
    nearer_ground = now.ahead.z_m < vehicle.z_m
    if nearer_ground.any():
        seen &= points[:, 1] / points[:, 2] < float((now.ahead.down_m / now.ahead.z_m)[nearer_ground].min())
    for other in now.vehicles:
        if other.z_m < vehicle.z_m - 0.5 and other.z_m > 0.3:
            seen &= ~_inside(rear_px(now.view, other), pixels)
    return float(seen.mean())


def rear_px(view: View, vehicle: VehicleAt) -> Array:
    """Projected outline of a vehicle's rear."""
    outline = outline_m(vehicle.body)
    c, s = np.cos(vehicle.yaw_rad), np.sin(vehicle.yaw_rad)
    points = np.stack([vehicle.x_m + outline[:, 0] * c, vehicle.down_m - outline[:, 1], vehicle.z_m - outline[:, 0] * s], 1)
    return view.project(points)


def _inside(outline: Array, points: Array) -> np.ndarray:
    if not np.isfinite(outline).all():
        return np.zeros(len(points), bool)
    shape = outline.astype(np.float32).reshape(-1, 1, 2)
    known = np.nan_to_num(points, nan=-1e6)
    return np.array([cv2.pointPolygonTest(shape, (float(x), float(y)), False) >= 0 for x, y in known])


def vehicle_box_px(view: View, vehicle: VehicleAt) -> tuple[float, float, float, float]:
    """Left, top, right, bottom of a vehicle's rear in the image."""
    half, top = body_size(vehicle.body)
    c, s = np.cos(vehicle.yaw_rad), np.sin(vehicle.yaw_rad)
    places = [(x, y) for x in (-half, half) for y in (0.0, top)]
    points = np.array([[vehicle.x_m + x * c, vehicle.down_m - y, vehicle.z_m - x * s] for x, y in places])
    p = view.project(points)
    return float(p[:, 0].min()), float(p[:, 1].min()), float(p[:, 0].max()), float(p[:, 1].max())
