#!/usr/bin/env python3
"""Trained weights -> ONNX: uint8 [1, 96, 160] in, logits [1, 89] out; static int8 (QDQ, per channel), the last layer float.

usage: export.py RUN/last.pt --calibrate CACHE --out horizonnet.onnx [--float FILE.onnx]
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

sys.path.insert(0, str(Path(__file__).resolve().parent))
from net import HEIGHT, WIDTH, HorizonNet  # noqa: E402
from train import Cache, batch  # noqa: E402


def take_bytes(model: onnx.ModelProto) -> onnx.ModelProto:
    """Replaces the float input by uint8 [1, H, W]. A quantized graph begins with QuantizeLinear(x, 1/255, 0): the bytes are its output."""
    graph = model.graph
    graph.input.remove(graph.input[0])
    graph.input.insert(0, helper.make_tensor_value_info("image", TensorProto.UINT8, [1, HEIGHT, WIDTH]))
    graph.initializer.append(numpy_helper.from_array(np.array([1, 1, HEIGHT, WIDTH], np.int64), "image_shape"))
    shaped = helper.make_node("Reshape", ["image", "image_shape"], ["image_nchw"], name="image_nchw")
    first = next(n for n in graph.node if "x" in n.input)
    graph.node.insert(0, shaped)
    if first.op_type == "QuantizeLinear":
        values = {i.name: numpy_helper.to_array(i) for i in graph.initializer}
        scale, zero = float(values[first.input[1]]), int(values[first.input[2]])
        if abs(scale * 255 - 1) > 1e-3 or zero != 0:
            raise ValueError(f"input scale {scale}, zero {zero}: calibrate with pictures that reach 0 and 255")
        for n in graph.node:
            for k, name in enumerate(n.input):
                if name == first.output[0]:
                    n.input[k] = "image_nchw"
        graph.node.remove(first)
    else:
        graph.initializer.append(numpy_helper.from_array(np.array(1 / 255, np.float32), "byte_scale"))
        graph.node.insert(1, helper.make_node("Cast", ["image_nchw"], ["image_f"], to=TensorProto.FLOAT))
        graph.node.insert(2, helper.make_node("Mul", ["image_f", "byte_scale"], ["x"]))
    return model


class Calibration(CalibrationDataReader):
    """Crops as in training, and one picture of both extremes so that the input's scale is 1/255."""

    def __init__(self, cache: Path, count: int) -> None:
        images, *_ = batch(Cache(cache), np.random.default_rng(5), count, 0.3)
        extreme = np.random.default_rng(0).integers(0, 2, (1, 1, HEIGHT, WIDTH)).astype(np.float32)
        self.items = iter([{"x": x} for x in (extreme, *(i[None].numpy() for i in images))])

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next picture."""
        return next(self.items, None)


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
    with tempfile.TemporaryDirectory() as d:
        raw, quant = Path(d) / "raw.onnx", Path(d) / "quant.onnx"
        torch.onnx.export(net, (torch.rand(1, 1, HEIGHT, WIDTH),), str(raw), opset_version=17, input_names=["x"], output_names=["logits"], dynamo=False)
        if a.float:
            onnx.save(take_bytes(onnx.load(raw)), a.float)
        last = [n.name for n in onnx.load(raw).graph.node if "logits" in n.output]
        quantize_static(
            str(raw), str(quant), Calibration(a.calibrate, a.count), quant_format=QuantFormat.QDQ, per_channel=True, activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8, calibrate_method=CalibrationMethod.MinMax, nodes_to_exclude=last,
        )  # fmt: skip
        model = take_bytes(onnx.load(quant))
        del model.metadata_props[:]
        onnx.checker.check_model(model)
        a.out.parent.mkdir(parents=True, exist_ok=True)
        onnx.save(model, a.out)
    print(f"{a.out}: {a.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
