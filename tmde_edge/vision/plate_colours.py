"""What the colours of a plate say of its standard: the ground's, and whether its ends are blue bands.

Cameras tint: by headlights a white plate of a ride was pink, another's blue band grey. So only plain colours are told, and what
lies between is left open.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import Ground, PlateColours
from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import size_px

Array = NDArray[np.float64]
ROWS, COLUMNS = 12, 128
LEAST_CHROMA = 3.0  # grey levels between the channels: a picture with less everywhere is grey
LEAST_BRIGHT = 40.0  # of a ground: in the dark all are grey
PALE, FULL = 0.30, 0.45  # saturation: white or grey, and a colour
TINTED = 0.15  # saturation of a white ground in tinted light
HUES: tuple[tuple[float, float, Ground], ...] = ((30, 65, "yellow"), (95, 170, "green"), (190, 260, "blue"))  # degrees
BAND_HEIGHT_PX = 5.0  # of plates: on lower ones blur pales a band
BAND_OF_HEIGHT, BAND_OF_WIDTH = 0.36, 0.08  # the width of a band, the lesser of the two
BAND_PART = 0.2, 0.75  # of its width that is looked at
BLUE, NOT_BLUE = 0.15, 0.06  # blue over the larger of green and red, in shares of the ground's level


def plate_colours(image: Image, corners_px: Array, light_on_dark: bool) -> PlateColours | None:
    """Colours inside the outline (4, 2); None of a grey picture."""
    if image.ndim != 3 or image.shape[2] < 3 or not np.isfinite(corners_px).all():
        return None
    width_px, height_px = size_px(corners_px)
    if min(width_px, height_px) < 2:
        return None
    across, down = (np.arange(COLUMNS) + 0.5) / COLUMNS, 0.15 + 0.7 * (np.arange(ROWS) + 0.5) / ROWS
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    places = np.stack(np.meshgrid(across, down), axis=-1).reshape(1, -1, 2)
    at = cv2.perspectiveTransform(places, cv2.getPerspectiveTransform(square, corners_px.astype(np.float32)))
    at = at.reshape(ROWS, COLUMNS, 2).astype(np.float32)
    flat = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[..., :3].astype(np.float32)
    if float(np.quantile(flat.max(axis=2) - flat.min(axis=2), 0.95)) < LEAST_CHROMA:
        return None
    middle = flat[:, (across > 0.14) & (across < 0.86)].reshape(-1, 3)
    level = middle.max(axis=1)
    bounds = np.quantile(level, (1 / 3, 2 / 3))
    colour = np.median(middle[level <= bounds[0]] if light_on_dark else middle[level >= bounds[1]], axis=0)
    bright = float(colour.max())
    if bright < LEAST_BRIGHT:
        return PlateColours()
    ground, tint = _ground(colour), 1 - float(colour.min()) / bright
    left = right = None
    if height_px >= BAND_HEIGHT_PX and not light_on_dark:
        white = bright if ground in ("yellow", "green", "blue") else np.maximum(colour, LEAST_BRIGHT)  # else the light is tinted
        balanced = flat / white
        blue = balanced[..., 0] - np.maximum(balanced[..., 1], balanced[..., 2])
        band = min(BAND_OF_HEIGHT * height_px / width_px, BAND_OF_WIDTH)
        clear = tint < TINTED or ground == "yellow"  # tinted light can hide a band, it makes none
        left, right = (
            _is_band(blue[:, (x > BAND_PART[0] * band) & (x < BAND_PART[1] * band)], clear) for x in (across, 1 - across)
        )
    return PlateColours(ground=ground, left_band=left, right_band=right)


def _is_band(blue: NDArray[np.float32], clear: bool) -> bool | None:
    """Whether an end of these bluenesses is a band; None where it cannot be told, in tinted light never that it is none."""
    over = float(np.median(blue)) if blue.size else 0.5 * (BLUE + NOT_BLUE)
    return True if over > BLUE else False if clear and over < NOT_BLUE else None


def _ground(bgr: NDArray[np.float32]) -> Ground | None:
    blue, green, red = bgr.tolist()
    most, least = max(bgr.tolist()), min(bgr.tolist())
    saturation = (most - least) / most
    if saturation < PALE:
        return "white"
    if saturation < FULL:
        return None
    if most == red:
        hue = 60 * (green - blue) / (most - least)
    elif most == green:
        hue = 120 + 60 * (blue - red) / (most - least)
    else:
        hue = 240 + 60 * (red - green) / (most - least)
    return next((name for low, high, name in HUES if low <= hue % 360 < high), None)
