"""GlyphReader round a made-up network that errs by a known amount."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import plate_still

from tmde_edge.messages import PlateColours
from tmde_edge.simulation.stills import render_still
from tmde_edge.simulation.vehicle import Body
from tmde_edge.vision.protocols import PlateCandidate
from tmde_edge.vision.segment.bolts import BoltPlaces
from tmde_edge.vision.segment.glyph_decode import Glyph, GlyphReading
from tmde_edge.vision.segment.glyph_reader import GlyphReader
from tmde_edge.vision.settings import SegmenterSettings
from tmde_edge.vision.sighting import plate_sighting, washed

AMERICAN = BoltPlaces(spacing=177.8 / 304.8, aspect=0.5)


class Unsure:
    """Is less sure of the fourth character."""

    def __init__(self, network, score):
        self.network, self.score = network, score

    def read(self, image, corners_px):
        reading = self.network.read(image, corners_px)[0]
        glyphs = list(reading.glyphs)
        glyphs[3] = replace(glyphs[3], score=self.score)
        return [replace(reading, glyphs=tuple(glyphs))]


class Network:
    """Knows the truth, moved by an error; sigma as told."""

    def __init__(self, still, corner_error_px=0.0, glyph_error=0.0, sigma_px=0.8, platehood=0.99):
        self.still, self.corner_error, self.glyph_error = still, corner_error_px, glyph_error
        self.sigma, self.platehood = sigma_px, platehood

    def read(self, image, corners_px):
        rng = np.random.default_rng(5)
        glyphs = []
        for box, main in zip(self.still.glyph_boxes_px, self.still.face.main, strict=True):
            height = box[3, 1] - box[0, 1]
            top, bottom = (box[0] + box[1]) / 2, (box[2] + box[3]) / 2
            left, right = (box[0] + box[3]) / 2, (box[1] + box[2]) / 2
            dl, dr, dt, db = rng.normal(0, self.glyph_error * height, 4)
            glyphs.append(Glyph(
                left_px=left + np.array([dl, 0]), right_px=right + np.array([dr, 0]), top_px=top + np.array([0, dt]),
                bottom_px=bottom + np.array([0, db]), score=0.9, main=main, row=0,
            ))
        corners = self.still.corners_px + rng.normal(0, self.corner_error, (4, 2))
        reading = GlyphReading(
            platehood=self.platehood, corners_px=corners, sigma_px=np.full(4, self.sigma), glyphs=tuple(glyphs),
            light_on_dark=False,
        )
        return [reading] * len(corners_px)


def _read(still, network):
    candidate = PlateCandidate(corners_px=still.corners_px, score=0.9)
    return GlyphReader(network, SegmenterSettings()).read(still.image, [candidate])[0]


@pytest.mark.parametrize("standard", ["de-mittel", "us-mi", "ru-1"])
def test_heights_are_measured_in_the_image_not_taken_from_the_network(standard):
    still = plate_still(standard, 240, seed=3)
    reading = _read(still, Network(still, corner_error_px=1.0, glyph_error=0.03))
    heights = [np.hypot(*(c.bottom_px - c.top_px)) for c in reading.characters if c.main]
    assert np.mean(heights) == pytest.approx(still.char_height_px, rel=0.006)
    assert [c.main for c in reading.characters] == list(still.face.main)
    assert reading.platehood == 0.99
    spec = still.face.spec
    assert reading.stroke_px == pytest.approx(spec.glyphs[1].stroke_mm * still.width_px / spec.width_mm, rel=0.12)


@pytest.mark.parametrize(("ink", "score", "count"), [(0.5, 0.6, 6), (0.5, 0.9, 7), (0.95, 0.6, 7)])
def test_seals_in_the_row_are_no_characters_unless_inked_like_them(ink, score, count):
    still = plate_still("us-mi", 240, seed=3)
    (left, top), (right, bottom) = still.glyph_boxes_px[3][0].astype(int), still.glyph_boxes_px[3][2].astype(int)
    dark, paper = np.percentile(still.image[top:bottom, left:right], (5, 95))
    still.image[top - 2 : bottom + 3, left - 1 : right + 2] = int(paper)
    radius = (bottom - top) // 4
    level = float(paper + ink * (dark - paper))
    for y in (top + radius, bottom - radius):
        cv2.circle(still.image, ((left + right) // 2, int(y)), int(radius), (level,) * 3, cv2.FILLED)
    assert len(_read(still, Unsure(Network(still), score)).characters) == count


def test_the_outline_is_the_images_where_it_shows():
    errors = []
    for seed in range(4):
        still = plate_still("de-mittel", 240, seed=seed)
        reading = _read(still, Network(still, corner_error_px=1.0, sigma_px=1.0))
        errors.append(np.median(np.abs(reading.corners_px - still.corners_px)))
        assert reading.corners_sigma_px <= 1.0
    assert np.median(errors) < 0.3


def test_small_plates_keep_the_networks_corners_and_believe_them_less():
    still = plate_still("de-mittel", 28)
    reading = _read(still, Network(still, sigma_px=0.3))
    assert reading.refined
    assert 0.4 < reading.corners_sigma_px < 0.7
    assert np.abs(reading.corners_px - still.corners_px).max() < 0.1


@pytest.mark.parametrize(("hurried", "places", "pairs"), [(False, (AMERICAN,), 1), (True, (AMERICAN,), 0), (False, (), 0)])
def test_bolts_are_looked_for_where_they_are_expected_and_time_allows(hurried, places, pairs):
    still = plate_still("us-mi", 160, seed=3)
    reader = GlyphReader(Network(still), SegmenterSettings(), bolts=places)
    reading = reader.read(still.image, [PlateCandidate(corners_px=still.corners_px, score=0.9, hurried=hurried)])[0]
    assert len(reading.bolts) == pairs


@pytest.mark.parametrize(
    ("standard", "seen"),
    [("fr-1", ("white", True, True)), ("de-mittel", ("white", True, False)), ("gb-2001", ("yellow", False, False)),
     ("pl-2", ("white", True, False)), ("us-mi", ("white", False, False))],
)  # fmt: skip
def test_a_plates_colours_are_read_where_time_allows(standard, seen):
    still = plate_still(standard, 90, seed=3)
    reader = GlyphReader(Network(still), SegmenterSettings())
    for hurried in (False, True):
        reading = reader.read(still.image, [PlateCandidate(corners_px=still.corners_px, score=0.9, hurried=hurried)])[0]
        if hurried:
            assert reading.colours is None
        else:
            assert (reading.colours.ground, reading.colours.left_band, reading.colours.right_band) == seen
    sighting = plate_sighting(
        replace(reading, colours=PlateColours(ground="green")), track_id=1, score=0.9, source="detector", shape=still.image.shape,
        settings=SegmenterSettings(),
    )  # fmt: skip
    assert sighting.colours == PlateColours(ground="green")
    assert washed(replace(reading, colours=PlateColours(ground="green"))).colours is None


class BandLeftOut(Network):
    """Sees grey only: the second band of a French plate is body to it."""

    def read(self, image, corners_px):
        reading = super().read(image, corners_px)[0]
        corners = reading.corners_px.copy()
        corners[1:3] += 0.077 * (corners[[0, 3]] - corners[1:3])  # 40 of 520 mm
        return [replace(reading, corners_px=corners)]


@pytest.mark.parametrize("hurried", [False, True])
def test_small_plates_have_their_second_blue_band(hurried):
    dark = Body(kind="sedan", colour_bgr=(40.0, 38.0, 36.0), plate_up_m=0.8)
    still = render_still("fr-1", width_px=30, body=dark, scenery=False)
    candidate = PlateCandidate(corners_px=still.corners_px, score=0.9, hurried=hurried)
    off = {}
    for refine in (True, False):
        reader = GlyphReader(BandLeftOut(still, sigma_px=0.3), SegmenterSettings(refine=refine))
        corners = reader.read(still.image, [candidate])[0].corners_px
        off[refine] = np.abs(corners - still.corners_px).max()
    assert off[False] > 2
    assert off[True] < 0.6


@pytest.mark.parametrize("colour", [(112.0, 116.0, 120.0), (232.0, 232.0, 230.0)])
def test_a_plate_ends_at_the_outer_end_of_its_bands(colour):
    body = Body(kind="van", colour_bgr=colour, plate_up_m=0.8)
    for seed in range(6):
        still = render_still("fr-1", width_px=34.0 + seed, body=body, scenery=False, seed=seed)
        corners = _read(still, Network(still, corner_error_px=0.3, sigma_px=0.6)).corners_px
        assert np.abs(corners - still.corners_px)[:, 0].max() < 1.0, seed  # a band is 2.6 px wide


class Watched(Network):
    """Keeps the picture that it was given."""

    def read(self, image, corners_px):
        self.picture = image
        return super().read(image, corners_px)


def test_a_yellow_plate_is_read_in_a_picture_in_which_it_is_bright():
    silver = Body(kind="van", colour_bgr=(200.0, 203.0, 205.0), plate_up_m=0.8)
    for seed in range(5):
        still = render_still("gb-2001", width_px=32.0 + seed, body=silver, scenery=False, seed=seed)
        network = Watched(still, sigma_px=0.6)
        reading = _read(still, network)
        assert network.picture.ndim == 2
        assert np.abs(reading.corners_px - still.corners_px).max() < 1.0, seed


def test_a_white_plate_is_read_in_the_image_itself():
    still = plate_still("us-mi", 60)
    network = Watched(still)
    _read(still, network)
    assert network.picture is still.image


def test_a_yellow_plate_between_white_ones_is_read_in_its_turn():
    still, other = plate_still("de-mittel", 120), plate_still("gb-2001", 120)
    image = np.concatenate([still.image, other.image])
    shift = np.array([0.0, still.image.shape[0]])

    class Corners:
        def read(self, image, corners_px):
            return [replace(Network(still).read(image, corners_px[:1])[0], corners_px=c, glyphs=()) for c in corners_px]

    places = [still.corners_px, other.corners_px + shift, still.corners_px + 0.5]
    found = GlyphReader(Corners(), SegmenterSettings()).read(image, [PlateCandidate(corners_px=p, score=0.9) for p in places])
    for reading, true in zip(found, (still.corners_px, other.corners_px + shift, still.corners_px), strict=True):
        assert np.abs(reading.corners_px - true).max() < 1.5


def test_what_is_no_plate_is_not_measured():
    still = plate_still("us-mi", 200)
    reading = _read(still, Network(still, platehood=0.1))
    assert reading.platehood == 0.1
    assert not reading.refined
    assert reading.stroke_px is None
    assert GlyphReader(Network(still), SegmenterSettings()).read(still.image, []) == []
