"""Coloured grounds: the grey picture in which a yellow plate is as bright as a white one.

Seen in luminance a yellow plate is as dark as the grey plastic or the silver paint round it, and its edges vanish; every
British and Dutch rear plate is yellow. Luminance with three quarters of its excess over blue added is brightest on yellow and
dark on ink. More of it would show compressed pictures' coarse colours: characters are measured in luminance all the same.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import bounds

Array = NDArray[np.float64]
YELLOW_BLUE = 0.6  # of the lesser of red and green: with less blue than that a ground is yellow
LEAST_YELLOW = 25.0  # grey levels of difference: less is noise
FROM_BGR = np.array([[-0.38, 0.70, 0.36]])  # (Y + 0.75 (Y - B)) / 1.465: yellow 204, white 163, grey 102, red 63, ink 14
# How far round the corners a reader looks, in widths and heights: GlyphNet's canvas 0.14 and 0.3, the outline's search a band
# more, and a few pixels.
REACH_X, REACH_Y, REACH_PX = 0.45, 0.7, 12
SAMPLES = 24, 64  # rows and columns of the middle that are looked at


def plate_picture(image: Image, corners_px: Array) -> Image:
    """The image itself, or for a plate of yellow ground a grey one of the same size, made only round the corners (4, 2).

    For what finds the plate's outline and tells its characters.
    """
    if image.ndim != 3 or image.shape[2] < 3 or not np.isfinite(corners_px).all() or not _is_yellow(image, corners_px):
        return image
    h, w = image.shape[:2]
    x0, y0, x1, y1 = bounds(corners_px)
    dx, dy = REACH_X * (x1 - x0) + REACH_PX, REACH_Y * (y1 - y0) + REACH_PX
    left, top, right, bottom = max(0, int(x0 - dx)), max(0, int(y0 - dy)), min(w, int(x1 + dx)), min(h, int(y1 + dy))
    grey = np.zeros((h, w), np.uint8)
    grey[top:bottom, left:right] = cv2.transform(image[top:bottom, left:right, :3], FROM_BGR)
    return grey


def _is_yellow(image: Image, corners_px: Array) -> bool:
    """By the median colour of the brightest third of the plate's middle: lettering may fill half of it."""
    x0, y0, x1, y1 = bounds(corners_px)
    dx, dy = 0.12 * (x1 - x0), 0.2 * (y1 - y0)
    part = image[max(0, int(y0 + dy)) : max(0, int(y1 - dy) + 1), max(0, int(x0 + dx)) : max(0, int(x1 - dx) + 1), :3]
    part = part[:: 1 + part.shape[0] // SAMPLES[0], :: 1 + part.shape[1] // SAMPLES[1]].reshape(-1, 3)
    if not len(part):
        return False
    red = part[:, 2]
    ground = np.median(part[red >= np.sort(red)[len(red) * 2 // 3]], axis=0)
    blue, lesser = float(ground[0]), float(min(ground[1], ground[2]))
    return lesser - blue > LEAST_YELLOW and blue < YELLOW_BLUE * lesser
