"""What is told of a plate's ground and of blue bands at its ends, and what is left open."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tmde_edge.messages import PlateColours
from tmde_edge.vision.plate_colours import plate_colours

CORNERS = np.array([[199.5, 99.5], [303.5, 99.5], [303.5, 121.5], [199.5, 121.5]])
WHITE, YELLOW, GREEN, BLUE, INK, EU = (236, 240, 240), (40, 190, 240), (60, 110, 20), (150, 60, 20), (22, 22, 24), (150, 60, 20)


def _plate(ground_bgr=WHITE, ink_bgr=INK, left_bgr=None, right_bgr=None, light=(1.0, 1.0, 1.0), around_bgr=(90, 90, 90)):
    image = np.full((240, 520, 3), around_bgr, np.uint8)
    image[100:122, 200:304] = ground_bgr
    for left in range(212, 290, 11):
        image[104:118, left : left + 5] = ink_bgr
    if left_bgr is not None:
        image[100:122, 200:208] = left_bgr
    if right_bgr is not None:
        image[100:122, 296:304] = right_bgr
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    return np.minimum(image * np.array(light), 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("ground", "ink", "name"),
    [
        (WHITE, INK, "white"), ((160, 165, 166), INK, "white"), ((66, 70, 72), (15, 15, 15), "white"),
        (YELLOW, INK, "yellow"), ((18, 60, 75), (5, 6, 6), "yellow"), (GREEN, WHITE, "green"), (BLUE, WHITE, "blue"),
        ((100, 70, 180), INK, None),  # pink: no plate's ground
        ((140, 200, 215), INK, None),  # yellowish: by a lamp, or faded
    ],
)  # fmt: skip
def test_the_ground_is_named_where_it_is_plain(ground, ink, name):
    light_on_dark = sum(ink) > sum(ground)
    colours = plate_colours(_plate(ground, ink, left_bgr=EU if name == "white" else None), CORNERS, light_on_dark)
    assert colours is not None
    assert colours.ground == name


@pytest.mark.parametrize("ground", [WHITE, YELLOW])
@pytest.mark.parametrize(("left", "right"), [(EU, None), (EU, EU), (None, None), (None, EU)])
def test_blue_bands_are_seen_at_both_ends(ground, left, right):
    colours = plate_colours(_plate(ground, left_bgr=left, right_bgr=right), CORNERS, light_on_dark=False)
    assert colours is not None
    assert (colours.left_band, colours.right_band) == (left is not None, right is not None)


def test_grey_at_an_end_of_a_yellow_plate_is_no_band():
    colours = plate_colours(_plate(YELLOW, left_bgr=(120, 120, 120)), CORNERS, light_on_dark=False)
    assert colours is not None
    assert colours.left_band is False


@pytest.mark.parametrize("light", [(0.3, 0.75, 1.0), (0.1, 0.7, 1.0), (0.5, 0.75, 1.0), (1.0, 0.5, 0.4)])
def test_in_coloured_light_no_ground_is_coloured_and_no_band_denied(light):
    """Sodium lamps, dusk, a blue flash: all else is of that colour too."""
    for left in (None, EU):
        seen = plate_colours(_plate(left_bgr=left, light=light, around_bgr=(120, 125, 128)), CORNERS, light_on_dark=False)
        assert seen is not None
        assert seen.ground in (None, "white")
        assert False not in (seen.left_band, seen.right_band) or seen.ground == "white"


def test_a_yellow_plate_on_a_coloured_vehicle_is_yellow():
    for body in ((130, 70, 30), (40, 38, 36), (52, 40, 150), (60, 110, 20)):
        seen = plate_colours(_plate(YELLOW, around_bgr=body), CORNERS, light_on_dark=False)
        assert seen is not None
        assert seen.ground == "yellow"


def test_tinted_light_may_hide_a_band_but_does_not_deny_it():
    pink = (0.75, 0.6, 1.0)
    seen = plate_colours(_plate(left_bgr=EU, light=pink), CORNERS, light_on_dark=False)
    assert seen is not None
    assert seen.left_band is True
    assert seen.right_band is None
    pale = plate_colours(_plate(left_bgr=(200, 190, 195), light=pink), CORNERS, light_on_dark=False)
    assert pale is not None
    assert pale.left_band is None


def test_a_low_plate_shows_no_bands_but_its_ground():
    corners = CORNERS.mean(axis=0) + (CORNERS - CORNERS.mean(axis=0)) * 0.2
    shrink = np.array([[0.2, 0, 0.8 * 251.5], [0, 0.2, 0.8 * 110.5]])
    image = cv2.warpAffine(cv2.GaussianBlur(_plate(YELLOW), (0, 0), 2.5), shrink, (520, 240))
    assert plate_colours(image, corners, light_on_dark=False) == PlateColours(ground="yellow")


@pytest.mark.parametrize(
    "image",
    [
        _plate(YELLOW)[:, :, 1],
        np.repeat(_plate(YELLOW)[:, :, 1:2], 3, axis=2),  # a grey camera that says BGR
    ],
)
def test_a_grey_picture_says_nothing(image):
    assert plate_colours(image, CORNERS, light_on_dark=False) is None


def test_in_the_dark_nothing_is_told():
    dark = (_plate(YELLOW) * 0.12).astype(np.uint8)
    assert plate_colours(dark, CORNERS, light_on_dark=False) == PlateColours()


@pytest.mark.parametrize("corners", [np.full((4, 2), np.nan), CORNERS * 0])
def test_an_outline_without_a_size_says_nothing(corners):
    assert plate_colours(_plate(), corners, light_on_dark=False) is None


def test_noise_of_a_grey_camera_is_no_colour():
    rng = np.random.default_rng(3)
    noisy = np.clip(np.repeat(_plate(YELLOW)[:, :, 1:2], 3, axis=2) + rng.normal(0, 4, (240, 520, 3)), 0, 255).astype(np.uint8)
    assert plate_colours(noisy, CORNERS, light_on_dark=False) is None


def test_glare_is_no_white_ground():
    glare = np.clip(_plate(YELLOW, left_bgr=EU).astype(float) * 7, 0, 255).astype(np.uint8)
    assert plate_colours(glare, CORNERS, light_on_dark=False) == PlateColours()


def test_where_a_plate_is_cut_its_band_is_not_denied():
    image = _plate(left_bgr=EU, right_bgr=EU)
    left = plate_colours(np.ascontiguousarray(image[:, 210:]), CORNERS - [210, 0], light_on_dark=False)
    right = plate_colours(np.ascontiguousarray(image[:, :294]), CORNERS, light_on_dark=False)
    assert left == PlateColours(ground="white", left_band=None, right_band=True)
    assert right == PlateColours(ground="white", left_band=True, right_band=None)


def test_a_plate_outside_the_picture_has_no_colours():
    for away in (600.0, -600.0, 5e5):
        assert plate_colours(_plate(YELLOW), CORNERS + away, light_on_dark=False) is None
    assert plate_colours(np.zeros((0, 10, 3), np.uint8), CORNERS, light_on_dark=False) is None


def test_a_picture_wider_than_opencv_samples_from_is_read():
    image = np.zeros((240, 33000, 3), np.uint8)
    image[:, 32000:32520] = _plate(YELLOW)
    seen = plate_colours(image, CORNERS + np.array([32000, 0]), light_on_dark=False)
    assert seen is not None
    assert seen.ground == "yellow"


def test_a_tall_plates_band_may_end_half_way_down():
    image = np.full((240, 520, 3), 90, np.uint8)
    image[80:150, 200:300] = WHITE
    image[86:110, 220:280:9] = INK
    image[120:144, 215:285:9] = INK
    image[80:111, 200:208] = EU
    corners = np.array([[199.5, 79.5], [299.5, 79.5], [299.5, 149.5], [199.5, 149.5]])
    seen = plate_colours(image, corners, light_on_dark=False)
    assert seen == PlateColours(ground="white", left_band=True, right_band=False)
