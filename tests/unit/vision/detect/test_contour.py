"""Algorithm 1: finds drawn plates, keeps to its gates, refuses what is no plate."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import plate_still

from tmde_edge.vision.detect.contour import ContourFinder, box_iou, verify_plate_region, without_doubles
from tmde_edge.vision.protocols import PlateCandidate
from tmde_edge.vision.settings import DetectorSettings

SETTINGS = DetectorSettings(kind="contour")


def _plate_on_grey(width: int = 200, height: int = 60) -> np.ndarray:
    """A bordered plate with seven letters at (150, 120) on a flat grey wall."""
    image = np.full((360, 640), 110, np.uint8)
    cv2.rectangle(image, (150, 120), (150 + width - 1, 120 + height - 1), 20, -1)
    cv2.rectangle(image, (154, 124), (150 + width - 5, 120 + height - 5), 235, -1)
    for i, c in enumerate("ABC1234"):
        at = (150 + round(width * (0.07 + 0.125 * i)), 120 + round(height * 0.78))
        cv2.putText(image, c, at, cv2.FONT_HERSHEY_SIMPLEX, height / 52, 20, max(1, height // 30))
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def test_a_clean_plate_is_found_where_it_is():
    found = ContourFinder(SETTINGS).find(_plate_on_grey())
    assert len(found) == 1
    true = np.array([[149.5, 119.5], [349.5, 119.5], [349.5, 179.5], [149.5, 179.5]])
    assert np.abs(found[0].corners_px - true).max() < 1.2
    assert 0.5 <= found[0].score < 1


def test_a_region_gives_source_pixels():
    image = _plate_on_grey()
    whole = ContourFinder(SETTINGS).find(image)[0]
    part = ContourFinder(SETTINGS).find(image, region_px=(100, 80, 420, 260))[0]
    assert part.corners_px == pytest.approx(whole.corners_px, abs=0.6)


def test_too_small_and_wrong_aspect_are_refused():
    assert ContourFinder(SETTINGS).find(_plate_on_grey(50, 16)) == []
    wide = _plate_on_grey(240, 50)
    assert ContourFinder(SETTINGS).find(wide) == []
    assert len(ContourFinder(SETTINGS, aspect_range=(4.7, 4.8)).find(wide)) == 1


def test_permissive_mode_takes_more_aspects_than_strict():
    finder = ContourFinder(SETTINGS)
    strict = finder.aspect_limits()
    finder.mode = "permissive"
    assert strict == (1.5, 4.0)
    assert finder.aspect_limits() == (1.2, 5.0)
    assert len(finder.find(_plate_on_grey(240, 50))) == 1


def test_no_plate_in_noise_gradients_and_blanks():
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 255, (360, 640), dtype=np.uint8)
    ramp = np.tile(np.linspace(0, 255, 640).astype(np.uint8), (360, 1))
    panel = np.full((360, 640), 80, np.uint8)
    panel[100:180, 200:440] = 200
    for image in (noise, ramp, panel, np.zeros((8, 8), np.uint8)):
        assert ContourFinder(SETTINGS).find(image) == []


def test_a_drawn_street_scene():
    still = plate_still("us-mi", 220, seed=4)
    found = ContourFinder(SETTINGS, (2.0, 2.0)).find(still.image)
    assert any(box_iou(c.corners_px, still.corners_px) > 0.5 for c in found)


def test_verification_needs_edges_contrast_and_characters():
    mesh = np.indices((80, 260)).sum(axis=0) // 5 % 2 * 200
    plate = _plate_on_grey()[120:180, 150:350]
    assert verify_plate_region(plate, 7)
    assert not verify_plate_region(plate, 0)
    assert not verify_plate_region((plate // 16 + 100).astype(np.uint8), 7)
    assert not verify_plate_region(mesh.astype(np.uint8), 7)


def test_doubles_go_the_better_stays():
    square = np.array([[0.0, 0], [10, 0], [10, 4], [0, 4]])
    a, b, c = (PlateCandidate(corners_px=square + d, score=s) for d, s in ((0, 0.6), (1, 0.9), (30, 0.2)))
    assert without_doubles([a, b, c]) == [b, c]
    assert box_iou(square, square) == pytest.approx(1.0)
    assert box_iou(square, square + 20) == 0.0
