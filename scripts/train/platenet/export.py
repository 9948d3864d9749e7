#!/usr/bin/env python3
"""Trained weights -> ONNX: batch norm folded, uint8 NHWC input, int8 (static QDQ, per channel), scores and corners left in float.

usage: export.py --weights last.pt --out platenet.onnx --calibrate SHARD.npy... [--float FILE.onnx]
"""
from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from torch.nn.utils.fusion import fuse_conv_bn_eval

sys.path.insert(0, str(Path(__file__).resolve().parent))
from net import ConvBn, PlateNet  # noqa: E402


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


def take_bytes(model: onnx.ModelProto) -> onnx.ModelProto:
    """Replaces the float input by uint8 [1,H,W,3]. A quantized graph begins with QuantizeLinear(x, 1/255, 0): the bytes themselves are its output."""
    graph = model.graph
    graph.input.remove(graph.input[0])
    graph.input.insert(0, helper.make_tensor_value_info("image", TensorProto.UINT8, [1, "h", "w", 3]))
    first = next(n for n in graph.node if "x" in n.input)
    turned = helper.make_node("Transpose", ["image"], ["image_nchw"], perm=[0, 3, 1, 2], name="image_nchw")
    if first.op_type == "QuantizeLinear":
        scale = {i.name: numpy_helper.to_array(i) for i in graph.initializer}[first.input[1]]
        zero = {i.name: numpy_helper.to_array(i) for i in graph.initializer}[first.input[2]]
        if abs(float(scale) * 255 - 1) > 1e-3 or int(zero) != 0:
            raise ValueError(f"input scale {scale}, zero {zero}: calibrate with images that reach 0 and 255")
        for n in graph.node:
            for k, name in enumerate(n.input):
                if name == first.output[0]:
                    n.input[k] = "image_nchw"
        graph.node.remove(first)
        graph.node.insert(0, turned)
    else:
        graph.initializer.append(numpy_helper.from_array(np.array(1 / 255, np.float32), "byte_scale"))
        graph.node.insert(0, turned)
        graph.node.insert(1, helper.make_node("Cast", ["image_nchw"], ["image_f"], to=TensorProto.FLOAT))
        graph.node.insert(2, helper.make_node("Mul", ["image_f", "byte_scale"], ["x"]))
    return model


class Calibration(CalibrationDataReader):
    """Patches of the training cache, and one picture of both extremes so that the input's scale is 1/255."""

    def __init__(self, shards: list[Path], count: int) -> None:
        rng = np.random.default_rng(0)
        pictures = [p for f in shards for p in np.load(f, mmap_mode="r")[:: max(1, len(shards) * 256 // count)]][:count]
        extreme = rng.integers(0, 2, (64, 64, 3), dtype=np.uint8) * 255
        self.items = iter([{"x": (np.ascontiguousarray(p).astype(np.float32) / 255).transpose(2, 0, 1)[None]} for p in [extreme, *pictures]])

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next picture."""
        return next(self.items, None)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--weights", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--float", type=Path)
    p.add_argument("--calibrate", type=Path, nargs="+", required=True)
    p.add_argument("--count", type=int, default=160)
    a = p.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as d:
        raw, quant = Path(d) / "raw.onnx", Path(d) / "quant.onnx"
        export_float(folded(a.weights), raw)
        if a.float:
            onnx.save(take_bytes(onnx.load(raw)), a.float)
        model = onnx.load(raw)
        last = [n.name for n in model.graph.node if n.op_type == "Conv" and n.output[0] in {o.name for o in model.graph.output}]
        if len(last) != 2:
            raise ValueError(f"expected two output convolutions, found {last}")
        quantize_static(str(raw), str(quant), Calibration(a.calibrate, a.count), quant_format=QuantFormat.QDQ, per_channel=True, activation_type=QuantType.QUInt8,
                        weight_type=QuantType.QInt8, calibrate_method=CalibrationMethod.MinMax, nodes_to_exclude=last)
        model = take_bytes(onnx.load(quant))
        del model.metadata_props[:]
        onnx.checker.check_model(model)
        a.out.parent.mkdir(parents=True, exist_ok=True)
        onnx.save(model, a.out)
    print(f"{a.out}: {a.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
