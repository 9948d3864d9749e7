"""PlateNet through ONNX Runtime: an image or a region of it -> plate candidates in source pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
import onnxruntime.capi.onnxruntime_pybind11_state as ort_errors
from numpy.typing import NDArray

from tmde_edge.errors import ModelError
from tmde_edge.vision.detect.platenet_decode import CHANNELS, STRIDES_PX, Maps, decode
from tmde_edge.vision.protocols import Image, PlateCandidate

MODEL_PATH = Path(__file__).resolve().parents[2] / "models" / "platenet.onnx"
MULTIPLE_PX = 32  # the network halves the picture five times
SCORE_MIN = 0.25  # candidates only: the reader behind it verifies them

LOAD_ERRORS = (  # what InferenceSession raises for a file that is no model, or one this runtime cannot run; they share no base
    ort_errors.Fail, ort_errors.InvalidArgument, ort_errors.InvalidGraph, ort_errors.InvalidProtobuf, ort_errors.NoModel,
    ort_errors.NotImplemented, ort_errors.RuntimeException, OSError, RuntimeError,
)


class PlateNet:
    """The packaged plate network. `threads` bounds its pool. Raises ModelError when the file is missing or is no PlateNet."""

    def __init__(self, threads: int = 1, model_path: Path | None = None) -> None:
        path = self._path = model_path or MODEL_PATH
        if not path.is_file():
            raise ModelError(f"{path}: the plate network is missing; install the package again")
        ort.disable_telemetry_events()
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except LOAD_ERRORS as error:
            raise ModelError(f"{path}: ONNX Runtime cannot load the plate network: {error}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shapes = [o.shape for o in outputs]
        if len(inputs) != 1 or inputs[0].type != "tensor(uint8)" or len(outputs) != len(STRIDES_PX) or any(
            len(s) != 4 or s[1] != CHANNELS for s in shapes
        ):
            raise ModelError(f"{path}: not a PlateNet: inputs {[(i.name, i.type, i.shape) for i in inputs]}, outputs {shapes}")
        self._input = inputs[0].name

    def detect(
        self,
        image: Image,
        *,
        region_px: tuple[int, int, int, int] | None = None,
        scale: float = 1.0,
        score_min: float = SCORE_MIN,
        max_candidates: int = 32,
    ) -> list[PlateCandidate]:
        """Candidates in source pixels, best first; an empty list means: no plate there.

        image: BGR or grey. region_px: (x0, y0, x1, y1), half open, inside the image. scale: network pixels per source
        pixel; plates 8..330 px wide in network pixels are found. Raises ValueError for an empty region, a bad scale or a
        score_min outside 0..1, ModelError where the network's output is not finite.
        """
        x0, y0, x1, y1 = region_px or (0, 0, image.shape[1], image.shape[0])
        if not (0 <= x0 < x1 <= image.shape[1] and 0 <= y0 < y1 <= image.shape[0]):
            raise ValueError(f"region {region_px} is empty or leaves the image of {image.shape[1]}x{image.shape[0]} px")
        if not 0.0 < score_min < 1.0:
            raise ValueError(f"score_min {score_min}: must lie between 0 and 1")
        if not 0.0 < scale <= 8.0:
            raise ValueError(f"scale {scale}: must lie in 0..8")
        fed, scale_xy = prepare(image[y0:y1, x0:x1], scale)
        maps: list[Maps] = self._session.run(None, {self._input: fed})
        try:
            return decode(
                tuple(m[0] for m in maps), score_min=score_min, scale_xy=scale_xy, origin_px=(float(x0), float(y0)),
                max_candidates=max_candidates,
            )
        except ValueError as error:
            raise ModelError(f"{self._path}: {error}; install the package again") from error


def prepare(crop: Image, scale: float) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """The crop scaled, as BGR, padded with black at the right and bottom: (1, H, W, 3), and the true scales in x and y."""
    h, w = crop.shape[:2]
    sw, sh = max(1, round(w * scale)), max(1, round(h * scale))
    if (sw, sh) != (w, h):
        crop = np.asarray(cv2.resize(crop, (sw, sh), interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR), np.uint8)
    fed = np.zeros((1, -(-sh // MULTIPLE_PX) * MULTIPLE_PX, -(-sw // MULTIPLE_PX) * MULTIPLE_PX, 3), np.uint8)
    fed[0, :sh, :sw] = crop if crop.ndim == 3 else crop[..., None]
    return fed, (sw / w, sh / h)
