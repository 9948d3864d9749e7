"""The camera's attitude in every frame, from vanishing points as they come: one filter, its state explicit.

Model: the body pitches about its rest as a damped oscillator driven by white noise (suspension, about 1.2 Hz), so that
between two sightings the pitch is predicted and after the last one it returns to rest with its full spread.
"""

from __future__ import annotations

import math

import numpy as np

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import EgoState, LaneSighting, Point, Pose, TiltChange
from tmde_edge.pose.compensate import FloatArray, pitch_and_yaw, vanishing_point_px
from tmde_edge.pose.resting import RestingPose
from tmde_edge.pose.settings import PoseSettings

_LANE_MEMORY_S = 0.5  # for so long the errors of successive lane sightings are alike
_WITNESSES_AGAINST_MOTION = 6  # sightings that must agree to overrule the picture's own movement


class AttitudeEstimator:
    """Pose of the camera against the road; pitch positive nose down, roll positive clockwise, yaw positive right."""

    def __init__(
        self,
        settings: PoseSettings,
        camera: Camera | None,
        *,
        pitch_rad: float = 0.0,
        roll_rad: float = 0.0,
        yaw_rad: float = 0.0,
        resting: RestingPose | None = None,
    ) -> None:
        """The angles are those of calibration; `resting` what earlier drives have learnt. No camera: never measured."""
        self._settings = settings
        self._camera = camera
        self._calibrated = pitch_rad, roll_rad, yaw_rad
        self._resting = resting if resting is not None else RestingPose()
        self._state = np.zeros(2)  # pitch about its rest (rad), its rate (rad/s)
        self._covariance = self._at_rest()
        self._roll = 0.0, settings.rest_sigma_rad  # about the calibrated roll, and sigma
        self._t_ns: int | None = None
        self._seen_ns: int | None = None
        self._source: str = "none"
        self._turned_ns: int | None = None  # the last frame whose movement was seen; None where it is not followed
        self._witnesses = 0
        self._doubted: tuple[float, float, int] | None = None  # pitch, sigma and time of the last outlier

    @property
    def resting(self) -> RestingPose:
        """What driving has taught about the mounting; keep it over restarts."""
        return self._resting

    @property
    def rest(self) -> Pose:
        """The attitude while nothing moves the body: learnt where enough was seen, else calibrated."""
        pitch_rad, roll_rad, yaw_rad = self._calibrated
        sigma_rad = self._settings.rest_sigma_rad
        if self._resting.valid:
            pitch_rad, yaw_rad, sigma_rad = self._resting.pitch_rad, self._resting.yaw_rad, self._resting.sigma_rad
        return Pose(
            pitch_rad=pitch_rad,
            roll_rad=roll_rad,
            yaw_rad=yaw_rad,
            pitch_sigma_rad=sigma_rad,
            roll_sigma_rad=self._settings.rest_sigma_rad,
        )

    def expected_vanishing_px(self, width_px: int, height_px: int) -> Point | None:
        """Where LaneFinder should look in an image of this size; None without a calibration."""
        if self._camera is None:
            return None
        return vanishing_point_px(self.rest, self._camera.scaled_to(width_px, height_px))

    def update(
        self,
        lanes: LaneSighting | None,
        t_ns: int,
        ego: EgoState | None,
        size_px: tuple[int, int] | None = None,
        tilt: TiltChange | None = None,
    ) -> Pose:
        """The pose at t_ns; `lanes` and `tilt` are in pixels of an image of `size_px` (default: the calibrated size)."""
        camera = self._camera
        if camera is not None and size_px is not None:
            camera = camera.scaled_to(*size_px)
        if camera is None or self._settings.method == "none":
            self._predict(t_ns)
            return self._pose(t_ns)
        if tilt is not None and self._t_ns == tilt.t_from_ns and t_ns > tilt.t_from_ns:
            self._turn(tilt, camera, t_ns)
            self._turned_ns = t_ns
        else:
            self._predict(t_ns)
            if self._turned_ns is not None and (t_ns - self._turned_ns) * 1e-9 > self._settings.hold_s:
                self._turned_ns = None
        if lanes is not None:
            self._take(lanes, camera, t_ns, ego)
        return self._pose(t_ns)

    def _at_rest(self) -> FloatArray:
        """Covariance when nothing has been seen for long."""
        s = self._settings
        rate = s.pitch_spread_rad * 2.0 * math.pi * s.natural_hz
        return np.diag([s.pitch_spread_rad**2 + s.rest_sigma_rad**2, rate**2])

    def _predict(self, t_ns: int) -> None:
        if self._t_ns is None or t_ns <= self._t_ns:
            self._t_ns = t_ns if self._t_ns is None else self._t_ns
            return
        dt_s = (t_ns - self._t_ns) * 1e-9
        self._t_ns = t_ns
        forward = oscillator(dt_s, 2.0 * math.pi * self._settings.natural_hz, self._settings.damping)
        still = self._at_rest()
        self._state = forward @ self._state
        # The noise that keeps the resting covariance in balance, whatever the step: exact for white noise.
        self._covariance = forward @ (self._covariance - still) @ forward.T + still

    def _turn(self, tilt: TiltChange, camera: Camera, t_ns: int) -> None:
        """The pitch moved by what was seen to move; only the slope of the road drifts unseen. A leak leads back to rest."""
        dt_s = (t_ns - tilt.t_from_ns) * 1e-9
        self._t_ns = t_ns
        moved_rad = -tilt.down_px / camera.fy_px
        sigma_rad = tilt.sigma_px / camera.fy_px
        still = self._at_rest()
        keep = math.exp(-dt_s / self._settings.slope_time_s)
        variance = keep**2 * float(self._covariance[0, 0]) + (1.0 - keep**2) * float(still[0, 0]) + sigma_rad**2
        # The rate follows from the same movement, for the frames that will have none.
        rate_sigma = math.sqrt(2.0) * sigma_rad / dt_s
        self._state = np.array([keep * float(self._state[0]) + moved_rad, moved_rad / dt_s])
        self._covariance = np.diag([min(variance, float(still[0, 0])), min(rate_sigma**2, float(still[1, 1]))])

    def _take(self, lanes: LaneSighting, camera: Camera, t_ns: int, ego: EgoState | None) -> None:
        ray = camera.rays(np.array([lanes.vanishing_px]))[0]
        roll_rad = self._calibrated[1] + self._roll[0]
        pitch_rad, yaw_rad = pitch_and_yaw(ray, roll_rad)
        sigma_rad = math.hypot(
            lanes.sigma_y_px / camera.fy_px,
            lanes.sigma_x_px / camera.fx_px * math.sin(roll_rad),
            self._settings.road_sigma_rad,
        )
        if not (math.isfinite(pitch_rad) and math.isfinite(sigma_rad)):
            return
        rest = self.rest
        if self._turned_ns is not None:
            # What misleads one picture's lanes (a kerb, a car's side) misleads the next ones too: not independent witnesses.
            since_s = (t_ns - self._seen_ns) * 1e-9 if self._seen_ns is not None else _LANE_MEMORY_S
            sigma_rad *= math.sqrt(1.0 + 2.0 * _LANE_MEMORY_S / max(since_s, 0.03))
        innovation = pitch_rad - rest.pitch_rad - float(self._state[0])
        doubtful = innovation**2 > self._settings.gate_sigma**2 * (float(self._covariance[0, 0]) + sigma_rad**2)
        if doubtful and not self._confirmed(pitch_rad, sigma_rad, t_ns):
            return
        self._doubted = None
        variance = float(self._covariance[0, 0]) + sigma_rad**2
        gain = self._covariance[:, 0] / variance
        self._state = self._state + gain * innovation
        left = np.eye(2) - np.outer(gain, [1.0, 0.0])
        self._covariance = left @ self._covariance @ left.T + np.outer(gain, gain) * sigma_rad**2
        if lanes.roll_rad is not None and lanes.roll_sigma_rad is not None:
            self._take_roll(lanes.roll_rad - self._calibrated[1], lanes.roll_sigma_rad)
        self._seen_ns, self._source = t_ns, lanes.source
        if self._straight(ego) and lanes.source == "lanes":
            before = self.rest.pitch_rad
            self._resting = self._resting.with_sample(pitch_rad, yaw_rad)
            self._state[0] += before - self.rest.pitch_rad  # the pitch itself does not jump when its rest is corrected

    def _confirmed(self, pitch_rad: float, sigma_rad: float, t_ns: int) -> bool:
        """A far-off sighting is believed once the next one, soon after, agrees with it: clutter does not repeat itself."""
        before, self._doubted = self._doubted, (pitch_rad, sigma_rad, t_ns)
        if before is None or (t_ns - before[2]) * 1e-9 > self._settings.hold_s:
            self._witnesses = 1
            return False
        dt_s = (t_ns - before[2]) * 1e-9
        moved_rad = self._settings.pitch_spread_rad * 2.0 * math.pi * self._settings.natural_hz * dt_s
        agrees = abs(pitch_rad - before[0]) <= 2.0 * math.hypot(sigma_rad, before[1], min(moved_rad, 0.01))
        self._witnesses = self._witnesses + 1 if agrees else 1
        if self._witnesses < (2 if self._turned_ns is None else _WITNESSES_AGAINST_MOTION):
            return False
        self._covariance = self._at_rest()
        return True

    def _take_roll(self, roll_rad: float, sigma_rad: float) -> None:
        """Roll changes slowly against its calibration: a first-order filter of about a second at 10 Hz."""
        at, old = self._roll
        variance = min(old**2 + (0.1 * self._settings.rest_sigma_rad) ** 2, 4.0 * self._settings.rest_sigma_rad**2)
        gain = variance / (variance + max(sigma_rad, 1e-6) ** 2)
        self._roll = at + gain * (roll_rad - at), math.sqrt((1.0 - gain) * variance)

    def _straight(self, ego: EgoState | None) -> bool:
        s = self._settings
        return (
            s.auto_calibrate
            and ego is not None
            and ego.speed_mps >= s.calibrate_speed_mps
            and ego.yaw_rate_radps is not None
            and abs(ego.yaw_rate_radps) <= s.calibrate_yaw_rate_radps
        )

    def _pose(self, t_ns: int) -> Pose:
        rest = self.rest
        source = "none"
        if self._seen_ns is not None and (t_ns - self._seen_ns) * 1e-9 <= self._settings.hold_s:
            source = self._source
        return Pose(
            pitch_rad=rest.pitch_rad + float(self._state[0]),
            roll_rad=rest.roll_rad + self._roll[0],
            yaw_rad=rest.yaw_rad,
            pitch_sigma_rad=math.sqrt(max(float(self._covariance[0, 0]), 0.0)),
            roll_sigma_rad=self._roll[1],
            source="network" if source == "network" else "lanes" if source == "lanes" else "none",
        )


def oscillator(dt_s: float, natural_radps: float, damping: float) -> FloatArray:
    """(2, 2) transition of x'' = -2 z w x' - w^2 x over dt, z < 1 (the standard underdamped solution)."""
    swing = natural_radps * math.sqrt(1.0 - damping**2)
    fade = math.exp(-damping * natural_radps * dt_s)
    c, s = math.cos(swing * dt_s), math.sin(swing * dt_s)
    ratio = damping * natural_radps / swing
    free = np.array([[c + ratio * s, s / swing], [-(natural_radps**2) / swing * s, c - ratio * s]])
    moved: FloatArray = fade * free
    return moved
