"""A plate detector of the user's own: any ONNX file of a known family, through the `PlateFinder` interface."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tmde_edge.adapters.detectors.platenet import LOAD_ERRORS
from tmde_edge.errors import ModelError
from tmde_edge.vision.detect.onnx_decode import decode_detr, decode_ssd_corners, decode_yolo, decode_yolo_corners
from tmde_edge.vision.protocols import Image, PlateCandidate
from tmde_edge.vision.settings import DetectorSettings

PAD = 114  # grey of letterboxes, what YOLO is trained with
MULTIPLE_PX = 32
OPEN_SIZE_PX = 640  # longer side where neither graph nor configuration says


def detector_file(settings: DetectorSettings) -> Path:
    """The file of `detector.onnx_path`. Raises ModelError where there is none."""
    path = Path(settings.onnx_path)
    if not settings.onnx_path or not path.is_file():
        raise ModelError(f"detector.onnx_path = {settings.onnx_path!r}: no such file; name the ONNX file of your detector")
    return path


class OnnxFinder:
    """Finds plates with `detector.onnx_path`. Raises ModelError for a file that is missing, broken or of another family."""

    def __init__(self, settings: DetectorSettings, threads: int = 1) -> None:
        self._settings = settings
        path = detector_file(settings)
        ort.disable_telemetry_events()
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except LOAD_ERRORS as error:
            raise ModelError(f"{path}: ONNX Runtime cannot load the detector: {error}") from error
        inputs = self._session.get_inputs()
        fits = len(inputs) == 1 and len(inputs[0].shape) == 4 and inputs[0].type in ("tensor(float)", "tensor(uint8)")
        if not fits or any(isinstance(n, int) and n not in (-1, m) for n, m in zip(inputs[0].shape, (1, 3), strict=False)):
            shapes = [(i.name, i.type, i.shape) for i in inputs]
            raise ModelError(f"{path}: inputs {shapes}; a detector takes one image (1, 3, height, width)")
        self._path = path
        self._input = inputs[0].name
        self._float = inputs[0].type == "tensor(float)"
        self._fixed = tuple(n if isinstance(n, int) and n > 0 else 0 for n in inputs[0].shape[2:])

    def find(self, image: Image, *, region_px: tuple[int, int, int, int] | None = None) -> list[PlateCandidate]:
        """Candidates in source pixels. Raises ModelError for a failed run and for outputs of another family."""
        x0, y0, x1, y1 = region_px or (0, 0, image.shape[1], image.shape[0])
        crop = image[y0:y1, x0:x1]
        width, height = self._input_size(crop.shape[1], crop.shape[0])
        stretch = self._settings.onnx_format == "detr"
        canvas, scale_x, scale_y = place(crop, width, height, stretch=stretch)
        names = [o.name for o in self._session.get_outputs()]
        try:
            outputs = dict(zip(names, self._session.run(names, {self._input: self._feed(canvas)}), strict=True))
        except LOAD_ERRORS as error:
            raise ModelError(
                f"{self._path}: the detector failed on a picture of {width}x{height} px: {str(error).strip().splitlines()[0]}; "
                "check detector.onnx_width_px and detector.onnx_height_px"
            ) from error
        try:
            found = self._decode(outputs, width, height)
        except ValueError as error:
            raise ModelError(f"{self._path}: {error}; is it of detector.onnx_format = {self._settings.onnx_format!r}?") from error
        # pixel centres: source + 0.5 = (input + 0.5) / scale
        return [
            PlateCandidate(
                corners_px=(c.corners_px + 0.5) / np.array([scale_x, scale_y]) - 0.5 + np.array([x0, y0]), score=c.score
            )
            for c in found
        ]

    def _input_size(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Of the network: the graph's, the configured one, or the image's own shape at OPEN_SIZE_PX."""
        height, width = self._fixed[0] or self._settings.onnx_height_px, self._fixed[1] or self._settings.onnx_width_px
        scale = min(1.0, OPEN_SIZE_PX / max(width_px, height_px))
        if width or height:
            scale = width / width_px if width else height / height_px
        wide, tall = width or width_px * scale, height or height_px * scale
        rounded = [v if v in self._fixed else max(1, round(v / MULTIPLE_PX)) * MULTIPLE_PX for v in (wide, tall)]
        return int(rounded[0]), int(rounded[1])

    def _feed(self, canvas: Image) -> NDArray[np.float32] | NDArray[np.uint8]:
        """(1, 3, h, w) with the configured order of channels, mean and factor."""
        s = self._settings
        ssd = s.onnx_format == "ssd-corners"
        rgb = s.onnx_rgb if s.onnx_rgb is not None else not ssd
        ordered = canvas[:, :, ::-1] if rgb else canvas
        planes = np.ascontiguousarray(ordered.transpose(2, 0, 1)[None])
        if not self._float:
            return planes
        mean = s.onnx_mean or ([104.0, 117.0, 123.0] if ssd else [0.0, 0.0, 0.0])
        factor = s.onnx_scale if s.onnx_scale is not None else (1.0 if ssd else 1 / 255)
        centred = planes.astype(np.float32) - np.asarray(mean, np.float32)[None, :, None, None]
        return np.asarray(centred * np.float32(factor), dtype=np.float32)

    def _decode(self, outputs: dict[str, NDArray[np.float32]], width: int, height: int) -> list[PlateCandidate]:
        s = self._settings
        score_min = min(s.score_min, s.permissive_score_min)
        if s.onnx_format == "ssd-corners":
            return decode_ssd_corners(outputs, width, height, s.onnx_sizes_px, score_min)
        if s.onnx_format == "detr":
            return decode_detr(outputs, width, height, s.onnx_class, score_min, no_object=s.onnx_no_object)
        first = next(iter(outputs.values()))
        if s.onnx_format == "yolo-corners":
            return decode_yolo_corners(first, s.onnx_classes, s.onnx_class, score_min)
        return decode_yolo(first, s.onnx_class, score_min)


def place(crop: Image, width_px: int, height_px: int, *, stretch: bool) -> tuple[Image, float, float]:
    """The crop as BGR on a canvas of the network's size, at the top left, and its scales (network px per source px)."""
    h, w = crop.shape[:2]
    sx, sy = width_px / w, height_px / h
    if not stretch:
        sx = sy = min(sx, sy)
    inner_w, inner_h = min(width_px, max(1, round(w * sx))), min(height_px, max(1, round(h * sy)))
    mode = cv2.INTER_AREA if inner_w < w else cv2.INTER_LINEAR
    small = np.asarray(cv2.resize(crop, (inner_w, inner_h), interpolation=mode), dtype=np.uint8)
    canvas = np.full((height_px, width_px, 3), PAD, np.uint8)
    canvas[:inner_h, :inner_w] = small if small.ndim == 3 else small[:, :, None]
    return canvas, inner_w / w, inner_h / h
