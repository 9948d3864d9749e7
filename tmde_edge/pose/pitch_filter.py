"""The pitch of the camera about its rest, from absolute sightings and from the picture's movement: a linear Kalman filter.

State (rad, rad/s): body pitch p and its rate r (a damped oscillator: the car on its springs), slow offset b (load, braking,
a slope that begins), rate s at which the road itself turns, and the pitch q at the frame before. A sighting measures p + b, a
movement between frames p + b + s dt - q: what the road turns is no pitch against the road. Every part is driven by white
noise that keeps its stationary variance, so any step is exact and long silence leads back to rest.
"""

from __future__ import annotations

import math

import numpy as np

from tmde_edge.pose.edges import FloatArray

_BODY, _RATE, _OFFSET, _ROAD, _BEFORE = range(5)


class PitchFilter:
    """Zero is the resting pitch; positive nose down."""

    def __init__(
        self,
        *,
        spread_rad: float,
        natural_radps: float,
        damping: float,
        offset_rad: float,
        offset_time_s: float,
        road_radps: float,
        road_time_s: float,
    ) -> None:
        """Stationary sigmas and time constants of the three parts."""
        self._natural, self._damping = natural_radps, damping
        self._offset_time_s, self._road_time_s = offset_time_s, road_time_s
        stationary = [spread_rad, spread_rad * natural_radps, offset_rad, road_radps]
        self._still = np.diag(np.square(stationary))
        self._state = np.zeros(5)
        self._covariance = np.zeros((5, 5))
        self.reset()

    @property
    def pitch_rad(self) -> float:
        return float(self._state[_BODY] + self._state[_OFFSET])

    @property
    def sigma_rad(self) -> float:
        return math.sqrt(max(self._spread(self._sum()), 0.0))

    def reset(self) -> None:
        """Nothing is known but what cars do."""
        self._state[:] = 0.0
        self._covariance[:] = 0.0
        self._covariance[:4, :4] = self._still
        self._mark()

    def shift(self, rad: float) -> None:
        """The rest moved by this: the pitch itself stays where it was."""
        self._state[_OFFSET] -= rad
        self._state[_BEFORE] -= rad

    def predict(self, dt_s: float) -> None:
        """Time passes; the pitch of before is kept as q."""
        self._mark()
        f = np.eye(5)
        f[:2, :2] = oscillator(dt_s, self._natural, self._damping)
        f[_OFFSET, _OFFSET] = math.exp(-dt_s / self._offset_time_s)
        f[_ROAD, _ROAD] = math.exp(-dt_s / self._road_time_s)
        noise = np.zeros((5, 5))
        noise[:4, :4] = self._still - f[:4, :4] @ self._still @ f[:4, :4].T
        self._state = f @ self._state
        self._covariance = f @ self._covariance @ f.T + noise

    def off_by(self, pitch_rad: float, sigma_rad: float) -> float:
        """How many sigma a sighting lies off what is expected."""
        return abs(pitch_rad - self.pitch_rad) / math.sqrt(max(self._spread(self._sum()), 0.0) + sigma_rad**2)

    def take_pitch(self, pitch_rad: float, sigma_rad: float) -> None:
        """A sighting of the pitch about its rest."""
        self._take(self._sum(), pitch_rad, sigma_rad)

    def take_turn(self, turned_rad: float, sigma_rad: float, dt_s: float) -> None:
        """By how much the camera turned nose down during the last prediction, as the far picture shows it."""
        row = self._sum()
        row[_ROAD], row[_BEFORE] = dt_s, -1.0
        self._take(row, turned_rad, sigma_rad)

    def _sum(self) -> FloatArray:
        row = np.zeros(5)
        row[_BODY] = row[_OFFSET] = 1.0
        return row

    def _spread(self, row: FloatArray) -> float:
        return float(row @ self._covariance @ row)

    def _mark(self) -> None:
        copy = np.eye(5)
        copy[_BEFORE] = self._sum()
        self._state = copy @ self._state
        self._covariance = copy @ self._covariance @ copy.T

    def _take(self, row: FloatArray, value: float, sigma: float) -> None:
        gain = self._covariance @ row / (self._spread(row) + sigma**2)
        self._state = self._state + gain * (value - float(row @ self._state))
        left = np.eye(5) - np.outer(gain, row)
        self._covariance = left @ self._covariance @ left.T + np.outer(gain, gain) * sigma**2


def oscillator(dt_s: float, natural_radps: float, damping: float) -> FloatArray:
    """(2, 2) transition of x'' = -2 z w x' - w^2 x over dt, z < 1 (the standard underdamped solution)."""
    swing = natural_radps * math.sqrt(1.0 - damping**2)
    fade = math.exp(-damping * natural_radps * dt_s)
    c, s = math.cos(swing * dt_s), math.sin(swing * dt_s)
    ratio = damping * natural_radps / swing
    free = np.array([[c + ratio * s, s / swing], [-(natural_radps**2) / swing * s, c - ratio * s]])
    moved: FloatArray = fade * free
    return moved
