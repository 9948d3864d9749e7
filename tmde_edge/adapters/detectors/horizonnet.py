"""HorizonNet through ONNX Runtime: a frame -> the horizon's row and slope, for frames without lanes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime as ort

from tmde_edge.adapters.detectors.platenet import LOAD_ERRORS
from tmde_edge.errors import ModelError
from tmde_edge.messages import LaneSighting, Point
from tmde_edge.pose.edges import Image
from tmde_edge.pose.horizon import HEIGHT, OFFSETS_PX, SLOPES, WIDTH, horizon_of, network_picture, network_view

MODEL_PATH = Path(__file__).resolve().parents[2] / "models" / "horizonnet.onnx"


class HorizonNet:
    """The packaged horizon network, one thread. Raises ModelError when the file is missing or is no HorizonNet."""

    def __init__(self, model_path: Path | None = None) -> None:
        path = model_path or MODEL_PATH
        if not path.is_file():
            raise ModelError(f"{path}: the horizon network is missing; install the package again or set pose.network = false")
        ort.disable_telemetry_events()
        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except LOAD_ERRORS as error:
            raise ModelError(f"{path}: ONNX Runtime cannot load the horizon network: {error}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        wanted = "tensor(uint8)", [1, HEIGHT, WIDTH], [1, len(OFFSETS_PX) + len(SLOPES)]
        if len(inputs) != 1 or (inputs[0].type, inputs[0].shape, outputs[0].shape) != wanted:
            raise ModelError(f"{path}: not a HorizonNet: inputs {[(i.type, i.shape) for i in inputs]}, output {outputs[0].shape}")
        self._input = inputs[0].name

    def see(self, image: Image, fx_px: float | None, expected_px: Point | None) -> LaneSighting | None:
        """The horizon of a grey or BGR image; None where the network is not sure. fx_px is that of this image."""
        view = network_view(image.shape[1], image.shape[0], fx_px, expected_px)
        logits = self._session.run(None, {self._input: network_picture(image, view)[None]})[0][0]
        return horizon_of(np.asarray(logits, np.float64), view, expected_px, image.shape[1])
