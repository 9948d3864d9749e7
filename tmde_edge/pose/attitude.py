"""The camera's attitude in every frame: vanishing points as they come, the picture's movement between them, and rest."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import EgoState, LaneSighting, Pose, TiltChange
from tmde_edge.pose.compensate import pitch_and_yaw
from tmde_edge.pose.pitch_filter import PitchFilter
from tmde_edge.pose.resting import RestingPose
from tmde_edge.pose.settings import PoseSettings

_BEND_RAD_M = 1.0  # sigma of a vanishing row on a bend, times its curvature: chords at different depths do not meet
_WITNESSES_AGAINST_MOTION = 6
_LEAST_SPEED_MPS = 2.0  # below it yaw rate over speed is no curvature


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
        s = self._settings = settings
        self._camera = camera
        self._calibrated = pitch_rad, roll_rad, yaw_rad
        self._resting = resting if resting is not None else RestingPose()
        self._filter = PitchFilter(
            spread_rad=s.pitch_spread_rad,
            natural_radps=2.0 * math.pi * s.natural_hz,
            damping=s.damping,
            offset_rad=s.rest_sigma_rad,
            offset_time_s=s.offset_time_s,
            road_radps=s.road_turn_radps,
            road_time_s=s.road_turn_time_s,
        )
        self._roll = 0.0, s.rest_sigma_rad  # about the calibrated roll, and sigma
        self._t_ns: int | None = None
        self._seen_ns: int | None = None
        self._source: str = "none"
        self._moved_ns: int | None = None  # of the last movement that was used
        self._witnesses = 0  # outliers in a row that agree
        self._doubted: tuple[float, float, int] | None = None  # pitch, sigma and time of the last outlier

    @property
    def correction(self) -> Literal["rotate", "paper", "none"]:
        """How distances are corrected for the attitude."""
        return self._settings.correction

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

    def update(
        self,
        lanes: LaneSighting | None,
        t_ns: int,
        ego: EgoState | None,
        size_px: tuple[int, int] | None = None,
        tilt: TiltChange | None = None,
    ) -> Pose:
        """The pose at t_ns; `lanes` and `tilt` are in pixels of an image of `size_px` (default: the calibrated size)."""
        before_ns, dt_s = self._t_ns, 0.0
        if before_ns is None or t_ns > before_ns:
            dt_s = 0.0 if before_ns is None else (t_ns - before_ns) * 1e-9
            self._t_ns = t_ns
            if dt_s > 0.0:
                self._filter.predict(dt_s)
        camera = self._camera
        if camera is not None and self._settings.method != "none":
            if size_px is not None:
                camera = camera.scaled_to(*size_px)
            if tilt is not None and dt_s > 0.0 and tilt.t_from_ns == before_ns and self._settings.track_motion:
                self._filter.take_turn(-tilt.down_px / camera.fy_px, tilt.sigma_px / camera.fy_px, dt_s)
                self._moved_ns = t_ns
            if lanes is not None:
                self._take(lanes, camera, t_ns, ego)
        return self._pose(t_ns)

    def _take(self, lanes: LaneSighting, camera: Camera, t_ns: int, ego: EgoState | None) -> None:
        roll_rad = self._calibrated[1] + self._roll[0]
        pitch_rad, yaw_rad = pitch_and_yaw(camera.rays(np.array([lanes.vanishing_px]))[0], roll_rad)
        sigma_rad = math.hypot(
            lanes.sigma_y_px / camera.fy_px,
            lanes.sigma_x_px / camera.fx_px * math.sin(roll_rad),
            self._settings.road_sigma_rad,
            _BEND_RAD_M * _curvature_per_m(ego),
        )
        if not (math.isfinite(pitch_rad) and math.isfinite(sigma_rad)):
            return
        about_rest = pitch_rad - self.rest.pitch_rad
        if self._filter.off_by(about_rest, sigma_rad) > self._settings.gate_sigma:
            if not self._confirmed(pitch_rad, sigma_rad, t_ns):
                return
            self._filter.reset()
        self._doubted = None
        self._filter.take_pitch(about_rest, sigma_rad)
        if lanes.roll_rad is not None and lanes.roll_sigma_rad is not None:
            self._take_roll(lanes.roll_rad - self._calibrated[1], lanes.roll_sigma_rad)
        self._seen_ns, self._source = t_ns, lanes.source
        if self._straight(ego) and lanes.source == "lanes":
            before = self.rest.pitch_rad
            self._resting = self._resting.with_sample(pitch_rad, yaw_rad)
            self._filter.shift(self.rest.pitch_rad - before)

    def _confirmed(self, pitch_rad: float, sigma_rad: float, t_ns: int) -> bool:
        """A far-off sighting is believed once the next one agrees with it; against the picture's own movement, a few more."""
        before, self._doubted = self._doubted, (pitch_rad, sigma_rad, t_ns)
        followed = self._moved_ns is not None and (t_ns - self._moved_ns) * 1e-9 <= self._settings.hold_s
        self._witnesses += 1
        if before is None or (t_ns - before[2]) * 1e-9 > self._settings.hold_s:
            self._witnesses = 1
            return False
        dt_s = (t_ns - before[2]) * 1e-9
        moved_rad = self._settings.pitch_spread_rad * 2.0 * math.pi * self._settings.natural_hz * dt_s
        if abs(pitch_rad - before[0]) > 2.0 * math.hypot(sigma_rad, before[1], min(moved_rad, 0.01)):
            self._witnesses = 1
        return self._witnesses >= (_WITNESSES_AGAINST_MOTION if followed else 2)

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
            pitch_rad=rest.pitch_rad + self._filter.pitch_rad,
            roll_rad=rest.roll_rad + self._roll[0],
            yaw_rad=rest.yaw_rad,
            pitch_sigma_rad=self._filter.sigma_rad,
            roll_sigma_rad=self._roll[1],
            source="network" if source == "network" else "lanes" if source == "lanes" else "none",
        )


def _curvature_per_m(ego: EgoState | None) -> float:
    """Of the own path; 0 where it is not known."""
    if ego is None or ego.yaw_rate_radps is None or ego.speed_mps < _LEAST_SPEED_MPS:
        return 0.0
    return abs(ego.yaw_rate_radps) / ego.speed_mps
