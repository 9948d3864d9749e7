"""Outputs of common detector families to plate candidates, in pixels of the network's input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.detect.contour import without_doubles
from tmde_edge.vision.protocols import PlateCandidate
from tmde_edge.vision.rectify import is_convex, order_corners

Array = NDArray[np.float64]
SSD_STEPS_PX = (8, 16, 32)
SSD_VARIANCE = 0.1, 0.2
KEEP = 300  # candidates looked at, the best


def decode_yolo(output: NDArray[np.float32], plate_class: int, score_min: float) -> list[PlateCandidate]:
    """YOLO boxes: (1, 4 + classes, n) centre and size (v8 on), (1, n, 5 + classes) with objectness (v5, v7), or (1, n, 6)
    corners, score and class (end to end, n at most 300).

    Raises ValueError for another shape.
    """
    table = _table(output)
    n, columns = table.shape
    if columns == 6 and n <= KEEP and not _has_objectness(output):
        boxes, scores = table[:, :4], np.where(table[:, 5].round() == plate_class, table[:, 4], 0.0)
    elif _has_objectness(output):
        boxes, scores = _from_centres(table[:, :4]), table[:, 4] * _column(table, 5 + plate_class)
    else:
        boxes, scores = _from_centres(table[:, :4]), _column(table, 4 + plate_class)
    return _candidates(_corners(boxes), scores, score_min)


def decode_yolo_corners(output: NDArray[np.float32], classes: int, plate_class: int, score_min: float) -> list[PlateCandidate]:
    """YOLO pose with four key points: (1, 4 + classes + 4 k, n), k = 2 (x, y) or 3 (x, y, visible)."""
    table = _table(output)
    points = table.shape[1] - 4 - classes
    if points not in (8, 12):
        raise ValueError(f"output {output.shape} has {points} key point numbers after {classes} classes, not 8 or 12")
    corners = table[:, 4 + classes :].reshape(len(table), 4, points // 4)[:, :, :2]
    return _candidates(corners, _column(table[:, : 4 + classes], 4 + plate_class), score_min)


def decode_ssd_corners(
    outputs: Mapping[str, NDArray[np.float32]], width_px: int, height_px: int, sizes_px: Sequence[Sequence[float]],
    score_min: float,
) -> list[PlateCandidate]:
    """SSD with landmarks: loc (1, n, 4), conf (1, n, 2), landms (1, n, 8) against a grid of square priors.

    Liu et al., SSD (2016), section 2.2; landmarks as in Deng et al., RetinaFace (2019). Raises ValueError for other outputs.
    """
    by_width = {v.shape[-1]: np.asarray(v[0], np.float64) for v in outputs.values() if v.ndim == 3}
    if not {2, 4, 8} <= by_width.keys():
        raise ValueError(f"outputs {[v.shape for v in outputs.values()]} are not boxes, scores and four corners")
    priors = ssd_priors(width_px, height_px, sizes_px)
    if len(priors) != len(by_width[8]):
        raise ValueError(f"{len(by_width[8])} predictions for {len(priors)} priors; check detector.onnx_sizes_px")
    corners = priors[:, None, :2] + by_width[8].reshape(-1, 4, 2) * SSD_VARIANCE[0] * priors[:, None, 2:]
    return _candidates(corners, by_width[2][:, 1], score_min)


def ssd_priors(width_px: int, height_px: int, sizes_px: Sequence[Sequence[float]]) -> Array:
    """(n, 4) centre x, y and side twice, in pixels: for every cell of every stride one square per size."""
    parts = []
    for step, sizes in zip(SSD_STEPS_PX, sizes_px, strict=True):
        rows, columns = -(-height_px // step), -(-width_px // step)
        y, x, side = np.meshgrid(np.arange(rows), np.arange(columns), np.asarray(sizes, np.float64), indexing="ij")
        parts.append(np.stack([(x + 0.5) * step, (y + 0.5) * step, side, side], axis=-1).reshape(-1, 4))
    return np.concatenate(parts)


def decode_detr(
    outputs: Mapping[str, NDArray[np.float32]], width_px: int, height_px: int, plate_class: int, score_min: float, *,
    no_object: bool,
) -> list[PlateCandidate]:
    """DETR: boxes (1, q, 4) centre and size in 0..1 and logits (1, q, classes); no_object: the last class is none (softmax)."""
    boxes = next((v for k, v in outputs.items() if v.ndim == 3 and v.shape[-1] == 4 and "logit" not in k), None)
    logits = next((v for k, v in outputs.items() if v.ndim == 3 and v is not boxes), None)
    if boxes is None or logits is None or boxes.shape[1] != logits.shape[1]:
        raise ValueError(f"outputs {[(k, v.shape) for k, v in outputs.items()]} are not boxes and logits")
    raw = np.asarray(logits[0], np.float64)
    if no_object:
        odds = np.exp(raw - raw.max(axis=1, keepdims=True))
        scores = _column((odds / odds.sum(axis=1, keepdims=True))[:, :-1], plate_class)
    else:
        scores = 1 / (1 + np.exp(-_column(raw, plate_class)))
    size = np.array([width_px, height_px, width_px, height_px], np.float64)
    return _candidates(_corners(_from_centres(np.asarray(boxes[0], np.float64) * size)), scores, score_min)


def _has_objectness(output: NDArray[np.float32]) -> bool:
    """Rows are predictions and there are many of them: the layout of v5 and v7."""
    return bool(output.shape[1] > output.shape[2] and output.shape[1] > KEEP)


def _table(output: NDArray[np.float32]) -> Array:
    """(n, columns) of a batch of one, whichever way round it is."""
    if output.ndim != 3 or output.shape[0] != 1 or min(output.shape[1:]) < 5:
        raise ValueError(f"output {output.shape} is no table of boxes")
    rows = np.asarray(output[0], np.float64)
    few_rows = rows.shape[0] < rows.shape[1] and not (rows.shape[1] == 6 and rows.shape[0] <= KEEP)
    return rows.T if few_rows else rows


def _column(table: Array, index: int) -> Array:
    if index >= table.shape[1]:
        raise ValueError(f"class column {index} of {table.shape[1]}: check detector.onnx_class")
    return np.asarray(table[:, index])


def _from_centres(boxes: Array) -> Array:
    return np.concatenate([boxes[:, :2] - boxes[:, 2:4] / 2, boxes[:, :2] + boxes[:, 2:4] / 2], axis=1)


def _corners(boxes: Array) -> Array:
    """(n, 4, 2) of (n, 4) left, top, right, bottom."""
    return np.asarray(boxes[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2))


def _candidates(corners: Array, scores: Array, score_min: float) -> list[PlateCandidate]:
    """The best ones without doubles; edges of boxes lie between pixels: centre 0 is at 0.5."""
    if not (np.isfinite(scores).all() and np.isfinite(corners).all()):
        raise ValueError("the network's output is not finite")
    found = []
    for i in np.argsort(-scores)[:KEEP]:
        if scores[i] < score_min:
            break
        ordered = corners[i] - 0.5
        if not _is_ordered(ordered):
            try:
                ordered = order_corners(ordered)
            except ValueError:  # four points that are no quadrilateral are no plate
                continue
        found.append(PlateCandidate(corners_px=ordered, score=float(min(scores[i], 1.0))))
    return without_doubles(found)


def _is_ordered(corners: Array) -> bool:
    """Whether (4, 2) are TL, TR, BR, BL as they come: clockwise on the screen, reading to the right within 45 degrees.

    What looks taller than wide (two rows in yaw, a motorcycle's plate) shows its order in nothing but the network's own.
    """
    across, down = corners[1] + corners[2] - corners[0] - corners[3]
    return is_convex(corners) and bool(across > abs(down))
