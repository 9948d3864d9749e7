"""Plates of one picture by itself: looks from the whole to finer parts, doubtful readings read a second time."""

from __future__ import annotations

from dataclasses import replace

from tmde_edge.messages import Mode, PlateSighting
from tmde_edge.vision.detect.contour import box_iou
from tmde_edge.vision.judgement import credible, joint_score
from tmde_edge.vision.protocols import Image, PlateCandidate, PlateReader, PlateReading
from tmde_edge.vision.rectify import is_convex
from tmde_edge.vision.search import PlateSearch
from tmde_edge.vision.settings import DetectorSettings, SegmenterSettings
from tmde_edge.vision.sighting import plate_sighting
from tmde_edge.vision.timing import Timing

REREAD_PLATEHOOD = 0.1  # below this a reader's corners say nothing
SAME_STILL_IOU = 0.3  # finer looks at a still: overlap with a plate already read
STILL_MODE: Mode = "strict"


def plates_of_still(
    image: Image, search: PlateSearch, reader: PlateReader, detector: DetectorSettings, segmenter: SegmenterSettings,
    timing: Timing,
) -> tuple[PlateSighting, ...]:
    """The plates that can be reported on one look, the surest first."""
    least = segmenter.still_platehood_min
    found: list[tuple[PlateCandidate, PlateReading]] = []
    for candidates in search.still(image, STILL_MODE):
        timing.done("detect")
        # a place read badly at a small scale may be read well at a larger one
        known = [c for c, r in found if credible(r, least)]
        fresh = [c for c in candidates if all(box_iou(c.corners_px, k.corners_px) <= SAME_STILL_IOU for k in known)]
        best = sorted(fresh, key=lambda c: -c.score)[: detector.max_plates]
        found += _read_twice(image, best, reader, segmenter)
        timing.done("read")
        if any(_sure(c, r, detector) for c, r in found):
            break
    plates: list[PlateSighting] = []
    shown: list[PlateReading] = []
    for c, r in sorted(found, key=lambda pair: -joint_score(*pair)):
        # two candidates may turn out to be one plate once their corners are read
        double = any(box_iou(r.corners_px, s.corners_px) > SAME_STILL_IOU for s in shown)
        if credible(r, least) and not double:
            shown.append(r)
            plates.append(
                plate_sighting(
                    r, track_id=0, score=joint_score(c, r), source="detector", shape=image.shape, settings=segmenter
                )
            )
    return tuple(plates)


def _read_twice(
    image: Image, candidates: list[PlateCandidate], reader: PlateReader, segmenter: SegmenterSettings
) -> list[tuple[PlateCandidate, PlateReading]]:
    """Reads candidates; what is doubtful is read again where the reader itself puts the corners.

    A plate that the finder saw at a small scale is cut badly at first.
    """
    pairs = list(zip(candidates, reader.read(image, candidates), strict=True))
    least = segmenter.still_platehood_min
    again = [
        i for i, (_, r) in enumerate(pairs)
        if r.platehood is not None and REREAD_PLATEHOOD <= r.platehood < least and is_convex(r.corners_px)
    ]  # fmt: skip
    better = reader.read(image, [replace(pairs[i][0], corners_px=pairs[i][1].corners_px) for i in again])
    for i, reading in zip(again, better, strict=True):
        if (reading.platehood or 0.0) >= segmenter.reread_platehood_min:
            pairs[i] = (pairs[i][0], reading)
    return pairs


def _sure(candidate: PlateCandidate, reading: PlateReading, detector: DetectorSettings) -> bool:
    """Whether this is surely a plate, so that nothing finer needs to be looked at."""
    if reading.platehood is None:
        return candidate.score >= detector.confident_score
    return reading.platehood >= detector.confident_score and candidate.score >= detector.score_min
