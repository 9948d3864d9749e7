"""Rendered plates of known place and size, through what `measure` does before it ranges: found, how exactly, counted.

usage: finding_stills.py [--count 40] [--seed 0] [--glyphnet FILE.onnx] [--cache FOLDER]      one table to stdout
"""

from __future__ import annotations

import argparse
import pickle
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.adapters.detectors import glyphnet
from tmde_edge.app.wiring import build_eyes
from tmde_edge.config import load
from tmde_edge.messages import Frame
from tmde_edge.simulation.stills import Still, render_still
from tmde_edge.vision.detect.contour import box_iou

BINS_PX = ((20, 30), (30, 45), (45, 60), (60, 90), (90, 150), (150, 300))
STANDARDS = ("de-mittel", "us-mi", "ru-1", "gb-1line", "fr-2009", "eu-1line", "us-ca", "it-1line")


def known(wanted: tuple[str, ...]) -> list[str]:
    """Those of the wanted standards that exist; the first of each country for the others."""
    from tmde_edge.plates.standard import select

    ids = [s.id for s in select(["auto"])]
    out = []
    for name in wanted:
        near = [i for i in ids if i == name] or [i for i in ids if i.startswith(name.split("-")[0] + "-")]
        out += near[:1]
    return list(dict.fromkeys(out))


def stills(low_px: float, high_px: float, count: int, seed: int) -> list[Still]:
    """Plates of a range of widths: standards in turn, turned a little, a fifth at night."""
    names = known(STANDARDS)
    out = []
    for k in range(count):
        rng = np.random.default_rng((seed, round(low_px), k))
        width = float(np.exp(rng.uniform(np.log(low_px), np.log(high_px))))
        yaw, tilt, roll = (float(v) for v in rng.normal(0, (0.15, 0.06, 0.02)))
        out.append(render_still(
            names[k % len(names)], width_px=width, yaw_rad=yaw, tilt_rad=tilt, roll_rad=roll,
            seed=seed * 1000 + round(low_px) * 7 + k, night=bool(rng.random() < 0.2),
        ))
    return out


def main() -> None:
    """Prints the table."""
    p = argparse.ArgumentParser()
    p.add_argument("--count", type=int, default=40)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--glyphnet", type=Path)
    p.add_argument("--cache", type=Path)
    a = p.parse_args()
    cv2.setNumThreads(1)
    if a.glyphnet:
        glyphnet.MODEL_FILE = a.glyphnet
    eyes = build_eyes(load(None, ["runtime.threads=1"]), time.perf_counter_ns)
    print("width_px   n  recall  count  corner_px median p90  cover_1  cover_2  false   char_height median |error|  bias")
    for low, high in BINS_PX:
        file = a.cache / f"{low}_{a.count}_{a.seed}.pkl" if a.cache else None
        if file is not None and file.exists():
            made = pickle.loads(file.read_bytes())
        else:
            made = stills(low, high, a.count, a.seed)
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(pickle.dumps(made))
        found, counted, false = 0, 0, 0
        errors: list[NDArray[np.float64]] = []
        z: list[NDArray[np.float64]] = []
        heights: list[float] = []
        for still in made:
            seen = eyes.see_still(Frame(t_ns=0, index=0, image=still.image)).plates
            best = max(seen, key=lambda s: box_iou(np.array(s.corners_px), still.corners_px), default=None)
            if best is None or box_iou(np.array(best.corners_px), still.corners_px) <= 0.5:
                false += len(seen)
                continue
            found, false = found + 1, false + len(seen) - 1
            counted += len(best.glyphs) == len(still.glyph_boxes_px)
            off = np.array(best.corners_px) - still.corners_px
            errors.append(np.hypot(off[:, 0], off[:, 1]))
            z.append(np.abs(off).ravel() / best.corners_sigma_px)
            if best.char_height_px is not None and len(best.glyphs) == len(still.glyph_boxes_px):
                heights.append(best.char_height_px / still.char_height_px - 1)
        e, s, h = np.concatenate(errors), np.concatenate(z), np.array(heights) if heights else np.full(1, np.nan)
        parts = (
            f"{low:3d}-{high:3d} {len(made):4d}  {found / len(made):.3f}  {counted / max(found, 1):.3f}",
            f"{np.median(e):.3f} {np.quantile(e, 0.9):.3f}   {np.mean(s < 1):.2f} {np.mean(s < 2):.2f}   {false / len(made):.3f}",
            f"{100 * np.median(np.abs(h)):.2f} % {100 * np.median(h):+.2f} %",
        )
        print("   ".join(parts), flush=True)


if __name__ == "__main__":
    main()
