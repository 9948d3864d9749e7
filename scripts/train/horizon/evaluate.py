#!/usr/bin/env python3
"""Errors of an exported HorizonNet on held-out shards of generate.py, spoilt as in training, and how often sigma covers them.

usage: evaluate.py SHARD.npz horizonnet.onnx
"""
from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import onnxruntime as ort

sys.path.insert(0, str(Path(__file__).resolve().parent))
from train import crop, spoil  # noqa: E402

from tmde_edge.pose.horizon import OFFSETS_PX, SLOPES  # noqa: E402


def main() -> None:
    shard, model = sys.argv[1:3]
    session = ort.InferenceSession(model, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(3)
    error_px, sigma_px, error_slope = [], [], []
    with np.load(shard) as data:
        for image, line, sigma in zip(data["images"], data["line"], data["sigma"], strict=True):
            picture, offset, slope, _ = crop(image, line, float(sigma), rng)
            fed = (spoil(picture, rng) * 255).astype(np.uint8)[None]
            logits = session.run(None, {session.get_inputs()[0].name: fed})[0][0].astype(float)
            means = []
            for part, values in ((logits[: len(OFFSETS_PX)], OFFSETS_PX), (logits[len(OFFSETS_PX) :], SLOPES)):
                weight = np.exp(part - part.max())
                weight /= weight.sum()
                means += [weight @ values, np.sqrt(weight @ (values - weight @ values) ** 2)]
            error_px.append(means[0] - offset)
            sigma_px.append(means[1])
            error_slope.append(means[2] - slope)
    e, s = np.abs(error_px), np.array(sigma_px)
    print(f"{len(e)} crops: offset median {np.median(e):.2f} px, 90 % {np.percentile(e, 90):.2f} px, rms {np.sqrt(np.mean(e**2)):.2f} px, "
          f"inside 1 / 2 sigma {np.mean(e < s):.2f} / {np.mean(e < 2 * s):.2f}; slope rms {np.sqrt(np.mean(np.square(error_slope))):.4f}")  # fmt: skip


if __name__ == "__main__":
    main()
