"""What two spots that look like bolts say of the distance, as far as they are believed: they may be print.

The plate is fitted without them. How far a pair lies from where that fit puts it tells how likely it is one; the answer mixes the
distances without and with it by that. A track keeps the mean of what its frames said, and applies it in those without
bolts too: the bolts of one plate do not change, and the distance must not jump when they are seen. They teach the scale memory
nothing, so the same print cannot make itself believed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmde_edge.ranging.features import Features
from tmde_edge.ranging.fit import LOG_D, ROLL, STEP, Fit, U, V, axes, nudged, on_plane

Floats = NDArray[np.float64]

PRINT = 0.1  # chance that a pair is print
PRINT_SPREAD = 0.14  # log: the range of spacings that are taken for bolts' at all (vision/segment/bolts.py)
BELIEVED = 0.5  # pairs less likely than this are left out where another one is more
MEAN_OF = 25  # frames
BIAS_PX = 0.1  # error of the distance between two bolts that all rows share, one sigma


@dataclass(frozen=True, slots=True)
class BoltSize:
    """A standard's bolts: the spacing, one sigma of its log that all rows share, and one of each bolt's place in its row."""

    spacing_m: float
    sigma: float
    jitter_m: float


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


def judge(features: Features, bolts: BoltSize, fit: Fit) -> Judged:
    """What a frame's pairs say beside the fit, which does not see them: one linear update of its distance by the believed.

    Evidence is against a standard whose bolts nobody states: to that any spacing is as likely as any other.
    """
    off, gradient, noise = _off(features, bolts, fit)
    shared = bolts.sigma**2 + _bias(features) ** 2
    every = gradient.T @ fit.covariance @ gradient + shared + np.diag(noise**2)
    sigma = np.sqrt(every.diagonal())
    true = (1 - PRINT) * PRINT_SPREAD * np.exp(-0.5 * (off / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
    chances = true / (true + PRINT)
    chosen = np.flatnonzero(chances >= min(BELIEVED, float(chances.max())))
    slope = gradient[:, chosen]
    gain = np.linalg.solve(every[np.ix_(chosen, chosen)], slope.T @ fit.covariance[:, LOG_D])  # (m,) of the log distance
    kept = np.eye(len(fit.x))[LOG_D] - slope @ gain
    p, apart, before = float(chances[chosen].mean()), -float(gain @ off[chosen]), float(fit.prior[LOG_D, LOG_D])
    after = float(kept @ fit.prior @ kept) + shared * float(gain.sum()) ** 2
    # Where bolts and fit contradict each other by more than they state, neither is as good as stated (Birge's ratio).
    after *= max(1.0, float(off[chosen] @ np.linalg.solve(every[np.ix_(chosen, chosen)], off[chosen])) / len(chosen))
    mixed = (1 - p) * before + p * after + p * (1 - p) * apart**2
    # Rows hang on one distance: the mean of what they say, not its sum.
    return Judged(chances, p * apart, mixed / before, float(np.mean(np.log(true + PRINT))))


def believed(features: Features, judged: Judged | None) -> Features:
    """With the pairs that are rather bolts than print, or with all where none is: for their cue."""
    if judged is None or not judged.believed.any():
        return features
    return replace(features, bolts=features.bolts[judged.believed], bolts_sigma=features.bolts_sigma[judged.believed])


def _off(features: Features, bolts: BoltSize, fit: Fit) -> tuple[Floats, Floats, Floats]:
    """Log of each pair's spacing over the expected one (m,), its gradient (p, m) by what was fitted, and its own sigma (m,)."""
    batch = nudged(fit.x)
    right, _, away = axes(batch[:, : ROLL + 1])
    lift = (away[:, 0] * batch[:, U] + away[:, 1] * batch[:, V] + away[:, 2]) * np.exp(batch[:, LOG_D])
    depth, place = on_plane(features.bolts.reshape(-1, 2), lift[:, None], right, away)
    apart = np.maximum(place[:, 1::2] - place[:, ::2], 1e-3)  # a pair that is turned round is far from any bolts'
    noise = np.sqrt(2 * (depth[0, ::2] * features.bolts_sigma) ** 2 + 2 * bolts.jitter_m**2) / np.maximum(apart[0], 0.05)
    off = np.log(apart / bolts.spacing_m)
    return off[0], (off[1:] - off[0]) / STEP, noise


def _bias(features: Features) -> float:
    """One sigma of the error of the log spacing that all rows of a frame share."""
    apart = features.bolts[:, 1] - features.bolts[:, 0]
    return BIAS_PX / (features.focal_px * float(np.median(np.hypot(apart[:, 0], apart[:, 1]))))
