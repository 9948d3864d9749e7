"""What a plate's edge looks like across: ground, perhaps a border line and a margin of ground, then the body. Fitted.

f(u) = G + (K - G) P(u - x + m + t) + (G + D - K) P(u - x + m) + (B - G - D) P(u - x) + L [1 - P(u - e)],
u outward in pixels, P the normal distribution of spread s: x is the plate's edge, m the margin outside the border line, t
the line's thickness, G, K, B the grey levels of ground, line and body. Without a border t = 0. On small plates line and
margin blur into one shoulder: only the model tells where the edge is. Lettering that ends at e, so
near the edge that the ground between them never reaches its level, is the last term; without any L = 0.
Beside a blue band the margin may be brighter than what is inside: D.
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
ITERATIONS = 6
SETTLED_PX = 0.01
NOISE_GREY = 1.5  # of an averaged profile at least: uneven paint and light
GROUND_SIGMA = 12.0  # grey levels: light over the plate
MARGIN_LEVEL_SIGMA = 50.0
TEXT_SIGMA_PX, TEXT_LEVEL_SIGMA = 1.0, 60.0
X, T, M, S, G, K, B, E, L, D = range(10)  # columns of the parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeFit:
    """Edge place x_px with the fit's sigma; misfit is the mean square of residuals and priors in noise units."""

    x_px: float
    sigma_px: float
    spread_px: float
    thickness_px: float
    misfit: float
    line_off: float  # of the border line's level from the ink's, in sigmas; 0 without a line


def fit_edges(
    profiles: Array, offsets_px: Array, start_px: Array, height_px: float, ink_level: Array | float, x_sigma_px: float,
    limits_px: Array | None = None, ground_level: Array | None = None, text_px: Array | None = None,
) -> list[tuple[EdgeFit, EdgeFit]]:
    """For each profile (n, m) from inside outwards the fits without and with a border line.

    start_px (n,): the first edge seen from inside; x_sigma_px: how well the given outline (u = 0) is believed; limits_px (n, 2):
    what lies farther inside and outside belongs to other edges. ground_level (n,): of the plate;
    text_px (n,): where lettering ends next to the edge; NaN in either: unknown, none.
    """
    n = len(profiles)
    y = np.concatenate([profiles, profiles])
    border = np.repeat([False, True], n)
    ink = np.concatenate([np.broadcast_to(ink_level, n)] * 2)
    nothing = np.full(n, np.nan)
    text = np.concatenate([nothing if text_px is None else text_px] * 2)
    level = np.concatenate([nothing if ground_level is None else ground_level] * 2)
    p, prior, weight = _start(y, start_px, border, height_px, ink, x_sigma_px, level, text)
    noise = np.maximum(NOISE_GREY, 0.02 * np.ptp(y, axis=1))
    inside = _window(offsets_px, np.concatenate([start_px, start_px]), height_px)
    if limits_px is not None:
        low, high = np.concatenate([limits_px, limits_px]).T[:, :, None]
        inside &= (offsets_px >= low) & (offsets_px <= high)
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
            line_off=float((p[i, K] - ink[i]) / LINE_LEVEL_SIGMA) if border[i] else 0.0,
            spread_px=float(np.exp(p[i, S])), thickness_px=float(p[i, T]), misfit=float(cost[i] / count[i]),
        )
        for i in range(2 * n)
    ]  # fmt: skip
    return [(fits[i], fits[n + i]) for i in range(n)]


_ALL = np.arange(10)
_S_MIN, _S_MAX = float(np.log(0.3)), float(np.log(3.0))
_LIMIT = np.array([1.0, 0.6, 0.6, 0.3, 60.0, 60.0, 60.0, 0.6, 60.0, 60.0])  # of one step


def _start(
    y: Array, start_px: Array, border: NDArray[np.bool_], height_px: float, ink_level: Array, x_sigma_px: float,
    ground_level: Array, text_px: Array,
) -> tuple[Array, Array, Array]:
    """Start, prior means and inverse prior sigmas of the parameters, (2 n, 10) each."""
    ground, body = np.sort(y, axis=1)[:, int(0.95 * y.shape[1])], y[:, -3:].mean(axis=1)
    start = np.concatenate([start_px, start_px])
    known, lettered = np.isfinite(ground_level), np.isfinite(text_px)
    ground = np.where(known, ground_level, ground)
    p = np.zeros((len(y), 10))
    p[:, T] = np.where(border, THICKNESS * height_px, 0.0)
    p[:, M] = np.where(border, MARGIN * height_px, 0.0)
    p[:, X] = start + p[:, T] + p[:, M]
    p[:, S], p[:, G], p[:, K], p[:, B] = np.log(SPREAD_PX), ground, ink_level, body
    p[:, E] = np.where(lettered, text_px, -50.0)
    p[:, L] = np.where(lettered, 0.5 * (ink_level - ground), 0.0)
    prior = p.copy()
    prior[:, X] = 0.0
    weight = np.zeros_like(p)
    weight[:, X] = 1 / x_sigma_px
    weight[:, T] = np.where(border, 1 / (THICKNESS_SIGMA * height_px), 1e4)
    weight[:, M] = np.where(border, 1 / (MARGIN_SIGMA * height_px), 1e4)
    weight[:, S] = 1 / SPREAD_LOG_SIGMA
    weight[:, K] = 1 / LINE_LEVEL_SIGMA
    weight[:, G] = np.where(known, 1 / GROUND_SIGMA, 1e-3)
    weight[:, B] = 1e-3
    weight[:, D] = np.where(border & ~known, 1 / MARGIN_LEVEL_SIGMA, 1e4)
    weight[:, E] = np.where(lettered, 1 / TEXT_SIGMA_PX, 1e4)
    weight[:, L] = np.where(lettered, 1 / TEXT_LEVEL_SIGMA, 1e4)
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
    """Cost (n,), jacobian (n, 10, m) and residuals (n, m) in noise units; outside the window both are zero."""
    x, t, m, s = p[:, X, None], p[:, T, None], p[:, M, None], np.exp(p[:, S, None])
    text = p[:, L, None]
    z = np.stack([u - x + m + t, u - x + m, u - x, u - p[:, E, None]]) / s
    square = z * z
    # normal distribution, within 3e-4 (Page 1977)
    dist = 0.5 + 0.5 * np.tanh(z * (0.7978845608 + 0.0356774081 * square))
    dens = np.exp(-0.5 * np.minimum(square, 200.0)) * (0.3989422804 / s)
    ground, line, body = p[:, G, None], p[:, K, None], p[:, B, None]
    margin = ground + p[:, D, None]
    # times the step that each of the four edges makes
    dens *= np.stack([line - ground, margin - line, body - margin, -text])
    j = np.empty((len(y), 10, y.shape[1]))
    j[:, T] = dens[0]
    j[:, M] = dens[0] + dens[1]
    j[:, X] = -(j[:, M] + dens[2])
    j[:, S] = -s * (dens * z).sum(axis=0)
    j[:, K] = dist[0] - dist[1]
    j[:, D] = dist[1] - dist[2]
    j[:, B] = dist[2]
    j[:, G] = 1 - dist[0] + j[:, D]
    j[:, E] = -dens[3]
    j[:, L] = 1 - dist[3]
    scale = inside / noise[:, None]
    model = ground * j[:, G] + line * j[:, K] + (margin - ground) * j[:, D] + body * j[:, B] + text * j[:, L]
    residual = (model - y) * scale
    cost = (residual**2).sum(axis=1) + ((weight * (p - prior)) ** 2).sum(axis=1)
    j *= scale[:, None]
    return cost, j, residual
