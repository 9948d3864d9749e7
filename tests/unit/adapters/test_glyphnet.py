"""The packaged network through its adapter: rendered plates, wrong files, odd corners."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tmde_edge.adapters.detectors.glyphnet import MODEL_FILE, GlyphNet
from tmde_edge.errors import ModelError
from tmde_edge.simulation.plate_face import FaceSpec, GlyphSpec, render_face
from tmde_edge.simulation.stills import render_still
from tmde_edge.vision.protocols import PlateCandidate
from tmde_edge.vision.segment.glyph_reader import GlyphReader
from tmde_edge.vision.settings import SegmenterSettings


@pytest.fixture(scope="module")
def network() -> GlyphNet:
    return GlyphNet(threads=1)


def plate(text: str, *, light_on_dark: bool = False) -> FaceSpec:
    """A one-line plate 520 x 112 mm with glyphs 76 mm tall."""
    pitch, width = 56.0, 44.0
    left = -(pitch * len(text) - (pitch - width)) / 2
    glyphs = tuple(
        GlyphSpec(char=c, left_mm=left + k * pitch, top_mm=-38, width_mm=width, height_mm=76, stroke_mm=10)
        for k, c in enumerate(text)
    )
    dark, light = (25, 25, 25), (225, 225, 225)
    ink, ground = (light, dark) if light_on_dark else (dark, light)
    return FaceSpec(width_mm=520, height_mm=112, glyphs=glyphs, background_bgr=ground, ink_bgr=ink, border_mm=3)


def scene(spec: FaceSpec, width_px: float, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """A grey 480 x 360 picture with the plate's top left corner at (x, y) px, and its true corners."""
    ppm = 4 * width_px / spec.width_mm
    big = np.full((360 * 4, 480 * 4, 3), 70, np.uint8)
    face = render_face(spec, ppm)
    col, row = round(4 * x), round(4 * y)
    big[row : row + face.shape[0], col : col + face.shape[1]] = face
    seen = cv2.resize(cv2.GaussianBlur(big, (0, 0), 2.4), (480, 360), interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(seen, cv2.COLOR_BGR2GRAY)
    # the big picture's pixel k covers the small one's (k - 0.5) / 4 .. in continuous coordinates; centres are at +0.5
    x0, y0 = col / 4 - 0.5, row / 4 - 0.5
    x1, y1 = x0 + face.shape[1] / 4, y0 + face.shape[0] / 4
    return grey, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


@pytest.mark.parametrize(("text", "dark"), [("AB423CD", False), ("8K4772", False), ("HN90EFZX", False), ("GT5560B", True)])
@pytest.mark.parametrize("width_px", [80.0, 200.0])
def test_a_rendered_plate_is_read_with_its_count_and_edges(
    network: GlyphNet, text: str, dark: bool, width_px: float
) -> None:
    spec = plate(text, light_on_dark=dark)
    image, truth = scene(spec, width_px, 130.0, 120.0)
    wrong = truth + np.array([[0.02, -0.01], [-0.02, 0.02], [0.01, 0.015], [-0.01, -0.01]]) * width_px
    (reading,) = network.read(image, wrong[None])
    assert reading.count == len(text)
    assert reading.platehood > 0.5
    assert reading.light_on_dark == dark
    assert all(g.main for g in reading.glyphs)
    assert np.abs(reading.corners_px - truth).max() < max(1.0, 0.012 * width_px)
    centre = truth.mean(axis=0)
    heights = [g.bottom_px[1] - g.top_px[1] for g in reading.glyphs]
    assert np.mean(heights) == pytest.approx(76 * width_px / 520, rel=0.05)
    lefts = [g.left_px[0] for g in reading.glyphs]
    expected = [centre[0] + s.left_mm * width_px / 520 for s in spec.glyphs]
    assert np.abs(np.array(lefts) - expected).max() < max(1.0, 0.012 * width_px)


def test_colour_and_grey_give_the_same_reading_and_a_batch_equals_single_reads(network: GlyphNet) -> None:
    image, truth = scene(plate("AB423CD"), 120.0, 90.0, 60.0)
    candidates = np.stack([truth, truth + np.array([200.0, 150.0])])
    grey = network.read(image, candidates)
    colour = network.read(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), candidates)
    single = network.read(image, candidates[1:])
    np.testing.assert_allclose(grey[0].corners_px, colour[0].corners_px, atol=0.02)
    np.testing.assert_allclose(grey[1].corners_px, single[0].corners_px, atol=0.02)
    assert grey[0].platehood > 0.5 > grey[1].platehood


def test_a_small_plate_that_is_followed_keeps_its_size(network: GlyphNet) -> None:
    """Each look is given what the look before made of the plate: an error must not feed itself."""
    reader = GlyphReader(network, SegmenterSettings())
    off_px = []  # width, characters' height; and how much the plate's height grew from the first look to the fourth
    for standard in ("de-mittel", "fr-1", "us-mi", "gb-2001", "ro-1"):
        for seed in range(4):
            still = render_still(standard, width_px=19.0 + seed, seed=seed, scenery=False)
            corners, heights_px, characters = still.corners_px, [], ()
            for _ in range(4):
                reading = reader.read(still.image, [PlateCandidate(corners_px=corners, score=0.9)])[0]
                corners, characters = reading.corners_px, reading.characters
                heights_px.append(_height_px(corners))
            wide_px = float(np.hypot(*(corners[1] - corners[0])) - np.hypot(*(still.corners_px[1] - still.corners_px[0])))
            boxes = still.glyph_boxes_px
            tall_px = np.hypot(*((boxes[:, 3] + boxes[:, 2] - boxes[:, 0] - boxes[:, 1]) / 2).T)
            seen_px = [float(np.hypot(*(c.bottom_px - c.top_px))) for c in characters if c.main]
            high_px = float(np.median(seen_px) - np.median(tall_px[tall_px > 0.95 * tall_px.max()])) if seen_px else np.nan
            off_px.append((wide_px, high_px, heights_px[-1] - heights_px[0]))
    width, character, growth = np.nanmedian(np.array(off_px), axis=0)
    assert abs(width) < 0.4
    assert abs(character) < 0.25
    assert abs(growth) < 0.2


def _height_px(corners: np.ndarray) -> float:
    return float(np.mean(np.hypot(*(corners[[3, 2]] - corners[[0, 1]]).T)))


def test_no_candidates_no_readings_and_corners_without_area_are_no_plate(network: GlyphNet) -> None:
    image = np.zeros((60, 80), np.uint8)
    assert network.read(image, np.zeros((0, 4, 2))) == []
    (reading,) = network.read(image, np.zeros((1, 4, 2)))
    assert reading.platehood == 0.0
    assert reading.glyphs == ()


def test_corners_that_are_not_numbers_are_an_error(network: GlyphNet) -> None:
    with pytest.raises(ValueError, match="finite"):
        network.read(np.zeros((60, 80), np.uint8), np.full((1, 4, 2), np.nan))


def test_a_missing_a_broken_and_a_foreign_model_are_model_errors(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="missing"):
        GlyphNet(model=tmp_path / "none.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(MODEL_FILE.read_bytes()[:5000])
    with pytest.raises(ModelError, match="not a network"):
        GlyphNet(model=broken)
    other = MODEL_FILE.parent / "platenet.onnx"
    if other.exists():
        with pytest.raises(ModelError, match="not GlyphNet"):
            GlyphNet(model=other)


def test_the_packaged_model_is_small() -> None:
    assert MODEL_FILE.stat().st_size <= 600_000
