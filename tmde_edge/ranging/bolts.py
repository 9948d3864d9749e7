"""What two spots that look like bolts say of the distance, as far as they are believed: they may be print.

The plate is fitted without them first. How far a pair lies from where that fit puts it tells how likely it is one; the answer
mixes the fit without and the fit with it by that. A track keeps the mean of what its frames said, and applies it in those without
bolts too: the bolts of one plate do not change, and the distance must not jump when they are seen. They teach the scale memory
nothing, so the same print cannot make itself believed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmde_edge.ranging.features import Features
from tmde_edge.ranging.fit import LOG_D, POSE, ROLL, STEP, Fit, Model, U, V, axes, bolts_apart_m, nudged, solve

Floats = NDArray[np.float64]

PRINT = 0.1  # chance that a pair is print
PRINT_SPREAD = 0.14  # log: the range of spacings that are taken for bolts' at all (vision/segment/bolts.py)
BELIEVED = 0.5  # pairs less likely than this are left out where another one is more
MEAN_OF = 25  # frames


@dataclass(frozen=True, slots=True)
class BoltsSay:
    """What bolts change in a standard's answer: the mean log distance, and the variance of its scale by a factor."""

    shift: float = 0.0
    factor: float = 1.0
    frames: int = 0

    def with_frame(self, shift: float, factor: float) -> BoltsSay:
        """The running mean after one more frame with bolts."""
        gain = 1 / min(self.frames + 1, MEAN_OF)
        return BoltsSay(self.shift + gain * (shift - self.shift), self.factor + gain * (factor - self.factor), self.frames + 1)


@dataclass(frozen=True, slots=True)
class Judged:
    """One frame's pairs: their chances (m,) to be bolts, what they say, and their log evidence for the standard."""

    chances: Floats
    shift: float
    factor: float
    evidence: float

    @property
    def believed(self) -> NDArray[np.bool_]:
        """Which pairs (m,) are rather bolts than print."""
        return np.asarray(self.chances >= BELIEVED)


def without_bolts(features: Features) -> Features:
    """The same without any pair; most plates show none, and every fit asks."""
    return _only(features, np.zeros(len(features.bolts), dtype=bool)) if len(features.bolts) else features


def judge(features: Features, model: Model, fit: Fit) -> Judged | None:
    """What a frame's pairs say beside the fit without them; None where the fit with them does not end at a plate.

    Evidence is against a standard whose bolts nobody states: to that any spacing is as likely as any other.
    """
    off, sigma = _off(features, model, fit)
    true = (1 - PRINT) * PRINT_SPREAD * np.exp(-0.5 * (off / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
    chances = true / (true + PRINT)
    chosen = chances >= min(BELIEVED, float(chances.max()))
    joint = solve(_only(features, chosen), model, fit.x)
    if joint is None:
        return None
    p, apart = float(chances[chosen].mean()), float(joint.x[LOG_D] - fit.x[LOG_D])
    before, after = float(fit.prior[LOG_D, LOG_D]), float(joint.prior[LOG_D, LOG_D])
    mixed = (1 - p) * before + p * after + p * (1 - p) * apart**2
    # Rows hang on one distance: the mean of what they say, not its sum.
    evidence = float(np.mean(np.log(true + PRINT)))
    return Judged(chances, p * apart, mixed / before, evidence)


def believed(features: Features, judged: Judged | None) -> Features:
    """With the pairs that are rather bolts than print, or with all where none is: for their cue."""
    return features if judged is None or not judged.believed.any() else _only(features, judged.believed)


def _only(features: Features, which: NDArray[np.bool_]) -> Features:
    return replace(features, bolts=features.bolts[which], bolts_sigma=features.bolts_sigma[which])


def _off(features: Features, model: Model, fit: Fit) -> tuple[Floats, Floats]:
    """Log of each pair's spacing over the expected one (m,), and its sigma from the whole pose, the sizes and the image."""
    batch = nudged(fit.x)
    right, _, away = axes(batch[:, : ROLL + 1])
    lift = (away[:, 0] * batch[:, U] + away[:, 1] * batch[:, V] + away[:, 2]) * np.exp(batch[:, LOG_D])
    apart, noise = bolts_apart_m(features, model, lift[:, None], right, away)
    apart = np.maximum(apart, 1e-3)  # a pair that is turned round is far from any bolts'
    off = np.log(apart / model.bolts_m) - batch[:, POSE + len(model.class_height_m) + 3, None]
    gradient = (off[1:] - off[0]) / STEP
    variance = np.einsum("pm,pq,qm->m", gradient, fit.covariance, gradient) + (noise / np.maximum(apart[0], 0.05)) ** 2
    return off[0], np.sqrt(variance)
