"""What the colours of a plate say of its standard: the ground's, and whether its ends are blue bands.

Cameras and lamps tint: by headlights a white plate of a ride was pink, by sodium light everything is yellow. So a ground is
called coloured only where what surrounds the plate is not, a band is denied only in clear light, and what lies between is left
open.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import Ground, PlateColours
from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import apply_homography, bounds, homography_source_from_rectified, is_convex, size_px

Array = NDArray[np.float64]
Colours = NDArray[np.float32]
ROWS, COLUMNS = 12, 128
UP, DOWN = 0.12, 0.88  # of the plate's height: the rows that are looked at
TALL = 2.2  # width over height: on lower ones a band may end half way down
ROUND = 0.3  # so far outside, in plate heights, is looked at what surrounds it
LEAST_CHROMA = 3.0  # grey levels between the channels: a picture with less everywhere is grey
LEAST_BRIGHT, CLIPPED = 40.0, 250.0  # of a ground: in the dark all are grey, in glare all are white
PALE, FULL = 0.30, 0.45  # saturation: white or grey, and a colour
TINTED = 0.15  # saturation of a white ground in tinted light
HUES: tuple[tuple[float, float, Ground], ...] = ((30, 65, "yellow"), (95, 170, "green"), (190, 260, "blue"))  # degrees
SAME_HUE = 40.0  # degrees
LEAST_ROUND = 8  # samples round a plate
LEAST_SEEN = 0.6  # of the samples inside the picture
BAND_HEIGHT_PX = 5.0  # of plates: on lower ones blur pales a band
BAND_OF_HEIGHT, BAND_OF_WIDTH = 0.36, 0.08  # the width of a band, the lesser of the two
BAND_PART = 0.2, 0.75  # of its width that is looked at
BLUE, NOT_BLUE = 0.15, 0.06  # blue over the larger of green and red, in shares of the ground's level


def plate_colours(image: Image, corners_px: Array, light_on_dark: bool) -> PlateColours | None:
    """Colours inside the outline (4, 2); None of a grey picture, or where there is no plate to look at."""
    if image.ndim != 3 or image.shape[2] < 3 or not np.isfinite(corners_px).all() or np.abs(corners_px).max() > 1e6:
        return None
    width_px, height_px = size_px(corners_px)
    if min(width_px, height_px) < 2 or not is_convex(corners_px):
        return None
    across, down = (np.arange(COLUMNS) + 0.5) / COLUMNS, UP + (DOWN - UP) * (np.arange(ROWS) + 0.5) / ROWS
    flat, seen = _sampled(image, corners_px, across, down)
    middle = (across > 0.14) & (across < 0.86)
    if seen[:, middle].mean() < LEAST_SEEN or _is_grey(flat):
        return None
    colour = _typical(flat[:, middle], light_on_dark)
    bright = float(colour.max())
    if bright < LEAST_BRIGHT or colour.min() >= CLIPPED:
        return PlateColours()
    ground = _ground(colour)
    coloured = ground not in (None, "white")
    if coloured and _alike(colour, _surround(image, corners_px)):
        ground, coloured = None, False
    left = right = None
    if height_px >= BAND_HEIGHT_PX and not light_on_dark:
        clear = ground == "yellow" or 1 - float(colour.min()) / bright < TINTED  # tinted light can hide a band, it makes none
        white = bright if coloured else np.maximum(colour, LEAST_BRIGHT)
        balanced = flat / white
        blue = balanced[..., 0] - np.maximum(balanced[..., 1], balanced[..., 2])
        band = min(BAND_OF_HEIGHT * height_px / width_px, BAND_OF_WIDTH)
        rows = down < (0.5 if width_px < TALL * height_px else 1.0)
        left, right = (
            _is_band(blue[np.ix_(rows, at)], seen[np.ix_(rows, at)], clear)
            for at in ((x > BAND_PART[0] * band) & (x < BAND_PART[1] * band) for x in (across, 1 - across))
        )
    return PlateColours(ground=ground, left_band=left, right_band=right)


def _sampled(image: Image, corners_px: Array, across: Array, down: Array) -> tuple[Colours, NDArray[np.bool_]]:
    """Colours (n, m, 3) at shares of the plate's height down (n,) and width across (m,), and which of them the picture shows."""
    places = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2) - 0.5  # in a rectified picture of one pixel
    at = apply_homography(homography_source_from_rectified(corners_px, 1, 1), places).reshape(len(down), len(across), 2)
    h, w = image.shape[:2]
    inside = (at >= -0.5).all(axis=2) & (at[..., 0] <= w - 0.5) & (at[..., 1] <= h - 0.5)
    x0, y0, x1, y1 = bounds(at.reshape(-1, 2))
    left, top = max(0, min(int(x0) - 1, w - 1)), max(0, min(int(y0) - 1, h - 1))
    part = image[top : max(top + 1, int(y1) + 3), left : max(left + 1, int(x1) + 3), :3]
    if part.size == 0 or max(part.shape[:2]) >= 32767:  # more than OpenCV samples from
        return np.zeros((*inside.shape, 3), np.float32), np.zeros_like(inside)
    xy = (at - (left, top)).astype(np.float32)
    seen = cv2.remap(part, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return seen.astype(np.float32), inside


def _is_grey(flat: Colours) -> bool:
    """Whether a picture shows no colour but noise: blocks of samples are averaged."""
    blocks = flat.reshape(ROWS // 4, 4, COLUMNS // 8, 8, 3).mean(axis=(1, 3))
    return float(np.quantile(blocks.max(axis=2) - blocks.min(axis=2), 0.95)) < LEAST_CHROMA


def _typical(colours: Colours, dark: bool) -> Colours:
    """Median colour (3,) of the darkest or brightest third of some (n, m, 3)."""
    flat = colours.reshape(-1, 3)
    level = flat.max(axis=1)
    bound = np.sort(level)[len(level) // 3 if dark else len(level) * 2 // 3]
    return np.asarray(np.median(flat[level <= bound] if dark else flat[level >= bound], axis=0), np.float32)


def _alike(bgr: Colours, around: Colours | None) -> bool:
    """Whether what lies round a plate has the plate's colour: then the light has it, or the whole vehicle."""
    if around is None:
        return False
    (hue, _), (other, saturation) = _hue_saturation(bgr), _hue_saturation(around)
    return saturation > PALE and abs((hue - other + 180) % 360 - 180) < SAME_HUE


def _surround(image: Image, corners_px: Array) -> Colours | None:
    """Colour (3,) of what lies above, below and beside a plate; None where that is too dark to have one."""
    width_px, height_px = size_px(corners_px)
    beside = ROUND * height_px / width_px
    found = []
    for across, down in (
        (np.linspace(0, 1, 24), np.array([-ROUND, 1 + ROUND])), (np.array([-beside, 1 + beside]), np.linspace(0, 1, 12)),
    ):  # fmt: skip
        colours, inside = _sampled(image, corners_px, across, down)
        found.append(colours[inside])
    around = np.concatenate(found)
    if len(around) < LEAST_ROUND:
        return None
    colour = _typical(around[:, None], dark=False)
    return colour if colour.max() >= LEAST_BRIGHT / 2 else None


def _is_band(blue: Colours, seen: NDArray[np.bool_], clear: bool) -> bool | None:
    """Whether an end of these bluenesses is a band; None where it cannot be told, in tinted light never that it is none."""
    if not seen.any():
        return None
    over = float(np.median(blue[seen]))
    return True if over > BLUE else False if clear and over < NOT_BLUE else None


def _ground(bgr: Colours) -> Ground | None:
    hue, saturation = _hue_saturation(bgr)
    if saturation < PALE:
        return "white"
    return next((name for low, high, name in HUES if saturation > FULL and low <= hue < high), None)


def _hue_saturation(bgr: Colours) -> tuple[float, float]:
    """Hue, degrees, and saturation, 0 to 1."""
    blue, green, red = bgr.tolist()
    most, least = max(blue, green, red), min(blue, green, red)
    spread = max(most - least, 1e-6)
    if most == red:
        hue = 60 * (green - blue) / spread
    elif most == green:
        hue = 120 + 60 * (blue - red) / spread
    else:
        hue = 240 + 60 * (red - green) / spread
    return hue % 360, spread / max(most, 1.0)
