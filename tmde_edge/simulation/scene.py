"""One instant, rendered: road, scenery, vehicles and their plates where the pinhole model puts them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.camera import Array, View, heading_rotation
from tmde_edge.simulation.compose import Image, Region, Texture, region_round, texture
from tmde_edge.simulation.ground import RoadAhead, RoadStyle, paint_ground
from tmde_edge.simulation.plate_face import FaceSpec, face_alpha, render_face
from tmde_edge.simulation.scenery import card
from tmde_edge.simulation.tunnel import INSIDE_GAIN, paint_tunnel
from tmde_edge.simulation.vehicle import Body, body_size, outline_m, rear_picture

PLATE_PROUD_M = 0.02  # the plate stands this far behind the rear's plane
_NEAR_M = 0.15  # what is nearer than this in front of the lens is cut


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleAt:
    """A vehicle in the level frame: the point on the road under the middle of its rear, and its attitude."""

    body: Body
    face: FaceSpec | None
    x_m: float
    down_m: float  # the road under it, below the lens
    z_m: float
    yaw_rad: float = 0.0
    tilt_rad: float = 0.0  # of the whole body, nose down
    plate_tilt_rad: float = 0.0  # of the plate in its recess: its lower edge nearer when positive
    plate_roll_rad: float = 0.0
    lamps: str = "off"
    hidden: float = 0.0  # 0..1 of the plate's width covered from the left, by something dark


@dataclass(frozen=True, slots=True, kw_only=True)
class CardAt:
    """A piece of scenery in the level frame, facing the camera."""

    kind: str
    variant: int
    x_m: float
    down_m: float
    z_m: float
    text: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """Ambient light (1: day) and our own headlamps' share."""

    ambient: float = 1.0
    headlamps: float = 0.0
    retro: float = 0.0  # what a plate throws back of the headlamps


DAY = Light()
_TUNNEL = Light(ambient=INSIDE_GAIN, headlamps=0.35, retro=1.2)
NIGHT = Light(ambient=0.10, headlamps=0.55, retro=1.6)


def plate_pose(vehicle: VehicleAt) -> tuple[Array, Array]:
    """Plate centre (3,) in the level frame, and the rotation (3, 3) of plate axes (x right, y down) into it."""
    body_axes = heading_rotation(vehicle.yaw_rad, vehicle.tilt_rad)
    origin = np.array([vehicle.x_m, vehicle.down_m, vehicle.z_m])
    centre = origin + body_axes @ np.array([vehicle.body.plate_right_m, -vehicle.body.plate_up_m, -PLATE_PROUD_M])
    return centre, body_axes @ heading_rotation(0.0, vehicle.plate_tilt_rad, vehicle.plate_roll_rad)


def on_plate(vehicle: VehicleAt, points_mm: Array) -> Array:
    """Level-frame points (n, 3) in metres of plate-frame points (n, 2) in mm."""
    centre, axes = plate_pose(vehicle)
    flat = np.zeros((len(points_mm), 3))
    flat[:, :2] = np.asarray(points_mm) / 1000.0
    out: Array = centre + flat @ axes.T
    return out


def face_corners_mm(face: FaceSpec) -> Array:
    """TL, TR, BR, BL of the plate's outer edge (corners not rounded), plate frame."""
    w, h = face.width_mm / 2, face.height_mm / 2
    return np.array([[-w, -h], [w, -h], [w, h], [-w, h]])


def plate_corners_px(view: View, vehicle: VehicleAt) -> Array:
    """(4, 2) TL TR BR BL of a vehicle's plate; NaN where there is none or it is behind the lens."""
    if vehicle.face is None:
        return np.full((4, 2), np.nan)
    return view.project(on_plate(vehicle, face_corners_mm(vehicle.face)))


def render(
    view: View, pitch_rad: float, roll_rad: float, ahead: RoadAhead, style: RoadStyle, vehicles: list[VehicleAt],
    cards: list[CardAt], light: Light = DAY, *, slope: float = 0.0, tunnel_z_m: float | None = None,
) -> Image:
    """BGR image of the instant; pitch and roll are the whole attitude that `view` holds (the ground needs them apart).

    slope: of the road under us, up positive. tunnel_z_m: we are in a tunnel whose portal is that far ahead.
    """
    camera = view.camera
    image: Image = np.empty((camera.height_px, camera.width_px, 3), np.uint8)
    paint_ground(image, camera, pitch_rad, ahead, style, slope)
    if roll_rad != 0.0:
        _roll(image, view, roll_rad)
    if light.headlamps > 0.0 or light.ambient != 1.0:
        _light_ground(image, view, pitch_rad, light)
    portal_m = tunnel_z_m if tunnel_z_m is not None else -1.0
    things: list[tuple[float, VehicleAt | CardAt | None]] = [(v.z_m, v) for v in vehicles]
    things += [(c.z_m, c) for c in cards if c.z_m > portal_m]
    if portal_m > 0:
        things.append((portal_m, None))
    for _, thing in sorted(things, key=lambda item: -item[0]):
        if thing is None:
            paint_tunnel(image, view, camera.height_m, portal_m, float(ahead.s_m[0] - ahead.z_m[0]))
            continue
        behind = _hidden_from_row(view, ahead, thing.z_m, thing.down_m)
        kept = None if behind is None else image[behind:].copy()
        if isinstance(thing, CardAt):
            _paint_card(image, view, thing, light)
        else:
            _paint_vehicle(image, view, thing, _TUNNEL if thing.z_m < portal_m else light)
        if kept is not None:
            image[behind:] = kept
    return image


def _hidden_from_row(view: View, ahead: RoadAhead, z_m: float, down_m: float) -> int | None:
    """First image row in which a crest hides what stands at z; None where the road is seen all the way."""
    nearer = ahead.z_m < z_m
    if z_m <= 0 or not nearer.any():
        return None
    slopes = (ahead.down_m / ahead.z_m)[nearer]
    blocked = float(slopes.min())
    if blocked >= down_m / z_m - 1e-6:
        return None
    row = float(view.project(np.array([[0.0, blocked * z_m, z_m]]))[0, 1])
    return int(np.clip(np.ceil(row), 0, view.camera.height_px))


def _roll(image: Image, view: View, roll_rad: float) -> None:
    """The ground was painted for a level horizon: turn it about the principal point."""
    camera = view.camera
    c, s = np.cos(-roll_rad), np.sin(-roll_rad)
    cx, cy = camera.cx_px, camera.cy_px
    matrix = np.array([[c, -s, cx - c * cx + s * cy], [s, c, cy - s * cx - c * cy]])
    image[:] = cv2.warpAffine(image, matrix, (image.shape[1], image.shape[0]), flags=cv2.INTER_LINEAR,
                              borderMode=cv2.BORDER_REPLICATE)


def _beam(z_m: float, light: Light) -> float:
    """Display-gain share of our headlamps at a distance."""
    return float(light.headlamps * np.clip(14.0 / max(z_m, 4.0), 0.0, 1.0) ** 0.9)


def _light_ground(image: Image, view: View, pitch_rad: float, light: Light) -> None:
    image[:] = cv2.multiply(image, _ground_gain(view.camera.height_px, view.camera.width_px, view.camera.fy_px,
                                                view.camera.cy_px, round(float(pitch_rad), 2), light), dtype=cv2.CV_8U)


@lru_cache(maxsize=16)
def _ground_gain(rows: int, cols: int, f_px: float, cy_px: float, pitch_rad: float, light: Light) -> NDArray[np.float32]:
    yn = (np.arange(rows) - cy_px) / f_px + np.tan(pitch_rad)
    z = np.where(yn > 0.0, 1.3 / np.maximum(yn, 0.002), 700.0)
    reach = np.where(yn > 0.0, np.clip(14.0 / z, 0.0, 1.2) ** 0.9 * np.clip((z - 2.0) / 5.0, 0.25, 1.0), 0.0)
    x = (np.arange(cols) - (cols - 1) / 2) / f_px
    side = np.exp(-((x / 0.32) ** 2))
    gain = np.where(yn[:, None] > 0.0, light.ambient, 1.0)  # the sky is painted as dark as it is
    gain = gain + light.headlamps * reach[:, None] * side[None, :]
    return np.repeat(gain.astype(np.float32)[..., None], 3, axis=2)


def _paint_card(image: Image, view: View, item: CardAt, light: Light) -> None:
    if item.z_m < 1.0:
        return
    picture, width, height = card(item.kind, item.variant, item.text)
    x, y, z = item.x_m, item.down_m, item.z_m
    corners = view.project(np.array([[x - width / 2, y - height, z], [x + width / 2, y - height, z],
                                     [x + width / 2, y, z], [x - width / 2, y, z]]))
    region = region_round(image, corners, 1)
    if region is None:
        return
    region.quad(picture, corners, gain=min(light.ambient + _beam(z, light) * float(np.exp(-((x / (0.4 * z)) ** 2))), 1.0))
    region.done()


def _paint_vehicle(image: Image, view: View, vehicle: VehicleAt, light: Light) -> None:
    body = vehicle.body
    axes = heading_rotation(vehicle.yaw_rad, vehicle.tilt_rad)
    origin = np.array([vehicle.x_m, vehicle.down_m, vehicle.z_m])

    def place(points: Array) -> Array:
        """Body points (x right, y up, z forward from the rear) -> level frame."""
        flipped = np.asarray(points, np.float64) * [1.0, -1.0, 1.0]
        out: Array = origin + flipped @ axes.T
        return out

    half, top = body_size(body)
    box = place(np.array([[x, y, z] for x in (-half - 0.5, half + 0.5) for y in (0.0, top + 0.1) for z in (-0.6, body.length_m)]))
    inside = view.project(box)
    if not np.isfinite(inside).any() or float(box[:, 2].max()) < _NEAR_M:
        return
    if not np.isfinite(inside).all() or float(box[:, 2].min()) < _NEAR_M:
        # a part is beside or behind the lens: any pixel may be touched
        inside = np.array([[0.0, 0.0], [view.camera.width_px, view.camera.height_px]])
    wide = float(np.ptp(view.project(place(np.array([[-half, 0.5, 0.0], [half, 0.5, 0.0]])))[:, 0])) \
        if vehicle.z_m > _NEAR_M else 9999.0
    factor = 4 if wide < 150 else 2 if wide < 420 else 1
    region = region_round(image, inside, factor)
    if region is None:
        return
    gain = min(light.ambient + _beam(vehicle.z_m, light), 1.0)
    if vehicle.z_m > _NEAR_M + 0.6:
        shadow = view.project(place(np.array([[-half - 0.35, 0, body.length_m], [half + 0.35, 0, body.length_m],
                                              [half + 0.35, 0, -0.45], [-half - 0.35, 0, -0.45]])))
        region.quad(_shadow(), shadow, opacity=0.75)
    _paint_sides(region, view, vehicle, place, gain)
    if vehicle.z_m > _NEAR_M:
        size = (vehicle.face.width_mm / 1000, vehicle.face.height_mm / 1000) if vehicle.face else (0.52, 0.11)
        rear = rear_picture(body, size, vehicle.lamps)
        corners = view.project(place(np.array([[rear.left_m, rear.top_m, 0], [rear.right_m, rear.top_m, 0],
                                               [rear.right_m, rear.bottom_m, 0], [rear.left_m, rear.bottom_m, 0]])))
        region.quad(rear.picture, corners, gain=gain)
    region.done()
    if vehicle.lamps != "off" and light.ambient < 0.6:
        _glow(image, view, vehicle, place)
    paint_plate(image, view, vehicle, light)


def paint_plate(image: Image, view: View, vehicle: VehicleAt, light: Light) -> None:
    """Lay a vehicle's plate, if it has one, over the image with an exact box filter on its edges."""
    if vehicle.face is None:
        return
    corners = plate_corners_px(view, vehicle)
    if not np.isfinite(corners).all():
        return
    width = float(np.hypot(*(corners[1] - corners[0])))
    factor = int(np.clip(np.ceil(1600 / max(width, 1.0)), 3, 8))
    region = region_round(image, corners, factor)
    if region is None:
        return
    picture = face_texture(vehicle.face)
    centre, _ = plate_pose(vehicle)
    gain = light.ambient + light.retro * _beam(float(centre[2]), light)
    region.quad(picture, corners, gain=gain)
    if vehicle.hidden > 0:
        share = vehicle.hidden
        cover = corners.copy()
        cover[1] = corners[0] + (corners[1] - corners[0]) * share
        cover[2] = corners[3] + (corners[2] - corners[3]) * share
        region.polygon(cover, (34.0, 36.0, 38.0))
    region.done()


@lru_cache(maxsize=32)
def face_texture(face: FaceSpec) -> Texture:
    """The face at 4 px a millimetre with its rounded corners."""
    return texture(render_face(face, 4.0), face_alpha(face, 4.0))


@lru_cache(maxsize=1)
def _shadow() -> Texture:
    x = np.linspace(-1, 1, 128)
    soft = np.clip((1 - np.abs(x)) / 0.30, 0, 1) ** 1.3
    return texture(np.full((128, 128, 3), 12, np.uint8), np.outer(soft, soft).astype(np.float32))


def _paint_sides(region: Region, view: View, vehicle: VehicleAt, place: object, gain: float) -> None:
    """The box behind the rear: hulls of body and cabin, with side windows and wheels where a side is seen."""
    body = vehicle.body
    half, top = body_size(body)
    colour = np.array(body.colour_bgr) * gain
    belt = 1.02 if body.kind not in ("van", "truck") else top
    rear = outline_m(body)
    low = rear[rear[:, 1] <= belt + 1e-6]
    assert callable(place)

    def at(points: Array, z: float) -> Array:
        out: Array = place(np.column_stack([points, np.full(len(points), z)]))
        return out

    _hull(region, view, np.vstack([at(low, 0.0), at(low * [0.96, 0.92], body.length_m)]), colour * 0.80)
    if belt < top:
        cabin = rear[rear[:, 1] >= belt - 0.03]
        _hull(region, view, np.vstack([at(cabin, 0.05), at(cabin * [0.97, 0.99], 0.55 * body.length_m),
                                       at(np.array([[half * 0.9, belt], [-half * 0.9, belt]]), 0.75 * body.length_m)]),
              colour * 0.62)
    side = -1.0 if vehicle.x_m > 0 else 1.0  # which side of it looks at us
    if abs(vehicle.x_m) < half and abs(vehicle.yaw_rad) < 0.05:
        return
    x = side * half * 0.985
    glass = (52.0 * gain, 46.0 * gain, 42.0 * gain)
    length = body.length_m
    if body.kind in ("hatch", "sedan", "suv"):
        inner = side * half * 0.78
        for z0, z1 in ((0.45, 1.35), (1.45, 2.35)):
            pane = np.array([[x, belt + 0.02, z0], [inner, top - 0.14, z0 + 0.12], [inner, top - 0.14, z1 - 0.05],
                             [x, belt + 0.02, z1 + 0.05]])
            _flat(region, view, place(pane), glass)
    angles = np.linspace(0, 2 * np.pi, 18, endpoint=False)
    radius = 0.33 if body.kind != "truck" else 0.5
    for z in (0.19 * length, 0.80 * length):
        for r, tone in ((radius, 24.0), (radius * 0.62, 110.0)):
            wheel = np.stack([np.full(18, side * (half + 0.005)), radius + r * np.sin(angles), z + r * np.cos(angles)], axis=1)
            _flat(region, view, place(wheel), (tone * gain,) * 3)


def _clip_near(points: Array) -> Array:
    """A polygon's part in front of the near plane (Sutherland-Hodgman)."""
    out: list[Array] = []
    for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
        if a[2] >= _NEAR_M:
            out.append(a)
        if (a[2] >= _NEAR_M) != (b[2] >= _NEAR_M):
            out.append(a + (b - a) * (_NEAR_M - a[2]) / (b[2] - a[2]))
    return np.array(out).reshape(-1, 3)


def _flat(region: Region, view: View, points_m: Array, colour: tuple[float, float, float]) -> None:
    points = _clip_near(points_m)
    if len(points) >= 3:
        region.polygon(view.project(points), colour)


def _hull(region: Region, view: View, points_m: Array, colour: Array) -> None:
    """The convex outline of a solid's points; what lies behind the near plane is drawn up to it."""
    points = points_m.copy()
    behind = points[:, 2] < _NEAR_M
    if behind.all():
        return
    points[behind, 2] = _NEAR_M
    flat = view.project(points).astype(np.float32)
    outline = cv2.convexHull(flat)[:, 0, :]
    region.polygon(outline.astype(np.float64), tuple(float(c) for c in colour))


def _glow(image: Image, view: View, vehicle: VehicleAt, place: object) -> None:
    """Bloom round lit lamps in the dark: a soft red disc added to the picture."""
    half, _ = body_size(vehicle.body)
    assert callable(place)
    up = 0.9 if vehicle.body.kind != "truck" else 0.72
    for side in (-1, 1):
        spot = view.project(place(np.array([[side * (half - 0.14), up, -0.02], [side * (half - 0.02), up, -0.02]])))
        if not np.isfinite(spot).all():
            continue
        size = 2.6 * abs(float(spot[1, 0] - spot[0, 0])) + 3.0
        x, y = spot[0]
        x0, x1 = max(int(x - 3 * size), 0), min(int(x + 3 * size) + 1, image.shape[1])
        y0, y1 = max(int(y - 3 * size), 0), min(int(y + 3 * size) + 1, image.shape[0])
        if x0 >= x1 or y0 >= y1:
            continue
        gx = np.exp(-0.5 * ((np.arange(x0, x1) - x) / size) ** 2)
        gy = np.exp(-0.5 * ((np.arange(y0, y1) - y) / size) ** 2)
        bright = 140.0 if vehicle.lamps == "brake" else 60.0
        add = (np.outer(gy, gx) * bright)[..., None] * np.array([0.35, 0.25, 1.0])
        part = image[y0:y1, x0:x1]
        part[:] = np.clip(part + add, 0, 255).astype(np.uint8)
