"""Stills: which places are read again, asked about again, and believed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import plate_still

from tmde_edge.adapters.detectors.platenet import PlateNet
from tmde_edge.vision.judgement import belief
from tmde_edge.vision.protocols import PlateCandidate, PlateReading
from tmde_edge.vision.search import CLOSER_FLOOR, NetworkSearch
from tmde_edge.vision.settings import DetectorSettings, SegmenterSettings
from tmde_edge.vision.still import StillLook

IMAGE = np.zeros((480, 640, 3), np.uint8)
CORNERS = np.array([[100.0, 100], [200, 100], [200, 125], [100, 125]])
opinions = st.floats(0.0, 1.0)


@dataclass
class Search:
    """One candidate in each of two looks; a fixed opinion when asked about it alone."""

    candidate: PlateCandidate
    opinion: float | None
    looks: int = 0
    asked: list[np.ndarray] = field(default_factory=list)

    def still(self, image, mode):
        for _ in range(2):
            self.looks += 1
            yield [self.candidate]

    def closer(self, image, corners_px):
        self.asked.append(corners_px)
        return self.opinion


@dataclass
class Reader:
    """Sees the plate's true corners; `first` is its opinion anywhere else, `there` its opinion when read at them."""

    first: float | None
    there: float | None

    def read(self, image, candidates):
        return [
            PlateReading(
                corners_px=CORNERS, corners_sigma_px=0.2, refined=True, characters=(),
                platehood=self.there if np.abs(c.corners_px - CORNERS).max() < 0.5 else self.first,
            )
            for c in candidates
        ]  # fmt: skip


def _plates(*, score=0.65, first=0.99, there=0.99, closer=0.85, shift=6.0):
    search = Search(PlateCandidate(corners_px=CORNERS + shift, score=score), closer)
    look = StillLook(search, Reader(first, there), DetectorSettings(), SegmenterSettings())
    return look.look(IMAGE, lambda stage: None), search


@pytest.mark.parametrize("platehood", [None, 0.99])
def test_crossed_corners_are_never_reported(platehood):
    """However little is asked for, and whether the reader has an opinion (the paper's has none) or not."""

    class Crossing:
        def read(self, image, candidates):
            return [PlateReading(corners_px=CORNERS[[1, 0, 2, 3]], corners_sigma_px=0.2, refined=False, characters=(),
                                 platehood=platehood) for _ in candidates]

    search = Search(PlateCandidate(corners_px=CORNERS, score=0.95), None)
    look = StillLook(search, Crossing(), DetectorSettings(still_belief_min=0.0), SegmenterSettings())
    assert look.look(IMAGE, lambda stage: None) == []


@given(opinions, opinions, opinions, st.floats(0.0, 0.5))
def test_belief_rises_with_every_opinion_and_stays_between_0_and_1(score, platehood, closer, more):
    base = belief(score, platehood, closer)
    assert 0.0 <= base <= 1.0
    raised = [(min(1.0, v + more)) for v in (score, platehood, closer)]
    assert belief(raised[0], platehood, closer) >= base
    assert belief(score, raised[1], closer) >= base
    assert belief(score, platehood, raised[2]) >= base


def test_a_place_that_only_the_reader_likes_is_no_plate():
    assert len(_plates(closer=0.85)[0]) == 1
    assert len(_plates(closer=0.4)[0]) == 0
    assert len(_plates(first=0.3, there=0.3, closer=0.95)[0]) == 0


def test_a_reader_beyond_doubt_outvotes_the_closer_look_of_a_strong_find():
    assert len(_plates(first=0.9999, closer=0.4)[0]) == 1
    assert len(_plates(score=0.45, first=0.9999, closer=0.3)[0]) == 0


def test_a_weak_find_is_believed_when_reader_and_closer_look_are_sure():
    assert len(_plates(score=0.4, closer=0.9)[0]) == 1
    assert len(_plates(score=0.4, closer=0.6)[0]) == 0


def test_a_doubtful_place_is_read_again_where_the_reader_puts_the_corners():
    assert len(_plates(first=0.4, there=0.99)[0]) == 1
    assert len(_plates(first=0.4, there=0.5)[0]) == 0


def test_a_finder_without_a_closer_look_leaves_it_to_a_sure_reader():
    assert len(_plates(closer=None)[0]) == 1
    assert len(_plates(closer=None, first=0.8, there=0.8)[0]) == 0
    assert len(_plates(closer=None, first=None, there=None)[0]) == 1  # a reader without opinion


def test_a_sure_plate_ends_the_search_and_a_plate_is_shown_once():
    assert _plates(score=0.9)[1].looks == 1
    plates, search = _plates(score=0.45, closer=0.9)
    assert len(plates) == 1
    assert search.looks == 2
    assert len(search.asked) == 1  # the second look shows the same place


def test_beside_a_sure_plate_a_doubtful_one_is_left_out_and_a_sure_one_shown():
    class TwoPlaces(Search):
        def still(self, image, mode):
            yield [self.candidate, PlateCandidate(corners_px=CORNERS + 300, score=min(0.6, self.candidate.score))]

        def closer(self, image, corners_px):
            return 0.9 if corners_px.min() < 300 else self.opinion

    class Echo:
        def read(self, image, candidates):
            return [
                PlateReading(corners_px=c.corners_px, corners_sigma_px=0.2, refined=True, characters=(), platehood=0.99)
                for c in candidates
            ]

    def shown(score, opinion):
        search = TwoPlaces(PlateCandidate(corners_px=CORNERS, score=score), opinion)
        return len(StillLook(search, Echo(), DetectorSettings(), SegmenterSettings()).look(IMAGE, lambda stage: None))

    assert shown(0.9, 0.9) == 2
    assert shown(0.9, 0.7) == 1
    assert shown(0.4, 0.8) == 2  # neither is sure: none outdoes the other


class Detector:
    """Remembers how it was asked; finds one plate somewhere."""

    def __init__(self, at, score):
        self.answer, self.calls = [PlateCandidate(corners_px=at, score=score)], []

    def detect(self, image, *, region_px=None, scale=1.0, score_min=0.5):
        self.calls.append((region_px, scale))
        return self.answer


@given(st.floats(10.0, 600.0), st.floats(-20.0, 640.0), st.floats(-20.0, 480.0))
def test_a_closer_look_shows_the_plate_at_its_best_size_and_stays_in_the_image(width, x, y):
    at = (CORNERS - 100) * (width / 100) + (x, y)
    detector = Detector(at, 0.8)
    answer = NetworkSearch(detector, DetectorSettings()).closer(IMAGE, at)
    assert answer == pytest.approx(0.8) or answer == CLOSER_FLOOR
    for (x0, y0, x1, y1), scale in detector.calls:
        assert 0 <= x0 < x1 <= 640
        assert 0 <= y0 < y1 <= 480
        assert width * scale <= 96.01
        assert scale <= 2.0


def test_a_closer_look_counts_only_what_lies_at_the_place():
    search = NetworkSearch(Detector(CORNERS + 300, 0.9), DetectorSettings())
    assert search.closer(IMAGE, CORNERS) == pytest.approx(CLOSER_FLOOR)


@pytest.mark.parametrize("width_px", [30, 60, 250])
def test_the_packaged_network_is_sure_of_a_plate_by_itself_and_not_of_its_surroundings(width_px):
    still = plate_still("de-mittel", width_px, seed=3)
    search = NetworkSearch(PlateNet(1), DetectorSettings())
    assert search.closer(still.image, still.corners_px) > 0.6
    assert search.closer(still.image, still.corners_px + np.array([0.0, 1.6 * width_px])) < 0.3
