"""Writes shards of training crops. usage: generate.py OUT --count N --seed S [--held-out-fonts] [--photos GLOB...] [--frames DASHCAM_RO]"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import cv2
import numpy as np
from fonts import font_files
from scenes import MAX_GLYPHS, Sample, World, any_sample

PHOTOS = ("/usr/share/wallpapers/**/*.jpg", "/usr/share/wallpapers/**/*.png", "/usr/share/backgrounds/**/*.jpg", "/usr/share/backgrounds/**/*.png")
SHARD = 500


def load_world(frames_dir: Path | None, holdout: Path, held_out: bool, photos_share: slice = slice(None)) -> World:
    """Photos, in-car frames of the training (or held-out) part with their boxes, fonts."""
    photos = []
    for pattern in PHOTOS:
        for file in sorted(Path("/").glob(pattern.lstrip("/"))):
            image = cv2.imread(str(file))
            if image is None or min(image.shape[:2]) < 300:
                continue
            k = 1100 / max(image.shape[:2])
            photos.append(cv2.resize(image, None, fx=k, fy=k, interpolation=cv2.INTER_AREA) if k < 1 else image)
    photos = [p for i, p in enumerate(photos) if (i % 7 == 0) == held_out]
    frames = []
    if frames_dir is not None and frames_dir.exists():
        away = set(holdout.read_text().split())
        boxes: dict[str, list[list[float]]] = {}
        with (frames_dir / "labels.csv").open() as f:
            for row in csv.DictReader(f):
                boxes.setdefault(row["image"], []).append([float(row[k]) for k in "xywh"])
        for name in sorted(boxes):
            if (name in away) == held_out:
                image = cv2.imread(str(frames_dir / name))
                if image is not None:
                    frames.append((image, np.array(boxes[name], np.float64)))
    return World(photos, frames, font_files(held_out))


def pack(samples: list[Sample]) -> dict[str, np.ndarray]:
    """Arrays of equal length."""
    n = len(samples)
    glyphs = np.full((n, MAX_GLYPHS, 7), np.nan, np.float32)
    for i, s in enumerate(samples):
        glyphs[i, : len(s.glyphs), :6] = s.glyphs
        glyphs[i, : len(s.glyphs), 6] = s.small
    return {
        "canvas": np.stack([s.canvas for s in samples]), "plate": np.array([s.plate for s in samples], np.int8),
        "corners": np.stack([s.corners for s in samples]), "glyphs": glyphs,
        "light": np.array([s.light_on_dark for s in samples], np.int8),
        "px_per_canvas": np.array([s.px_per_canvas for s in samples], np.float32),
        "plate_w_px": np.array([s.plate_w_px for s in samples], np.float32), "kind": np.array([s.kind for s in samples]),
        "canvas_from_source": np.stack([s.canvas_from_source for s in samples]),
    }


def main() -> None:
    """Resumes after the last whole shard."""
    p = argparse.ArgumentParser()
    p.add_argument("out", type=Path)
    p.add_argument("--count", type=int, default=60000)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--held-out", action="store_true")
    p.add_argument("--frames", type=Path, default=Path("../shared/data/dashcam_ro"))
    p.add_argument("--holdout-list", type=Path, default=Path(__file__).parents[1] / "dashcam_ro_holdout.txt")
    a = p.parse_args()
    cv2.setNumThreads(1)
    world = load_world(a.frames, a.holdout_list, a.held_out)
    print(f"{len(world.photos)} photos, {len(world.frames)} frames, {len(world.fonts)} fonts", flush=True)
    a.out.mkdir(parents=True, exist_ok=True)
    for k in range(-(-a.count // SHARD)):
        file = a.out / f"shard_{a.seed:03d}_{k:04d}.npz"
        if file.exists():
            continue
        samples = [any_sample(np.random.default_rng([a.seed, k, i]), world) for i in range(min(SHARD, a.count))]
        temp = file.with_suffix(".tmp.npz")
        np.savez(temp, **pack(samples))
        temp.rename(file)
        print(file.name, flush=True)


if __name__ == "__main__":
    main()
