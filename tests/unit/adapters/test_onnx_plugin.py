"""The plugged-in detector: sizes, letterbox and what is refused; with a graph of its own where `onnx` is installed."""

from __future__ import annotations

import numpy as np
import pytest

from tmde_edge.adapters.detectors.onnx_plugin import OnnxFinder, place
from tmde_edge.adapters.detectors.platenet import MODEL_PATH
from tmde_edge.errors import ModelError
from tmde_edge.vision.settings import DetectorSettings


def _settings(path, **more) -> DetectorSettings:
    return DetectorSettings(kind="onnx", onnx_path=str(path), **more)


def test_a_missing_path_and_a_broken_file_are_model_errors(tmp_path):
    with pytest.raises(ModelError, match="onnx_path"):
        OnnxFinder(DetectorSettings(kind="onnx"))
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"not a model")
    with pytest.raises(ModelError, match="cannot load"):
        OnnxFinder(_settings(broken))


@pytest.mark.skipif(not MODEL_PATH.is_file(), reason="the packaged network is not there")
def test_a_network_of_another_family_is_named_as_such():
    """PlateNet itself takes (1, h, w, 3): whatever comes of it, it is a ModelError and no answer."""
    with pytest.raises(ModelError):
        OnnxFinder(_settings(MODEL_PATH, onnx_width_px=64, onnx_height_px=64)).find(np.zeros((64, 64, 3), np.uint8))


@pytest.mark.parametrize("stretch", [True, False])
def test_placing_keeps_track_of_its_scale(stretch):
    crop = np.zeros((100, 400), np.uint8)
    crop[40:60, 100:300] = 255
    canvas, sx, sy = place(crop, 320, 320, stretch=stretch)
    assert canvas.shape == (320, 320, 3)
    bright = np.argwhere(canvas[:, :, 0] > 200)
    assert (bright[:, 1].min(), bright[:, 1].max() + 1) == pytest.approx((100 * sx, 300 * sx), abs=1)
    assert (bright[:, 0].min(), bright[:, 0].max() + 1) == pytest.approx((40 * sy, 60 * sy), abs=1)
    assert (sx == sy) is not stretch
    if not stretch:
        assert (canvas[100:] == 114).all()


def _one_box(path, shape):
    """A network that always answers one box, in input pixels; it reads its picture, so the shape fed must fit."""
    onnx = pytest.importorskip("onnx", reason="onnx is a training extra")
    box = np.zeros((1, 5, 400), np.float32)
    box[0, :, 0] = 80, 40, 60, 20, 0.9
    graph = onnx.helper.make_graph(
        [
            onnx.helper.make_node("ReduceMax", ["image"], ["top"], keepdims=0),
            onnx.helper.make_node("Sub", ["top", "top"], ["zero"]),
            onnx.helper.make_node("Add", ["box", "zero"], ["output"]),
        ],
        "g",
        [onnx.helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, shape)],
        [onnx.helper.make_tensor_value_info("output", onnx.TensorProto.FLOAT, [1, 5, 400])],
        [onnx.numpy_helper.from_array(box, "box")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize("shape", [[1, 160, 320, 3], [2, 3, 160, 320], [1, 1, 160, 320]])
def test_an_input_that_is_no_colour_picture_is_refused_when_loaded(tmp_path, shape):
    path = _one_box(tmp_path / "other.onnx", shape)
    with pytest.raises(ModelError, match=r"takes one image \(1, 3, height, width\)"):
        OnnxFinder(_settings(path))


def test_a_run_that_fails_is_a_model_error(tmp_path):
    """A size left open by the graph, and then not taken by it."""
    onnx = pytest.importorskip("onnx", reason="onnx is a training extra")
    add = onnx.helper.make_node("Add", ["image", "fixed"], ["output"])
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [add], "g", [value("image", onnx.TensorProto.FLOAT, ["n", "c", "h", "w"])],
        [value("output", onnx.TensorProto.FLOAT, None)],
        [onnx.numpy_helper.from_array(np.zeros((1, 3, 24, 24), np.float32), "fixed")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(tmp_path / "fixed.onnx"))
    finder = OnnxFinder(_settings(tmp_path / "fixed.onnx", onnx_width_px=64, onnx_height_px=64))
    with pytest.raises(ModelError, match=r"64x64 px.*onnx_width_px"):
        finder.find(np.zeros((100, 100, 3), np.uint8))


def test_a_graph_end_to_end(tmp_path):
    """The box comes back in source pixels of the region."""
    _one_box(tmp_path / "one.onnx", [1, 3, 160, 320])
    finder = OnnxFinder(_settings(tmp_path / "one.onnx"))
    (found,) = finder.find(np.zeros((720, 1280, 3), np.uint8), region_px=(100, 200, 740, 520))
    true = np.array([[50.0, 30], [110, 30], [110, 50], [50, 50]]) * 2 + (100, 200) - 0.5
    assert found.corners_px == pytest.approx(true, abs=1e-6)
    assert found.score == pytest.approx(0.9)
    (grey,) = finder.find(np.zeros((320, 640), np.uint8))
    assert grey.corners_px[0] == pytest.approx([99.5, 59.5])
