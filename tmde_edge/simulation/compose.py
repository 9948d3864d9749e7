"""Laying pictures and polygons into an image with supersampling, so that edges land where the pinhole puts them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Array = NDArray[np.float64]
Box = tuple[int, int, int, int]  # x0, y0, x1, y1, half open

_SHIFT = 4  # fractional bits of polygon corners


@dataclass(frozen=True, slots=True)
class Texture:
    """A BGRA picture with its own chain of halved copies, each inside a transparent rim of one pixel."""

    levels: tuple[Image, ...] = field(repr=False)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels of the finest level, without the rim."""
        return self.levels[0].shape[1] - 2, self.levels[0].shape[0] - 2


def texture(bgr: Image, alpha: NDArray[np.float32] | None = None) -> Texture:
    """A texture of a BGR picture and its coverage 0..1 (None: opaque), premultiplied while it is halved."""
    cover = np.full(bgr.shape[:2], 255, np.uint8) if alpha is None else np.rint(alpha * 255).astype(np.uint8)
    levels = [np.dstack([bgr, cover])]
    while min(levels[-1].shape[:2]) > 3:
        last = levels[-1]
        h, w = last.shape[:2]
        # an odd last row or column gets a transparent neighbour, so that halving keeps the outline where it is
        even = np.asarray(cv2.copyMakeBorder(last, 0, h % 2, 0, w % 2, cv2.BORDER_REPLICATE), np.uint8)
        even[h:, :, 3] = 0
        even[:, w:, 3] = 0
        levels.append(_halve(even))
    return Texture(tuple(_rimmed(level) for level in levels))


def _rimmed(bgra: Image) -> Image:
    rimmed = np.asarray(cv2.copyMakeBorder(bgra, 1, 1, 1, 1, cv2.BORDER_REPLICATE), np.uint8)
    rimmed[[0, -1], :, 3] = 0
    rimmed[:, [0, -1], 3] = 0
    return rimmed


def _halve(bgra: Image) -> Image:
    size = (bgra.shape[1] // 2, bgra.shape[0] // 2)
    if bgra[..., 3].min() == 255:
        return np.asarray(cv2.resize(bgra, size, interpolation=cv2.INTER_AREA), np.uint8)
    full = bgra.astype(np.float32)
    full[..., :3] *= full[..., 3:] / 255.0
    small = np.asarray(cv2.resize(full, size, interpolation=cv2.INTER_AREA), np.float64)
    small[..., :3] *= 255.0 / np.maximum(small[..., 3:], 1e-3)
    return np.clip(np.rint(small), 0, 255).astype(np.uint8)


class Region:
    """A window of an image, enlarged `factor` times, painted on, then averaged back: an exact box filter."""

    def __init__(self, image: Image, box: Box, factor: int) -> None:
        self.image, self.box, self.factor = image, box, factor
        x0, y0, x1, y1 = box
        part = image[y0:y1, x0:x1]
        self.pixels: Image = (
            np.ascontiguousarray(part.repeat(factor, axis=0).repeat(factor, axis=1)) if factor > 1 else part.copy()
        )

    def fine(self, points_px: Array) -> Array:
        """Image pixels (n, 2) -> pixels of the enlarged window."""
        out: Array = (np.asarray(points_px, np.float64) - np.array(self.box[:2]) + 0.5) * self.factor - 0.5
        return out

    def polygon(self, points_px: Array, colour_bgr: Sequence[float], opacity: float = 1.0) -> None:
        """Fill a polygon given in image pixels."""
        points = self.fine(points_px)
        if not np.isfinite(points).all():
            return
        fixed = np.rint(np.clip(points, -20000, 20000) * (1 << _SHIFT)).astype(np.int32)
        if opacity >= 1.0:
            cv2.fillPoly(self.pixels, [fixed], [float(c) for c in colour_bgr], cv2.LINE_8, _SHIFT)
            return
        mask = np.zeros(self.pixels.shape[:2], np.uint8)
        cv2.fillPoly(mask, [fixed], [255.0], cv2.LINE_8, _SHIFT)
        x, y, w, h = cv2.boundingRect(mask)
        if w and h:
            flat = np.full((h, w, 3), np.clip(colour_bgr, 0, 255), np.uint8)
            self._blend(flat, mask[y : y + h, x : x + w], opacity, slice(y, y + h), slice(x, x + w))

    def quad(self, picture: Texture, corners_px: Array, *, gain: float = 1.0, opacity: float = 1.0) -> None:
        """Lay a texture on the quad (4, 2) TL TR BR BL, whose corners are the texture's outer edges."""
        corners = self.fine(corners_px)
        if not np.isfinite(corners).all():
            return
        rows, cols = self.pixels.shape[:2]
        x0, y0 = np.floor(corners.min(axis=0)).astype(int)
        x1, y1 = np.ceil(corners.max(axis=0)).astype(int) + 1
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, cols), min(y1, rows)
        if x0 >= x1 or y0 >= y1:
            return
        sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
        wide, high = picture.size
        finest = max(max(sides[0], sides[2]) / wide, max(sides[1], sides[3]) / high)
        level = int(np.clip(np.ceil(-np.log2(max(finest, 1e-6))), 0, len(picture.levels) - 1))
        source = picture.levels[level]
        # the outer edge of the finest level, in this level's pixels with its rim
        left, right, bottom = 0.5, wide / 2**level + 0.5, high / 2**level + 0.5
        edge = np.array([[left, left], [right, left], [right, bottom], [left, bottom]], np.float32)
        warp = cv2.getPerspectiveTransform(edge, (corners - [x0, y0]).astype(np.float32))
        # the coverage falls through 50 % exactly on the texture's outer edge, halfway to its rim
        both = cv2.warpPerspective(source, warp, (int(x1 - x0), int(y1 - y0)), flags=cv2.INTER_LINEAR,
                                   borderMode=cv2.BORDER_REPLICATE)
        colour, cover8 = cv2.cvtColor(both, cv2.COLOR_BGRA2BGR), cv2.extractChannel(both, 3)
        if gain != 1.0:
            colour = cv2.convertScaleAbs(colour, alpha=gain)
        where = (slice(y0, y1), slice(x0, x1))
        self._blend(np.asarray(colour, np.uint8), np.asarray(cover8, np.uint8), opacity, *where)

    def _blend(self, colour: Image, cover: Image, opacity: float, rows: slice, cols: slice) -> None:
        part = self.pixels[rows, cols]
        if opacity >= 1.0:
            cv2.copyTo(colour, cv2.inRange(cover, 255, 255), part)
            soft = np.flatnonzero(cv2.inRange(cover, 1, 254))
        else:
            soft = np.flatnonzero(cover)
        if soft.size * 8 > cover.size:
            weight = cover.astype(np.float32) * np.float32(opacity / 255)
            part[:] = cv2.blendLinear(colour, part, weight, np.float32(1.0) - weight)
            return
        r, c = np.divmod(soft, cover.shape[1])
        base = part[r, c].astype(np.float32)
        some = cover[r, c].astype(np.float32)[:, None] * np.float32(opacity / 255)
        base += some * (colour[r, c].astype(np.float32) - base)
        part[r, c] = (base + 0.5).astype(np.uint8)

    def done(self) -> None:
        """Average the window back into the image."""
        x0, y0, x1, y1 = self.box
        if self.factor == 1:
            self.image[y0:y1, x0:x1] = self.pixels
        else:
            self.image[y0:y1, x0:x1] = cv2.resize(self.pixels, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)


def region_round(image: Image, points_px: Array, factor: int, margin_px: float = 2.0) -> Region | None:
    """The window of the image round some points; None where it lies outside."""
    good = points_px[np.isfinite(points_px).all(axis=1)]
    if len(good) == 0:
        return None
    x0, y0 = np.floor(good.min(axis=0) - margin_px)
    x1, y1 = np.ceil(good.max(axis=0) + margin_px) + 1
    box = (max(int(max(x0, -1e6)), 0), max(int(max(y0, -1e6)), 0), min(int(min(x1, 1e6)), image.shape[1]),
           min(int(min(y1, 1e6)), image.shape[0]))
    if box[0] >= box[2] or box[1] >= box[3]:
        return None
    return Region(image, box, factor)
