"""Everything that looks at a frame: plates every time, lanes at their own rate of source time; one Sighting comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Frame, LaneSighting, Point, Pose, Sighting
from tmde_edge.pose.compensate import vanishing_point_px
from tmde_edge.pose.course import find_course
from tmde_edge.pose.edges import Image
from tmde_edge.pose.lanes import LaneFinder
from tmde_edge.pose.settings import PoseSettings
from tmde_edge.pose.tilt import TiltMeter
from tmde_edge.vision.perception import BETWEEN, EARLY_NS, Perception

COURSE_PERIOD_NS = 200_000_000  # a lane's course is followed no oftener: what was seen is carried along for half a second
Horizon = Callable[[Image, "Point | None"], "LaneSighting | None"]  # a picture and where its horizon is expected


class Eyes:
    """Perception of plates and of lanes. `see` remembers, `see_still` does not."""

    def __init__(
        self,
        perception: Perception,
        pose: PoseSettings,
        prior_px: Callable[[int, int], Point | None],
        clock_ns: Callable[[], int],
        horizon: Horizon | None = None,
        focal_px: Callable[[int, int], float] | None = None,
    ) -> None:
        """`horizon` stands in where no lanes are found; without `focal_px` (of an image's size) no course is looked for."""
        self._perception = perception
        self._lanes = LaneFinder(pose) if pose.method in ("robust", "paper") else None
        self._horizon = horizon if pose.method != "none" else None
        self._tilt = TiltMeter()
        self._period_ns = round(1e9 / pose.rate_hz)
        self._horizon_period_ns = round(1e9 / pose.network_rate_hz)
        self._asked_ns: int | None = None  # when the horizon network was last asked
        self._prior_px = prior_px
        self._clock_ns = clock_ns
        self._focal_px = focal_px
        self._looked_ns: int | None = None
        self._course_ns: int | None = None
        self._last_ns: int | None = None

    def see(self, frame: Frame) -> Sighting:
        """The next frame of a drive, in order of time."""
        start_ns = self._clock_ns()
        prior = self._prior_px(frame.image.shape[1], frame.image.shape[0])
        tilt = self._tilt.see(frame.image, frame.t_ns, prior)
        self._perception.far_point_px = prior
        self._perception.shaken_px = 0.0 if tilt is None else tilt.down_px
        took_ns = self._clock_ns() - start_ns
        sighting = self._perception.see(frame)
        if (self._lanes is None and self._horizon is None) or sighting.status == "blind":
            return _timed(sighting, took_ns)
        start_ns = self._clock_ns()
        lanes: LaneSighting | None = None
        if self._lanes_due(frame.t_ns, sighting.searched):
            self._looked_ns = frame.t_ns
            if self._lanes is not None:
                lanes = self._lanes.see(frame.image, frame.t_ns, prior)
            if lanes is None and self._horizon is not None and _due(self._asked_ns, frame.t_ns, self._horizon_period_ns):
                self._asked_ns = frame.t_ns
                lanes = self._horizon(frame.image, prior)
            if lanes is not None and self._focal_px is not None and _due(self._course_ns, frame.t_ns, COURSE_PERIOD_NS):
                self._course_ns = frame.t_ns
                focal_px = self._focal_px(frame.image.shape[1], frame.image.shape[0])
                lanes = replace(lanes, course_px=find_course(frame.image, lanes.vanishing_px, focal_px))
        return _timed(replace(sighting, lanes=lanes, tilt=tilt), took_ns + self._clock_ns() - start_ns)

    def _lanes_due(self, t_ns: int, searched: bool) -> bool:
        """Whether to look for lanes; not beside a full search where the next frame comes soon enough."""
        step_ns = 0 if self._last_ns is None else t_ns - self._last_ns
        self._last_ns = t_ns
        wait = searched and 0 < BETWEEN * step_ns <= self._period_ns + EARLY_NS
        return _due(self._looked_ns, t_ns, self._period_ns + (step_ns if wait else 0))

    def thin_searches(self, factor: float) -> None:
        """Full searches are this much rarer from the next frame on (1: as configured)."""
        self._perception.thinning = factor

    def see_still(self, frame: Frame) -> Sighting:
        """A picture by itself."""
        return self._perception.see_still(frame)


def _timed(sighting: Sighting, pose_ns: int) -> Sighting:
    """With the time that the camera's attitude took."""
    timing = dict(sighting.timing_ms)
    timing["pose"] = pose_ns * 1e-6
    timing["total"] = timing.get("total", 0.0) + timing["pose"]
    return replace(sighting, timing_ms=timing)


def _due(last_ns: int | None, t_ns: int, period_ns: int) -> bool:
    """True where a period has passed, or time went back."""
    return last_ns is None or not -EARLY_NS <= t_ns - last_ns < period_ns - EARLY_NS


def calibrated_prior(
    camera: Camera | None, pitch_rad: float, roll_rad: float, yaw_rad: float
) -> Callable[[int, int], Point | None]:
    """Where the calibration expects the lanes to meet, for an image of a given size."""
    pose = Pose(pitch_rad=pitch_rad, roll_rad=roll_rad, yaw_rad=yaw_rad)

    def prior_px(width_px: int, height_px: int) -> Point | None:
        return vanishing_point_px(pose, camera.scaled_to(width_px, height_px)) if camera is not None else None

    return prior_px
