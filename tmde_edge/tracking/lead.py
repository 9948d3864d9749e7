"""Tracks of plates in metres, and which of them is the lead: the nearest in the own path, with hysteresis."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import Literal

from tmde_edge.messages import EgoState, RangeMeasurement, ScaleChange
from tmde_edge.tracking.ego import EgoMotion
from tmde_edge.tracking.kalman import Innovation, RangeFilter
from tmde_edge.tracking.path import OwnPath
from tmde_edge.tracking.settings import TrackerSettings

Source = Literal["plate", "vehicle", "flow", "depth"]
LATERAL_TAU_S = 0.25  # smoothing of the lateral offset: short against a lane change of 2 to 4 s
STANDING_MPS = 1.0  # a vehicle that was never surely faster than this stands
# So long it must surely move to have moved: the first ranges of a far plate err together, and a tenth of a second of them may
# look like 15 m/s.
MOVED_NS = 200_000_000
ONCOMING_MPS, ONCOMING_SHARE = 3.0, 0.35
DEPTH_CARRIES_AFTER_S = 0.15  # without any other measurement for longer than this a reading carries the lead
DEPTH_CARRIES_NS = 600_000_000  # and it does so for this long ...
DEPTH_ADDS_S = 1.5  # ... but never more than this beyond coasting
SEEN_AGAIN = 5  # measurements after which alerts rest on the filter with depth again
HARDEST_MPS2 = 12.0  # two cars brake or part harder than this in a crash only
GUESS_LASTS_S = 2.0  # an outline that is only carried along keeps its error about this long
REAR_DEPTH_M = 0.15  # how far, one sigma, the vehicle's rear lies in front of or behind the plate's plane
CARRIES_S = 0.45  # a growth this old still stands: they come every 0.2 s
SPEED_LASTS_NS = 2_000_000_000  # what was known of its speed over ground holds this long while our own is lost
SAME_VEHICLE_LATERAL_M = 0.9  # a new identity this near to a coasting track is that vehicle again


@dataclass(slots=True, kw_only=True)
class Track:
    """One vehicle candidate."""

    track_id: int
    filter: RangeFilter
    t_ns: int  # of the filter's state
    measured_ns: int  # by its plate or by its vehicle
    plate_ns: int  # by its plate
    grown_ns: int | None = None  # by its vehicle, whether or not the plate was measured too
    lateral_m: float
    lateral_sigma_m: float
    scale_sigma: float
    source: Source
    hits: int = 1
    in_path: bool = False
    in_path_since_ns: int = 0
    moved: bool = False  # was ever surely seen to move over ground, for MOVED_NS
    moving_since_ns: int | None = None
    oncoming: bool = False  # came towards us when its speed over ground was last known
    speed_ns: int | None = None  # when that was
    stood: bool = False  # was last judged as what stands
    depth_ns: int | None = None  # when a distance by depth was last taken
    without_depth: RangeFilter | None = None  # since only depth carried: what would be known without it
    seen_again: int = 0  # measurements since then
    innovations: list[tuple[float, float]] = field(default_factory=list)  # (residual, sigma) of the last ranges

    @property
    def evidence(self) -> RangeFilter:
        """What alerts may rest on: never depth alone."""
        return self.without_depth if self.without_depth is not None else self.filter

    @property
    def speed_known(self) -> bool:
        """Whether its speed over ground is known, or was a moment ago."""
        return self.speed_ns is not None and self.t_ns - self.speed_ns <= SPEED_LASTS_NS

    @property
    def stands(self) -> bool:
        """Whether it was never seen to move; where its speed over ground is not known, it may."""
        return self.speed_known and not self.moved

    @property
    def filters(self) -> tuple[RangeFilter, ...]:
        """All that a measurement other than depth goes to."""
        return (self.filter,) if self.without_depth is None else (self.filter, self.without_depth)

    @property
    def sigma_m(self) -> float:
        """Whole sigma of the distance: the filter's and the scale's, which no averaging removes."""
        return math.hypot(
            math.sqrt(max(float(self.filter.covariance[0, 0]), 0.0)), self.scale_sigma * self.filter.distance_m
        )


class LeadTracker:
    """All tracks, fed with ranges and time.

    `metric` False: distances of unknown scale (uncalibrated). Our speed in true metres must not meet them: tracks are relative.
    """

    def __init__(self, settings: TrackerSettings, *, metric: bool = True) -> None:
        self._s = settings
        self._metric = metric
        self.tracks: dict[int, Track] = {}
        self.ego_motion = EgoMotion()
        self.path = OwnPath()
        self._ego: EgoState | None = None
        self._lead_id: int | None = None

    def set_ego(self, ego: EgoState | None) -> None:
        """The newest ego state, or None when it is not known (any more)."""
        self._ego = ego
        self.path.set_ego(ego)
        if ego is None:
            self.ego_motion.clear()
        else:
            self.ego_motion.add(ego)

    def predict(self, t_ns: int) -> None:
        """Moves every track on to t_ns and ends those that coasted too long or grew too uncertain."""
        yaw_radps = self._yaw_radps()
        for track in list(self.tracks.values()):
            dt_s = (t_ns - track.t_ns) * 1e-9
            if dt_s > 0:
                # While the speed was unknown the filter is relative; it changes over before it moves on.
                speed = self._approach_mps(track.lateral_m)
                track.filter.set_ego_speed(speed)
                sigma_m = (self._ego.speed_sigma_mps if self._ego is not None else 0.0) * dt_s
                travel_m = self._travel_m(track, track.t_ns, t_ns)
                track.lateral_m += yaw_radps * dt_s * track.filter.distance_m
                track.filter.predict(dt_s, travel_m, sigma_m)
                if track.without_depth is not None:
                    track.without_depth.set_ego_speed(speed)
                    track.without_depth.predict(dt_s, travel_m, sigma_m)
                track.lateral_sigma_m = math.hypot(track.lateral_sigma_m, 0.5 * dt_s)
                track.t_ns = t_ns
            carried = track.depth_ns is not None and t_ns - track.depth_ns <= DEPTH_CARRIES_NS
            if self._over(track, track.filter, t_ns, self._s.coast_s + (DEPTH_ADDS_S if carried else 0.0)):
                del self.tracks[track.track_id]

    def _yaw_radps(self) -> float:
        """Our turning, left positive; 0 where it is not known."""
        return 0.0 if self._ego is None or self._ego.yaw_rate_radps is None else self._ego.yaw_rate_radps

    def _approach_mps(self, lateral_m: float) -> float | None:
        """How fast what stands at this lateral place comes nearer along our axis; None where that is not known.

        The axis turns with us: z falls by v + x yaw, so what stands beside a bend must not look as if it drove.
        """
        if self._ego is None or not self._metric:
            return None
        return self._ego.speed_mps + lateral_m * self._yaw_radps()

    def _travel_m(self, track: Track, from_ns: int, to_ns: int) -> float:
        """The same over a time: our way, and what our turning adds at this track's place."""
        if self._ego is None or not self._metric:
            return 0.0
        return self.ego_motion.travel_m(from_ns, to_ns) + track.lateral_m * self._yaw_radps() * (to_ns - from_ns) * 1e-9

    def _over(self, track: Track, state: RangeFilter, t_ns: int, coast_s: float) -> bool:
        """True where nothing was measured for too long, or nothing is known any more."""
        coasted_s = (t_ns - track.measured_ns) * 1e-9
        sigma_m = math.hypot(math.sqrt(max(float(state.covariance[0, 0]), 0.0)), track.scale_sigma * state.distance_m)
        lost = sigma_m > self._s.drop_sigma * max(state.distance_m, 1.0) and track.hits >= self._s.confirm_hits
        return coasted_s > coast_s or (lost and coasted_s > 0.2) or state.distance_m <= 0

    def known_without_depth(self, track: Track, t_ns: int) -> bool:
        """False where only depth still carries the track: it is shown then, and nothing is told of it."""
        return track.without_depth is None or not self._over(track, track.without_depth, t_ns, self._s.coast_s)

    def update(self, measurement: RangeMeasurement, source: Source, *, guessed: bool = False) -> Track:
        """One range of one track; predict() must have been called for its time."""
        track = self.tracks.get(measurement.track_id) or self._adopt(measurement)
        if track is None:
            track = Track(
                track_id=measurement.track_id,
                filter=RangeFilter(
                    self._s,
                    distance_m=measurement.distance_m,
                    noise_m=measurement.noise_m,
                    ego_speed_mps=self._approach_mps(measurement.lateral_m),
                ),
                t_ns=measurement.t_ns,
                measured_ns=measurement.t_ns,
                plate_ns=measurement.t_ns,
                lateral_m=measurement.lateral_m,
                lateral_sigma_m=measurement.lateral_sigma_m,
                scale_sigma=measurement.scale_sigma,
                source=source,
            )
            track.filter.set_anchor(measurement.t_ns)
            self.tracks[track.track_id] = track
            return track
        noise_m = measurement.noise_m
        if guessed:  # one error in all frames of a while: together they may weigh as much as one range
            since_s = max((measurement.t_ns - track.plate_ns) * 1e-9, GUESS_LASTS_S * 1e-3)
            noise_m *= math.sqrt(max(1.0, GUESS_LASTS_S / since_s))
        innovation = track.filter.update_range(measurement.distance_m, noise_m, guessed=guessed)
        if track.without_depth is not None:
            track.without_depth.update_range(measurement.distance_m, noise_m, guessed=guessed)
            track.seen_again += 1
            if track.seen_again >= SEEN_AGAIN:
                track.without_depth = None
        if innovation.accepted:
            gain = track.lateral_sigma_m**2 / (track.lateral_sigma_m**2 + measurement.lateral_sigma_m**2 + 1e-9)
            dt_s = (measurement.t_ns - track.plate_ns) * 1e-9
            gain = max(gain, 1.0 - math.exp(-dt_s / LATERAL_TAU_S))
            track.lateral_m += gain * (measurement.lateral_m - track.lateral_m)
            track.lateral_sigma_m = math.sqrt(1.0 - min(gain, 0.9)) * math.hypot(track.lateral_sigma_m, 1e-3)
            track.scale_sigma = measurement.scale_sigma
            track.measured_ns = track.plate_ns = measurement.t_ns
            track.source = source
            track.hits += 1
        track.innovations = [*track.innovations[-49:], (innovation.residual, innovation.sigma)]
        return track

    def update_depth(self, track: Track, distance_m: float, sigma_m: float, reading_ns: int, t_ns: int) -> None:
        """One distance by depth as of reading_ns, taken at t_ns (the time of the track's state)."""
        idle_s = (t_ns - track.measured_ns) * 1e-9
        carries = idle_s > DEPTH_CARRIES_AFTER_S and not self.carries(track.track_id, t_ns)
        if carries and track.without_depth is None:
            track.without_depth = copy.deepcopy(track.filter)
        if carries:
            track.seen_again = 0
        age_s, travel_m = (t_ns - reading_ns) * 1e-9, self._travel_m(track, reading_ns, t_ns)
        if track.filter.update_depth(distance_m, sigma_m, age_s, travel_m).accepted:
            track.depth_ns = t_ns
            if carries:
                track.source = "depth"

    def grow(self, change: ScaleChange, t_ns: int) -> None:
        """Growth of the vehicle's rear up to now, free of metres; carries the distance where the plate is not measured."""
        track = self.tracks.get(change.track_id)
        if track is None or change.ratio <= 0 or t_ns <= change.t_from_ns:
            return
        carried = track.plate_ns < t_ns
        if carried and not self._s.vehicle_scale:
            for f in track.filters:
                f.set_anchor(t_ns)
            return
        # What is not in the plate's plane grows by another factor: by the share of its depth in the distance.
        depth = abs(math.log(change.ratio)) * REAR_DEPTH_M / max(track.filter.distance_m, 1.0)
        sigma = math.hypot(change.sigma, change.ratio * depth)
        # Ranges may have made a speed up. Without any since, the speed changes as braking allows, or this is another thing.
        since_s = (t_ns - max(track.plate_ns, track.grown_ns or 0)) * 1e-9
        most_mps = math.inf if track.plate_ns >= change.t_from_ns else HARDEST_MPS2 * since_s
        innovation, *_ = [_grow(f, change, sigma, t_ns, most_mps) for f in track.filters]
        if innovation.accepted:
            track.grown_ns = t_ns
            if carried:
                track.measured_ns, track.source = t_ns, "vehicle"

    def carries(self, track_id: int, t_ns: int) -> bool:
        """Whether the vehicle's rear carries this track's distance now, so that a plate only guessed at is not needed."""
        track = self.tracks.get(track_id)
        if track is None or track.grown_ns is None or not self._s.vehicle_scale:
            return False
        return (t_ns - track.grown_ns) * 1e-9 <= CARRIES_S

    def place(self, track_id: int, lateral_ratio: float, sigma_ratio: float) -> None:
        """Where a track's vehicle is seen (x / z in the vehicle's axes) while its plate is not measured."""
        track = self.tracks.get(track_id)
        if track is not None:
            track.lateral_m = lateral_ratio * track.filter.distance_m
            track.lateral_sigma_m = math.hypot(sigma_ratio * track.filter.distance_m, abs(lateral_ratio) * track.sigma_m)

    def _adopt(self, measurement: RangeMeasurement) -> Track | None:
        """A new image identity that continues a coasting track in metres takes over its state."""
        for track in self.tracks.values():
            if track.measured_ns >= measurement.t_ns:
                continue
            gap_m = abs(track.filter.distance_m - measurement.distance_m)
            sigma_m = math.hypot(track.sigma_m, measurement.sigma_m)
            if gap_m <= 3 * sigma_m and abs(track.lateral_m - measurement.lateral_m) <= SAME_VEHICLE_LATERAL_M:
                del self.tracks[track.track_id]
                if self._lead_id == track.track_id:
                    self._lead_id = measurement.track_id
                track.track_id = measurement.track_id
                self.tracks[track.track_id] = track
                return track
        return None

    def path_offset_m(self, track: Track) -> tuple[float, float]:
        """Lateral offset of a track (right positive) from the path that speed and yaw rate predict, and its sigma."""
        return self.path.offset_m(track.t_ns, track.lateral_m, track.lateral_sigma_m, track.filter.distance_m)

    def _judge(self, track: Track) -> None:
        """What a track's speed over ground tells. Only evidence counts: a loss of our own speed tells nothing."""
        speed = track.filter.lead_speed_mps
        if self._ego is None or speed is None:
            return
        track.speed_ns = track.t_ns
        if not _moves(track, speed):
            track.moving_since_ns = None
        elif track.moving_since_ns is None:
            track.moving_since_ns = track.t_ns
        track.moved = track.moved or (track.moving_since_ns is not None and track.t_ns - track.moving_since_ns >= MOVED_NS)
        track.oncoming = _oncoming(track, speed, self._ego.speed_mps)

    def _in_path(self, track: Track) -> bool:
        """With hysteresis. What stands and never moved is mostly parked: lane and arc must both lead to it."""
        if track.oncoming and track.speed_known:
            return False
        offset_m, sigma_m = self.path_offset_m(track)
        if track.stands:
            # The wide path of what may move keeps nothing in this one.
            limit_m = self._s.standing_leave_m if track.in_path and track.stood else self._s.standing_half_width_m
            arc_m, arc_sigma_m = self.path.arc_offset_m(track.lateral_m, track.lateral_sigma_m, track.filter.distance_m)
            worst_m = max(abs(o) + self._s.standing_sigma * s for o, s in ((offset_m, sigma_m), (arc_m, arc_sigma_m)))
            return worst_m <= limit_m
        return abs(offset_m) <= (self._s.path_leave_m if track.in_path else self._s.path_half_width_m)

    def choose(self, t_ns: int) -> Track | None:
        """The lead at t_ns: nearest in the path; a nearer one must stay in it for lead_hold_s to take over."""
        candidates = []
        for track in self.tracks.values():
            self._judge(track)
            inside = self._in_path(track)
            track.stood = track.stands
            if inside and not track.in_path:
                track.in_path_since_ns = t_ns
            track.in_path = inside
            if inside and track.hits >= self._s.confirm_hits:
                candidates.append(track)
        if not candidates:
            self._lead_id = None
            return None
        nearest = min(candidates, key=lambda c: c.filter.distance_m)
        current = next((c for c in candidates if c.track_id == self._lead_id), None)
        held_s = (t_ns - nearest.in_path_since_ns) * 1e-9
        if current is not None and nearest is not current and held_s < self._s.lead_hold_s:
            nearest = current
        self._lead_id = nearest.track_id
        return nearest


def _grow(state: RangeFilter, change: ScaleChange, sigma: float, t_ns: int, most_mps: float = math.inf) -> Innovation:
    """Takes a growth of the image; one that contradicts the speed of a new track, or twice in a row, restarts that speed.

    most_mps: the largest such change. Growth is much surer of the speed than differences between a far plate's ranges.
    """
    innovation = state.update_growth(change.ratio, sigma, change.t_from_ns)
    dt_s = (t_ns - change.t_from_ns) * 1e-9
    rate, rate_sigma = -math.log(change.ratio) / dt_s, sigma / change.ratio / dt_s
    if innovation is None:  # begun before this track was measured: the mean closing since then is all it says
        innovation = state.update_inverse_ttc(rate, rate_sigma)
    jump_mps = abs(rate * state.distance_m - state.range_rate_mps) - 2.0 * rate_sigma * state.distance_m
    if not innovation.accepted and state.closing_doubted and jump_mps <= most_mps:
        state.restart_closing(rate, rate_sigma)
    state.closing_doubted = not innovation.accepted
    state.set_anchor(t_ns)
    return innovation


def _moves(track: Track, speed_mps: float) -> bool:
    """Whether it surely drives away from where it is, also where its plate's size is not quite known."""
    sigma = math.sqrt(max(float(track.filter.covariance[1, 1]), 0.0))
    return speed_mps - 2.0 * math.hypot(sigma, track.scale_sigma * track.filter.range_rate_mps) > STANDING_MPS


def _oncoming(track: Track, speed_mps: float, ego_mps: float) -> bool:
    """Whether it comes towards us, by more than a wrong size of its plate would feign: never a lead."""
    sigma = math.sqrt(max(float(track.filter.covariance[1, 1]), 0.0))
    return speed_mps + 2.0 * sigma < -max(ONCOMING_MPS, ONCOMING_SHARE * ego_mps)
