"""Algorithm 2 on drawn plates: counts, heights in source pixels, strokes, polarity."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import plate_still

from tmde_edge.vision.protocols import PlateCandidate
from tmde_edge.vision.refine import OutlineFit
from tmde_edge.vision.segment.measure import border_thickness, stroke_width
from tmde_edge.vision.segment.paper import (
    PaperReader,
    enlargement,
    geometric_filters,
    height_inliers,
    main_class,
    read_characters,
    rows_of,
)
from tmde_edge.vision.settings import SegmenterSettings


def _exact(still) -> OutlineFit:
    return OutlineFit(corners_px=still.corners_px, sigma_px=0.1, refined=True, blur_px=None)


def _height_px(reading) -> float:
    return float(np.mean([np.hypot(*(c.bottom_px - c.top_px)) for c in reading.characters if c.main]))


@pytest.mark.parametrize(("standard", "width_px"), [("us-mi", 120), ("us-mi", 300), ("gb-2001", 200), ("de-mittel", 240)])
def test_every_character_is_found_and_its_height_is_right(standard, width_px):
    still = plate_still(standard, width_px)
    reading = read_characters(still.image, _exact(still))
    assert len(reading.characters) == len(still.glyph_boxes_px)
    assert _height_px(reading) == pytest.approx(still.char_height_px, rel=0.012)
    for box, true in zip(reading.characters, still.glyph_boxes_px, strict=True):
        assert box.top_px[1] == pytest.approx(true[:2, 1].mean(), abs=max(0.6, 0.004 * width_px))
        assert box.left_px[0] == pytest.approx(true[[0, 3], 0].mean(), abs=max(0.6, 0.006 * width_px))


@pytest.mark.parametrize("flat_height_px", [110, 140, 200, 280])
def test_the_rectified_size_does_not_change_a_height(flat_height_px):
    still = plate_still("us-mi", 220)
    own = read_characters(still.image, _exact(still))
    other = read_characters(still.image, _exact(still), flat_height_px)
    assert len(other.characters) == len(own.characters)
    assert _height_px(other) == pytest.approx(_height_px(own), rel=0.006)
    assert other.stroke_px == pytest.approx(own.stroke_px, rel=0.15)


def test_light_characters_on_a_dark_plate():
    still = plate_still("us-mi", 200)
    image = 255 - still.image
    reading = read_characters(image, _exact(still))
    assert reading.light_on_dark
    assert len(reading.characters) == len(still.glyph_boxes_px)
    assert not read_characters(still.image, _exact(still)).light_on_dark


def test_the_reader_answers_every_candidate_in_order():
    still = plate_still("us-mi", 200)
    nothing = still.corners_px - np.array([0.0, still.corners_px[0, 1] - 5])
    candidates = [PlateCandidate(corners_px=c, score=0.9) for c in (still.corners_px, nothing, still.corners_px)]
    first, second, third = PaperReader(SegmenterSettings(kind="paper")).read(still.image, candidates)
    assert len(first.characters) == len(third.characters) == len(still.glyph_boxes_px)
    assert len(second.characters) < len(still.glyph_boxes_px)


def test_enlargement_is_the_papers():
    assert [enlargement(h) for h in (20, 50, 99, 100, 300)] == pytest.approx([5.0, 2.0, 2.0, 1.0, 1.0])


def test_each_geometric_filter_refuses_its_own_kind():
    good = [40, 30, 20, 50, 500]
    bad = {
        "height": [40, 40, 8, 12, 60], "aspect": [40, 30, 90, 50, 3000], "area": [40, 30, 4, 29, 80],
        "fill": [40, 30, 40, 50, 200], "centre": [0, 30, 5, 50, 200], "through": [40, 0, 20, 100, 1000],
    }
    stats = np.array([good, *bad.values()], np.int32)
    assert geometric_filters(stats, 300, 100).tolist() == [True] + [False] * len(bad)


def test_height_outliers_go_and_equal_heights_stay():
    assert height_inliers(np.array([50.0] * 7)).all()
    assert height_inliers(np.array([50.0, 51, 49, 50, 50, 51, 80])).tolist() == [True] * 6 + [False]
    assert len(height_inliers(np.zeros(0))) == 0


def test_small_letters_of_a_russian_plate_are_not_main():
    heights = np.array([58.0, 76, 76, 76, 58, 58, 76, 75])
    assert main_class(heights).tolist() == [False, True, True, True, False, False, True, True]


def test_two_rows_are_told_apart():
    tops = np.array([10.0, 11, 10, 60, 61])
    assert rows_of(tops, tops + 40).tolist() == [0, 0, 0, 1, 1]


@pytest.mark.parametrize("width", [3, 4, 7, 10])
def test_stroke_of_a_bar(width):
    mask = np.zeros((60, 40), np.uint8)
    mask[5:55, 10 : 10 + width] = 1
    assert stroke_width(mask) == pytest.approx(width, abs=0.6)


def test_border_is_measured_or_absent_never_guessed():
    plate = np.full((400, 1600), 230, np.uint8)
    cv2.rectangle(plate, (12, 12), (1587, 387), 30, thickness=12)
    for x in range(200, 1400, 200):
        cv2.rectangle(plate, (x, 100), (x + 90, 300), 30, thickness=24)
    flat = cv2.resize(plate, (400, 100), interpolation=cv2.INTER_AREA)
    assert border_thickness(flat, False) == pytest.approx(3.0, abs=0.4)
    bare = plate.copy()
    bare[:60], bare[340:], bare[:, :60], bare[:, 1540:] = 230, 230, 230, 230
    assert border_thickness(cv2.resize(bare, (400, 100), interpolation=cv2.INTER_AREA), False) is None
