"""The face of one plate of a standard, with the standard's own sizes: the truth behind every simulated range."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tmde_edge.errors import UsageError
from tmde_edge.plates.standard import GlyphClass, PlateStandard, Size, load_standards
from tmde_edge.simulation.plate_face import Colour, FaceSpec, GlyphSpec, Mark

# What a standard leaves open is drawn as plates look on the road; these numbers are style, never truth of a cue.
_WIDTH_PER_HEIGHT = 0.56
_STROKE_PER_HEIGHT = 0.14
_GAP_PER_HEIGHT = 0.13
_GROUP_GAP_PER_HEIGHT = 0.45
_BAND_MM = 40.0
_LINE_MM = 3.0  # of a border line of unknown thickness
_BOLT_PLAY_MM = 1.5, 1.0  # of the bolts of one side in their slots together, and of each, one sigma
_LETTERS, _DIGITS = "ABCDEFGHJKLMNPRSTUVWXYZ", "0123456789"
_COLOURS: dict[str, Colour] = {
    "white": (236, 240, 240), "yellow": (40, 190, 240), "black": (22, 22, 24), "blue": (150, 60, 20),
    "green": (60, 110, 20), "red": (40, 40, 190), "silver": (200, 200, 200), "grey": (160, 160, 160),
}
_TEXTS = {
    "de": "M AB 1234", "us": "ABC 1D23", "ru": "A123BC 77", "gb": "AB12 CDE", "fr": "AB 123 CD", "ro": "B 60 JRB",
    "nl": "GB 001 B", "it": "AB 123 CD", "es": "1234 BCD", "pl": "WX 12345",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StandardFace:
    """A face and what it is: the standard's id, the text, and which glyphs belong to the main class."""

    standard: str
    text: str
    spec: FaceSpec
    main: tuple[bool, ...]  # one for each of spec.glyphs

    @property
    def main_height_mm(self) -> float:
        """Mean height of the main characters: the true size behind `char_height_px`."""
        return float(np.mean([g.height_mm for g, m in zip(self.spec.glyphs, self.main, strict=True) if m]))


def standard_named(name: str) -> PlateStandard:
    """The standard with this id, or the most common one of a country or group. Raises UsageError."""
    known = load_standards()
    key = name.lower()
    if key in known:
        return known[key]
    hits = [s for s in known.values() if key in s.groups or s.country.lower().split("-")[0] == key]
    if not hits:
        raise UsageError(f"plate standard {name!r}: unknown; see `tmde-edge plates list`")
    return max(hits, key=lambda s: s.weight)


def standard_face(name: str, text: str | None = None, *, seed: int | None = None) -> StandardFace:
    """The face of a standard's plate; nominal sizes, or with a seed sizes drawn within the standard's limits.

    text: characters of one row with spaces between groups, rows separated by "/"; None: a usual one.
    """
    standard = standard_named(name)
    rng = None if seed is None else np.random.default_rng(seed)
    rows = _rows(standard, text)
    border = _size(standard.border, rng, 0.0 if standard.border_line is False else _LINE_MM)
    inset = _size(standard.border_inset, rng, 2.0 if border else 0.0)
    usual = 0.6 * _size(standard.plate_height, None, 120.0) / len(rows)
    classes = {key: _Glyphs.of(glyph, rng, usual) for key, glyph in standard.glyphs.items()}
    tallest = [max(classes[key].height for _, key in row if key != " ") for row in rows]
    longest = max(sum(1.15 * classes[k].width(c) if k != " " else 20.0 for c, k in row) for row in rows)
    width = _size(standard.plate_width, rng, longest + 30.0)
    height = _size(standard.plate_height, rng, 1.25 * sum(tallest) + 20.0)
    left, right = -width / 2 + border + inset, width / 2 - border - inset
    marks: list[Mark] = []
    band = min(_BAND_MM, 0.1 * width)
    if standard.band in ("left", "both"):
        marks += _band(left, -height / 2 + border + inset, band, height - 2 * (border + inset), standard.country)
        left += band
    if standard.band in ("right", "both"):
        marks += _band(right - band, -height / 2 + border + inset, band, height - 2 * (border + inset), "")
        right -= band
    us = standard.country.startswith("US")
    glyphs: list[GlyphSpec] = []
    main: list[bool] = []
    gap_v = max((height - 2 * (border + inset) - sum(tallest)) / (len(rows) + 1), 0.0)
    bottom = -height / 2 + border + inset
    for r, row in enumerate(rows):
        bottom += gap_v + tallest[r]
        gap = _size(standard.group_gap, rng, _GROUP_GAP_PER_HEIGHT * tallest[r])
        for x, char, key, fit in _place(row, classes, left, right, gap):
            g = classes[key]
            glyphs.append(GlyphSpec(char=char, left_mm=x, top_mm=bottom - g.height, width_mm=g.width(char) * fit,
                                    height_mm=g.height, stroke_mm=g.stroke, counted=True, row=r))
            main.append(key == standard.main_key)
        if standard.country == "DE":
            marks += _seals(glyphs, r, row, tallest[r])
    ink = _COLOURS.get(standard.ink, _COLOURS["black"])
    if standard.country == "RU" and len(rows) == 1:
        marks += _ru_box(glyphs, main, width, height, border + inset, ink)
    if us:
        marks += _us_marks(width, height, _size(standard.hole_spacing, None, 177.8), rng)
    spec = FaceSpec(
        width_mm=width, height_mm=height, glyphs=tuple(glyphs), ink_bgr=ink, border_mm=border, border_inset_mm=inset,
        background_bgr=_COLOURS.get(standard.background, _COLOURS["white"]), marks=tuple(marks),
        corner_radius_mm=20.0 if us else 8.0,
    )
    return StandardFace(standard=standard.id, text="/".join("".join(c for c, _ in row) for row in rows), spec=spec,
                        main=tuple(main))


@dataclass(frozen=True, slots=True)
class _Glyphs:
    """One glyph class in millimetres."""

    height: float
    letter: float
    digit: float
    stroke: float
    gap: float

    @classmethod
    def of(cls, glyph: GlyphClass, rng: np.random.Generator | None, usual_height: float) -> _Glyphs:
        height = _size(glyph.height, rng, usual_height)
        letter = _size(glyph.letter_width, rng, _WIDTH_PER_HEIGHT * height)
        gap = _size(glyph.gap, rng, _GAP_PER_HEIGHT * height)
        if glyph.pitch is not None and glyph.gap is None:
            gap = max(_size(glyph.pitch, rng, 0.0) - letter, 0.03 * height)
        return cls(height, letter, _size(glyph.digit_width, rng, letter),
                   _size(glyph.stroke, rng, _STROKE_PER_HEIGHT * height), gap)

    def width(self, char: str) -> float:
        return self.digit if char.isdigit() else self.letter


def _size(size: Size | None, rng: np.random.Generator | None, otherwise: float) -> float:
    if size is None:
        return otherwise
    nominal = size.mm
    if nominal is None:
        limits = [v for v in (size.min, size.max) if v is not None]
        nominal = float(np.mean(limits))
    if rng is None or size.min is None or size.max is None or size.min >= size.max:
        return float(nominal)
    return float(rng.triangular(size.min, min(max(nominal, size.min), size.max), size.max))


def any_text(name: str, rng: np.random.Generator) -> str:
    """Random characters in the layout of the usual text: a letter for each letter, a digit for each digit."""

    def other(char: str) -> str:
        return char if char == " " else str(rng.choice(list(_DIGITS if char.isdigit() else _LETTERS)))

    return "/".join("".join(other(char) for char, _ in row) for row in _rows(standard_named(name), None))


def _rows(standard: PlateStandard, text: str | None) -> list[list[tuple[str, str]]]:
    """Characters with their glyph class, row by row; ' ' is a group gap."""
    pattern = standard.rows
    if text is None:
        usual = _TEXTS.get(standard.country.lower().split("-")[0], "")
        fits = len(pattern) == 1 and len(usual.replace(" ", "")) in standard.char_counts
        if usual and fits and (len(standard.glyphs) == 1 or standard.id == "ru-1"):
            text = usual
        else:
            letters = iter("AB123CD456EFGH789KLMNP" * 3)
            text = "/".join("".join(" " if c == " " else next(letters) for c in row) for row in pattern)
    parts = text.split("/")
    if len(parts) != len(pattern):
        raise UsageError(f"plate text {text!r}: {standard.id} has {len(pattern)} rows, separated by '/'")
    only = next(iter(standard.glyphs)) if len(standard.glyphs) == 1 else None
    out: list[list[tuple[str, str]]] = []
    for part, row in zip(parts, pattern, strict=True):
        keys = iter(row.replace(" ", ""))
        line: list[tuple[str, str]] = []
        for char in part.upper():
            if char == " ":
                line.append((" ", " "))
                continue
            key = only or next(keys, row[-1])
            line.append((char, key))
        out.append(line)
    return out


def _place(
    row: list[tuple[str, str]], classes: dict[str, _Glyphs], left: float, right: float, group_gap: float
) -> list[tuple[float, str, str, float]]:
    """(left edge, character, class, width factor): centred; narrower gaps, then narrower letters where it must be."""
    spaces = sum(key == " " for _, key in row)
    ink = sum(classes[key].width(char) for char, key in row if key != " ")
    pairs = [(a[1], b[1]) for a, b in pairwise(row) if a[1] != " " and b[1] != " "]
    gaps = sum(max(classes[a].gap, classes[b].gap) for a, b in pairs)
    room = right - left - 0.02 * (right - left)
    smallest = max((classes[key].gap for _, key in row if key != " "), default=0.0)
    if ink + gaps + spaces * group_gap > room and spaces:
        group_gap = max((room - ink - gaps) / spaces, smallest)
    total = ink + gaps + spaces * group_gap
    fit = min(1.0, room / total)
    x = (left + right) / 2 - total * fit / 2
    out: list[tuple[float, str, str, float]] = []
    for i, (char, key) in enumerate(row):
        if key == " ":
            x += group_gap * fit
            continue
        out.append((x, char, key, fit))
        x += classes[key].width(char) * fit
        if i + 1 < len(row) and row[i + 1][1] != " ":
            x += max(classes[key].gap, classes[row[i + 1][1]].gap) * fit
    return out


def _band(left: float, top: float, width: float, height: float, country: str) -> list[Mark]:
    blue = (160.0, 60.0, 10.0)
    marks = [Mark(kind="rect", left_mm=left, top_mm=top, width_mm=width, height_mm=height, colour_bgr=blue)]
    gold = (30.0, 210.0, 250.0)
    ring = 0.26 * width
    for k in range(12):
        a = 2 * np.pi * k / 12
        x, y = left + width / 2 + ring * np.sin(a), top + 0.3 * height - ring * np.cos(a)
        marks.append(Mark(kind="disc", left_mm=x - 2, top_mm=y - 2, width_mm=4, height_mm=4, colour_bgr=gold))
    letters = {"DE": "D", "RO": "RO", "FR": "F", "IT": "I", "ES": "E", "PL": "PL", "NL": "NL"}.get(country, country[:2])
    if letters:
        w = 0.3 * width * len(letters)
        marks.append(Mark(kind="text", left_mm=left + (width - w) / 2, top_mm=top + 0.64 * height, width_mm=w,
                          height_mm=0.2 * height, colour_bgr=(240, 240, 240), text=letters))
    return marks


def _seals(glyphs: list[GlyphSpec], row: int, line: list[tuple[str, str]], height: float) -> list[Mark]:
    """The two round seals in the first group gap, where there is room."""
    first = next((i for i, (_, key) in enumerate(line) if key == " "), None)
    if first is None or row > 0:
        return []
    before, after = glyphs[first - 1], glyphs[first]
    left, right = before.left_mm + before.width_mm, after.left_mm
    size = min(right - left - 4.0, 35.0)
    if size < 10.0:
        return []
    x = (left + right) / 2
    return [
        Mark(kind="disc", left_mm=x - size / 2, top_mm=y - size / 2, width_mm=size, height_mm=size, colour_bgr=colour)
        for y, colour in ((-0.27 * height, (150.0, 160.0, 60.0)), (0.27 * height, (190.0, 190.0, 185.0)))
    ]


def _ru_box(
    glyphs: list[GlyphSpec], main: list[bool], width: float, height: float, edge: float, ink: Colour
) -> list[Mark]:
    """The region box: its line, the raised region number, RUS and the flag."""
    last = max(i for i, m in enumerate(main) if m) + 3  # three digits, then two letters, then the region
    region = list(range(last, len(glyphs)))
    if not region:
        return []
    top = -height / 2 + edge + 6.0
    for i in region:
        g = glyphs[i]
        glyphs[i] = GlyphSpec(char=g.char, left_mm=g.left_mm, top_mm=top, width_mm=g.width_mm, height_mm=g.height_mm,
                              stroke_mm=g.stroke_mm, counted=g.counted, row=g.row)
    line = (glyphs[last - 1].left_mm + glyphs[last - 1].width_mm + glyphs[last].left_mm) / 2
    low = top + glyphs[last].height_mm + 8.0
    marks = [
        Mark(kind="rect", left_mm=line - 1.5, top_mm=-height / 2 + edge, width_mm=3, height_mm=height - 2 * edge,
             colour_bgr=ink),
        Mark(kind="text", left_mm=line + 12, top_mm=low, width_mm=48, height_mm=20, colour_bgr=ink, text="RUS",
             stroke_mm=3.0),
    ]
    colours: tuple[Colour, ...] = ((240, 240, 240), (170, 60, 20), (40, 40, 200))
    for k, colour in enumerate(colours):
        marks.append(Mark(kind="rect", left_mm=line + 66, top_mm=low + k * 20 / 3, width_mm=28, height_mm=20 / 3,
                          colour_bgr=colour))
    return marks


def _us_marks(width: float, height: float, holes_mm: float, rng: np.random.Generator | None) -> list[Mark]:
    """Print above and below the characters, and four bolts, each with its play in its slot where sizes are drawn."""
    blue: Colour = (140.0, 60.0, 30.0)
    marks = [
        Mark(kind="text", left_mm=-0.28 * width, top_mm=-height / 2 + 10, width_mm=0.56 * width, height_mm=18,
             colour_bgr=blue, text="NORTH SHORE"),
        Mark(kind="text", left_mm=-0.25 * width, top_mm=height / 2 - 20, width_mm=0.5 * width, height_mm=10,
             colour_bgr=blue, text="LAKES AND PINES"),
    ]
    for hole_x in (-holes_mm / 2, holes_mm / 2):
        side = rng.normal(0, _BOLT_PLAY_MM[0]) if rng is not None else 0.0
        for hole_y in (-height / 2 + 16, height / 2 - 16):
            own = rng.normal(0, _BOLT_PLAY_MM[1], 2) if rng is not None else (0.0, 0.0)
            x, y = hole_x + side + own[0], hole_y + own[1]
            marks.append(Mark(kind="disc", left_mm=x - 5, top_mm=y - 4, width_mm=10, height_mm=8,
                              colour_bgr=(120.0, 120.0, 120.0), above=True))
    return marks
