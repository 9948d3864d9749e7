"""What a plate's edge looks like across: ground, perhaps a border line and a margin of ground, then the body. Fitted.

f(u) = G + (K - G) [P(u - x + m + t) - P(u - x + m)] + (B - G) P(u - x), u outward in pixels, P the normal distribution
of spread s: x is the plate's edge, m the margin outside the border line, t the line's thickness, G, K, B the grey levels
of ground, line and body. Without a border t = 0. On small plates line and margin blur into one shoulder: only the model
tells where the edge is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Of the plate's height: border lines and margins of the standards (DE 4 and 2 of 110 mm, RU 3 and 2 of 112 mm, ...).
THICKNESS, THICKNESS_SIGMA = 0.030, 0.010
MARGIN, MARGIN_SIGMA = 0.018, 0.008
SPREAD_PX, SPREAD_LOG_SIGMA = 0.65, 0.35  # lens, sensor and demosaicing
LINE_LEVEL_SIGMA = 25.0  # grey levels; the line has the ink's colour
ITERATIONS = 8
SETTLED_PX = 0.01
NOISE_GREY = 1.5  # of an averaged profile at least: uneven paint and light
X, T, M, S, G, K, B = range(7)  # columns of the parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeFit:
    """Edge place x_px with the fit's sigma; misfit is the mean square of residuals and priors in noise units."""

    x_px: float
    sigma_px: float
    spread_px: float
    thickness_px: float
    misfit: float


def fit_edges(
    profiles: Array, offsets_px: Array, start_px: Array, height_px: float, ink_level: float, x_sigma_px: float
) -> list[tuple[EdgeFit, EdgeFit]]:
    """For each profile (n, m) from inside outwards the fits without and with a border line.

    start_px (n,): the first edge seen from inside; x_sigma_px: how well the given outline (u = 0) is believed.
    """
    n = len(profiles)
    y = np.concatenate([profiles, profiles])
    border = np.repeat([False, True], n)
    p, prior, weight = _start(y, start_px, border, height_px, ink_level, x_sigma_px)
    noise = np.maximum(NOISE_GREY, 0.02 * np.ptp(y, axis=1))
    inside = _window(offsets_px, np.concatenate([start_px, start_px]), height_px)
    seen = inside.any(axis=0)
    y, offsets_px, inside = y[:, seen], offsets_px[seen], inside[:, seen]
    damping = np.full(2 * n, 1e-2)
    cost, jacobian, residual = _evaluate(p, y, offsets_px, inside, noise, prior, weight)
    for _ in range(ITERATIONS):
        damped = jacobian @ jacobian.transpose(0, 2, 1)
        damped[:, _ALL, _ALL] = (damped[:, _ALL, _ALL] + weight**2) * (1 + damping[:, None])
        gradient = (jacobian @ residual[..., None])[..., 0] + weight**2 * (p - prior)
        step = np.linalg.solve(damped, gradient[..., None])[..., 0]
        trial = p - np.minimum(np.maximum(step, -_LIMIT), _LIMIT)
        trial[:, S] = np.minimum(np.maximum(trial[:, S], _S_MIN), _S_MAX)
        t_cost, t_jacobian, t_residual = _evaluate(trial, y, offsets_px, inside, noise, prior, weight)
        better = t_cost < cost
        damping = np.where(better, damping * 0.2, damping * 8)
        moved = np.abs(trial[:, X] - p[:, X])
        p[better], cost[better] = trial[better], t_cost[better]
        jacobian[better], residual[better] = t_jacobian[better], t_residual[better]
        if (moved < SETTLED_PX).all():
            break
    normal = jacobian @ jacobian.transpose(0, 2, 1)
    normal[:, _ALL, _ALL] += weight**2
    covariance = np.linalg.inv(normal)
    count = inside.sum(axis=1)
    fits = [
        EdgeFit(
            x_px=float(p[i, X]), sigma_px=float(np.sqrt(covariance[i, X, X] * max(1.0, cost[i] / count[i]))),
            spread_px=float(np.exp(p[i, S])), thickness_px=float(p[i, T]), misfit=float(cost[i] / count[i]),
        )
        for i in range(2 * n)
    ]  # fmt: skip
    return [(fits[i], fits[n + i]) for i in range(n)]


_ALL = np.arange(7)
_S_MIN, _S_MAX = float(np.log(0.3)), float(np.log(3.0))
_LIMIT = np.array([1.0, 0.6, 0.6, 0.3, 60.0, 60.0, 60.0])  # of one step


def _start(
    y: Array, start_px: Array, border: NDArray[np.bool_], height_px: float, ink_level: float, x_sigma_px: float
) -> tuple[Array, Array, Array]:
    """Start, prior means and inverse prior sigmas of the parameters, (2 n, 7) each."""
    ground, body = np.sort(y, axis=1)[:, int(0.95 * y.shape[1])], y[:, -3:].mean(axis=1)
    start = np.concatenate([start_px, start_px])
    p = np.zeros((len(y), 7))
    p[:, T] = np.where(border, THICKNESS * height_px, 0.0)
    p[:, M] = np.where(border, MARGIN * height_px, 0.0)
    p[:, X] = start + p[:, T] + p[:, M]
    p[:, S], p[:, G], p[:, K], p[:, B] = np.log(SPREAD_PX), ground, ink_level, body
    prior = p.copy()
    prior[:, X] = 0.0
    weight = np.zeros_like(p)
    weight[:, X] = 1 / x_sigma_px
    weight[:, T] = np.where(border, 1 / (THICKNESS_SIGMA * height_px), 1e4)
    weight[:, M] = np.where(border, 1 / (MARGIN_SIGMA * height_px), 1e4)
    weight[:, S] = 1 / SPREAD_LOG_SIGMA
    weight[:, K] = 1 / LINE_LEVEL_SIGMA
    weight[:, G] = weight[:, B] = 1e-3
    return p, prior, weight


def _window(offsets_px: Array, start_px: Array, height_px: float) -> NDArray[np.bool_]:
    """(n, m) samples that belong to the edge: a little ground inside the first step, a little body beyond the last."""
    u = offsets_px[None, :]
    out = start_px[:, None] + (THICKNESS + MARGIN) * height_px
    inside = (u >= start_px[:, None] - max(3.0, 0.03 * height_px)) & (u <= out + 2.5)
    return np.asarray(inside)


def _evaluate(
    p: Array, y: Array, u: Array, inside: NDArray[np.bool_], noise: Array, prior: Array, weight: Array
) -> tuple[Array, Array, Array]:
    """Cost (n,), jacobian (n, 7, m) and residuals (n, m) in noise units; outside the window both are zero."""
    x, t, m, s = p[:, X, None], p[:, T, None], p[:, M, None], np.exp(p[:, S, None])
    z = np.stack([u - x + m + t, u - x + m, u - x]) / s
    square = z * z
    # normal distribution, within 3e-4 (Page 1977)
    dist = 0.5 + 0.5 * np.tanh(z * (0.7978845608 + 0.0356774081 * square))
    dens = np.exp(-0.5 * np.minimum(square, 200.0)) * (0.3989422804 / s)
    ground, line, body = p[:, G, None], p[:, K, None], p[:, B, None]
    dens *= np.stack([line - ground, ground - line, body - ground])  # times the step that each of the three edges makes
    j = np.empty((len(y), 7, y.shape[1]))
    j[:, T] = dens[0]
    j[:, M] = dens[0] + dens[1]
    j[:, X] = -(j[:, M] + dens[2])
    j[:, S] = -s * (dens * z).sum(axis=0)
    j[:, K] = dist[0] - dist[1]
    j[:, B] = dist[2]
    j[:, G] = 1 - j[:, K] - dist[2]
    scale = inside / noise[:, None]
    residual = (ground * j[:, G] + line * j[:, K] + body * j[:, B] - y) * scale
    cost = (residual**2).sum(axis=1) + ((weight * (p - prior)) ** 2).sum(axis=1)
    j *= scale[:, None]
    return cost, j, residual
