"""From GlyphNet's outputs to plate-ness, corners and character boxes in source pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.segment.glyph_crop import apply_affine, invert_affine

STRIDE_X_PX, STRIDE_Y_PX = 2, 4  # canvas pixels per cell of the glyph map
BOX_SCALE_PX = 8.0  # of the box channels
_HEAT_MIN = 0.40
_OVERLAP_MAX = 0.45
_LAPLACE_SD = float(np.sqrt(2.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Glyph:
    """One character: middle points of its ink box's edges, (2,) float64 source px. main: of the row's full height."""

    left_px: NDArray[np.float64]
    right_px: NDArray[np.float64]
    top_px: NDArray[np.float64]
    bottom_px: NDArray[np.float64]
    score: float
    main: bool
    row: int
    sigma_tb_px: float = 0.5  # one standard deviation of top and bottom, source px
    sigma_lr_px: float = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class GlyphReading:
    """What GlyphNet makes of one candidate. corners_px (4, 2) TL, TR, BR, BL source px; sigma_px (4,) one per corner.

    glyphs: rows from above, each from the left. platehood: 0..1.
    """

    platehood: float
    corners_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    glyphs: tuple[Glyph, ...]
    light_on_dark: bool

    @property
    def count(self) -> int:
        """How many characters the registration has."""
        return len(self.glyphs)


def decode(
    glyph_map: NDArray[np.float32], corners: NDArray[np.float32], tail: NDArray[np.float32],
    canvas_from_source: NDArray[np.float64],
) -> GlyphReading:
    """One crop's outputs: map (6, rows, columns), corners (4, 2) canvas px, tail (6,), and the crop's map (2, 3).

    Raises ValueError where an output is not finite.
    """
    if not (np.isfinite(glyph_map).all() and np.isfinite(corners).all() and np.isfinite(tail).all()):
        raise ValueError("the network's output is not finite")
    canvas_corners = corners.astype(np.float64)
    boxes = _grow_rows(_suppress(_peaks(glyph_map)), canvas_corners)
    source_from_canvas = invert_affine(canvas_from_source)
    pixel_scale = float(np.sqrt(abs(np.linalg.det(source_from_canvas[:, :2]))))
    sigma = _LAPLACE_SD * np.exp(np.clip(tail[:4].astype(np.float64), -3.0, 4.0)) * pixel_scale
    right, down = _directions(canvas_corners)
    glyphs = tuple(_to_source(box, row, right, down, source_from_canvas) for row, box in boxes)
    return GlyphReading(
        platehood=_sigmoid(float(tail[4])), corners_px=apply_affine(source_from_canvas, canvas_corners), sigma_px=sigma,
        glyphs=glyphs, light_on_dark=bool(tail[5] > 0),
    )


def not_a_plate(corners_px: NDArray[np.float64]) -> GlyphReading:
    """The reading of corners that span no area."""
    corners = np.asarray(corners_px, np.float64)
    return GlyphReading(platehood=0.0, corners_px=corners, sigma_px=np.full(4, 1e3), glyphs=(), light_on_dark=False)


@dataclass(slots=True)
class _Box:
    """A character on the canvas, px."""

    left: float
    right: float
    top: float
    bottom: float
    score: float
    small: float

    @property
    def x(self) -> float:
        return (self.left + self.right) / 2

    @property
    def y(self) -> float:
        return (self.top + self.bottom) / 2

    @property
    def height(self) -> float:
        return self.bottom - self.top


def _sigmoid(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-np.clip(x, -60.0, 60.0))))


def _peaks(glyph_map: NDArray[np.float32]) -> list[_Box]:
    """Local maxima of the heat; each box is the heat-weighted mean of its neighbourhood's opinions."""
    heat = 1.0 / (1.0 + np.exp(-np.clip(glyph_map[0].astype(np.float64), -60.0, 60.0)))
    rows, cols = heat.shape
    padded = np.pad(heat, 2)
    shifts = [(dy, dx) for dy in (-1, 0, 1) for dx in (-2, -1, 0, 1, 2)]
    around = np.max([padded[2 + dy : 2 + dy + rows, 2 + dx : 2 + dx + cols] for dy, dx in shifts], axis=0)
    found = []
    for r, c in np.argwhere((heat >= around) & (heat >= _HEAT_MIN)):
        r0, r1, c0, c1 = max(r - 1, 0), min(r + 2, rows), max(c - 1, 0), min(c + 2, cols)
        weight = heat[r0:r1, c0:c1]
        weight = np.where(weight > 0.3 * heat[r, c], weight, 0.0)
        weight = weight / weight.sum()
        x = (np.arange(c0, c1) + 0.5) * STRIDE_X_PX - 0.5
        y = ((np.arange(r0, r1) + 0.5) * STRIDE_Y_PX - 0.5)[:, None]
        small, left, right, top, bottom = glyph_map[1:, r0:r1, c0:c1].astype(np.float64)
        box = _Box(
            left=float((weight * (x - BOX_SCALE_PX * left)).sum()), right=float((weight * (x + BOX_SCALE_PX * right)).sum()),
            top=float((weight * (y - BOX_SCALE_PX * top)).sum()), bottom=float((weight * (y + BOX_SCALE_PX * bottom)).sum()),
            score=float(heat[r, c]), small=_sigmoid(float((weight * small).sum())),
        )
        if box.right - box.left > 0.8 and box.height > 2.0:
            found.append(box)
    return found


def _suppress(boxes: list[_Box]) -> list[_Box]:
    """Of boxes that share much of the smaller one's area, keep the strongest."""
    kept: list[_Box] = []
    for box in sorted(boxes, key=lambda b: -b.score):
        for other in kept:
            wide = min(box.right, other.right) - max(box.left, other.left)
            high = min(box.bottom, other.bottom) - max(box.top, other.top)
            area = min((box.right - box.left) * box.height, (other.right - other.left) * other.height)
            if wide > 0 and high > 0 and wide * high > _OVERLAP_MAX * area:
                break
        else:
            kept.append(box)
    return kept


def _directions(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The plate's right and down on the canvas: (1, slope) and (slope, 1); upright where the corners make no sense."""
    along = (corners[1] + corners[2] - corners[0] - corners[3]) / 2
    down = (corners[2] + corners[3] - corners[0] - corners[1]) / 2
    right = np.array([1.0, float(np.clip(along[1] / max(along[0], 1.0), -1.0, 1.0))])
    below = np.array([float(np.clip(down[0] / max(down[1], 1.0), -1.5, 1.5)), 1.0])
    return right, below


def _grow_rows(boxes: list[_Box], corners: NDArray[np.float64]) -> list[tuple[int, _Box]]:
    """Boxes in reading order with their row; a weak box off every row's line or size is dropped."""
    if not boxes:
        return []
    right, _ = _directions(corners)
    tallest = float(np.median(sorted(b.height for b in boxes)[-max(1, (len(boxes) + 1) // 2) :]))
    boxes = [b for b in boxes if 0.35 * tallest < b.height < 1.6 * tallest or b.score > 0.8]
    level = {id(b): b.y - right[1] * b.x for b in boxes}
    rows: list[list[_Box]] = []
    for box in sorted(boxes, key=lambda b: -b.height):
        for members in rows:
            tall = members[0]  # the row's tallest
            apart = abs(level[id(box)] - level[id(tall)])
            if (tall.height + box.height) / 2 - apart > 0.45 * box.height:  # they overlap by half the smaller one
                members.append(box)
                break
        else:
            rows.append([box])
    best = max(sum(b.score for b in members) for members in rows)
    rows = [members for members in rows if len(members) > 1 or members[0].score > 0.5 or best < 1.0]
    rows.sort(key=lambda members: float(np.mean([level[id(b)] for b in members])))
    return [(k, box) for k, members in enumerate(rows) for box in sorted(members, key=lambda b: b.x)]


def _to_source(
    box: _Box, row: int, right: NDArray[np.float64], down: NDArray[np.float64], source_from_canvas: NDArray[np.float64]
) -> Glyph:
    centre = np.array([box.x, box.y])
    half_w, half_h = (box.right - box.left) / 2, box.height / 2
    points = np.array([centre - half_w * right, centre + half_w * right, centre - half_h * down, centre + half_h * down])
    left_px, right_px, top_px, bottom_px = apply_affine(source_from_canvas, points)
    return Glyph(
        left_px=left_px, right_px=right_px, top_px=top_px, bottom_px=bottom_px, score=box.score, main=box.small < 0.5, row=row
    )
