"""What finder and reader together think of one candidate."""

from __future__ import annotations

import numpy as np

from tmde_edge.vision.protocols import PlateCandidate, PlateReading

# Logistic regression on candidates of rendered plates, the training rides of dashcam_ro, rendered facades and shop fronts
# (scripts/train/platenet/belief.py), plates and others weighing the same.
CONSTANT, OF_SCORE, OF_PLATEHOOD, OF_CLOSER = -4.24, 1.29, 0.64, 2.07
SCORE_LOGITS, PLATEHOOD_LOGITS = (-3.0, 4.0), (-1.0, 5.0)  # beyond these an opinion counts no more


def joint_score(candidate: PlateCandidate, reading: PlateReading) -> float:
    """The geometric mean of both opinions; the finder's where the reader has none."""
    return candidate.score if reading.platehood is None else float(np.sqrt(candidate.score * reading.platehood))


def credible(reading: PlateReading, platehood_min: float) -> bool:
    """Whether the reader does not deny that this is a plate."""
    return reading.platehood is None or reading.platehood >= platehood_min


def belief(score: float, platehood: float, closer: float) -> float:
    """0..1 from three opinions of 0..1: the finder's in its search, the reader's, the finder's at the plate's best size.

    Rows of windows and words on signs look like plates at one size, to one of the three; plates do to all of them.
    """
    z = CONSTANT + OF_SCORE * _logit(score, SCORE_LOGITS) + OF_PLATEHOOD * _logit(platehood, PLATEHOOD_LOGITS)
    z += OF_CLOSER * _logit(closer, SCORE_LOGITS)
    return float(1.0 / (1.0 + np.exp(-z)))


def _logit(p: float, limits: tuple[float, float]) -> float:
    p = min(max(p, 1e-6), 1.0 - 1e-6)
    return float(np.clip(np.log(p / (1.0 - p)), *limits))
