#!/usr/bin/env python3
"""Writes shards of training patches (uint8) and labels; see README.md.

usage: make_cache.py --dashcam FOLDER --photos GLOB... --out FOLDER --shards N [--first K] [--seed S] [--tempting SHARE --mined FOLDER]
A shard is NAME.npy (n, side, side, 3) and NAME.json: [[ [x,y]*4, corner weight, kind ], ...] and whether unlabelled plates are possible.
"""
from __future__ import annotations

import argparse
import json
import pickle
import sys
import time
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[2])]
from backgrounds import false_card, load_cliparts, load_photos  # noqa: E402
from dashcam_split import training_names  # noqa: E402
from faces import ASPECTS, Fonts, latin_fonts, styled_face, wild_face  # noqa: E402
from scenes import Banks, Composer, load_frames  # noqa: E402

SIDES = ((256, 256), (384, 40))  # side_px, patches a shard


def build_banks(a: argparse.Namespace, seed: int, frames: set[str] | None = None) -> Banks:
    """Faces, cards, photos, frames; faces are kept in --out/faces_SEED.pkl."""
    rng = np.random.default_rng(seed)
    fonts = Fonts(latin_fonts(Path(a.fonts)))
    cached = a.out / f"faces_{seed}.pkl"
    if cached.exists():
        faces, cards = pickle.loads(cached.read_bytes())
    else:
        kinds = list(ASPECTS)
        faces = [wild_face(rng, fonts, kinds[int(rng.choice(4, p=(0.36, 0.38, 0.12, 0.14)))]) for _ in range(a.faces)]
        try:
            faces += [styled_face(rng, fonts) for _ in range(a.styled)]
        except ImportError as e:
            print(f"no plate styles yet: {e}", flush=True)
        cards = [false_card(rng, fonts) for _ in range(1200)]
        cached.write_bytes(pickle.dumps((faces, cards)))
    names = sorted(f.name for f in a.dashcam.glob("*.jpg"))
    held = (HERE.parent / "dashcam_ro_holdout.txt").read_text().split()
    extra = json.loads((HERE.parent / "dashcam_ro_extra.json").read_text())
    use = set(training_names(names, held)) if frames is None else frames
    return Banks(faces, cards, load_photos(a.photos), load_frames(a.dashcam, use, extra), load_cliparts(a.cliparts), fonts, a.tempting, load_mined(a.mined))


def load_mined(folder: Path | None) -> list[np.ndarray]:
    """The pictures of mine.py."""
    return [np.asarray(cv2.imread(str(f), cv2.IMREAD_COLOR), np.uint8) for f in sorted(folder.glob("*.png"))] if folder else []


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--dashcam", type=Path, required=True)
    p.add_argument("--photos", nargs="*", default=[])
    p.add_argument("--cliparts", default="/usr/share/openclipart/png")
    p.add_argument("--fonts", default="/usr/share/fonts")
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--shards", type=int, default=100)
    p.add_argument("--first", type=int, default=0)
    p.add_argument("--faces", type=int, default=2600)
    p.add_argument("--styled", type=int, default=2000)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--tempting", type=float, default=0.0, help="share of patches on facades, shop fronts, lit signs and mined places")
    p.add_argument("--mined", type=Path, help="pictures of mine.py")
    p.add_argument("--synthetic", action="store_true", help="no street frames at all: for the synthetic hold-out")
    a = p.parse_args()
    cv2.setNumThreads(1)
    a.out.mkdir(parents=True, exist_ok=True)
    banks = build_banks(a, a.seed, set() if a.synthetic else None)
    print(f"{len(banks.faces)} faces, {len(banks.photos)} photos, {len(banks.frames)} frames, {len(banks.cliparts)} cliparts, {len(banks.mined)} mined", flush=True)
    composer = Composer(banks)
    for shard in range(a.first, a.first + a.shards):
        rng = np.random.default_rng((a.seed, shard))
        t0, n = time.perf_counter(), 0
        for side, count in SIDES:
            images = np.empty((count, side, side, 3), np.uint8)
            meta = []
            for i in range(count):
                images[i], labels, street = composer.patch(rng, side)
                meta.append([[[lab.corners_px.round(3).tolist(), lab.corner_weight, lab.kind] for lab in labels], street])
                n += 1
            stem = a.out / f"s{shard:05d}_{side}"
            stem.with_suffix(".json").write_text(json.dumps(meta))
            np.save(stem.with_suffix(".part.npy"), images)
            stem.with_suffix(".part.npy").rename(stem.with_suffix(".npy"))
        print(f"shard {shard}: {n / (time.perf_counter() - t0):.1f} patches/s", flush=True)


if __name__ == "__main__":
    main()
