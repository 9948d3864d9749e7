#!/usr/bin/env python3
"""Trained weights -> ONNX: batch norm folded, uint8 NHWC input, int8 (static QDQ, per channel), scores and corners left in float.

usage: export.py --weights last.pt --out platenet.onnx --calibrate SHARD.npy... [--float FILE.onnx]
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper
from torch.nn.utils.fusion import fuse_conv_bn_eval

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
from net import ConvBn, PlateNet  # noqa: E402
from quantized import BYTES, BYTES_NCHW, Calibration, export, take_bytes  # noqa: E402


def folded(weights: Path) -> PlateNet:
    """The averaged (EMA) network with its batch norms folded into the convolutions."""
    net = PlateNet()
    net.load_state_dict(torch.load(weights, weights_only=True)["ema"])
    net.eval()
    for m in net.modules():
        if isinstance(m, ConvBn):
            m[0] = fuse_conv_bn_eval(m[0], m[1])
            m[1] = torch.nn.Identity()
    return net


def export_float(net: PlateNet, path: Path) -> None:
    """x: float [1,3,H,W] in 0..1."""
    torch.onnx.export(net, (torch.rand(1, 3, 96, 128),), str(path), opset_version=17, input_names=["x"], output_names=["maps4", "maps16"], dynamo=False,
                      dynamic_axes={"x": {2: "h", 3: "w"}, "maps4": {2: "h4", 3: "w4"}, "maps16": {2: "h16", 3: "w16"}})


def with_bytes(model: onnx.ModelProto) -> onnx.ModelProto:
    """uint8 [1, H, W, 3] in."""
    turned = helper.make_node("Transpose", [BYTES], [BYTES_NCHW], perm=[0, 3, 1, 2], name=BYTES_NCHW)
    return take_bytes(model, [1, "h", "w", 3], turned)


def calibration(shards: list[Path], count: int) -> Calibration:
    """Patches of the training cache."""
    rng = np.random.default_rng(0)
    pictures = [p for f in shards for p in np.load(f, mmap_mode="r")[:: max(1, len(shards) * 256 // count)]][:count]
    extreme = rng.integers(0, 2, (64, 64, 3), dtype=np.uint8) * 255
    return Calibration([(np.ascontiguousarray(p).astype(np.float32) / 255).transpose(2, 0, 1)[None] for p in [extreme, *pictures]])


def last_nodes(model: onnx.ModelProto) -> list[str]:
    """The two output convolutions."""
    found = [n.name for n in model.graph.node if n.op_type == "Conv" and n.output[0] in {o.name for o in model.graph.output}]
    if len(found) != 2:
        raise ValueError(f"expected two output convolutions, found {found}")
    return found


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--weights", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--float", type=Path)
    p.add_argument("--calibrate", type=Path, nargs="+", required=True)
    p.add_argument("--count", type=int, default=160)
    a = p.parse_args()
    torch.set_num_threads(1)
    export(lambda raw: export_float(folded(a.weights), raw), last_nodes, with_bytes, lambda: calibration(a.calibrate, a.count), a.out, a.float)


if __name__ == "__main__":
    main()
