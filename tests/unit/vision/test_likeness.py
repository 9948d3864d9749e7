"""A plate looks like itself through noise, blur and small misplacement; its cover does not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import plate_still

from tmde_edge.vision.flow import follow_rear, make_template
from tmde_edge.vision.likeness import SURE, Looks, is_washed_out, small_look, view_of
from tmde_edge.vision.settings import FlowSettings


def seen(image, corners_px):
    return view_of(small_look(image, corners_px), corners_px)


@pytest.mark.parametrize("width_px", [28, 60, 200])
def test_itself_is_known_and_a_cover_is_not(width_px):
    still = plate_still("de-mittel", width_px, seed=3)
    rng = np.random.default_rng(0)

    def noisy(image):
        return np.clip(image + rng.normal(0, 5, image.shape), 0, 255).astype(np.uint8)

    looks = Looks()
    for _ in range(SURE):
        assert not looks.contradicted(seen(np.full_like(still.image, 40), still.corners_px))  # too little is known
        looks.learn(seen(noisy(still.image), still.corners_px))
    for shift in (-0.6, 0.0, 0.6):
        assert not looks.contradicted(seen(noisy(still.image), still.corners_px + shift))
        darker = noisy(cv2.GaussianBlur(still.image, (0, 0), 0.8) * 0.4)
        assert not looks.contradicted(seen(darker, still.corners_px + shift))
    covered = still.image.copy()
    cv2.fillConvexPoly(covered, np.rint(still.corners_px).astype(np.int32), (36, 36, 36))
    assert looks.contradicted(seen(noisy(covered), still.corners_px))


def test_too_small_or_no_area_is_no_view():
    image = np.zeros((50, 50, 3), np.uint8)
    assert seen(image, np.array([[0, 0], [10, 0], [10, 3], [0, 3]], np.float64)) is None
    looks = Looks(count=SURE)
    looks.learn(None)
    assert looks.count == SURE
    assert not looks.contradicted(None)


def test_the_rear_alone_leads_to_a_covered_plate():
    """The plate is covered between the two frames: the ring round it says where it went and how it grew."""
    still = plate_still("de-mittel", 60, seed=5)
    flow = FlowSettings()
    template = make_template(still.image, still.corners_px, flow)
    assert template is not None
    k, centre = 1.01, still.corners_px.mean(axis=0)
    warp = np.array([[k, 0, centre[0] * (1 - k) + 1.4], [0, k, centre[1] * (1 - k) - 0.8]])
    later = cv2.warpAffine(still.image, warp, still.image.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    true = still.corners_px @ warp[:, :2].T + warp[:, 2]
    cv2.fillConvexPoly(later, np.rint(true).astype(np.int32), (36, 36, 36))
    step = follow_rear(template, later, still.corners_px, flow)
    assert step is not None
    assert step.rear is not None
    assert np.abs(step.corners_px - true).max() < 0.3
    assert step.rear.ratio == pytest.approx(k, abs=max(4 * step.rear.sigma, 0.002))


def test_glare_that_eats_the_ink_is_washed_out_a_clipped_plate_with_dark_ink_is_not():
    small, large = plate_still("de-mittel", 40, seed=2), plate_still("de-mittel", 200, seed=2)
    in_glare = np.clip(small.image.astype(float) * 2.4, 0, 255).astype(np.uint8)  # its blurred strokes are nearly white
    in_lamps = np.clip((large.image.astype(float) - 20) * 2.4, 0, 255).astype(np.uint8)
    assert not is_washed_out(small_look(small.image, small.corners_px))
    assert is_washed_out(small_look(in_glare, small.corners_px))
    assert not is_washed_out(small_look(in_lamps, large.corners_px))
    assert not is_washed_out(small_look(in_glare, small.corners_px * np.nan))


def test_a_clipped_plate_of_two_dark_characters_is_not_washed_out():
    plate = np.full((14, 48), 255, np.uint8)
    plate[3:11, 20:22] = plate[3:11, 26:28] = 20  # 5 % ink
    assert not is_washed_out(plate)
    assert is_washed_out(np.maximum(plate, 235))
