from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from tmde_edge.adapters.depth.disabled import DisabledDepth
from tmde_edge.adapters.depth.manifest import ModelSpec, find_model, known_models, write_sidecar
from tmde_edge.adapters.depth.onnx_depth import OnnxDepth, chosen_providers
from tmde_edge.adapters.depth.onnx_graph import first_operators, normalises_inside
from tmde_edge.adapters.depth.paced import PacedDepth
from tmde_edge.adapters.depth.recorded import RecordedDepth, write_track
from tmde_edge.adapters.depth.threaded import ThreadedDepth
from tmde_edge.errors import InputDataError, InputMissingError, ModelError
from tmde_edge.messages import DepthReading, Frame

SPEC = ModelSpec(name="tiny", file="tiny.onnx", input="0", output="797", width_px=64, height_px=64, normalisation="inside")
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def tiny_model(path: Path, *, normalises: bool = True, value: float | None = None, size_px: int = 64) -> Path:
    """MiDaS's contract in four nodes: Sub, Div, a 1x1 convolution that adds the channels, Squeeze."""
    onnx = pytest.importorskip("onnx", reason="the package onnx (an extra) is not installed")
    h, n, t = onnx.helper, onnx.numpy_helper, onnx.TensorProto
    weights = np.ones((1, 3, 1, 1), np.float32) if value is None else np.full((1, 3, 1, 1), value, np.float32)
    constants = {
        "mean": MEAN.reshape(1, 3, 1, 1).astype(np.float32), "std": STD.reshape(1, 3, 1, 1).astype(np.float32),
        "w": weights, "axis": np.array([1], np.int64),
    }  # fmt: skip
    head = [h.make_node("Sub", ["0", "mean"], ["a"]), h.make_node("Div", ["a", "std"], ["b"])]
    tail = [h.make_node("Conv", ["b", "w"], ["c"], kernel_shape=[1, 1]), h.make_node("Squeeze", ["c", "axis"], ["797"])]
    nodes = [*(head if normalises else [h.make_node("Relu", ["0"], ["b"])]), *tail]
    graph = h.make_graph(
        nodes, "tiny", [h.make_tensor_value_info("0", t.FLOAT, [1, 3, size_px, size_px])],
        [h.make_tensor_value_info("797", t.FLOAT, [1, size_px, size_px])], [n.from_array(v, k) for k, v in constants.items()],
    )  # fmt: skip
    onnx.save(h.make_model(graph, opset_imports=[h.make_opsetid("", 13)], ir_version=8), str(path))
    return path


def frame(t_ns: int = 0, level: int = 128, shape: tuple[int, ...] = (120, 160, 3)) -> Frame:
    return Frame(t_ns=t_ns, index=0, image=np.full(shape, level, np.uint8))


def test_preprocessing_is_plain_rgb_over_255(tmp_path: Path) -> None:
    network = OnnxDepth(SPEC, tiny_model(tmp_path / "tiny.onnx"), grid=(16, 12))
    image = np.zeros((120, 160, 3), np.uint8)
    image[:] = (10, 100, 200)  # BGR
    expected = ((np.array([200, 100, 10]) / 255 - MEAN) / STD).sum()
    reading = network.infer(Frame(t_ns=5, index=0, image=image), 9)
    assert (reading.t_ns, reading.ready_t_ns, reading.width_px, reading.height_px) == (5, 9, 160, 120)
    assert (reading.grid_columns, reading.grid_rows, len(reading.inverse_depth)) == (16, 12, 192)
    assert np.allclose(reading.inverse_depth, expected, atol=1e-4)
    grey = network.infer(frame(shape=(120, 160)))
    assert np.allclose(grey.inverse_depth, network.infer(frame()).inverse_depth)


def test_grid_keeps_left_right_top_bottom(tmp_path: Path) -> None:
    network = OnnxDepth(SPEC, tiny_model(tmp_path / "tiny.onnx"), grid=(16, 12))
    image = np.zeros((120, 160, 3), np.uint8)
    image[:60, 80:] = 255
    grid = np.array(network.infer(Frame(t_ns=0, index=0, image=image)).inverse_depth).reshape(12, 16)
    assert grid[2, 12] > grid[2, 3] + 1.0
    assert grid[2, 12] > grid[9, 12] + 1.0


def test_another_graph_contract_is_refused_at_load(tmp_path: Path) -> None:
    bare = tiny_model(tmp_path / "bare.onnx", normalises=False)
    assert not normalises_inside(bare, "0")
    assert first_operators(bare, "0", 3) == ("Relu", "Conv", "Squeeze")
    with pytest.raises(ModelError, match="begins with Relu then Conv"):
        OnnxDepth(SPEC, bare)
    whole = tiny_model(tmp_path / "tiny.onnx")
    outside = ModelSpec(name="t", file="t", width_px=64, height_px=64, normalisation="imagenet")
    with pytest.raises(ModelError, match="begins with Sub then Div"):
        OnnxDepth(outside, whole)
    with pytest.raises(ModelError, match="takes"):
        OnnxDepth(ModelSpec(name="t", file="t"), whole)
    with pytest.raises(ModelError, match="another network"):
        OnnxDepth(ModelSpec(name="t", file="t", output="depth", width_px=64, height_px=64), whole)


def test_missing_broken_and_wrong_files(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="models fetch midas-v21-small"):
        OnnxDepth(*find_model("midas-v21-small", tmp_path))
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"\x08\x08 this is no model")
    with pytest.raises(ModelError, match="cannot load"):
        OnnxDepth(SPEC, broken)
    with pytest.raises(ModelError, match="not an ONNX file"):
        first_operators(broken, "0")
    with pytest.raises(ModelError, match="SHA-256"):
        OnnxDepth(find_model("midas-v21-small", tmp_path)[0], broken)


def test_numbers_that_are_not_finite_are_an_error(tmp_path: Path) -> None:
    network = OnnxDepth(SPEC, tiny_model(tmp_path / "tiny.onnx", value=float("inf")))
    with pytest.raises(ModelError, match="not finite"):
        network.infer(frame())


def test_providers_end_with_the_cpu_and_unknown_ones_are_named() -> None:
    assert chosen_providers()[-1] == "CPUExecutionProvider"
    with pytest.raises(ModelError, match="NoSuchProvider"):
        chosen_providers(["NoSuchProvider"])


def test_manifest_sidecar_and_unknown_names(tmp_path: Path) -> None:
    specs = known_models(tmp_path)
    assert specs["midas-v21-small"].bytes == 66_764_249
    assert all(s.sha256 is not None and s.licence for s in specs.values())
    with pytest.raises(ModelError, match="did you mean midas-v21-small"):
        find_model("midas-small", tmp_path)
    mine = ModelSpec(name='a "b" \\c', file="mine.onnx", normalisation="none", kind="metric")
    (tmp_path / "mine.onnx").touch()
    write_sidecar(mine, tmp_path / "mine.onnx")
    assert known_models(tmp_path)[mine.name] == mine
    assert find_model(str(tmp_path / "mine.onnx"), tmp_path) == (mine, tmp_path / "mine.onnx")
    (tmp_path / "mine.onnx.toml").write_text("name = 3")
    with pytest.raises(ModelError, match="contract"):
        known_models(tmp_path)


def make_track(path: Path, n: int = 10) -> Path:
    grids = np.arange(n, dtype=np.float32)[:, None, None] + np.zeros((n, 6, 8), np.float32)
    write_track(path, [k * 100_000_000 for k in range(n)], grids, (1280, 720), "simulated")
    return path


def test_recorded_track_plays_on_source_time(tmp_path: Path) -> None:
    depth = RecordedDepth(make_track(tmp_path / "depth.npz"), rate_hz=5.0, latency_s=0.15)
    got = []
    for k in range(30):
        t_ns = 1_000_000_000 + k * 33_333_333  # the source need not start at zero
        got.extend((t_ns, r) for r in depth.ready(t_ns))
        depth.submit(frame(t_ns))
    assert len(got) == 5 or len(got) == 4
    for t_ns, reading in got:
        assert 150_000_000 <= t_ns - reading.t_ns < 190_000_000
        at = round((reading.t_ns - 1_000_000_000) / 1e8)
        assert reading.inverse_depth[0] == at
        assert (reading.width_px, reading.grid_columns, reading.model) == (1280, 8, "simulated")
    assert [r.t_ns for _, r in got] == sorted({r.t_ns for _, r in got})


def test_recorded_track_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputMissingError):
        RecordedDepth(tmp_path / "none.npz", rate_hz=4.0, latency_s=0.1)
    bad = tmp_path / "bad.npz"
    for content in (b"", b"PK\x03\x04 nonsense", b"text", make_track(tmp_path / "ok.npz").read_bytes()[:200]):
        bad.write_bytes(content)
        with pytest.raises(InputDataError):
            RecordedDepth(bad, rate_hz=4.0, latency_s=0.1)
    with pytest.raises(ValueError, match="finite"):
        write_track(tmp_path / "x.npz", [0], np.full((1, 6, 8), np.nan, np.float32), (8, 6), "")
    assert not (tmp_path / "x.npz").exists()


class Counting:
    """A network that says which frame it saw."""

    def __init__(self, gate: threading.Event | None = None, fails_at: int | None = None) -> None:
        self.seen: list[int] = []
        self._gate, self._fails_at = gate, fails_at

    def infer(self, frame: Frame, ready_t_ns: int | None = None) -> DepthReading:
        if self._gate is not None:
            assert self._gate.wait(5.0)
        self.seen.append(frame.t_ns)
        if self._fails_at == len(self.seen):
            raise ModelError("broken")
        return DepthReading(
            t_ns=frame.t_ns, ready_t_ns=ready_t_ns or frame.t_ns, width_px=1, height_px=1, grid_columns=1, grid_rows=1,
            inverse_depth=(1.0,),
        )  # fmt: skip


def test_paced_network_runs_at_its_rate() -> None:
    network = Counting()
    depth = PacedDepth(network, rate_hz=4.0, latency_s=0.2)
    for k in range(60):
        depth.submit(frame(k * 33_333_333))
    assert 7 <= len(network.seen) <= 10
    assert [r.ready_t_ns - r.t_ns for r in depth.ready(10**10)] == [200_000_000] * len(network.seen)
    assert list(depth.ready(10**10)) == []


def test_thread_takes_the_newest_frame_and_stops() -> None:
    gate, done = threading.Event(), threading.Event()
    network, got = Counting(gate), []

    def take(reading: DepthReading) -> None:
        got.append(reading)
        if reading.t_ns == 9_000_000_000:
            done.set()

    depth = ThreadedDepth(network, rate_hz=10.0, clock_ns=lambda: 10**12, on_reading=take, on_failure=pytest.fail)
    depth.start()
    for k in range(10):
        depth.submit(frame(k * 1_000_000_000))
    gate.set()
    assert done.wait(5.0)
    assert depth.stop()
    assert network.seen[-1] == 9_000_000_000
    assert len(network.seen) <= 2
    assert depth.skipped >= 8
    assert got[-1].ready_t_ns == 10**12


def test_thread_tells_of_a_failure_once_and_ends() -> None:
    failures, failed = [], threading.Event()

    def fail(error: BaseException) -> None:
        failures.append(error)
        failed.set()

    depth = ThreadedDepth(Counting(fails_at=1), rate_hz=10.0, clock_ns=lambda: 0, on_reading=lambda r: None, on_failure=fail)
    depth.start()
    depth.submit(frame())
    assert failed.wait(5.0)
    assert depth.stop()
    assert [type(f) for f in failures] == [ModelError]


def test_disabled_is_silent() -> None:
    depth = DisabledDepth()
    depth.submit(frame())
    assert list(depth.ready(10**12)) == []
