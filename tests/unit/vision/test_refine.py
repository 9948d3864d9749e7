"""The sub-pixel outline on drawn plates."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import plate_still

from tmde_edge.vision.edge_model import fit_edges
from tmde_edge.vision.refine import first_step, refine_outline


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


def test_grey_and_colour_agree():
    still = plate_still("de-mittel", 150)
    grey = cv2.cvtColor(still.image, cv2.COLOR_BGR2GRAY)
    a, b = refine_outline(still.image, still.corners_px), refine_outline(grey, still.corners_px)
    assert np.array_equal(a.corners_px, b.corners_px)


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
