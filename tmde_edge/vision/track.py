"""One plate followed through the image: what is remembered of it, when it is confirmed, when it may be carried by flow."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tmde_edge.vision.detect.contour import box_iou
from tmde_edge.vision.flow import FlowStep, Template
from tmde_edge.vision.judgement import joint_score
from tmde_edge.vision.likeness import Looks
from tmde_edge.vision.protocols import PlateCandidate, PlateReading
from tmde_edge.vision.rectify import Array, bounds, is_convex, size_px
from tmde_edge.vision.settings import DetectorSettings, FlowSettings

VELOCITY_SHARE = 0.6  # of a new step in the smoothed image velocity
BRIDGE_HITS = 3  # sightings before flow alone may carry a plate
MISSES = 2  # frames in a row without a sighting that end a track before it was confirmed
REAR_LOST_NS = 250_000_000  # a vehicle whose rear flow has not followed for this long is lost
SETTLED_NS = 250_000_000  # the finder itself looks at a settled track again after this long
SETTLED_SIGMA = 0.15  # of a plate's height: a prediction this good needs no search, the reader's crop holds the plate
GROWN_UNSEEN = 2.0  # times its width when it was last seen
GHOST_MISSES = 3  # frames without a sighting, before another plate on its vehicle ends a track
SAME_PLATE_IOU = 0.15  # overlap with the predicted box that makes a candidate the same plate


@dataclass(slots=True)
class Track:
    """One plate followed through the image."""

    corners_px: Array
    score: float
    seen_ns: int  # last detection
    seen_px: float = field(init=False)  # its width then
    hits: int = 1
    misses: int = 0  # frames since the last hit
    found_ns: int = 0  # last time that the finder itself saw it, and how sure it was
    found_score: float = 0.0
    judged: bool = False  # the reader has an opinion whether this is a plate
    needed: int = 2  # hits before it is reported
    doubted: bool = False  # did not look like a plate from closer up
    sure: bool = False  # was once beyond doubt
    id: int = 0  # 0 until confirmed
    velocity_px: Array = field(default_factory=lambda: np.zeros((4, 2)))  # corners' motion a nanosecond, without the camera's
    sigma_px: float = 1.0
    placed: bool = True  # in this frame its place was seen, or flow led there; else it is a guess
    template: Template | None = None  # of the last frame in which it was placed
    template_ns: int = 0
    shaken_px: float = 0.0  # how far down the camera's own pitching has moved the picture since the template, where known
    anchor: Template | None = None  # where the present scale change starts
    anchor_ns: int = 0
    outlined_ns: int = 0  # its outline was last looked for in the image
    rear_ns: int = 0  # the vehicle's rear was last followed
    washed: bool = False  # too bright to be measured in the last frame
    looks: Looks = field(default_factory=Looks)

    def __post_init__(self) -> None:
        self.seen_px = size_px(self.corners_px)[0]

    @property
    def bridges(self) -> bool:
        """Whether flow alone may carry this plate: it was seen well or often enough."""
        return self.id > 0 and (self.sure or self.hits >= BRIDGE_HITS)

    def settled(self, step: FlowStep | None, t_ns: int) -> bool:
        """Whether flow knows where this plate is so well that the reader alone can say whether it is still there."""
        return (
            step is not None
            and self.judged
            and self.bridges
            and self.misses == 0
            and t_ns - self.found_ns <= SETTLED_NS
            and self.sigma_px <= SETTLED_SIGMA * size_px(self.corners_px)[1]
        )

    def hidden(self, t_ns: int, lost_s: float) -> bool:
        """Whether the plate itself was not seen for longer than flow is believed about it."""
        return t_ns - self.seen_ns > lost_s * 1e9

    def faded_score(self, t_ns: int, lost_s: float) -> float:
        """The score of a plate that the detector has not seen since: none is left when the track ends."""
        return self.score * max(0.0, 1.0 - (t_ns - self.seen_ns) * 1e-9 / lost_s)

    def alive(self, t_ns: int, detector: DetectorSettings, flow: FlowSettings) -> bool:
        """Whether it is worth following on: seen of late, or hidden on a vehicle that is still followed."""
        if not self.id and self.misses >= MISSES:  # what was not confirmed must be seen at once again
            return False
        if not self.hidden(t_ns, detector.lost_s):
            return True
        if size_px(self.corners_px)[0] > GROWN_UNSEEN * self.seen_px:
            return False  # what was a plate from farther away would be seen to be one by now
        followed = t_ns - self.rear_ns <= REAR_LOST_NS and self.bridges
        return followed and t_ns - self.seen_ns <= flow.carry_s * 1e9

    def inside(self, width_px: int, height_px: int) -> bool:
        """Whether the plate's middle is in an image of this size."""
        x, y = self.corners_px.mean(axis=0)
        return bool(-0.5 <= x <= width_px - 0.5 and -0.5 <= y <= height_px - 0.5)

    def near(self, reading: PlateReading) -> bool:
        """Whether what was read is the plate that flow carried, and not a neighbouring edge."""
        off = float(np.abs(reading.corners_px - self.corners_px).max())
        return off <= 3 * self.sigma_px + 0.04 * size_px(self.corners_px)[0]

    def hit(self, candidate: PlateCandidate, reading: PlateReading, t_ns: int) -> None:
        """Takes a sighting by the detector."""
        self.carry(reading, t_ns)
        self.placed = True
        self.score, self.seen_ns = joint_score(candidate, reading), t_ns
        self.seen_px = size_px(self.corners_px)[0]
        self.hits, self.misses = self.hits + 1, 0
        self.judged = reading.platehood is not None
        self.sigma_px = reading.corners_sigma_px

    def carry(self, reading: PlateReading, t_ns: int) -> None:
        """Moves to where the plate was read."""
        if not is_convex(reading.corners_px):
            return
        if self.template is not None and t_ns > self.template_ns:
            moved = (reading.corners_px - self.template.corners_px).mean(axis=0) - (0.0, self.shaken_px)
            moved /= t_ns - self.template_ns
            self.velocity_px = (1 - VELOCITY_SHARE) * self.velocity_px + VELOCITY_SHARE * moved
        self.corners_px = reading.corners_px


def associate(
    tracks: list[Track], candidates: list[PlateCandidate]
) -> tuple[dict[int, PlateCandidate], list[PlateCandidate]]:
    """Greedy by score and overlap: candidate of each track (by position), and those that belong to none, the best first.

    Ids keep who was there first: of two tracks that want one candidate the better overlap wins.
    """
    pairs = []
    for c_i, c in enumerate(candidates):
        for t_i, track in enumerate(tracks):
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
    return matched, fresh


def without_doubles(tracks: list[Track], ring: float) -> list[Track]:
    """Of tracks on one place the one with the older id, or the surer one, stays; what hides where a plate is seen is a ghost.

    ring: width of a vehicle's rear round its plate, in plate heights. A vehicle has one plate.
    """
    seen = [t for t in tracks if t.id and t.misses == 0]
    kept: list[Track] = []
    for track in sorted(tracks, key=lambda t: (t.id == 0, t.id, -t.score)):
        ghost = track.misses >= GHOST_MISSES and any(_same_rear(track, s, ring) for s in seen)
        if not ghost and all(box_iou(track.corners_px, k.corners_px) <= 0.4 for k in kept):
            kept.append(track)
    return kept


def _same_rear(track: Track, seen: Track, ring: float) -> bool:
    """Whether a track's middle lies on the rear of another one's vehicle, both plates about as large."""
    x0, y0, x1, y1 = bounds(seen.corners_px)
    reach = ring * size_px(seen.corners_px)[1]
    x, y = track.corners_px.mean(axis=0)
    share = size_px(track.corners_px)[1] / size_px(seen.corners_px)[1]
    return bool(x0 - reach <= x <= x1 + reach and y0 - reach <= y <= y1 + reach and 0.5 < share < 2.0)
