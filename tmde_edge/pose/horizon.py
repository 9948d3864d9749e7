"""What HorizonNet sees of a picture, and what its answer means: the horizon's row and slope with their sigmas. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from tmde_edge.messages import LaneSighting, Point
from tmde_edge.pose.edges import FloatArray, Image

WIDTH, HEIGHT = 160, 96  # of the network's picture
OFFSETS_PX: FloatArray = np.arange(-31.5, 32.0, 1.0)  # of the horizon below that picture's middle row, at its middle column
SLOPES: FloatArray = np.arange(-12.0, 13.0) * 0.015  # rows per column
VIEW_RAD = 1.0  # how much of the picture is looked at, at most, from left to right
# The network's own spread is of single pictures; pictures of one road err alike, and a filter takes them for independent.
SHARED_ERROR = 1.3
LEAST_SIGMA_PX = 0.7  # network pixels
MAX_SIGMA_PX = 8.0  # a distribution wider than this says nothing


@dataclass(frozen=True, slots=True)
class View:
    """How a network picture lies in its source: centre (source pixels) and network pixels per source pixel."""

    centre_px: Point
    scale: float


def network_view(width_px: int, height_px: int, fx_px: float | None, expected_px: Point | None) -> View:
    """The part round the expected vanishing point: a radian wide, or all of the picture's width where that is less."""
    x_px, y_px = expected_px if expected_px is not None else ((width_px - 1) / 2, (height_px - 1) / 2)
    wide_px = width_px if fx_px is None else min(float(width_px), VIEW_RAD * fx_px)
    half_px = 0.5 * wide_px
    x_px = min(max(x_px, half_px - 0.5), width_px - 0.5 - half_px)
    return View((x_px, min(max(y_px, 0.0), height_px - 1.0)), WIDTH / wide_px)


def network_picture(image: Image, view: View) -> Image:
    """(HEIGHT, WIDTH) grey; beyond the source its edge goes on."""
    height, width = image.shape[:2]
    wide_px, high_px = WIDTH / view.scale, HEIGHT / view.scale
    x0, y0 = view.centre_px[0] + 0.5 - 0.5 * wide_px, view.centre_px[1] + 0.5 - 0.5 * high_px
    top, bottom = max(math.floor(y0), 0), min(math.ceil(y0 + high_px), height)
    left, right = max(math.floor(x0), 0), min(math.ceil(x0 + wide_px), width)
    part = image[top:bottom, left:right]
    # Whole source rows and columns are averaged first; the exact place comes with the last, small step.
    shrink = max(1, math.floor(1.0 / view.scale))
    if shrink > 1:
        part = np.asarray(
            cv2.resize(part, (-(-part.shape[1] // shrink), -(-part.shape[0] // shrink)), interpolation=cv2.INTER_AREA), np.uint8
        )
    kx, ky = part.shape[1] / (right - left), part.shape[0] / (bottom - top)
    if part.ndim == 3:
        part = np.asarray(cv2.cvtColor(part, cv2.COLOR_BGR2GRAY), np.uint8)
    sx, sy = view.scale / kx, view.scale / ky
    matrix = np.array([[sx, 0.0, sx * 0.5 - 0.5 + (left - x0) * view.scale], [0.0, sy, sy * 0.5 - 0.5 + (top - y0) * view.scale]])
    out = cv2.warpAffine(part, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, np.uint8)


def horizon_of(logits: FloatArray, view: View, expected_px: Point | None, width_px: int) -> LaneSighting | None:
    """The horizon as a vanishing row at the expected column; None where the answer is too wide or not finite."""
    if logits.shape != (len(OFFSETS_PX) + len(SLOPES),) or not np.isfinite(logits).all():
        return None
    offset_px, offset_sigma_px = _mean_and_sigma(logits[: len(OFFSETS_PX)], OFFSETS_PX)
    slope, slope_sigma = _mean_and_sigma(logits[len(OFFSETS_PX) :], SLOPES)
    if offset_sigma_px > MAX_SIGMA_PX:
        return None
    x_px = expected_px[0] if expected_px is not None else view.centre_px[0]
    row_px = view.centre_px[1] + offset_px / view.scale + slope * (x_px - view.centre_px[0])
    sigma_px = SHARED_ERROR * max(offset_sigma_px, LEAST_SIGMA_PX) / view.scale
    return LaneSighting(
        vanishing_px=(x_px, row_px),
        sigma_x_px=float(width_px),
        sigma_y_px=math.hypot(sigma_px, slope_sigma * (x_px - view.centre_px[0])),
        roll_rad=-math.atan(slope),
        roll_sigma_rad=SHARED_ERROR * max(slope_sigma, 0.01),
        source="network",
    )


def _mean_and_sigma(logits: FloatArray, values: FloatArray) -> tuple[float, float]:
    weight = np.exp(logits - logits.max())
    weight /= weight.sum()
    mean = float(weight @ values)
    return mean, math.sqrt(max(float(weight @ (values - mean) ** 2), 0.0))
