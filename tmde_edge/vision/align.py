"""Dense alignment of a patch under a similarity: growth of the image by all of its pixels, not only by features.

Efficient second-order minimisation (Benhimane and Malis, 2004): residuals between the later image, warped, and gain times
template plus offset, with the mean of both gradients; Huber weights against reflections and what passes in front.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, isfinite, sqrt

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
EXPLAINED_MIN = 0.3  # rears in drives: 0.6 to 1.0; in clipped glare 0.5; what is not the same thing: about 0
SPREAD_MIN_GREY = 2.0  # a blank picture is explained by any template whose contrast is taken away
CORRELATED_PX = 4.0  # neighbours that share one independent residual: interpolation, demosaicing, compression
NOISE_FLOOR_GREY = 1.0
_CENTRAL = np.array([[-0.5, 0.0, 0.5]], np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """(2, 3) map from template to later pixels; growth ratio with its sigma; robust rms that is left, grey."""

    matrix: Array
    ratio: float
    ratio_sigma: float
    residual_grey: float


def layers(grey: Image) -> NDArray[np.float32]:
    """(h, w, 3) of a grey picture: itself and its gradients along x and y, grey levels a pixel."""
    value = grey.astype(np.float32)
    across = cv2.filter2D(value, cv2.CV_32F, _CENTRAL)
    down = cv2.filter2D(value, cv2.CV_32F, _CENTRAL.T)
    return np.asarray(cv2.merge([value, across, down]), dtype=np.float32)


def align(
    template: NDArray[np.float32], later: NDArray[np.float32], mask: NDArray[np.bool_], start: Array
) -> Alignment | None:
    """Similarity that takes the template's pixels under the mask into `later` (`layers` of both), from a start (2, 3).

    None where there is too little texture, too much leaves the image, it does not settle, or something else is there.
    """
    rows, columns = np.nonzero(mask)
    skip = 1 + len(rows) // PIXELS_MAX
    rows, columns = rows[::skip], columns[::skip]
    if len(rows) < PIXELS_MIN:
        return None
    cx, cy = float(columns.mean()), float(rows.mean())
    x, y = columns - cx, rows - cy  # about the patch's centre
    farthest = float(np.hypot(x, y).max())
    wanted, then_x, then_y = template[rows, columns].T.astype(np.float64)
    height, width = later.shape[:2]
    # z -> m z + t about the patch's centre, as complex numbers
    m = complex(start[0, 0], start[1, 0])
    t = complex(*(start[:, :2] @ (cx, cy) + start[:, 2]).tolist())
    normal, sigma, step = np.eye(6), 0.0, np.inf
    weights = np.ones(len(rows))
    jacobian = np.empty((6, len(rows)))
    jacobian[4], jacobian[5] = wanted.mean() - wanted, -1.0
    for _ in range(ITERATIONS):
        at_x = (m.real * x - m.imag * y + t.real).astype(np.float32)
        at_y = (m.imag * x + m.real * y + t.imag).astype(np.float32)
        inside = (at_x >= 0) & (at_x <= width - 1) & (at_y >= 0) & (at_y <= height - 1)
        count = int(np.count_nonzero(inside))
        if count < 0.8 * len(rows):
            return None
        # one row of many pixels: as a column it takes OpenCV twenty times as long
        got = cv2.remap(later, at_x[None], at_y[None], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        seen, now_x, now_y = np.asarray(got)[0].T.astype(np.float64)
        # the mean of both gradients, the later image's turned back into the template's axes
        slope_x = 0.5 * (then_x + now_x * m.real + now_y * m.imag)
        slope_y = 0.5 * (then_y + now_y * m.real - now_x * m.imag)
        jacobian[0] = slope_x * x + slope_y * y
        jacobian[1] = slope_y * x - slope_x * y
        jacobian[2], jacobian[3] = slope_x, slope_y
        residual = seen - wanted
        weighted = jacobian * (weights * inside)
        normal = weighted @ jacobian.T
        try:
            solved = np.linalg.solve(normal, -(weighted @ residual))
        except np.linalg.LinAlgError:  # a patch without texture
            return None
        left = np.abs(residual + solved @ jacobian)
        sigma = max(NOISE_FLOOR_GREY, 1.4826 * float(np.partition(left[inside], count // 2)[count // 2]))
        weights = np.minimum(1.0, HUBER_SIGMAS * sigma / np.maximum(left, 1e-9))
        # the step is in the template's axes: compose it in front of the map so far
        grown, turned, shift_x, shift_y = solved[:4].tolist()
        turn, shift = complex(1 + grown, turned), complex(shift_x, shift_y) * m
        t, m = t + shift, m * turn
        step = hypot(abs(turn - 1) * farthest, abs(shift))
        if step < SETTLED_PX:
            break
    if not step <= 0.1 or not isfinite(abs(m)):
        return None
    # the share of what the later patch varies by that the template explains
    spread = seen[inside] - seen[inside].mean()
    explained = 1.0 - float((weights[inside] * left[inside] ** 2).sum() / max(float((weights[inside] * spread**2).sum()), 1e-9))
    if explained < EXPLAINED_MIN or float(spread.std()) < SPREAD_MIN_GREY:
        return None
    covariance = np.linalg.inv(normal) * sigma**2 * max(1.0, CORRELATED_PX / skip)
    linear = np.array([[m.real, -m.imag], [m.imag, m.real]])
    return Alignment(
        matrix=np.column_stack([linear, (t.real, t.imag) - linear @ (cx, cy)]), ratio=abs(m), residual_grey=sigma,
        ratio_sigma=abs(m) * sqrt(max(float(covariance[0, 0]), 0.0)),
    )
