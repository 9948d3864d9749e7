#!/usr/bin/env python3
"""Fits the constants of tmde_edge/vision/judgement.py: logistic regression on candidates whose truth is known.

usage: belief.py --dashcam FOLDER [--photos GLOB...] [--count 16] [--every 3]
Candidates come from rendered plates, training frames of dashcam_ro (unlabelled plates known, unsure places left out) and drawn streets of
seeds that no network saw; shown at the end: how many of each remain at several thresholds, and on the held-out rides.
"""
from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[2])]
from backgrounds import Image8, load_photos  # noqa: E402
from dashcam_split import training_names  # noqa: E402
from evaluate import Box, box, iou  # noqa: E402
from faces import Fonts, latin_fonts  # noqa: E402
from scenes import load_frames  # noqa: E402
from streets import tempting_scene  # noqa: E402

from tmde_edge.adapters.detectors.glyphnet import GlyphNet  # noqa: E402
from tmde_edge.adapters.detectors.platenet import PlateNet  # noqa: E402
from tmde_edge.plates.standard import select  # noqa: E402
from tmde_edge.simulation.stills import render_still  # noqa: E402
from tmde_edge.vision.judgement import PLATEHOOD_LOGITS, SCORE_LOGITS  # noqa: E402
from tmde_edge.vision.rectify import is_convex  # noqa: E402
from tmde_edge.vision.search import NetworkSearch  # noqa: E402
from tmde_edge.vision.segment.glyph_reader import GlyphReader  # noqa: E402
from tmde_edge.vision.settings import DetectorSettings, SegmenterSettings  # noqa: E402

WIDTHS_PX = ((20, 30), (30, 45), (45, 60), (60, 90), (90, 150), (150, 300))
Truth = list[tuple[Box, int]]  # 1 a plate, -1 unsure


def rendered(count: int, seed: int) -> Iterator[tuple[Image8, Truth]]:
    """Plates of every standard in turn, turned a little, a fifth at night."""
    ids = [s.id for s in select(["auto"])]
    for low, high in WIDTHS_PX:
        for k in range(count):
            rng = np.random.default_rng((seed, low, k))
            yaw, tilt, roll = (float(v) for v in rng.normal(0, (0.15, 0.06, 0.02)))
            still = render_still(ids[int(rng.integers(len(ids)))], width_px=float(np.exp(rng.uniform(np.log(low), np.log(high)))), yaw_rad=yaw, tilt_rad=tilt,
                                 roll_rad=roll, seed=seed * 1000 + low * 7 + k, night=bool(rng.random() < 0.2))
            yield still.image, [(box(still.corners_px), 1)]


def driven(folder: Path, held_out: bool, every: int) -> Iterator[tuple[Image8, Truth]]:
    """In-car frames of the training or the held-out rides."""
    held = (HERE.parent / "dashcam_ro_holdout.txt").read_text().split()
    extra = json.loads((HERE.parent / "dashcam_ro_extra.json").read_text())
    names = sorted(held) if held_out else training_names(sorted(f.name for f in folder.glob("*.jpg")), held)[::every]
    for name in names:
        frame = load_frames(folder, {name}, extra)[0]
        yield frame.image, [(b, 1) for b in frame.boxes + frame.found] + [(tuple(b), -1) for b in frame.unsure]  # type: ignore[misc]


def drawn(count: int, photos: list[Image8], seed: int) -> Iterator[tuple[Image8, Truth]]:
    """Facades, shop fronts, lit signs: nothing there is a plate."""
    fonts = Fonts(latin_fonts())
    backs = [cv2.resize(p, (640, 640), interpolation=cv2.INTER_AREA).astype(np.float32) for p in photos]
    for i in range(count):
        rng = np.random.default_rng((seed, i))
        scene = tempting_scene(rng, fonts, 640, backs[i % len(backs)] if backs and rng.random() < 0.6 else None)
        yield np.clip(scene + rng.normal(0, rng.uniform(0, 7), scene.shape), 0, 255).astype(np.uint8)[80:560], []


class Judges:
    """What `StillLook` asks, for every candidate and without deciding anything."""

    def __init__(self) -> None:
        self.detector, self.segmenter = DetectorSettings(), SegmenterSettings()
        self.search = NetworkSearch(PlateNet(1), self.detector)
        self.reader = GlyphReader(GlyphNet(1), self.segmenter)

    def candidates(self, pictures: Iterator[tuple[Image8, Truth]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, 4): 1 and three log odds; (n,): whether it is a plate."""
        rows, truth = [], []
        for image, places in pictures:
            for found in self.search.still(image, "strict"):
                best = sorted(found, key=lambda c: -c.score)[:12]
                sure = False
                for c, r in zip(best, self.reader.read(image, best), strict=True):
                    sure = sure or ((r.platehood or 0) >= 0.8 and c.score >= 0.5)
                    if not is_convex(r.corners_px):
                        continue
                    if (r.platehood or 0) < self.segmenter.still_platehood_min:
                        r = self.reader.read(image, [replace(c, corners_px=r.corners_px)])[0]
                    over = max(((iou(box(r.corners_px), b), kind) for b, kind in places), default=(0.0, 0))
                    kind = over[1] if over[0] > 0.5 else -1 if over[0] > 0.1 else 0
                    if kind < 0 or (r.platehood or 0) < self.segmenter.platehood_min or not is_convex(r.corners_px):
                        continue
                    opinions = (c.score, r.platehood or 0.0, self.search.closer(image, r.corners_px) or 0.0)
                    rows.append([1.0, *(np.clip(np.log((p + 1e-9) / (1 - p + 1e-9)), *cap) for p, cap in zip(opinions, (SCORE_LOGITS, PLATEHOOD_LOGITS, SCORE_LOGITS), strict=True))])
                    truth.append(float(kind))
                if sure:
                    break
        return np.array(rows).reshape(-1, 4), np.array(truth)


def fit(x: NDArray[np.float64], y: NDArray[np.float64], ridge: float = 0.01) -> NDArray[np.float64]:
    """Weights of a logistic regression, both classes weighing the same (Newton)."""
    w = np.where(y == 1, 0.5 * len(y) / max(1.0, (y == 1).sum()), 0.5 * len(y) / max(1.0, (y == 0).sum()))
    b = np.zeros(x.shape[1])
    free = np.r_[0.0, np.ones(x.shape[1] - 1)] * ridge * len(y)
    for _ in range(60):
        p = 1 / (1 + np.exp(-x @ b))
        b -= np.linalg.solve((x * (w * p * (1 - p))[:, None]).T @ x + np.diag(free + 1e-9), x.T @ (w * (p - y)) + free * b)
    return b


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--dashcam", type=Path, required=True)
    p.add_argument("--photos", nargs="*", default=[])
    p.add_argument("--count", type=int, default=16, help="rendered plates a width; ten times as many streets")
    p.add_argument("--every", type=int, default=3, help="of the training frames")
    a = p.parse_args()
    cv2.setNumThreads(1)
    judges = Judges()
    sets = {
        "rendered": judges.candidates(rendered(a.count, 77)), "driven": judges.candidates(driven(a.dashcam, False, a.every)),
        "drawn": judges.candidates(drawn(10 * a.count, load_photos(a.photos), 4242)), "held out": judges.candidates(driven(a.dashcam, True, 1)),
    }
    learnt = [sets[k] for k in ("rendered", "driven", "drawn")]
    weights = fit(np.concatenate([x for x, _ in learnt]), np.concatenate([y for _, y in learnt]))
    print("constant, score, platehood, closer:", weights.round(2).tolist())
    for least in (0.4, 0.5, 0.6, 0.7, 0.8):
        kept = {k: 1 / (1 + np.exp(-x @ weights)) >= least for k, (x, _) in sets.items()}
        print(f"belief {least}: " + ", ".join(f"{k}: plates {(v & (sets[k][1] == 1)).sum()} of {(sets[k][1] == 1).sum()}, others {(v & (sets[k][1] == 0)).sum()} of {(sets[k][1] == 0).sum()}"
                                              for k, v in kept.items()), flush=True)


if __name__ == "__main__":
    main()
