"""GlyphNet behind the `PlateReader` interface: its characters and corners, measured again in the source image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import CharacterBox, Image, PlateCandidate, PlateReading
from tmde_edge.vision.rectify import apply_homography, is_convex, size_px, steadied
from tmde_edge.vision.refine import OutlineFit, refine_outline
from tmde_edge.vision.segment.glyph_decode import Glyph, GlyphReading
from tmde_edge.vision.segment.measure import border_thickness, box_edges, ink_mask, stroke_width
from tmde_edge.vision.segment.paper import FlatView, flatten, main_class
from tmde_edge.vision.settings import SegmenterSettings

Array = NDArray[np.float64]
MOVED_SIGMAS = 4.0  # an outline further than this from the network's corners is another edge
FLOOR_SIGMA_PX = 0.15  # the network's own, at best
NETWORK_SHARE = 0.6  # in the tops and bottoms of characters up to BOTH_PX high; measured on rendered stills of ten standards
BOTH_PX, CROSSING_ALONE_PX = 13.0, 17.0
BORDER_HEIGHT_PX = 24.0  # on lower plates no border line is wider than a pixel: nothing to measure
REFINE_HEIGHT_PX = 16.0  # on lower plates border, margin and lettering run into one another: the network knows better


class GlyphNetwork(Protocol):
    """The network: corners (n, 4, 2) of candidates to one reading each."""

    def read(self, image: Image, corners_px: Array) -> list[GlyphReading]:
        """One reading per candidate, in order, source pixels."""
        ...


class GlyphReader:
    """Reads candidates with GlyphNet in one batch; outline and glyph edges are then refined where they are plates."""

    def __init__(self, network: GlyphNetwork, settings: SegmenterSettings) -> None:
        self._network = network
        self._settings = settings

    def read(self, image: Image, candidates: list[PlateCandidate]) -> list[PlateReading]:
        """One reading per candidate, in order, in source pixels."""
        if not candidates:
            return []
        readings = self._network.read(image, np.stack([c.corners_px for c in candidates]))
        return [self._measure(image, r, c.hurried) for r, c in zip(readings, candidates, strict=True)]

    def _measure(self, image: Image, reading: GlyphReading, hurried: bool) -> PlateReading:
        given_sigma = max(FLOOR_SIGMA_PX, float(np.sqrt(np.mean(np.square(reading.sigma_px)))))
        corners = steadied(reading.corners_px, given_sigma)
        given = OutlineFit(corners_px=corners, sigma_px=given_sigma, refined=False, blur_px=None)
        if reading.platehood < self._settings.platehood_min or not is_convex(reading.corners_px):
            return _plain(given, reading)
        if hurried:
            fit = replace(given, refined=True)  # the network's corners, with their own sigma
        else:
            fit = self._outline(image, given, reading.light_on_dark)
        # glyphs are measured in the frame of the network's own corners: a wrong edge of the outline moves none of them
        view = flatten(image, given.corners_px)
        if view is None or not reading.glyphs:
            return _plain(fit, reading)
        boxes = _flat_boxes(reading.glyphs, view)
        edges, sigma = box_edges(view.grey, boxes, reading.light_on_dark)
        edges, sigma = _with_network(boxes, edges, sigma, view.per_px)
        strokes = [stroke_width(ink_mask(view.grey, b, reading.light_on_dark)) / view.per_px for b in edges]
        main_strokes = [s for s, g in zip(strokes, reading.glyphs, strict=True) if g.main and s > 0]
        visible = not hurried and size_px(given.corners_px)[1] >= BORDER_HEIGHT_PX
        border = border_thickness(view.grey, reading.light_on_dark) if visible else None
        characters = tuple(
            _character(g, e, view, s, stroke)
            for g, e, s, stroke in zip(reading.glyphs, edges, sigma, strokes, strict=True)
        )
        return PlateReading(
            corners_px=fit.corners_px,
            corners_sigma_px=fit.sigma_px,
            refined=fit.refined,
            characters=_classed(characters),
            platehood=reading.platehood,
            light_on_dark=reading.light_on_dark,
            stroke_px=float(np.median(main_strokes)) if main_strokes else None,
            border_px=None if border is None else border / view.per_px,
            blur_px=fit.blur_px,
        )

    def _outline(self, image: Image, given: OutlineFit, light_on_dark: bool) -> OutlineFit:
        """The image's own edges where they agree with the network's corners; else those corners."""
        if size_px(given.corners_px)[1] < REFINE_HEIGHT_PX:
            return replace(given, refined=True)
        if not self._settings.refine:
            return given
        fit = refine_outline(image, given.corners_px, given.sigma_px, light_on_dark)
        moved = float(np.abs(fit.corners_px - given.corners_px).max())
        if not fit.refined or moved > MOVED_SIGMAS * max(given.sigma_px, fit.sigma_px):
            return given
        if fit.sigma_px > given.sigma_px:
            return given
        return replace(fit, corners_px=steadied(fit.corners_px, fit.sigma_px))


def _classed(characters: tuple[CharacterBox, ...]) -> tuple[CharacterBox, ...]:
    """The tallest height class again, from measured heights, where these are surer than the classes are apart."""
    heights = np.array([np.hypot(*(c.bottom_px - c.top_px)) for c in characters], np.float64)
    sigmas = np.array([np.sqrt(2) * c.sigma_tb_px for c in characters])
    if np.median(sigmas) > 0.04 * np.median(heights):
        return characters
    return tuple(replace(c, main=bool(m)) for c, m in zip(characters, main_class(heights), strict=True))


def _plain(fit: OutlineFit, reading: GlyphReading) -> PlateReading:
    """A reading whose glyphs are the network's own."""
    height = size_px(reading.corners_px)[1]
    sigma = max(0.3, 0.02 * height)
    return PlateReading(
        corners_px=fit.corners_px, corners_sigma_px=fit.sigma_px, refined=fit.refined, platehood=reading.platehood,
        light_on_dark=reading.light_on_dark, blur_px=fit.blur_px,
        characters=tuple(
            CharacterBox(
                left_px=g.left_px, right_px=g.right_px, top_px=g.top_px, bottom_px=g.bottom_px, score=g.score,
                main=g.main, row=g.row, sigma_tb_px=sigma, sigma_lr_px=sigma,
            )
            for g in reading.glyphs
        ),
    )  # fmt: skip


def _flat_boxes(glyphs: Sequence[Glyph], view: FlatView) -> Array:
    """(n, 4) left, top, right, bottom in the rectified picture."""
    flat_from_source = np.asarray(np.linalg.inv(view.source_from_flat), dtype=np.float64)
    names = ("left_px", "top_px", "right_px", "bottom_px")
    sides = [np.array([getattr(g, n) for g in glyphs], np.float64) for n in names]
    mapped = [apply_homography(flat_from_source, s) for s in sides]
    return np.column_stack([mapped[0][:, 0], mapped[1][:, 1], mapped[2][:, 0], mapped[3][:, 1]])


def _with_network(boxes: Array, edges: Array, sigma: Array, per_px: float) -> tuple[Array, Array]:
    """Tops and bottoms of small characters: the half-contrast edges and the network's own, which err independently.

    Blur and compression make the crossing of a narrow top come out short by up to half a pixel; the network has seen such
    characters drawn, but rounds large ones to its grid. What the two differ by is part of the sigma.
    """
    height_px = (edges[:, 3] - edges[:, 1]) / per_px
    share = NETWORK_SHARE * np.clip((CROSSING_ALONE_PX - height_px) / (CROSSING_ALONE_PX - BOTH_PX), 0.0, 1.0)
    mixed, spread = edges.copy(), sigma.copy()
    apart = boxes[:, [1, 3]] - edges[:, [1, 3]]
    mixed[:, [1, 3]] += share[:, None] * apart
    spread[:, 0] = np.sqrt(sigma[:, 0] ** 2 + share * (1 - share) * np.mean(apart**2, axis=1))
    return mixed, spread


def _character(glyph: Glyph, edges: Array, view: FlatView, sigma: Array, stroke_px: float) -> CharacterBox:
    left, top, right, bottom = edges
    x, y = (left + right) / 2, (top + bottom) / 2
    at = apply_homography(view.source_from_flat, np.array([[left, y], [right, y], [x, top], [x, bottom]]))
    return CharacterBox(
        left_px=at[0], right_px=at[1], top_px=at[2], bottom_px=at[3], score=glyph.score, main=glyph.main, row=glyph.row,
        sigma_tb_px=float(sigma[0]) / view.per_px, sigma_lr_px=float(sigma[1]) / view.per_px,
        stroke_px=stroke_px if stroke_px > 0 else None,
    )  # fmt: skip
