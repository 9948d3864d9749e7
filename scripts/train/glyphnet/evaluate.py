"""Judges an exported network on held-out shards. usage: evaluate.py SHARDS MODEL.onnx [--sheet FILE.png]"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from tmde_edge.vision.segment.glyph_crop import apply_affine, invert_affine, normalise
from tmde_edge.vision.segment.glyph_decode import decode

BINS = (0, 30, 40, 60, 90, 150, 300, 1000)


def main() -> None:
    """Prints tables."""
    p = argparse.ArgumentParser()
    p.add_argument("shards", type=Path)
    p.add_argument("model", type=Path)
    p.add_argument("--sheet", type=Path)
    a = p.parse_args()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(a.model), options, providers=["CPUExecutionProvider"])
    plates, scores, bad = [], {}, []
    for file in sorted(a.shards.glob("shard_*.npz")):
        with np.load(file) as z:
            data = {k: z[k] for k in z.files}
        for start in range(0, len(data["plate"]), 64):
            part = slice(start, start + 64)
            outputs = session.run(None, {session.get_inputs()[0].name: normalise(data["canvas"][part])})
            for k in range(len(outputs[0])):
                i = start + k
                reading = decode(outputs[0][k], outputs[1][k], outputs[2][k], data["canvas_from_source"][i].astype(np.float64))
                kind = str(data["kind"][i])
                scores.setdefault((int(data["plate"][i]), kind), []).append(reading.platehood)
                if kind != "plate":
                    continue
                back = invert_affine(data["canvas_from_source"][i].astype(np.float64))
                truth = data["glyphs"][i][~np.isnan(data["glyphs"][i][:, 0])]
                corner_error = np.hypot(*(reading.corners_px - apply_affine(back, data["corners"][i].astype(np.float64))).T)
                edges, small_right = [], []
                scale_y = float(np.hypot(*back[:, 1]))
                scale_x = float(np.hypot(*back[:, 0]))
                forward = data["canvas_from_source"][i].astype(np.float64)
                for g in reading.glyphs:
                    left, right, top, bottom = (apply_affine(forward, q) for q in (g.left_px, g.right_px, g.top_px, g.bottom_px))
                    j = int(np.argmin(np.abs(truth[:, 0] - (left[0] + right[0]) / 2) + np.abs(truth[:, 1] - (top[1] + bottom[1]) / 2)))
                    t = truth[j]
                    if abs(t[0] - (left[0] + right[0]) / 2) < 5:
                        edges.append([(top[1] - t[4]) * scale_y, (bottom[1] - t[5]) * scale_y, (left[0] - t[2]) * scale_x, (right[0] - t[3]) * scale_x,
                                      (bottom[1] - top[1] - t[5] + t[4]) * scale_y])
                        small_right.append(g.main == (t[6] < 0.5))
                height = ((truth[:, 5] - truth[:, 4]) * scale_y).mean()
                mean_height = np.mean([e[4] for e in edges]) / height if edges else np.nan
                plates.append((float(data["plate_w_px"][i]), reading.count == len(truth), np.array(edges), corner_error, reading.sigma_px, reading.platehood,
                               reading.light_on_dark == bool(data["light"][i]), float(np.mean(small_right)) if small_right else np.nan, mean_height))
                if reading.count != len(truth) and data["plate_w_px"][i] > 45 and len(bad) < 96:
                    bad.append((data["canvas"][i], reading, forward, truth))
    print("width_px      n  count  top/bottom_px(med) left/right_px height%(med) corner_px(med,p90) corner/sigma>1,>2 light main plate>.5")
    for low, high in zip(BINS[:-1], BINS[1:], strict=True):
        rows = [r for r in plates if low <= r[0] < high]
        if not rows:
            continue
        edges = np.concatenate([r[2] for r in rows if len(r[2])]) if any(len(r[2]) for r in rows) else np.full((1, 5), np.nan)
        corner = np.concatenate([r[3] for r in rows])
        z = np.concatenate([r[3] / np.sqrt(2) / r[4] for r in rows])
        print(f"{low:4d}-{high:4d} {len(rows):6d}  {np.mean([r[1] for r in rows]):.3f}  {np.median(np.abs(edges[:, :2])):.3f} (bias {np.median(edges[:, 0]):+.3f} {np.median(edges[:, 1]):+.3f})"
              f"  {np.median(np.abs(edges[:, 2:4])):.3f}  {100 * np.nanmedian(np.abs([r[8] for r in rows])):.2f}"
              f"  {np.median(corner):.3f} {np.quantile(corner, 0.9):.3f}  {np.mean(z > 1):.2f} {np.mean(z > 2):.2f}"
              f"  {np.mean([r[6] for r in rows]):.3f}  {np.nanmean([r[7] for r in rows]):.3f}  {np.mean([r[5] > 0.5 for r in rows]):.3f}")
    print("all counts exact:", round(float(np.mean([r[1] for r in plates])), 4), "of plates >= 40 px:", round(float(np.mean([r[1] for r in plates if r[0] >= 40])), 4))
    for (plate, kind), values in sorted(scores.items()):
        v = np.array(values)
        print(f"plate={plate} {kind:10s} n={len(v):5d} share above 0.3 / 0.5 / 0.7 / 0.9: {[round(float((v > t).mean()), 4) for t in (0.3, 0.5, 0.7, 0.9)]}")
    if a.sheet and bad:
        tiles = []
        for canvas, reading, forward, truth in bad:
            tile = cv2.cvtColor(cv2.resize(canvas, None, fx=1.5, fy=1.5), cv2.COLOR_GRAY2BGR)
            for g in reading.glyphs:
                pts = apply_affine(forward, np.array([g.left_px, g.right_px, g.top_px, g.bottom_px])) * 1.5
                cv2.rectangle(tile, (round(pts[0, 0]), round(pts[2, 1])), (round(pts[1, 0]), round(pts[3, 1])), (0, 0, 255) if g.main else (255, 120, 0), 1)
            for t in truth:
                cv2.circle(tile, (round(t[0] * 1.5), round(t[1] * 1.5)), 2, (0, 255, 0), -1)
            cv2.polylines(tile, [np.round(apply_affine(forward, reading.corners_px) * 1.5).astype(int)], True, (0, 220, 220), 1)
            tiles.append(tile)
        while len(tiles) % 6:
            tiles.append(np.zeros_like(tiles[0]))
        cv2.imwrite(str(a.sheet), np.vstack([np.hstack(tiles[i : i + 6]) for i in range(0, len(tiles), 6)]))


if __name__ == "__main__":
    main()
