"""Simulated stills against the bars of ranging: known standard, sizes drawn within the law, and `auto`.

python tests/benchmarks/ranging_stills.py [--stills N] [--standards ID ...] [--save FILE | --load FILE]

Plates stand up to 1.2 m beside the axis, turned, leaning and rolled a little, seen by a camera with
noise. Markdown tables are printed. --save keeps the sightings (pickle), --load ranges them again without rendering and
looking: for work on ranging alone.
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tmde_edge.app.wiring import build_eyes
from tmde_edge.config import from_tree
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Frame, PlateSighting
from tmde_edge.plates.standard import load_standards, select
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.settings import RangingSettings
from tmde_edge.simulation.camera import hd_camera
from tmde_edge.simulation.ground import RoadStyle
from tmde_edge.simulation.stills import TWO_LANES, Still, render_still
from tmde_edge.simulation.vehicle import Body

WIDTHS_PX = (20, 30, 60, 80, 120)
STANDARDS = ("de-mittel", "us-mi", "us-aamva3", "ru-1", "gb-2001", "fr-1", "pl-2", "jp-mid", "br-mercosul", "ro-1")
SIM = hd_camera()
CAMERA = Camera(
    width_px=SIM.width_px, height_px=SIM.height_px, fx_px=SIM.fx_px, fy_px=SIM.fy_px, cx_px=SIM.cx_px, cy_px=SIM.cy_px
)
HEAD = "| ranged | mean abs | bias | p95 | median sigma | inside 1 / 2 sigma |"
# Few streets and bodies, so that a still costs little: the plate and its pose are what is measured.
STREET = RoadStyle(markings=TWO_LANES, skyline="trees", sky="day")
BODIES = (
    Body(kind="hatch", colour_bgr=(40.0, 38.0, 36.0), plate_up_m=0.8),
    Body(kind="sedan", colour_bgr=(205.0, 207.0, 208.0), plate_up_m=0.8),
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
    plate: PlateSighting | None


def shots(standards: tuple[str, ...], stills: int) -> Iterator[Shot]:
    eyes = build_eyes(from_tree({"plates": {"expect": ["auto"]}, "runtime": {"threads": 1}}, "benchmark"), time.perf_counter_ns)
    for i in range(stills):
        for name in standards:
            for width_px in WIDTHS_PX:
                for drawn in (False, True):
                    still = _still(name, width_px, i, drawn)
                    sighting = eyes.see_still(Frame(t_ns=0, index=i, image=still.image))
                    near = [p for p in sighting.plates if _off_px(p, still) < 0.3 * width_px]
                    yield Shot(
                        standard=name, width_px=width_px, drawn=drawn, distance_m=still.distance_m,
                        true_corners_px=still.corners_px, plate=near[0] if near else None,
                    )  # fmt: skip


def _off_px(plate: PlateSighting, still: Still) -> float:
    return float(np.abs(np.mean(plate.corners_px, axis=0) - still.corners_px.mean(axis=0)).max())


def _still(name: str, width_px: int, i: int, drawn: bool) -> Still:
    rng = np.random.default_rng((width_px, i, int(drawn)))
    body = BODIES[i % len(BODIES)]
    reach = min(max(0.42 * SIM.width_px / width_px * 0.5 - 0.4, 0.0), 1.2)
    return render_still(
        name, width_px=width_px * rng.uniform(0.97, 1.03), yaw_rad=rng.normal(0, 0.08), tilt_rad=rng.normal(0, 0.06),
        roll_rad=rng.normal(0, 0.02),
        lateral_m=reach * rng.uniform(-1, 1),
        seed=1000 * width_px + i, true_sizes=drawn, body=body, style=STREET, scenery=False,
    )  # fmt: skip


def _rows(found: list[Shot], auto: Ranger, known: dict[str, Ranger]) -> list[dict[str, Any]]:
    rows = []
    for s in found:
        row: dict[str, Any] = {"standard": s.standard, "width": s.width_px, "drawn": s.drawn, "e": None}
        if s.plate is not None:
            for name, ranger in (("", known[s.standard]), ("auto_", auto)):
                m, _, _ = ranger.measure(s.plate, CAMERA, np.eye(3), 0)
                if m is None:
                    continue
                row[name + "e"], row[name + "sigma"] = m.distance_m / s.distance_m - 1, m.sigma_m / s.distance_m
                row[name + "id"] = m.standard
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


def report(rows: list[dict[str, Any]]) -> None:
    for drawn in (False, True):
        print(f"\n### Known standard, {'sizes drawn within the law' if drawn else 'nominal sizes'}\n")
        print(f"| plate px {HEAD}\n" + "|---" * 7 + "|")
        for w in WIDTHS_PX:
            print(f"| {w} | {_stats([r for r in rows if r['width'] == w and r['drawn'] is drawn])} |")
    print(f"\n### By standard, nominal sizes, 60 px and more\n\n| standard {HEAD}\n" + "|---" * 7 + "|")
    for name in dict.fromkeys(r["standard"] for r in rows):
        print(f"| {name} | {_stats([r for r in rows if r['standard'] == name and r['width'] >= 60 and not r['drawn']])} |")
    print("\n### Standard unknown (auto), sizes drawn within the law\n")
    print(f"| plate px {HEAD} right class | wrong: inside 2 sigma |\n" + "|---" * 9 + "|")
    for w in WIDTHS_PX:
        mine = [r for r in rows if r["width"] == w and r["drawn"]]
        told = [r for r in mine if r.get("auto_e") is not None]
        right = [_same(r["standard"], r["auto_id"]) for r in told]
        wrong = [abs(r["auto_e"]) < 2 * r["auto_sigma"] for r, ok in zip(told, right, strict=True) if not ok]
        share = f"{np.mean(right):.2f}" if right else "-"
        print(f"| {w} | {_stats(mine, 'auto_')} | {share} | {sum(wrong)}/{len(wrong)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stills", type=int, default=8, help="a width and standard")
    parser.add_argument("--standards", nargs="*", default=list(STANDARDS))
    parser.add_argument("--save", type=Path)
    parser.add_argument("--load", type=Path)
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
            for shot in shots(standards, args.stills):
                found.append(shot)
                if f is not None:
                    pickle.dump(shot, f)
    settings = RangingSettings()
    known = {s: Ranger(settings, select([s])) for s in {f.standard for f in found}}
    report(_rows(found, Ranger(settings, select(["auto"])), known))


if __name__ == "__main__":
    main()
