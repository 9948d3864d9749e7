"""The sub-pixel outline on drawn plates."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import plate_still

from tmde_edge.vision.bands import with_bands
from tmde_edge.vision.edge_model import EdgeFit, fit_edges
from tmde_edge.vision.edge_steps import Tried, first_step
from tmde_edge.vision.ground_colour import plate_picture
from tmde_edge.vision.refine import _costs, refine_outline


def _nudged(corners, width_px, seed):
    return corners + np.random.default_rng(seed).normal(0, 0.006 * width_px, (4, 2))


@pytest.mark.parametrize(("standard", "width_px"), [("de-mittel", 300), ("de-mittel", 120), ("us-mi", 150), ("ru-1", 200)])
def test_outline_is_found_to_a_fraction_of_a_pixel(standard, width_px):
    errors = []
    for seed in range(4):
        still = plate_still(standard, width_px, seed=seed)
        fit = refine_outline(still.image, _nudged(still.corners_px, width_px, seed))
        errors.append(float(np.median(np.abs(fit.corners_px - still.corners_px))))
    assert float(np.median(errors)) < 0.3


def test_a_plain_bright_rectangle_is_exact():
    image = np.full((120, 240), 40, np.uint8)
    image[30:80, 40:190] = 220
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    true = np.array([[39.5, 29.5], [189.5, 29.5], [189.5, 79.5], [39.5, 79.5]])
    fit = refine_outline(image, true + np.array([[1.5, -1], [-1, 1.2], [1, 1], [-1.3, -0.8]]))
    assert fit.refined
    assert np.abs(fit.corners_px - true).max() < 0.1
    assert fit.sigma_px < 0.2
    assert fit.blur_px == pytest.approx(0.8, abs=0.2)


def test_light_on_dark_plates_too():
    image = np.full((120, 240), 200, np.uint8)
    image[30:80, 40:190] = 30
    image[45:65, 60:170:12] = 230
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    true = np.array([[39.5, 29.5], [189.5, 29.5], [189.5, 79.5], [39.5, 79.5]])
    fit = refine_outline(image, true + 1.0)
    assert fit.refined
    assert np.abs(fit.corners_px - true).max() < 0.15


def test_no_edge_is_said_not_hidden():
    flat = np.full((120, 240), 128, np.uint8)
    given = np.array([[40.0, 30.0], [190.0, 30.0], [190.0, 80.0], [40.0, 80.0]])
    fit = refine_outline(flat, given)
    assert not fit.refined
    assert np.array_equal(fit.corners_px, given)
    assert fit.sigma_px > 1.0


def test_a_side_outside_the_image_is_not_refined():
    still = plate_still("de-mittel", 200)
    x0 = int(still.corners_px[:, 0].min()) + 40
    cut = np.ascontiguousarray(still.image[:, x0:])
    fit = refine_outline(cut, still.corners_px - (x0, 0))
    assert not fit.refined
    assert np.isfinite(fit.corners_px).all()


def test_grey_and_colour_agree_where_nothing_is_blue():
    still = plate_still("ru-1", 150)
    grey = cv2.cvtColor(still.image, cv2.COLOR_BGR2GRAY)
    a, b = refine_outline(still.image, still.corners_px), refine_outline(grey, still.corners_px)
    assert np.array_equal(a.corners_px, b.corners_px)


def _two_tone(band_bgr, body_bgr, ground_bgr=(236, 240, 240)):
    """A plate of 150 x 40 px at (60, 40) whose left 16 px are a band; blurred."""
    image = np.full((120, 270, 3), body_bgr, np.float32)
    image[40:80, 60:210] = ground_bgr
    image[40:80, 60:76] = band_bgr
    image[50:70, 90:200:14] = image[50:70, 91:200:14] = image[50:70, 92:200:14] = 25
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    return image.astype(np.uint8), np.array([[59.5, 39.5], [209.5, 39.5], [209.5, 79.5], [59.5, 79.5]])


@pytest.mark.parametrize("body", [(38, 38, 36), (50, 40, 150), (30, 30, 30)])
def test_a_blue_band_on_a_dark_body_belongs_to_the_plate(body):
    image, true = _two_tone((160, 60, 10), body)
    inner = true + np.array([[16, 0], [0, 0], [0, 0], [16, 0]])  # what shows in grey
    for given in (inner, true + 0.4):
        fit = refine_outline(image, given, 0.5, False)
        assert fit.refined
        assert np.abs(fit.corners_px - true).max() < 0.35


def test_a_blue_band_on_a_yellow_plate_is_seen_in_colour():
    image, true = _two_tone((160, 60, 10), (38, 38, 36), ground_bgr=(40, 190, 240))
    inner = true + np.array([[16, 0], [0, 0], [0, 0], [16, 0]])
    grey = plate_picture(image, inner)
    assert grey.ndim == 2
    for given in (inner, true + 0.4):
        fit = refine_outline(grey, given, 0.5, False, colour=image)
        assert fit.refined
        assert np.abs(fit.corners_px - true).max() < 0.6


def test_a_blue_body_a_yellow_plate_and_a_picture_are_no_bands():
    image, true = _two_tone((236, 240, 240), (150, 60, 20))
    assert np.array_equal(with_bands(image, true, 1.0).corners_px, true)
    image, true = _two_tone((40, 190, 240), (50, 40, 150), ground_bgr=(40, 190, 240))
    assert np.array_equal(with_bands(image, true, 1.0).corners_px, true)
    image, true = _two_tone((236, 240, 240), (38, 38, 36))
    image[45:75, 110:130] = (180, 60, 20)
    assert np.array_equal(with_bands(image, true, 1.0).corners_px, true)


@pytest.mark.parametrize("inside_px", [4, 6, 8])
def test_a_blue_picture_near_the_end_of_a_plate_moves_no_side(inside_px):
    image, true = _two_tone((236, 240, 240), (112, 116, 120))
    left = 59 + inside_px
    image[43:76, left : left + 10] = (170, 60, 20)
    for given in (true, true + np.array([[-0.5, 0.3]] * 4)):
        corners = refine_outline(image, given, 0.5, False).corners_px
        assert np.abs(corners - true).max() < 0.6


@pytest.mark.parametrize("width_px", [70, 120])
@pytest.mark.parametrize("frame_h", [0.12, 0.3])
def test_a_blue_frame_round_a_plate_is_no_band(width_px, frame_h):
    height_px = width_px // 4
    border = round(frame_h * height_px)
    image = np.full((120, 240, 3), (112, 116, 120), np.float32)
    x, y = 50, 40
    image[y - border : y + height_px + border, x - border : x + width_px + border] = (160, 60, 10)
    image[y : y + height_px, x : x + width_px] = (236, 240, 240)
    image[y + height_px // 4 : y + 3 * height_px // 4, x + 8 : x + width_px - 8 : 7] = 25
    image = cv2.GaussianBlur(image, (0, 0), 0.7).astype(np.uint8)
    left, top, right, bottom = x - 0.5, y - 0.5, x + width_px - 0.5, y + height_px - 0.5
    true = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    assert np.abs(with_bands(image, true, 1.0).corners_px - true).max() == 0
    assert np.abs(refine_outline(image, true, 0.5, False).corners_px - true).max() < 0.5


def _low(band_bgr, body_bgr, ground_bgr=(236, 240, 240)):
    """A plate of 24 x 5.3 px whose right 2 px are a band, as a camera sees it; shrunk from eight times the size."""
    big = np.full((160, 480, 3), body_bgr, np.float32)
    big[56:98, 120:312] = ground_bgr
    big[56:98, 296:312] = band_bgr
    big[66:88, 150:286:14] = big[66:88, 152:286:14] = 25
    image = cv2.GaussianBlur(cv2.resize(big, (60, 20), interpolation=cv2.INTER_AREA), (0, 0), 0.55)
    return image.astype(np.uint8), np.array([[14.5, 6.5], [38.5, 6.5], [38.5, 11.75], [14.5, 11.75]])


@pytest.mark.parametrize("body", [(38, 38, 36), (50, 40, 150), (112, 116, 120)])
def test_a_low_plates_blue_band_belongs_to_it(body):
    image, true = _low((160, 60, 10), body)
    inner = true - np.array([[0, 0], [2, 0], [2, 0], [0, 0]])
    banded = with_bands(image, inner, 0.5)
    assert banded.right_px == 0.0
    assert banded.left_px is None
    assert np.abs(banded.corners_px - true).max() < 0.4


@pytest.mark.parametrize(
    ("band", "body", "ground"),
    [
        ((236, 240, 240), (150, 60, 20), (236, 240, 240)),  # a blue body
        ((40, 190, 240), (50, 40, 150), (40, 190, 240)),  # a yellow plate
        ((236, 240, 240), (38, 38, 36), (236, 240, 240)),
    ],
)
def test_a_low_plate_without_a_band_keeps_its_corners(band, body, ground):
    image, true = _low(band, body, ground)
    noisy = np.clip(image + np.random.default_rng(3).normal(0, 3, image.shape), 0, 255).astype(np.uint8)
    for given in (true, true - np.array([[0, 0], [1, 0], [1, 0], [0, 0]])):
        assert np.array_equal(with_bands(noisy, given, 0.5).corners_px, given)


def test_small_print_inside_the_edge_is_not_the_edge():
    image = np.full((140, 240), 40, np.uint8)
    image[30:105, 40:190] = 230
    image[50:85, 60:170:12] = 30
    image[98:101, 60:170] = 120  # a line of small print 4 px above the lower edge
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    true = np.array([[39.5, 29.5], [189.5, 29.5], [189.5, 104.5], [39.5, 104.5]])
    fit = refine_outline(image, true + np.array([[0.4, -0.3], [-0.3, 0.4], [0.3, -0.4], [-0.4, -0.2]]), 0.6, False)
    assert np.abs(fit.corners_px - true).max() < 0.25


def test_a_grey_recess_with_a_bright_body_beyond_is_not_a_border_line():
    image = np.full((140, 240), 225, np.uint8)
    image[27:113, 37:193] = 140  # 3 px of recess round the plate
    image[30:110, 40:190] = 230
    image[45:95, 60:170:12] = 30
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    true = np.array([[39.5, 29.5], [189.5, 29.5], [189.5, 109.5], [39.5, 109.5]])
    fit = refine_outline(image, true + 0.3, 0.6, False)
    assert np.abs(fit.corners_px - true).max() < 0.3


def test_a_side_without_an_edge_keeps_its_place_and_the_given_doubt():
    image = np.full((140, 260), 40, np.uint8)
    image[30:80, 40:260] = 220  # the ground runs on to the right
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    given = np.array([[39.5, 29.5], [189.5, 29.5], [189.5, 79.5], [39.5, 79.5]]) + np.array([0.3, -0.3])
    fit = refine_outline(image, given, 0.8, False)
    assert fit.side_sigma_px[1] == pytest.approx(0.8)
    assert max(fit.side_sigma_px[i] for i in (0, 2, 3)) < 0.4
    assert fit.corners_px[1, 0] == pytest.approx(given[1, 0], abs=0.1)


def test_lettering_next_to_the_edge_does_not_push_it_out():
    """Ground of 1.2 px between lettering and edge, blurred, never reaches its level: half of what is seen lies outside."""
    u = np.arange(-24, 25) * 0.25
    fine = np.arange(-2000, 2001) * 0.01
    raw = np.select([fine < -1.2, fine < 0], [90.0, 230.0], 60.0)
    kernel = np.exp(-0.5 * (np.arange(-400, 401) * 0.01 / 0.7) ** 2)
    profile = np.interp(u, fine, np.convolve(np.pad(raw, 400, mode="edge"), kernel / kernel.sum(), "valid"))
    args = (profile[None], u, np.array([0.2]), 30.0, 40.0, 1.0, np.array([[-2.2, 6.0]]))
    ((told, _),) = fit_edges(*args, np.array([230.0]), np.array([-1.2]))
    assert told.x_px == pytest.approx(0.0, abs=0.05)


def test_model_finds_the_edge_behind_an_unresolved_border():
    """A 3.2 px zone of line and margin, blurred: the first step lies inside, the plate's edge 3.2 px further out."""
    height_px, blur = 66.0, 0.8
    u = np.arange(-60, 61) * 0.25
    fine = np.arange(-2000, 2001) * 0.01
    raw = np.select([fine < -3.2, fine < -1.2, fine < 0], [230.0, 40.0, 230.0], 70.0)
    kernel = np.exp(-0.5 * (np.arange(-400, 401) * 0.01 / blur) ** 2)
    smooth = np.convolve(np.pad(raw, 400, mode="edge"), kernel / kernel.sum(), "valid")
    profile = np.interp(u, fine, smooth)
    start = first_step(profile, u)
    assert start == pytest.approx(-3.2, abs=0.5)
    ((without, border),) = fit_edges(profile[None], u, np.array([start]), height_px, 40.0, 3.0)
    assert border.misfit < 0.2 * without.misfit
    assert border.x_px == pytest.approx(0.0, abs=0.1)
    assert border.thickness_px == pytest.approx(2.0, abs=0.3)


def _tried(plain_cost, plain_px=0.0, lined_px=0.8):
    """A step's fits without and with a border line; plain_cost: by how much the plain one explains it worse."""
    step = Tried(
        i=0, side=None, profile=np.zeros(3), start_px=0.0, inner_px=-1.0, outer_px=1.0, text_px=float("nan"), valley_px=None,
    )  # fmt: skip
    fit = EdgeFit(x_px=plain_px, sigma_px=0.1, spread_px=0.6, thickness_px=0.0, misfit=np.exp(plain_cost / 6), line_off=0.0)
    return [(step, fit), (step, replace(fit, x_px=lined_px, misfit=1.0, thickness_px=0.5))]


@pytest.mark.parametrize(
    ("own", "others", "share", "lined"),
    [
        (-1.0, 4.0, 0.5, True),
        (-1.0, -4.0, 0.5, False),
        (1.0, -4.0, 0.5, False),
        (-6.0, 4.0, 0.5, False),  # a frame hides the line here
        (-0.5, -0.5, 0.9, True),  # nothing tells: the standard does
        (0.5, 0.5, 0.1, False),
        (-6.0, -6.0, 1.0, False),  # no belief is beyond what is seen
    ],
)
def test_a_side_that_is_in_doubt_about_its_border_line_follows_the_others_and_the_standard(own, others, share, lined):
    """own, others: by how much the plain step explains this side, and each other one, worse."""
    sides = [_tried(own), *[_tried(others)] * 3]
    assert bool(_costs(sides, 5.0, share)[0].argmin() == 1) == lined


def test_an_outline_that_is_too_small_is_too_small_on_all_sides():
    """Where one side shows two edges alike, the one that is as far out as the other sides' edges is the plate's."""
    clear = [_tried(50.0, lined_px=2.0)] * 3
    assert _costs([_tried(0.0, 0.0, 2.0), *clear], 1.0, 0.5)[0].argmin() == 1
    clear = [_tried(-50.0, plain_px=0.0)] * 3
    assert _costs([_tried(0.0, 0.0, 2.0), *clear], 1.0, 0.5)[0].argmin() == 0


@pytest.mark.parametrize(("standard", "right"), [("ru-1", 0.95), ("gb-2001", 0.05)])
def test_knowing_the_standard_tells_on_which_side_of_an_unresolved_line_a_plate_ends(standard, right):
    """At 60 px line and margin are half a pixel together: with the wrong belief the plate is read a per cent off."""
    off = {right: [], 1 - right: []}
    for seed in range(8):
        still = plate_still(standard, 60, seed=seed)
        true_px = float(np.hypot(*(still.corners_px[1] - still.corners_px[0])))
        for share, errors in off.items():
            fit = refine_outline(still.image, _nudged(still.corners_px, 60, seed), 0.5, False, share)
            errors.append(float(np.hypot(*(fit.corners_px[1] - fit.corners_px[0]))) - true_px)
    assert np.abs(off[right]).mean() < 0.4
    assert np.abs(off[right]).mean() < 0.7 * np.abs(off[1 - right]).mean()
