"""Plates drawn for the tests of vision, at exactly known places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.stills import Still, render_still


def plate_still(standard: str = "de-mittel", width_px: float = 160.0, seed: int = 1, yaw_rad: float = 0.0) -> Still:
    """A vehicle in a street with this plate at this width."""
    return render_still(standard, width_px=width_px, seed=seed, yaw_rad=yaw_rad, scenery=False)


def inside(outer: NDArray[np.float64], point: NDArray[np.float64]) -> bool:
    """Whether a point lies in the upright box round corners."""
    return bool(np.all(point >= outer.min(axis=0)) and np.all(point <= outer.max(axis=0)))
