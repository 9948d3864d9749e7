"""From what a reader found on one plate to the logged `PlateSighting`; and whether a frame shows anything at all."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import hypot
from statistics import median
from typing import Literal

import numpy as np

from tmde_edge.messages import BoltSighting, GlyphSighting, PlateSighting, Point
from tmde_edge.vision.protocols import CharacterBox, Image, PlateReading
from tmde_edge.vision.rectify import Array, size_px
from tmde_edge.vision.settings import SegmenterSettings

WASHED_SIGMA = 0.2  # one sigma of a corner where white runs into white, in plate heights
GROUP_GAP = 1.35  # a pitch longer than this many medians spans a gap between groups


def plate_sighting(
    reading: PlateReading, *, track_id: int, score: float, source: Literal["detector", "flow"],
    shape: tuple[int, ...], settings: SegmenterSettings,
) -> PlateSighting:
    """One plate of a frame of the given shape (rows, columns, ...), in source pixels."""
    glyphs = tuple(_glyph(c) for c in reading.characters)
    heights = [g.height_px for g in glyphs if g.main]
    enough = len(glyphs) >= max(1, settings.min_characters)
    x, y = reading.corners_px[:, 0], reading.corners_px[:, 1]
    cut = x.min() < -0.5 or y.min() < -0.5 or x.max() > shape[1] - 0.5 or y.max() > shape[0] - 0.5
    return PlateSighting(
        track_id=track_id,
        corners_px=(
            _point(reading.corners_px[0]), _point(reading.corners_px[1]),
            _point(reading.corners_px[2]), _point(reading.corners_px[3]),
        ),
        corners_sigma_px=reading.corners_sigma_px,
        score=score,
        source=source,
        glyphs=glyphs,
        char_height_px=trimmed_mean(heights, settings.trim_k) if enough else None,
        stroke_px=reading.stroke_px,
        spacing_px=spacing(reading.characters),
        border_px=reading.border_px,
        refined=reading.refined,
        light_on_dark=reading.light_on_dark,
        cut=bool(cut),
        blur_px=reading.blur_px,
        side_sigma_px=reading.side_sigma_px,
        bolts=tuple(
            BoltSighting(left_px=_point(b.left_px), right_px=_point(b.right_px), sigma_px=b.sigma_px) for b in reading.bolts
        ),
        colours=reading.colours,
    )  # fmt: skip


def trimmed_mean(values: list[float], k: int) -> float | None:
    """Mean without the k largest and k smallest; with too few values fewer are left out; None of nothing."""
    if not values:
        return None
    k = min(k, (len(values) - 1) // 2)
    kept = sorted(values)[k : len(values) - k]
    return sum(kept) / len(kept)


def spacing(characters: tuple[CharacterBox, ...]) -> float | None:
    """Mean distance between the centres of neighbours in a row, source pixels; gaps between groups left out."""
    pitches: list[float] = []
    centres = {id(c): tuple(((c.left_px + c.right_px) / 2).tolist()) for c in characters if c.main}
    for row in {c.row for c in characters}:
        ordered = sorted(centres[id(c)] for c in characters if c.row == row and c.main)
        pitches += [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(ordered)]
    if len(pitches) < 2:
        return None
    near = [p for p in pitches if p <= GROUP_GAP * median(pitches)]
    return sum(near) / len(near)


def is_blind(image: Image, contrast_min: float) -> bool:
    """Whether the image shows nothing: black, saturated or nearly constant (2 % to 98 % of a coarse grid of its pixels)."""
    coarse = image[:: max(1, image.shape[0] // 45), :: max(1, image.shape[1] // 80)]
    if coarse.ndim == 3:  # the brightest channel; numpy's own maximum over so short an axis is slow
        coarse = np.maximum.reduce([coarse[..., i] for i in range(coarse.shape[2])])
    grey = np.sort(coarse, axis=None)
    low, high = grey[len(grey) // 50], grey[len(grey) - 1 - len(grey) // 50]
    return bool(float(high) - float(low) < contrast_min)


def washed(reading: PlateReading) -> PlateReading:
    """What may be said of a plate that is washed out: about where it is."""
    sigma_px = max(reading.corners_sigma_px, WASHED_SIGMA * size_px(reading.corners_px)[1])
    return without_ink(reading, reading.corners_px, sigma_px)


def without_ink(reading: PlateReading, corners_px: Array, sigma_px: float) -> PlateReading:
    """A reading of which only the place is left, as given."""
    return replace(
        reading, corners_px=corners_px, corners_sigma_px=sigma_px, refined=False, characters=(), stroke_px=None,
        border_px=None, blur_px=None, side_sigma_px=(), bolts=(), colours=None,
    )  # fmt: skip


def _glyph(c: CharacterBox) -> GlyphSighting:
    return GlyphSighting(
        left_px=_point(c.left_px), right_px=_point(c.right_px), top_px=_point(c.top_px), bottom_px=_point(c.bottom_px),
        sigma_tb_px=c.sigma_tb_px, sigma_lr_px=c.sigma_lr_px, score=c.score, row=c.row, main=c.main, stroke_px=c.stroke_px,
    )  # fmt: skip


def _point(p: Array) -> Point:
    x, y = p.tolist()
    return x, y
