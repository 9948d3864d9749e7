"""Everything that looks at a frame: plates every time, lanes at their own rate of source time; one Sighting comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Frame, LaneSighting, Point, Pose, Sighting
from tmde_edge.pose.compensate import vanishing_point_px
from tmde_edge.pose.lanes import LaneFinder
from tmde_edge.pose.settings import PoseSettings
from tmde_edge.pose.tilt import TiltMeter
from tmde_edge.vision.perception import EARLY_NS, Perception


class Eyes:
    """Perception of plates and of lanes. `see` remembers, `see_still` does not."""

    def __init__(
        self,
        perception: Perception,
        pose: PoseSettings,
        prior_px: Callable[[int, int], Point | None],
        clock_ns: Callable[[], int],
    ) -> None:
        self._perception = perception
        self._lanes = LaneFinder(pose) if pose.method != "none" else None
        self._tilt = TiltMeter()
        self._period_ns = round(1e9 / pose.rate_hz)
        self._prior_px = prior_px
        self._clock_ns = clock_ns
        self._looked_ns: int | None = None

    def see(self, frame: Frame) -> Sighting:
        """The next frame of a drive, in order of time."""
        sighting = self._perception.see(frame)
        if self._lanes is None or sighting.status == "blind":
            return sighting
        start_ns = self._clock_ns()
        prior = self._prior_px(frame.image.shape[1], frame.image.shape[0])
        tilt = self._tilt.see(frame.image, frame.t_ns, prior)
        lanes: LaneSighting | None = None
        if self._looked_ns is None or not -EARLY_NS <= frame.t_ns - self._looked_ns < self._period_ns - EARLY_NS:
            self._looked_ns = frame.t_ns
            lanes = self._lanes.see(frame.image, frame.t_ns, prior)
        took_ms = (self._clock_ns() - start_ns) * 1e-6
        timing = dict(sighting.timing_ms)
        timing["pose"] = took_ms
        timing["total"] = timing.get("total", 0.0) + took_ms
        return replace(sighting, lanes=lanes, tilt=tilt, timing_ms=timing)

    def thin_searches(self, factor: float) -> None:
        """Full searches are this much rarer from the next frame on (1: as configured)."""
        self._perception.thinning = factor

    def see_still(self, frame: Frame) -> Sighting:
        """A picture by itself."""
        return self._perception.see_still(frame)


def calibrated_prior(
    camera: Camera | None, pitch_rad: float, roll_rad: float, yaw_rad: float
) -> Callable[[int, int], Point | None]:
    """Where the calibration expects the lanes to meet, for an image of a given size."""
    pose = Pose(pitch_rad=pitch_rad, roll_rad=roll_rad, yaw_rad=yaw_rad)

    def prior_px(width_px: int, height_px: int) -> Point | None:
        return vanishing_point_px(pose, camera.scaled_to(width_px, height_px)) if camera is not None else None

    return prior_px
