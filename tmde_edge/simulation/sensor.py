"""What lens and sensor add to a clean picture: defocus, exposure, noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.compose import Image


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """Blur of the lens (one sigma), noise (one sigma, grey levels) and exposure gain."""

    blur_px: float = 0.55
    noise: float = 2.0
    gain: float = 1.0


@lru_cache(maxsize=8)
def _noise_bank(sigma: float, height: int, width: int) -> NDArray[np.int16]:
    """Coloured noise a bit larger than a frame; each frame takes another window of it."""
    rng = np.random.default_rng(4021)
    luma = rng.normal(0, sigma, (height + 97, width + 131, 1))
    chroma = rng.normal(0, 0.5 * sigma, (height + 97, width + 131, 3))
    return np.rint(luma + chroma).astype(np.int16)


def expose(image: Image, sensor: Sensor, rng: np.random.Generator) -> Image:
    """The picture as the sensor gives it; draws from rng once."""
    out = image
    if sensor.blur_px > 0.05:
        out = np.asarray(cv2.GaussianBlur(out, (0, 0), sensor.blur_px, borderType=cv2.BORDER_REPLICATE), np.uint8)
    if sensor.gain != 1.0:
        out = np.asarray(cv2.convertScaleAbs(out, alpha=sensor.gain), np.uint8)
    dy, dx, flip = int(rng.integers(97)), int(rng.integers(131)), int(rng.integers(2))
    if sensor.noise > 0:
        h, w = out.shape[:2]
        bank = _noise_bank(sensor.noise, h, w)[dy : dy + h, dx : dx + w]
        out = np.asarray((cv2.subtract if flip else cv2.add)(out, bank, dtype=cv2.CV_8U), np.uint8)
    return out
