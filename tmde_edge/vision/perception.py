"""Frame -> Sighting: full searches at a steady rate of source time, region searches round every track, flow between.

Nothing here reads a clock to decide: `clock_ns` only fills `timing_ms`. Times are the frames' own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from tmde_edge.messages import Frame, Mode, PlateSighting, Point, ScaleChange, Sighting, VehicleBox
from tmde_edge.vision.flow import FlowStep, follow, follow_rear, grow, make_template
from tmde_edge.vision.judgement import credible, joint_score
from tmde_edge.vision.likeness import is_washed_out, small_look, view_of
from tmde_edge.vision.protocols import Image, PlateCandidate, PlateReader, PlateReading
from tmde_edge.vision.rectify import Array, bounds, is_convex, size_px
from tmde_edge.vision.search import PlateSearch, Region, fovea_region
from tmde_edge.vision.settings import DetectorSettings, FlowSettings, SegmenterSettings
from tmde_edge.vision.sighting import is_blind, plate_sighting, washed, without_ink
from tmde_edge.vision.still import STILL_MODE, StillLook
from tmde_edge.vision.timing import Timing
from tmde_edge.vision.track import Track, associate, without_doubles

EARLY_NS = 2_000_000  # a search may run this much before it is due: frame times jitter
LONGEST_STEP_NS = 1_000_000_000  # after a gap longer than this between frames no track is carried over
SMALL_SHARE = 0.5  # of the belief that is asked of larger plates
SMALL_PX = 40.0  # a plate narrower than this shows no more from closer up
ASKED_AGAIN_HITS = 3  # more hits before what did not look like a plate from closer up is looked at again
LONG_LOST_MISSES = 4  # a plate missed for longer is looked for in every other frame only, and not beside a full search
OUTLINE_NS = 200_000_000  # where frames come quickly a settled plate's outline, strokes and border are measured this often
BETWEEN = 3.0  # work that can wait one frame is not done beside a full search where frames come this much quicker


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
        self._still = StillLook(search, reader, detector, segmenter)
        self.thinning = 1.0  # full and fovea searches are this much rarer: the live loop sheds load by it
        self.far_point_px: Point | None = None  # the driving path's far end, where known: the fovea looks there
        self.shaken_px = 0.0  # how far the camera's own pitching moved the picture down since the last frame, where known
        self._reset()

    def _reset(self) -> None:
        self._tracks: list[Track] = []
        self._next_id = 1
        self._mode: Mode = "strict"
        self._without_plate = 0
        self._last_ns: int | None = None
        self._searched_ns: int | None = None
        self._fovea_ns: int | None = None

    def see_still(self, frame: Frame) -> Sighting:
        """A picture by itself: nothing remembered, nothing carried over to the next one."""
        timing = Timing(self._clock_ns)
        if is_blind(frame.image, self._detector.blind_contrast):
            return self._sighting(frame, "blind", (), (), True, STILL_MODE, timing)
        plates = self._still.plates(frame.image, timing)
        return self._sighting(frame, "ok" if plates else "no_plate", plates, (), True, STILL_MODE, timing)

    def see(self, frame: Frame) -> Sighting:
        """The next frame of a drive. Frames come in order of time; after a step back or a long gap all tracks are new."""
        timing = Timing(self._clock_ns)
        image, t_ns = frame.image, frame.t_ns
        if self._last_ns is not None and not 0 < t_ns - self._last_ns <= LONGEST_STEP_NS:
            self._tracks = []
            self._searched_ns = self._fovea_ns = None
        step_ns = 0 if self._last_ns is None else t_ns - self._last_ns
        self._last_ns = t_ns
        self._tracks = [t for t in self._tracks if t.alive(t_ns, self._detector, self._flow)]
        if is_blind(image, self._detector.blind_contrast):
            for track in self._tracks:
                track.template = track.anchor = None
            self._count(False)
            return self._sighting(frame, "blind", (), (), False, self._mode, timing)

        steps = [self._predict(track, image, t_ns, step_ns) for track in self._tracks]
        timing.done("flow")
        settled = [track.settled(step, t_ns) for track, step in zip(self._tracks, steps, strict=True)]
        searched, candidates = self._look(image, t_ns, step_ns, settled)
        timing.done("detect")
        matched, fresh = associate(self._tracks, candidates)
        fresh = fresh[: max(0, self._detector.max_plates - len(self._tracks))]
        plates = self._measure(image, t_ns, step_ns, steps, settled, matched, fresh)
        timing.done("read")
        changes = self._scale_changes(image, t_ns, busy=self._busy(t_ns, step_ns))
        self._retire(image, t_ns)
        timing.done("flow")
        mode = self._mode
        self._count(any(p.source == "detector" for p in plates))
        vehicles = self._vehicles({p.track_id for p in plates}, t_ns)
        return self._sighting(frame, "ok" if plates else "no_plate", plates, changes, searched, mode, timing, vehicles)

    def _predict(self, track: Track, image: Image, t_ns: int, step_ns: int) -> FlowStep | None:
        """Moves a track to this frame: by its velocity and the camera's pitching, then by flow where that succeeds."""
        track.shaken_px += self.shaken_px
        guess = track.corners_px + track.velocity_px * step_ns + (0.0, self.shaken_px)
        if not is_convex(guess):
            guess = track.corners_px
        step = None
        if self._flow.enabled and track.template is not None:
            step = follow(track.template, image, guess, self._flow)
            if (step is None or step.rear is None) and track.bridges and not self._plate_followed(track, step, image):
                step = follow_rear(track.template, image, guess, self._flow)
        if step is not None and not is_convex(step.corners_px):
            step = None
        track.corners_px = guess if step is None else step.corners_px
        track.placed = step is not None
        if step is not None and step.rear is not None:
            track.rear_ns = t_ns
        # drift of the flow adds up until the next detection; without flow the guess is a plate's own motion off
        track.sigma_px = float(np.hypot(track.sigma_px, step.sigma_px if step is not None else 2.0))
        return step

    @staticmethod
    def _plate_followed(track: Track, step: FlowStep | None, image: Image) -> bool:
        """Whether the plate's own features went on with the plate, and not with what sweeps across it."""
        if step is None or not is_convex(step.corners_px):
            return False
        return not track.looks.contradicted(view_of(small_look(image, step.corners_px), step.corners_px))

    def _soon(self, step_ns: int) -> bool:
        """Whether frames come so quickly that what is not done in this one is done soon enough."""
        return 0 < step_ns * 1e-9 * BETWEEN <= min(self._flow.base_s, 1 / self._detector.search_rate_hz) + EARLY_NS * 1e-9

    def _busy(self, t_ns: int, step_ns: int) -> bool:
        """Whether this frame has a full search to pay for, or follows one (lanes are looked for then), and others come soon."""
        return self._soon(step_ns) and self._searched_ns is not None and t_ns - self._searched_ns < 1.5 * step_ns

    def _look(self, image: Image, t_ns: int, step_ns: int, settled: list[bool]) -> tuple[bool, list[PlateCandidate]]:
        """Region searches round every track that is not settled, and the full search or the fovea when due."""
        found: list[PlateCandidate] = []
        full, soon = self._due(self._searched_ns, t_ns, self._detector.search_rate_hz / self.thinning), self._soon(step_ns)
        for track, known in zip(self._tracks, settled, strict=True):
            waits = soon and track.misses >= LONG_LOST_MISSES and (full or track.misses % 2 == 1)
            region = None if known or waits else self._region(track, image)
            if region is not None:
                # where a plate is known to be, a weaker sign of it is enough
                mode: Mode = "permissive" if track.bridges else self._mode
                found += self._search.region(image, region, size_px(track.corners_px)[0], mode)
        if full:
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

    def _region(self, track: Track, image: Image) -> Region | None:
        """The predicted box with its margin, inside the image; None where nothing of it is left."""
        h, w = image.shape[:2]
        x0, y0, x1, y1 = bounds(track.corners_px)
        margin = self._detector.region_margin * (x1 - x0)
        region = max(0, int(x0 - margin)), max(0, int(y0 - margin)), min(w, int(x1 + margin)), min(h, int(y1 + margin))
        return region if region[2] - region[0] >= 8 and region[3] - region[1] >= 8 else None

    def _measure(
        self, image: Image, t_ns: int, step_ns: int, steps: list[FlowStep | None], settled: list[bool],
        matched: dict[int, PlateCandidate], fresh: list[PlateCandidate],
    ) -> tuple[PlateSighting, ...]:
        """Reads every track where it was found (or where flow carried it) and every new candidate; updates the tracks."""
        tracks = list(self._tracks)
        wanted, soon, busy = [], self._soon(step_ns), self._busy(t_ns, step_ns)
        for i, t in enumerate(tracks):
            if i in matched:
                t.found_ns, t.found_score = t_ns, matched[i].score
            if settled[i]:  # flow carries the place better than a search of the whole frame
                hurried = busy or (soon and (t_ns - t.outlined_ns < OUTLINE_NS - EARLY_NS or self._growth_due(t, t_ns)))
                wanted.append(PlateCandidate(corners_px=t.corners_px, score=t.found_score, hurried=hurried))
            else:
                faded = t.faded_score(t_ns, self._detector.lost_s)
                wanted.append(matched.get(i) or PlateCandidate(corners_px=t.corners_px, score=faded))
        readings = self._reader.read(image, wanted + fresh)
        plates: list[PlateSighting] = []
        for i, track in enumerate(tracks):
            reading = readings[i]
            look = small_look(image, reading.corners_px)
            view, track.washed = view_of(look, reading.corners_px), is_washed_out(look)
            if track.washed:  # what glare eats and gives back again looks like growth
                track.anchor = None
            plate = self._is_plate(reading) and not track.looks.contradicted(view)
            if plate and (i in matched or settled[i]):
                source: Literal["detector", "flow"] = "detector"
                if track.washed and steps[i] is not None:  # it is there; where exactly, flow knows better
                    reading, source = without_ink(reading, track.corners_px, track.sigma_px), "flow"
                elif track.washed:
                    reading = washed(reading)
                if not wanted[i].hurried:
                    track.outlined_ns = t_ns
                track.hit(wanted[i], reading, t_ns)
                self._confirm(track, image, wanted[i], reading)
                if not track.washed:
                    track.looks.learn(view)
                plates += self._report(track, reading, track.score, source, image)
                continue
            track.misses += 1
            if track.hidden(t_ns, self._detector.lost_s):  # only its vehicle is still followed
                continue
            if steps[i] is not None and track.bridges and track.inside(image.shape[1], image.shape[0]):
                seen = plate and reading.refined and track.near(reading)
                carried = reading if seen else without_ink(reading, track.corners_px, track.sigma_px)
                track.carry(carried, t_ns)
                plates += self._report(track, carried, wanted[i].score, "flow", image)
        for candidate, reading in zip(fresh, readings[len(tracks) :], strict=True):
            if self._is_plate(reading):
                pale = is_washed_out(small_look(image, reading.corners_px))
                reading = washed(reading) if pale else reading
                track = Track(corners_px=reading.corners_px, score=joint_score(candidate, reading), seen_ns=t_ns, washed=pale)
                track.sigma_px = reading.corners_sigma_px
                track.found_ns, track.found_score = t_ns, candidate.score
                # a lower bar for candidates needs one more look before anything is claimed
                track.needed = self._detector.confirm_hits + (1 if self._mode == "permissive" else 0)
                self._tracks.append(track)
                self._confirm(track, image, candidate, reading)
                plates += self._report(track, reading, track.score, "detector", image)
        return tuple(plates)

    def _is_plate(self, reading: PlateReading) -> bool:
        """Whether a reading may be one of a plate: not denied by the reader, and of an outline that a plate can have."""
        return credible(reading, self._segmenter.platehood_min) and is_convex(reading.corners_px)

    def _confirm(self, track: Track, image: Image, candidate: PlateCandidate, reading: PlateReading) -> None:
        """Gives an identity to what seems sure, or was seen often enough, and looks like a plate from closer up too.

        A facade far ahead changes as little from frame to frame as a plate does: more hits alone say nothing new. And one
        frame's high scores are no proof: windows in rows have fooled finder and reader together. Of what is small there is little
        more to see from closer up: where finder and reader are sure of it, that is enough, or once it was doubted, half as much.
        """
        confident = track.score >= self._detector.confident_score
        if track.id:
            track.sure = track.sure or confident
            return
        clear = confident and size_px(track.corners_px)[0] < SMALL_PX  # as clear as something so small can be
        enough = clear and not track.doubted
        worth_asking = clear or (confident and not track.doubted) or track.hits >= track.needed
        if not worth_asking:
            return
        judged = reading.platehood is not None  # a reader without an opinion leaves it to finder and hits
        belief_min = self._detector.still_belief_min * (SMALL_SHARE if clear else 1.0)
        if judged and not enough and self._still.belief(image, candidate, reading) < belief_min:
            track.doubted, track.needed = True, track.hits + ASKED_AGAIN_HITS
            return
        track.id, track.sure = self._next_id, confident
        self._next_id += 1

    def _report(
        self, track: Track, reading: PlateReading, score: float, source: Literal["detector", "flow"], image: Image
    ) -> list[PlateSighting]:
        if not track.id:
            return []
        settings = self._segmenter
        return [
            plate_sighting(reading, track_id=track.id, score=score, source=source, shape=image.shape, settings=settings)
        ]

    def _scale_changes(self, image: Image, t_ns: int, *, busy: bool) -> tuple[ScaleChange, ...]:
        """Growth of confirmed vehicles since their anchor, directly between the two images, once every base_s; not while busy."""
        changes: list[ScaleChange] = []
        if not self._flow.enabled or busy:
            return ()
        for track in self._tracks:
            if track.anchor is None or not track.placed or not track.id or not self._growth_due(track, t_ns):
                continue
            rear = grow(track.anchor, image, track.corners_px, self._flow)
            if rear is not None:
                changes.append(
                    ScaleChange(track_id=track.id, t_from_ns=track.anchor_ns, ratio=rear.ratio, sigma=rear.sigma)
                )
            track.anchor = None
        return tuple(changes)

    def _growth_due(self, track: Track, t_ns: int) -> bool:
        return t_ns - track.anchor_ns >= self._flow.base_s * 1e9 - EARLY_NS

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
        """Ends tracks that are doubled or outside; renews the templates of the others.

        Where a plate is only guessed to be there may be road by now, and flow would follow that: the old template is kept.
        """
        w, h = image.shape[1], image.shape[0]
        inside = [t for t in self._tracks if t.inside(w, h) and min(size_px(t.corners_px)) >= 2]
        self._tracks = without_doubles(inside, self._flow.ring)
        if not self._flow.enabled:
            return
        for track in self._tracks:
            if not track.placed:
                continue
            track.template, track.template_ns = make_template(image, track.corners_px, self._flow), t_ns
            track.shaken_px = 0.0
            if track.anchor is None and not track.washed:
                track.anchor, track.anchor_ns = track.template, t_ns

    def _count(self, success: bool) -> None:
        """Strict and permissive: permissive after a run of frames without a plate, strict again on success."""
        self._without_plate = 0 if success else self._without_plate + 1
        self._mode = "permissive" if self._without_plate >= self._detector.permissive_after_frames else "strict"

    def _sighting(
        self, frame: Frame, status: Literal["ok", "no_plate", "blind"], plates: tuple[PlateSighting, ...],
        changes: tuple[ScaleChange, ...], searched: bool, mode: Mode, timing: Timing,
        vehicles: tuple[VehicleBox, ...] = (),
    ) -> Sighting:
        return Sighting(
            t_ns=frame.t_ns, frame_index=frame.index, width_px=frame.image.shape[1], height_px=frame.image.shape[0],
            status=status, plates=plates, scale_changes=changes, vehicles=vehicles, mode=mode, searched=searched,
            timing_ms=timing.total_ms(),
        )  # fmt: skip


def _within(corners_px: Array, region: Region) -> bool:
    """Whether a plate's middle lies in a region."""
    x, y = corners_px.mean(axis=0)
    return bool(region[0] <= x < region[2] and region[1] <= y < region[3])
