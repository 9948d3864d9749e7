"""A flat picture of a plate's face from a description in millimetres, with exact, antialiased geometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.stroke_font import StrokeFont, ellipse_depth

Colour = tuple[float, float, float]  # BGR, 0..255


@dataclass(frozen=True, slots=True, kw_only=True)
class GlyphSpec:
    """One character's ink box. Plate frame: origin at the plate's centre, x right, y down, mm."""

    char: str
    left_mm: float
    top_mm: float
    width_mm: float
    height_mm: float
    stroke_mm: float
    counted: bool = True
    row: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """Anything on a face that is no character: a band, a name, a seal, a hyphen, a line. Plate frame, mm.

    kind "rect", "disc" (an ellipse filling the box), "poly" (points in 0..1 of the box), "text" (filling the box) or
    "line" (from the box's left/top to left+width/top+height). stroke_mm > 0 draws rect and disc as an outline that lies
    inside the box, and sets the width of lines and letters. colour2_bgr makes a vertical gradient. `above` marks are
    drawn over the characters.
    """

    kind: str
    left_mm: float
    top_mm: float
    width_mm: float
    height_mm: float
    colour_bgr: Colour
    colour2_bgr: Colour | None = None
    text: str = ""
    stroke_mm: float = 0.0
    corner_radius_mm: float = 0.0
    opacity: float = 1.0
    above: bool = False
    points: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FaceSpec:
    """A plate's face. The border line's outer edge lies border_inset_mm inside the plate's edge."""

    width_mm: float
    height_mm: float
    glyphs: tuple[GlyphSpec, ...]
    background_bgr: Colour
    ink_bgr: Colour
    border_mm: float = 0
    border_inset_mm: float = 0
    corner_radius_mm: float = 8
    marks: tuple[Mark, ...] = ()
    border_bgr: Colour | None = None  # None: the ink's colour


class GlyphFont(Protocol):
    """What draws letters: our stroke font, or (training only) a font file."""

    def supports(self, char: str) -> bool:
        """Whether the font has this character."""
        ...

    def coverage(
        self, char: str, *, width_mm: float, height_mm: float, stroke_mm: float, x_mm: NDArray[np.float64],
        y_mm: NDArray[np.float64], px_per_mm: float,
    ) -> NDArray[np.float32]:
        """Ink coverage (len(y), len(x)) in 0..1 at pixel centres given in mm from the ink box's top left corner."""
        ...


_DEFAULT_FONT = StrokeFont()


def render_face(spec: FaceSpec, px_per_mm: float, font: GlyphFont | None = None) -> NDArray[np.uint8]:
    """BGR (round(h px_per_mm), round(w px_per_mm), 3); pixel (0, 0) is centred at (-w/2, -h/2) + 0.5/px_per_mm each.

    Edges are antialiased by their analytic coverage, so that a 50 % crossing lies on the true edge.
    Outside the rounded corners the background goes on; `face_alpha` says what belongs to the plate.
    """
    canvas = _Canvas(spec, px_per_mm)
    use = font or _DEFAULT_FONT
    for mark in spec.marks:
        if not mark.above:
            _draw_mark(canvas, mark, use)
    if spec.border_mm > 0:
        inset = spec.border_inset_mm
        w, h = spec.width_mm - 2 * inset, spec.height_mm - 2 * inset
        radius = max(spec.corner_radius_mm - inset, 0.0)
        _draw_rect(canvas, -w / 2, -h / 2, w, h, radius, spec.border_mm, spec.border_bgr or spec.ink_bgr, None, 1.0)
    for glyph in spec.glyphs:
        _draw_char(
            canvas, use, glyph.char, glyph.left_mm, glyph.top_mm, glyph.width_mm, glyph.height_mm, glyph.stroke_mm,
            spec.ink_bgr, 1.0,
        )
    for mark in spec.marks:
        if mark.above:
            _draw_mark(canvas, mark, use)
    return np.clip(np.rint(canvas.pixels), 0, 255).astype(np.uint8)


def face_alpha(spec: FaceSpec, px_per_mm: float) -> NDArray[np.float32]:
    """How much of each pixel of `render_face` belongs to the plate, 0..1: its rounded corners are cut away."""
    canvas = _Canvas(spec, px_per_mm)
    x, y = canvas.x_mm[None, :], canvas.y_mm[:, None]
    depth = _round_rect_depth(x, y, -spec.width_mm / 2, -spec.height_mm / 2, spec.width_mm, spec.height_mm,
                              spec.corner_radius_mm)
    # the outline's straight sides coincide with the picture's own: only the corners are cut
    alpha: NDArray[np.float32] = np.clip(1.0 + depth * px_per_mm, 0.0, 1.0)
    return alpha


class _Canvas:
    """Float picture and the plate-frame positions of its pixel centres."""

    def __init__(self, spec: FaceSpec, px_per_mm: float) -> None:
        cols, rows = max(1, round(spec.width_mm * px_per_mm)), max(1, round(spec.height_mm * px_per_mm))
        self.px_per_mm = px_per_mm
        self.x_mm: NDArray[np.float64] = -spec.width_mm / 2 + (np.arange(cols, dtype=np.float64) + 0.5) / px_per_mm
        self.y_mm: NDArray[np.float64] = -spec.height_mm / 2 + (np.arange(rows, dtype=np.float64) + 0.5) / px_per_mm
        self.pixels = np.empty((rows, cols, 3), np.float32)
        self.pixels[:] = spec.background_bgr

    def window(self, left_mm: float, top_mm: float, width_mm: float, height_mm: float) -> tuple[slice, slice]:
        """Rows and columns that a box with one pixel of margin touches."""
        ppm = self.px_per_mm
        x0 = int(np.floor((left_mm - float(self.x_mm[0])) * ppm)) - 1
        x1 = int(np.ceil((left_mm + width_mm - float(self.x_mm[0])) * ppm)) + 2
        y0 = int(np.floor((top_mm - float(self.y_mm[0])) * ppm)) - 1
        y1 = int(np.ceil((top_mm + height_mm - float(self.y_mm[0])) * ppm)) + 2
        rows, cols = self.pixels.shape[:2]
        return slice(min(max(y0, 0), rows), min(max(y1, 0), rows)), slice(min(max(x0, 0), cols), min(max(x1, 0), cols))

    def blend(self, where: tuple[slice, slice], coverage: NDArray[np.float32], colour: NDArray[np.float32]) -> None:
        """Lay a colour (3,) or (rows, 1, 3) over the window with the given coverage."""
        part = self.pixels[where]
        part += coverage[..., None] * (colour - part)


def _round_rect_depth(
    x: NDArray[np.float64], y: NDArray[np.float64], left: float, top: float, width: float, height: float, radius: float
) -> NDArray[np.float32]:
    """Signed depth in mm inside a rounded rectangle (exact outside of corners and inside)."""
    r = min(radius, width / 2, height / 2)
    qx = np.abs(x - (left + width / 2)) - (width / 2 - r)
    qy = np.abs(y - (top + height / 2)) - (height / 2 - r)
    outside = np.sqrt(np.maximum(qx, 0.0) ** 2 + np.maximum(qy, 0.0) ** 2)
    depth: NDArray[np.float32] = (r - outside - np.minimum(np.maximum(qx, qy), 0.0)).astype(np.float32)
    return depth


def _gradient(
    canvas: _Canvas, rows: slice, top: float, height: float, colour: Colour, colour2: Colour | None
) -> NDArray[np.float32]:
    first = np.array(colour, np.float32)
    if colour2 is None:
        return first
    t = np.clip((canvas.y_mm[rows] - top) / max(height, 1e-9), 0.0, 1.0).astype(np.float32)
    mixed: NDArray[np.float32] = first + t[:, None, None] * (np.array(colour2, np.float32) - first)
    return mixed


def _draw_rect(
    canvas: _Canvas, left: float, top: float, width: float, height: float, radius: float, stroke: float,
    colour: Colour, colour2: Colour | None, opacity: float,
) -> None:
    where = canvas.window(left, top, width, height)
    x, y = canvas.x_mm[where[1]][None, :], canvas.y_mm[where[0]][:, None]
    depth = _round_rect_depth(x, y, left, top, width, height, radius)
    if stroke > 0:
        depth = np.minimum(depth, stroke - depth)
    coverage = np.clip(0.5 + depth * canvas.px_per_mm, 0.0, 1.0) * opacity
    canvas.blend(where, coverage.astype(np.float32), _gradient(canvas, where[0], top, height, colour, colour2))


def _draw_char(
    canvas: _Canvas, font: GlyphFont, char: str, left: float, top: float, width: float, height: float, stroke: float,
    colour: Colour, opacity: float,
) -> None:
    where = canvas.window(left, top, width, height)
    if where[0].start >= where[0].stop or where[1].start >= where[1].stop:
        return
    use: GlyphFont = font if font.supports(char) else _DEFAULT_FONT
    coverage = use.coverage(
        char, width_mm=width, height_mm=height, stroke_mm=stroke, x_mm=canvas.x_mm[where[1]] - left,
        y_mm=canvas.y_mm[where[0]] - top, px_per_mm=canvas.px_per_mm,
    )
    canvas.blend(where, coverage * np.float32(opacity), np.array(colour, np.float32))


def _draw_mark(canvas: _Canvas, mark: Mark, font: GlyphFont) -> None:
    if mark.kind == "rect":
        _draw_rect(canvas, mark.left_mm, mark.top_mm, mark.width_mm, mark.height_mm, mark.corner_radius_mm,
                   mark.stroke_mm, mark.colour_bgr, mark.colour2_bgr, mark.opacity)
    elif mark.kind == "disc":
        _draw_disc(canvas, mark)
    elif mark.kind == "line":
        _draw_line(canvas, mark)
    elif mark.kind == "poly":
        _draw_poly(canvas, mark)
    elif mark.kind == "text":
        _draw_text(canvas, mark, font)
    else:
        raise ValueError(f"mark kind {mark.kind!r}: use rect, disc, line, poly or text")


def _draw_disc(canvas: _Canvas, mark: Mark) -> None:
    where = canvas.window(mark.left_mm, mark.top_mm, mark.width_mm, mark.height_mm)
    rx, ry = mark.width_mm / 2, mark.height_mm / 2
    x = (canvas.x_mm[where[1]][None, :] - mark.left_mm - rx).astype(np.float32)
    y = (canvas.y_mm[where[0]][:, None] - mark.top_mm - ry).astype(np.float32)
    depth = ellipse_depth(x, y, rx, ry)
    if mark.stroke_mm > 0:
        depth = np.minimum(depth, mark.stroke_mm - depth)
    coverage = (np.clip(0.5 + depth * canvas.px_per_mm, 0.0, 1.0) * mark.opacity).astype(np.float32)
    colour = _gradient(canvas, where[0], mark.top_mm, mark.height_mm, mark.colour_bgr, mark.colour2_bgr)
    canvas.blend(where, coverage, colour)


def _draw_line(canvas: _Canvas, mark: Mark) -> None:
    half = mark.stroke_mm / 2
    x0, x1 = sorted((mark.left_mm, mark.left_mm + mark.width_mm))
    y0, y1 = sorted((mark.top_mm, mark.top_mm + mark.height_mm))
    where = canvas.window(x0 - half, y0 - half, x1 - x0 + 2 * half, y1 - y0 + 2 * half)
    x = canvas.x_mm[where[1]][None, :] - mark.left_mm
    y = canvas.y_mm[where[0]][:, None] - mark.top_mm
    length2 = max(mark.width_mm**2 + mark.height_mm**2, 1e-12)
    t = np.clip((x * mark.width_mm + y * mark.height_mm) / length2, 0.0, 1.0)
    depth = half - np.sqrt((x - t * mark.width_mm) ** 2 + (y - t * mark.height_mm) ** 2)
    coverage = (np.clip(0.5 + depth * canvas.px_per_mm, 0.0, 1.0) * mark.opacity).astype(np.float32)
    canvas.blend(where, coverage, np.array(mark.colour_bgr, np.float32))


def _draw_poly(canvas: _Canvas, mark: Mark) -> None:
    where = canvas.window(mark.left_mm, mark.top_mm, mark.width_mm, mark.height_mm)
    shape = (where[0].stop - where[0].start, where[1].stop - where[1].start)
    if min(shape) <= 0:
        return
    size, ppm = np.array([mark.width_mm, mark.height_mm]), canvas.px_per_mm
    corner = np.array([mark.left_mm - float(canvas.x_mm[where[1].start]), mark.top_mm - float(canvas.y_mm[where[0].start])])
    at = (np.array(mark.points) * size + corner) * ppm
    cover = np.zeros((shape[0] * 4, shape[1] * 4), np.uint8)  # finer, then averaged: fillPoly draws half a pixel too much
    cv2.fillPoly(cover, [np.rint((at * 4 + 1.5) * 16).astype(np.int32)], 255, cv2.LINE_8, 4)
    cover = np.asarray(cv2.resize(cover, (shape[1], shape[0]), interpolation=cv2.INTER_AREA), np.uint8)
    colour = _gradient(canvas, where[0], mark.top_mm, mark.height_mm, mark.colour_bgr, mark.colour2_bgr)
    canvas.blend(where, cover.astype(np.float32) / np.float32(255) * np.float32(mark.opacity), colour)


def _draw_text(canvas: _Canvas, mark: Mark, font: GlyphFont) -> None:
    """Letters of equal cells that fill the mark's box; blanks stay blank."""
    if not mark.text:
        return
    cell = mark.width_mm / len(mark.text)
    stroke = mark.stroke_mm or 0.16 * mark.height_mm
    for i, char in enumerate(mark.text):
        if char == " ":
            continue
        width = stroke if char == "I" else cell * 0.8
        height, top = (stroke, mark.top_mm + (mark.height_mm - stroke) / 2) if char == "-" else (
            mark.height_mm, mark.top_mm)
        left = mark.left_mm + i * cell + (cell - width) / 2
        _draw_char(canvas, font, char, left, top, width, height, stroke, mark.colour_bgr, mark.opacity)
