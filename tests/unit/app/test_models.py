from __future__ import annotations

import errno
import hashlib
import http.server
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tmde_edge.adapters.depth import manifest
from tmde_edge.adapters.depth.manifest import ModelSpec, known_models
from tmde_edge.app import models, quantize
from tmde_edge.app.models import fetch_model, list_models, verify_models
from tmde_edge.app.quantize import alike, quantize_model
from tmde_edge.errors import InputDataError, InputMissingError, ModelError
from tmde_edge.messages import Frame

CONTENT = bytes(np.random.default_rng(0).integers(0, 256, 1_500_000).astype(np.uint8))


@dataclass
class Site:
    """What the server does with the next requests."""

    url: str = ""
    content: bytes = CONTENT
    cut_after: int | None = None
    ranges: bool = True
    status: int | None = None
    requests: list[str | None] = field(default_factory=list)


@pytest.fixture
def site() -> Iterator[Site]:
    """An HTTP server on 127.0.0.1 that knows Range and can be told to misbehave."""
    state = Site()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = self.headers.get("Range")
            state.requests.append(asked)
            if state.status is not None:
                self.send_error(state.status)
                return
            start = int(asked[6:].rstrip("-")) if asked and state.ranges else 0
            if start >= len(state.content):
                self.send_error(416)
                return
            body = state.content[start:]
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(state.content) - 1}/{len(state.content)}")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body if state.cut_after is None else body[: state.cut_after])
            self.close_connection = True

        def log_message(self, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    state.url = f"http://127.0.0.1:{server.server_address[1]}/model.onnx"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield state
    server.shutdown()
    server.server_close()


@pytest.fixture(autouse=True)
def small_manifest(tmp_path_factory: pytest.TempPathFactory, site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path_factory.mktemp("manifest") / "manifest.toml"
    digest = hashlib.sha256(CONTENT).hexdigest()
    path.write_text(
        f'[[model]]\nname = "net"\nfile = "net.onnx"\nurl = "{site.url}"\nsha256 = "{digest}"\nbytes = {len(CONTENT)}\n'
    )
    monkeypatch.setattr(manifest, "PACKAGED", path)


def test_fetch_whole_then_find_it_there(tmp_path: Path, site: Site) -> None:
    seen: list[tuple[int, int]] = []
    folder = tmp_path / "state" / "models"
    got = fetch_model("net", folder, progress=lambda done, total: seen.append((done, total)))
    assert got.path.read_bytes() == CONTENT
    assert (got.bytes, got.resumed_from, got.already_there) == (len(CONTENT), 0, False)
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert [d for d, _ in seen] == sorted({d for d, _ in seen})
    assert os.listdir(folder) == ["net.onnx"]
    assert fetch_model("net", folder).already_there
    assert len(site.requests) == 1
    assert list_models(folder)[0].state == "present"


def test_cut_connection_goes_on_where_it_was(tmp_path: Path, site: Site) -> None:
    (tmp_path / "net.onnx").write_bytes(b"the old one")
    site.cut_after = 700_000
    with pytest.raises(ModelError, match="700000 bytes, which are kept"):
        fetch_model("net", tmp_path)
    assert (tmp_path / "net.onnx").read_bytes() == b"the old one"
    site.cut_after = None
    got = fetch_model("net", tmp_path)
    assert got.resumed_from == 700_000
    assert site.requests == [None, "bytes=700000-"]
    assert got.path.read_bytes() == CONTENT


@pytest.mark.parametrize("ranges", [True, False])
def test_a_piece_of_another_file_is_thrown_away(tmp_path: Path, site: Site, ranges: bool) -> None:
    site.ranges = ranges
    (tmp_path / "net.onnx.part").write_bytes(b"x" * 1000)
    assert fetch_model("net", tmp_path).path.read_bytes() == CONTENT
    (tmp_path / "net.onnx").unlink()
    (tmp_path / "net.onnx.part").write_bytes(b"x" * (len(CONTENT) + 5))
    assert fetch_model("net", tmp_path).path.read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (CONTENT[:-1] + b"?", "a file of 1500000 bytes with SHA-256"),
        (b"<!DOCTYPE html><p>log in first", "a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer"),
        (CONTENT + b"more", "sends more than"),
    ],
)
def test_wrong_content_is_refused_and_the_old_file_stays(tmp_path: Path, site: Site, content: bytes, says: str) -> None:
    (tmp_path / "net.onnx").write_bytes(b"the old one")
    site.content = content
    with pytest.raises(ModelError, match=says) as error:
        fetch_model("net", tmp_path)
    assert "\n" not in str(error.value)
    assert (tmp_path / "net.onnx").read_bytes() == b"the old one"
    part = tmp_path / "net.onnx.part"
    assert not part.exists() or part.stat().st_size == 0


def test_server_errors_and_no_network(tmp_path: Path, site: Site) -> None:
    site.status = 404
    with pytest.raises(ModelError, match="404"):
        fetch_model("net", tmp_path)
    with pytest.raises(ModelError, match=r"cannot be reached.*--from FILE"):
        fetch_model("net", tmp_path, url="http://127.0.0.1:9/model.onnx")
    with pytest.raises(ModelError, match="no usable answer"):
        fetch_model("net", tmp_path, url="nonsense")
    assert not (tmp_path / "net.onnx").exists()


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The refusal is put where the kernel gives it for delayed writes."""
    (tmp_path / "net.onnx").write_bytes(b"the old one")

    def full(fd: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ModelError, match=r"disk is full .* old file is untouched"):
        fetch_model("net", tmp_path)
    assert (tmp_path / "net.onnx").read_bytes() == b"the old one"


def test_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may write anywhere, so the refusal is put where the kernel would give it."""
    real_open = Path.open

    def refuse(self: Path, mode: str = "r", *args: object, **kwargs: object) -> object:
        if self.name.endswith(".part") and "a" in mode:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))
        return real_open(self, mode, *args, **kwargs)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(ModelError, match=r"cannot be written \(Read-only file system\)"):
        fetch_model("net", tmp_path)
    blocked = tmp_path / "file"
    blocked.touch()
    with pytest.raises(ModelError, match="cannot be written"):
        fetch_model("net", blocked / "models")


def test_from_file(tmp_path: Path, site: Site) -> None:
    source = tmp_path / "brought.onnx"
    source.write_bytes(CONTENT)
    assert fetch_model("net", tmp_path / "m", from_file=source).path.read_bytes() == CONTENT
    source.write_bytes(b"wrong")
    (tmp_path / "m" / "net.onnx").unlink()
    with pytest.raises(ModelError, match="5 bytes with SHA-256"):
        fetch_model("net", tmp_path / "m", from_file=source)
    with pytest.raises(InputMissingError):
        fetch_model("net", tmp_path / "m", from_file=tmp_path / "none")
    assert site.requests == []


def test_names(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="did you mean net"):
        fetch_model("nets", tmp_path)
    with pytest.raises(ModelError, match="nothing to fetch"):
        fetch_model(str(tmp_path / "mine" / "own.onnx"), tmp_path)


def test_two_fetches_at_once(tmp_path: Path) -> None:
    with (tmp_path / "net.onnx.part").open("ab") as other:
        models._lock(other, tmp_path / "net.onnx.part")
        with pytest.raises(ModelError, match="another fetch"):
            fetch_model("net", tmp_path)


def test_list_and_verify(tmp_path: Path) -> None:
    assert list_models(tmp_path)[0].state == "missing"
    assert verify_models(tmp_path) == []
    assert verify_models(tmp_path, ["net"])[0].state == "missing"
    (tmp_path / "net.onnx").write_bytes(b"short")
    assert list_models(tmp_path)[0].state == "broken"
    assert "SHA-256" in verify_models(tmp_path)[0].detail
    (tmp_path / "net.onnx").write_bytes(CONTENT)  # the right sum, yet no network
    assert "cannot load" in verify_models(tmp_path)[0].detail


def frames(n: int = 9) -> list[Frame]:
    """Smooth coloured pictures."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (n, 4, 4, 3)).astype(np.uint8)
    return [Frame(t_ns=i, index=i, image=np.kron(c, np.ones((20, 20, 1), np.uint8))) for i, c in enumerate(coarse)]


def convolution_model(path: Path) -> Path:
    """MiDaS's contract with three real convolutions, smooth weights: a network that quantizes well."""
    onnx = pytest.importorskip("onnx", reason="the package onnx (an extra) is not installed")
    h, n, t = onnx.helper, onnx.numpy_helper, onnx.TensorProto
    rng = np.random.default_rng(1)
    constants = {"mean": np.full((1, 3, 1, 1), 0.45, np.float32), "std": np.full((1, 3, 1, 1), 0.22, np.float32),
                 "axis": np.array([1], np.int64)}  # fmt: skip
    nodes = [h.make_node("Sub", ["0", "mean"], ["a"]), h.make_node("Div", ["a", "std"], ["x0"])]
    for i, (inputs, outputs) in enumerate(((3, 8), (8, 8), (8, 1))):
        constants[f"w{i}"] = (rng.uniform(0.0, 0.2, (outputs, inputs, 3, 3))).astype(np.float32)
        nodes.append(h.make_node("Conv", [f"x{i}", f"w{i}"], [f"y{i}"], kernel_shape=[3, 3], pads=[1, 1, 1, 1]))
        nodes.append(h.make_node("Relu", [f"y{i}"], [f"x{i + 1}"]))
    nodes.append(h.make_node("Squeeze", ["x3", "axis"], ["797"]))
    graph = h.make_graph(
        nodes, "net", [h.make_tensor_value_info("0", t.FLOAT, [1, 3, 64, 64])],
        [h.make_tensor_value_info("797", t.FLOAT, [1, 64, 64])], [n.from_array(v, k) for k, v in constants.items()],
    )  # fmt: skip
    onnx.save(h.make_model(graph, opset_imports=[h.make_opsetid("", 13)], ir_version=8), str(path))
    manifest.write_sidecar(ModelSpec(name="smooth", file=path.name, width_px=64, height_px=64), path)
    return path


def test_quantize_makes_a_model_that_agrees_and_is_known(tmp_path: Path) -> None:
    convolution_model(tmp_path / "smooth.onnx")
    steps: list[tuple[int, int]] = []
    made = quantize_model("smooth", tmp_path, frames(), progress=lambda i, n: steps.append((i, n)))
    assert steps == [(i, 6) for i in range(1, 7)]
    assert made.agreement.correlation > 0.99
    assert made.agreement.relative_difference < 0.05
    assert made.agreement.frames == 3
    spec = known_models(tmp_path)["smooth-int8"]
    assert spec == made.spec
    assert (spec.base, spec.sha256 is not None, spec.normalisation) == ("smooth", True, "inside")
    assert [s.state for s in verify_models(tmp_path, ["smooth-int8"])] == ["present"]
    assert sorted(os.listdir(tmp_path)) == sorted(
        ["smooth.onnx", "smooth.onnx.toml", "smooth.int8.onnx", "smooth.int8.onnx.toml"]
    )
    with pytest.raises(ModelError, match="quantized already"):
        quantize_model("smooth-int8", tmp_path, frames())


def test_a_bad_int8_model_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    convolution_model(tmp_path / "smooth.onnx")
    with pytest.raises(ModelError, match="refused"):
        quantize_model("smooth", tmp_path, frames(), min_correlation=1.1)
    assert sorted(os.listdir(tmp_path)) == ["smooth.onnx", "smooth.onnx.toml"]


def test_calibration_frames_from_folders(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    for f in frames(20):
        cv2.imwrite(str(tmp_path / f"{f.index:03}.png"), f.image)
    got = quantize.calibration_frames([str(tmp_path)], limit=10)
    assert [f.index for f in got] == list(range(0, 20, 2))
    with pytest.raises(InputDataError, match="3 frames"):
        quantize.calibration_frames([str(tmp_path)], limit=3)


def test_alike_ignores_scale_and_shift() -> None:
    a = np.random.default_rng(0).uniform(1, 2, (8, 8))
    assert alike(a, 3.0 * a - 1.0) == pytest.approx((1.0, 0.0), abs=1e-9)
    assert alike(a, -a)[0] == pytest.approx(-1.0)
    assert alike(a, np.zeros_like(a)) == (0.0, float("inf"))


def test_spec_is_plain_data() -> None:
    assert msgspec.structs.replace(ModelSpec(name="a", file="b"), base="c").base == "c"
