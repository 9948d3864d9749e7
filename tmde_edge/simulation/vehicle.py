"""Vehicles seen from behind: a painted rear of one of a few body shapes, its box, lamps and licence recess."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.compose import Image, Texture, texture

Colour = tuple[float, float, float]  # BGR, 0..255
_PX_PER_M = 400
_MARGIN_M = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """A vehicle's rear in metres (x right of its middle, y up from the road) and the box behind it."""

    kind: str = "hatch"
    colour_bgr: Colour = (120.0, 110.0, 100.0)
    plate_up_m: float = 0.85  # plate centre above the road
    plate_right_m: float = 0.0
    length_m: float = 4.3
    lettering: str = ""  # on the doors of a van


@dataclass(frozen=True, slots=True)
class _Shape:
    """Half outline from the bottom to the roof (x, y), and where things are."""

    half: tuple[tuple[float, float], ...]
    window: tuple[tuple[float, float], ...]
    lamps: tuple[tuple[float, float], ...]
    sill_m: float  # lower edge of the painted body
    bumper: tuple[float, float]
    tyre_half_m: float


_SHAPES = {
    "hatch": _Shape(
        ((0.76, 0.28), (0.86, 0.36), (0.89, 0.60), (0.88, 0.88), (0.82, 1.00), (0.70, 1.32), (0.60, 1.46), (0.35, 1.50)),
        ((0.66, 1.02), (0.56, 1.38), (0.30, 1.42)), ((0.60, 0.84), (0.84, 0.82), (0.80, 1.04), (0.66, 1.02)),
        0.28, (0.36, 0.62), 0.84),
    "sedan": _Shape(
        ((0.78, 0.27), (0.88, 0.36), (0.91, 0.62), (0.90, 0.86), (0.84, 1.00), (0.68, 1.06), (0.58, 1.32), (0.48, 1.42),
         (0.25, 1.45)),
        ((0.62, 1.07), (0.50, 1.34), (0.26, 1.38)), ((0.52, 0.80), (0.87, 0.76), (0.84, 0.95), (0.56, 0.94)),
        0.27, (0.34, 0.60), 0.86),
    "suv": _Shape(
        ((0.80, 0.38), (0.92, 0.48), (0.94, 0.75), (0.93, 1.05), (0.88, 1.18), (0.78, 1.52), (0.68, 1.66), (0.40, 1.70)),
        ((0.74, 1.20), (0.64, 1.56), (0.34, 1.60)), ((0.74, 0.92), (0.92, 0.90), (0.88, 1.26), (0.78, 1.22)),
        0.38, (0.46, 0.76), 0.86),
    "van": _Shape(
        ((0.86, 0.36), (0.94, 0.42), (0.96, 0.80), (0.95, 1.60), (0.92, 1.90), (0.84, 1.98), (0.40, 2.02)),
        ((0.80, 1.15), (0.78, 1.75), (0.40, 1.78)), ((0.84, 0.70), (0.94, 0.70), (0.93, 1.22), (0.85, 1.22)),
        0.36, (0.40, 0.60), 0.86),
    "truck": _Shape(
        ((1.10, 0.48), (1.20, 0.55), (1.24, 1.00), (1.25, 2.50), (1.25, 3.60), (1.22, 3.68), (0.60, 3.70)),
        (), ((0.86, 0.62), (1.18, 0.62), (1.18, 0.82), (0.86, 0.82)), 0.48, (0.52, 0.92), 1.15),
}


def body_size(body: Body) -> tuple[float, float]:
    """Half width and height in metres of the rear."""
    shape = _SHAPES[body.kind]
    return max(x for x, _ in shape.half), max(y for _, y in shape.half)


def outline_m(body: Body) -> NDArray[np.float64]:
    """The rear's outline (n, 2): x right of the middle, y up from the road, in metres."""
    half = _SHAPES[body.kind].half
    return np.array([*half, *[(-x, y) for x, y in reversed(half)]], np.float64)


@dataclass(frozen=True, slots=True)
class RearPicture:
    """The rear as a texture with its rectangle in metres (left, top, right, bottom; x right, y up from the road)."""

    picture: Texture
    left_m: float
    top_m: float
    right_m: float
    bottom_m: float


@lru_cache(maxsize=64)
def rear_picture(body: Body, plate_size_m: tuple[float, float], lamps: str = "off", plate: bool = True) -> RearPicture:
    """Paint a rear; lamps "off", "on" (night) or "brake"."""
    shape = _SHAPES[body.kind]
    half_w, top = body_size(body)
    left, right, up, down = -half_w - _MARGIN_M, half_w + _MARGIN_M, top + _MARGIN_M, -0.0
    paint = _Painter(left, up, right, down)
    body_bgr = np.array(body.colour_bgr)
    outline = outline_m(body)
    dark = (26.0, 25.0, 25.0)
    _tyres(paint, shape)
    paint.shape(outline, body_bgr)
    paint.shade(outline)
    low = [(x, y) for x, y in outline if y <= shape.bumper[0]]
    if len(low) >= 3 and body.kind != "truck":
        paint.shape(np.array([*low, (low[-1][0], shape.bumper[0] + 0.06), (low[0][0], shape.bumper[0] + 0.06)]), dark)
    if body.kind == "truck":
        _truck(paint, body, body_bgr)
    else:
        _window(paint, shape, body_bgr)
        _seams(paint, shape, body, body_bgr)
    if plate:
        _recess(paint, body, plate_size_m, body_bgr)
    for side in (-1, 1):
        _lamp(paint, np.array([(side * x, y) for x, y in shape.lamps]), lamps)
    if lamps == "brake" and shape.window:
        y = shape.window[-1][1] + 0.03
        paint.rect(-0.18, y - 0.012, 0.18, y + 0.012, (70, 60, 255))
    pixels, alpha = paint.finished()
    return RearPicture(texture(pixels, alpha), left, up, right, down)


class _Painter:
    """A canvas in metres, drawn at twice its final density."""

    def __init__(self, left_m: float, top_m: float, right_m: float, bottom_m: float) -> None:
        self.left, self.top = left_m, top_m
        self.scale = 2 * _PX_PER_M / (2 if right_m - left_m > 2.2 else 1)
        cols = 2 * round((right_m - left_m) * self.scale / 2)
        rows = 2 * round((top_m - bottom_m) * self.scale / 2)
        self.pixels: Image = np.zeros((rows, cols, 3), np.uint8)
        self.alpha: Image = np.zeros((rows, cols), np.uint8)

    def _fixed(self, points_m: NDArray[np.float64]) -> NDArray[np.int32]:
        p = np.asarray(points_m, np.float64)
        xy = np.stack([(p[:, 0] - self.left) * self.scale - 0.5, (self.top - p[:, 1]) * self.scale - 0.5], axis=1)
        return np.rint(xy * 16).astype(np.int32)

    def shape(self, points_m: NDArray[np.float64], colour: NDArray[np.float64] | Colour, opaque: bool = True) -> None:
        fixed = self._fixed(points_m)
        cv2.fillPoly(self.pixels, [fixed], [float(np.clip(c, 0, 255)) for c in colour], cv2.LINE_8, 4)
        if opaque:
            cv2.fillPoly(self.alpha, [fixed], [255.0], cv2.LINE_8, 4)

    def rect(self, x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
        self.shape(np.array([(x0, y1), (x1, y1), (x1, y0), (x0, y0)]), colour)

    def line(self, points_m: list[tuple[float, float]], width_m: float, colour: NDArray[np.float64] | Colour) -> None:
        fixed = self._fixed(np.array(points_m))
        thick = max(1, round(width_m * self.scale))
        cv2.polylines(self.pixels, [fixed], False, [float(np.clip(c, 0, 255)) for c in colour], thick, cv2.LINE_AA, 4)

    def mask(self, points_m: NDArray[np.float64]) -> Image:
        out = np.zeros(self.alpha.shape, np.uint8)
        cv2.fillPoly(out, [self._fixed(points_m)], [255.0], cv2.LINE_8, 4)
        return out

    def shade(self, outline_m: NDArray[np.float64]) -> None:
        """Light from above: brighter shoulders, a darker tuck-under, round sides."""
        rows, cols = self.alpha.shape
        y = self.top - (np.arange(rows) + 0.5) / self.scale
        x = self.left + (np.arange(cols) + 0.5) / self.scale
        up = np.interp(y, [0.2, 0.45, 0.62, 0.66, 0.9, 1.05, 1.6], [0.45, 0.72, 0.98, 0.84, 1.12, 1.0, 1.1])
        half = float(np.abs(outline_m[:, 0]).max())
        side = 1.0 - 0.35 * np.clip((np.abs(x) - half + 0.22) / 0.22, 0, 1) ** 2
        gain = (up[:, None] * side[None, :]).astype(np.float32)
        inside = self.mask(outline_m) > 0
        lit = self.pixels.astype(np.float32) * gain[..., None]
        self.pixels[inside] = np.clip(lit[inside], 0, 255).astype(np.uint8)

    def blend(self, mask: Image, colour: NDArray[np.float32], opacity: float) -> None:
        inside = mask > 0
        base = self.pixels[inside].astype(np.float32)
        target = np.broadcast_to(colour, self.pixels.shape)[inside]
        self.pixels[inside] = np.clip(base + opacity * (target - base), 0, 255).astype(np.uint8)

    def finished(self) -> tuple[Image, NDArray[np.float32]]:
        size = (self.pixels.shape[1] // 2, self.pixels.shape[0] // 2)
        alpha = np.asarray(cv2.resize(self.alpha.astype(np.float32) / 255, size, interpolation=cv2.INTER_AREA), np.float32)
        weight = (self.alpha > 0).astype(np.float32)
        shrunk = cv2.resize(self.pixels.astype(np.float32) * weight[..., None], size, interpolation=cv2.INTER_AREA)
        colour = np.asarray(shrunk, np.float32) / np.maximum(alpha, 1e-3)[..., None]
        return np.clip(np.rint(colour), 0, 255).astype(np.uint8), alpha


def _tyres(paint: _Painter, shape: _Shape) -> None:
    for side in (-1, 1):
        x0, x1 = sorted((side * shape.tyre_half_m, side * (shape.tyre_half_m - 0.21)))
        paint.rect(x0, 0.01, x1, shape.sill_m + 0.1, (20, 19, 19))
        paint.line([(x0 + 0.05, 0.03), (x0 + 0.05, shape.sill_m)], 0.008, (38, 37, 36))
    paint.rect(-shape.tyre_half_m + 0.2, 0.20, shape.tyre_half_m - 0.2, shape.sill_m + 0.1, (16, 15, 15))
    paint.rect(0.42, 0.24, 0.50, 0.30, (90, 88, 86))  # the exhaust


def _window(paint: _Painter, shape: _Shape, body_bgr: NDArray[np.float64]) -> None:
    points = np.array([*shape.window, *[(-x, y) for x, y in reversed(shape.window)]])
    middle = points.mean(axis=0)
    paint.shape(middle + (points - middle) * [1.035, 1.06], body_bgr * 0.28)
    paint.shape(points, (46, 42, 38))
    rows = paint.alpha.shape[0]
    y = paint.top - (np.arange(rows) + 0.5) / paint.scale
    low, high = float(points[:, 1].min()), float(points[:, 1].max())
    t = np.clip((y - low) / (high - low), 0, 1)[:, None, None]
    sky = (np.array([150.0, 140.0, 130.0]) * t + np.array([30.0, 28.0, 26.0]) * (1 - t)).astype(np.float32)
    paint.blend(paint.mask(points), sky, 0.45)
    for x in (-0.33, 0.33):  # head rests
        if abs(x) < shape.window[0][0] - 0.15:
            cv2.ellipse(paint.pixels, _pixel(paint, x, low + 0.10), (round(0.11 * paint.scale), round(0.09 * paint.scale)),
                        0, 0, 360, (30, 28, 27), -1, cv2.LINE_AA)
    paint.line([(0.0, low + 0.01), (0.36, low + 0.05)], 0.018, (14, 14, 14))


def _pixel(paint: _Painter, x_m: float, y_m: float) -> tuple[int, int]:
    return round((x_m - paint.left) * paint.scale), round((paint.top - y_m) * paint.scale)


def _seams(paint: _Painter, shape: _Shape, body: Body, body_bgr: NDArray[np.float64]) -> None:
    seam = body_bgr * 0.4
    low, high = shape.bumper[1], shape.window[0][1]
    half = shape.lamps[0][0] - 0.02
    paint.line([(-half, high), (-half, low), (half, low), (half, high)], 0.009, seam)
    paint.line([(-half - 0.2, low), (half + 0.2, low)], 0.012, seam)
    paint.line([(-half, low + 0.012), (half, low + 0.012)], 0.006, body_bgr * 1.25)
    for side in (-1, 1):  # reflectors in the bumper
        x0, x1 = sorted((side * 0.60, side * 0.74))
        paint.rect(x0, shape.bumper[0] + 0.09, x1, shape.bumper[0] + 0.12, (40, 35, 150))
    badge = body.plate_up_m + 0.17 if body.plate_up_m > low else high - 0.08
    cv2.circle(paint.pixels, _pixel(paint, 0.0, badge), round(0.035 * paint.scale), (205, 205, 205), -1, cv2.LINE_AA)
    cv2.circle(paint.pixels, _pixel(paint, 0.0, badge), round(0.022 * paint.scale), (90, 90, 92), -1, cv2.LINE_AA)
    if body.kind == "van":
        paint.line([(0.0, shape.sill_m + 0.05), (0.0, 1.95)], 0.016, seam)
    if body.lettering:
        x, y = _pixel(paint, -0.72, 1.0)
        cv2.putText(paint.pixels, body.lettering, (x, y), cv2.FONT_HERSHEY_DUPLEX, paint.scale * 0.0042, (60, 50, 150),
                    max(1, round(0.014 * paint.scale)), cv2.LINE_AA)


def _truck(paint: _Painter, body: Body, body_bgr: NDArray[np.float64]) -> None:
    paint.rect(-1.2, 1.05, 1.2, 3.6, (210, 212, 214))
    for x in (-1.0, -0.5, 0.02, 0.52, 1.02):
        paint.line([(x, 1.1), (x, 3.55)], 0.012, (170, 172, 174))
    paint.line([(0.0, 1.05), (0.0, 3.6)], 0.03, (90, 92, 94))
    for x in (-0.35, 0.35):
        paint.line([(x, 1.1), (x, 3.5)], 0.035, (120, 122, 124))
    paint.rect(-1.2, 0.95, 1.2, 1.05, tuple(float(c) for c in body_bgr))  # type: ignore[arg-type]
    paint.rect(-1.15, 0.5, 1.15, 0.62, (60, 62, 64))
    if body.lettering:
        cv2.putText(paint.pixels, body.lettering, _pixel(paint, -0.95, 2.6), cv2.FONT_HERSHEY_DUPLEX,
                    paint.scale * 0.009, (120, 60, 20), max(1, round(0.05 * paint.scale)), cv2.LINE_AA)


def _recess(paint: _Painter, body: Body, plate_size_m: tuple[float, float], body_bgr: NDArray[np.float64]) -> None:
    half_w, half_h = plate_size_m[0] / 2, plate_size_m[1] / 2
    x, y = body.plate_right_m, body.plate_up_m
    tone = body_bgr * 0.62 if body.kind != "truck" else np.array([45.0, 46.0, 48.0])
    outer = [(x - half_w - 0.05, y + half_h + 0.055), (x + half_w + 0.05, y + half_h + 0.055),
             (x + half_w + 0.035, y - half_h - 0.03), (x - half_w - 0.035, y - half_h - 0.03)]
    paint.shape(np.array(outer), tone)
    paint.rect(x - half_w - 0.03, y + half_h + 0.03, x + half_w + 0.03, y + half_h + 0.055, (30, 30, 30))  # lamp bar
    paint.line([outer[3], outer[2]], 0.008, body_bgr * 1.2)


def _lamp(paint: _Painter, points: NDArray[np.float64], state: str) -> None:
    colours = {"off": (38, 32, 120), "on": (70, 60, 225), "brake": (120, 110, 255)}
    middle = points.mean(axis=0)
    paint.shape(middle + (points - middle) * 1.06, (30, 26, 40))
    paint.shape(points, colours[state])
    inner = middle + (points - middle) * [0.8, 0.35]
    paint.shape(inner, {"off": (150, 145, 170), "on": (140, 135, 245), "brake": (235, 230, 255)}[state])
    paint.line([(float(x), float(y)) for x, y in points[:2]], 0.01, (60, 50, 150))
