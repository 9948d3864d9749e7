"""Our distance of a rendered plate against an AprilTag of the plate's height: same poses, same camera, same noise.

python tests/benchmarks/apriltag_compare.py [poses a size] [standard ...] [--jsonl FILE]

The tag's black square is as tall as the plate (its white margin comes on top, in the tag's favour), its size and the
plate's standard are known exactly, the plate's sizes are nominal. Tags are found by OpenCV's ArUco detector with
AprilTag corner refinement and posed by IPPE_SQUARE. A markdown table is printed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from tmde_edge.app.wiring import build_eyes
from tmde_edge.config import from_tree
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.geometry.planar import rectangle_mm
from tmde_edge.messages import Frame, PlateSighting
from tmde_edge.plates.standard import select
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.settings import RangingSettings
from tmde_edge.simulation.camera import hd_camera, level_from_camera
from tmde_edge.simulation.ground import RoadStyle
from tmde_edge.simulation.plate_face import FaceSpec, Mark
from tmde_edge.simulation.scene import DAY, VehicleAt, View, plate_pose, render
from tmde_edge.simulation.sensor import Sensor, expose
from tmde_edge.simulation.standard_face import standard_face
from tmde_edge.simulation.stills import TWO_LANES, flat_road
from tmde_edge.simulation.vehicle import Body

WIDTHS_PX = (200, 100, 60, 30, 20)
TEXTS = {"de-mittel": "M AB 1234", "us-mi": "ABC 1D23", "ru-1": "A123BC 77", "gb-2001": "AB12 CDE"}
SIM = hd_camera()
BLACK = (25.0, 25.0, 25.0)
STREET = RoadStyle(markings=TWO_LANES, skyline="trees", sky="day")
HEAD = (
    "standard", "plate px", "tag px", "ours: found", "mean abs", "bias", "in 1 / 2 sigma", "width cue", "char cue", "tag: found",
    "mean abs", "bias",
)  # fmt: skip
CAMERA = Camera(
    width_px=SIM.width_px, height_px=SIM.height_px, fx_px=SIM.fx_px, fy_px=SIM.fy_px, cx_px=SIM.cx_px, cy_px=SIM.cy_px
)
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)


def tag_face(side_mm: float, number: int = 7) -> FaceSpec:
    """A tag36h11 whose black square is side_mm wide, with one cell of white round it."""
    cells = cv2.aruco.generateImageMarker(DICTIONARY, number, 8, borderBits=1)
    cell = side_mm / 8
    marks = tuple(
        Mark(kind="rect", left_mm=(c - 4) * cell, top_mm=(r - 4) * cell, width_mm=cell, height_mm=cell, colour_bgr=BLACK)
        for r in range(8) for c in range(8) if cells[r, c] == 0
    )  # fmt: skip
    return FaceSpec(
        width_mm=10 * cell, height_mm=10 * cell, glyphs=(), background_bgr=(235.0, 235.0, 235.0), ink_bgr=BLACK,
        corner_radius_mm=0.0, marks=marks,
    )  # fmt: skip


def shoot(face: FaceSpec, pose: dict[str, float], seed: int) -> np.ndarray:
    """The vehicle with this face, its centre exactly at the pose."""
    rng = np.random.default_rng((seed, 5))
    body = Body(kind="sedan", colour_bgr=(120.0, 116.0, 112.0), plate_up_m=0.8)
    drop = 0.30 * SIM.height_px * pose["distance_m"] / SIM.fy_px
    camera = replace(SIM, height_m=min(1.3, body.plate_up_m + drop))
    probe = VehicleAt(body=body, face=face, x_m=0.0, down_m=camera.height_m, z_m=0.0, yaw_rad=pose["yaw"],
                      plate_tilt_rad=pose["tilt"], plate_roll_rad=pose["roll"])  # fmt: skip
    offset, _ = plate_pose(probe)
    vehicle = replace(probe, x_m=pose["lateral_m"] - float(offset[0]), z_m=pose["distance_m"] - float(offset[2]))
    view = View(camera, level_from_camera(0.0, 0.0))
    clean = render(view, 0.0, 0.0, flat_road(camera), STREET, [vehicle], [], DAY)
    return expose(clean, Sensor(), rng)


class Tags:
    def __init__(self) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
        parameters.minMarkerPerimeterRate = 0.005
        parameters.minSideLengthCanonicalImg = 16
        self._detector = cv2.aruco.ArucoDetector(DICTIONARY, parameters)

    def distance_m(self, image: np.ndarray, side_mm: float) -> float | None:
        """Forward distance of the tag's centre, or None where it is not found."""
        corners, ids, _ = self._detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
        if ids is None or 7 not in ids.ravel():
            return None
        found = corners[int(np.flatnonzero(ids.ravel() == 7)[0])].reshape(4, 2).astype(np.float64)
        square = rectangle_mm(side_mm, side_mm)
        square[:, 1] *= -1  # IPPE_SQUARE wants y up
        flat = np.column_stack([square / 1000, np.zeros(4)])
        k = np.array([[CAMERA.fx_px, 0, CAMERA.cx_px], [0, CAMERA.fy_px, CAMERA.cy_px], [0, 0, 1]])
        count, _, places, errors = cv2.solvePnPGeneric(flat, found, k, np.zeros(4), flags=cv2.SOLVEPNP_IPPE_SQUARE)
        return float(places[int(np.argmin(errors[:count]))][2, 0]) if count else None


class Plates:
    def __init__(self, standard: str) -> None:
        config = from_tree({"plates": {"expect": [standard]}, "runtime": {"threads": 1}}, "benchmark")
        self._eyes = build_eyes(config, time.perf_counter_ns)
        self._ranger = Ranger(RangingSettings(), select([standard]))

    def measure(self, image: np.ndarray, index: int, near_px: tuple[float, float]) -> dict[str, float]:
        """Distances by name: joint and every cue; sigma of the joint one. Empty where there is none."""
        sighting = self._eyes.see_still(Frame(t_ns=0, index=index, image=image))
        if not sighting.plates:
            return {}
        plate = min(sighting.plates, key=lambda p: self._off(p, near_px))
        if self._off(plate, near_px) > 40:
            return {}
        found, _, _ = self._ranger.measure(plate, CAMERA, np.eye(3), 0)
        if found is None:
            return {}
        return {"joint": found.distance_m, "sigma": found.sigma_m, **{c.cue: c.distance_m for c in found.cues}}

    @staticmethod
    def _off(plate: PlateSighting, near_px: tuple[float, float]) -> float:
        return float(np.abs(np.mean(plate.corners_px, axis=0) - near_px).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("poses", nargs="?", type=int, default=12)
    parser.add_argument("standards", nargs="*", default=["de-mittel", "us-mi"])
    parser.add_argument("--jsonl")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    tags = Tags()
    print("| " + " | ".join(HEAD) + " |")
    print("|---" * len(HEAD) + "|")
    for standard in args.standards:
        face, plates = standard_face(standard, TEXTS.get(standard)), Plates(standard)
        tag = tag_face(face.spec.height_mm)
        for width_px in WIDTHS_PX:
            errors: dict[str, list[float]] = defaultdict(list)
            ratios: list[float] = []
            for i in range(args.poses):
                rng = np.random.default_rng((width_px, i))
                d = SIM.fx_px * face.spec.width_mm / 1000 / width_px * rng.uniform(0.97, 1.03)
                pose = {"distance_m": d, "lateral_m": rng.uniform(-0.25, 0.25) * d, "yaw": rng.normal(0, 0.08),
                        "tilt": rng.normal(0, 0.06), "roll": rng.normal(0, 0.02)}  # fmt: skip
                image = shoot(face.spec, pose, i)
                drop = min(1.3 - 0.8, 0.30 * SIM.height_px * d / SIM.fy_px)
                where = (SIM.cx_px + SIM.fx_px * pose["lateral_m"] / d, SIM.cy_px + SIM.fy_px * drop / d)
                ours = plates.measure(image, i, where)
                for name, value in ours.items():
                    if name != "sigma":
                        errors[name].append(value / d - 1)
                if ours:
                    ratios.append(abs(ours["joint"] - d) / ours["sigma"])
                theirs = tags.distance_m(shoot(tag, pose, i), face.spec.height_mm)
                if theirs is not None:
                    errors["tag"].append(theirs / d - 1)
            _print(standard, width_px, width_px * face.spec.height_mm / face.spec.width_mm, args.poses, errors, ratios)
            if args.jsonl:
                with open(args.jsonl, "a") as f:
                    f.write(json.dumps({"standard": standard, "width_px": width_px, **errors}) + "\n")


def _print(standard: str, width_px: int, tag_px: float, poses: int, errors: dict[str, list[float]], ratios: list[float]) -> None:
    def mean_abs(name: str) -> str:
        e = errors.get(name)
        return f"{100 * float(np.mean(np.abs(e))):.2f} %" if e else "-"

    def bias(name: str) -> str:
        e = errors.get(name)
        return f"{100 * float(np.mean(e)):+.2f} %" if e else "-"

    r: Any = np.array(ratios)
    cover = f"{np.mean(r < 1):.2f} / {np.mean(r < 2):.2f}" if len(r) else "-"
    ours, theirs = len(errors.get("joint", [])), len(errors.get("tag", []))
    cells = (
        standard, width_px, f"{tag_px:.0f}", f"{ours}/{poses}", mean_abs("joint"), bias("joint"), cover, mean_abs("plate_width"),
        mean_abs("char_height"), f"{theirs}/{poses}", mean_abs("tag"), bias("tag"),
    )  # fmt: skip
    print("| " + " | ".join(str(c) for c in cells) + " |", flush=True)


if __name__ == "__main__":
    main()
