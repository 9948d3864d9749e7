#!/usr/bin/env python3
"""Renders roads with a known horizon, and takes real road frames whose horizon is known from their lanes: shards of grey pictures.

A shard is an .npz: `images` (n, 200, 320) uint8, `line` (n, 2) the horizon's row at the middle column and its slope (rows per column), `sigma` (n,)
how well that row is known (pixels). Roads: straight, bends, hills and crests; every skyline and sky; markings of several kinds or none; vehicles;
lenses of 30 to 75 degrees; any attitude. The horizon is that of the road under the car.

usage: generate.py OUT --count 9000 [--seed 1] [--roads FOLDER] [--dashcam FOLDER]
"""
from __future__ import annotations

import argparse
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.camera import hd_camera, view_of
from tmde_edge.simulation.drive import picture
from tmde_edge.simulation.ground import Marking, RoadStyle
from tmde_edge.simulation.scenario import Actor, Prop, Scenario
from tmde_edge.simulation.scene import DAY, NIGHT, Light
from tmde_edge.simulation.sensor import Sensor
from tmde_edge.simulation.stills import COLOURS
from tmde_edge.simulation.vehicle import Body

from tmde_edge.simulation.world import Motion, Road

SIZE = (320, 200)  # of a kept picture
RENDER = (640, 400)
PER_SCENE = 14
SHARD = 500
# (video or folder, row of the horizon at the source's own height, sigma): the median of the lanes' vanishing rows over the whole recording
ROADS = {"videos/solidWhiteRight.mp4": (305.2, 540, 2.0), "videos/test_video.mp4": (421.1, 720, 3.0), "test_images": (421.1, 720, 6.0)}
RIDE = ("dayride_type1_001", 289.0, 720, 10.0)
HOLDOUT = Path(__file__).resolve().parent.parent / "dashcam_ro_holdout.txt"
Image = NDArray[np.uint8]


def markings(rng: np.random.Generator) -> tuple[Marking, ...]:
    """None in a third of all roads; else lanes of 2.6 to 3.9 m, solid or dashed, white or yellow."""
    if rng.random() < 0.35:
        return ()
    lane = rng.uniform(2.6, 3.9)
    colour = (80.0, 190.0, 215.0) if rng.random() < 0.15 else tuple(float(v) for v in np.full(3, rng.uniform(150, 225)))
    out = []
    for k in range(int(rng.integers(2, 5))):
        lateral = lane / 2 - k * lane
        dash, gap = (0.0, 0.0) if k == 0 or rng.random() < 0.4 else (rng.uniform(2, 6), rng.uniform(4, 12))
        out.append(Marking(lateral_m=float(lateral), width_m=float(rng.uniform(0.1, 0.25)), dash_m=float(dash), gap_m=float(gap), colour_bgr=colour))
    return tuple(o for o in out if rng.random() < 0.85)


def road(rng: np.random.Generator) -> Road:
    """Straight or bending, level, rolling or over a crest or through a dip."""
    bend: list[tuple[float, float]] = []
    if rng.random() < 0.6:
        s = 0.0
        for _ in range(8):
            s += rng.uniform(30, 120)
            bend.append((s, float(rng.choice([0.0, 1.0]) * rng.normal(0, 1 / 160))))
    hills: list[tuple[float, float]] = []
    kind = rng.random()
    if kind < 0.35:  # rolling
        s, up = 0.0, 0.0
        for _ in range(9):
            hills.append((s, up))
            step = rng.uniform(60, 200)
            s, up = s + step, up + float(rng.normal(0, 0.02)) * step
    elif kind < 0.55:  # a crest or a dip
        top, length = rng.uniform(1, 5) * rng.choice([-1, 1]), rng.uniform(30, 80)
        at = rng.uniform(10, 120)
        hills = [(at, 0.0), (at + length, float(top)), (at + length + 10, float(top)), (at + 2 * length + 10, float(-0.3 * top))]
    return Road(curvature=tuple(bend), elevation=tuple(hills))


def scene(rng: np.random.Generator) -> tuple[Scenario, float]:
    """A drive whose camera is set anew for every picture; and its length in seconds."""
    night = rng.random() < 0.22
    sky = "night" if night else str(rng.choice(["day", "overcast", "dusk"], p=[0.45, 0.4, 0.15]))
    skyline = str(rng.choice(["trees", "town", "hills", "none"], p=[0.32, 0.32, 0.26, 0.1]))
    verge = np.array([52.0, 92.0, 78.0]) * rng.uniform(0.6, 1.5) if rng.random() < 0.7 else np.full(3, rng.uniform(60, 190)) * rng.uniform(0.9, 1.1, 3)
    style = RoadStyle(
        markings=markings(rng), left_m=float(-rng.uniform(2.2, 9.5)), right_m=float(rng.uniform(2.0, 7.0)), asphalt=float(rng.uniform(55, 175)),
        verge_bgr=tuple(float(v) for v in verge), kerb=bool(rng.random() < 0.4), skyline=skyline, sky=sky, seed=int(rng.integers(10**6)),
    )
    speed = 12.0
    length_m = 30.0 * speed
    props = []
    density = rng.uniform(0.0, 0.9)
    for s in np.arange(8.0, length_m + 200.0, rng.uniform(7, 16)):
        for side in (-1.0, 1.0):
            if rng.random() > density:
                continue
            kind = "house" if rng.random() < (0.6 if skyline == "town" else 0.1) else str(rng.choice(["tree", "lamp", "board"], p=[0.7, 0.2, 0.1]))
            edge = style.right_m if side > 0 else -style.left_m
            lateral = side * (edge + rng.uniform(1.0, 9.0) + (6.0 if kind == "house" else 0.0))
            props.append(Prop(kind=kind, variant=int(rng.integers(8)), s_m=float(s), lateral_m=float(lateral)))
    actors = []
    for k in range(int(rng.integers(0, 6))):
        b, g, r = COLOURS[int(rng.integers(len(COLOURS)))]
        lateral = float(rng.normal(0, 0.3)) if k == 0 else float(rng.uniform(-8, 6))
        body = Body(kind=str(rng.choice(["hatch", "sedan", "suv", "van", "truck"])), colour_bgr=(float(b), float(g), float(r)))
        start = float(rng.uniform(5, 20) if k == 0 and rng.random() < 0.5 else rng.uniform(6, 90))
        actors.append(Actor(name=f"v{k}", motion=Motion(start_m=start, speed_mps=speed), body=body, face=None, lateral=((0.0, lateral),)))
    light = (Light(ambient=float(rng.uniform(0.08, 0.3)), headlamps=float(rng.uniform(0.3, 0.7)), retro=1.0) if rng.random() < 0.7 else NIGHT) if night else DAY
    made = Scenario(
        name="road", text="", duration_s=25.0, camera=hd_camera(fx_px=600.0, width_px=RENDER[0], height_px=RENDER[1]),
        ego=Motion(start_m=0.0, speed_mps=speed), style=style, actors=tuple(actors), props=tuple(props), road=road(rng), light=light,
        seed=int(rng.integers(10**6)),
    )  # fmt: skip
    return made, 25.0


def rendered(rng: np.random.Generator) -> list[tuple[Image, tuple[float, float], float]]:
    """The pictures of one drive: one lens, any attitude, any place."""
    made, length_s = scene(rng)
    f_px = float(np.exp(rng.uniform(np.log(420.0), np.log(1150.0))))
    height_m = float(rng.uniform(1.05, 1.6) if rng.random() < 0.85 else rng.uniform(1.6, 2.6))
    out = []
    for _ in range(PER_SCENE):
        pitch, roll, yaw = float(rng.normal(0, 0.05)), float(rng.normal(0, 0.02)), float(rng.normal(0, 0.03))
        pitch = float(np.clip(pitch, -0.25 * RENDER[1] / f_px, 0.25 * RENDER[1] / f_px))
        camera = hd_camera(fx_px=f_px, width_px=RENDER[0], height_px=RENDER[1], pitch_rad=pitch, roll_rad=roll, yaw_rad=yaw, height_m=height_m)
        sensor = Sensor(blur_px=float(rng.uniform(0.3, 1.6)), noise=float(rng.uniform(0.5, 6.0)), gain=float(np.exp(rng.normal(0, 0.25))))
        lateral = float(rng.normal(0, 0.4))
        still = replace(made, camera=camera, sensor=sensor, ego_lateral=((0.0, lateral),), dive_rad_per_mps2=0.0)
        frame = int(rng.integers(0, round(length_s * made.rate_hz)))
        image = picture(still, frame)
        # far directions on the level: their pixels draw the horizon
        ends = view_of(camera).project(np.array([[-0.3, 0.0, 1.0], [0.3, 0.0, 1.0]]) * 1e6)
        out.append(kept(image, ends, 0.2))
    return out


def kept(image: Image, ends_px: NDArray[np.float64], sigma_px: float) -> tuple[Image, tuple[float, float], float]:
    """The picture as kept, its horizon (row at the middle column, slope), and sigma; all scaled with it. Aspect is kept: the middle is cut out."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    k = SIZE[0] / grey.shape[1]
    small = cv2.resize(grey, (SIZE[0], round(grey.shape[0] * k)), interpolation=cv2.INTER_AREA)
    ends = (np.asarray(ends_px) + 0.5) * k - 0.5
    top = 0
    if small.shape[0] < SIZE[1]:
        top = -((SIZE[1] - small.shape[0]) // 2)
        small = cv2.copyMakeBorder(small, -top, SIZE[1] - small.shape[0] + top, 0, 0, cv2.BORDER_REPLICATE)
    elif small.shape[0] > SIZE[1]:
        top = (small.shape[0] - SIZE[1]) // 2
        small = small[top : top + SIZE[1]]
    slope = float((ends[1, 1] - ends[0, 1]) / (ends[1, 0] - ends[0, 0]))
    row = float(ends[0, 1] - top + slope * ((SIZE[0] - 1) / 2 - ends[0, 0]))
    return np.ascontiguousarray(small), (row, slope), max(sigma_px * k, 0.1)


def real(roads: Path | None, dashcam: Path | None) -> list[tuple[Image, tuple[float, float], float]]:
    """Frames of real roads (MIT) whose horizon is the median row of their lanes; held-out in-car frames are left out."""
    out = []

    def add(image: Image | None, row: float, at_height: float, sigma: float) -> None:
        if image is not None:
            k = image.shape[0] / at_height
            ends = np.array([[0.0, row * k], [image.shape[1] - 1.0, row * k]])
            out.append(kept(image, ends, sigma * k))

    for name, (row, height, sigma) in ROADS.items() if roads is not None else ():
        path = roads / name
        if path.suffix == ".mp4":
            video = cv2.VideoCapture(str(path))
            while True:
                ok, image = video.read()
                if not ok:
                    break
                add(image, row, height, sigma)
        else:
            for f in sorted(path.glob("*.jpg")):
                add(cv2.imread(str(f)), row, height, sigma)
    if dashcam is not None:
        held = set(HOLDOUT.read_text().split())
        for f in sorted(dashcam.glob(f"{RIDE[0]}*.jpg")):
            if f.name not in held and re.search(r"_t_", f.name):
                add(cv2.imread(str(f)), *RIDE[1:])
    return out


def write(path: Path, items: list[tuple[Image, tuple[float, float], float]]) -> None:
    """One shard, whole or not at all."""
    part = path.with_name("part-" + path.name)
    np.savez(part, images=np.stack([i[0] for i in items]), line=np.array([i[1] for i in items], np.float32), sigma=np.array([i[2] for i in items], np.float32))
    part.replace(path)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("out", type=Path)
    p.add_argument("--count", type=int, default=9000)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--roads", type=Path)
    p.add_argument("--dashcam", type=Path)
    a = p.parse_args()
    cv2.setNumThreads(1)
    a.out.mkdir(parents=True, exist_ok=True)
    if a.roads is not None or a.dashcam is not None:
        write(a.out / "real.npz", real(a.roads, a.dashcam))
    for shard in range(-(-a.count // SHARD)):
        path = a.out / f"made{shard:03d}.npz"
        if path.exists():
            continue
        rng = np.random.default_rng((a.seed, shard))
        items: list[tuple[Image, tuple[float, float], float]] = []
        while len(items) < SHARD:
            items += rendered(rng)
        write(path, items)
        print(path, flush=True)


if __name__ == "__main__":
    main()
