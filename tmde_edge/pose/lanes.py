"""The vanishing point of the road's lines in one image: pixels only, no time but the stamp it is given.

Two methods: "robust" (ours) and "paper" (Canny, probabilistic Hough, lines less than 45 deg from horizontal, median of the
pairwise intersections). Neither gives a roll: one pencil of parallel lines does not hold it, and the mean angle of lane
lines is the car's place in its lane, not its roll.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from tmde_edge.messages import LaneSighting, Point
from tmde_edge.pose.edges import FloatArray, Image, Lines
from tmde_edge.pose.settings import PoseSettings
from tmde_edge.pose.vanishing import paper, robust

_PAINTED = 2.0  # trust of an edge that may be a lane's border: light paint, not a kerb or a shadow


class LaneFinder:
    """Finds where the road's lines meet, on a reduced image below the expected horizon."""

    def __init__(self, settings: PoseSettings) -> None:
        self._settings = settings

    def see(
        self, image: Image, t_ns: int, prior_vanishing_px: Point | None = None, scale: float = 1.0
    ) -> LaneSighting | None:
        """The lanes' vanishing point, or None where the image holds none that can be trusted.

        `image` grey or BGR; `scale` = image pixels per source pixel (0.5 for an image already halved). The prior and the
        result are in source pixels. `t_ns` is not used: perception stamps the Sighting.
        """
        if self._settings.method == "none":
            return None
        height, width = image.shape[:2]
        shrink = max(1, round(width / self._settings.working_width_px))
        prior = (width - 1) / 2, (height - 1) / 2
        if prior_vanishing_px is not None:
            prior = _centre_scaled(prior_vanishing_px, scale)
        reach_y = self._settings.search_fraction * width * (1.0 if prior_vanishing_px is not None else 2.0)
        top = int(min(max(prior[1] - 0.25 * reach_y, 0.0), 0.85 * height)) // shrink * shrink
        rows = (height - top) // shrink * shrink
        columns = width // shrink * shrink
        if rows // shrink < 24 or columns // shrink < 80:
            return None
        grey = _reduced(image[top : top + rows, :columns], shrink)

        prior_w = (prior[0] + 0.5) / shrink - 0.5, (prior[1] - top + 0.5) / shrink - 0.5
        find = paper if self._settings.method == "paper" else robust
        found = find(grey, np.array(prior_w), reach_y / shrink)
        if found is None:
            return None
        point_w, covariance_w, lines = found
        to_source = shrink / scale
        sigma_x_px, sigma_y_px = (to_source * math.sqrt(max(float(v), 0.0)) for v in np.diag(covariance_w))
        limit_px = self._settings.max_sigma_px * width / scale / 1280.0
        if not (math.isfinite(sigma_x_px) and sigma_y_px <= limit_px):
            return None
        left_w, right_w = _borders(lines, point_w, grey.shape[0] - 1.0)
        x_px = (float(point_w[0]) + 0.5) * to_source - 0.5
        y_px = (float(point_w[1]) + 0.5) * to_source + top / scale - 0.5
        return LaneSighting(
            vanishing_px=(x_px, y_px),
            sigma_x_px=sigma_x_px,
            sigma_y_px=sigma_y_px,
            left_bottom_px=None if left_w is None else (left_w + 0.5) * to_source - 0.5,
            right_bottom_px=None if right_w is None else (right_w + 0.5) * to_source - 0.5,
        )


def _centre_scaled(point_px: Point, scale: float) -> Point:
    """A source point in an image of another size; pixel centres at integers."""
    return (point_px[0] + 0.5) * scale - 0.5, (point_px[1] + 0.5) * scale - 0.5


def _reduced(image: Image, shrink: int) -> Image:
    if shrink > 1:
        size = image.shape[1] // shrink, image.shape[0] // shrink
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    return image


def _borders(lines: Lines, point: FloatArray, bottom_row: float) -> tuple[float | None, float | None]:
    """Columns where the nearest lines left and right of the car's own track cross the bottom row (working pixels).

    The track of the camera itself is the column of the vanishing point. A border lies 0.4 to 2.5 camera heights off it.
    """
    depth = bottom_row - float(point[1])
    if depth < 8.0:
        return None, None
    down = np.where(lines.direction[:, 1] < 0.0, -1.0, 1.0)[:, None] * lines.direction
    steep = (down[:, 1] > 0.15) & (lines.trust > _PAINTED)
    column = float(point[0]) + (lines.middle_px[:, 0] - point[0]) * depth / np.maximum(lines.middle_px[:, 1] - point[1], 4.0)
    off = (column - float(point[0])) / depth
    sides: list[float | None] = []
    for sign in (-1.0, 1.0):
        here = steep & (sign * off > 0.4) & (sign * off < 2.5)
        support = (np.abs(off - off[:, None]) < 0.12) @ (lines.length_px * here)
        here &= support >= 20.0
        if here.any():
            nearest = float(np.abs(off[here]).min())
            group = here & (np.abs(np.abs(off) - nearest) < 0.15)
            sides.append(float(np.average(column[group], weights=lines.length_px[group])))
        else:
            sides.append(None)
    return sides[0], sides[1]
