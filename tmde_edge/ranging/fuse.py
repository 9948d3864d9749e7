"""Inverse-variance fusion, and mixtures of hypotheses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def inverse_variance(distances_m: Sequence[float], sigmas_m: Sequence[float]) -> tuple[float, float]:
    """Weighted mean and its sigma for independent estimates: w_i = sigma_i^-2 (the paper's fusion)."""
    weights = 1.0 / np.square(np.asarray(sigmas_m, dtype=np.float64))
    mean = float(np.sum(weights * np.asarray(distances_m)) / weights.sum())
    return mean, float(weights.sum() ** -0.5)


def mixture(weights: Sequence[float], means: Sequence[float], sigmas: Sequence[float]) -> tuple[float, float]:
    """Mean and sigma of a mixture: the spread between hypotheses counts."""
    w = np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    m, s = np.asarray(means, dtype=np.float64), np.asarray(sigmas, dtype=np.float64)
    mean = float(w @ m)
    return mean, float(np.sqrt(w @ (s**2 + (m - mean) ** 2)))
