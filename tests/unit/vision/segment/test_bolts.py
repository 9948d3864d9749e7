"""Bolts on rendered plates, at known places."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tmde_edge.geometry.planar import rectangle_mm
from tmde_edge.simulation import stills
from tmde_edge.simulation.standard_face import standard_face
from tmde_edge.vision.rectify import apply_homography
from tmde_edge.vision.segment.bolts import BoltPlaces, find_bolts
from tmde_edge.vision.segment.paper import FlatView, flatten

AMERICAN = BoltPlaces(spacing=177.8 / 304.8, aspect=0.5)


def _still(monkeypatch, width_px=120.0, *, discs=(0, 1, 2, 3), standard="us-mi", seed=1, yaw_rad=0.0):
    """A plate with these of its four bolts (upper left, lower left, upper right, lower right)."""
    face = standard_face(standard, "ABC 1234" if standard.startswith("us") else None)
    marks, bolts = [], [m for m in face.spec.marks if m.kind == "disc"]
    marks = [m for m in face.spec.marks if m.kind != "disc"] + [bolts[i] for i in discs if i < len(bolts)]
    changed = replace(face, spec=replace(face.spec, marks=tuple(marks)))
    monkeypatch.setattr(stills, "standard_face", lambda *_, **__: changed)
    return stills.render_still(standard, width_px=width_px, seed=seed, yaw_rad=yaw_rad, scenery=False)


def _found(still, places=(AMERICAN,)):
    view = flatten(still.image, still.corners_px)
    assert view is not None
    boxes = apply_homography(np.linalg.inv(view.source_from_flat), still.glyph_boxes_px.reshape(-1, 2)).reshape(-1, 4, 2)
    return find_bolts(view, np.concatenate([boxes.min(axis=1), boxes.max(axis=1)], axis=1), places)


def _true_px(still, x_mm, y_mm):
    flat = rectangle_mm(still.face.spec.width_mm, still.face.spec.height_mm)[:, :2].astype(np.float32)
    homography = cv2.getPerspectiveTransform(flat, still.corners_px.astype(np.float32)).astype(np.float64)
    return apply_homography(homography, np.array([[x_mm, y_mm]]))[0]


@pytest.mark.parametrize(("width_px", "yaw_rad"), [(75.0, 0.0), (120.0, 0.0), (200.0, 0.3)])
def test_both_bolts_of_the_lower_row_are_found_where_they_are(monkeypatch, width_px, yaw_rad):
    still = _still(monkeypatch, width_px, yaw_rad=yaw_rad)
    bolts = [b for b in _found(still) if b.left_px[1] > still.corners_px[:, 1].mean()]
    assert len(bolts) == 1
    left, right = _true_px(still, -88.9, 60.2), _true_px(still, 88.9, 60.2)
    assert np.hypot(*(bolts[0].left_px - left)) < 0.5
    assert np.hypot(*(bolts[0].right_px - right)) < 0.5
    apart_px = np.hypot(*(bolts[0].right_px - bolts[0].left_px))
    assert apart_px == pytest.approx(np.hypot(*(right - left)), abs=2 * bolts[0].sigma_px)


@pytest.mark.parametrize("discs", [(), (1,), (3,), (0, 3), (1, 2)])
@pytest.mark.parametrize("standard", ["us-mi", "us-aamva3"])
def test_print_and_single_bolts_are_no_pair(monkeypatch, discs, standard):
    for seed in range(3):
        assert _found(_still(monkeypatch, 110.0, discs=discs, standard=standard, seed=seed)) == ()


def test_a_pair_that_is_not_alike_is_none(monkeypatch):
    still = _still(monkeypatch, 160.0, discs=(1, 3))
    assert len(_found(still)) == 1
    x, y = np.rint(_true_px(still, 88.9, 60.2)).astype(int)
    still.image[y : y + 4, x - 4 : x + 5] = still.image[y - 8, x]  # half of it painted over
    assert _found(still) == ()


def test_only_plates_that_can_have_bolts_there_are_looked_at(monkeypatch):
    still = _still(monkeypatch, 160.0)
    assert _found(still, ()) == ()
    assert _found(still, (replace(AMERICAN, aspect=0.21),)) == ()  # of a long plate


def test_a_picture_that_shows_nothing_has_no_bolts(monkeypatch):
    still = _still(monkeypatch, 160.0)
    still.image[:] = 128
    assert _found(still) == ()


# On a drawn plate of 1 px a mm: letters (left, top, right, bottom), and (x, y, half width, half height, darkness) of spots
# about the middle of its lower margin.
LETTERS = np.array([[x, 45.0, x + 8, 108.0] for x in range(30, 275, 24)])
PAIR = [(-88.9, 0, 5, 5, 120), (88.9, 0, 5, 5, 120)]


@pytest.mark.parametrize(
    ("spots", "pairs"),
    [
        (PAIR, 1),
        ([(x, 0, 4, 5, 120) for x in np.arange(-10.5, 11) * 178 / 14], 0),  # print all along
        ([(x, y, a, b, 15) for x, y, a, b, _ in PAIR], 0),  # hardly darker than the ground
        ([(x, y, 60, b, dark) for x, y, _, b, dark in PAIR], 0),  # a line along the plate
        ([(x, y, 2, 20, dark) for x, y, _, _, dark in PAIR], 0),  # lines across it
        ([(x, 0.06 * x, a, b, dark) for x, _, a, b, dark in PAIR], 0),  # not level
        ([(0.9 * x, y, a, b, dark) for x, y, a, b, dark in PAIR], 0),  # too close together
        ([(x + 9, y, a, b, dark) for x, y, a, b, dark in PAIR], 0),  # not about the plate's middle
        ([(x, y, a, b, 200 if x < 0 else 70) for x, y, a, b, _ in PAIR], 0),  # one much deeper
    ],
)
def test_what_a_pair_must_look_like(spots, pairs):
    assert len(find_bolts(_drawn(spots), LETTERS, (AMERICAN,))) == pairs


def test_on_a_small_plate_a_bolt_is_too_few_pixels():
    assert find_bolts(replace(_drawn(PAIR), per_px=305 / 50), LETTERS, (AMERICAN,)) == ()


def _drawn(spots):
    grey = np.full((152, 305), 230, np.uint8)
    for left, top, right, bottom in LETTERS.astype(int):
        grey[top:bottom, left:right] = 30
    for x, y, a, b, dark in spots:
        centre, axes = (round(16 * (152 + x)), round(16 * (136 + y))), (16 * a, 16 * b)
        cv2.ellipse(grey, centre, axes, 0, 0, 360, 230 - dark, cv2.FILLED, cv2.LINE_AA, 4)
    return FlatView(grey=cv2.GaussianBlur(grey, (0, 0), 1.5), source_from_flat=np.eye(3), per_px=1.0)


def test_what_lies_in_the_characters_is_none():
    tall = LETTERS + np.array([0, 0, 0, 40])
    assert len(find_bolts(_drawn(PAIR), LETTERS, (AMERICAN,))) == 1
    assert find_bolts(_drawn(PAIR), tall, (AMERICAN,)) == ()
    assert len(find_bolts(_drawn(PAIR), np.empty((0, 4)), (AMERICAN,))) == 1
