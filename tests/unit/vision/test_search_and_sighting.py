"""Which looks are taken at which scale; sizes of a sighting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.vision.protocols import CharacterBox, PlateCandidate, PlateReading
from tmde_edge.vision.search import TILE_PX, NetworkSearch, PlainSearch, fovea_region, tiles
from tmde_edge.vision.settings import DetectorSettings, SegmenterSettings
from tmde_edge.vision.sighting import is_blind, plate_sighting, spacing, trimmed_mean


class Looks:
    """A detector that only remembers how it was asked."""

    def __init__(self, answer=()):
        self.calls: list[tuple[tuple[int, int, int, int], float, float]] = []
        self.answer = list(answer)

    def detect(self, image, *, region_px=None, scale=1.0, score_min=0.5):
        region = region_px or (0, 0, image.shape[1], image.shape[0])
        self.calls.append((region, scale, score_min))
        return self.answer

    def find(self, image, *, region_px=None):
        return self.answer


@given(st.integers(32, 6000), st.integers(32, 5000), st.sampled_from([0.15, 0.3, 0.5, 1.0]))
def test_tiles_cover_the_image_and_stay_inside(width, height, scale):
    regions = tiles(width, height, scale)
    assert all(0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height for x0, y0, x1, y1 in regions)
    assert all((x1 - x0) * scale <= TILE_PX[0] + 1 and (y1 - y0) * scale <= TILE_PX[1] + 1 for x0, y0, x1, y1 in regions)
    for point in ((0, 0), (width - 1, height - 1), (width // 3, height // 2), (width - 1, 0)):
        assert any(x0 <= point[0] < x1 and y0 <= point[1] < y1 for x0, y0, x1, y1 in regions)


@pytest.mark.parametrize("size", [(4032, 3024), (1280, 720), (640, 480), (200, 80)])
def test_a_still_never_costs_more_than_its_looks(size):
    detector = Looks()
    settings = DetectorSettings(still_tiles_max=12)
    for _ in NetworkSearch(detector, settings).still(np.zeros((size[1], size[0]), np.uint8), "strict"):
        pass
    assert len(detector.calls) <= 1 + 12 + 2
    for (x0, y0, x1, y1), scale, _ in detector.calls:
        assert (x1 - x0) * scale <= 660
        assert (y1 - y0) * scale <= 660
        assert scale <= 2.0


def test_who_has_seen_enough_pays_for_no_more():
    sure = PlateCandidate(corners_px=np.array([[0.0, 0], [50, 0], [50, 20], [0, 20]]), score=0.97)
    detector = Looks([sure])
    assert next(NetworkSearch(detector, DetectorSettings()).still(np.zeros((720, 1280), np.uint8), "strict")) == [sure]
    assert len(detector.calls) == 1


def test_permissive_mode_lowers_the_bar():
    detector, settings = Looks(), DetectorSettings()
    search = NetworkSearch(detector, settings)
    image = np.zeros((720, 1280), np.uint8)
    search.frame(image, "strict")
    search.frame(image, "permissive")
    assert [c[2] for c in detector.calls] == [settings.score_min] * 2 + [settings.permissive_score_min] * 2


def test_plain_search_gives_source_pixels_of_huge_stills():
    at = np.array([[100.0, 50], [200, 50], [200, 100], [100, 100]])
    search = PlainSearch(Looks([PlateCandidate(corners_px=at, score=0.9)]), DetectorSettings(kind="onnx"))
    ((found,),) = search.still(np.zeros((2400, 3200), np.uint8), "strict")
    assert found.corners_px == pytest.approx((at + 0.5) * 2 - 0.5)


@given(st.integers(10, 4000), st.integers(10, 3000), st.floats(-100, 5000), st.floats(-100, 5000))
def test_fovea_lies_inside_the_image(width, height, x, y):
    settings = DetectorSettings()
    for centre in (None, (x, y)):
        x0, y0, x1, y1 = fovea_region(width, height, centre, settings)
        assert 0 <= x0 < x1 <= width
        assert 0 <= y0 < y1 <= height
        assert x1 - x0 <= settings.fovea_width_px


def _box(left, top, width, height, **more):
    x, y = left + width / 2, top + height / 2
    points = [np.array(p, float) for p in ((left, y), (left + width, y), (x, top), (x, top + height))]
    return CharacterBox(left_px=points[0], right_px=points[1], top_px=points[2], bottom_px=points[3], **more)


def test_char_height_is_the_mean_of_main_characters_and_trims_when_asked():
    boxes = (*(_box(20 * i, 10, 12, h) for i, h in enumerate((20, 21, 22, 23, 34))), _box(120, 12, 12, 15, main=False))
    reading = PlateReading(corners_px=np.array([[0.0, 0], [200, 0], [200, 50], [0, 50]]), corners_sigma_px=0.3, refined=True,
                           characters=boxes)
    make = lambda **s: plate_sighting(  # noqa: E731
        reading, track_id=1, score=0.9, source="detector", shape=(100, 300), settings=SegmenterSettings(**s)
    )
    assert make().char_height_px == pytest.approx(24.0)
    assert make(trim_k=2).char_height_px == pytest.approx(22.0)
    assert make(min_characters=7).char_height_px is None
    assert make().spacing_px == pytest.approx(20.0, rel=0.02)  # their middles lie at different heights
    assert len(make().glyphs) == 6


def test_spacing_leaves_group_gaps_out_and_rows_apart():
    row = [_box(x, 0, 10, 20) for x in (0, 15, 30, 70, 85)]
    assert spacing(tuple(row)) == pytest.approx(15.0)
    other = [_box(x, 40, 10, 20, row=1) for x in (7, 22, 37)]
    assert spacing(tuple(row + other)) == pytest.approx(15.0)
    assert spacing((row[0], row[1])) is None


@given(st.lists(st.floats(1, 100), min_size=1, max_size=12), st.integers(0, 5))
def test_trimmed_mean_lies_between_the_extremes(values, k):
    mean = trimmed_mean(values, k)
    assert mean is not None
    assert min(values) - 1e-9 <= mean <= max(values) + 1e-9
    assert trimmed_mean([], k) is None


def test_a_dark_street_with_lamps_is_not_blind():
    night = np.full((720, 1280), 4, np.uint8)
    night[420:, 300:980] = np.linspace(10, 45, 300).astype(np.uint8)[:, None]  # the road in the own beam
    night[380:400, 600:640] = 255
    assert not is_blind(night, 12.0)
    assert is_blind(np.full((720, 1280, 3), 4, np.uint8), 12.0)
