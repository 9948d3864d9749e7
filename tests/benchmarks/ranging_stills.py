"""Simulated stills against the bars of ranging: known standard, sizes drawn within the law, and `auto`.

python tests/benchmarks/ranging_stills.py [--stills N] [--seed N] [--widths PX ...] [--standards ID ...]
                                         [--save FILE | --load FILE] [--spoil WHAT]

Plates with any text stand up to 1.2 m beside the axis, turned, leaning and rolled a little, on bodies of six colours, seen
by a camera with noise and more or less defocus. Even seeds have the nominal sizes, odd ones sizes within the law. Markdown
tables are printed. --save keeps the sightings (pickle), --load ranges them again without rendering and looking: for work
on ranging alone. --spoil falsifies each sighting: `glyphs` makes all characters 4 to 7 % taller or smaller (a plate unlike its
standard), `frame` moves each side outwards by 6 to 14 mm with a chance of 0.4, `inside` all sides inwards by 3 to 7 mm.
"""

from __future__ import annotations

import argparse
import pickle
import time
import zlib
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tmde_edge.app.eyes import Eyes
from tmde_edge.app.wiring import build_eyes
from tmde_edge.config import from_tree
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Frame, PlateSighting
from tmde_edge.plates.standard import load_standards, select
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.settings import RangingSettings
from tmde_edge.simulation.camera import hd_camera
from tmde_edge.simulation.ground import RoadStyle
from tmde_edge.simulation.sensor import Sensor
from tmde_edge.simulation.standard_face import any_text, standard_face
from tmde_edge.simulation.stills import TWO_LANES, Still, render_still
from tmde_edge.simulation.vehicle import Body

WIDTHS_PX = (20, 30, 40, 60, 80, 120)
STANDARDS = ("de-mittel", "us-mi", "us-aamva3", "ru-1", "gb-2001", "fr-1", "pl-2", "jp-mid", "br-mercosul", "ro-1")
# The middle of the frame: as many pixels on a plate, in a quarter of the time.
SIM = replace(hd_camera(), width_px=640, height_px=360, cx_px=319.5, cy_px=179.5)
CAMERA = Camera(
    width_px=SIM.width_px, height_px=SIM.height_px, fx_px=SIM.fx_px, fy_px=SIM.fy_px, cx_px=SIM.cx_px, cy_px=SIM.cy_px
)
HEAD = "| ranged | mean abs | bias | p95 | median sigma | inside 1 / 2 sigma |"
# Few streets and bodies, so that a still costs little: the plate and its pose are what is measured.
STREET = RoadStyle(markings=TWO_LANES, skyline="trees", sky="day")
BODIES = tuple(
    Body(kind=kind, colour_bgr=colour, plate_up_m=0.8)
    for kind, colour in (
        ("hatch", (40.0, 38.0, 36.0)), ("sedan", (205.0, 207.0, 208.0)), ("suv", (120.0, 116.0, 112.0)),
        ("van", (232.0, 232.0, 230.0)), ("sedan", (52.0, 40.0, 150.0)), ("hatch", (130.0, 70.0, 30.0)),
    )
)
SAME_SIZE = 0.03  # of outer size and character height: the right class


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """What the eyes saw of one still, beside the truth."""

    standard: str
    width_px: int
    drawn: bool  # sizes drawn within the law, instead of nominal
    distance_m: float
    true_corners_px: Any
    plate: PlateSighting | None  # by eyes that expect its standard
    unknown: PlateSighting | None  # by eyes that expect any; of sizes drawn within the law only


def shots(standards: tuple[str, ...], widths_px: tuple[int, ...], seeds: range) -> Iterator[Shot]:
    eyes = {name: _eyes(name) for name in ("auto", *standards)}
    for i in seeds:
        for name in standards:
            for width_px in widths_px:
                drawn = bool(i % 2)
                still = _still(name, width_px, i, drawn)
                frame = Frame(t_ns=0, index=i, image=still.image)
                yield Shot(
                    standard=name, width_px=width_px, drawn=drawn, distance_m=still.distance_m,
                    true_corners_px=still.corners_px, plate=_seen(eyes[name], frame, still),
                    unknown=_seen(eyes["auto"], frame, still) if drawn else None,
                )  # fmt: skip


def _eyes(expect: str) -> Eyes:
    return build_eyes(from_tree({"plates": {"expect": [expect]}, "runtime": {"threads": 1}}, "benchmark"), time.perf_counter_ns)


def _seen(eyes: Eyes, frame: Frame, still: Still) -> PlateSighting | None:
    near = (p for p in eyes.see_still(frame).plates if _off_px(p, still) < 0.3 * still.width_px)
    return next(near, None)


def _off_px(plate: PlateSighting, still: Still) -> float:
    return float(np.abs(np.mean(plate.corners_px, axis=0) - still.corners_px.mean(axis=0)).max())


def _still(name: str, width_px: int, i: int, drawn: bool) -> Still:
    rng = np.random.default_rng((width_px, i, int(drawn), zlib.crc32(name.encode())))
    reach = min(max(0.36 * SIM.width_px / width_px * 0.5 - 0.4, 0.0), 1.2)
    blur_px = 0.55 if rng.random() < 0.5 else float(rng.uniform(0.35, 0.95))
    text, seed = any_text(name, rng), 7000 * width_px + i
    seen_px = width_px * rng.uniform(0.9, 1.1)
    distance_m = SIM.fx_px * standard_face(name, text, seed=seed if drawn else None).spec.width_mm / 1000 / seen_px
    camera = replace(SIM, height_m=min(SIM.height_m, 0.8 + 0.25 * SIM.height_px * distance_m / SIM.fy_px))
    return render_still(
        name, text, camera=camera, width_px=seen_px, yaw_rad=rng.normal(0, 0.08), tilt_rad=rng.normal(0, 0.06),
        roll_rad=rng.normal(0, 0.02), lateral_m=reach * rng.uniform(-1, 1), seed=seed, true_sizes=drawn,
        body=BODIES[int(rng.integers(len(BODIES)))], style=STREET, scenery=False, sensor=Sensor(blur_px=blur_px),
    )  # fmt: skip


def spoilt(shot: Shot, what: str, seed: int) -> Shot:
    """The shot with one cue falsified, alike in both sightings (see --spoil)."""
    return replace(
        shot, plate=_spoilt_plate(shot.plate, shot, what, seed), unknown=_spoilt_plate(shot.unknown, shot, what, seed)
    )


def _spoilt_plate(plate: PlateSighting | None, shot: Shot, what: str, seed: int) -> PlateSighting | None:
    if plate is None:
        return None
    rng = np.random.default_rng(seed)
    if what == "glyphs":
        factor = float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.04, 0.07)))
        glyphs = []
        for g in plate.glyphs:
            top, bottom = np.array(g.top_px), np.array(g.bottom_px)
            middle, half = (top + bottom) / 2, factor * (bottom - top) / 2
            glyphs.append(replace(g, top_px=tuple(middle - half), bottom_px=tuple(middle + half)))
        return replace(plate, glyphs=tuple(glyphs))
    corners, true = np.array(plate.corners_px), np.asarray(shot.true_corners_px)
    width_mm, _ = load_standards()[shot.standard].outline_belief() or ((520.0, 0.0), (110.0, 0.0))
    right, down = true[1] - true[0], true[3] - true[0]
    per_mm = float(np.hypot(*right)) / width_mm[0]
    out_mm = rng.uniform(6, 14, 4) * (rng.random(4) < 0.4) if what == "frame" else -rng.uniform(3, 7, 4)
    up, out, low, left = out_mm * per_mm
    moved = np.outer([-left, out, out, -left], right / np.hypot(*right)) + np.outer([-up, -up, low, low], down / np.hypot(*down))
    return replace(plate, corners_px=tuple((float(x), float(y)) for x, y in corners + moved))


def _rows(found: list[Shot], auto: Ranger, known: dict[str, Ranger]) -> list[dict[str, Any]]:
    rows = []
    for s in found:
        row: dict[str, Any] = {"standard": s.standard, "width": s.width_px, "drawn": s.drawn, "e": None}
        for name, plate, ranger in (("", s.plate, known[s.standard]), ("auto_", s.unknown, auto)):
            m = None if plate is None else ranger.measure(plate, CAMERA, np.eye(3), 0)[0]
            if m is None:
                continue
            row[name + "e"], row[name + "sigma"] = m.distance_m / s.distance_m - 1, m.sigma_m / s.distance_m
            row[name + "id"] = m.standard
        if s.plate is not None:
            off = np.array(s.plate.corners_px) - s.true_corners_px
            row["corner"], row["coordinate"] = float(np.median(np.hypot(*off.T))), float(np.median(np.abs(off)))
        rows.append(row)
    return rows


def _same(a: str, b: str) -> bool:
    """Whether two standards agree in outer size and character height."""
    known = load_standards()
    sizes = []
    for s in (known[a], known[b]):
        outline, height = s.outline_belief(), s.main_class.height
        sizes.append((*(m for m, _ in outline or ()), *((height.belief("glyph_height")[0],) if height is not None else ())))
    return len(sizes[0]) == len(sizes[1]) and all(abs(np.log(x / y)) < SAME_SIZE for x, y in zip(*sizes, strict=True))


def _stats(rows: list[dict[str, Any]], prefix: str = "") -> str:
    ok = [r for r in rows if r.get(prefix + "e") is not None]
    if not ok:
        return f"0/{len(rows)} | - | - | - | - | -"
    e, s = (np.array([r[prefix + k] for r in ok]) for k in ("e", "sigma"))
    z = np.abs(e) / s
    shown = (f"{100 * np.abs(e).mean():.2f} %", f"{100 * e.mean():+.2f} %", f"{100 * np.quantile(np.abs(e), 0.95):.1f} %",
             f"{100 * np.median(s):.2f} %", f"{(z < 1).mean():.2f} / {(z < 2).mean():.2f}")  # fmt: skip
    return f"{len(ok)}/{len(rows)} | " + " | ".join(shown)


def _corners(rows: list[dict[str, Any]]) -> str:
    seen = [r for r in rows if "corner" in r]
    if not seen:
        return "- | - | -"
    corner = [r["corner"] for r in seen]
    return f"{np.median(corner):.2f} | {np.median([r['coordinate'] for r in seen]):.2f} | {np.quantile(corner, 0.9):.2f}"


def report(rows: list[dict[str, Any]]) -> None:
    for drawn in (False, True):
        print(f"\n### Known standard, {'sizes drawn within the law' if drawn else 'nominal sizes'}\n")
        print(f"| plate px {HEAD}\n" + "|---" * 7 + "|")
        for w in sorted({r["width"] for r in rows}):
            print(f"| {w} | {_stats([r for r in rows if r['width'] == w and r['drawn'] is drawn])} |")
    print(f"\n### By standard, nominal sizes, 60 px and more\n\n| standard {HEAD}\n" + "|---" * 7 + "|")
    for name in dict.fromkeys(r["standard"] for r in rows):
        print(f"| {name} | {_stats([r for r in rows if r['standard'] == name and r['width'] >= 60 and not r['drawn']])} |")
    print("\n### Corners, px\n\n| plate px | median | of one coordinate | p90 |\n|---|---|---|---|")
    for w in sorted({r["width"] for r in rows}):
        print(f"| {w} | {_corners([r for r in rows if r['width'] == w])} |")
    for name in dict.fromkeys(r["standard"] for r in rows):
        print(f"| {name}, 60 and more | {_corners([r for r in rows if r['standard'] == name and r['width'] >= 60])} |")
    print("\n### Standard unknown (auto), sizes drawn within the law\n")
    print(f"| plate px {HEAD} right class | wrong: inside 2 sigma |\n" + "|---" * 9 + "|")
    for w in sorted({r["width"] for r in rows}):
        mine = [r for r in rows if r["width"] == w and r["drawn"]]
        told = [r for r in mine if r.get("auto_e") is not None]
        right = [_same(r["standard"], r["auto_id"]) for r in told]
        wrong = [abs(r["auto_e"]) < 2 * r["auto_sigma"] for r, ok in zip(told, right, strict=True) if not ok]
        share = f"{np.mean(right):.2f}" if right else "-"
        print(f"| {w} | {_stats(mine, 'auto_')} | {share} | {sum(wrong)}/{len(wrong)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stills", type=int, default=8, help="a width and standard")
    parser.add_argument("--seed", type=int, default=0, help="of the first still")
    parser.add_argument("--widths", type=int, nargs="*", default=list(WIDTHS_PX), help="of the plates, px")
    parser.add_argument("--standards", nargs="*", default=list(STANDARDS))
    parser.add_argument("--save", type=Path)
    parser.add_argument("--load", type=Path)
    parser.add_argument("--spoil", choices=("glyphs", "frame", "inside"))
    args = parser.parse_args()
    cv2.setNumThreads(1)
    standards = tuple(args.standards)
    found: list[Shot] = []
    if args.load:
        with args.load.open("rb") as f:
            while f.peek(1):  # one pickle a still, so that a run that was cut short keeps its stills
                found.append(pickle.load(f))
    else:
        with args.save.open("wb") if args.save else nullcontext() as f:
            for shot in shots(standards, tuple(args.widths), range(args.seed, args.seed + args.stills)):
                found.append(shot)
                if f is not None:
                    pickle.dump(shot, f)
    if args.spoil:
        found = [spoilt(shot, args.spoil, i) for i, shot in enumerate(found)]
    settings = RangingSettings()
    known = {s: Ranger(settings, select([s])) for s in {f.standard for f in found}}
    report(_rows(found, Ranger(settings, select(["auto"])), known))


if __name__ == "__main__":
    main()
