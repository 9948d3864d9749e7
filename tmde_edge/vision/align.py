"""Dense alignment of a patch under a similarity: growth of the image by all of its pixels, not only by features.

Efficient second-order minimisation (Benhimane and Malis, 2004): residuals between the later image, warped, and gain times
template plus offset, with the mean of both gradients; Huber weights against reflections and what passes in front.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image

Array = NDArray[np.float64]
ITERATIONS = 10
SETTLED_PX = 0.004  # a step below this moves the ratio by less than its sigma
PIXELS_MAX = 1200
PIXELS_MIN = 60
HUBER_SIGMAS = 2.0
CORRELATED_PX = 4.0  # neighbours that share one independent residual: interpolation, demosaicing, compression
NOISE_FLOOR_GREY = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """(2, 3) map from template to later pixels; growth ratio with its sigma; how well it explains the patch (rms, grey)."""

    matrix: Array
    ratio: float
    ratio_sigma: float
    residual_grey: float


def align(template: Image, later: Image, mask: NDArray[np.bool_], start: Array) -> Alignment | None:
    """Similarity that takes the template's pixels under the mask into `later`, from a start (2, 3).

    None where there is too little texture, too much leaves the image, or it does not settle.
    """
    rows, columns = np.nonzero(mask)
    skip = 1 + len(rows) // PIXELS_MAX
    rows, columns = rows[::skip], columns[::skip]
    if len(rows) < PIXELS_MIN:
        return None
    then = template.astype(np.float32)
    gx, gy = _gradients(then)
    now = later.astype(np.float32)
    layers = np.asarray(cv2.merge([now, *_gradients(now)]), dtype=np.float32)
    points = np.column_stack([columns, rows]).astype(np.float64)
    centre = points.mean(axis=0)
    offsets = points - centre
    wanted = then[rows, columns].astype(np.float64)
    slope_then = np.column_stack([gx[rows, columns], gy[rows, columns]]).astype(np.float64)
    # z -> m z + t about the patch's centre, as complex numbers
    m = complex(start[0, 0], start[1, 0])
    t = start[:, :2] @ centre + start[:, 2]
    normal, sigma, step = np.eye(6), 0.0, np.inf
    weights = np.ones(len(rows))
    jacobian = np.empty((len(rows), 6))
    jacobian[:, 4], jacobian[:, 5] = wanted.mean() - wanted, -1.0
    for _ in range(ITERATIONS):
        at = _moved(offsets, m, t).astype(np.float32)
        inside = (at >= 0).all(axis=1) & (at[:, 0] <= later.shape[1] - 1) & (at[:, 1] <= later.shape[0] - 1)
        if inside.mean() < 0.8:
            return None
        seen, sx, sy = _sample(layers, at)
        # the mean of both gradients, the later image's turned back into the template's axes
        slope_x = 0.5 * (slope_then[:, 0] + sx * m.real + sy * m.imag)
        slope_y = 0.5 * (slope_then[:, 1] + sy * m.real - sx * m.imag)
        jacobian[:, 0] = slope_x * offsets[:, 0] + slope_y * offsets[:, 1]
        jacobian[:, 1] = slope_y * offsets[:, 0] - slope_x * offsets[:, 1]
        jacobian[:, 2], jacobian[:, 3] = slope_x, slope_y
        residual = seen - wanted
        weighted = jacobian * (weights * inside)[:, None]
        normal = weighted.T @ jacobian
        try:
            solved = np.linalg.solve(normal, -(weighted.T @ residual))
        except np.linalg.LinAlgError:  # a patch without texture
            return None
        left = np.abs(residual + jacobian @ solved)
        sigma = max(NOISE_FLOOR_GREY, 1.4826 * float(np.partition(left[inside], (k := int(inside.sum()) // 2))[k]))
        weights = np.minimum(1.0, HUBER_SIGMAS * sigma / np.maximum(left, 1e-9))
        # the step is in the template's axes: compose it in front of the map so far
        turn = complex(1 + solved[0], solved[1])
        shift = complex(solved[2], solved[3]) * m
        t = t + np.array([shift.real, shift.imag])
        m = m * turn
        step = float(np.hypot(abs(turn - 1) * np.abs(offsets).max(), abs(shift)))
        if step < SETTLED_PX:
            break
    if step > 0.1 or not np.isfinite(abs(m)):
        return None
    covariance = np.linalg.inv(normal) * sigma**2 * max(1.0, CORRELATED_PX / skip)
    linear = np.array([[m.real, -m.imag], [m.imag, m.real]])
    return Alignment(
        matrix=np.column_stack([linear, t - linear @ centre]), ratio=abs(m), residual_grey=sigma,
        ratio_sigma=abs(m) * float(np.sqrt(max(covariance[0, 0], 0.0))),
    )


def _gradients(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return (
        np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel), dtype=np.float32),
        np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel.T), dtype=np.float32),
    )


def _moved(offsets: Array, m: complex, t: Array) -> Array:
    x, y = offsets[:, 0], offsets[:, 1]
    return np.column_stack([m.real * x - m.imag * y + t[0], m.imag * x + m.real * y + t[1]])


def _sample(layers: NDArray[np.float32], at: NDArray[np.float32]) -> Array:
    """(layers, n) cubic samples; border pixels are repeated outside."""
    got = cv2.remap(layers, at[:, None, 0], at[:, None, 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.asarray(got, dtype=np.float64)[:, 0].T)
