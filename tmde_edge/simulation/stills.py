"""Single plates at exactly known poses, in a street, for tests of finding, reading and ranging."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.camera import Array, SimCamera, View, hd_camera, level_from_camera
from tmde_edge.simulation.compose import Image
from tmde_edge.simulation.ground import Marking, RoadAhead, RoadStyle
from tmde_edge.simulation.plate_face import FaceSpec
from tmde_edge.simulation.scene import (
    DAY,
    NIGHT,
    PLATE_PROUD_M,
    CardAt,
    VehicleAt,
    face_corners_mm,
    on_plate,
    plate_corners_px,
    plate_pose,
    render,
)
from tmde_edge.simulation.sensor import Sensor, expose
from tmde_edge.simulation.standard_face import StandardFace, standard_face
from tmde_edge.simulation.vehicle import Body

COLOURS = ((40, 38, 36), (205, 207, 208), (120, 116, 112), (52, 40, 150), (130, 70, 30), (70, 92, 60), (232, 232, 230))
TWO_LANES = (
    Marking(lateral_m=-1.75, dash_m=3.0, gap_m=6.0), Marking(lateral_m=1.75, width_m=0.15),
    Marking(lateral_m=-5.25, width_m=0.15),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Still:
    """An image with its truth; pixels of the image, pixel centres at integers."""

    image: Image
    camera: SimCamera
    view: View
    face: StandardFace
    distance_m: float  # lens to plate centre along the vehicle's forward axis
    centre_m: NDArray[np.float64]  # (3,) plate centre in the level frame
    corners_px: NDArray[np.float64]  # (4, 2) TL TR BR BL
    glyph_boxes_px: NDArray[np.float64]  # (n, 4, 2) TL TR BR BL of every glyph's ink box, as face.spec.glyphs
    yaw_rad: float
    tilt_rad: float
    roll_rad: float

    @property
    def width_px(self) -> float:
        """Mean length of the plate's top and bottom edges."""
        c = self.corners_px
        return float((np.hypot(*(c[1] - c[0])) + np.hypot(*(c[2] - c[3]))) / 2)

    @property
    def char_height_px(self) -> float:
        """Mean distance between the middles of top and bottom edges of the main characters."""
        b = self.glyph_boxes_px[np.array(self.face.main)]
        middle = (b[:, 0] + b[:, 1]) / 2 - (b[:, 2] + b[:, 3]) / 2
        return float(np.hypot(middle[:, 0], middle[:, 1]).mean())


def glyph_corners_px(view: View, vehicle: VehicleAt, face: FaceSpec) -> NDArray[np.float64]:
    """(n, 4, 2) TL TR BR BL of the glyphs' ink boxes."""
    if not face.glyphs:
        return np.zeros((0, 4, 2))
    boxes = np.array([
        [[g.left_mm, g.top_mm], [g.left_mm + g.width_mm, g.top_mm], [g.left_mm + g.width_mm, g.top_mm + g.height_mm],
         [g.left_mm, g.top_mm + g.height_mm]] for g in face.glyphs
    ])
    return view.project(on_plate(vehicle, boxes.reshape(-1, 2))).reshape(-1, 4, 2)


def flat_road(camera: SimCamera, s_m: float = 0.0) -> RoadAhead:
    """A straight, level road under the camera."""
    z = np.geomspace(0.5, 2000.0, 400)
    return RoadAhead(z_m=z, x_m=np.zeros_like(z), down_m=np.full_like(z, camera.height_m), s_m=s_m + z)


def render_still(
    standard: str = "de-mittel", text: str | None = None, *, distance_m: float | None = None,
    width_px: float | None = None, lateral_m: float | None = None, yaw_rad: float = 0.0, tilt_rad: float = 0.0,
    roll_rad: float = 0.0, camera: SimCamera | None = None, seed: int = 0, body: Body | None = None,
    night: bool = False, sensor: Sensor | None = None, true_sizes: bool = False, scenery: bool = True,
    style: RoadStyle | None = None,
) -> Still:
    """A vehicle with this plate at an exact place; either distance_m or width_px (face-on) says how far.

    yaw_rad turns the vehicle to the right, tilt_rad and roll_rad the plate in its recess. The seed chooses body,
    colours, street (unless `style` says it), noise (and with true_sizes the plate's own sizes within its standard's limits).
    """
    if (distance_m is None) == (width_px is None):
        raise ValueError("render_still needs exactly one of distance_m and width_px")
    rng = np.random.default_rng((seed, 31))
    own_camera = camera is None
    camera = camera or hd_camera()
    face = standard_face(standard, text, seed=seed if true_sizes else None)
    if distance_m is None:
        assert width_px is not None
        distance_m = camera.fx_px * face.spec.width_mm / 1000 / width_px
    if body is None:
        kind = str(rng.choice(["hatch", "sedan", "suv", "van"]))
        colour = COLOURS[int(rng.integers(len(COLOURS)))]
        body = Body(kind=kind, colour_bgr=(float(colour[0]), float(colour[1]), float(colour[2])),
                    plate_up_m=float(rng.uniform(0.72, 0.92)))
    if own_camera:
        # a near plate stays in the picture: the lens comes down to it
        drop = 0.30 * camera.height_px * distance_m / camera.fy_px
        camera = replace(camera, height_m=min(camera.height_m, body.plate_up_m + drop))
    if lateral_m is None:
        reach = max(0.42 * distance_m * camera.width_px / camera.fx_px - 0.4, 0.0)
        lateral_m = float(rng.uniform(-1, 1)) * min(reach, 1.2)
    # the vehicle stands where its plate centre is exactly distance_m ahead and lateral_m beside the lens
    probe = VehicleAt(body=body, face=face.spec, x_m=0.0, down_m=camera.height_m, z_m=0.0, yaw_rad=yaw_rad,
                      plate_tilt_rad=tilt_rad, plate_roll_rad=roll_rad, lamps="on" if night else "off")
    offset, _ = plate_pose(probe)
    vehicle = replace(probe, x_m=lateral_m - float(offset[0]), z_m=distance_m - float(offset[2]))
    view = View(camera, level_from_camera(camera.pitch_rad, camera.roll_rad, camera.yaw_rad))
    style = style or RoadStyle(
        markings=TWO_LANES, skyline=str(rng.choice(["trees", "town", "hills"])), kerb=bool(rng.random() < 0.4),
        sky="night" if night else str(rng.choice(["day", "overcast"])), seed=int(rng.integers(4)),
    )  # fmt: skip
    cards = street(rng, camera, style) if scenery else []
    clean = render(view, camera.pitch_rad, camera.roll_rad, flat_road(camera, float(rng.uniform(0, 500))), style, [vehicle],
                   cards, NIGHT if night else DAY)
    centre, _ = plate_pose(vehicle)
    return Still(
        image=expose(clean, sensor or Sensor(), rng), camera=camera, view=view, face=face, distance_m=float(centre[2]),
        centre_m=centre, corners_px=plate_corners_px(view, vehicle), glyph_boxes_px=glyph_corners_px(view, vehicle, face.spec),
        yaw_rad=yaw_rad, tilt_rad=tilt_rad, roll_rad=roll_rad,
    )


def calibration_captures(
    distances_m: tuple[float, ...] = (2.0, 5.0, 10.0), *, standard: str = "de-mittel", camera: SimCamera | None = None,
    tilt_rad: float = 0.17, reference_offset_m: float = 0.0, seed: int = 0, sensor: Sensor | None = None,
) -> list[Still]:
    """Plates at stated distances from a hand-held or parked setup: turned, tilted and rolled by up to tilt_rad each.

    reference_offset_m: the tape began that far in front of the lens, so every stated distance is short by it.
    """
    rng = np.random.default_rng((seed, 53))
    out: list[Still] = []
    for k, distance_m in enumerate(distances_m):
        yaw, tilt, roll = (float(v) for v in rng.uniform(-tilt_rad, tilt_rad, 3))
        reach = 0.15 * distance_m
        out.append(render_still(
            standard, distance_m=distance_m + reference_offset_m, yaw_rad=yaw, tilt_rad=tilt, roll_rad=0.3 * roll,
            lateral_m=float(rng.uniform(-reach, reach)), camera=camera, seed=seed * 101 + k, sensor=sensor,
        ))
    return out


def street(rng: np.random.Generator, camera: SimCamera, style: RoadStyle) -> list[CardAt]:
    """Trees, houses, lamps and a sign along a straight road."""
    cards: list[CardAt] = []
    for z in np.arange(12.0, 160.0, 11.0):
        for side in (-1.0, 1.0):
            if rng.random() < 0.7:
                kind = "house" if style.skyline == "town" and rng.random() < 0.6 else "tree"
                edge = style.right_m if side > 0 else -style.left_m
                x = side * (edge + rng.uniform(3.0, 8.0) + (6.0 if kind == "house" else 0.0))
                cards.append(CardAt(kind=kind, variant=int(rng.integers(8)), x_m=float(x), down_m=camera.height_m, z_m=float(z)))
    for z in np.arange(10.0, 120.0, 25.0):
        cards.append(CardAt(kind="post", variant=0, x_m=style.right_m + 0.8, down_m=camera.height_m, z_m=float(z)))
    cards.append(CardAt(kind="sign", variant=int(rng.integers(9)), x_m=style.right_m + 1.2, down_m=camera.height_m, z_m=38.0))
    return cards


__all__ = ["PLATE_PROUD_M", "TWO_LANES", "Array", "Still", "face_corners_mm", "flat_road", "render_still", "street"]
