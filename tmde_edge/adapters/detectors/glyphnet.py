"""GlyphNet on onnxruntime: plate-ness, corners and characters of plate candidates, all in one batch."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi.onnxruntime_pybind11_state import (
    Fail,
    InvalidArgument,
    InvalidGraph,
    InvalidProtobuf,
    NoSuchFile,
    RuntimeException,
)
from onnxruntime.capi.onnxruntime_pybind11_state import (
    NotImplemented as NotImplementedByRuntime,
)

from tmde_edge.errors import ModelError
from tmde_edge.vision.segment.glyph_crop import CANVAS_H_PX, CANVAS_W_PX, canvas_from_source, cut_canvas, normalise, spans_area
from tmde_edge.vision.segment.glyph_decode import GlyphReading, decode, not_a_plate

MODEL_FILE = Path(__file__).resolve().parents[2] / "models" / "glyphnet.onnx"
_LOAD_ERRORS = (  # onnxruntime's exceptions share no base but Exception
    Fail, InvalidArgument, InvalidGraph, InvalidProtobuf, NoSuchFile, NotImplementedByRuntime, RuntimeException,
)
_OUTPUTS = ["glyphs", "corners", "tail"]


class GlyphNet:
    """Loads the packaged network. Raises ModelError when the file is missing, broken or of another contract."""

    def __init__(self, threads: int = 1, model: Path | None = None) -> None:
        file = model or MODEL_FILE
        if not file.is_file():
            raise ModelError(f"{file}: the character network is missing; reinstall tmde-edge")
        onnxruntime.disable_telemetry_events()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        except _LOAD_ERRORS as error:
            raise ModelError(f"{file}: not a network that onnxruntime can load ({error}); reinstall tmde-edge") from error
        inputs = self._session.get_inputs()
        names = [output.name for output in self._session.get_outputs()]
        if len(inputs) != 1 or list(inputs[0].shape)[1:] != [1, CANVAS_H_PX, CANVAS_W_PX] or names != _OUTPUTS:
            raise ModelError(f"{file}: inputs {[i.shape for i in inputs]}, outputs {names} are not GlyphNet's")
        self._input = inputs[0].name

    def read(self, image: NDArray[np.uint8], corners_px: NDArray[np.float64]) -> list[GlyphReading]:
        """One reading per candidate (n, 4, 2) in order, from a grey or BGR source image.

        Corners that span no area are no plate (platehood 0). Raises ValueError for corners that are not finite,
        ModelError where the network's output is not finite.
        """
        if not np.isfinite(corners_px).all():
            raise ValueError("candidate corners are not finite")
        readings = [not_a_plate(corners) for corners in corners_px]
        indices, maps, canvases = [], [], []
        for k, corners in enumerate(corners_px):
            if spans_area(corners):
                indices.append(k)
                maps.append(canvas_from_source(corners))
                canvases.append(cut_canvas(*_grey_part(image, corners, maps[-1])))
        if not indices:
            return readings
        outputs = self._session.run(_OUTPUTS, {self._input: normalise(np.stack(canvases))})
        try:
            for k, matrix, glyphs, corners, tail in zip(indices, maps, *outputs, strict=True):
                readings[k] = decode(glyphs, corners, tail, matrix)
        except ValueError as error:
            raise ModelError(f"{MODEL_FILE.name}: {error}") from error
        return readings


def _grey_part(
    image: NDArray[np.uint8], corners_px: NDArray[np.float64], matrix: NDArray[np.float64]
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The grey region that a crop can see, and the map from that region: only this much is converted."""
    if image.ndim == 2:
        return image, matrix
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    reach = float(np.max(high - low)) * 0.9 + 8
    height, width = image.shape[:2]
    x0, y0 = (int(np.clip(v, 0, size - 1)) for v, size in zip(np.floor(low - reach), (width, height), strict=True))
    x1, y1 = (int(np.clip(v, 1, size)) for v, size in zip(np.ceil(high + reach), (width, height), strict=True))
    part = image[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)]
    grey = cv2.cvtColor(part, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
    moved = matrix.copy()
    moved[:, 2] += matrix[:, :2] @ np.array([x0, y0], np.float64)
    return grey, moved
