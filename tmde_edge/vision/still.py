"""Plates of one picture by itself: looked at from the whole to finer parts, doubtful places read and judged twice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from tmde_edge.messages import Mode, PlateSighting
from tmde_edge.vision.detect.contour import box_iou
from tmde_edge.vision.judgement import belief, joint_score
from tmde_edge.vision.likeness import is_washed_out, small_look
from tmde_edge.vision.protocols import Image, PlateCandidate, PlateReader, PlateReading
from tmde_edge.vision.rectify import is_convex
from tmde_edge.vision.search import PlateSearch
from tmde_edge.vision.settings import DetectorSettings, SegmenterSettings
from tmde_edge.vision.sighting import plate_sighting, washed
from tmde_edge.vision.timing import Timing

SURE_SCORE, SURE_PLATEHOOD = 0.7, 0.98  # both together need no further look
CERTAIN_PLATEHOOD = 0.9997  # three of four plates reach it; of what is none the surest had 0.999: outvotes the closer look
REREAD_PLATEHOOD = 0.1  # below this a reader's corners say nothing
SAME_STILL_IOU = 0.3  # finer looks: overlap with a plate already read
STILL_MODE: Mode = "strict"


class StillLook:
    """Finds and reads the plates of stills. No second frame confirms them, so finder and reader must agree about each."""

    def __init__(
        self, search: PlateSearch, reader: PlateReader, detector: DetectorSettings, segmenter: SegmenterSettings
    ) -> None:
        self._search = search
        self._reader = reader
        self._detector = detector
        self._segmenter = segmenter

    def plates(self, image: Image, timing: Timing) -> tuple[PlateSighting, ...]:
        """The plates that can be reported on one look, the surest first."""
        return tuple(
            plate_sighting(r, track_id=0, score=score, source="detector", shape=image.shape, settings=self._segmenter)
            for r, score in self.look(image, timing.done)
        )

    def look(self, image: Image, done: Callable[[str], None]) -> list[tuple[PlateReading, float]]:
        """Each plate once, with its score, best first. `done` is told the stages ("detect", "read") as they end."""
        found: list[tuple[PlateCandidate, PlateReading, float]] = []
        for candidates in self._candidates(image, done):
            # a place read badly at a small scale may be read well at a larger one
            fresh = [c for c in candidates if all(box_iou(c.corners_px, k.corners_px) <= SAME_STILL_IOU for k, _, _ in found)]
            pairs = self._read_twice(image, fresh[: self._detector.max_plates])
            done("read")
            judged = [(c, r, self.belief(image, c, r)) for c, r in pairs if is_convex(r.corners_px)]
            found += [f for f in judged if f[2] >= self._detector.still_belief_min]
            done("detect")
            if any(self._sure(c, r) for c, r, _ in found):
                break
        found.sort(key=lambda f: -f[2])
        # beside a sure plate, what rests on little is left out: the search ended before it was looked at as it should be
        least = self._detector.still_beside_min if found and self._sure(*found[0][:2]) else 0.0
        kept = [f for k, f in enumerate(found) if k == 0 or f[2] >= least]
        plates: list[tuple[PlateReading, float]] = []
        for c, r, _ in sorted(kept, key=lambda f: -joint_score(*f[:2])):
            # two candidates may turn out to be one plate once their corners are read
            if all(box_iou(r.corners_px, p.corners_px) <= SAME_STILL_IOU for p, _ in plates):
                plates.append((washed(r) if is_washed_out(small_look(image, r.corners_px)) else r, joint_score(c, r)))
        return plates

    def _candidates(self, image: Image, done: Callable[[str], None]) -> Iterator[list[PlateCandidate]]:
        """Look by look, best first; weak ones by themselves, so that who has seen enough need not read them."""
        for candidates in self._search.still(image, STILL_MODE):
            done("detect")
            ordered = sorted(candidates, key=lambda c: -c.score)
            yield [c for c in ordered if c.score >= self._detector.score_min]
            yield [c for c in ordered if c.score < self._detector.score_min]

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
            pairs[i] = (pairs[i][0], reading)
        return pairs

    def belief(self, image: Image, candidate: PlateCandidate, reading: PlateReading) -> float:
        """0..1 whether a plate is there: reader and finder together, the finder asked again about this place alone."""
        if reading.platehood is None:
            doubted = candidate.score < self._detector.score_min and self._search.closer(image, reading.corners_px) is not None
            return 0.0 if doubted else 1.0
        if reading.platehood < self._segmenter.platehood_min:
            return 0.0
        if candidate.score >= SURE_SCORE and reading.platehood >= SURE_PLATEHOOD:
            return 1.0
        closer = self._search.closer(image, reading.corners_px)
        if closer is None:  # the finder has nothing to add: the reader must be sure
            return float(reading.platehood >= self._segmenter.still_platehood_min)
        judged = belief(candidate.score, reading.platehood, closer)
        certain = reading.platehood >= CERTAIN_PLATEHOOD and candidate.score >= self._detector.score_min
        return max(judged, self._detector.still_belief_min) if certain else judged

    def _sure(self, candidate: PlateCandidate, reading: PlateReading) -> bool:
        """Whether this is surely a plate, so that nothing finer needs to be looked at."""
        if reading.platehood is None:
            return candidate.score >= self._detector.confident_score
        return reading.platehood >= self._detector.confident_score and candidate.score >= self._detector.score_min
