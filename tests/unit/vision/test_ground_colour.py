"""Which plates are yellow, and the picture that is made of them."""

from __future__ import annotations

import numpy as np
import pytest

from tmde_edge.vision.ground_colour import plate_picture

CORNERS = np.array([[200.0, 100.0], [300.0, 100.0], [300.0, 122.0], [200.0, 122.0]])


def _plate(ground_bgr, ink_bgr=(22, 22, 24), around_bgr=(150, 150, 150)):
    image = np.full((240, 520, 3), around_bgr, np.uint8)
    image[100:122, 200:300] = ground_bgr
    for left in range(210, 290, 12):
        image[104:118, left : left + 5] = ink_bgr
    return image


@pytest.mark.parametrize("ground", [(40, 190, 240), (40, 160, 197), (18, 60, 75)])
def test_a_yellow_plate_is_brighter_than_anything_round_it(ground):
    image = _plate(ground)
    grey = plate_picture(image, CORNERS)
    assert grey.shape == image.shape[:2]
    assert grey.dtype == np.uint8
    if ground[2] > 150:
        assert grey[102, 205] > 1.5 * grey[90, 205]
    assert grey[110, 212] < 0.5 * grey[102, 205]


@pytest.mark.parametrize(
    "image",
    [
        _plate((236, 240, 240)),
        _plate((142, 183, 189)),  # white by a warm lamp
        _plate((170, 60, 20), (240, 240, 240)),  # white on blue
        _plate((10, 22, 26)),  # too dark to tell
        _plate((40, 190, 240))[:, :, 1],  # a grey camera
    ],
)
def test_other_plates_stay_as_they_are(image):
    assert plate_picture(image, CORNERS) is image


@pytest.mark.parametrize("corners", [CORNERS + 1e4, CORNERS - 1e4, np.full((4, 2), np.nan), CORNERS * 0])
def test_corners_that_show_nothing_leave_the_image_as_it_is(corners):
    image = _plate((40, 190, 240))
    assert plate_picture(image, corners) is image
