"""Frame -> Sighting: full searches at a steady rate of source time, region searches round every track, flow between.

Nothing here reads a clock to decide: `clock_ns` only fills `timing_ms`. Times are the frames' own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from tmde_edge.messages import Frame, Mode, PlateSighting, Point, ScaleChange, Sighting, VehicleBox
from tmde_edge.vision.detect.contour import box_iou
from tmde_edge.vision.flow import FlowStep, Growth, Template, follow, follow_rear, grow, make_template
from tmde_edge.vision.likeness import Looks, view_of
from tmde_edge.vision.protocols import Image, PlateCandidate, PlateReader, PlateReading
from tmde_edge.vision.rectify import Array, bounds, is_convex, size_px
from tmde_edge.vision.search import PlateSearch, Region, fovea_region
from tmde_edge.vision.settings import DetectorSettings, FlowSettings, SegmenterSettings
from tmde_edge.vision.sighting import is_blind, plate_sighting

EARLY_NS = 2_000_000  # a search may run this much before it is due: frame times jitter
LONGEST_STEP_NS = 1_000_000_000  # after a gap longer than this between frames no track is carried over
VELOCITY_SHARE = 0.6  # of a new step in the smoothed image velocity
BRIDGE_HITS = 3  # sightings before flow alone may carry a plate
MISSES = 2  # frames in a row without a sighting that end a track before it was confirmed
REAR_LOST_NS = 250_000_000  # a vehicle whose rear flow has not followed for this long is lost
SETTLED_NS = 250_000_000  # the finder itself looks at a settled track again after this long
SETTLED_SIGMA = 0.15  # of a plate's height: a prediction this good needs no search, the reader's crop holds the plate
BETWEEN = 3.0  # work that can wait one frame is not done beside a full search where frames come this much quicker
REREAD_PLATEHOOD = 0.1  # below this a reader's corners say nothing
SAME_STILL_IOU = 0.3  # finer looks at a still: overlap with a plate already read
SAME_PLATE_IOU = 0.15  # overlap with the predicted box that makes a candidate the same plate


def _joint_score(candidate: PlateCandidate, reading: PlateReading) -> float:
    """Finder and reader together: the geometric mean of their opinions; the finder's where the reader has none."""
    return candidate.score if reading.platehood is None else float(np.sqrt(candidate.score * reading.platehood))


@dataclass(slots=True)
class _Track:
    """One plate followed through the image."""

    corners_px: Array
    score: float
    seen_ns: int  # last detection
    hits: int = 1
    misses: int = 0  # frames since the last hit
    found_ns: int = 0  # last time that the finder itself saw it, and how sure it was
    found_score: float = 0.0
    judged: bool = False  # the reader has an opinion whether this is a plate
    needed: int = 2  # hits before it is reported
    sure: bool = False  # was once beyond doubt
    id: int = 0  # 0 until confirmed
    velocity_px: Array = field(default_factory=lambda: np.zeros((4, 2)))  # corners' motion a nanosecond
    sigma_px: float = 1.0
    template: Template | None = None  # of the last frame
    anchor: Template | None = None  # where the present scale change starts
    anchor_ns: int = 0
    rear_ns: int = 0  # the vehicle's rear was last followed
    looks: Looks = field(default_factory=Looks)


@dataclass(slots=True)
class _Timing:
    """Milliseconds by stage."""

    clock_ns: Callable[[], int]
    start_ns: int
    stages: dict[str, float] = field(default_factory=dict)
    last_ns: int = 0

    def done(self, stage: str) -> None:
        now = self.clock_ns()
        self.stages[stage] = self.stages.get(stage, 0.0) + (now - self.last_ns) * 1e-6
        self.last_ns = now

    def total(self) -> dict[str, float]:
        return {"total": (self.clock_ns() - self.start_ns) * 1e-6, **self.stages}


class Perception:
    """Finds, follows and measures plates. One object per camera; `see` remembers, `see_still` does not."""

    def __init__(
        self, *, search: PlateSearch, reader: PlateReader, detector: DetectorSettings, segmenter: SegmenterSettings,
        flow: FlowSettings, clock_ns: Callable[[], int],
    ) -> None:
        self._search = search
        self._reader = reader
        self._detector = detector
        self._segmenter = segmenter
        self._flow = flow
        self._clock_ns = clock_ns
        self.thinning = 1.0  # full and fovea searches are this much rarer: the live loop sheds load by it
        self.far_point_px: Point | None = None  # the driving path's far end, where known: the fovea looks there
        self._reset()

    def _reset(self) -> None:
        self._tracks: list[_Track] = []
        self._next_id = 1
        self._mode: Mode = "strict"
        self._without_plate = 0
        self._last_ns: int | None = None
        self._searched_ns: int | None = None
        self._fovea_ns: int | None = None

    def see_still(self, frame: Frame) -> Sighting:
        """A picture by itself: nothing remembered, nothing carried over to the next one."""
        timing = self._timer()
        image = frame.image
        if is_blind(image, self._detector.blind_contrast):
            return self._sighting(frame, "blind", (), (), True, "strict", timing)
        mode: Mode = "strict"
        found: list[tuple[PlateCandidate, PlateReading]] = []
        for candidates in self._search.still(image, mode):
            timing.done("detect")
            # a place read badly at a small scale may be read well at a larger one
            known = [c for c, r in found if self._credible(r, self._segmenter.still_platehood_min)]
            fresh = [c for c in candidates if all(box_iou(c.corners_px, k.corners_px) <= SAME_STILL_IOU for k in known)]
            best = sorted(fresh, key=lambda c: -c.score)[: self._detector.max_plates]
            found += self._read_twice(image, best)
            timing.done("read")
            if any(self._sure(c, r) for c, r in found):
                break
        plates: list[PlateSighting] = []
        shown: list[PlateReading] = []
        for c, r in sorted(found, key=lambda pair: -_joint_score(*pair)):
            # two candidates may turn out to be one plate once their corners are read
            double = any(box_iou(r.corners_px, s.corners_px) > SAME_STILL_IOU for s in shown)
            if self._credible(r, self._segmenter.still_platehood_min) and not double:
                shown.append(r)
                score = _joint_score(c, r)
                plates.append(
                    plate_sighting(
                        r, track_id=0, score=score, source="detector", shape=image.shape, settings=self._segmenter
                    )
                )
        return self._sighting(frame, "ok" if plates else "no_plate", tuple(plates), (), True, mode, timing)

    def _read_twice(self, image: Image, candidates: list[PlateCandidate]) -> list[tuple[PlateCandidate, PlateReading]]:
        """Reads candidates; what is doubtful is read again where the reader itself puts the corners.

        A plate that the finder saw at a small scale is cut badly at first.
        """
        pairs = list(zip(candidates, self._reader.read(image, candidates), strict=True))
        least = self._segmenter.still_platehood_min
        again = [
            i for i, (_, r) in enumerate(pairs)
            if r.platehood is not None and REREAD_PLATEHOOD <= r.platehood < least and is_convex(r.corners_px)
        ]  # fmt: skip
        better = self._reader.read(image, [replace(pairs[i][0], corners_px=pairs[i][1].corners_px) for i in again])
        for i, reading in zip(again, better, strict=True):
            if (reading.platehood or 0.0) >= self._segmenter.reread_platehood_min:
                pairs[i] = (pairs[i][0], reading)
        return pairs

    def _sure(self, candidate: PlateCandidate, reading: PlateReading) -> bool:
        """Whether this is surely a plate, so that nothing finer needs to be looked at."""
        if reading.platehood is None:
            return candidate.score >= self._detector.confident_score
        return reading.platehood >= self._detector.confident_score and candidate.score >= self._detector.score_min

    def see(self, frame: Frame) -> Sighting:
        """The next frame of a drive. Frames come in order of time; after a step back or a long gap all tracks are new."""
        timing = self._timer()
        image, t_ns = frame.image, frame.t_ns
        if self._last_ns is not None and not 0 < t_ns - self._last_ns <= LONGEST_STEP_NS:
            self._tracks = []
            self._searched_ns = self._fovea_ns = None
        step_ns = 0 if self._last_ns is None else t_ns - self._last_ns
        self._last_ns = t_ns
        self._forget_old(t_ns)
        if is_blind(image, self._detector.blind_contrast):
            for track in self._tracks:
                track.template = track.anchor = None
            self._count(False)
            return self._sighting(frame, "blind", (), (), False, self._mode, timing)

        steps = [self._predict(track, image, t_ns, step_ns) for track in self._tracks]
        timing.done("flow")
        settled = [self._settled(track, step, t_ns) for track, step in zip(self._tracks, steps, strict=True)]
        searched, candidates = self._look(image, t_ns, settled)
        timing.done("detect")
        matched, fresh = self._associate(candidates)
        plates = self._measure(image, t_ns, step_ns, steps, settled, matched, fresh)
        timing.done("read")
        changes = self._scale_changes(image, t_ns, busy=self._busy(t_ns, step_ns))
        self._retire(image, t_ns)
        timing.done("flow")
        mode = self._mode
        self._count(any(p.source == "detector" for p in plates))
        vehicles = self._vehicles({p.track_id for p in plates}, t_ns)
        return self._sighting(frame, "ok" if plates else "no_plate", plates, changes, searched, mode, timing, vehicles)

    def _timer(self) -> _Timing:
        now = self._clock_ns()
        return _Timing(clock_ns=self._clock_ns, start_ns=now, last_ns=now)

    def _predict(self, track: _Track, image: Image, t_ns: int, step_ns: int) -> FlowStep | None:
        """Moves a track to this frame: by its velocity, then by flow where that succeeds."""
        guess = track.corners_px + track.velocity_px * step_ns
        if not is_convex(guess):
            guess = track.corners_px
        step = None
        if self._flow.enabled and track.template is not None:
            step = follow(track.template, image, guess, self._flow)
            if (step is None or step.rear is None) and self._bridges(track) and not self._plate_followed(track, step, image):
                step = follow_rear(track.template, image, guess, self._flow)
        if step is not None and not is_convex(step.corners_px):
            step = None
        track.corners_px = guess if step is None else step.corners_px
        if step is not None and step.rear is not None:
            track.rear_ns = t_ns
        # drift of the flow adds up until the next detection; without flow the guess is a plate's own motion off
        track.sigma_px = float(np.hypot(track.sigma_px, step.sigma_px if step is not None else 2.0))
        return step

    @staticmethod
    def _plate_followed(track: _Track, step: FlowStep | None, image: Image) -> bool:
        """Whether the plate's own features went on with the plate, and not with what sweeps across it."""
        if step is None or not is_convex(step.corners_px):
            return False
        return not track.looks.contradicted(view_of(image, step.corners_px))

    def _busy(self, t_ns: int, step_ns: int) -> bool:
        """Whether this frame has a full search to pay for, or follows one (lanes are looked for then), and others come soon."""
        soon = 0 < step_ns * 1e-9 * BETWEEN <= min(self._flow.base_s, 1 / self._detector.search_rate_hz) + EARLY_NS * 1e-9
        return soon and self._searched_ns is not None and t_ns - self._searched_ns < 1.5 * step_ns

    def _settled(self, track: _Track, step: FlowStep | None, t_ns: int) -> bool:
        """Whether flow knows where this plate is so well that the reader alone can say whether it is still there."""
        return (
            step is not None
            and track.judged
            and self._bridges(track)
            and track.misses == 0
            and t_ns - track.found_ns <= SETTLED_NS
            and track.sigma_px <= SETTLED_SIGMA * size_px(track.corners_px)[1]
        )

    def _look(self, image: Image, t_ns: int, settled: list[bool]) -> tuple[bool, list[PlateCandidate]]:
        """Region searches round every track that is not settled, and the full search or the fovea when due."""
        found: list[PlateCandidate] = []
        for track, known in zip(self._tracks, settled, strict=True):
            region = None if known else self._region(track, image)
            if region is not None:
                # where a plate is known to be, a weaker sign of it is enough
                mode: Mode = "permissive" if self._bridges(track) else self._mode
                found += self._search.region(image, region, size_px(track.corners_px)[0], mode)
        if self._due(self._searched_ns, t_ns, self._detector.search_rate_hz / self.thinning):
            self._searched_ns = t_ns
            return True, found + self._search.frame(image, self._mode)
        if self._detector.fovea and self._due(self._fovea_ns, t_ns, self._detector.fovea_rate_hz / self.thinning):
            self._fovea_ns = t_ns
            window = fovea_region(image.shape[1], image.shape[0], self.far_point_px, self._detector)
            # a settled plate in the window is on a vehicle that hides what lies beyond
            if not any(k and _within(t.corners_px, window) for t, k in zip(self._tracks, settled, strict=True)):
                found += self._search.region(image, window, None, self._mode)
        return False, found

    @staticmethod
    def _due(last_ns: int | None, t_ns: int, rate_hz: float) -> bool:
        return last_ns is None or t_ns - last_ns >= 1e9 / rate_hz - EARLY_NS

    def _region(self, track: _Track, image: Image) -> Region | None:
        """The predicted box with its margin, inside the image; None where nothing of it is left."""
        h, w = image.shape[:2]
        x0, y0, x1, y1 = bounds(track.corners_px)
        margin = self._detector.region_margin * (x1 - x0)
        region = max(0, int(x0 - margin)), max(0, int(y0 - margin)), min(w, int(x1 + margin)), min(h, int(y1 + margin))
        return region if region[2] - region[0] >= 8 and region[3] - region[1] >= 8 else None

    def _associate(self, candidates: list[PlateCandidate]) -> tuple[dict[int, PlateCandidate], list[PlateCandidate]]:
        """Greedy by score and overlap: candidate of each track (by position), and those that belong to none.

        Ids keep who was there first: of two tracks that want one candidate the better overlap wins.
        """
        pairs = []
        for c_i, c in enumerate(candidates):
            for t_i, track in enumerate(self._tracks):
                overlap = box_iou(c.corners_px, track.corners_px)
                if overlap > SAME_PLATE_IOU:
                    pairs.append((c.score * (0.5 + overlap), c_i, t_i))
        matched: dict[int, PlateCandidate] = {}
        for _, c_i, t_i in sorted(pairs, key=lambda p: (-p[0], p[1], p[2])):
            if t_i not in matched and not any(candidates[c_i] is m for m in matched.values()):
                matched[t_i] = candidates[c_i]
        taken = {c_i for _, c_i, _ in pairs}
        fresh: list[PlateCandidate] = []
        for i, c in sorted(enumerate(candidates), key=lambda p: -p[1].score):
            if i not in taken and all(box_iou(c.corners_px, f.corners_px) <= SAME_PLATE_IOU for f in fresh):
                fresh.append(c)
        return matched, fresh[: max(0, self._detector.max_plates - len(self._tracks))]

    def _measure(
        self, image: Image, t_ns: int, step_ns: int, steps: list[FlowStep | None], settled: list[bool],
        matched: dict[int, PlateCandidate], fresh: list[PlateCandidate],
    ) -> tuple[PlateSighting, ...]:
        """Reads every track where it was found (or where flow carried it) and every new candidate; updates the tracks."""
        tracks = list(self._tracks)
        wanted, busy = [], self._busy(t_ns, step_ns)
        for i, t in enumerate(tracks):
            if i in matched:
                t.found_ns, t.found_score = t_ns, matched[i].score
            if settled[i]:  # flow carries the place better than a search of the whole frame
                wanted.append(PlateCandidate(corners_px=t.corners_px, score=t.found_score, hurried=busy))
            else:
                wanted.append(matched.get(i) or PlateCandidate(corners_px=t.corners_px, score=self._faded(t, t_ns)))
        readings = self._reader.read(image, wanted + fresh)
        plates: list[PlateSighting] = []
        for i, track in enumerate(tracks):
            reading = readings[i]
            view = view_of(image, reading.corners_px) if is_convex(reading.corners_px) else None
            credible = self._credible(reading) and not track.looks.contradicted(view)
            if credible and (i in matched or settled[i]):
                self._hit(track, wanted[i], reading, t_ns, step_ns)
                track.looks.learn(view)
                plates += self._report(track, reading, track.score, "detector", image)
                continue
            track.misses += 1
            if self._hidden(track, t_ns):  # only its vehicle is still followed
                continue
            if steps[i] is not None and self._bridges(track) and self._inside(track, image):
                seen = credible and reading.refined and _near(track, reading)
                carried = reading if seen else _bare(track, reading)
                self._carry(track, carried, step_ns)
                plates += self._report(track, carried, wanted[i].score, "flow", image)
        for candidate, reading in zip(fresh, readings[len(tracks) :], strict=True):
            if self._credible(reading) and is_convex(reading.corners_px):
                track = _Track(corners_px=reading.corners_px, score=_joint_score(candidate, reading), seen_ns=t_ns)
                track.sigma_px = reading.corners_sigma_px
                track.found_ns, track.found_score = t_ns, candidate.score
                # a lower bar for candidates needs one more look before anything is claimed
                track.needed = self._detector.confirm_hits + (1 if self._mode == "permissive" else 0)
                self._tracks.append(track)
                self._confirm(track)
                plates += self._report(track, reading, track.score, "detector", image)
        return tuple(plates)

    @staticmethod
    def _bridges(track: _Track) -> bool:
        """Whether flow alone may carry this plate: it was seen well or often enough."""
        return track.id > 0 and (track.sure or track.hits >= BRIDGE_HITS)

    def _faded(self, track: _Track, t_ns: int) -> float:
        """The score of a plate that the detector has not seen since: none is left when the track ends."""
        return track.score * max(0.0, 1.0 - (t_ns - track.seen_ns) * 1e-9 / self._detector.lost_s)

    def _credible(self, reading: PlateReading, least: float | None = None) -> bool:
        least = self._segmenter.platehood_min if least is None else least
        return reading.platehood is None or reading.platehood >= least

    @staticmethod
    def _inside(track: _Track, image: Image) -> bool:
        """Whether the plate's middle is still in the image."""
        x, y = track.corners_px.mean(axis=0)
        return bool(-0.5 <= x <= image.shape[1] - 0.5 and -0.5 <= y <= image.shape[0] - 0.5)

    def _hit(
        self, track: _Track, candidate: PlateCandidate, reading: PlateReading, t_ns: int, step_ns: int
    ) -> None:
        self._carry(track, reading, step_ns)
        track.score, track.seen_ns = _joint_score(candidate, reading), t_ns
        track.hits, track.misses = track.hits + 1, 0
        track.judged = reading.platehood is not None
        track.sigma_px = reading.corners_sigma_px
        self._confirm(track)

    @staticmethod
    def _carry(track: _Track, reading: PlateReading, step_ns: int) -> None:
        if not is_convex(reading.corners_px):
            return
        if step_ns > 0 and track.template is not None:
            moved = (reading.corners_px - track.template.corners_px).mean(axis=0) / step_ns
            track.velocity_px = (1 - VELOCITY_SHARE) * track.velocity_px + VELOCITY_SHARE * moved
        track.corners_px = reading.corners_px

    def _confirm(self, track: _Track) -> None:
        track.sure = track.sure or track.score >= self._detector.confident_score
        if not track.id and (track.sure or track.hits >= track.needed):
            track.id = self._next_id
            self._next_id += 1

    def _report(
        self, track: _Track, reading: PlateReading, score: float, source: Literal["detector", "flow"], image: Image
    ) -> list[PlateSighting]:
        if not track.id:
            return []
        settings = self._segmenter
        return [
            plate_sighting(reading, track_id=track.id, score=score, source=source, shape=image.shape, settings=settings)
        ]

    def _scale_changes(self, image: Image, t_ns: int, *, busy: bool) -> tuple[ScaleChange, ...]:
        """Growth of confirmed tracks since their anchor, directly between the two images, once every base_s; not while busy."""
        changes: list[ScaleChange] = []
        if not self._flow.enabled or busy:
            return ()
        for track in self._tracks:
            if track.anchor is None or not track.id or t_ns - track.anchor_ns < self._flow.base_s * 1e9 - EARLY_NS:
                continue
            plate, rear = grow(track.anchor, image, track.corners_px, self._flow)
            changes += _changes(track, plate, rear)
            track.anchor = None
        return tuple(changes)

    def _vehicles(self, shown: set[int], t_ns: int) -> tuple[VehicleBox, ...]:
        """The followed rears of confirmed tracks whose plate is not seen in this frame."""
        boxes = []
        for track in self._tracks:
            if track.id and track.id not in shown and track.rear_ns == t_ns:
                x0, y0, x1, y1 = bounds(track.corners_px)
                ring = self._flow.ring * size_px(track.corners_px)[1]
                boxes.append(VehicleBox(track_id=track.id, left_px=x0 - ring, top_px=y0 - ring, right_px=x1 + ring,
                                        bottom_px=y1 + ring, sigma_px=track.sigma_px))
        return tuple(boxes)

    def _retire(self, image: Image, t_ns: int) -> None:
        """Ends tracks that are doubled or outside; renews the templates of the others."""
        kept: list[_Track] = []
        for track in sorted(self._tracks, key=lambda t: (t.id == 0, t.id, -t.score)):
            doubled = any(box_iou(track.corners_px, k.corners_px) > 0.4 for k in kept)
            if doubled or not self._inside(track, image) or min(size_px(track.corners_px)) < 2:
                continue
            kept.append(track)
        self._tracks = kept
        if not self._flow.enabled:
            return
        for track in self._tracks:
            track.template = make_template(image, track.corners_px, self._flow)
            if track.anchor is None:
                track.anchor, track.anchor_ns = track.template, t_ns

    def _forget_old(self, t_ns: int) -> None:
        # what was not confirmed must be seen at once again: it is looked for in every frame
        self._tracks = [
            t for t in self._tracks if (not self._hidden(t, t_ns) or self._by_vehicle(t, t_ns)) and (t.id or t.misses < MISSES)
        ]

    def _hidden(self, track: _Track, t_ns: int) -> bool:
        """Whether the plate itself was not seen for longer than flow is believed about it."""
        return t_ns - track.seen_ns > self._detector.lost_s * 1e9

    def _by_vehicle(self, track: _Track, t_ns: int) -> bool:
        """Whether a hidden plate's vehicle is still followed."""
        followed = t_ns - track.rear_ns <= REAR_LOST_NS and self._bridges(track)
        return followed and t_ns - track.seen_ns <= self._flow.carry_s * 1e9

    def _count(self, success: bool) -> None:
        """Strict and permissive: permissive after a run of frames without a plate, strict again on success."""
        self._without_plate = 0 if success else self._without_plate + 1
        self._mode = "permissive" if self._without_plate >= self._detector.permissive_after_frames else "strict"

    def _sighting(
        self, frame: Frame, status: Literal["ok", "no_plate", "blind"], plates: tuple[PlateSighting, ...],
        changes: tuple[ScaleChange, ...], searched: bool, mode: Mode, timing: _Timing,
        vehicles: tuple[VehicleBox, ...] = (),
    ) -> Sighting:
        return Sighting(
            t_ns=frame.t_ns, frame_index=frame.index, width_px=frame.image.shape[1], height_px=frame.image.shape[0],
            status=status, plates=plates, scale_changes=changes, vehicles=vehicles, mode=mode, searched=searched,
            timing_ms=timing.total(),
        )  # fmt: skip


def _within(corners_px: Array, region: Region) -> bool:
    """Whether a plate's middle lies in a region."""
    x, y = corners_px.mean(axis=0)
    return bool(region[0] <= x < region[2] and region[1] <= y < region[3])


def _near(track: _Track, reading: PlateReading) -> bool:
    """Whether what was read is the plate that flow carried, and not a neighbouring edge."""
    off = float(np.abs(reading.corners_px - track.corners_px).max())
    return off <= 3 * track.sigma_px + 0.04 * size_px(track.corners_px)[0]


def _bare(track: _Track, reading: PlateReading) -> PlateReading:
    """What flow alone knows of a plate: its place. Characters read there are kept only when the outline was seen too."""
    return PlateReading(
        corners_px=track.corners_px, corners_sigma_px=track.sigma_px, refined=False, characters=(),
        light_on_dark=reading.light_on_dark,
    )  # fmt: skip


def _changes(track: _Track, plate: Growth | None, rear: Growth | None) -> list[ScaleChange]:
    parts: list[tuple[Growth | None, Literal["plate", "vehicle"]]] = [(plate, "plate"), (rear, "vehicle")]
    return [
        ScaleChange(track_id=track.id, t_from_ns=track.anchor_ns, ratio=g.ratio, sigma=g.sigma, source=source)
        for g, source in parts
        if g is not None
    ]
