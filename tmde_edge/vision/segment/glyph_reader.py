"""GlyphNet behind the `PlateReader` interface: its characters and corners, measured again in the source image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from statistics import median
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.bands import with_bands
from tmde_edge.vision.ground_colour import plate_picture
from tmde_edge.vision.plate_colours import plate_colours
from tmde_edge.vision.protocols import CharacterBox, Image, PlateCandidate, PlateReading
from tmde_edge.vision.rectify import apply_homography, is_convex, size_px, steadied
from tmde_edge.vision.refine import OutlineFit, refine_outline
from tmde_edge.vision.segment.bolts import BoltPlaces, find_bolts
from tmde_edge.vision.segment.glyph_decode import Glyph, GlyphReading
from tmde_edge.vision.segment.measure import border_thickness, box_edges, ink_mask, stroke_width
from tmde_edge.vision.segment.paper import FlatView, flatten, main_class
from tmde_edge.vision.settings import SegmenterSettings

Array = NDArray[np.float64]
FLOOR_SIGMA_PX = 0.15  # the network's own, at best
# The network's share in the edges of characters by their height, px; measured on rendered stills of ten standards.
SHARE_TB = (7.0, 8.5, 12.5, 15.0), (0.85, 0.6, 0.6, 0.0)  # tops and bottoms
SHARE_LR = (9.0, 12.0), (1.0, 0.0)  # left and right edges: of small ones blur fills the gaps to the neighbours
BORDER_HEIGHT_PX = 24.0  # on lower plates no border line is wider than a pixel: nothing to measure
LOW_PLATE_PX = 5.0  # of plates about so high the network's corners err twice as much as it says (rendered stills)
INKED_COUNT_MIN = 4  # fewer characters tell nothing about the plate's ink
INKED_MIN = 0.62  # of the median contrast: paler is a seal; from the standards' seals (green, grey) and characters of all widths
INKED_HEIGHT_PX = 10.0
INKED_SAMPLES = 16  # rows of a character that are looked at
INKED_SURE = 0.8  # the network's score
QUICK_ROWS = 60  # of a rectified plate in a hurried frame: heights of characters come out as well as from 100 (rendered stills)
REFINE_HEIGHT_PX = 7.0  # on lower plates border, margin and lettering run into one another: the network knows better
LOW_BAND_SLACK_PX = 0.5  # but for a blue band at an end that it leaves out by more than this: it sees grey only


class GlyphNetwork(Protocol):
    """The network: corners (n, 4, 2) of candidates to one reading each."""

    def read(self, image: Image, corners_px: Array) -> list[GlyphReading]:
        """One reading per candidate, in order, source pixels."""
        ...


class GlyphReader:
    """Reads candidates with GlyphNet in one batch; outline and glyph edges are then refined where they are plates."""

    def __init__(
        self, network: GlyphNetwork, settings: SegmenterSettings, line_share: float = 0.5, bolts: Sequence[BoltPlaces] = ()
    ) -> None:
        """By the expected standards: the chance that a printed line runs round a plate, and where its bolts may be."""
        self._network = network
        self._settings = settings
        self._line_share = line_share
        self._bolts = tuple(bolts)

    def read(self, image: Image, candidates: list[PlateCandidate]) -> list[PlateReading]:
        """One reading per candidate, in order, in source pixels."""
        if not candidates:
            return []
        pictures = [plate_picture(image, c.corners_px) for c in candidates]
        readings = self._read(pictures, candidates)
        return [self._measure(p, image, r, c.hurried) for p, r, c in zip(pictures, readings, candidates, strict=True)]

    def _read(self, pictures: list[Image], candidates: list[PlateCandidate]) -> list[GlyphReading]:
        """The network's own reading of each candidate in its picture; those of one picture in one batch."""
        groups: dict[int, list[int]] = {}
        for i, picture in enumerate(pictures):
            groups.setdefault(id(picture), []).append(i)
        readings: dict[int, GlyphReading] = {}
        for which in groups.values():
            found = self._network.read(pictures[which[0]], np.stack([candidates[i].corners_px for i in which]))
            readings.update(zip(which, found, strict=True))
        return [readings[i] for i in range(len(candidates))]

    def _measure(self, picture: Image, image: Image, reading: GlyphReading, hurried: bool) -> PlateReading:
        """The outline in the picture that the network read, the characters in the image itself."""
        given_sigma = max(FLOOR_SIGMA_PX, sqrt(float(reading.sigma_px @ reading.sigma_px) / len(reading.sigma_px)))
        if is_convex(reading.corners_px):
            given_sigma *= 1 + (LOW_PLATE_PX / size_px(reading.corners_px)[1]) ** 2
        corners = steadied(reading.corners_px, given_sigma)
        given = OutlineFit(corners_px=corners, sigma_px=given_sigma, refined=False, blur_px=None)
        if reading.platehood < self._settings.platehood_min or not is_convex(reading.corners_px):
            return _plain(given, reading)
        if hurried and size_px(given.corners_px)[1] >= REFINE_HEIGHT_PX:
            fit = replace(given, refined=True)  # the network's corners, with their own sigma
        else:
            fit = self._outline(picture, image, given, reading.light_on_dark)
        # glyphs are measured in the frame of the network's own corners: a wrong edge of the outline moves none of them
        tall_px = size_px(given.corners_px)[1]
        rows = round(max(QUICK_ROWS, 2 * tall_px)) if hurried and tall_px < QUICK_ROWS else None
        view = flatten(image, given.corners_px, rows)
        if view is None or not reading.glyphs:
            return _plain(fit, reading)
        boxes = _flat_boxes(reading.glyphs, view)
        inked = _of_one_ink(view, boxes, reading)
        if not inked.all():
            reading = replace(reading, glyphs=tuple(g for g, keep in zip(reading.glyphs, inked, strict=True) if keep))
            boxes = boxes[inked]
        edges, sigma = box_edges(view.grey, boxes, reading.light_on_dark)
        edges, sigma = _with_network(boxes, edges, sigma, view.per_px)
        strokes = [0.0] * len(edges)  # not measured
        if not hurried:
            strokes = [stroke_width(ink_mask(view.grey, b, reading.light_on_dark)) / view.per_px for b in edges]
        main_strokes = [s for s, g in zip(strokes, reading.glyphs, strict=True) if g.main and s > 0]
        visible = not hurried and tall_px >= BORDER_HEIGHT_PX
        border = border_thickness(view.grey, reading.light_on_dark) if visible else None
        return PlateReading(
            corners_px=fit.corners_px,
            corners_sigma_px=fit.sigma_px,
            side_sigma_px=fit.side_sigma_px,
            refined=fit.refined,
            characters=_characters(reading.glyphs, edges, view, sigma, strokes),
            platehood=reading.platehood,
            light_on_dark=reading.light_on_dark,
            stroke_px=median(main_strokes) if main_strokes else None,
            border_px=None if border is None else border / view.per_px,
            blur_px=fit.blur_px,
            bolts=() if hurried else find_bolts(view, edges, self._bolts),
            colours=None if hurried else plate_colours(image, fit.corners_px, reading.light_on_dark),
        )

    def _outline(self, picture: Image, image: Image, given: OutlineFit, light_on_dark: bool) -> OutlineFit:
        """The image's own edges where they agree with the network's corners; else those corners, blue bands taken in."""
        if size_px(given.corners_px)[1] < REFINE_HEIGHT_PX:
            if light_on_dark or not self._settings.refine:
                return replace(given, refined=True)
            banded = with_bands(image, given.corners_px, LOW_BAND_SLACK_PX)
            return replace(given, corners_px=banded.corners_px, refined=True)
        if not self._settings.refine:
            return given
        fit = refine_outline(picture, given.corners_px, given.sigma_px, light_on_dark, self._line_share, image)
        if not fit.side_sigma_px:
            return replace(given, corners_px=fit.corners_px)
        return replace(fit, corners_px=steadied(fit.corners_px, fit.sigma_px))


def _main(glyphs: Sequence[Glyph], heights_px: Array, sigmas_px: Array) -> list[bool]:
    """The tallest height class again, from measured heights, where these are surer than the classes are apart."""
    if median((sqrt(2) * sigmas_px).tolist()) > 0.04 * median(heights_px.tolist()):
        return [g.main for g in glyphs]
    return [bool(m) for m in main_class(heights_px)]


def _plain(fit: OutlineFit, reading: GlyphReading) -> PlateReading:
    """A reading whose glyphs are the network's own."""
    height = size_px(reading.corners_px)[1]
    sigma = max(0.3, 0.02 * height)
    return PlateReading(
        corners_px=fit.corners_px, corners_sigma_px=fit.sigma_px, side_sigma_px=fit.side_sigma_px, refined=fit.refined,
        platehood=reading.platehood, light_on_dark=reading.light_on_dark, blur_px=fit.blur_px,
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
    sides = np.array([(g.left_px, g.top_px, g.right_px, g.bottom_px) for g in glyphs], np.float64)  # (n, 4, 2)
    mapped = apply_homography(flat_from_source, sides.reshape(-1, 2)).reshape(-1, 4, 2)
    return np.stack([mapped[:, 0, 0], mapped[:, 1, 1], mapped[:, 2, 0], mapped[:, 3, 1]], axis=1)


def _of_one_ink(view: FlatView, boxes: Array, reading: GlyphReading) -> NDArray[np.bool_]:
    """Which boxes are inked like the others. Seals and stickers stand in the row too, as high as a character, but paler.

    What the network is sure of stays: glare makes a character pale. So do small ones: blur makes thin ones pale.
    """
    grey = view.grey
    keep = np.ones(len(boxes), np.bool_)
    sure = np.array([g.score >= INKED_SURE for g in reading.glyphs])
    tall_px = median((boxes[:, 3] - boxes[:, 1]).tolist())
    if len(boxes) < INKED_COUNT_MIN or tall_px < INKED_HEIGHT_PX * view.per_px or sure.all():
        return keep
    spans = np.clip(np.rint(boxes), 0, np.array([grey.shape[1], grey.shape[0]] * 2)).astype(int)
    step = 1 if tall_px < 2 * INKED_SAMPLES else int(tall_px // INKED_SAMPLES)
    patches = [grey[t:b:step, left:right:step] for left, t, right, b in spans.tolist()]
    if any(patch.size == 0 for patch in patches):
        return keep
    ranked = [np.sort(patch, axis=None) for patch in patches]
    ends = [(float(r[len(r) * 8 // 100]), float(r[len(r) - 1 - len(r) * 8 // 100])) for r in ranked]
    ink, paper = np.array([e[::-1] if reading.light_on_dark else e for e in ends]).T
    depth = np.abs(median(paper.tolist()) - ink)
    return np.asarray((depth >= INKED_MIN * median(depth.tolist())) | sure)


def _with_network(boxes: Array, edges: Array, sigma: Array, per_px: float) -> tuple[Array, Array]:
    """Edges of small characters: the half-contrast edges and the network's own, which err independently.

    Blur and compression make the crossing of a narrow top come out short by up to half a pixel; the network has seen such
    characters drawn, but rounds large ones to its grid. What the two differ by is part of the sigma.
    """
    height_px = (edges[:, 3] - edges[:, 1]) / per_px
    mixed, spread = edges.copy(), sigma.copy()
    for column, pair, (at_px, shares) in ((0, [1, 3], SHARE_TB), (1, [0, 2], SHARE_LR)):
        share = np.interp(height_px, at_px, shares)
        apart = boxes[:, pair] - edges[:, pair]
        mixed[:, pair] += share[:, None] * apart
        spread[:, column] = np.sqrt(sigma[:, column] ** 2 + share * (1 - share) * np.mean(apart**2, axis=1))
    return mixed, spread


def _characters(
    glyphs: Sequence[Glyph], edges: Array, view: FlatView, sigma: Array, strokes_px: list[float]
) -> tuple[CharacterBox, ...]:
    """Edges (n, 4) of the rectified picture as edge middles in the source image; sigma (n, 2) of tb and lr edges."""
    left, top, right, bottom = edges.T
    x, y = (left + right) / 2, (top + bottom) / 2
    places = np.stack([left, y, right, y, x, top, x, bottom], axis=1).reshape(-1, 2)
    at = apply_homography(view.source_from_flat, places).reshape(-1, 4, 2)
    sigma_px = sigma / view.per_px
    step = at[:, 3] - at[:, 2]
    main = _main(glyphs, np.hypot(step[:, 0], step[:, 1]), sigma_px[:, 0])
    return tuple(
        CharacterBox(
            left_px=p[0], right_px=p[1], top_px=p[2], bottom_px=p[3], score=g.score, main=m, row=g.row, sigma_tb_px=s_tb,
            sigma_lr_px=s_lr, stroke_px=stroke if stroke > 0 else None,
        )
        for g, p, (s_tb, s_lr), m, stroke in zip(glyphs, at, sigma_px.tolist(), main, strokes_px, strict=True)
    )  # fmt: skip
