"""Kinematics of ego, other vehicles and the road: pure functions of time, SI units, no pixels."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from tmde_edge.simulation.camera import Array
from tmde_edge.simulation.ground import RoadAhead

Keys = tuple[tuple[float, float], ...]  # (time or place, value), increasing

_AHEAD_M = np.concatenate(
    [np.arange(-14.0, 60.0, 0.5), np.arange(60.0, 240.0, 2.0), np.geomspace(240.0, 2500.0, 60)]
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Travel along the road: start, speed, and accelerations each from its time on; a stopped vehicle stays."""

    start_m: float
    speed_mps: float
    accels: Keys = ()  # (from t_s, m/s^2)

    def state(self, t_s: float) -> tuple[float, float, float]:
        """Place (m), speed (m/s) and acceleration (m/s^2) at a time; before 0 the first speed held."""
        s, v, a, at = self.start_m, self.speed_mps, 0.0, 0.0
        if t_s <= 0.0:
            return s + v * t_s, v, 0.0
        for begin, accel in (*self.accels, (np.inf, 0.0)):
            until = min(begin, t_s)
            if until > at:
                s, v, stopped = _advance(s, v, a, until - at)
                a = 0.0 if stopped else a
                at = until
            if begin > t_s:
                break
            a = accel if v > 0 or accel > 0 else 0.0
        return s, v, a


def _advance(s: float, v: float, a: float, dt_s: float) -> tuple[float, float, bool]:
    if a < 0 and v + a * dt_s <= 0:
        return s + v * v / (-2 * a), 0.0, True
    return s + v * dt_s + 0.5 * a * dt_s * dt_s, v + a * dt_s, False


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """Travel as it was recorded: times and speeds, places by integration."""

    t_s: tuple[float, ...]
    speed_mps: tuple[float, ...]
    place_m: tuple[float, ...]

    def state(self, t_s: float) -> tuple[float, float, float]:
        """Place, speed and acceleration, piecewise linear in speed."""
        k = int(np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2))
        dt = self.t_s[k + 1] - self.t_s[k]
        a = (self.speed_mps[k + 1] - self.speed_mps[k]) / dt
        h = t_s - self.t_s[k]
        return self.place_m[k] + self.speed_mps[k] * h + 0.5 * a * h * h, self.speed_mps[k] + a * h, a


def recorded(t_s: Array, speed_mps: Array, start_m: float = 0.0) -> Recorded:
    """Travel from speed samples, trapezoidal places."""
    place = start_m + np.concatenate([[0.0], np.cumsum(0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(t_s))])
    return Recorded(t_s=tuple(map(float, t_s)), speed_mps=tuple(map(float, speed_mps)), place_m=tuple(map(float, place)))


def eased(keys: Keys, at: float) -> float:
    """Value between keys, with a smooth (cosine) passage; held outside."""
    if not keys:
        return 0.0
    if at <= keys[0][0]:
        return keys[0][1]
    for (t0, v0), (t1, v1) in pairwise(keys):
        if at <= t1:
            share = 0.5 - 0.5 * np.cos(np.pi * (at - t0) / (t1 - t0))
            return float(v0 + (v1 - v0) * share)
    return keys[-1][1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Road:
    """Curvature (1/m, right positive) and elevation (m) along the arc length; keys are eased between."""

    curvature: Keys = ()
    elevation: Keys = ()

    def curvature_at(self, s_m: Array) -> Array:
        """Linear between keys, held outside."""
        if not self.curvature:
            return np.zeros_like(s_m)
        s, k = zip(*self.curvature, strict=True)
        return np.asarray(np.interp(s_m, s, k), np.float64)

    def elevation_at(self, s_m: Array) -> Array:
        """Smooth between keys, held outside."""
        if not self.elevation:
            return np.zeros_like(s_m)
        return np.array([eased(self.elevation, float(s)) for s in np.atleast_1d(s_m)])


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The road round the ego at one instant, in the level frame (x right, y down from the lens, z forward)."""

    s_rel_m: Array = field(repr=False)
    x_m: Array = field(repr=False)
    z_m: Array = field(repr=False)
    down_m: Array = field(repr=False)
    heading_rad: Array = field(repr=False)
    s_m: float = 0.0
    azimuth_rad: float = 0.0  # of the ego's heading, right positive, for what is infinitely far
    slope: float = 0.0  # of the road under the ego, up positive

    def place(self, s_m: float, lateral_m: float) -> tuple[float, float, float, float]:
        """x, down, z and heading of a point on the road at an arc length and lateral place (0: lane middle)."""
        rel = s_m - self.s_m
        x, z, down, heading = (
            float(np.interp(rel, self.s_rel_m, v)) for v in (self.x_m, self.z_m, self.down_m, self.heading_rad)
        )
        return x + lateral_m * np.cos(heading), down, z - lateral_m * np.sin(heading), heading

    def ahead(self) -> RoadAhead:
        """What the ground painter needs: the part in front, monotonic in z."""
        keep = self.z_m > 0.4
        z = np.maximum.accumulate(self.z_m[keep])
        rising = np.concatenate([[True], np.diff(z) > 1e-6])
        use = np.flatnonzero(keep)[rising]
        return RoadAhead(
            z_m=self.z_m[use], x_m=self.x_m[use], down_m=self.down_m[use], s_m=self.s_m + self.s_rel_m[use],
            horizon_x_m=self.azimuth_rad,
        )


def surroundings(
    road: Road, s_m: float, lateral_m: float, heading_rad: float, camera_height_m: float
) -> Surroundings:
    """The road as seen from a place on it; heading is the ego's against the road's tangent, right positive."""
    rel = _AHEAD_M
    zero = int(np.searchsorted(rel, 0.0))
    if road.curvature:
        middle = s_m + 0.5 * (rel[1:] + rel[:-1])
        step = np.diff(rel)
        theta = np.concatenate([[0.0], np.cumsum(road.curvature_at(middle) * step)])
        theta -= theta[zero]
        between = 0.5 * (theta[1:] + theta[:-1])
        x = np.concatenate([[0.0], np.cumsum(np.sin(between) * step)])
        z = np.concatenate([[0.0], np.cumsum(np.cos(between) * step)])
        x, z = x - x[zero], z - z[zero]
        whole = np.linspace(0.0, s_m, max(2, int(abs(s_m)) + 2))
        kappa = road.curvature_at(whole)
        azimuth = float(np.sum(0.5 * (kappa[1:] + kappa[:-1]) * np.diff(whole)))
    else:
        theta, x, z, azimuth = np.zeros_like(rel), np.zeros_like(rel), rel.copy(), 0.0
    x = x - lateral_m
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    x, z = c * x - s * z, s * x + c * z
    slope = 0.0
    down = np.full_like(rel, camera_height_m)
    if road.elevation:
        slope = float(np.diff(road.elevation_at(np.array([s_m - 0.5, s_m + 0.5])))[0])
        here = float(road.elevation_at(np.array([s_m]))[0])
        down = camera_height_m - (road.elevation_at(s_m + rel) - here - slope * rel)
    return Surroundings(rel, x, z, down, theta - heading_rad, s_m, azimuth + heading_rad, slope)


def ttc_counting_accel(
    gap_m: float, ego_speed_mps: float, ego_accel_mps2: float, lead_speed_mps: float, lead_accel_mps2: float
) -> float | None:
    """Time until the gap is gone if both keep their accelerations, a braking vehicle standing once it has stopped.

    The smallest t > 0 with gap + rate t + accel t^2 / 2 = 0 (NHTSA FCW: the lead's braking counts); None: never.
    """
    if gap_m <= 0:
        return 0.0
    t, gap = 0.0, gap_m
    # accelerations below 1e-6 m/s^2 move nothing within an hour
    both = [[v, a if abs(a) > 1e-6 else 0.0] for v, a in ((ego_speed_mps, ego_accel_mps2), (lead_speed_mps, lead_accel_mps2))]
    for _ in range(3):
        for one in both:
            if one[0] <= 1e-9 and one[1] < 0:
                one[:] = [0.0, 0.0]
        (ve, ae), (vl, al) = both
        until = min([-v / a for v, a in both if a < 0], default=np.inf)
        hit = _first_zero(gap, vl - ve, al - ae)
        if hit is not None and hit <= until + 1e-9:
            return t + hit
        if not np.isfinite(until):
            return None
        gap += (vl - ve) * until + 0.5 * (al - ae) * until**2
        t += until
        for one in both:
            one[0] = max(one[0] + one[1] * until, 0.0)
            if one[0] < 1e-6 and one[1] < 0:
                one[:] = [0.0, 0.0]
    return None


def _first_zero(gap_m: float, rate_mps: float, accel_mps2: float) -> float | None:
    """Smallest t > 0 with gap + rate t + accel t^2 / 2 = 0."""
    if abs(accel_mps2) < 1e-9:
        return -gap_m / rate_mps if rate_mps < -1e-9 else None
    root = rate_mps**2 - 2 * accel_mps2 * gap_m
    if root < 0:
        return None
    found = [t for t in ((-rate_mps + sign * np.sqrt(root)) / accel_mps2 for sign in (-1, 1)) if t > 0]
    return float(min(found)) if found else None
