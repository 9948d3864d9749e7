"""A bump that throws the picture farther than a block's window still is measured."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tmde_edge.pose.tilt import TiltMeter


@pytest.mark.parametrize("down_px", [-29.0, -13.0, 3.0, 18.0, 30.0])
def test_jumps_of_the_picture_are_measured(down_px: float) -> None:
    rng = np.random.default_rng(4)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (720, 1280)).astype(np.float32), (0, 0), 5.0)
    image = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    later = cv2.warpAffine(image, np.array([[1.0, 0, 0.4], [0, 1, down_px]]), (1280, 720), borderMode=cv2.BORDER_REFLECT)
    meter = TiltMeter()
    assert meter.see(image, 0, None) is None
    change = meter.see(later, 33_000_000, None)
    assert change is not None
    assert change.down_px == pytest.approx(down_px, abs=max(3 * change.sigma_px, 0.4))
