"""Writes patches round single characters for GlyphEdges. usage: generate_edges.py OUT.npz --plates N --seed S [--held-out]"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from fonts import random_font
from generate import load_world
from scenes import World, plate_width, project, view

from tmde_edge.simulation.plate_styles import random_spec
from tmde_edge.vision.segment.glyph_decode import Glyph
from tmde_edge.vision.segment.refine_glyphs import cut_patch, patch_frame

JITTERS = 2


def plate_patches(rng: np.random.Generator, world: World) -> list[tuple[np.ndarray, np.ndarray, float, float]]:
    """(patch, true offsets left right top bottom in patch px, log source px per patch px, plate width px) of one plate."""
    spec = random_spec(rng)
    width_px = plate_width(rng)
    grey, quad, h = view(rng, world, spec, random_font(rng, world.fonts), width_px)
    out = []
    for g in spec.glyphs:
        if not g.counted:
            continue
        x0, x1, y0, y1 = g.left_mm, g.left_mm + g.width_mm, g.top_mm, g.top_mm + g.height_mm
        xm, ym = (x0 + x1) / 2, (y0 + y1) / 2
        true = project(h, np.array([[x0, ym], [x1, ym], [xm, y0], [xm, y1]]))
        across, down = true[1] - true[0], true[3] - true[2]
        wide, high = float(np.hypot(*across)), float(np.hypot(*down))
        if high < 2.0 or wide < 0.3:
            continue
        for _ in range(JITTERS):
            # the first network's boxes: some tenths of a pixel and a share of the height off, directions a little too
            spread = np.hypot(0.28, 0.022 * high) * np.exp(rng.normal(0, 0.3))
            e = rng.normal(0, spread, 4)
            tilt, lean = rng.normal(0, 0.008), rng.normal(0, 0.022)
            u, v = across / wide, down / high
            u = u + tilt * v
            v = v + lean * u
            u, v = u / np.hypot(*u), v / np.hypot(*v)
            a, b = -wide / 2 + e[0], max(wide / 2 + e[1], -wide / 2 + e[0] + 0.4)
            c, d = -high / 2 + e[2], max(high / 2 + e[3], -high / 2 + e[2] + 1.6)
            mid = true.mean(axis=0)
            box = mid + (a + b) / 2 * u + (c + d) / 2 * v
            glyph = Glyph(left_px=box - (b - a) / 2 * u, right_px=box + (b - a) / 2 * u, top_px=box - (d - c) / 2 * v,
                          bottom_px=box + (d - c) / 2 * v, score=1.0, main=True, row=0)
            frame = patch_frame(glyph)
            if frame is None:
                continue
            inverse = np.linalg.inv(frame[:, :2])
            t = (true - frame[:, 2]) @ inverse.T
            g4 = (np.array([glyph.left_px, glyph.right_px, glyph.top_px, glyph.bottom_px]) - frame[:, 2]) @ inverse.T
            offsets = np.array([t[0, 0] - g4[0, 0], t[1, 0] - g4[1, 0], t[2, 1] - g4[2, 1], t[3, 1] - g4[3, 1]])
            out.append((cut_patch(grey, frame), offsets, float(np.log(np.hypot(*frame[:, 1]))), width_px))
    return out


def main() -> None:
    """One file."""
    p = argparse.ArgumentParser()
    p.add_argument("out", type=Path)
    p.add_argument("--plates", type=int, default=8000)
    p.add_argument("--seed", type=int, default=11)
    p.add_argument("--held-out", action="store_true")
    p.add_argument("--frames", type=Path, default=Path("../shared/data/dashcam_ro"))
    p.add_argument("--holdout-list", type=Path, default=Path(__file__).parents[1] / "dashcam_ro_holdout.txt")
    a = p.parse_args()
    cv2.setNumThreads(1)
    world = load_world(a.frames, a.holdout_list, a.held_out)
    rows = [r for i in range(a.plates) for r in plate_patches(np.random.default_rng([a.seed, i]), world)]
    np.savez(a.out, patch=np.stack([r[0] for r in rows]), offsets=np.array([r[1] for r in rows], np.float32),
             log_scale=np.array([[r[2]] for r in rows], np.float32), plate_w_px=np.array([r[3] for r in rows], np.float32))
    print(len(rows), "patches")


if __name__ == "__main__":
    main()
