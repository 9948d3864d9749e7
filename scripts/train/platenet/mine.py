#!/usr/bin/env python3
"""Cuts out what a PlateNet takes for plates in pictures that hold none: photos, and drawn streets of another seed than the shards'.

usage: mine.py --model FILE.onnx --photos GLOB... --out FOLDER [--scenes 2000] [--score 0.3] [--seed 7]
Each picture is as the network saw it (its scale), the tempting place in its middle. Look at them: a photo with a plate spoils everything.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parents[2])]
from backgrounds import Image8, load_photos  # noqa: E402
from faces import Fonts, latin_fonts  # noqa: E402
from streets import tempting_scene  # noqa: E402

from tmde_edge.adapters.detectors.platenet import PlateNet  # noqa: E402

SIDE_PX = 384
WIDTHS_PX = (256, 640, 1280)  # a photo is searched at these widths, never enlarged
MOST = 4  # places of one picture at one scale


def places(net: PlateNet, picture: Image8, score: float) -> list[Image8]:
    """Cuts of SIDE_PX round the surest candidates; the picture mirrored beyond its borders."""
    half = SIDE_PX // 2
    wide = cv2.copyMakeBorder(picture, half, half, half, half, cv2.BORDER_REFLECT_101)
    out = []
    for c in net.detect(picture, scale=1.0, score_min=score, max_candidates=MOST):
        x, y = (round(float(v)) for v in np.clip(c.corners_px.mean(axis=0), 0, (picture.shape[1] - 1, picture.shape[0] - 1)))
        out.append(wide[y:y + SIDE_PX, x:x + SIDE_PX])
    return out


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--model", type=Path, required=True)
    p.add_argument("--photos", nargs="*", default=[])
    p.add_argument("--fonts", default="/usr/share/fonts")
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--scenes", type=int, default=2000)
    p.add_argument("--score", type=float, default=0.3)
    p.add_argument("--seed", type=int, default=7)
    a = p.parse_args()
    cv2.setNumThreads(1)
    net, count = PlateNet(1, a.model), 0
    a.out.mkdir(parents=True, exist_ok=True)

    def keep(cuts: list[Image8], name: str) -> None:
        for k, cut in enumerate(cuts):
            cv2.imwrite(str(a.out / f"{name}_{k}.png"), cut)

    for i, photo in enumerate(load_photos(a.photos)):
        for width in WIDTHS_PX:
            scale = min(1.0, width / photo.shape[1])
            if scale == 1.0 and width > photo.shape[1] * 1.5:
                continue
            small = photo if scale == 1.0 else np.asarray(cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
            cuts = places(net, small, a.score)
            keep(cuts, f"photo{i:04d}_{width}")
            count += len(cuts)
    print(f"{count} places in photos", flush=True)
    fonts = Fonts(latin_fonts(Path(a.fonts)))
    for i in range(a.scenes):
        rng = np.random.default_rng((a.seed, i))
        scene = tempting_scene(rng, fonts, SIDE_PX, None)
        cuts = places(net, np.clip(scene + rng.normal(0, rng.uniform(0, 6), scene.shape), 0, 255).astype(np.uint8), a.score)
        keep(cuts, f"scene{i:05d}")
        count += len(cuts)
    print(f"{count} places in all", flush=True)


if __name__ == "__main__":
    main()
