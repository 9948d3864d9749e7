"""Plate standards as data: outer sizes, glyph sizes, tolerances, layout; and what a tolerance means in numbers."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from functools import lru_cache
from importlib import resources
from typing import Literal

import msgspec

from tmde_edge.errors import ConfigError

Kind = Literal["outline", "glyph_height", "glyph_width", "stroke", "pitch", "gap", "border", "hole"]

# One-sigma relative uncertainty of a number that comes without limits: (verified, unverified). See docs/plates.md.
DEFAULT_SIGMA: dict[Kind, tuple[float, float]] = {
    "outline": (0.003, 0.006),
    "glyph_height": (0.008, 0.030),
    "glyph_width": (0.030, 0.060),
    "stroke": (0.060, 0.120),
    "pitch": (0.012, 0.040),
    "gap": (0.10, 0.20),
    "border": (0.12, 0.25),
    "hole": (0.005, 0.015),
}
# A width the law only bounds ("at most 520") is the usual one on most vehicles, for plates are made from blanks of few sizes; the
# others are shorter. The share is a cautious guess, nobody counts them.
WHOLE_SHARE = 0.85
# As seen: dark holders hide dark borders (Romanian plates, all of one size, scatter by 3 % on roads, with characters' errors).
WHOLE_SIGMA = 0.025
SHORTER, SHORTER_SIGMA = 0.06, 0.06  # log: how much shorter the others are (460 mm is the next German blank: 0.12)
# Chance that a plate shows a printed line round it where its standard has one, has none, or does not say: series differ, and
# makers draw lines that no law asks for.
LINE_SHARE = {True: 0.95, False: 0.05, None: 0.5}
# Nobody states the limits to the last 0.1 mm of what is stamped: no tolerance is believed tighter than this.
LEAST_SIGMA = 0.002
BACKGROUNDS = ("white", "grey", "yellow", "green", "blue", "red", "black")


class Size(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One length: nominal, legal limits, whether the number was read in a source, and which (None: the standard's)."""

    mm: float | None = None
    min: float | None = None
    max: float | None = None
    verified: bool = False
    source: str | None = None

    def belief(self, kind: Kind) -> tuple[float, float]:
        """Mean and one sigma in mm: about the nominal where there is one, else uniform between the limits."""
        low, high, mode = self.min, self.max, self.mm
        if mode is None:
            if low is not None and high is not None:
                return (low + high) / 2, max((high - low) / 12**0.5, LEAST_SIGMA * high)
            mode = high if high is not None else low
        if mode is None:
            raise ValueError("a size needs mm, or min and max")
        usual = DEFAULT_SIGMA[kind][0 if self.verified else 1] * mode
        if low is None and high is None:
            return mode, usual
        # A side without a limit reaches as far as three of the usual sigmas.
        below = mode - low if low is not None else 3 * usual
        above = high - mode if high is not None else 3 * usual
        # Triangular density with its mode at the nominal. Plates are made to the nominal, so that stays the mean and
        # sigma is the r.m.s. deviation from it: (a^2 - a b + b^2) / 6 with a below and b above.
        return mode, max(((below**2 - below * above + above**2) / 6) ** 0.5, LEAST_SIGMA * mode)


class GlyphClass(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Characters of one height. `main` marks the class whose height the paper's character cue uses."""

    height: Size | None = None
    letter_width: Size | None = None
    digit_width: Size | None = None
    stroke: Size | None = None
    gap: Size | None = None  # clear between neighbours of a group
    pitch: Size | None = None  # centre to centre of neighbours of a group, where all cells are equal
    main: bool = True


class PlateStandard(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One plate of one jurisdiction. All lengths in mm.

    rows: a typical layout, one string a row; each letter is a key of `glyphs`, a space a group gap.
    char_counts: the numbers of characters that occur. weight: how common, against the other standards of "auto".
    """

    id: str
    country: str
    name: str
    rows: tuple[str, ...]
    char_counts: tuple[int, ...]
    glyphs: dict[str, GlyphClass]
    source: str
    plate_width: Size | None = None
    plate_height: Size | None = None
    width_floats: bool = False  # the law bounds the width or lets it be cut: most have it whole, the others any
    border: Size | None = None
    border_line: bool | None = None  # whether such a line is printed round it, where its thickness is not known; None: not known
    border_inset: Size | None = None
    group_gap: Size | None = None
    margin_tb: Size | None = None  # clear above and below the characters
    hole_spacing: Size | None = None
    background: str = "white"
    other_backgrounds: dict[str, float] = {}  # those of front plates, taxis, states, each with its share of all plates
    ink: str = "black"
    band: Literal["", "left", "right", "both", "top"] = ""  # a coloured band without characters
    optional_band: Literal["", "left"] = ""  # that some of its plates have
    font: str = ""
    groups: tuple[str, ...] = ()
    weight: float = 1.0
    notes: str = ""

    @property
    def light_on_dark(self) -> bool:
        """Whether the characters are lighter than their ground."""
        return self.ink in ("white", "yellow") and self.background not in ("white", "yellow")

    def class_counts(self) -> dict[str, int]:
        """How many characters of each glyph class the typical layout has."""
        text = "".join(self.rows)
        return {key: text.count(key) for key in self.glyphs}

    @property
    def main_class(self) -> GlyphClass:
        """The class of the tallest characters."""
        return self.glyphs[self.main_key]

    @property
    def main_key(self) -> str:
        """Key of the class of the tallest characters in `glyphs`."""
        return next(k for k, g in self.glyphs.items() if g.main)

    def outline_belief(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """((width, sigma), (height, sigma)) in mm, or None where the standard fixes no outline."""
        if self.plate_width is None or self.plate_height is None:
            return None
        width, sigma = self.plate_width.belief("outline")
        kinds = self.floating_widths()
        if kinds:
            sigma = sum(share * (s**2 + (w - width) ** 2) for share, w, s in kinds) ** 0.5
        return (width, sigma), self.plate_height.belief("outline")

    def floating_widths(self) -> tuple[tuple[float, float, float], ...]:
        """(share, width, sigma) in mm of whole plates and of shorter ones where the width floats, else none."""
        if not self.width_floats or self.plate_width is None or self.plate_width.mm is None:
            return ()
        whole = self.plate_width.mm
        shorter = whole * math.exp(-SHORTER)
        return (WHOLE_SHARE, whole, WHOLE_SIGMA * whole), (1 - WHOLE_SHARE, shorter, SHORTER_SIGMA * shorter)

    @property
    def line_share(self) -> float:
        """Chance that one of these plates shows a printed line round it, 0 to 1."""
        return LINE_SHARE[True if self.border is not None else self.border_line]

    def pitch_belief(self) -> tuple[float, float] | None:
        """Centre-to-centre distance of neighbouring main characters and its sigma in mm, or None.

        From the stated pitch; else the mean width of letters and digits plus the gap, where they are stated.
        """
        main = self.main_class
        if main.pitch is not None:
            return main.pitch.belief("pitch")
        widths = [w.mm for w in (main.letter_width, main.digit_width) if w is not None and w.mm is not None]
        if not widths or main.letter_width is None or main.gap is None or main.gap.mm is None:
            return None
        sure = main.letter_width.verified and main.gap.verified
        pitch = sum(widths) / len(widths) + main.gap.mm
        return pitch, max(DEFAULT_SIGMA["pitch"][0 if sure else 1] * pitch, max(widths) - min(widths))


class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    standard: tuple[PlateStandard, ...]


def parse_standards(text: str, where: str) -> tuple[PlateStandard, ...]:
    """Standards of one TOML text (array of tables `standard`). Raises ConfigError naming the place and the fault."""
    try:
        file = msgspec.toml.decode(text, type=_File, strict=False)
    except (msgspec.DecodeError, ValueError) as error:
        raise ConfigError(f"plate standards {where}: {error}") from None
    for standard in file.standard:
        fault = _fault(standard)
        if fault:
            raise ConfigError(f"plate standard {standard.id!r} in {where}: {fault}")
    return file.standard


@lru_cache(maxsize=1)
def _all_standards() -> dict[str, PlateStandard]:
    found: dict[str, PlateStandard] = {}
    folder = resources.files("tmde_edge.plates") / "data"
    for item in sorted(folder.iterdir(), key=lambda f: f.name):
        if not item.name.endswith(".toml"):
            continue
        for standard in parse_standards(item.read_text(encoding="utf-8"), item.name):
            if standard.id in found:
                raise ConfigError(f"plate standard {standard.id!r} in {item.name}: the id is taken")
            found[standard.id] = standard
    return found


def load_standards() -> dict[str, PlateStandard]:
    """All standards that come with the program, by id."""
    return dict(_all_standards())


def select(expect: Sequence[str]) -> tuple[PlateStandard, ...]:
    """The standards that `plates.expect` names: ids, groups ("de-1line"), countries ("us", "de"), or "auto" for all.

    Order as named, each once. Raises ConfigError for an empty list or an unknown name, naming the nearest right one.
    """
    standards = _all_standards()
    if not expect:
        raise ConfigError('plates.expect is empty: name plate standards, for example ["us"], or ["auto"]')
    chosen: dict[str, PlateStandard] = {}
    for name in expect:
        key = name.strip().lower()
        hits = [s for s in standards.values() if key in _names(s)]
        if not hits:
            known = sorted({n for s in standards.values() for n in _names(s)})
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]!r}?" if near else "see `tmde-edge plates list`"
            raise ConfigError(f"plates.expect: unknown plate standard {name!r}; {hint}")
        chosen.update((s.id, s) for s in hits)
    return tuple(chosen.values())


def line_share(standards: Sequence[PlateStandard]) -> float:
    """Chance that a plate of one of these standards shows a printed line round it, by how common each is."""
    return sum(s.weight * s.line_share for s in standards) / sum(s.weight for s in standards)


def bolt_places(standards: Sequence[PlateStandard]) -> tuple[tuple[float, float], ...]:
    """Each (spacing of the bolts over the plate's width, its height over its width) that occurs in these standards."""
    found = set()
    for s in standards:
        outline = s.outline_belief()
        if s.hole_spacing is not None and outline is not None:
            (width, _), (height, _) = outline
            found.add((round(s.hole_spacing.belief("hole")[0] / width, 4), round(height / width, 4)))
    return tuple(sorted(found))


def _names(standard: PlateStandard) -> tuple[str, ...]:
    country = standard.country.lower()
    return (standard.id, *standard.groups, country, country.split("-")[0], "auto")


def _fault(standard: PlateStandard) -> str:
    """What is wrong beyond types, or ""."""
    if not standard.glyphs or not standard.char_counts or not standard.rows:
        return "needs glyphs, rows and char_counts"
    if sum(g.main for g in standard.glyphs.values()) != 1:
        return "needs exactly one main glyph class"
    unknown = set("".join(standard.rows)) - {" "} - set(standard.glyphs)
    if unknown:
        return f"rows use unknown glyph classes {sorted(unknown)}"
    used = sum(len(row.replace(" ", "")) for row in standard.rows)
    if used not in standard.char_counts:
        return f"rows hold {used} characters, which char_counts {list(standard.char_counts)} lacks"
    if standard.plate_width is None and standard.main_class.height is None:
        return "fixes neither a plate size nor a character height"
    if (standard.plate_width is None) != (standard.plate_height is None):
        return "needs both plate_width and plate_height, or neither"
    for ground in (standard.background, *standard.other_backgrounds):
        if ground not in BACKGROUNDS:
            return f"background {ground!r} is none of {', '.join(BACKGROUNDS)}"
    if any(v <= 0 for v in standard.other_backgrounds.values()) or sum(standard.other_backgrounds.values()) >= 1:
        return f"other_backgrounds {standard.other_backgrounds}: shares must be positive and leave some for the usual ground"
    if standard.weight <= 0:
        return "weight must be positive"
    for path, size in sizes(standard):
        numbers = [v for v in (size.min, size.mm, size.max) if v is not None]
        if not numbers or numbers != sorted(numbers) or not 0 < numbers[0] < 5000:
            return f"{path}: {numbers} is not min <= mm <= max in millimetres"
    return ""


def sizes(standard: PlateStandard) -> list[tuple[str, Size]]:
    """Every size of a standard with its path, for tables and checks."""
    found = [(f, v) for f in standard.__struct_fields__ if isinstance(v := getattr(standard, f), Size)]
    for key, glyph in standard.glyphs.items():
        found += [(f"glyphs.{key}.{f}", v) for f in glyph.__struct_fields__ if isinstance(v := getattr(glyph, f), Size)]
    return found
