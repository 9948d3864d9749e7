"""What finder and reader together think of one candidate."""

from __future__ import annotations

import numpy as np

from tmde_edge.vision.protocols import PlateCandidate, PlateReading


def joint_score(candidate: PlateCandidate, reading: PlateReading) -> float:
    """The geometric mean of both opinions; the finder's where the reader has none."""
    return candidate.score if reading.platehood is None else float(np.sqrt(candidate.score * reading.platehood))


def credible(reading: PlateReading, platehood_min: float) -> bool:
    """Whether the reader does not deny that this is a plate."""
    return reading.platehood is None or reading.platehood >= platehood_min
