"""The range filter of one lead candidate: distance, speed and acceleration along the own path.

State (3,): distance D (m), speed v (m/s), acceleration a (m/s2). With ego speed known, v and a are the lead's own over
ground and the distance changes by v minus what we travelled; without it they are relative (ego travel 0).
A fourth state is the relative error b of distances by depth: it hangs together over seconds, so readings of a network
are no independent measurements. It is learnt while the plate is seen, and costs nothing while no depth comes.
A fifth is D as it was at an anchor in the past (a stochastic clone: S. Roumeliotis, J. Burdick, ICRA 2002), so that
growth of the image since then, ratio = D_anchor / D, is one exact linear measurement with all correlations.
Process: Singer's exponentially correlated acceleration (R. A. Singer, IEEE T-AES 6(4), 1970), da/dt = -a/tau + w,
discretised exactly, so two steps of 0.1 s are one of 0.2 s. Model "cv" is the paper's [D, v] with white acceleration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from tmde_edge.tracking.settings import TrackerSettings

Matrix = NDArray[np.float64]
RESTART_SPEED_SIGMA_MPS = 1.0  # of a speed that starts anew, beside the growth's own


@lru_cache(maxsize=512)
def transition(model: str, dt_s: float, accel_sigma_mps2: float, accel_tau_s: float) -> tuple[Matrix, Matrix]:
    """F and Q (3, 3) of one step, by Van Loan's method (IEEE T-AC 23(3), 1978) with a Taylor series.

    cv: accel_sigma_mps2^2 is the spectral density of white acceleration (m2/s3). A step beyond 0.25 s is composed of halves.
    """
    if dt_s > 0.25:
        f, q = transition(model, dt_s / 2, accel_sigma_mps2, accel_tau_s)
        return f @ f, f @ q @ f.T + q
    a = np.zeros((3, 3))
    g = np.zeros((3, 3))
    a[0, 1] = 1.0
    if model == "singer":
        a[1, 2] = 1.0
        a[2, 2] = -1.0 / accel_tau_s
        g[2, 2] = 2.0 * accel_sigma_mps2**2 / accel_tau_s
    else:
        g[1, 1] = accel_sigma_mps2**2
    block = np.zeros((6, 6))
    block[:3, :3] = -a
    block[:3, 3:] = g
    block[3:, 3:] = a.T
    block *= dt_s
    total = term = np.eye(6)
    for k in range(1, 20):
        term = term @ block / k
        total = total + term
    f = total[3:, 3:].T
    q = f @ total[:3, 3:]
    return f, (q + q.T) / 2


JUMP_SPEED_MPS = 1.0  # how far a speed may be off after its ranges have jumped: hard braking while they were not believed


@dataclass(frozen=True, slots=True, kw_only=True)
class Innovation:
    """What a measurement said against the prediction."""

    residual: float
    sigma: float  # of the residual
    accepted: bool


class RangeFilter:
    """One track's filter. Wraps filterpy's KalmanFilter (the only user of filterpy)."""

    def __init__(
        self, settings: TrackerSettings, *, distance_m: float, noise_m: float, ego_speed_mps: float | None = None
    ) -> None:
        self._s = settings
        self._kf = KalmanFilter(dim_x=5, dim_z=1)
        self._anchor_ns: int | None = None
        self._ego_speed_mps = ego_speed_mps
        self._rejected: list[float] = []
        self.closing_doubted = True  # until growth of the image has confirmed it: a few first ranges tell little
        self._depth_sigma = 0.0  # of the lasting error, as the readings tell it; none has come yet
        self._start(distance_m, noise_m)

    def _start(self, distance_m: float, noise_m: float) -> None:
        accel = self._s.accel_sigma_mps2 if self._s.model == "singer" else 0.0
        # Vehicles ahead mostly move about as fast as we do: begin with no closing and a wide sigma.
        speed = self._ego_speed_mps or 0.0
        self._kf.x = np.array([[distance_m], [speed], [0.0], [0.0], [distance_m]])
        initial = (noise_m, self._s.initial_speed_sigma_mps, accel, self._depth_sigma, 0.0)
        self._kf.P = np.diag(np.square(initial))
        self._anchor_ns = None

    def _jump(self, distance_m: float, noise_m: float) -> None:
        """The ranges agree on another distance. A vehicle does not jump: its measure changed, its speed hardly."""
        speed, variance = float(self._kf.x[1, 0]), float(self._kf.P[1, 1])
        self._start(distance_m, noise_m)
        self._kf.x[1, 0] = speed
        self._kf.P[1, 1] = min(variance + JUMP_SPEED_MPS**2, self._s.initial_speed_sigma_mps**2)

    def predict(self, dt_s: float, ego_travel_m: float = 0.0, ego_travel_sigma_m: float = 0.0) -> None:
        """Moves the state on by dt_s >= 0; ego_travel_m is what the own vehicle covered in it."""
        if dt_s <= 0:
            return
        sigma = self._s.accel_sigma_mps2 if self._s.model == "singer" else self._s.cv_accel_sigma_mps2
        fade = math.exp(-dt_s / self._s.depth_error_tau_s)
        f, q = np.diag([1.0, 1.0, 1.0, fade, 1.0]), np.zeros((5, 5))
        q[3, 3] = (1.0 - fade**2) * self._depth_sigma**2
        f[:3, :3], q[:3, :3] = transition(self._s.model, round(dt_s, 9), sigma, self._s.accel_tau_s)
        self._kf.predict(F=f, Q=q)
        if self._ego_speed_mps is not None:
            self._kf.x[0, 0] -= ego_travel_m
            self._kf.P[0, 0] += ego_travel_sigma_m**2

    def set_ego_speed(self, ego_speed_mps: float | None) -> None:
        """Says how fast we are now; a change between known and unknown re-expresses the state."""
        if (ego_speed_mps is None) != (self._ego_speed_mps is None):
            self._kf.x[1, 0] += ego_speed_mps if ego_speed_mps is not None else -(self._ego_speed_mps or 0.0)
        self._ego_speed_mps = ego_speed_mps

    def update_range(self, distance_m: float, noise_m: float, *, guessed: bool = False) -> Innovation:
        """One range with its per-frame noise; outside the gate it is not used, unless several in a row agree.

        `guessed`: of an outline that was only carried along; its error is the same in every frame, so agreeing is no proof.
        """
        r = noise_m**2
        s = float(self._kf.P[0, 0]) + r
        y = distance_m - float(self._kf.x[0, 0])
        sigma = s**0.5
        n = abs(y) / sigma
        if n > self._s.gate_sigma:
            if guessed:
                return Innovation(residual=y, sigma=sigma, accepted=False)
            self._rejected.append(distance_m)
            recent = self._rejected[-self._s.gate_rejects :]
            if len(recent) == self._s.gate_rejects and max(recent) - min(recent) < 8 * noise_m + 0.05 * distance_m:
                self._rejected.clear()
                self._jump(distance_m, noise_m)
                return Innovation(residual=y, sigma=sigma, accepted=True)
            return Innovation(residual=y, sigma=sigma, accepted=False)
        self._rejected.clear()
        r = _huber(r, s, n)
        self._kf.update(np.array([[distance_m]]), R=np.array([[r]]), H=np.array([[1.0, 0.0, 0.0, 0.0, 0.0]]))
        return Innovation(residual=y, sigma=sigma, accepted=True)

    def set_anchor(self, t_ns: int) -> None:
        """Remembers the present distance, with its correlations, for growth that starts now."""
        self._kf.x[4] = self._kf.x[0]
        self._kf.P[4, :] = self._kf.P[0, :]
        self._kf.P[:, 4] = self._kf.P[:, 0]
        self._anchor_ns = t_ns

    def update_growth(self, ratio: float, sigma: float, t_from_ns: int) -> Innovation | None:
        """Image size now / at the anchor says D = D_anchor / ratio; None where the anchor is of another time."""
        if self._anchor_ns != t_from_ns:
            return None
        h = np.array([[1.0, 0.0, 0.0, 0.0, -1.0 / ratio]])
        r = (float(self._kf.x[4, 0]) / ratio * sigma / ratio) ** 2
        y = -(h @ self._kf.x).item()
        s = (h @ self._kf.P @ h.T).item() + r
        n = abs(y) / s**0.5
        if n > self._s.gate_sigma:
            return Innovation(residual=y, sigma=s**0.5, accepted=False)
        self._kf.update(np.array([[0.0]]), R=np.array([[_huber(r, s, n)]]), H=h)
        return Innovation(residual=y, sigma=s**0.5, accepted=True)

    def update_inverse_ttc(self, rate_per_s: float, sigma_per_s: float) -> Innovation:
        """Closing from scale change: rate = d(ln D)/dt = v_rel / D, free of metric knowledge."""
        d = float(self._kf.x[0, 0])
        z = rate_per_s * d + (self._ego_speed_mps or 0.0)
        r = (sigma_per_s * d) ** 2
        y = z - float(self._kf.x[1, 0])
        sigma = (float(self._kf.P[1, 1]) + r) ** 0.5
        if abs(y) > self._s.gate_sigma * sigma:
            return Innovation(residual=y, sigma=sigma, accepted=False)
        r = _huber(r, sigma**2, abs(y) / sigma)
        self._kf.update(np.array([[z]]), R=np.array([[r]]), H=np.array([[0.0, 1.0, 0.0, 0.0, 0.0]]))
        return Innovation(residual=y, sigma=sigma, accepted=True)

    def restart_closing(self, rate_per_s: float, sigma_per_s: float) -> None:
        """The speed starts anew from growth of the image (v_rel / D = rate): what it was made of was wrong."""
        d = float(self._kf.x[0, 0])
        self._kf.x[1, 0] = rate_per_s * d + (self._ego_speed_mps or 0.0)
        self._kf.x[2, 0] = 0.0
        accel = self._s.accel_sigma_mps2 if self._s.model == "singer" else 0.0
        for i, variance in ((1, (2 * sigma_per_s * d) ** 2 + RESTART_SPEED_SIGMA_MPS**2), (2, accel**2)):
            self._kf.P[i, :] = self._kf.P[:, i] = 0.0
            self._kf.P[i, i] = variance

    def update_depth(self, distance_m: float, sigma_m: float, age_s: float, travel_m: float) -> Innovation:
        """A distance by depth as of age_s ago, travel_m back: z = (D - v age + a age^2 / 2 + travel)(1 + b).

        All of sigma_m is taken as an error that lasts; only `depth_noise` is new in every reading.
        """
        d = float(self._kf.x[0, 0])
        back = np.array([1.0, -age_s, 0.5 * age_s**2])
        then_m = float(back @ self._kf.x[:3, 0]) + (travel_m if self._ego_speed_mps is not None else 0.0)
        relative = max(sigma_m / max(distance_m, 1e-3), self._s.depth_noise)
        self._kf.P[3, 3] += max(relative**2 - self._depth_sigma**2, 0.0)  # it is worse than it was: so is what was learnt
        self._depth_sigma = relative
        r = (self._s.depth_noise * then_m) ** 2
        bias = 1.0 + float(self._kf.x[3, 0])
        h = np.array([[*(back * bias), then_m, 0.0]])
        y = distance_m - then_m * bias
        s = float((h @ self._kf.P @ h.T)[0, 0]) + r
        sigma = s**0.5
        if d <= 0.0 or then_m <= 0.0 or abs(y) > self._s.gate_sigma * sigma:
            return Innovation(residual=y, sigma=sigma, accepted=False)
        r = _huber(r, s, abs(y) / sigma)
        self._kf.update(np.array([[y + float((h @ self._kf.x)[0, 0])]]), R=np.array([[r]]), H=h)
        return Innovation(residual=y, sigma=sigma, accepted=True)

    @property
    def distance_m(self) -> float:
        return float(self._kf.x[0, 0])

    @property
    def range_rate_mps(self) -> float:
        return float(self._kf.x[1, 0]) - (self._ego_speed_mps or 0.0)

    @property
    def lead_speed_mps(self) -> float | None:
        """Over ground; None while our own speed is unknown."""
        return float(self._kf.x[1, 0]) if self._ego_speed_mps is not None else None

    @property
    def accel_mps2(self) -> float:
        return float(self._kf.x[2, 0])

    @property
    def covariance(self) -> Matrix:
        """(3, 3) of D, v, a."""
        return np.array(self._kf.P[:3, :3], dtype=np.float64)


def _huber(r: float, s: float, n: float) -> float:
    """Variance of a measurement of variance r whose residual of variance s is n sigmas off: beyond 2 it counts less and less."""
    return r + s * (n / 2.0 - 1.0) if n > 2.0 else r
