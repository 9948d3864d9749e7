"""Writes shards of training crops. usage: generate.py OUT --count N --seed S [--held-out-fonts] [--photos GLOB...] [--frames DASHCAM_RO]"""

from __future__ import annotations

import argparse
import csv
import json
import re
from pathlib import Path

import cv2
import numpy as np
from fonts import font_files, sign_fonts
from negatives import near_boxes, samples
from scenes import MAX_GLYPHS, Frame, Sample, World

from tmde_edge.adapters.detectors.platenet import PlateNet

PHOTOS = ("/usr/share/wallpapers/**/*.jpg", "/usr/share/wallpapers/**/*.png", "/usr/share/backgrounds/**/*.jpg", "/usr/share/backgrounds/**/*.png")
FACADES = ("/usr/share/games/torcs/tracks/**/*.png",)
NOT_FACADES = "tree|shadow|raceline|background|grass|road|sand|map|env|sky|bush|arbor|dirt|gravel|asphalt"
SHARD = 500


def load_photos(patterns: tuple[str, ...], side_px: int, refused: str = "^$") -> list[np.ndarray]:
    """Pictures of some glob patterns, at most side_px wide or high."""
    out = []
    for pattern in patterns:
        for file in sorted(Path("/").glob(pattern.lstrip("/"))):
            image = None if re.search(refused, file.name, re.I) else cv2.imread(str(file))
            if image is None or min(image.shape[:2]) < 120 or image.std() < 12:
                continue
            k = side_px / max(image.shape[:2])
            out.append(cv2.resize(image, None, fx=k, fy=k, interpolation=cv2.INTER_AREA) if k < 1 else image)
    return out


def load_frames(folder: Path, holdout: Path, held_out: bool) -> list[Frame]:
    """In-car frames of the training (or held-out) part; plates that their labels miss are known from a list."""
    away = set(holdout.read_text().split())
    extra = json.loads((holdout.parent / "dashcam_ro_extra.json").read_text())
    boxes: dict[str, list[list[float]]] = {}
    with (folder / "labels.csv").open() as f:
        for row in csv.DictReader(f):
            boxes.setdefault(row["image"], []).append([float(row[k]) for k in "xywh"])
    out = []
    for name in sorted(boxes):
        image = cv2.imread(str(folder / name)) if (name in away) == held_out else None
        if image is not None:
            more = extra.get(name, {})
            found, unsure = ([[a, b, c - a, d - b] for a, b, c, d in more.get(k, [])] for k in ("plates", "unsure"))
            out.append(Frame(image, np.array(boxes[name] + found, np.float64), np.array(unsure, np.float64).reshape(-1, 4)))
    return out


def find_tempting(world: World) -> list[tuple[str, int, np.ndarray]]:
    """Corners that the shipped PlateNet proposes where no plate is."""
    net, out = PlateNet(1), []
    pools = {"photos": world.photos, "facades": world.facades, "frames": [f.image for f in world.frames]}
    for pool, images in pools.items():
        for index, image in enumerate(images):
            known = np.concatenate([world.frames[index].boxes, world.frames[index].unsure]) if pool == "frames" else np.zeros((0, 4))
            for scale in (1.0, 0.5) if pool == "frames" else (min(1.0, 640 / image.shape[1]), min(0.4, 320 / image.shape[1])):
                for c in net.detect(image, scale=scale, score_min=0.08, max_candidates=12):
                    if np.ptp(c.corners_px[:, 0]) >= 10 and not near_boxes(c.corners_px, known):
                        out.append((pool, index, c.corners_px))
    return out


def load_world(frames_dir: Path | None, holdout: Path, held_out: bool) -> World:
    """Photos, walls and boards, in-car frames of the training (or held-out) part with their boxes, fonts."""
    photos, facades = load_photos(PHOTOS, 1100), load_photos(FACADES, 1024, NOT_FACADES)
    photos, facades = ([p for i, p in enumerate(pool) if (i % 7 == 0) == held_out] for pool in (photos, facades))
    frames = load_frames(frames_dir, holdout, held_out) if frames_dir is not None and frames_dir.exists() else []
    world = World(photos, frames, font_files(held_out), facades, sign_fonts(), [])
    world.tempting = find_tempting(world)
    return world


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
    print(f"{len(world.photos)} photos, {len(world.facades)} walls, {len(world.tempting)} tempting places, {len(world.frames)} frames, {len(world.fonts)} fonts", flush=True)
    a.out.mkdir(parents=True, exist_ok=True)
    for k in range(-(-a.count // SHARD)):
        file = a.out / f"shard_{a.seed:03d}_{k:04d}.npz"
        if file.exists():
            continue
        made, i = [], 0
        while len(made) < min(SHARD, a.count):
            made += samples(np.random.default_rng([a.seed, k, i]), world)
            i += 1
        temp = file.with_suffix(".tmp.npz")
        np.savez(temp, **pack(made[:SHARD]))
        temp.rename(file)
        print(file.name, flush=True)


if __name__ == "__main__":
    main()
