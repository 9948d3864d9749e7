"""What bolts say beside a fit, against the algebra written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plate_scenes import AHEAD, CAMERA, sighting

from tmde_edge.messages import BoltSighting
from tmde_edge.plates.standard import load_standards
from tmde_edge.ranging.bolts import BoltSize, judge
from tmde_edge.ranging.features import Features, gather
from tmde_edge.ranging.fit import LOG_D, POSE, Fit, U, V, axes

STANDARDS = load_standards()


def _bolted_features(off: float, rows: int = 2) -> tuple[Features, Fit]:
    """A small plate of which nothing but four corners and bolts is seen, and a fit of it with a correlated covariance."""
    plate = sighting(STANDARDS["us-aamva3"], distance_m=6.0)
    x, y = (np.array(plate.corners_px).mean(axis=0)).tolist()
    half = 0.0889 * (1 + off) / 6.0 * CAMERA.fx_px
    pairs = [
        BoltSighting(left_px=(x - half, y + down), right_px=(x + half + more, y + down), sigma_px=0.25)
        for down, more in ((14.0, 0.0), (-14.0, 0.2))
    ]
    features = gather(replace(plate, bolts=tuple(pairs[:rows])), CAMERA, AHEAD)
    p = POSE + 4  # one class of characters, width, height, pitch
    x = np.zeros(p)
    x[U], x[V], x[LOG_D] = features.centre[0], features.centre[1], np.log(6.0)
    rng = np.random.default_rng(3)
    root = rng.normal(0, 0.003, (p, p))
    prior = root @ root.T
    return features, Fit(
        x=x, noise=1e-5 * np.eye(p), prior=prior, data=np.eye(p), cost=0.0, evidence=0.0, glyphs_used=0, corners_used=4,
        pitch_used=False, strain=1.0, rejected=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("off", [0.004, 0.03])
def test_the_update_by_bolts_is_bayes(off: float, rows: int) -> None:
    """Against the Gaussian posterior of pose and bolts' common error, stacked and solved by information."""
    features, fit = _bolted_features(off, rows)
    bolts = BoltSize(0.1778, 0.009, 0.001)
    told = judge(features, bolts, fit)
    assert told.believed.all(), told.chances
    p, n = len(fit.x), len(features.bolts)
    bias = 0.1 / (features.focal_px * np.median(np.hypot(*(features.bolts[:, 1] - features.bolts[:, 0]).T)))

    def log_apart(x: np.ndarray) -> np.ndarray:
        right, _, away = axes(x[None, :3])
        lift = (away[0] @ np.array([x[U], x[V], 1.0])) * np.exp(x[LOG_D])
        ends = [[lift / (away[0] @ np.append(e, 1)) * (right[0] @ np.append(e, 1)) for e in pair] for pair in features.bolts]
        return np.array([np.log(b - a) for a, b in ends])

    gradient = np.array([(log_apart(fit.x + 1e-6 * d) - log_apart(fit.x - 1e-6 * d)) / 2e-6 for d in np.eye(p)])
    own = np.array([2 * (6.0 * s) ** 2 + 2 * 0.001**2 for s in features.bolts_sigma]) / np.exp(log_apart(fit.x)) ** 2
    design = np.hstack([gradient.T, -np.ones((n, 1))])  # pose and sizes, then the error that all rows share
    before = np.zeros((p + 1, p + 1))
    before[:p, :p] = np.linalg.inv(fit.covariance)
    before[p, p] = 1 / (bolts.sigma**2 + bias**2)
    information = before + design.T @ (design / own[:, None])
    apart = log_apart(fit.x) - np.log(0.1778)
    step = -np.linalg.solve(information, design.T @ (apart / own))
    chance = float(told.chances.mean())
    assert told.shift == pytest.approx(chance * step[LOG_D], rel=2e-3)
    # the same posterior's part that comes from the prior: with noise all but absent, its variance less the rows' own
    gain = np.linalg.solve(information, design.T / own)[LOG_D]
    kept = np.eye(p)[LOG_D] - gradient @ gain
    after = kept @ fit.prior @ kept + (bolts.sigma**2 + bias**2) * gain.sum() ** 2
    every = design @ np.linalg.solve(before, design.T) + np.diag(own)
    after *= max(1.0, apart @ np.linalg.solve(every, apart) / n)  # Birge's ratio
    mixed = (1 - chance) * fit.prior[LOG_D, LOG_D] + chance * after + chance * (1 - chance) * step[LOG_D] ** 2
    assert told.factor == pytest.approx(mixed / fit.prior[LOG_D, LOG_D], rel=2e-3)
