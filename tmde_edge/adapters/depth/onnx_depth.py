"""A monocular depth network through ONNX Runtime: an image -> relative inverse depth on a coarse grid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
import onnxruntime.capi.onnxruntime_pybind11_state as ort_errors
from numpy.typing import NDArray

from tmde_edge.adapters.depth.manifest import ModelSpec, sha256_of
from tmde_edge.adapters.depth.onnx_graph import first_operators, normalises_inside
from tmde_edge.errors import ModelError
from tmde_edge.messages import DepthReading, Frame

PREFERRED = (  # best first; what the installed ONNX Runtime does not offer is left out
    "TensorrtExecutionProvider", "CUDAExecutionProvider", "ACLExecutionProvider", "XnnpackExecutionProvider",
    "CPUExecutionProvider",
)  # fmt: skip
IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], dtype=np.float32)
IMAGENET_STD = np.array([0.229, 0.224, 0.225], dtype=np.float32)
LOAD_ERRORS = (  # what ONNX Runtime raises for a file that is no model or one it cannot run; they share no base
    ort_errors.Fail, ort_errors.InvalidArgument, ort_errors.InvalidGraph, ort_errors.InvalidProtobuf, ort_errors.NoModel,
    ort_errors.NotImplemented, ort_errors.RuntimeException, ort_errors.EPFail, OSError, RuntimeError, ValueError,
)  # fmt: skip

Output = NDArray[np.float32]


def chosen_providers(wanted: Sequence[str] = ()) -> list[str]:
    """Execution providers of this installation, best first, always ending with the CPU. Raises ModelError."""
    offered = ort.get_available_providers()
    missing = [p for p in wanted if p not in offered]
    if missing:
        raise ModelError(f"depth.providers: {missing[0]} is not offered by this ONNX Runtime; it has {', '.join(offered)}")
    chosen = [p for p in (wanted or PREFERRED) if p in offered]
    return chosen if "CPUExecutionProvider" in chosen else [*chosen, "CPUExecutionProvider"]


class OnnxDepth:
    """A loaded depth network; `infer` is not for two threads at a time."""

    def __init__(
        self,
        spec: ModelSpec,
        path: Path,
        *,
        threads: int = 1,
        grid: tuple[int, int] = (64, 48),
        providers: Sequence[str] = (),
        check_sum: bool = True,
    ) -> None:
        """`grid` is (columns, rows). Raises ModelError: missing, another checksum, another graph contract, unloadable."""
        if not path.is_file():
            how = f"run `tmde-edge models fetch {spec.name}`" if spec.url else "check depth.model"
            raise ModelError(f"{path}: the depth network {spec.name} is not there; {how}, or set depth.kind = \"none\"")
        if check_sum and spec.sha256 is not None and (found := sha256_of(path)) != spec.sha256:
            raise ModelError(
                f"{path}: SHA-256 is {found}, {spec.name} has {spec.sha256}; run `tmde-edge models fetch {spec.name}`"
            )
        self.spec, self.path, self._grid = spec, path, grid
        ort.disable_telemetry_events()  # before the first session: nothing leaves this machine unasked
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(str(path), options, providers=chosen_providers(providers))
        except LOAD_ERRORS as error:
            first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise ModelError(f"{path}: ONNX Runtime cannot load it: {first}; fetch it again") from None
        self._check_contract()

    @property
    def providers(self) -> tuple[str, ...]:
        """The execution providers in use, best first."""
        return tuple(self._session.get_providers())

    def fed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The input tensor [1, 3, h, w] of a BGR or grey image."""
        s = self.spec
        rgb = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)
        shrinks = rgb.shape[1] > s.width_px and rgb.shape[0] > s.height_px
        sized = cv2.resize(rgb, (s.width_px, s.height_px), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        values = np.asarray(sized, dtype=np.float32) / np.float32(255.0)
        if s.normalisation == "imagenet":
            values = (values - IMAGENET_MEAN) / IMAGENET_STD
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None])

    def raw(self, image: NDArray[np.uint8]) -> Output:
        """The network's whole output (rows, columns) for a BGR or grey image. Raises ModelError on a failed run."""
        s, tensor = self.spec, self.fed(image)
        try:
            out = np.asarray(self._session.run([s.output], {s.input: tensor})[0], dtype=np.float32)
        except LOAD_ERRORS as error:
            raise ModelError(f"{self.path}: the depth network failed: {str(error).strip().splitlines()[0]}") from None
        out = out.reshape(out.shape[-2:])
        if not np.isfinite(out).all():
            raise ModelError(f"{self.path}: the depth network gave numbers that are not finite; fetch or quantize it again")
        return out

    def infer(self, frame: Frame, ready_t_ns: int | None = None) -> DepthReading:
        """Relative inverse depth of a frame, reduced to the grid. Raises ModelError."""
        out = self.raw(frame.image)
        if self.spec.kind == "metric":
            out = 1.0 / np.maximum(out, np.float32(0.1))
        grid = np.asarray(cv2.resize(out, self._grid, interpolation=cv2.INTER_AREA), dtype=np.float64)
        return DepthReading(
            t_ns=frame.t_ns,
            ready_t_ns=frame.t_ns if ready_t_ns is None else ready_t_ns,
            width_px=int(frame.image.shape[1]),
            height_px=int(frame.image.shape[0]),
            grid_columns=self._grid[0],
            grid_rows=self._grid[1],
            inverse_depth=tuple(float(v) for v in grid.ravel()),
            model=self.spec.name,
        )

    def _check_contract(self) -> None:
        """Input and output names and sizes, and where normalisation happens, as the manifest says."""
        s = self.spec
        inputs = {i.name: i for i in self._session.get_inputs()}
        outputs = {o.name: o for o in self._session.get_outputs()}
        if s.input not in inputs or s.output not in outputs:
            raise ModelError(
                f"{self.path}: has inputs {', '.join(inputs)} and outputs {', '.join(outputs)}; {s.name} has {s.input} and "
                f"{s.output}; this is another network"
            )
        shape, kind = inputs[s.input].shape, inputs[s.input].type
        wanted = [1, 3, s.height_px, s.width_px]
        fits = len(shape) == 4 and all(not isinstance(a, int) or a == b for a, b in zip(shape, wanted, strict=True))
        if not fits or kind != "tensor(float)":
            raise ModelError(f"{self.path}: input {s.input} is {kind} {shape}; {s.name} takes tensor(float) {wanted}")
        inside = normalises_inside(self.path, s.input)
        if inside != (s.normalisation == "inside"):
            found = " then ".join(first_operators(self.path, s.input)) or "nothing"
            where = "inside" if s.normalisation == "inside" else "outside"
            raise ModelError(
                f"{self.path}: its graph begins with {found}, but {s.name} normalises {where} the graph; "
                "this is another export: feeding it would normalise twice or not at all"
            )
