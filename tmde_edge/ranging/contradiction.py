"""How far the cues of one plate contradict each other: one scale factor for the sigma of their joint fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tmde_edge.ranging.features import Features
from tmde_edge.ranging.fit import AFTER_CLASSES, LOG_D, POSE, ROLL, Fit, Model, U, V, axes, corners_of

Floats = NDArray[np.float64]

_MUCH_WEAKER = 3.0  # sigmas of all together: a cue less sure than that cannot contradict, and must not count as one that agrees
_OF_MEDIAN = 1.57  # variance of a median over that of a mean
_UNSEEN = 1e-2  # information about a size that nothing shows


def scale_factor(features: Features, model: Model, fit: Fit) -> float:
    """S = sqrt(chi-square / (cues - 1)) of the cues about the joint answer, at least 1: all sigmas grow by it.

    Cues are the logs of the distances that the characters (their median: one wild character says nothing, all of them do), the
    plate's width and its height each say by their nominal or learned size. What a cue's features share, one reader, one class's
    tolerance, the edges' common error, stands in the cues' covariance and contradicts nothing; spacing is no cue, a missed
    character doubles it; nor are bolts (bolts.py weighs them). The plate is taken as turned only as far as perspective
    shows: a turn that the fit needs to reconcile two sizes is a contradiction. Of cues that share an error (a memory knows sizes
    by their ratio) S says too much: what it adds ends where the cue farthest from the answer lies. Source: Birge, Phys. Rev. 40
    (1932) 207; Particle Data Group, Review of Particle Physics, Introduction, 5.2.2 (which leaves out weak cues too).
    """
    k = len(model.class_height_m)
    x = fit.x.copy()
    x[POSE:] = model.mean[POSE:]
    x[:ROLL] *= _shown_by_perspective(model, fit)
    off, noise, of_size = [], [], []
    used = np.flatnonzero(model.glyph_class >= 0)
    if len(used):
        classes, heights = model.glyph_class[used], features.heights[used]
        off.append(float(np.median(np.log(_heights(features, model, x, used) / heights))))
        each = 2 * (features.sigma_tb[used] / heights) ** 2 + model.glyph_jitter**2
        noise.append(_OF_MEDIAN * float(each.mean()) / len(used))
        of_size.append(np.bincount(classes, minlength=k + AFTER_CLASSES) / len(used))
    right, down, _ = axes(x[None, : ROLL + 1])
    corners = corners_of(model, x[None], right, down)[0]
    for place, seen, expected, sigma in (
        (k, features.width, features.width_of(corners), features.width_sigma),
        (k + 1, features.height, features.height_of(corners), features.height_sigma),
    ):
        if seen and expected:
            off.append(float(np.log(expected / seen)))
            noise.append(2 * (sigma / seen) ** 2)
            of_size.append(np.eye(k + AFTER_CLASSES)[place])
    if len(off) < 2:
        return 1.0
    which = np.array(of_size)
    covariance = which @ np.linalg.inv(model.information[POSE:, POSE:]) @ which.T + np.diag(noise)
    together = 1 / float(np.linalg.inv(covariance).sum())
    sure = np.flatnonzero(covariance.diagonal() < _MUCH_WEAKER**2 * together)
    if len(sure) < 2:
        return 1.0
    d = np.array(off)[sure]
    weight = np.linalg.inv(covariance[np.ix_(sure, sure)])
    apart = float(np.abs(d).max() ** 2) / float(fit.covariance[LOG_D, LOG_D])
    return max(1.0, float(np.sqrt(min(d @ weight @ d / (len(sure) - 1), 1 + apart))))


def _shown_by_perspective(model: Model, fit: Fit) -> Floats:
    """Share (2,) of heading and lean, 0 to 1, that the features show without any size: 1 - (sigma without sizes / prior's)^2."""
    prior = model.information.diagonal()[:ROLL]
    other = [i for i in range(len(fit.x)) if i != LOG_D]  # distance and free sizes are one
    free = fit.data[np.ix_(other, other)]
    free[np.diag_indices(len(free))] += _UNSEEN
    free[np.arange(ROLL), np.arange(ROLL)] += prior
    return np.asarray(np.clip(1 - np.linalg.inv(free).diagonal()[:ROLL] * prior, 0.0, 1.0), dtype=np.float64)


def _heights(features: Features, model: Model, x: Floats, used: NDArray[np.int64]) -> Floats:
    """Heights (n,) that the used characters would have in the image at x (p,)."""
    _, down, away = (a[0] for a in axes(x[None, : ROLL + 1]))
    middle = np.column_stack([(features.top[used] + features.bottom[used]) / 2, np.ones(len(used))])
    depth = (away @ [x[U], x[V], 1.0]) * np.exp(x[LOG_D]) / (middle @ away)
    classes = model.glyph_class[used]
    half = (model.class_height_m[classes] * np.exp(x[POSE + classes]) / 2)[:, None] * down
    a, b = middle * depth[:, None] - half, middle * depth[:, None] + half
    return np.asarray(np.sqrt(np.sum((a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]) ** 2, axis=1)), dtype=np.float64)
