"""Do the measured distances shrink as far as we travel? What stands tells whether focal length, plate size and speed agree.

Towards something that stands D = D0 - s / k after s metres of own travel: k = true focal length / configured one (a wrong
size or a wrong speed signal look the same). A vehicle that drives at u adds u t. Each track is fitted as
D = D0 + u t - r s with u known to be near zero a priori (parked things do not creep): where our own speed changes, r and u
separate by themselves; where it does not, one track says less and several must agree. Moving leads are left out: their u is not
near zero, their r is far from one, or the halves of their run disagree.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_EVERY_NS = 100_000_000
_SAMPLES = 120  # of a track: 12 s
_LEAST_SAMPLES = 10
_LEAST_TRAVEL_M = 8.0
_LEAST_APPROACH = 1.5  # first distance over last: a bias that does not grow with distance stays small then
_LEAST_SPEED_MPS = 3.0  # mean over the run: creeping is what others do in a jam
_CREEP_MPS = 0.4  # sigma of the speed of what stands, a priori
_MOST_CREEP_MPS = 0.8
_MOST_OFF = 0.25  # more than this is no calibration, it drives
_PLATE_SIGMA = 0.012  # of one plate: its own size, and errors of its measurement that change with distance
_TURN_RADPS = 0.06  # in a bend distance along the axis is not travel
_TRACKS = 12  # the last ones count
_RAISE, _RAISE_SIGMAS, _CLEAR, _SURE = 0.025, 2.5, 0.015, 0.022


@dataclass(slots=True)
class _Run:
    """What one track said so far."""

    t0_ns: int
    last_ns: int
    travelled_m: float = 0.0
    # t, s, D, its noise and its scale sigma
    samples: deque[tuple[float, float, float, float, float]] = field(default_factory=lambda: deque(maxlen=_SAMPLES))


@dataclass(frozen=True, slots=True, kw_only=True)
class Mismatch:
    """How far true focal length over configured one is from 1, as it looks, with its sigma; from how many vehicles."""

    off: float
    sigma: float
    vehicles: int

    @property
    def text(self) -> str:
        """For people."""
        which = "larger" if self.off > 0 else "smaller"
        return (
            f"focal length looks {100 * abs(self.off):.0f} % off ({which} than configured; {self.vehicles} standing vehicles, "
            f"sigma {100 * self.sigma:.1f} %), or the speed signal or the plates' sizes are"
        )


class TravelCheck:
    """Fed with ranges and own travel; `mismatch` is what stands out of it, or None."""

    def __init__(self) -> None:
        self._runs: dict[int, _Run] = {}
        self._verdicts: deque[tuple[int, float, float]] = deque(maxlen=_TRACKS)  # track, off, sigma
        self.mismatch: Mismatch | None = None

    def add(
        self, track_id: int, t_ns: int, distance_m: float, noise_m: float, scale_sigma: float, travel_m: float,
        yaw_rate_radps: float | None,
    ) -> None:
        """One range of a track with its noise and the relative sigma that its frames share; travel_m since its last one."""
        run = self._runs.get(track_id)
        if yaw_rate_radps is not None and abs(yaw_rate_radps) > _TURN_RADPS:
            self._runs.pop(track_id, None)
            return
        if run is None or t_ns - run.last_ns > 1_000_000_000:
            run = self._runs[track_id] = _Run(t_ns, t_ns)
        else:
            run.travelled_m += travel_m
        run.last_ns = t_ns
        if not run.samples or t_ns - run.t0_ns - round(run.samples[-1][0] * 1e9) >= _EVERY_NS - 2_000_000:
            run.samples.append(((t_ns - run.t0_ns) * 1e-9, run.travelled_m, distance_m, noise_m, scale_sigma))
            if len(run.samples) % 5 == 0:
                self._judge(track_id, run)

    def forget(self, alive: set[int]) -> None:
        """Ends the runs of tracks that are no more; their verdicts stay."""
        self._runs = {k: v for k, v in self._runs.items() if k in alive}

    def _judge(self, track_id: int, run: _Run) -> None:
        values = np.array(run.samples)
        found = standing_fit(values)
        self._verdicts = deque((v for v in self._verdicts if v[0] != track_id), maxlen=_TRACKS)
        if found is not None:
            self._verdicts.append((track_id, *found))
        self.mismatch = self._conclude()

    def _conclude(self) -> Mismatch | None:
        """What lasts: raised from 2.5 % that stand out by 2.5 sigma, kept until below 1.5 %."""
        if not self._verdicts:
            return None
        off = np.array([v[1] for v in self._verdicts])
        weight = 1.0 / np.array([v[2] for v in self._verdicts]) ** 2
        mean, sigma = float(np.sum(weight * off) / weight.sum()), float(weight.sum() ** -0.5)
        if len(off) > 1:  # tracks that disagree say less
            sigma *= max(1.0, math.sqrt(float(np.sum(weight * (off - mean) ** 2)) / (len(off) - 1)))
        least = _CLEAR if self.mismatch is not None else max(_RAISE, _RAISE_SIGMAS * sigma)
        if self.mismatch is None and sigma > _SURE:  # one vehicle that creeps looks like that too
            return None
        return Mismatch(off=mean, sigma=sigma, vehicles=len(off)) if abs(mean) > least else None


def standing_fit(values: Floats) -> tuple[float, float] | None:
    """(off, sigma) from a run (n, 5) of t_s, travel_m, distance_m, noise_m, scale_sigma; None where it says nothing or drives."""
    if len(values) < _LEAST_SAMPLES:
        return None
    t, s, d, _, _ = values.T
    if s[-1] - s[0] < _LEAST_TRAVEL_M or d[0] < _LEAST_APPROACH * d[-1] or s[-1] - s[0] < _LEAST_SPEED_MPS * (t[-1] - t[0]):
        return None
    whole = _fit(values)
    half = len(values) // 2
    first, second = _fit(values[:half]), _fit(values[half:])
    if whole is None or first is None or second is None:
        return None
    r, sigma_r, u, sigma_u = whole
    if abs(u) > max(_MOST_CREEP_MPS, 2.0 * sigma_u) or abs(u) > 1.0 or abs(r - 1.0) > _MOST_OFF:
        return None
    if abs(first[0] - second[0]) > 3.0 * math.hypot(first[1], second[1]) + 0.03:
        return None
    return 1.0 / r - 1.0, math.hypot(sigma_r / r**2, _PLATE_SIGMA)


def _fit(values: Floats) -> tuple[float, float, float, float] | None:
    """r, its sigma, u, its sigma of D = D0 + u t - r s + b g, with the prior on u; sigmas grow where the residuals do.

    A small plate's ranges share an error that ends as it grows (b ~ 1 sigma of it, g, in two shapes): only what is left at
    the end scales the whole run, as a wrong focal length does.
    """
    t, s, d, noise, scale = values.T
    passing = d * np.sqrt(np.maximum(scale**2 - scale.min() ** 2, 0.0))
    # errors of edges last over some frames: neighbours say the same thing
    sigma = np.maximum(noise, 0.003 * d) * 1.5
    design = np.column_stack([np.ones_like(t), t, -s, passing, passing * d / d.max()]) / sigma[:, None]
    normal = design.T @ design
    normal[1, 1] += 1.0 / _CREEP_MPS**2
    normal[3, 3] += 1.0
    normal[4, 4] += 1.0
    try:
        covariance = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return None
    x = covariance @ (design.T @ (d / sigma))
    residual = d / sigma - design @ x
    scale = max(1.0, float(residual @ residual) / max(len(t) - 3, 1))
    if not np.isfinite(x).all() or not np.isfinite(covariance).all() or covariance[2, 2] <= 0 or covariance[1, 1] <= 0:
        return None
    return float(x[2]), math.sqrt(scale * float(covariance[2, 2])), float(x[1]), math.sqrt(float(covariance[1, 1]))
