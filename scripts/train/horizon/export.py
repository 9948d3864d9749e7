#!/usr/bin/env python3
"""Trained weights -> ONNX: uint8 [1, 96, 160] in, logits [1, 89] out; static int8 (QDQ, per channel), the last layer float.

usage: export.py RUN/last.pt --calibrate CACHE --out horizonnet.onnx [--float FILE.onnx]
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
from net import HEIGHT, WIDTH, HorizonNet  # noqa: E402
from quantized import BYTES, BYTES_NCHW, FLOATS, Calibration, export, take_bytes  # noqa: E402
from train import Cache, batch  # noqa: E402


def with_bytes(model: onnx.ModelProto) -> onnx.ModelProto:
    """uint8 [1, H, W] in."""
    model.graph.initializer.append(numpy_helper.from_array(np.array([1, 1, HEIGHT, WIDTH], np.int64), "image_shape"))
    shaped = helper.make_node("Reshape", [BYTES, "image_shape"], [BYTES_NCHW], name=BYTES_NCHW)
    return take_bytes(model, [1, HEIGHT, WIDTH], shaped)


def calibration(cache: Path, count: int) -> Calibration:
    """Crops as in training."""
    images, *_ = batch(Cache(cache), np.random.default_rng(5), count, 0.3)
    extreme = np.random.default_rng(0).integers(0, 2, (1, 1, HEIGHT, WIDTH)).astype(np.float32)
    return Calibration([extreme, *(i[None].numpy() for i in images)])


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("weights", type=Path)
    p.add_argument("--calibrate", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--float", type=Path)
    p.add_argument("--count", type=int, default=200)
    a = p.parse_args()
    torch.set_num_threads(1)
    net = HorizonNet()
    net.load_state_dict(torch.load(a.weights, weights_only=True)["ema"])
    net.eval()

    def draw(raw: Path) -> None:
        torch.onnx.export(net, (torch.rand(1, 1, HEIGHT, WIDTH),), str(raw), opset_version=17, input_names=[FLOATS], output_names=["logits"], dynamo=False)

    def last(model: onnx.ModelProto) -> list[str]:
        return [n.name for n in model.graph.node if "logits" in n.output]

    export(draw, last, with_bytes, lambda: calibration(a.calibrate, a.count), a.out, a.float)


if __name__ == "__main__":
    main()
