"""From GlyphNet's outputs to plate-ness, corners and character boxes in source pixels."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.segment.glyph_crop import apply_affine, invert_affine

STRIDE_X_PX, STRIDE_Y_PX = 2, 4  # canvas pixels per cell of the glyph map
BOX_SCALE_PX = 8.0  # of the box channels
_HEAT_MIN = 0.40
_OVERLAP_MAX = 0.45
_LOGIT_MIN = float(np.log(_HEAT_MIN / (1.0 - _HEAT_MIN)))
_AROUND = np.ones((3, 5), np.uint8)  # cells of the map within which a peak is alone: a narrow character
_STEP = np.array([-1, 0, 1])
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
    glyphs = _to_source(boxes, right, down, source_from_canvas)
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


def _sigmoids(logits: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(1.0 / (1.0 + np.exp(-np.minimum(np.maximum(logits, -60.0), 60.0))))


def _peaks(glyph_map: NDArray[np.float32]) -> list[_Box]:
    """Local maxima of the heat; each box is the heat-weighted mean of its neighbourhood's opinions."""
    logits = glyph_map[0]
    r, c = np.nonzero((logits >= cv2.dilate(logits, _AROUND)) & (logits >= _LOGIT_MIN))
    if not len(r):
        return []
    padded = np.pad(glyph_map, ((0, 0), (1, 1), (1, 1)))
    padded[0, [0, -1], :] = padded[0, :, [0, -1]] = -60.0  # no heat outside
    rows, cols = r[:, None, None] + _STEP[:, None], c[:, None, None] + _STEP  # (n, 3, 3) places, in unpadded cells
    around = padded[:, rows + 1, cols + 1].astype(np.float64)
    heat = _sigmoids(around[0])
    weight = np.where(heat > 0.3 * heat[:, 1:2, 1:2], heat, 0.0)
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    x, y = (cols + 0.5) * STRIDE_X_PX - 0.5, (rows + 0.5) * STRIDE_Y_PX - 0.5
    small, left, right, top, bottom = around[1:]
    values = np.stack([
        x - BOX_SCALE_PX * left, x + BOX_SCALE_PX * right, y - BOX_SCALE_PX * top, y + BOX_SCALE_PX * bottom, small
    ])
    means = (values * weight).sum(axis=(2, 3))
    means[4] = _sigmoids(means[4])
    found = [
        _Box(left=b[0], right=b[1], top=b[2], bottom=b[3], score=score, small=b[4])
        for b, score in zip(means.T.tolist(), heat[:, 1, 1].tolist(), strict=True)
    ]
    return [box for box in found if box.right - box.left > 0.8 and box.height > 2.0]


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
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners.tolist()
    slope = (by + cy - ay - dy) / max(bx + cx - ax - dx, 2.0)
    lean = (cx + dx - ax - bx) / max(cy + dy - ay - by, 2.0)
    return np.array([1.0, min(max(slope, -1.0), 1.0)]), np.array([min(max(lean, -1.5), 1.5), 1.0])


def _grow_rows(boxes: list[_Box], corners: NDArray[np.float64]) -> list[tuple[int, _Box]]:
    """Boxes in reading order with their row; a weak box off every row's line or size is dropped."""
    if not boxes:
        return []
    slope = float(_directions(corners)[0][1])
    tallest = median(sorted(b.height for b in boxes)[-max(1, (len(boxes) + 1) // 2) :])
    boxes = [b for b in boxes if 0.35 * tallest < b.height < 1.6 * tallest or b.score > 0.8]
    level = {id(b): b.y - slope * b.x for b in boxes}
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
    rows.sort(key=lambda members: sum(level[id(b)] for b in members) / len(members))
    return [(k, box) for k, members in enumerate(rows) for box in sorted(members, key=lambda b: b.x)]


def _to_source(
    boxes: list[tuple[int, _Box]], right: NDArray[np.float64], down: NDArray[np.float64],
    source_from_canvas: NDArray[np.float64],
) -> tuple[Glyph, ...]:
    if not boxes:
        return ()
    centre = np.array([(b.x, b.y) for _, b in boxes])
    wide = np.array([[(b.right - b.left) / 2] for _, b in boxes]) * right
    high = np.array([[b.height / 2] for _, b in boxes]) * down
    points = apply_affine(source_from_canvas, np.stack([centre - wide, centre + wide, centre - high, centre + high], axis=1))
    return tuple(
        Glyph(left_px=p[0], right_px=p[1], top_px=p[2], bottom_px=p[3], score=b.score, main=b.small < 0.5, row=row)
        for p, (row, b) in zip(points, boxes, strict=True)
    )
