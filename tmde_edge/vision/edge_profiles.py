"""Grey levels along lines across a plate's sides, in the source image, and their derivatives."""

from __future__ import annotations

from functools import lru_cache
from math import hypot

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import bounds, to_grey

Array = NDArray[np.float64]
ENDS = 0.08  # of a side left out at either end: rounded corners
MIN_STEP_GREY = 8.0  # contrast over an edge, grey levels
SMOOTH_PX = 0.6  # one sigma of the derivative of Gaussian
STEP_PX = 0.25  # between samples of a fine profile


def outward_normal(a: Array, b: Array) -> Array:
    """Unit normal of a side that points out of a quadrilateral in order TL, TR, BR, BL (y down)."""
    dx, dy = (b - a).tolist()
    length = hypot(dx, dy)
    return np.array([dy / length, -dx / length])


def grey_patch(image: Image, corners_px: Array, margin_px: float) -> tuple[NDArray[np.float32], Array]:
    """Grey float crop round the corners, and its origin. Outside the image: NaN, which no edge can cross."""
    h, w = image.shape[:2]
    x0, y0, x1, y1 = bounds(corners_px)
    left, top = int(np.floor(x0 - margin_px)), int(np.floor(y0 - margin_px))
    right, bottom = int(np.ceil(x1 + margin_px)) + 1, int(np.ceil(y1 + margin_px)) + 1
    l_in, t_in, r_in, b_in = max(left, 0), max(top, 0), min(right, w), min(bottom, h)
    if l_in >= r_in or t_in >= b_in:
        return np.full((2, 2), np.nan, np.float32), np.array([left, top], np.float64)
    inner = to_grey(image[t_in:b_in, l_in:r_in]).astype(np.float32)
    pads = (t_in - top, bottom - b_in, l_in - left, right - r_in)
    patch = cv2.copyMakeBorder(inner, *pads, cv2.BORDER_CONSTANT, value=float("nan")) if any(pads) else inner
    return np.asarray(patch, dtype=np.float32), np.array([left, top], np.float64)


def profiles(
    patch: NDArray[np.float32], a: Array, b: Array, rows: int, across_px: Array, line_px: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array]:
    """Positions along a side (n,), -0.5..0.5, and grey levels (n, m) at offsets across_px outward of a line near it.

    line_px: that line's outward offset at the side's middle, and its difference between the ends. Rows that leave the
    image are left out.
    """
    along = np.linspace(-0.5 + ENDS, 0.5 - ENDS, rows, dtype=np.float64)
    outward = line_px[0] + along * line_px[1]
    (mx, my), (dx, dy), (nx, ny) = ((a + b) / 2).tolist(), (b - a).tolist(), outward_normal(a, b).tolist()
    at_x = ((mx + along * dx + outward * nx)[:, None] + across_px * nx).astype(np.float32)
    at_y = ((my + along * dy + outward * ny)[:, None] + across_px * ny).astype(np.float32)
    grey = cv2.remap(patch, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    # the image is convex: a row whose ends lie in it lies in it
    whole = np.isfinite(grey[:, 0]) & np.isfinite(grey[:, -1])
    if whole.all():
        return along, np.asarray(grey, dtype=np.float64)
    return along[whole], np.asarray(grey[whole], dtype=np.float64)


def derivative(grey: Array, step_px: float, smooth_px: float) -> Array:
    """Derivative along the last axis, grey levels a pixel, by a Gaussian; repeated ends, same length."""
    if grey.size == 0:  # no profile lies inside the image
        return np.zeros(grey.shape)
    flat = np.atleast_2d(grey)
    out = cv2.filter2D(flat, cv2.CV_64F, _kernel(step_px, smooth_px), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.float64).reshape(grey.shape)


@lru_cache(maxsize=64)
def _kernel(step_px: float, smooth_px: float) -> Array:
    """(1, n) derivative of a Gaussian, a pixel."""
    half = int(np.ceil(3 * smooth_px / step_px))
    x = np.arange(-half, half + 1) * step_px
    gauss = np.exp(-0.5 * (x / smooth_px) ** 2)
    return np.asarray((x / smooth_px**2 * gauss / gauss.sum())[None, :], dtype=np.float64)


def middle_mean(rows: Array) -> Array:
    """(m,) mean of the middle half of each column's values: a median with less noise, and quicker."""
    n = len(rows)
    ranked = np.sort(rows, axis=0)
    return np.asarray(ranked[n // 4 : max(n // 4 + 1, n - n // 4)].mean(axis=0))
