"""Sighting | CanFrame | DepthReading | Tick in, decisions out. READ THIS FILE FIRST.

One object, one method: `Estimation.step(event)`. It reads no clock and sees no pixel arrays, so the live service, the
desk and the replay of a recorded drive run exactly this code on exactly these events.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from tmde_edge.alerts.policy import AlertPolicy, Situation
from tmde_edge.alerts.settings import AlertSettings
from tmde_edge.canbus.alert_tx import AlertTransmitter, StatusInfo
from tmde_edge.canbus.ego_rx import EgoReceiver
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import (
    Alert,
    CanFrame,
    CueRange,
    DepthEstimate,
    DepthReading,
    EgoState,
    Event,
    FrameResult,
    LeadEstimate,
    Output,
    PlateResult,
    PlateSighting,
    Pose,
    RangeMeasurement,
    Sighting,
    Tick,
)
from tmde_edge.pose.attitude import AttitudeEstimator
from tmde_edge.pose.compensate import (
    cosine_ratio,
    plate_ground_range,
    plate_height_possible,
    to_vehicle,
    view_from_vehicle,
)
from tmde_edge.pose.resting import RestingPose
from tmde_edge.ranging.cover import CoverCheck
from tmde_edge.ranging.depth_scale import DepthAligner
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.scale_memory import TrackScale
from tmde_edge.tracking.lead import LeadTracker, Source, Track
from tmde_edge.tracking.settings import TrackerSettings
from tmde_edge.tracking.travel_check import TravelCheck
from tmde_edge.tracking.ttc import braking_ttc_s, plain_ttc_s, required_decel_mps2, ttc_sigma_s

NOMINAL_FOCAL_PER_WIDTH = 0.9  # only to give an uncalibrated track a plausible scale: TTC does not depend on it
NOMINAL_PLATE_M = 0.22  # square root of a plate's area, likewise
BLIND_AFTER_S = 0.5  # no frame for this long is blindness
USUAL_HEIGHT_M = 1.3  # of a camera whose height is not configured, for the lane's course
LANE_YAW_SPEED_MPS = 8.0
LANE_YAW_NS = 1_000_000_000  # neighbouring frames' lanes err alike: one a second is used
MIN_HEADWAY_SPEED_MPS = 1.0


@dataclass(frozen=True, kw_only=True)
class Parts:
    """What one Estimation is made of; app/wiring.py builds it from the configuration."""

    camera: Camera | None  # None: uncalibrated
    to_bumper_m: float
    camera_height_m: float | None  # above the road; None: no gate on a plate's height
    ranger: Ranger
    attitude: AttitudeEstimator
    depth: DepthAligner | None
    tracker: TrackerSettings
    alerts: AlertSettings
    ego: EgoReceiver | None
    transmitter: AlertTransmitter | None


class Estimation:
    """All state behind the decisions."""

    def __init__(self, parts: Parts) -> None:
        self._p = parts
        self._tracker = LeadTracker(parts.tracker, metric=parts.camera is not None)
        self._policy = AlertPolicy(parts.alerts)
        self._travel = TravelCheck()
        self._travelled_ns: dict[int, int] = {}
        self._lane_yaw_ns = -LANE_YAW_NS
        self._scales: dict[int, TrackScale] = {}
        self._cover = CoverCheck()
        self._ego: EgoState | None = None
        self._pose = Pose(pitch_rad=0.0, roll_rad=0.0)
        self._alert = Alert()
        self._last: FrameResult | None = None
        self._last_frame_ns: int | None = None
        self._depth_taken_ns: int | None = None  # each reading of depth is used once
        self._tick_faults: tuple[str, ...] = ()
        self._temperature_c: float | None = None
        self._frame_times_ns: list[int] = []

    @property
    def resting(self) -> RestingPose:
        """What driving has taught about the camera's mounting, to be kept over restarts."""
        return self._p.attitude.resting

    def step(self, event: Event) -> tuple[Output, ...]:
        """Takes one event in time order and returns what follows from it."""
        if isinstance(event, Sighting):
            return self._on_sighting(event)
        if isinstance(event, CanFrame):
            self._on_can(event)
            return ()
        if isinstance(event, DepthReading):
            if self._p.depth is not None:
                self._p.depth.add_reading(event)
            return ()
        return self._on_tick(event)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of the configuration, as driving has shown it."""
        mismatch = self._travel.mismatch
        complaints = self._p.ego.complaints if self._p.ego is not None else ()
        return (*complaints, *((f"calibration: {mismatch.text}",) if mismatch is not None else ()))

    # -- inputs -------------------------------------------------------------------------------------------------------

    def _on_can(self, frame: CanFrame) -> None:
        if self._p.ego is not None:
            state = self._p.ego.update(frame)
            if state is not None:
                self._ego = state
                self._tracker.set_ego(state)

    def _on_tick(self, tick: Tick) -> tuple[Output, ...]:
        self._tick_faults = tick.faults
        self._temperature_c = tick.temperature_c
        self._refresh_ego(tick.t_ns)
        if self._last is not None and self._last_frame_ns is not None:
            silent_s = (tick.t_ns - self._last_frame_ns) * 1e-9
            if silent_s > BLIND_AFTER_S:  # what was seen is history now: no lead is claimed on it
                self._tracker.predict(tick.t_ns)
                lead = self._lead(tick.t_ns, self._tracker.choose(tick.t_ns))
                self._alert = self._policy.step(self._situation(tick.t_ns, lead))
                self._last = FrameResult(
                    t_ns=tick.t_ns, frame_index=self._last.frame_index, plates=(), lead=lead, ego=self._ego,
                    pose=self._pose, depth=None, alert=self._alert, faults=self._faults(tick.t_ns, blind=True),
                    mode=self._last.mode,
                )  # fmt: skip
                return (self._last, *self._transmit(tick.t_ns))
        return self._transmit(tick.t_ns)

    def _on_sighting(self, s: Sighting) -> tuple[Output, ...]:
        self._last_frame_ns = s.t_ns
        self._frame_times_ns = [*self._frame_times_ns[-30:], s.t_ns]
        self._refresh_ego(s.t_ns)
        self._pose = self._p.attitude.update(s.lanes, s.t_ns, self._ego, (s.width_px, s.height_px), s.tilt)
        self._take_course(s)
        self._tracker.predict(s.t_ns)
        camera = self._p.camera.scaled_to(s.width_px, s.height_px) if self._p.camera is not None else None
        measured: dict[int, tuple[PlateSighting, RangeMeasurement | None, str | None]] = {}
        for i, plate in enumerate(s.plates):
            measured[i] = (plate, *self._measure(plate, camera, s))
        alive = {p.track_id for p in s.plates} | set(self._tracker.tracks)
        self._scales = {k: v for k, v in self._scales.items() if k in alive}
        self._travelled_ns = {k: v for k, v in self._travelled_ns.items() if k in alive}
        self._travel.forget(alive)
        self._cover.keep(alive)
        self._scale_changes(s, camera)
        chosen = self._tracker.choose(s.t_ns)
        depth = self._depth(s, camera, chosen)
        lead = self._lead(s.t_ns, chosen)
        blind = s.status in ("blind", "failed")
        self._alert = self._policy.step(self._situation(s.t_ns, lead))
        plates = tuple(
            PlateResult(
                sighting=plate,
                range=found,
                not_ranged=reason,
                in_path=(t := self._tracker.tracks.get(plate.track_id)) is not None and t.in_path,
                lead=chosen is not None and plate.track_id == chosen.track_id,
            )
            for plate, found, reason in measured.values()
        )
        self._last = FrameResult(
            t_ns=s.t_ns, frame_index=s.frame_index, plates=plates, lead=lead, ego=self._ego, pose=self._pose, depth=depth,
            alert=self._alert, faults=self._faults(s.t_ns, blind=blind), mode=s.mode,
        )  # fmt: skip
        return (self._last, *self._transmit(s.t_ns))

    # -- steps --------------------------------------------------------------------------------------------------------

    def _refresh_ego(self, t_ns: int) -> None:
        if self._p.ego is not None:
            ego = self._p.ego.state(t_ns)
            if ego is None and self._ego is not None:
                self._tracker.set_ego(None)
                self._travelled_ns.clear()  # what was covered meanwhile is not known: the runs end here
                self._travel.forget(set())
            self._ego = ego

    def _measure(self, plate: PlateSighting, camera: Camera | None, s: Sighting) -> tuple[RangeMeasurement | None, str | None]:
        # An outline that flow alone carries repeats one old error in every frame; the vehicle's growth knows better.
        guessed = plate.source == "flow" and not plate.refined and not plate.glyphs
        usable = not (guessed and self._tracker.carries(plate.track_id, s.t_ns))
        if camera is None:
            if usable:
                self._tracker.update(_relative_range(plate, s), _source(plate))
            return None, "uncalibrated"
        if self._cover.covered(plate, s.t_ns):
            return None, "covered"
        correction = self._p.attitude.correction
        turn = view_from_vehicle(self._pose) if correction == "rotate" else np.eye(3)
        found, scale, reason = self._p.ranger.measure(plate, camera, turn, s.t_ns, self._scales.get(plate.track_id))
        if found is not None and correction != "rotate":
            found = _placed(found, self._pose)
        if found is not None and correction == "paper":
            found = _scaled(found, cosine_ratio(self._pose, self._p.attitude.rest))
        if found is not None and not self._height_possible(plate, found, camera):
            return None, "height above the road"
        self._scales[plate.track_id] = scale
        if found is not None:
            found = self._with_ground_cue(found, plate, camera)
        if found is not None and usable:
            self._tracker.update(found, _source(plate), guessed=guessed)
            if plate.source == "detector":
                self._check_travel(found)
        return found, reason

    def _height_possible(self, plate: PlateSighting, found: RangeMeasurement, camera: Camera) -> bool:
        """False for what would hang below the road or 5 m above it; True where the camera's height is not known."""
        height_m = self._p.camera_height_m
        if height_m is None:
            return True
        x_px, y_px = np.mean(plate.corners_px, axis=0)
        return plate_height_possible(
            (float(x_px), float(y_px)), found.distance_m, found.sigma_m, camera, self._pose, height_m
        )  # fmt: skip

    def _with_ground_cue(self, found: RangeMeasurement, plate: PlateSighting, camera: Camera) -> RangeMeasurement:
        """Beside the other cues, for people: its sigma is a third of the distance and more, so that it would change nothing."""
        height_m = self._p.camera_height_m
        if height_m is None or self._pose.source == "none":
            return found
        x_px, y_px = np.mean(plate.corners_px, axis=0)
        ground = plate_ground_range((float(x_px), float(y_px)), camera, self._pose, height_m)
        if ground is None:
            return found
        return replace(found, cues=(*found.cues, CueRange(cue="ground", distance_m=ground[0], sigma_m=ground[1], used=False)))

    def _take_course(self, s: Sighting) -> None:
        """The lane ahead, from pixels to metres on a flat road; its bend near us also teaches the yaw rate's zero."""
        if s.lanes is None or len(s.lanes.course_px) < 2 or self._p.camera is None:
            return
        camera = self._p.camera.scaled_to(s.width_px, s.height_px)
        height_m = self._p.camera_height_m or USUAL_HEIGHT_M
        seen = np.array(s.lanes.course_px)
        rays = to_vehicle(camera.rays(seen[:, :2]), self._pose)
        below = rays[:, 1] > 2e-3
        if below.sum() < 2:
            return
        z = height_m * rays[below, 2] / rays[below, 1]
        points_m = np.column_stack([z, height_m * rays[below, 0] / rays[below, 1], seen[below, 2] / camera.fx_px * z])
        further = np.concatenate([[True], np.diff(np.maximum.accumulate(z)) > 0])
        self._tracker.path.set_course(s.t_ns, points_m[further])
        ego, receiver = self._ego, self._p.ego
        if ego is None or receiver is None or ego.speed_mps < LANE_YAW_SPEED_MPS or s.t_ns - self._lane_yaw_ns < LANE_YAW_NS:
            return
        curvature = self._tracker.path.near_curvature()
        if curvature is not None:
            self._lane_yaw_ns = s.t_ns
            receiver.observe_lane_yaw(s.t_ns, -curvature[0] * ego.speed_mps, curvature[1] * ego.speed_mps)

    def _check_travel(self, found: RangeMeasurement) -> None:
        """Ranges against the own travel: what stands tells whether the calibration fits."""
        ego = self._ego
        if ego is None:
            return
        since_ns = self._travelled_ns.get(found.track_id, found.t_ns)
        self._travelled_ns[found.track_id] = found.t_ns
        travel_m = self._tracker.ego_motion.travel_m(since_ns, found.t_ns)
        self._travel.add(
            found.track_id, found.t_ns, found.distance_m, found.noise_m, found.scale_sigma, travel_m, ego.yaw_rate_radps
        )  # fmt: skip

    def _scale_changes(self, s: Sighting, camera: Camera | None) -> None:
        """Growth and place of the whole vehicle's rear; the plate's own growth is already in its ranges."""
        for change in s.scale_changes:
            self._tracker.grow(change, s.t_ns)
        for box in s.vehicles:
            if camera is not None:
                middle = np.array([[(box.left_px + box.right_px) / 2, (box.top_px + box.bottom_px) / 2]])
                ray = (camera.rays(middle) @ view_from_vehicle(self._pose))[0]
                self._tracker.place(box.track_id, float(ray[0] / ray[2]), box.sigma_px / camera.focal_px)

    def _depth(self, s: Sighting, camera: Camera | None, chosen: Track | None) -> DepthEstimate | None:
        if self._p.depth is None or camera is None:
            return None
        ranges_m = {k: t.filter.distance_m for k, t in self._tracker.tracks.items()}
        found = self._p.depth.update(s, camera, self._pose, ranges_m, chosen.track_id if chosen is not None else None)
        reading_ns = self._p.depth.reading_t_ns
        if found is not None and chosen is not None and reading_ns is not None and reading_ns != self._depth_taken_ns:
            self._depth_taken_ns = reading_ns
            self._tracker.update_depth(chosen, found.distance_m, found.sigma_m, reading_ns, s.t_ns)
        if found is None:
            return None
        # Depth is aligned to our own ranges and shares the focal length's error with them: told, but no noise in the fusion.
        return replace(found, sigma_m=math.hypot(found.sigma_m, camera.focal_sigma * found.distance_m))

    def _lead(self, t_ns: int, track: Track | None) -> LeadEstimate | None:
        if track is None:
            return None
        f, cov = track.filter, track.filter.covariance
        gap_m, rate_mps = self._gap_m(f.distance_m), f.range_rate_mps
        speed = self._ego.speed_mps if self._ego is not None else None
        ego_sigma = self._ego.speed_sigma_mps if self._ego is not None else 0.0
        metric = self._p.camera is not None
        return LeadEstimate(
            track_id=track.track_id,
            distance_m=f.distance_m if metric else None,
            sigma_m=track.sigma_m if metric else None,
            range_rate_mps=rate_mps if metric else None,
            range_rate_sigma_mps=math.hypot(math.sqrt(float(cov[1, 1])), ego_sigma, track.scale_sigma * rate_mps)
            if metric
            else None,
            ttc_s=plain_ttc_s(gap_m, rate_mps),
            ttc_sigma_s=ttc_sigma_s(gap_m, rate_mps, cov),
            headway_s=gap_m / speed if metric and speed is not None and speed >= MIN_HEADWAY_SPEED_MPS else None,
            coasting_s=(t_ns - track.measured_ns) * 1e-9,
            source=track.source,
            lateral_m=track.lateral_m,
            lateral_sigma_m=track.lateral_sigma_m,
            accel_mps2=f.accel_mps2 if metric else None,
        )

    def _gap_m(self, distance_m: float) -> float:
        """From the own bumper, 0 at the least; without calibration there is no bumper in these metres."""
        return max(distance_m - (self._p.to_bumper_m if self._p.camera is not None else 0.0), 0.0)

    def _situation(self, t_ns: int, lead: LeadEstimate | None) -> Situation:
        ego = self._ego
        turn = ego.turn_signal if ego is not None else None
        track = self._tracker.tracks.get(lead.track_id) if lead is not None else None
        if lead is None or track is None or not self._tracker.known_without_depth(track, t_ns):
            return Situation(t_ns=t_ns, ego_speed_mps=ego.speed_mps if ego is not None else None, turn_signal=turn)
        f = track.evidence
        gap_m = self._gap_m(f.distance_m)
        metric = self._p.camera is not None
        # The lead's braking counts as far as it stands out of its noise.
        accel = min(0.0, f.accel_mps2)
        accel *= max(0.0, 1.0 - max(float(f.covariance[2, 2]), 0.0) / max(accel**2, 1e-9))
        # A driver who brakes as well has seen it: only what the lead brakes harder counts, as in a relative acceleration.
        if f.lead_speed_mps is not None:
            accel = min(0.0, accel + self._tracker.ego_motion.braking_mps2())
        return Situation(
            t_ns=t_ns,
            present=True,
            gap_m=gap_m if metric else None,
            ttc_s=braking_ttc_s(gap_m, f.range_rate_mps, accel, f.lead_speed_mps),
            ttc_sigma_s=ttc_sigma_s(gap_m, f.range_rate_mps, f.covariance),
            closing_mps=-f.range_rate_mps if metric else None,
            closing_sigma_mps=math.sqrt(max(float(f.covariance[1, 1]), 0.0)) if metric else None,
            required_decel_mps2=required_decel_mps2(gap_m, f.range_rate_mps) if metric else None,
            standing=track.stands and not self._tracker.path.lane_seen(t_ns, f.distance_m),
            headway_s=None if lead.headway_s is None or ego is None else gap_m / ego.speed_mps,
            ego_speed_mps=ego.speed_mps if ego is not None else None,
            brake_pressed=ego.brake_pressed if ego is not None else None,
            turn_signal=turn,
        )

    def _faults(self, t_ns: int, *, blind: bool) -> tuple[str, ...]:
        faults = list(self._tick_faults)
        if self._p.camera is None:
            faults.append("uncalibrated")
        if blind:
            faults.append("blind")
        if self._p.ego is not None and self._p.ego.lost(t_ns):
            faults.append("can_lost")
        if self._travel.mismatch is not None:
            faults.append("calibration")
        return tuple(dict.fromkeys(faults))

    def _transmit(self, t_ns: int) -> tuple[CanFrame, ...]:
        if self._p.transmitter is None:
            return ()
        times = self._frame_times_ns
        span_s = (times[-1] - times[0]) * 1e-9 if len(times) > 1 else 0.0
        stale = self._last_frame_ns is None or (t_ns - self._last_frame_ns) * 1e-9 > BLIND_AFTER_S
        faults = self._faults(t_ns, blind=stale) if self._last is None or stale else self._last.faults
        status = StatusInfo(
            fps=0.0 if stale or span_s <= 0 else (len(times) - 1) / span_s,
            faults=faults,
            temperature_c=self._temperature_c,
        )
        return self._p.transmitter.frames(self._last, status, t_ns)


def _source(plate: PlateSighting) -> Source:
    return "flow" if plate.source == "flow" else "plate"


def _scaled(found: RangeMeasurement, factor: float) -> RangeMeasurement:
    """The same measurement with all its distances along the axis times a factor."""
    cues = tuple(replace(c, distance_m=c.distance_m * factor, sigma_m=c.sigma_m * factor) for c in found.cues)
    return replace(
        found, distance_m=found.distance_m * factor, sigma_m=found.sigma_m * factor, noise_m=found.noise_m * factor, cues=cues
    )


def _placed(found: RangeMeasurement, pose: Pose) -> RangeMeasurement:
    """Measured along the optical axis: the distance stays, the bearing becomes the vehicle's, as that of boxes and lanes is."""
    x, y, z = to_vehicle(np.array([found.lateral_m, found.down_m, found.distance_m]), pose).tolist()
    z = max(z, 1e-3)  # what a turned camera sees beside or behind us is far off the path
    lateral_m = x / z * found.distance_m
    turned_m2 = (lateral_m**2 - found.lateral_m**2) * (found.sigma_m / found.distance_m) ** 2
    return replace(
        found, lateral_m=lateral_m, lateral_sigma_m=math.sqrt(max(found.lateral_sigma_m**2 + turned_m2, 0.0)),
        down_m=y / z * found.distance_m,
    )  # fmt: skip


def _relative_range(plate: PlateSighting, s: Sighting) -> RangeMeasurement:
    """A range of unknown scale from the plate's image size: enough for TTC, which no scale changes."""
    c = np.array(plate.corners_px)
    area_px2 = 0.5 * abs(float(np.dot(c[:, 0], np.roll(c[:, 1], -1)) - np.dot(c[:, 1], np.roll(c[:, 0], -1))))
    size_px = math.sqrt(max(area_px2, 1.0))
    sigma_px = plate.corners_sigma_px
    if plate.char_height_px is not None and plate.glyphs:
        # Glyph edges are many and sharp: their mean height carries the scale better than four corners do.
        sigma = math.sqrt(2.0 / len(plate.glyphs)) * float(np.mean([g.sigma_tb_px for g in plate.glyphs]))
        sigma_px = min(sigma_px, sigma * size_px / plate.char_height_px)
    distance_m = NOMINAL_FOCAL_PER_WIDTH * s.width_px * NOMINAL_PLATE_M / size_px
    noise_m = distance_m * max(sigma_px / size_px, 0.002)
    lateral_m = (float(c[:, 0].mean()) - (s.width_px - 1) / 2) / size_px * NOMINAL_PLATE_M
    return RangeMeasurement(
        track_id=plate.track_id, t_ns=s.t_ns, distance_m=distance_m, sigma_m=noise_m, noise_m=noise_m, scale_sigma=0.0,
        lateral_m=lateral_m, lateral_sigma_m=0.1 * abs(lateral_m) + 0.1, down_m=0.0,
    )  # fmt: skip
