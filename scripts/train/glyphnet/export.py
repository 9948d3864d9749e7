"""Writes the trained network as ONNX. usage: export.py CHECKPOINT OUT.onnx"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from net import GlyphNet


def store_half(model: onnx.ModelProto) -> None:
    """Keep big weights as fp16 and widen them at load: half the file, the same fp32 arithmetic."""
    graph = model.graph
    casts = []
    for tensor in graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < 64 or "grid" in tensor.name:
            continue
        name = tensor.name
        tensor.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), name + "_half"))
        casts.append(onnx.helper.make_node("Cast", [name + "_half"], [name], to=onnx.TensorProto.FLOAT))
    for node in reversed(casts):
        graph.node.insert(0, node)


def main() -> None:
    """Exports, checks against torch, prints the size."""
    checkpoint, out = Path(sys.argv[1]), Path(sys.argv[2])
    net = GlyphNet().eval()
    net.load_state_dict(torch.load(checkpoint, map_location="cpu")["ema"])
    x = torch.randn(2, 1, 64, 192)
    torch.onnx.export(
        net, (x,), str(out), opset_version=17, dynamo=False, input_names=["crop"], output_names=["glyphs", "corners", "tail"],
        dynamic_axes={k: {0: "n"} for k in ("crop", "glyphs", "corners", "tail")},
    )
    model = onnx.load(str(out))
    model.doc_string = "GlyphNet of tmde-edge: plate-ness, corners and characters of a plate candidate"
    store_half(model)
    onnx.checker.check_model(model)
    onnx.save(model, str(out))
    x3 = torch.randn(3, 1, 64, 192)
    with torch.no_grad():
        want = [t.numpy() for t in net(x3)]
    got = onnxruntime.InferenceSession(str(out), providers=["CPUExecutionProvider"]).run(None, {"crop": x3.numpy()})
    print("largest difference", [float(np.abs(a - b).max()) for a, b in zip(want, got, strict=True)], out.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
