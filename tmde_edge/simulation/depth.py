"""A recorded depth track: the scene's inverse depth as a network of MiDaS's kind would give it, honestly marked as made up."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.drive import Instant, instant, rear_px
from tmde_edge.simulation.ground import rows_of
from tmde_edge.simulation.scenario import Scenario
from tmde_edge.simulation.scenery import card

GRID = (64, 48)  # columns, rows
MODEL = "simulated"
_WORK = (256, 192)
_PERIOD_FRAMES = 3


@dataclass(slots=True)
class DepthTrack:
    """m = scale inverse_depth + shift, both unknown to the reader and drifting; noise, blur and some wrong regions."""

    scenario: Scenario
    period_frames: int = _PERIOD_FRAMES
    t_ns: list[int] = field(default_factory=list)
    grids: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, frame: int) -> None:
        """Takes the frames that are due; the same scenario gives the same track."""
        if frame % self.period_frames:
            return
        t_s = frame / self.scenario.rate_hz
        inverse = inverse_depth(instant(self.scenario, t_s), GRID)
        self.t_ns.append(round(t_s * 1e9))
        self.grids.append(_as_network(inverse, self.scenario.seed, t_s, frame))


def inverse_depth(now: Instant, grid: tuple[int, int]) -> NDArray[np.float32]:
    """True 1/D (1/m, D along the optical axis; sky 0) averaged over the cells of a (columns, rows) grid: (rows, columns)."""
    camera = now.view.camera
    cols, rows = _WORK
    seen = rows_of(camera, now.pitch_rad, now.ahead)
    column = np.zeros(camera.height_px)
    column[seen.first :] = 1.0 / seen.t
    at = (np.arange(rows) + 0.5) * camera.height_px / rows - 0.5
    picture = np.repeat(np.interp(at, np.arange(camera.height_px), column)[:, None], cols, axis=1).astype(np.float32)
    fit = np.array([cols / camera.width_px, rows / camera.height_px])
    forward = now.view.level_from_camera[:, 2]
    shapes: list[tuple[float, NDArray[np.float64]]] = []
    for vehicle in now.vehicles:
        place = np.array([vehicle.x_m, vehicle.down_m - 0.8, vehicle.z_m])
        if vehicle.z_m > 0.3:
            shapes.append((float(place @ forward), rear_px(now.view, vehicle)))
    for item in now.cards:
        _, width, height = card(item.kind, item.variant, item.text)
        x, y, z = item.x_m, item.down_m, item.z_m
        # a tree or sign is as wide as half its card
        half = width / (2 if item.kind in ("house", "board") else 4)
        corners = np.array([[x - half, y - height, z], [x + half, y - height, z], [x + half, y, z], [x - half, y, z]])
        shapes.append((z, now.view.project(corners)))
    for distance, outline in sorted(shapes, key=lambda s: -s[0]):
        points = (outline + 0.5) * fit - 0.5
        if np.isfinite(points).all():
            fixed = np.rint(np.clip(points, -9000, 9000) * 16).astype(np.int32)
            cv2.fillPoly(picture, [fixed], [1.0 / max(distance, 0.1)], cv2.LINE_8, 4)
    return np.asarray(cv2.resize(picture, grid, interpolation=cv2.INTER_AREA), np.float32)


def _as_network(inverse: NDArray[np.float32], seed: int, t_s: float, frame: int) -> NDArray[np.float32]:
    whole = np.random.default_rng((seed, 77))
    scale, shift = whole.uniform(2000, 9000), whole.uniform(20, 90)
    phase = whole.uniform(0, 2 * np.pi, 4)
    scale *= 1 + 0.06 * np.sin(0.5 * t_s + phase[0]) + 0.03 * np.sin(1.7 * t_s + phase[1])
    shift *= 1 + 0.15 * np.sin(0.4 * t_s + phase[2])
    now = np.random.default_rng((seed, 78, frame))
    soft = np.asarray(cv2.GaussianBlur(inverse, (0, 0), 0.7), np.float32)
    rows, cols = soft.shape
    # errors of a network hang together over regions and over time: a slow field, and noise of each frame
    ripple = np.asarray(cv2.resize(whole.normal(0, 1, (5, 6)).astype(np.float32), (cols, rows), interpolation=cv2.INTER_CUBIC))
    soft = soft * (1 + 0.03 * np.sin(0.8 * t_s + phase[3]) * ripple)
    soft = soft * (1 + 0.015 * now.normal(0, 1, soft.shape))
    for _ in range(2):  # wrong regions, mostly beside the road
        if now.random() < 0.5:
            x = int(now.integers(0, cols - 6)) if now.random() < 0.3 else int(now.choice([0, cols - 8]))
            y, w, h = int(now.integers(0, rows - 6)), int(now.integers(3, 8)), int(now.integers(3, 8))
            soft[y : y + h, x : x + w] *= now.uniform(0.4, 1.8)
    return np.asarray(scale * soft + shift + now.normal(0, 1.5, soft.shape), np.float32)
