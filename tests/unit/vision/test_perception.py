"""Perception over made-up drives: schedule, identities, bridging, modes, blindness."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pytest
from scenes import plate_still

from tmde_edge.messages import Frame, Mode
from tmde_edge.vision.detect.contour import ContourFinder
from tmde_edge.vision.perception import Perception
from tmde_edge.vision.protocols import PlateCandidate, PlateReading
from tmde_edge.vision.rectify import is_convex
from tmde_edge.vision.search import PlainSearch
from tmde_edge.vision.segment.paper import PaperReader
from tmde_edge.vision.settings import DetectorSettings, FlowSettings, SegmenterSettings

STEP_NS = 33_333_333
STILL = plate_still("us-mi", 120, seed=2)


@dataclass
class ScriptedSearch:
    """Knows where the plates are; counts its calls; can look away."""

    plates: list[PlateCandidate] = field(default_factory=list)
    blindfold: bool = False
    frames: int = 0
    regions: list[tuple[int, int, int, int]] = field(default_factory=list)
    modes: list[Mode] = field(default_factory=list)
    closer_score: float | None = None
    closer_looks: int = 0

    def frame(self, image, mode):
        self.frames += 1
        self.modes.append(mode)
        return [] if self.blindfold else list(self.plates)

    def region(self, image, region_px, plate_width_px, mode):
        self.regions.append(region_px)
        x0, y0, x1, y1 = region_px
        inside = lambda c: x0 <= c[0] < x1 and y0 <= c[1] < y1  # noqa: E731
        return [] if self.blindfold else [p for p in self.plates if inside(p.corners_px.mean(axis=0))]

    def still(self, image, mode):
        yield list(self.plates)

    def closer(self, image, corners_px):
        self.closer_looks += 1
        return self.closer_score


class EchoReader:
    """Takes every candidate at its word."""

    platehood: float | None = None

    def read(self, image, candidates):
        return [
            PlateReading(corners_px=c.corners_px, corners_sigma_px=0.2, refined=True, characters=(), platehood=self.platehood)
            for c in candidates
        ]


def _perception(search, reader=None, *, flow=True, carry_s=4.0, **detector):
    return Perception(
        search=search, reader=reader or EchoReader(), detector=DetectorSettings(fovea=False, **detector),
        segmenter=SegmenterSettings(kind="paper"), flow=FlowSettings(enabled=flow, carry_s=carry_s), clock_ns=lambda: 0,
    )


def _frame(i, image=None, step_ns=STEP_NS):
    return Frame(t_ns=1_000_000_000 + i * step_ns, index=i, image=STILL.image if image is None else image)


def _candidate(shift=(0.0, 0.0), score=0.95):
    return PlateCandidate(corners_px=STILL.corners_px + shift, score=score)


def test_full_searches_run_at_their_rate_of_source_time_and_regions_every_frame():
    search = ScriptedSearch([_candidate()])
    p = _perception(search, search_rate_hz=10)
    sightings = [p.see(_frame(i)) for i in range(31)]
    assert search.frames == sum(s.searched for s in sightings) == 11
    assert [s.searched for s in sightings[:7]] == [True, False, False, True, False, False, True]
    assert len(search.regions) == 30
    assert all(s.plates[0].track_id == 1 and s.plates[0].source == "detector" for s in sightings)


def test_a_settled_track_needs_no_search_of_its_own_while_its_reader_is_sure_of_it():
    search, reader = ScriptedSearch([_candidate()]), EchoReader()
    reader.platehood = 0.99
    p = _perception(search, reader, search_rate_hz=0.5)
    sightings = [p.see(_frame(i)) for i in range(31)]
    assert all(s.plates[0].track_id == 1 and s.plates[0].source == "detector" for s in sightings)
    assert 3 <= len(search.regions) <= 8  # the finder itself looks again a few times a second
    reader.platehood = 0.1  # something else is there now
    seen = len(search.regions)
    after = [p.see(_frame(i)) for i in range(31, 35)]
    assert all(pl.source == "flow" for s in after for pl in s.plates)
    assert len(search.regions) - seen >= 3  # and it is looked for in every frame again


def test_two_runs_are_identical():
    runs = []
    for _ in range(2):
        p = _perception(ScriptedSearch([_candidate(), _candidate((200.0, 40.0))]))
        runs.append([p.see(_frame(i)) for i in range(12)])
    assert runs[0] == runs[1]


def test_an_unsure_plate_waits_for_its_second_sighting_a_sure_one_does_not():
    unsure = _perception(ScriptedSearch([_candidate(score=0.6)]))
    assert [len(unsure.see(_frame(i)).plates) for i in range(3)] == [0, 1, 1]
    assert _perception(ScriptedSearch([_candidate(score=0.95)])).see(_frame(0)).plates


def _seen_closer(candidate, *, closer_score):
    """A reader that believes 0.9 in all it reads, and a finder with an opinion from closer up."""
    reader = EchoReader()
    reader.platehood = 0.9
    search = ScriptedSearch([candidate], closer_score=closer_score)
    return _perception(search, reader), search


def test_what_is_unsure_and_no_plate_from_closer_up_never_gets_an_identity():
    p, facade = _seen_closer(_candidate(score=0.5), closer_score=0.02)
    assert not any(p.see(_frame(i)).plates for i in range(30))
    assert 5 <= facade.closer_looks <= 12  # it is asked again, but not in every frame
    p, plate = _seen_closer(_candidate(score=0.5), closer_score=0.9)
    assert [bool(p.see(_frame(i)).plates) for i in range(4)] == [False, True, True, True]
    assert plate.closer_looks == 1


def test_high_scores_of_one_frame_are_no_proof_where_the_closer_look_denies_them():
    """As windows in rows: finder 0.74, reader 0.9, together above confident_score; from closer up no plate."""
    p, facade = _seen_closer(_candidate(score=0.74), closer_score=0.5)
    assert not any(p.see(_frame(i)).plates for i in range(30))
    assert 5 <= facade.closer_looks <= 12
    plate, _ = _seen_closer(_candidate(score=0.74), closer_score=0.9)
    assert plate.see(_frame(0)).plates  # and a plate is still reported at once
    middle = STILL.corners_px.mean(axis=0)
    far = PlateCandidate(corners_px=middle + 0.25 * (STILL.corners_px - middle), score=0.74)
    p, search = _seen_closer(far, closer_score=0.5)
    assert p.see(_frame(0)).plates  # of 30 px there is no more to see from closer up
    assert search.closer_looks == 0


@pytest.mark.parametrize(("closer_score", "reported"), [(0.5, False), (0.6, True)])
def test_what_is_small_and_was_doubted_must_look_like_a_plate_from_closer_up_too(closer_score, reported):
    """A far facade gains high scores for a frame or two; a plate as small looks half like one at least (belief 0.19, 0.34)."""
    middle = STILL.corners_px.mean(axis=0)
    far = STILL.corners_px * 0.25 + middle * 0.75
    p, search = _seen_closer(PlateCandidate(corners_px=far, score=0.55), closer_score=0.3)
    assert not any(p.see(_frame(i)).plates for i in range(4))
    search.plates, search.closer_score = [PlateCandidate(corners_px=far, score=0.74)], closer_score
    assert any(p.see(_frame(i)).plates for i in range(4, 10)) == reported


def test_a_reader_that_knows_no_platehood_leaves_the_unsure_to_the_number_of_hits():
    search = ScriptedSearch([_candidate(score=0.35)])  # below score_min: found in permissive mode only
    p = _perception(search)
    assert [len(p.see(_frame(i)).plates) for i in range(3)] == [0, 1, 1]
    assert search.closer_looks == 0


def test_a_plate_washed_out_by_glare_keeps_its_place_and_says_nothing_of_its_size():
    """As out of a tunnel: the exposure rises by three within a frame and falls again. What the glare gives back is no growth."""
    small = plate_still("de-mittel", 40, seed=2)
    glare = np.clip(small.image.astype(float) * 2.6, 0, 255).astype(np.uint8)
    wrong = small.corners_px + np.array([(2.0, -1.0), (-2.0, -1.0), (-2.0, 1.5), (2.0, 1.5)])  # where white runs into white
    reader = EchoReader()
    reader.platehood = 0.99
    search = ScriptedSearch([PlateCandidate(corners_px=small.corners_px, score=0.95)])
    p = _perception(search, reader, search_rate_hz=1000)
    before = [p.see(_frame(i, small.image)) for i in range(20)]
    search.plates = [PlateCandidate(corners_px=wrong, score=0.95)]
    during = [p.see(_frame(i, glare)) for i in range(20, 50)]
    assert all(len(s.plates) == 1 and s.plates[0].track_id == 1 and not s.plates[0].refined for s in during[3:])
    widths = [s.plates[0].corners_px[1][0] - s.plates[0].corners_px[0][0] for s in during[3:]]
    assert widths == pytest.approx([40.0] * len(widths), abs=1.6)  # the jump itself moves the flow a little, once
    assert widths == pytest.approx([widths[0]] * len(widths), abs=0.3)
    assert any(s.scale_changes for s in before)
    assert not any(s.scale_changes for s in during)


def test_a_flash_that_is_seen_once_is_never_reported():
    search = ScriptedSearch([_candidate(score=0.6)])
    p = _perception(search)
    seen = list(p.see(_frame(0)).plates)
    search.blindfold = True
    for i in range(1, 30):
        seen += p.see(_frame(i)).plates
    assert seen == []


def test_a_picture_thrown_up_and_down_by_bumps_keeps_its_identities():
    """The camera's own pitching is told by others (pose/tilt.py); the plate jumps by twice its height from frame to frame."""
    search = ScriptedSearch()
    p = _perception(search, search_rate_hz=1000)
    ids, down = set(), 0.0
    for i in range(30):
        before, down = down, 60.0 * (-1) ** i if 10 <= i < 20 else 0.0
        image = cv2.warpAffine(STILL.image, np.array([[1.0, 0, 0], [0, 1, down]]), STILL.image.shape[1::-1])
        search.plates = [_candidate((0.0, down))]
        p.shaken_px = down - before
        ids |= {s.track_id for s in p.see(_frame(i, image)).plates}
    assert ids == {1}


def test_a_plate_that_was_lost_while_the_camera_pitched_has_no_motion_of_its_own():
    """Shaken while nothing of it was seen: two frames' pitching lie between the old template and where it is found again."""
    search = ScriptedSearch([_candidate()])
    p = _perception(search, search_rate_hz=1000)
    for i in range(5):
        p.see(_frame(i))
    grey = np.full_like(STILL.image, 128)
    grey[:40] = 20  # nothing to follow, but a picture
    search.blindfold = True
    for i, down in ((5, 30.0), (6, 0.0)):
        p.shaken_px = down
        p.see(_frame(i, grey))
    search.plates, search.blindfold, p.shaken_px = [_candidate((0.0, 30.0))], False, 0.0
    p.see(_frame(7, cv2.warpAffine(STILL.image, np.array([[1.0, 0, 0], [0, 1, 30.0]]), STILL.image.shape[1::-1])))
    (track,) = p._tracks
    assert track.hits > 5
    assert np.abs(track.velocity_px).max() * 33e6 < 1.0


def test_a_track_that_hides_where_another_plate_is_seen_is_a_ghost():
    """A jump that nobody announced: the old track is followed on, but its vehicle's plate has another one by now."""
    search = ScriptedSearch([_candidate()])
    p = _perception(search, search_rate_hz=1000, lost_s=5.0)
    for i in range(10):
        p.see(_frame(i))
    search.plates = [_candidate((0.0, 60.0))]
    shown = [[s.track_id for s in p.see(_frame(i)).plates] for i in range(10, 30)]
    assert shown[-1] == [2]


def test_identities_are_counted_from_one_and_kept_while_plates_move():
    search = ScriptedSearch()
    p = _perception(search, flow=False)
    ids = []
    for i in range(15):
        search.plates = [_candidate((3.0 * i, 0.0)), _candidate((-300.0 + 2 * i, 60.0))]
        ids.append(sorted((s.corners_px[0][0], s.track_id) for s in p.see(_frame(i)).plates))
    assert {tuple(t for _, t in row) for row in ids} == {(2, 1)} or {tuple(t for _, t in row) for row in ids} == {(1, 2)}


def test_flow_bridges_a_dropout_then_the_track_ends():
    search = ScriptedSearch([_candidate()])
    p = _perception(search, lost_s=0.3)
    p.see(_frame(0))
    search.blindfold = True
    later = []
    for i in range(1, 15):
        shift = np.array([[1, 0, 2.0 * i], [0, 1, -1.0 * i]], np.float64)
        size = (STILL.image.shape[1], STILL.image.shape[0])
        moved = cv2.warpAffine(STILL.image, shift, size, borderMode=cv2.BORDER_REPLICATE)
        later.append(p.see(_frame(i, moved)))
    bridged = [s for s in later if s.plates]
    assert 7 <= len(bridged) <= 9
    for s in bridged:
        (plate,) = s.plates
        assert plate.source == "flow"
        assert np.array(plate.corners_px)[0] - STILL.corners_px[0] == pytest.approx(
            [2.0 * s.frame_index, -1.0 * s.frame_index], abs=0.5
        )
    scores = [s.plates[0].score for s in bridged]
    assert scores == sorted(scores, reverse=True)
    assert later[-1].status == "no_plate"


def test_the_same_identity_after_a_short_dropout_another_after_a_long_one():
    search = ScriptedSearch([_candidate()])
    p = _perception(search, lost_s=0.3, carry_s=0.5)
    assert p.see(_frame(0)).plates[0].track_id == 1
    search.blindfold = True
    for i in range(1, 5):
        p.see(_frame(i))
    search.blindfold = False
    assert p.see(_frame(5)).plates[0].track_id == 1
    search.blindfold = True
    for i in range(6, 30):
        p.see(_frame(i))
    search.blindfold = False
    assert next(s for i in range(30, 40) if (s := p.see(_frame(i))).plates).plates[0].track_id == 2


def test_a_hidden_plates_vehicle_is_followed_on_without_a_plate_being_claimed():
    search = ScriptedSearch([_candidate()])
    p = _perception(search, lost_s=0.3, carry_s=3.0)
    first = p.see(_frame(0))
    assert first.vehicles == ()
    search.blindfold = True
    covered = STILL.image.copy()
    cv2.fillConvexPoly(covered, np.rint(STILL.corners_px).astype(np.int32), (34, 36, 38))
    later = []
    for i in range(1, 46):
        warp = np.array([[1 + 0.004 * i, 0, 0], [0, 1 + 0.004 * i, 0]], np.float64)
        warp[:, 2] = STILL.corners_px.mean(axis=0) * -0.004 * i
        later.append(p.see(_frame(i, cv2.warpAffine(covered, warp, covered.shape[1::-1], flags=cv2.INTER_CUBIC))))
    hidden = [s for s in later if not s.plates]
    assert len(hidden) >= 30
    assert [len(s.vehicles) for s in hidden] == [1] * len(hidden)
    assert hidden[-1].vehicles[0].track_id == 1
    growth = [c for s in hidden for c in s.scale_changes]
    assert len(growth) >= 4
    for c in growth:
        i_from = (c.t_from_ns - first.t_ns) / STEP_NS
        i_now = next((s.t_ns - first.t_ns) / STEP_NS for s in hidden if c in s.scale_changes)
        assert c.ratio == pytest.approx((1 + 0.004 * i_now) / (1 + 0.004 * i_from), abs=max(4 * c.sigma, 1e-3))
    assert 10 <= len(search.regions) <= 22  # it is looked for on, but not in every frame
    search.blindfold = False
    assert [plate.track_id for i in (46, 47) for plate in p.see(_frame(i)).plates][:1] == [1]


def test_a_plate_that_grows_to_twice_its_size_without_being_seen_was_none():
    """As a facade that was taken for a plate from far away, and is passed."""
    search = ScriptedSearch([_candidate()])
    p = _perception(search, lost_s=0.3, carry_s=10.0)
    p.see(_frame(0))
    search.blindfold = True
    covered = STILL.image.copy()
    cv2.fillConvexPoly(covered, np.rint(STILL.corners_px).astype(np.int32), (34, 36, 38))
    followed = []
    for i in range(1, 60):
        size = 1 + 0.02 * i
        warp = np.array([[size, 0, 0], [0, size, 0]], np.float64)
        warp[:, 2] = STILL.corners_px.mean(axis=0) * (1 - size)
        seen = p.see(_frame(i, cv2.warpAffine(covered, warp, covered.shape[1::-1], flags=cv2.INTER_CUBIC)))
        followed += [size] if seen.vehicles else []
    assert 1.8 < max(followed) < 2.15


def test_what_takes_a_vehicles_place_is_not_followed_in_its_stead():
    """A cut, or the lead is suddenly gone: the road that is seen in its place grows towards the camera, and is no vehicle."""
    search = ScriptedSearch([_candidate()])
    p = _perception(search, lost_s=0.3, carry_s=3.0)
    for i in range(10):
        assert p.see(_frame(i)).plates
    search.blindfold = True
    grain = np.random.default_rng(7).normal(size=STILL.image.shape[:2]).astype(np.float32)
    road = np.clip(110 + 120 * cv2.GaussianBlur(grain, (0, 0), 2.5), 0, 255).astype(np.uint8)
    after = []
    for i in range(10, 40):
        grown = 1.0 + 0.03 * (i - 10)
        warp = np.array([[grown, 0, 0], [0, grown, 0]], np.float64)
        warp[:, 2] = STILL.corners_px.mean(axis=0) * (1 - grown)
        image = cv2.warpAffine(road, warp, road.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        after.append(p.see(_frame(i, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))))
    assert not any(s.plates or s.vehicles or s.scale_changes for s in after)


def test_growth_of_the_image_is_reported_over_its_base():
    search = ScriptedSearch()
    p = _perception(search)
    centre = STILL.corners_px.mean(axis=0)
    changes = []
    for i in range(13):
        k = 1.004**i
        warp = np.array([[k, 0, centre[0] * (1 - k)], [0, k, centre[1] * (1 - k)]])
        search.plates = [PlateCandidate(corners_px=STILL.corners_px @ warp[:, :2].T + warp[:, 2], score=0.95)]
        size = (STILL.image.shape[1], STILL.image.shape[0])
        image = cv2.warpAffine(STILL.image, warp, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        sighting = p.see(_frame(i, image))
        changes += [(sighting.t_ns, c) for c in sighting.scale_changes]
    for t_ns, c in changes:
        frames = (t_ns - c.t_from_ns) / STEP_NS
        # 0.2 s are six frames; never beside a full search or just after one
        assert frames in (pytest.approx(6), pytest.approx(8))
        assert c.ratio == pytest.approx(1.004**frames, abs=max(0.002, 4 * c.sigma))


def test_permissive_after_thirty_frames_strict_again_on_success():
    search = ScriptedSearch()
    p = _perception(search, search_rate_hz=1000, permissive_after_frames=30)
    modes = [p.see(_frame(i)).mode for i in range(40)]
    assert modes == ["strict"] * 30 + ["permissive"] * 10
    assert search.modes[-1] == "permissive"
    search.plates = [_candidate()]
    p.see(_frame(40))
    assert p.see(_frame(41)).mode == "strict"


@pytest.mark.parametrize("image", [
    np.zeros((360, 640, 3), np.uint8), np.full((360, 640), 255, np.uint8), np.full((360, 640, 3), 91, np.uint8),
])
def test_blindness_is_not_absence(image):
    p = _perception(ScriptedSearch([_candidate()]))
    assert p.see(Frame(t_ns=1, index=0, image=image)).status == "blind"
    assert p.see_still(Frame(t_ns=1, index=0, image=image)).status == "blind"
    assert _perception(ScriptedSearch()).see(_frame(0)).status == "no_plate"


def test_a_finder_that_fails_is_not_an_empty_road():
    class Broken(ScriptedSearch):
        def frame(self, image, mode):
            raise RuntimeError("the network fell over")

    with pytest.raises(RuntimeError, match="fell over"):
        _perception(Broken()).see(_frame(0))


def test_a_reader_that_sees_no_plate_there_overrules_the_finder():
    reader = EchoReader()
    reader.platehood = 0.01
    p = _perception(ScriptedSearch([_candidate()]), reader)
    assert p.see_still(_frame(0)).status == "no_plate"
    assert all(p.see(_frame(i)).status == "no_plate" for i in range(5))


def test_crossed_corners_of_a_known_plate_are_never_reported():
    class Crossing(EchoReader):
        crossed = False

        def read(self, image, candidates):
            return [replace(r, corners_px=r.corners_px[[1, 0, 2, 3] if self.crossed else [0, 1, 2, 3]])
                    for r in super().read(image, candidates)]

    reader = Crossing()
    reader.platehood = 0.99
    p = _perception(ScriptedSearch([_candidate()]), reader)
    before = [p.see(_frame(i)) for i in range(6)]
    reader.crossed = True
    during = [p.see(_frame(i)) for i in range(6, 10)]
    reader.crossed = False
    after = p.see(_frame(10))
    assert all(is_convex(np.array(pl.corners_px)) for s in (*before, *during, after) for pl in s.plates)
    assert [[pl.source for pl in s.plates] for s in during] == [["flow"]] * 4
    assert [(pl.track_id, pl.source) for pl in after.plates] == [(1, "detector")]


def test_time_that_steps_back_ends_all_tracks():
    p = _perception(ScriptedSearch([_candidate()]))
    assert p.see(_frame(10)).plates[0].track_id == 1
    again = p.see(_frame(0))
    assert again.searched
    assert again.plates[0].track_id == 2


def test_cut_plates_are_marked():
    x0 = int(STILL.corners_px[:, 0].min()) + 30
    image = np.ascontiguousarray(STILL.image[:, x0:])
    p = _perception(ScriptedSearch([PlateCandidate(corners_px=STILL.corners_px - (x0, 0), score=0.95)]))
    assert p.see_still(_frame(0, image)).plates[0].cut
    assert not _perception(ScriptedSearch([_candidate()])).see_still(_frame(0)).plates[0].cut


def test_the_papers_pipeline_end_to_end_grey_and_colour():
    detector, segmenter = DetectorSettings(kind="contour"), SegmenterSettings(kind="paper")
    search = PlainSearch(ContourFinder(detector, (2.0, 2.0)), detector)
    still = plate_still("us-mi", 220, seed=4)
    heights = []
    for image in (still.image, cv2.cvtColor(still.image, cv2.COLOR_BGR2GRAY)):
        p = Perception(
            search=search, reader=PaperReader(segmenter), detector=detector, segmenter=segmenter, flow=FlowSettings(),
            clock_ns=lambda: 0,
        )
        best = max(p.see_still(_frame(0, image)).plates, key=lambda s: len(s.glyphs))
        assert len(best.glyphs) == len(still.glyph_boxes_px)
        heights.append(best.char_height_px)
    assert heights[0] == pytest.approx(still.char_height_px, rel=0.02)
    assert heights[1] == pytest.approx(heights[0], rel=0.01)
