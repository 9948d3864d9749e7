"""`models quantize`: an int8 model from a float one, calibrated on the user's own pictures, refused where it is bad.

Static quantization, QDQ nodes, weights per channel; mean and deviation inside the graph stay float. Needs the package `onnx`
on the machine that quantizes (the extra "quantize"); the result runs without it.
"""

from __future__ import annotations

import logging
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tmde_edge.adapters.cameras.sources import open_source
from tmde_edge.adapters.depth.manifest import ModelSpec, find_model, sha256_of, write_sidecar
from tmde_edge.adapters.depth.onnx_depth import OnnxDepth
from tmde_edge.errors import InputDataError, ModelError
from tmde_edge.messages import Frame

MAX_FRAMES = 64  # used in all: two thirds to calibrate, the rest to judge
MIN_FRAMES = 6
MIN_CORRELATION = 0.97  # int8 against float on the frames held out
MAX_RELATIVE_DIFFERENCE = 0.10  # median
QUANTIZED = ("Conv", "ConvTranspose", "Gemm", "MatMul", "Add", "Clip", "Relu", "Resize", "Concat", "MaxPool")


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """How alike two networks are on the same frames."""

    correlation: float
    relative_difference: float  # median |int8 - float| over median |float|, median over the frames
    float_ms: float
    int8_ms: float
    frames: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantized:
    """What was made."""

    spec: ModelSpec
    path: Path
    bytes: int
    agreement: Agreement


def calibration_frames(sources: Sequence[str], limit: int = MAX_FRAMES) -> list[Frame]:
    """Frames spread evenly over folders of images and recordings. Raises InputMissingError, InputDataError."""
    frames: list[Frame] = []
    share = max(1, limit // max(1, len(sources)))
    for spec in sources:
        source = open_source(spec)
        step = max(1, (source.frame_count or 10 * share) // share)
        taken = [item for k, item in enumerate(source) if k % step == 0 and isinstance(item, Frame)]
        frames.extend(taken[:share])
    if len(frames) < MIN_FRAMES:
        raise InputDataError(
            f"{', '.join(sources)}: {len(frames)} frames; quantizing needs {MIN_FRAMES} or more of your own roads, "
            f"better {MAX_FRAMES}"
        )
    return frames


def quantize_model(
    name: str,
    folder: Path,
    frames: Sequence[Frame],
    *,
    progress: Callable[[int, int], None] | None = None,
    min_correlation: float = MIN_CORRELATION,
    max_relative_difference: float = MAX_RELATIVE_DIFFERENCE,
) -> Quantized:
    """Makes NAME-int8 in the folder, with its contract beside it. Raises ModelError: no `onnx`, no model, a bad result."""
    spec, path = find_model(name, folder)
    if spec.base:
        raise ModelError(f"model {name}: is quantized already; name the float model, {spec.base}")
    exact = OnnxDepth(spec, path)
    calibrate = [f for i, f in enumerate(frames) if i % 3 != 2]
    judge = [f for i, f in enumerate(frames) if i % 3 == 2]
    made = msgspec.structs.replace(
        spec, name=f"{spec.name}-int8", file=f"{path.stem}.int8.onnx", url="", sha256=None, bytes=0, base=spec.name,
        note=f"int8 of {spec.name}, calibrated on {len(calibrate)} frames",
    )  # fmt: skip
    target = path.with_name(made.file)
    handle, temporary = tempfile.mkstemp(prefix=f".{made.file}.", suffix=".part", dir=target.parent)
    os.close(handle)
    part = Path(temporary)
    try:
        _quantize(path, part, exact, calibrate, progress)
        agreement = compare(exact, OnnxDepth(made, part), judge)
        if not (agreement.correlation >= min_correlation and agreement.relative_difference <= max_relative_difference):
            raise ModelError(
                f"{made.name}: on {agreement.frames} held-out frames its correlation with {spec.name} is "
                f"{agreement.correlation:.3f} (at least {min_correlation}) and it differs by {agreement.relative_difference:.1%} "
                f"(at most {max_relative_difference:.0%}); refused: calibrate on more, and more varied, frames"
            )
        made = msgspec.structs.replace(made, sha256=sha256_of(part), bytes=part.stat().st_size)
        part.chmod(0o644)
        os.replace(part, target)
        write_sidecar(made, target)
    except OSError as e:
        raise ModelError(f"{target.parent}: cannot be written ({e.strerror or e})") from None
    finally:
        part.unlink(missing_ok=True)
    return Quantized(spec=made, path=target, bytes=made.bytes, agreement=agreement)


def compare(exact: OnnxDepth, small: OnnxDepth, frames: Sequence[Frame]) -> Agreement:
    """Runs both on the frames. The difference counts after the best scale and shift, which relative depth leaves open."""
    correlations: list[float] = []
    differences: list[float] = []
    float_ms: list[float] = []
    int8_ms: list[float] = []
    for frame in frames:
        a, float_s = _timed(exact, frame)
        b, int8_s = _timed(small, frame)
        float_ms.append(float_s * 1000.0)
        int8_ms.append(int8_s * 1000.0)
        correlation, difference = alike(a, b)
        correlations.append(correlation)
        differences.append(difference)
    return Agreement(
        correlation=float(np.median(correlations)),
        relative_difference=float(np.median(differences)),
        float_ms=float(np.median(float_ms)),
        int8_ms=float(np.median(int8_ms)),
        frames=len(frames),
    )


def alike(a: NDArray[Any], b: NDArray[Any]) -> tuple[float, float]:
    """Correlation of two maps, and the median of |b' - a| / median |a| after b was scaled and shifted onto a."""
    x, y = np.asarray(b, dtype=np.float64).ravel(), np.asarray(a, dtype=np.float64).ravel()
    dx, dy = x - x.mean(), y - y.mean()
    power = float(dx @ dx)
    if power <= 0.0 or float(dy @ dy) <= 0.0:
        return 0.0, float("inf")
    gain = float(dx @ dy) / power
    size = max(float(np.median(np.abs(y))), 1e-12)
    correlation = float(dx @ dy) / float(np.sqrt(power * float(dy @ dy)))
    return correlation, float(np.median(np.abs(gain * dx - dy))) / size


def _timed(network: OnnxDepth, frame: Frame) -> tuple[NDArray[np.float32], float]:
    started_s = time.perf_counter()
    out = network.raw(frame.image)
    return out, time.perf_counter() - started_s


def _quantize(
    source: Path, target: Path, network: OnnxDepth, frames: Sequence[Frame], progress: Callable[[int, int], None] | None
) -> None:
    try:
        import onnx
        from onnxruntime import quantization as q
    except ImportError:
        raise ModelError('quantizing needs the package onnx: pip install "tmde-edge[quantize]", on any machine') from None

    class Reader(q.CalibrationDataReader):  # type: ignore[misc]
        """Feeds the frames as the network will be fed."""

        def __init__(self) -> None:
            self.at = 0

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            if self.at >= len(frames):
                return None
            self.at += 1
            if progress is not None:
                progress(self.at, len(frames))
            return {network.spec.input: network.fed(frames[self.at - 1].image)}

        def rewind(self) -> None:
            self.at = 0

    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)  # the tool's advice on pre-processing is not for the user
    try:
        model = onnx.load(str(source))
        head = _normalising_nodes(model, network.spec.input)
        with tempfile.TemporaryDirectory(prefix="tmde-quantize-") as scratch:
            named = Path(scratch) / "named.onnx"
            onnx.save(model, str(named))
            q.quantize_static(
                str(named), str(target), Reader(), quant_format=q.QuantFormat.QDQ, per_channel=True,
                activation_type=q.QuantType.QUInt8, weight_type=q.QuantType.QInt8, nodes_to_exclude=head,
                op_types_to_quantize=list(QUANTIZED),
            )  # fmt: skip
    except (ValueError, RuntimeError, KeyError, AttributeError, onnx.checker.ValidationError) as e:
        raise ModelError(f"{source}: ONNX Runtime cannot quantize it: {str(e).strip().splitlines()[0]}") from None
    finally:
        root.setLevel(level)


def _normalising_nodes(model: Any, input_name: str) -> list[str]:
    """Names the nodes (in place) and returns those that normalise the input: they stay float."""
    for i, node in enumerate(model.graph.node):
        if not node.name:
            node.name = f"{node.op_type}_{i}"
    names, at = [], input_name
    for node in model.graph.node:
        if at in node.input and node.op_type in ("Sub", "Div", "Add", "Mul"):
            names.append(node.name)
            at = node.output[0]
    return names
