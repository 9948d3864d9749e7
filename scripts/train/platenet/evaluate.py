#!/usr/bin/env python3
"""Recall, precision and corner errors of a PlateNet file on held-out drawn patches and on the held-out in-car frames.

usage: evaluate.py --model FILE.onnx [--patches SHARD.npy...] [--dashcam FOLDER] [--scales 0.5 1.0] [--score 0.3] [--sheet OUT.png]
"""
from __future__ import annotations

import argparse
import csv
import json
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[2])]
from tmde_edge.adapters.detectors.platenet import PlateNet  # noqa: E402
from tmde_edge.vision.detect.platenet_decode import suppress  # noqa: E402
from tmde_edge.vision.protocols import PlateCandidate  # noqa: E402

BINS = (8, 12, 16, 24, 32, 48, 64, 96, 140, 200, 340)
Box = tuple[float, float, float, float]


def iou(a: Box, b: Box) -> float:
    """Of two boxes x0, y0, x1, y1."""
    i = max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    u = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - i
    return i / u if u > 0 else 0.0


def box(q: NDArray[np.float64]) -> Box:
    """The quad's bounding box."""
    return float(q[:, 0].min()), float(q[:, 1].min()), float(q[:, 0].max()), float(q[:, 1].max())


def multi_scale(net: PlateNet, image: NDArray[np.uint8], scales: list[float], score: float) -> list[PlateCandidate]:
    """Candidates of every scale, each plate once."""
    found = sorted((c for s in scales for c in net.detect(image, scale=s, score_min=score)), key=lambda c: -c.score)
    return [found[i] for i in suppress(np.array([c.corners_px for c in found]).reshape(-1, 4, 2), 32)]


def patches(net: PlateNet, shards: list[Path], score: float) -> None:
    """Per width bin: recall at IoU 0.5, median and 90 % of the largest corner error; false ones per patch by score."""
    found = {b: [0, 0] for b in BINS}
    errors: dict[int, list[float]] = {b: [] for b in BINS}
    false: list[float] = []
    hits: list[float] = []
    count = 0
    for f in shards:
        images, meta = np.load(f), json.loads(f.with_suffix(".json").read_text())
        for image, (labels, _) in zip(images, meta, strict=True):
            count += 1
            got = net.detect(image, scale=1.0, score_min=score)
            plates = [np.array(q) for q, _, kind in labels if kind == 0]
            ignore = [np.array(q) for q, _, kind in labels if kind == 1]
            used: set[int] = set()
            for q in plates:
                b = max(v for v in BINS if v <= max(np.ptp(q[:, 0]), BINS[0]))
                found[b][1] += 1
                over = [iou(box(q), box(c.corners_px)) if i not in used else 0.0 for i, c in enumerate(got)]
                k = int(np.argmax(over)) if over else -1
                if k >= 0 and over[k] > 0.5:
                    used.add(k)
                    found[b][0] += 1
                    hits.append(got[k].score)
                    errors[b].append(float(np.linalg.norm(got[k].corners_px - q, axis=1).mean()))
            false += [c.score for i, c in enumerate(got) if i not in used and not any(iou(box(c.corners_px), box(q)) > 0.05 for q in ignore)]
    print(f"{count} patches, score >= {score}")
    for b in BINS:
        hit, total = found[b]
        if total:
            e = np.array(errors[b] or [np.nan])
            print(f"  width {b:3d}..: recall {hit / total:.3f} of {total}, corner error px median {np.median(e):.2f}, 90 % {np.quantile(e, 0.9):.2f}")
    total = sum(t for _, t in found.values())
    for s in (0.2, 0.3, 0.4, 0.5, 0.6):
        if s >= score:
            h, n = sum(v >= s for v in hits), sum(v >= s for v in false)
            print(f"  score {s}: recall {h / max(total, 1):.3f}, precision {h / max(h + n, 1):.3f}, false a patch {n / max(count, 1):.3f}")


def dashcam(net: PlateNet, folder: Path, scales: list[float], score: float, sheet: Path | None) -> None:
    """The held-out frames; a "false" one may be an unlabelled second car's plate: look at the sheet."""
    held = set((HERE.parent / "dashcam_ro_holdout.txt").read_text().split())
    truth: dict[str, list[Box]] = {}
    with open(folder / "labels.csv", newline="") as f:
        for r in csv.DictReader(f):
            if r["image"] in held:
                x, y = float(r["x"]), float(r["y"])
                truth.setdefault(r["image"], []).append((x, y, x + float(r["w"]), y + float(r["h"])))
    hits, false, tiles = [], [], []
    total = 0
    for name in sorted(truth):
        image = np.asarray(cv2.imread(str(folder / name), cv2.IMREAD_COLOR), np.uint8)
        got = multi_scale(net, image, scales, score)
        used: set[int] = set()
        total += len(truth[name])
        for b in truth[name]:
            over = [iou(b, box(c.corners_px)) if i not in used else 0.0 for i, c in enumerate(got)]
            k = int(np.argmax(over)) if over else -1
            if k >= 0 and over[k] > 0.5:
                used.add(k)
                hits.append(got[k].score)
            else:
                tiles.append(_tile(image, b, got, (0, 0, 255), f"miss {max(over, default=0):.2f}"))
        for i, c in enumerate(got):
            if i not in used:
                false.append(c.score)
                tiles.append(_tile(image, box(c.corners_px), got, (255, 200, 0), f"extra {c.score:.2f}"))
    for s in (0.2, 0.3, 0.4, 0.5, 0.6):
        if s >= score:
            h, n = sum(v >= s for v in hits), sum(v >= s for v in false)
            print(f"  dashcam held out, scales {scales}, score {s}: recall {h / max(total, 1):.3f} of {total}, precision {h / max(h + n, 1):.3f} (with unlabelled ones as false)")
    if sheet and tiles:
        while len(tiles) % 6:
            tiles.append(np.zeros_like(tiles[0]))
        cv2.imwrite(str(sheet), np.vstack([np.hstack(tiles[i:i + 6]) for i in range(0, min(len(tiles), 60), 6)]))


def _tile(image: NDArray[np.uint8], at: Box, got: list[PlateCandidate], colour: tuple[int, int, int], text: str) -> NDArray[np.uint8]:
    side = max(120.0, 1.8 * (at[2] - at[0]))
    cx, cy = (at[0] + at[2]) / 2, (at[1] + at[3]) / 2
    m = np.array([(200 / side, 0, 100 - cx * 200 / side), (0, 200 / side, 75 - cy * 200 / side)])
    out = np.asarray(cv2.warpAffine(image, m, (200, 150)), np.uint8)
    for c in got:
        q = c.corners_px @ m[:, :2].T + m[:, 2]
        cv2.polylines(out, [np.round(q * 16).astype(np.int32)], True, (0, 255, 0), 1, cv2.LINE_AA, 4)
    a, b = (int(at[0] * m[0, 0] + m[0, 2]), int(at[1] * m[1, 1] + m[1, 2])), (int(at[2] * m[0, 0] + m[0, 2]), int(at[3] * m[1, 1] + m[1, 2]))
    cv2.rectangle(out, a, b, colour, 1)
    cv2.putText(out, text, (3, 145), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return out


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--model", type=Path, required=True)
    p.add_argument("--patches", type=Path, nargs="*", default=[])
    p.add_argument("--dashcam", type=Path)
    p.add_argument("--scales", type=float, nargs="+", default=[0.5, 1.0])
    p.add_argument("--score", type=float, default=0.2)
    p.add_argument("--sheet", type=Path)
    a = p.parse_args()
    cv2.setNumThreads(1)
    net = PlateNet(1, a.model)
    if a.patches:
        patches(net, a.patches, a.score)
    if a.dashcam:
        dashcam(net, a.dashcam, a.scales, a.score, a.sheet)


if __name__ == "__main__":
    main()
