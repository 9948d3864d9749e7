"""One joint robust fit of a plate's pose and of its true proportions to everything measured on it.

Parameters: heading, lean and roll of the plate in the vehicle's axes; bearing (u, v) of its centre; log distance; and
the logarithms of its true sizes over the standard's: glyph height of each class, plate width, plate height, pitch.
The sizes carry the standard's tolerances (and what the track has learned) as priors, so that one wrong size moves every
feature that hangs on it together, instead of being averaged as if the features were independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmde_edge.ranging.features import Features

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

YAW, LEAN, ROLL, U, V, LOG_D = range(6)
POSE = 6  # parameters before the sizes

_STEP = 1e-6  # forward differences
_MAX_STEPS = 8
_GLYPH_C = 2.4  # Cauchy scale in sigmas: 95 % efficient on Gaussian noise
_CORNER_C = 3.0
_PRIOR_DOF = 6.0  # residuals worse than stated must show on more than a few features before the noise is scaled
_SIGNS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


@dataclass(frozen=True, slots=True)
class Model:
    """What one standard expects of one sighting. Lengths in metres.

    glyph_class (n,) gives each glyph's class or -1 for none; sizes: class heights (k,), then width, height, pitch.
    mean (6 + k + 3,) and information (same, square) are the Gaussian prior; sizes' part is about log size over nominal.
    """

    class_height_m: Floats
    width_m: float
    height_m: float
    pitch_m: float
    glyph_class: Ints
    glyph_jitter: float
    pitch_jitter_m: float
    mean: Floats
    information: Floats


@dataclass(frozen=True, slots=True)
class Fit:
    """The optimum, its covariance in two parts and what it costs.

    noise: covariance from the image's noise; prior: from the sizes and angles that were assumed; both (p, p).
    cost: -2 log posterior without constants. evidence: log marginal likelihood (Laplace), to compare standards by.
    """

    x: Floats
    noise: Floats
    prior: Floats
    cost: float
    evidence: float
    glyphs_used: int
    corners_used: int
    pitch_used: bool

    @property
    def covariance(self) -> Floats:
        return self.noise + self.prior


def solve(features: Features, model: Model, start: Floats) -> Fit | None:
    """Gauss-Newton with Cauchy weights from a starting point; None when it does not end at a plate in front of us."""
    problem = _Problem(features, model)
    x = start.copy()
    state = problem.linearise(x)
    if state is None:
        return None
    damping = 1e-6
    for _ in range(_MAX_STEPS):
        normal = state.normal + np.diag(damping * np.diag(state.normal))
        step = np.linalg.solve(normal, -state.gradient)
        step *= min(1.0, 0.5 / float(np.abs(step).max() + 1e-12))
        trial = problem.linearise(x + step)
        if trial is None or trial.cost > state.cost + 1e-9 * (1 + state.cost):
            damping = max(damping * 30, 1e-3)
            if damping > 1e4:
                break
            continue
        gain, x, state = state.cost - trial.cost, x + step, trial
        damping = max(damping * 0.1, 1e-9)
        if gain < 1e-3:
            break
    return problem.finish(x, state)


@dataclass(frozen=True, slots=True)
class _State:
    cost: float
    normal: Floats
    gradient: Floats
    data: Floats  # J^T W J without the prior
    chi2: float  # weighted squared residuals
    weight: float  # sum of weights


class _Problem:
    def __init__(self, features: Features, model: Model) -> None:
        self.f, self.m = features, model
        self.corner = np.flatnonzero(features.corner_ok)
        self.glyph = np.flatnonzero(model.glyph_class >= 0)
        self.k = len(model.class_height_m)
        self.classes = model.glyph_class[self.glyph]
        self.middle = (features.top[self.glyph] + features.bottom[self.glyph]) / 2
        self.stem = features.bottom[self.glyph] - features.top[self.glyph]
        jitter = model.glyph_jitter * np.sqrt(np.sum(self.stem**2, axis=1))
        self.stem_sigma = np.sqrt(2 * features.sigma_tb[self.glyph] ** 2 + jitter**2)
        self.runs = self._weigh_runs()

    def _weigh_runs(self) -> list[tuple[Floats, Floats, Floats]]:
        """For each run: left mid points, right mid points and weights that turn centres into the slope per place."""
        found = []
        for member in self.f.runs:
            place = np.arange(len(member), dtype=np.float64)
            place -= place.mean()
            centres = (self.f.left[member] + self.f.right[member]) / 2
            found.append((centres, self.f.sigma_lr[member], place / (place @ place)))
        return found

    def residuals(self, x: Floats) -> tuple[Floats, Floats, Floats]:
        """Residuals in sigmas for a batch (b, p): corners (b, c, 2), glyph heights (b, n), pitch runs (b, r)."""
        a, b, normal = axes(x[:, YAW], x[:, LEAN], x[:, ROLL])
        distance = np.exp(x[:, LOG_D])[:, None]
        centre = np.stack([x[:, U], x[:, V], np.ones(len(x))], axis=1)
        w = self.m.width_m * np.exp(x[:, POSE + self.k])[:, None] / distance
        h = self.m.height_m * np.exp(x[:, POSE + self.k + 1])[:, None] / distance
        signs = _SIGNS[self.corner]
        reach = (w * signs[:, 0])[:, :, None] * a[:, None, :] + (h * signs[:, 1])[:, :, None] * b[:, None, :]
        points = centre[:, None, :] + reach
        corners = (points[:, :, :2] / points[:, :, 2:] - self.f.corners[self.corner]) / self.f.corner_sigma
        # Depth of the plane along a glyph's ray, then the image of one metre along its height and along its row there.
        lift = np.sum(normal * centre, axis=1)[:, None] * distance
        facing = normal[:, :2] @ self.middle.T + normal[:, 2:]
        depth = lift / facing
        along = a[:, None, :2] - self.middle[None] * a[:, None, 2:]
        up = b[:, None, :2] - self.middle[None] * b[:, None, 2:]
        across = np.stack([-along[..., 1], along[..., 0]], axis=2)
        across /= np.sqrt(np.sum(across**2, axis=2, keepdims=True))
        size = self.m.class_height_m[self.classes] * np.exp(x[:, POSE : POSE + self.k][:, self.classes])
        expected = size / depth * np.sum(up * across, axis=2)
        heights = (expected - np.sum(self.stem[None] * across, axis=2)) / self.stem_sigma
        return corners, heights, self._pitch_residuals(x, a, normal, lift)

    def _pitch_residuals(self, x: Floats, a: Floats, normal: Floats, lift: Floats) -> Floats:
        if not self.runs:
            return np.zeros((len(x), 0))
        pitch = self.m.pitch_m * np.exp(x[:, POSE + self.k + 2])
        out = np.empty((len(x), len(self.runs)))
        for i, (centres, sigma, weights) in enumerate(self.runs):
            depth = lift / (normal[:, :2] @ centres.T + normal[:, 2:])
            place = depth * (a[:, :2] @ centres.T + a[:, 2:])  # metres along the row
            spread = np.sqrt(np.sum(weights**2 * (depth[0] ** 2 * sigma**2 / 2 + self.m.pitch_jitter_m**2)))
            out[:, i] = (place @ weights - pitch) / spread
        return out

    def linearise(self, x: Floats) -> _State | None:
        """Cost, Gauss-Newton matrix and gradient at x (p,); None when not finite."""
        p = len(x)
        batch = np.repeat(x[None], p + 1, axis=0)
        batch[np.arange(1, p + 1), np.arange(p)] += _STEP
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            corners, heights, pitch = self.residuals(batch)
        corner2 = np.sum(corners[0] ** 2, axis=1)
        weights = [np.repeat(1 / (1 + corner2 / _CORNER_C**2), 2), 1 / (1 + heights[0] ** 2 / _GLYPH_C**2),
                   1 / (1 + pitch[0] ** 2 / _GLYPH_C**2)]
        cost = _CORNER_C**2 * float(np.sum(np.log1p(corner2 / _CORNER_C**2)))
        for r in (heights[0], pitch[0]):
            cost += _GLYPH_C**2 * float(np.sum(np.log1p(r**2 / _GLYPH_C**2)))
        r = np.concatenate([corners.reshape(p + 1, -1), heights, pitch], axis=1)
        if not np.isfinite(r).all():
            return None
        w = np.concatenate(weights)
        jacobian = (r[1:] - r[0]).T / _STEP
        weighted = jacobian * w[:, None]
        data = weighted.T @ jacobian
        off = x - self.m.mean
        pull = self.m.information @ off
        return _State(cost + float(off @ pull), data + self.m.information, weighted.T @ r[0] + pull, data,
                      float(w @ r[0] ** 2), float(w.sum()))

    def finish(self, x: Floats, state: _State) -> Fit | None:
        if not np.isfinite(x).all() or abs(x[YAW]) > 1.4 or abs(x[LEAN]) > 1.2:
            return None
        inverse = np.linalg.inv(state.normal)
        # Noise larger than stated (blur, bad edges) shows in the residuals: scale it, never below what was stated.
        excess = max(1.0, (state.chi2 + _PRIOR_DOF) / (state.weight + _PRIOR_DOF)) if state.weight > 0 else 1.0
        noise = inverse @ state.data @ inverse * excess
        prior = inverse @ self.m.information @ inverse
        sign, logdet = np.linalg.slogdet(state.normal)
        prior_logdet = np.linalg.slogdet(self.m.information)[1]
        evidence = -0.5 * state.cost + 0.5 * (prior_logdet - (logdet if sign > 0 else 0.0))
        return Fit(x=x, noise=noise, prior=prior, cost=state.cost, evidence=float(evidence), glyphs_used=len(self.glyph),
                   corners_used=len(self.corner), pitch_used=bool(self.runs))


def axes(yaw_rad: Floats, lean_rad: Floats, roll_rad: Floats) -> tuple[Floats, Floats, Floats]:
    """Columns (b, 3) of turn_right(yaw) @ turn_down(lean) @ turn_clockwise(roll): plate's right, down and away."""
    cy, sy, cl, sl, cr, sr = (f(v) for v in (yaw_rad, lean_rad, roll_rad) for f in (np.cos, np.sin))
    right = np.stack([cy * cr - sy * sl * sr, cl * sr, -sy * cr - cy * sl * sr], axis=1)
    down = np.stack([-cy * sr - sy * sl * cr, cl * cr, sy * sr - cy * sl * cr], axis=1)
    away = np.stack([sy * cl, sl, cy * cl], axis=1)
    return right, down, away
