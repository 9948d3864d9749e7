"""One joint robust fit of a plate's pose and of its true proportions to everything measured on it.

Parameters: heading, lean and roll of the plate in the vehicle's axes; bearing (u, v) of its centre; log distance; and
the logarithms of its true sizes over the standard's: glyph height of each class, plate width, plate height, pitch. The
sizes carry the standard's tolerances (and what the track has learned) as priors, so that one wrong size moves every
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
AFTER_CLASSES = 3  # sizes after those of the characters: width, height, pitch

STEP = 1e-6  # forward differences
_MAX_STEPS = 9
_CLOSE = 0.02  # expected fall of the cost at which the last step is taken unseen: 0.14 sigma
_GLYPH_C = 2.4  # Cauchy scale in sigmas: 95 % efficient on Gaussian noise
_CORNER_C = 3.0
_WILD = 5.0  # sigmas
_MOST_LENIENCE = 80.0  # cost
_NEW_IN_A_FRAME = 0.2  # share of the variance of errors common to one frame: most of it is the text's shapes, which stay
_PRIOR_DOF = 6.0  # residuals worse than stated must show on more than a few features before the noise is scaled
# How many times its stated sigma a side's tilt errs (1.6 to 2.1 rms at 80 to 120 px on rendered stills, with long tails).
_TILT_DOUBT = 3.0
_SIDES = ((0, 1, 1), (1, 2, 0), (3, 2, 1), (0, 3, 0))  # top, right, bottom, left: two corners, and which of x and y is across
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
    frame_bias: Floats
    tail_sigma: Floats
    tail_c: Floats


@dataclass(frozen=True, slots=True)
class Fit:
    """The optimum, its covariance in two parts and what it costs.

    noise: covariance from the image's noise; prior: from the sizes and angles that were assumed; data: information of the
    image alone; all (p, p).
    cost: -2 log posterior without constants. evidence: log marginal likelihood (Laplace), to compare standards by.
    """

    x: Floats
    noise: Floats
    prior: Floats
    data: Floats
    cost: float
    evidence: float
    glyphs_used: int
    corners_used: int
    pitch_used: bool
    strain: float  # cost a residual; well above 1 where something does not fit
    rejected: float  # share of the characters that the fit calls wild

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
        normal = state.normal.copy()
        normal[np.diag_indices(len(x))] *= 1 + damping
        step = np.linalg.solve(normal, -state.gradient)
        step *= min(1.0, 0.5 / float(np.abs(step).max() + 1e-12))
        if damping < 1e-2 and -float(state.gradient @ step) < _CLOSE:
            x = x + step  # quadratic convergence: what is left after this step is far below the noise
            break
        trial = problem.linearise(x + step)
        if trial is None or trial.cost > state.cost + 1e-9 * (1 + state.cost):
            damping = max(damping * 30, 1e-3)
            if damping > 1e4:
                break
            continue
        x, state = x + step, trial
        damping = max(damping * 0.1, 1e-9)
    return problem.finish(x, state)


@dataclass(frozen=True, slots=True)
class _State:
    cost: float
    normal: Floats
    gradient: Floats
    data: Floats  # J^T W J without the prior
    assumed: Floats  # the prior's information
    rejected: float


class _Problem:
    def __init__(self, features: Features, model: Model) -> None:
        self.f, self.m = features, model
        self.corner = np.flatnonzero(features.corner_ok)
        self.whiten = np.diag(1 / features.corners_sigma[self.corner].ravel())
        if features.by_side and len(self.corner) == 4:
            self.whiten = np.zeros((8, 8))
            for side, (a, b, xy) in enumerate(_SIDES):
                place, tilt = 2**-0.5 / features.side_sigma[side], 2**-0.5 / (_TILT_DOUBT * features.side_sigma[side])
                self.whiten[[2 * a + xy, 2 * b + xy], 2 * side] = place
                self.whiten[[2 * a + xy, 2 * b + xy], 2 * side + 1] = -tilt, tilt
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

    def residuals(self, x: Floats) -> Floats:
        """Residuals in sigmas for a batch (b, p) -> (b, m): corners (x, y each) or sides, glyph heights, pitches."""
        n, k = len(x), self.k
        right, down, away = axes(x[:, :3])
        size = np.exp(x[:, LOG_D:])  # distance, classes, width, height, pitch
        distance = size[:, :1]
        centre = np.ones((n, 3))
        centre[:, :2] = x[:, U : V + 1]
        off = corners_of(self.m, x, right, down)[:, self.corner] - self.f.corners[self.corner]
        corners = off.reshape(n, -1) @ self.whiten
        # Depth of the plane along a glyph's ray, then the image of one metre of its height across its row's direction.
        lift = np.sum(away * centre, axis=1, keepdims=True) * distance
        mx, my = self.middle[:, 0], self.middle[:, 1]
        depth = lift / (away[:, :1] * mx + away[:, 1:2] * my + away[:, 2:])
        row_x, row_y = right[:, :1] - mx * right[:, 2:], right[:, 1:2] - my * right[:, 2:]
        up_x, up_y = down[:, :1] - mx * down[:, 2:], down[:, 1:2] - my * down[:, 2:]
        height = (self.m.class_height_m * size[:, 1 : k + 1])[:, self.classes] / depth
        expected = height * (row_x * up_y - row_y * up_x) - (row_x * self.stem[:, 1] - row_y * self.stem[:, 0])
        heights = expected / (np.sqrt(row_x * row_x + row_y * row_y) * self.stem_sigma)
        parts = [corners, heights]
        pitch = self.m.pitch_m * size[:, k + 3]
        for centres, sigma, weights in self.runs:
            depth, place = on_plane(centres, lift, right, away)
            spread = np.sqrt(np.sum(weights**2 * (depth[0] ** 2 * sigma**2 / 2 + self.m.pitch_jitter_m**2)))
            parts.append(((place @ weights - pitch) / spread)[:, None])
        return np.concatenate(parts, axis=1)

    def linearise(self, x: Floats) -> _State | None:
        """Cost, Gauss-Newton matrix and gradient at x (p,); None when not finite."""
        batch = nudged(x)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            r = self.residuals(batch)
        if not np.isfinite(r).all():
            return None
        now = r[0]
        # Cauchy: a corner's two coordinates, or a side's place and tilt, are one observation: they share its weight.
        c = 2 * len(self.corner)
        squares = now * now
        pairs = squares[:c].reshape(-1, 2).sum(axis=1)
        w = 1 / (1 + np.concatenate([np.repeat(pairs, 2) / _CORNER_C**2, squares[c:] / _GLYPH_C**2]))
        logs = -np.log(w)
        cost = _CORNER_C**2 * float(logs[:c:2].sum()) + _GLYPH_C**2 * float(logs[c:].sum())
        jacobian = (r[1:] - now) * (1 / STEP)  # transposed: (p, m)
        weighted = jacobian * w
        data = weighted @ jacobian.T
        off, slope = self._tailed(x - self.m.mean)
        assumed = self.m.information * slope[:, None] * slope
        pull = slope * (self.m.information @ off)
        cost += float(off @ self.m.information @ off)
        glyphs = squares[c : c + len(self.glyph)]
        rejected = float(np.mean(glyphs > _WILD**2)) if len(glyphs) else 0.0
        return _State(cost, data + assumed, weighted @ now + pull, data, assumed, rejected)

    def _tailed(self, off: Floats) -> tuple[Floats, Floats]:
        """Deviations from the prior's mean as a Gaussian prior with long tails sees them, and their slope (p,).

        Squaring phi = sigma c sqrt(log(1 + z^2 / c^2)) gives Cauchy's cost. Most plates ahead face us, a parked one may
        stand anyhow; most outlines are where the plate ends, a few follow something else.
        """
        z = np.abs(off) / self.m.tail_sigma
        c = self.m.tail_c
        logs = np.log1p((z / c) ** 2)
        far = z > 1e-4
        root = np.sqrt(np.where(far, logs, 1.0))
        phi = np.where(far, np.sign(off) * self.m.tail_sigma * c * root, off)
        slope = np.where(far, z / (c * (1 + (z / c) ** 2) * root), 1.0)
        return phi, slope

    def finish(self, x: Floats, state: _State) -> Fit | None:
        if not np.isfinite(x).all() or abs(x[YAW]) > 1.4 or abs(x[LEAN]) > 1.2:
            return None
        inverse = np.linalg.inv(state.normal)
        # Residuals larger than stated (blur, bad edges) widen the noise (Birge's ratio); smaller ones narrow nothing.
        count = 2 * len(self.corner) + len(self.glyph) + len(self.runs)
        strain = state.cost / max(count, 1)
        excess = max(1.0, (state.cost + _PRIOR_DOF) / (count + _PRIOR_DOF))
        noise = inverse @ state.data @ inverse * excess
        prior = inverse @ state.assumed @ inverse
        # Edge errors that one frame's features share come partly new with the next frame: the grid has moved on.
        spread = inverse @ state.assumed[:, POSE:]
        moving = _NEW_IN_A_FRAME * spread @ self.m.frame_bias @ spread.T
        noise, prior = noise + moving, prior - moving
        # Standards are compared without the outline's long tails: those are for blunders, not for other standards.
        outline = slice(POSE + self.k, POSE + self.k + 2)
        z = (x - self.m.mean)[outline] / self.m.tail_sigma[outline]
        tamed = self._tailed(x - self.m.mean)[0][outline] / self.m.tail_sigma[outline]
        lenience = min(float(z @ z - tamed @ tamed), _MOST_LENIENCE)
        sign, logdet = np.linalg.slogdet(state.data + self.m.information)
        prior_logdet = np.linalg.slogdet(self.m.information)[1]
        evidence = -0.5 * (state.cost + lenience) + 0.5 * (prior_logdet - (logdet if sign > 0 else 0.0))
        return Fit(
            x=x, noise=noise, prior=prior, data=state.data, cost=state.cost, evidence=float(evidence),
            glyphs_used=len(self.glyph), corners_used=len(self.corner), pitch_used=bool(self.runs), rejected=state.rejected,
            strain=strain,
        )


def nudged(x: Floats) -> Floats:
    """x (p,) and, below it, x with one parameter after the other a STEP larger: (p + 1, p)."""
    p = len(x)
    batch = np.repeat(x[None], p + 1, axis=0)
    batch[np.arange(1, p + 1), np.arange(p)] += STEP
    return batch


def on_plane(points: Floats, lift: Floats, right: Floats, away: Floats) -> tuple[Floats, Floats]:
    """Depths (b, n) of image points (n, 2) on planes of offset lift (b, 1), and where along right they lie there; metres."""
    depth = lift / (away[:, :2] @ points.T + away[:, 2:])
    return depth, depth * (right[:, :2] @ points.T + right[:, 2:])


def corners_of(model: Model, x: Floats, right: Floats, down: Floats) -> Floats:
    """Corners (b, 4, 2) TL, TR, BR, BL of the plate in the image, at x (b, p) whose axes are right and down."""
    k = len(model.class_height_m)
    size = np.exp(x[:, POSE + k : POSE + k + 2] - x[:, LOG_D : LOG_D + 1])
    centre, spans = np.ones((len(x), 1, 3)), np.empty((len(x), 2, 3))
    centre[:, 0, :2] = x[:, U : V + 1]
    spans[:, 0], spans[:, 1] = right * (model.width_m * size[:, :1]), down * (model.height_m * size[:, 1:])
    points = _SIGNS @ spans + centre
    out: Floats = points[:, :, :2] / points[:, :, 2:]
    return out


def axes(angles: Floats) -> tuple[Floats, Floats, Floats]:
    """Columns (b, 3) of turn_right(yaw) @ turn_down(lean) @ turn_clockwise(roll): plate's right, down and away."""
    cos, sin = np.cos(angles).T, np.sin(angles).T
    (cy, cl, cr), (sy, sl, sr) = cos, sin
    out = np.empty((3, 3, len(angles)))
    out[0] = cy * cr - sy * sl * sr, cl * sr, -sy * cr - cy * sl * sr
    out[1] = -cy * sr - sy * sl * cr, cl * cr, sy * sr - cy * sl * cr
    out[2] = sy * cl, sl, cy * cl
    return out[0].T, out[1].T, out[2].T
