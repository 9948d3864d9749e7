"""The canvas that GlyphNet reads: an affine cut round four approximate corners, with margins, antialiased."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

CANVAS_W_PX = 192
CANVAS_H_PX = 64
_MARGIN_X = 0.14  # of the corners' width, each side
_MARGIN_Y = (0.10, 0.08)  # of the corners' height, plus of their width: corners err in proportion to the width
_MIN_HALF_PX = (2.0, 0.6)


def canvas_from_source(corners_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Affine map (2, 3), canvas pixels from source pixels, for corners (4, 2) TL, TR, BR, BL of a plate.

    The corners' least-squares parallelogram lands on a fixed rectangle about the canvas' centre; its aspect decides
    the vertical margin. Perspective is left over: extrapolating a homography of uncertain corners would be worse.
    Raises ValueError for corners that are not finite or span no area.
    """
    if not spans_area(corners_px):
        raise ValueError(f"corners {np.asarray(corners_px).tolist()} span no plate")
    half_u, half_v = _half_axes(corners_px)
    half_w, half_h = float(np.hypot(*half_u)), float(np.hypot(*half_v))
    half_u *= max(1.0, _MIN_HALF_PX[0] / half_w)
    half_v *= max(1.0, _MIN_HALF_PX[1] / half_h)
    margin_y = _MARGIN_Y[0] + _MARGIN_Y[1] * min(half_w / half_h, 6.0)
    rect_half = np.array([CANVAS_W_PX / 2 / (1 + 2 * _MARGIN_X), CANVAS_H_PX / 2 / (1 + 2 * margin_y)])
    source_axes = np.stack([half_u, half_v], axis=1)  # columns: what one half plate is in the source
    linear = np.diag(rect_half) @ np.linalg.inv(source_axes)
    centre = np.asarray(corners_px, np.float64).mean(axis=0)
    canvas_centre = np.array([(CANVAS_W_PX - 1) / 2, (CANVAS_H_PX - 1) / 2])
    return np.concatenate([linear, (canvas_centre - linear @ centre)[:, None]], axis=1)


def spans_area(corners_px: NDArray[np.float64]) -> bool:
    """Whether corners are finite, run clockwise from the top left and span more than a line."""
    half_u, half_v = _half_axes(corners_px)
    cross = float(half_u[0] * half_v[1] - half_u[1] * half_v[0])
    return bool(np.isfinite(cross) and cross > 0.05 * np.hypot(*half_u) * np.hypot(*half_v) and cross > 1e-3)


def _half_axes(corners_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Half the width and half the height of the corners' least-squares parallelogram, as vectors."""
    tl, tr, br, bl = np.asarray(corners_px, np.float64)
    return (tr + br - tl - bl) / 4, (bl + br - tl - tr) / 4


def apply_affine(matrix: NDArray[np.float64], points_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (..., 2) through a (2, 3) map."""
    mapped: NDArray[np.float64] = points_px @ matrix[:, :2].T + matrix[:, 2]
    return mapped


def invert_affine(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse (2, 3) map."""
    linear = np.linalg.inv(matrix[:, :2])
    return np.concatenate([linear, (-linear @ matrix[:, 2])[:, None]], axis=1)


def cut_canvas(grey: NDArray[np.uint8], canvas_from_src: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The canvas (CANVAS_H_PX, CANVAS_W_PX) uint8 of a grey source; borders replicate.

    Where the source is finer than the canvas it is averaged over areas first, so that nothing aliases.
    """
    source_from_canvas = invert_affine(canvas_from_src)
    edges = np.array([[-1.0, -1.0], [CANVAS_W_PX, -1.0], [CANVAS_W_PX, CANVAS_H_PX], [-1.0, CANVAS_H_PX]])
    seen = apply_affine(source_from_canvas, edges)
    height, width = grey.shape[:2]
    x0, y0 = np.floor(seen.min(axis=0)).astype(int) - 2
    x1, y1 = np.ceil(seen.max(axis=0)).astype(int) + 3
    x0, y0 = min(max(x0, 0), width - 1), min(max(y0, 0), height - 1)
    x1, y1 = max(min(x1, width), x0 + 1), max(min(y1, height), y0 + 1)
    part: NDArray[np.uint8] = grey[y0:y1, x0:x1]
    # source pixels per canvas pixel along the source's own axes (plates are nearly upright)
    step = np.abs(source_from_canvas[:, :2])
    want_x, want_y = max(step[0, 0], 1.0), max(step[1, 1], 1.0)
    scale_x, scale_y = 1.0, 1.0
    if want_x > 1.2 or want_y > 1.2:
        new_w, new_h = max(1, round((x1 - x0) / want_x)), max(1, round((y1 - y0) / want_y))
        scale_x, scale_y = new_w / (x1 - x0), new_h / (y1 - y0)
        part = cv2.resize(part, (new_w, new_h), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    # part pixel p shows the source at (p + 0.5) / scale - 0.5 + offset
    part_to_source = np.array([[1 / scale_x, 0, 0.5 / scale_x - 0.5 + x0], [0, 1 / scale_y, 0.5 / scale_y - 0.5 + y0]])
    linear = canvas_from_src[:, :2] @ part_to_source[:, :2]
    shift = canvas_from_src[:, :2] @ part_to_source[:, 2] + canvas_from_src[:, 2]
    canvas = cv2.warpAffine(
        part, np.concatenate([linear, shift[:, None]], axis=1), (CANVAS_W_PX, CANVAS_H_PX), flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return canvas.astype(np.uint8, copy=False)


def normalise(canvases: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Network input (n, 1, H, W) float32 from canvases (n, H, W): the plate's middle has mean 0 and spread 1."""
    x = canvases.astype(np.float32)
    middle = x[:, CANVAS_H_PX // 4 : -CANVAS_H_PX // 4, CANVAS_W_PX // 8 : -CANVAS_W_PX // 8]
    mean = middle.mean(axis=(1, 2), keepdims=True)
    spread = middle.std(axis=(1, 2), keepdims=True)
    out: NDArray[np.float32] = ((x - mean) / (spread + 4.0))[:, None]
    return np.clip(out, -6.0, 6.0)
