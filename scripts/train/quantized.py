"""What the exports of PlateNet and HorizonNet share: static int8, and bytes instead of floats as input."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

FLOATS, BYTES, BYTES_NCHW = "x", "image", "image_nchw"  # the network's own input, the one that replaces it, and that in its order


class Calibration(CalibrationDataReader):
    """Float pictures (1, C, H, W), one of both extremes among them, so that the input's scale is 1/255."""

    def __init__(self, pictures: Sequence[np.ndarray]) -> None:
        self.items = iter([{FLOATS: picture} for picture in pictures])

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next picture."""
        return next(self.items, None)


def take_bytes(model: onnx.ModelProto, shape: Sequence[int | str], to_nchw: NodeProto) -> onnx.ModelProto:
    """Replaces the float input by uint8 of this shape; `to_nchw` turns BYTES into BYTES_NCHW.

    A quantized graph begins with QuantizeLinear(x, 1/255, 0): the bytes themselves are its output.
    """
    graph = model.graph
    graph.input.remove(graph.input[0])
    graph.input.insert(0, helper.make_tensor_value_info(BYTES, TensorProto.UINT8, shape))
    first = next(n for n in graph.node if FLOATS in n.input)
    graph.node.insert(0, to_nchw)
    if first.op_type == "QuantizeLinear":
        values = {i.name: numpy_helper.to_array(i) for i in graph.initializer}
        scale, zero = float(values[first.input[1]]), int(values[first.input[2]])
        if abs(scale * 255 - 1) > 1e-3 or zero != 0:
            raise ValueError(f"input scale {scale}, zero {zero}: calibrate with pictures that reach 0 and 255")
        for n in graph.node:
            for k, name in enumerate(n.input):
                if name == first.output[0]:
                    n.input[k] = BYTES_NCHW
        graph.node.remove(first)
    else:
        graph.initializer.append(numpy_helper.from_array(np.array(1 / 255, np.float32), "byte_scale"))
        graph.node.insert(1, helper.make_node("Cast", [BYTES_NCHW], ["image_f"], to=TensorProto.FLOAT))
        graph.node.insert(2, helper.make_node("Mul", ["image_f", "byte_scale"], [FLOATS]))
    return model


def export(
    draw: Callable[[Path], None], last_nodes: Callable[[onnx.ModelProto], list[str]], with_bytes: Callable[[onnx.ModelProto], onnx.ModelProto],
    calibration: Callable[[], Calibration], out: Path, float_out: Path | None,
) -> None:
    """Writes the int8 network (and the float one): `draw` writes the float ONNX, its `last_nodes` stay float."""
    with tempfile.TemporaryDirectory() as d:
        raw, quant = Path(d) / "raw.onnx", Path(d) / "quant.onnx"
        draw(raw)
        if float_out:
            onnx.save(with_bytes(onnx.load(raw)), float_out)
        quantize_static(
            str(raw), str(quant), calibration(), quant_format=QuantFormat.QDQ, per_channel=True, activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8, calibrate_method=CalibrationMethod.MinMax, nodes_to_exclude=last_nodes(onnx.load(raw)),
        )  # fmt: skip
        model = with_bytes(onnx.load(quant))
        del model.metadata_props[:]
        onnx.checker.check_model(model)
        out.parent.mkdir(parents=True, exist_ok=True)
        onnx.save(model, out)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")
