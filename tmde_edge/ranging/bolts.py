"""Whether what looks like two bolts is a pair of them, by what everything else says about the distance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tmde_edge.ranging.features import Features
from tmde_edge.ranging.fit import LOG_D, POSE, ROLL, Fit, Model, U, V, axes

Floats = NDArray[np.float64]

_PRINT = 0.1  # chance that a pair is print
_PRINT_SPREAD = 0.14  # log: the range of spacings that are taken for bolts' at all (vision/segment/bolts.py)
_BELIEVED = 1.8  # sigmas from where the rest puts it


def without_bolts(features: Features) -> Features:
    """The same without any pair."""
    return replace(features, bolts=np.empty((0, 2, 2)), bolts_sigma=np.empty(0)) if len(features.bolts) else features


def judge(features: Features, model: Model, fit: Fit) -> tuple[Features, float]:
    """The features with the pairs that are believed, and how much all pairs speak for the standard, in log evidence.

    fit: made without bolts, so print cannot argue for itself. On a track the first verdict holds (TrackScale.bolts): what is in
    doubt would else come and go, and the distance jump with it. A standard whose bolts nobody states gets no evidence: to it
    any spacing is as likely as any other.
    """
    b = POSE + len(model.class_height_m) + 3
    right, _, away = (a[0] for a in axes(fit.x[None, : ROLL + 1]))
    at = np.concatenate([features.bolts, np.ones((*features.bolts.shape[:2], 1))], axis=2)
    depth = float(away @ [fit.x[U], fit.x[V], 1.0]) * np.exp(fit.x[LOG_D]) / (at @ away)
    place = depth * (at @ right)
    apart = np.maximum(place[:, 1] - place[:, 0], 1e-6)
    off = np.log(apart / (model.bolts_m * np.exp(fit.x[b])))
    both = fit.covariance[np.ix_([LOG_D, b], [LOG_D, b])]
    noise = 2 * (depth.mean(axis=1) * features.bolts_sigma) ** 2 + model.bolt_jitter_m**2
    sigma = np.sqrt(both[0, 0] + both[1, 1] - 2 * both[0, 1] + noise / apart**2)
    true = (1 - _PRINT) * np.exp(-0.5 * (off / sigma) ** 2) / (sigma * (2 * np.pi) ** 0.5)
    # Rows hang on one distance: their mean, not their sum.
    evidence = float(np.mean(np.log(true * _PRINT_SPREAD + _PRINT)))
    believed = np.abs(off) < _BELIEVED * sigma
    return replace(features, bolts=features.bolts[believed], bolts_sigma=features.bolts_sigma[believed]), evidence
