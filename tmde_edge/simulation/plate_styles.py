"""Random plate faces in the manner of many jurisdictions: sizes near the standards', everything else invented."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tmde_edge.simulation.plate_face import Colour, FaceSpec, GlyphSpec, Mark

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
DIGITS = "0123456789"
WHITE: Colour = (238.0, 240.0, 240.0)
BLACK: Colour = (26.0, 24.0, 24.0)
EU_BLUE: Colour = (150.0, 62.0, 12.0)
YELLOW: Colour = (20.0, 190.0, 245.0)
_WORDS = (
    "SUNSHINE STATE",
    "GREAT LAKES",
    "LAND OF LINCOLN",
    "WILD WONDERFUL",
    "GOLDEN",
    "MOUNTAINS",
    "FIRST IN FLIGHT",
)
_STATES = (
    "MICHIGAN",
    "TEXAS",
    "OHIO",
    "NEW YORK",
    "FLORIDA",
    "ALBERTA",
    "QUEBEC",
    "SONORA",
    "UTAH",
    "VIRGINIA",
    "MAINE",
)


@dataclass(slots=True)
class _Face:
    """A face under construction."""

    width_mm: float
    height_mm: float
    background_bgr: Colour
    ink_bgr: Colour
    glyphs: list[GlyphSpec] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    border_mm: float = 0.0
    border_inset_mm: float = 0.0
    corner_radius_mm: float = 8.0
    border_bgr: Colour | None = None

    def mark(
        self,
        kind: str,
        left: float,
        top: float,
        width: float,
        height: float,
        colour: Colour,
        *,
        colour2: Colour | None = None,
        text: str = "",
        stroke: float = 0.0,
        radius: float = 0.0,
        opacity: float = 1.0,
        above: bool = False,
    ) -> None:
        """Add a mark; mm, plate frame."""
        self.marks.append(
            Mark(
                kind=kind,
                left_mm=left,
                top_mm=top,
                width_mm=width,
                height_mm=height,
                colour_bgr=colour,
                colour2_bgr=colour2,
                text=text,
                stroke_mm=stroke,
                corner_radius_mm=radius,
                opacity=opacity,
                above=above,
            )
        )

    def done(self) -> FaceSpec:
        """The finished description."""
        return FaceSpec(
            width_mm=self.width_mm,
            height_mm=self.height_mm,
            glyphs=tuple(self.glyphs),
            background_bgr=self.background_bgr,
            ink_bgr=self.ink_bgr,
            border_mm=self.border_mm,
            border_inset_mm=self.border_inset_mm,
            corner_radius_mm=self.corner_radius_mm,
            marks=tuple(self.marks),
            border_bgr=self.border_bgr,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Type:
    """Letter sizes of a row, mm."""

    height: float
    letter: float
    digit: float
    stroke: float
    gap: float
    group: float


def random_text(rng: np.random.Generator, pattern: str) -> str:
    """Fill a pattern: L letter, D digit, X either; anything else stays."""
    pools = {"L": LETTERS, "D": DIGITS, "X": LETTERS + DIGITS}
    return "".join(str(rng.choice(list(pools[c]))) if c in pools else c for c in pattern)


def random_spec(rng: np.random.Generator, style: str | None = None) -> FaceSpec:
    """A random face; style is a key of STYLES. Raises KeyError for an unknown one."""
    name = style if style is not None else str(rng.choice(list(STYLES), p=_SHARES))
    face = STYLES[name](rng)
    if rng.random() < 0.5:
        _screws(rng, face)
    return face.done()


def _u(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def _pick(rng: np.random.Generator, options: Sequence[str]) -> str:
    return options[int(rng.integers(len(options)))]


def _chance(rng: np.random.Generator, p: float) -> bool:
    return bool(rng.random() < p)


def _near(rng: np.random.Generator, colour: Colour, spread: float = 18.0) -> Colour:
    b, g, r = (float(np.clip(c + rng.normal(0, spread), 0, 255)) for c in colour)
    return b, g, r


def _dark(rng: np.random.Generator) -> Colour:
    options = (BLACK, BLACK, (110.0, 40.0, 20.0), (40.0, 90.0, 20.0), (40.0, 30.0, 140.0), (90.0, 20.0, 60.0))
    return _near(rng, options[int(rng.integers(len(options)))])


def _pale(rng: np.random.Generator) -> Colour:
    level = _u(rng, 150, 250)
    b, g, r = (float(np.clip(level + rng.normal(0, 30), 90, 255)) for _ in range(3))
    return b, g, r


def _row(
    rng: np.random.Generator,
    face: _Face,
    text: str,
    size: _Type,
    *,
    left: float,
    right: float,
    top: float,
    row: int = 0,
    align: str = "centre",
    hyphen: str = "none",
    counted: bool = True,
) -> tuple[float, float]:
    """Lay one row between left and right; narrower when it does not fit. Gives the ink's left and right edge.

    In text: blank a group gap, "-" the style's separator (hyphen "bar", "dot", "seal", "emblem"; "none": a gap),
    "_" half a group gap.
    """
    advance: list[tuple[str, float]] = []
    for char in text:
        if char == " ":
            advance.append((char, size.group))
        elif char == "_":
            advance.append((char, size.group * 0.5))
        elif char == "-":
            advance.append((char, {"bar": 15.0, "dot": 11.0, "seal": 34.0, "emblem": 30.0}.get(hyphen, size.group)))
        elif char == "I":
            advance.append((char, size.stroke if _chance(rng, 0.7) else 2.2 * size.stroke))
        elif char == "1":
            advance.append((char, max(size.digit * 0.55, 1.3 * size.stroke)))
        elif char in DIGITS:
            advance.append((char, size.digit))
        elif char in "MW" and _chance(rng, 0.5):
            advance.append((char, size.letter * 1.12))
        elif not char.isascii():
            advance.append((char, min(size.height * _u(rng, 0.7, 1.0), size.letter * 1.5)))
        else:
            advance.append((char, size.letter))
    total = sum(width for _, width in advance) + size.gap * (len(advance) - 1)
    room = right - left
    shrink = min(1.0, room / total)
    x = {"centre": (left + right - total * shrink) / 2, "left": left, "right": right - total * shrink}[align]
    first, last = x, x
    for char, width in advance:
        w = width * shrink
        if char == "-":
            _separator(rng, face, hyphen, x, w, top, size)
        elif char not in " _":
            face.glyphs.append(
                GlyphSpec(
                    char=char,
                    left_mm=x,
                    top_mm=top,
                    width_mm=w,
                    height_mm=size.height,
                    stroke_mm=min(size.stroke, 0.45 * w) if char not in "I1" else min(size.stroke, w),
                    counted=counted,
                    row=row,
                )
            )
            last = x + w
        x += w + size.gap * shrink
    return first, last


def _separator(
    rng: np.random.Generator, face: _Face, kind: str, x: float, width: float, top: float, size: _Type
) -> None:
    middle = top + size.height / 2
    if kind == "bar":
        face.mark("rect", x, middle - size.stroke / 2, width, size.stroke, face.ink_bgr)
    elif kind == "dot":
        face.mark("disc", x, middle - width / 2, width, width, face.ink_bgr)
    elif kind == "seal":
        d = width * 0.95
        for y in (middle - d * 1.1, middle + d * 0.1):
            colour = _near(rng, (60, 120, 60), 60)
            face.mark("disc", x, y, d, d, colour)
            face.mark("disc", x, y, d, d, _near(rng, (150, 150, 150), 50), stroke=d * 0.12)
            face.mark("rect", x + d * 0.3, y + d * 0.3, d * 0.4, d * 0.4, _near(rng, (120, 170, 200), 60))
    elif kind == "emblem":
        colour = _near(rng, face.ink_bgr, 60)
        for _ in range(int(rng.integers(1, 4))):
            w, h = width * _u(rng, 0.4, 1.0), size.height * _u(rng, 0.3, 0.8)
            kind2 = "disc" if _chance(rng, 0.5) else "rect"
            face.mark(
                kind2,
                x + (width - w) / 2,
                middle - h / 2,
                w,
                h,
                colour,
                opacity=_u(rng, 0.3, 0.9),
                stroke=0.0 if _chance(rng, 0.7) else 3.0,
            )


def _screws(rng: np.random.Generator, face: _Face) -> None:
    """Bolt heads or holes, two or four, anywhere that people put them."""
    dx = _u(rng, 0.25, 0.46) * face.width_mm
    dy = face.height_mm / 2 - _u(rng, 8, 16) if face.height_mm > 125 else _u(rng, -5, 5)
    d = _u(rng, 6, 13)
    colour = _near(rng, (120, 120, 120), 60) if _chance(rng, 0.6) else face.background_bgr
    for side_x in (-1, 1):
        for side_y in (-1, 1) if face.height_mm > 125 and _chance(rng, 0.5) else (-1,):
            face.mark("disc", side_x * dx - d / 2, side_y * dy - d / 2, d, d, _near(rng, colour, 8), above=True)
            if _chance(rng, 0.5):
                face.mark("disc", side_x * dx - d / 2, side_y * dy - d / 2, d, d, (60, 60, 60), stroke=1.0, above=True)


def _sticker(rng: np.random.Generator, face: _Face, left: float, top: float, width: float, height: float) -> None:
    colour = _near(rng, (120, 120, 120), 90)
    face.mark("rect", left, top, width, height, colour)
    text = _pick(rng, ("24", "25", "JUN", "12", "2026", "DEC", "07"))
    face.mark(
        "text",
        left + 0.1 * width,
        top + 0.25 * height,
        0.8 * width,
        0.5 * height,
        BLACK if sum(colour) > 360 else WHITE,
        text=text,
    )


def _us(rng: np.random.Generator) -> _Face:
    face = _Face(304.8, 152.4, _near(rng, WHITE, 10) if _chance(rng, 0.55) else _pale(rng), _dark(rng))
    if _chance(rng, 0.1):
        face.background_bgr, face.ink_bgr = _dark(rng), _near(rng, WHITE)
    w, h = face.width_mm, face.height_mm
    if _chance(rng, 0.45):  # a graphic sky
        face.mark("rect", -w / 2, -h / 2, w, h * _u(rng, 0.5, 1.0), _pale(rng), colour2=face.background_bgr)
    if _chance(rng, 0.3):  # hills, sun, fruit
        for _ in range(int(rng.integers(1, 5))):
            blob = _u(rng, 20, 160)
            face.mark(
                "disc" if _chance(rng, 0.7) else "rect",
                _u(rng, -w / 2, w / 2) - blob / 2,
                _u(rng, -10, h / 2),
                blob,
                blob * _u(rng, 0.3, 0.8),
                _pale(rng),
                opacity=_u(rng, 0.2, 0.7),
            )
    if _chance(rng, 0.35):
        band = _near(rng, _dark(rng), 40)
        face.mark("rect", -w / 2, -h / 2, w, _u(rng, 18, 34), band)
        if _chance(rng, 0.5):
            face.mark("rect", -w / 2, h / 2 - 26, w, 26, band if _chance(rng, 0.6) else _near(rng, _dark(rng), 40))
        name_colour = _near(rng, WHITE)
    else:
        name_colour = _near(rng, _dark(rng), 30)
    name = _pick(rng, _STATES)
    name_h = _u(rng, 12, 22)
    if _chance(rng, 0.92):
        wide = min(len(name) * name_h * _u(rng, 0.65, 1.1), 0.75 * w)
        face.mark(
            "text",
            -wide / 2,
            -h / 2 + _u(rng, 6, 10),
            wide,
            name_h,
            name_colour,
            text=name,
            stroke=name_h * _u(rng, 0.12, 0.22),
        )
    slogan = _pick(rng, (*_WORDS, "", "EXPLORE", "WWW.STATE.GOV", random_text(rng, "LLLLLL COUNTY")))
    if slogan and _chance(rng, 0.75):
        slogan_h = _u(rng, 7, 14)
        wide = min(len(slogan) * slogan_h * _u(rng, 0.6, 1.0), 0.72 * w)
        face.mark(
            "text",
            -wide / 2,
            h / 2 - slogan_h - _u(rng, 6, 10),
            wide,
            slogan_h,
            _near(rng, _dark(rng), 30) if sum(face.background_bgr) > 300 else _near(rng, WHITE),
            text=slogan,
        )
    for side_x in (-1, 1):
        for side_y in (-1, 1):
            if _chance(rng, 0.2):
                _sticker(rng, face, side_x * 130 - 16, side_y * 60 - 10 + _u(rng, -3, 3), 32, 20)
    height = _u(rng, 60, 76)
    size = _Type(
        height=height,
        letter=height * _u(rng, 0.42, 0.56),
        digit=height * _u(rng, 0.42, 0.54),
        stroke=_u(rng, 6, 10.5),
        gap=_u(rng, 4, 11),
        group=_u(rng, 8, 26),
    )
    pattern = _pick(
        rng,
        (
            "LLLDDDD",
            "LLL-DDDD",
            "LLL DDDD",
            "DLLLDDD",
            "LLLDDD",
            "LLL-DDD",
            "DDDLLL",
            "XXXXXXX",
            "LLL DDD",
            "DDD-LLL",
            "LLDDDDD",
            "XXXXXX",
            "XXXXX",
            "LDDLLL",
            "DDDDDDD",
            "LLLL DDD",
            "XXX XXX",
            "LL DDDDD",
            "DDD DDD",
            "LLLDLDD",
            "LLL-DDD-L",
            "XXXXXXXX",
            "DDDD",
        ),
    )
    left, right = -w / 2 + _u(rng, 8, 22), w / 2 - _u(rng, 8, 22)
    top = -height / 2 + _u(rng, -2, 8)
    if _chance(rng, 0.07):  # two small letters, stacked, before the number
        small = _Type(height=height * 0.44, letter=height * 0.3, digit=height * 0.3, stroke=5, gap=3, group=8)
        for k in range(2):
            _row(
                rng, face, random_text(rng, "L"), small, left=left, right=left + 24, top=top + k * height * 0.55, row=k
            )
        left += 32
        pattern = pattern[:6]
    _row(
        rng,
        face,
        random_text(rng, pattern),
        size,
        left=left,
        right=right,
        top=top,
        hyphen=_pick(rng, ("bar", "dot", "emblem", "emblem", "none")),
    )
    if _chance(rng, 0.5):
        face.border_mm, face.border_inset_mm = _u(rng, 1, 3), _u(rng, 0, 4)
        face.border_bgr = _near(rng, face.ink_bgr, 40) if _chance(rng, 0.5) else _near(rng, face.background_bgr, 30)
    face.corner_radius_mm = _u(rng, 8, 16)
    return face


def _stars(face: _Face, x: float, width: float, y: float) -> None:
    for k in range(12):
        angle = k * np.pi / 6
        face.mark(
            "disc",
            x + width / 2 + width * 0.3 * float(np.cos(angle)) - 2,
            y + width * 0.3 * float(np.sin(angle)) - 2,
            4,
            4,
            (0, 210, 250),
        )


def _bands(rng: np.random.Generator, face: _Face, code: str, *, right: bool = False) -> tuple[float, float]:
    """Blue band at the left (and right); gives the free space between."""
    w, h = face.width_mm, face.height_mm
    wide = _u(rng, 38, 46) if w > 400 else _u(rng, 32, 44)
    inset = face.border_inset_mm + face.border_mm if _chance(rng, 0.5) else 0.0
    blue = _near(rng, EU_BLUE, 14)
    face.mark("rect", -w / 2 + inset, -h / 2 + inset, wide, h - 2 * inset, blue)
    band_h = h if h < 130 else h / 2
    if _chance(rng, 0.85):
        _stars(face, -w / 2, wide, -h / 2 + band_h * 0.33)
    letter_h = _u(rng, 16, 24)
    text_w = min(wide * 0.7, letter_h * 0.8 * len(code))
    face.mark("text", -w / 2 + (wide - text_w) / 2, -h / 2 + band_h * 0.66, text_w, letter_h, WHITE, text=code)
    if right:
        face.mark("rect", w / 2 - wide - inset, -h / 2 + inset, wide, h - 2 * inset, blue)
        face.mark("disc", w / 2 - wide * 0.8, -h / 2 + h * 0.15, wide * 0.6, wide * 0.6, (0, 200, 240), stroke=3)
        face.mark(
            "text",
            w / 2 - wide * 0.8,
            -h / 2 + h * 0.68,
            wide * 0.6,
            17,
            WHITE,
            text=random_text(rng, "DD") if _chance(rng, 0.7) else random_text(rng, "LL"),
        )
    return -w / 2 + wide + inset, w / 2 - (wide if right else 0.0) - inset


_EU = {  # pattern options, separator, country letters, share of yellow, second band
    "D": (("LL-LL DDDD", "L-LL DDD", "LLL-L DDD", "L-L DDDD", "LL-L DDD", "LLL-LL DD"), "seal", "D", 0.0, False),
    "NL": (("LL-DDD-L", "DD-LLL-D", "L-DDD-LL", "DD-LL-LL", "LL-LL-DD"), "bar", "NL", 0.95, False),
    "F": (("LL-DDD-LL",), "bar", "F", 0.02, True),
    "I": (("LL DDDLL", "LLDDDLL"), "none", "I", 0.0, True),
    "PL": (("LLL DDDDD", "LL DDDDD", "LLL LLDD", "LL DDDDL", "LL-DDDDD"), "emblem", "PL", 0.0, False),
    "RO": (("L DDD LLL", "LL DD LLL", "L DD LLL"), "none", "RO", 0.0, False),
    "CZ": (("DLD-DDDD", "DLD DDDD"), "seal", "CZ", 0.0, False),
    "E": (("DDDD LLL",), "none", "E", 0.0, False),
    "A": (("L-DDDDDL", "LL-DDD LL", "L-DDDD L"), "emblem", "A", 0.0, False),
    "B": (("D-LLL-DDD",), "bar", "B", 0.0, False),
    "H": (("LLL-DDD", "LL-LL DDD"), "bar", "H", 0.0, False),
    "S": (("LLL DDD", "LLL DDL"), "none", "S", 0.0, False),
    "FIN": (("LLL-DDD",), "bar", "FIN", 0.0, False),
    "P": (("LL-DD-LL", "DD-LL-DD"), "bar", "P", 0.0, True),
    "BG": (("LL DDDD LL", "L DDDD LL"), "none", "BG", 0.0, False),
    "SK": (("LL-DDDLL",), "seal", "SK", 0.0, False),
    "UA": (("LL DDDD LL",), "none", "UA", 0.0, False),
    "GR": (("LLL-DDDD",), "bar", "GR", 0.0, False),
    "LT": (("LLL DDD", "LLL-DDD"), "emblem", "LT", 0.0, False),
}


def _eu_type(rng: np.random.Generator) -> _Type:
    height = _u(rng, 69, 81)
    return _Type(
        height=height,
        letter=_u(rng, 38, 50),
        digit=_u(rng, 37, 47),
        stroke=_u(rng, 8, 12),
        gap=_u(rng, 5, 13),
        group=_u(rng, 14, 36),
    )


def _eu_face(rng: np.random.Generator, width: float, height: float, yellow: float) -> _Face:
    face = _Face(width, height, _near(rng, YELLOW if _chance(rng, yellow) else WHITE, 9), _near(rng, BLACK, 9))
    if _chance(rng, 0.1):
        face.ink_bgr = _near(rng, (40, 110, 30) if _chance(rng, 0.5) else (40, 30, 170))
    face.corner_radius_mm = _u(rng, 4, 11)
    if _chance(rng, 0.6):
        face.border_mm, face.border_inset_mm = _u(rng, 1.5, 4.5), _u(rng, 0, 3.5)
        if _chance(rng, 0.25):
            face.border_bgr = _near(rng, (160, 160, 160), 30)
    return face


def _eu1(rng: np.random.Generator) -> _Face:
    patterns, hyphen, code, yellow, second = _EU[_pick(rng, list(_EU))]
    if _chance(rng, 0.12):
        hyphen = _pick(rng, ("none", "bar", "dot", "emblem"))
    face = _eu_face(rng, 520 if _chance(rng, 0.8) else _u(rng, 440, 525), _u(rng, 108, 114), max(yellow, 0.05))
    left, right = _bands(rng, face, code, right=second and _chance(rng, 0.9))
    if _chance(rng, 0.06):  # no band at all: older plates
        face.marks.clear()
        left, right = -face.width_mm / 2, face.width_mm / 2
    size = _eu_type(rng)
    _row(
        rng,
        face,
        random_text(rng, _pick(rng, patterns)),
        size,
        left=left + _u(rng, 6, 16),
        right=right - _u(rng, 6, 16),
        top=-size.height / 2 + _u(rng, -3, 3),
        hyphen=hyphen,
        align=_pick(rng, ("centre", "centre", "left")),
    )
    return face


def _eu2(rng: np.random.Generator) -> _Face:
    width, height = [(340, 200), (340, 220), (275, 200), (305, 214), (280, 200), (340, 200), (297, 210)][
        rng.integers(7)
    ]
    _, hyphen, code, yellow, _second = _EU[_pick(rng, list(_EU))]
    face = _eu_face(rng, width, height, max(yellow, 0.1))
    left, right = _bands(rng, face, code)
    size = _eu_type(rng)
    gap_mid = (height - 2 * size.height) / 3
    tops = (-height / 2 + gap_mid + _u(rng, -3, 3), height / 2 - size.height - gap_mid + _u(rng, -3, 3))
    patterns = _pick(
        rng,
        (
            "LL|DDD LL",
            "LLL|DDDDD",
            "DDDD|LLL",
            "L-LL|DDDD",
            "LL-DDD|LL",
            "LL|DDDLL",
            "LLDD|LLL",
            "L DD|LLL",
            "LL DD|LLL",
            "LL-|LL DDD",
            "LLLL|DDD",
        ),
    ).split("|")
    free = left + _u(rng, 6, 14)
    for row, (pattern, top) in enumerate(zip(patterns, tops, strict=True)):
        start = free if row == 0 or _chance(rng, 0.4) else -width / 2 + _u(rng, 10, 20)
        _row(
            rng,
            face,
            random_text(rng, pattern),
            size,
            left=start,
            right=right - _u(rng, 8, 16),
            top=top,
            row=row,
            hyphen=hyphen,
        )
    if start < left and face.marks:  # the band ends above the second row
        face.marks[0] = Mark(
            kind="rect",
            left_mm=-width / 2,
            top_mm=-height / 2,
            width_mm=left + width / 2,
            height_mm=height / 2 - 2,
            colour_bgr=face.marks[0].colour_bgr,
        )
    return face


def _gb(rng: np.random.Generator) -> _Face:
    two = _chance(rng, 0.12)
    face = _Face(
        285 if two else 520,
        203 if two else 111,
        _near(rng, YELLOW if _chance(rng, 0.5) else WHITE, 9),
        _near(rng, BLACK, 8),
        corner_radius_mm=_u(rng, 4, 12),
    )
    if _chance(rng, 0.12):  # before 1973
        face.background_bgr, face.ink_bgr = _near(rng, BLACK, 8), _near(rng, (190, 195, 200), 25)
    left, right = -face.width_mm / 2, face.width_mm / 2
    if not two and _chance(rng, 0.35):
        left, right = _bands(rng, face, _pick(rng, ("GB", "UK")))
    height = _u(rng, 77, 81)
    size = _Type(
        height=height,
        letter=_u(rng, 46, 56),
        digit=_u(rng, 46, 54),
        stroke=_u(rng, 12, 15.5),
        gap=_u(rng, 9, 12.5),
        group=_u(rng, 26, 36),
    )
    text = random_text(
        rng, _pick(rng, ("LLDD|LLL", "LLDD|LLL", "LDDD|LLL", "LLL|DDDL", "LLL|DDD", "L|LLL", "DD|LL", "DDDD|LL"))
    )
    if _chance(rng, 0.6):  # the maker's name below
        word = _pick(rng, ("MOTORS LTD", "WWW.DEALER.CO.UK", "AUTO SALES 01234"))
        wide = _u(rng, 60, 180)
        face.mark("text", -wide / 2, face.height_mm / 2 - 9.5, wide, _u(rng, 4, 6.5), face.ink_bgr, text=word)
    if two:
        for row, part in enumerate(text.split("|")):
            _row(
                rng,
                face,
                part,
                size,
                left=left + 10,
                right=right - 10,
                row=row,
                top=-size.height - 9.5 if row == 0 else 9.5,
            )
    else:
        _row(rng, face, text.replace("|", " "), size, left=left + 9, right=right - 9, top=-height / 2 + _u(rng, -4, 1))
    return face


def _ru(rng: np.random.Generator) -> _Face:
    face = _Face(
        520,
        112,
        _near(rng, WHITE, 9),
        _near(rng, BLACK, 9),
        corner_radius_mm=10,
        border_mm=_u(rng, 2, 5),
        border_inset_mm=_u(rng, 0, 3),
    )
    pool = list("ABEKMHOPCTYX")
    big = _Type(
        height=_u(rng, 74, 78),
        letter=50,
        digit=_u(rng, 44, 54),
        stroke=_u(rng, 10.5, 12.5),
        gap=_u(rng, 5, 11),
        group=14,
    )
    small = _Type(
        height=big.height * 58 / 76 * _u(rng, 0.97, 1.03),
        letter=_u(rng, 44, 54),
        digit=40,
        stroke=_u(rng, 9, 11),
        gap=big.gap,
        group=12,
    )
    base = big.height / 2 + _u(rng, -1, 4)
    split = 260 - _u(rng, 128, 142)
    letters = [str(rng.choice(pool)) for _ in range(3)]
    left = -260 + _u(rng, 22, 34)
    _, x = _row(
        rng, face, letters[0], small, left=left, right=left + small.letter, top=base - small.height, align="left"
    )
    _, x = _row(
        rng,
        face,
        random_text(rng, "DDD"),
        big,
        left=x + big.gap + _u(rng, 4, 12),
        right=split,
        top=base - big.height,
        align="left",
    )
    room = split - _u(rng, 8, 14)
    _row(
        rng,
        face,
        "".join(letters[1:]),
        small,
        left=x + big.gap + _u(rng, 4, 10),
        right=room,
        top=base - small.height,
        align="left",
    )
    face.mark("line", split, -56, 0, 112, face.ink_bgr, stroke=_u(rng, 2, 4))
    region_h = _u(rng, 52, 60)
    region = _Type(
        height=region_h, letter=40, digit=_u(rng, 30, 38), stroke=_u(rng, 8, 10), gap=_u(rng, 4, 8), group=10
    )
    _row(
        rng,
        face,
        random_text(rng, "DD" if _chance(rng, 0.5) else "DDD"),
        region,
        left=split + 8,
        right=260 - 9,
        top=-56 + _u(rng, 8, 13),
    )
    face.mark("text", split + _u(rng, 12, 26), 56 - 20 - _u(rng, 9, 12), 52, 20, face.ink_bgr, text="RUS", stroke=4)
    if _chance(rng, 0.85):
        for k, colour in enumerate(((235, 235, 235), (180, 60, 20), (40, 30, 200))):
            face.mark("rect", 260 - 48, 56 - 31 + k * 6.7, 34, 6.7, colour)
        face.mark("rect", 260 - 48, 56 - 31, 34, 20, face.ink_bgr, stroke=1)
    if _chance(rng, 0.6):
        for x in (-260 + 12, split - 2 + 135 - 16):
            face.mark("disc", x, -3, 8, 8, (90, 90, 90), above=True)
    return face


def _cn(rng: np.random.Generator) -> _Face:
    green = _chance(rng, 0.35)
    face = _Face(
        480 if green else 440,
        140,
        _near(rng, (150, 60, 10), 14),
        _near(rng, WHITE, 8),
        border_mm=_u(rng, 2, 4),
        border_inset_mm=_u(rng, 3, 7),
        corner_radius_mm=10,
    )
    if green:
        face.ink_bgr = _near(rng, BLACK)
        face.mark("rect", -240, -70, 480, 140, _near(rng, (225, 240, 225), 8), colour2=_near(rng, (100, 190, 70), 15))
    elif _chance(rng, 0.2):
        face.background_bgr, face.ink_bgr = _near(rng, YELLOW), _near(rng, BLACK)
    size = _Type(
        height=_u(rng, 87, 92),
        letter=_u(rng, 42, 46),
        digit=_u(rng, 42, 46),
        stroke=_u(rng, 9, 12),
        gap=_u(rng, 9, 13),
        group=20,
    )
    text = _pick(rng, "京沪粤苏浙鲁川渝津冀豫云辽黑湘皖") + random_text(rng, "L-XXXXXX" if green else "L-XXXXX")
    _row(
        rng,
        face,
        text,
        size,
        left=-face.width_mm / 2 + 12,
        right=face.width_mm / 2 - 12,
        top=-size.height / 2,
        hyphen="dot" if not green else "none",
    )
    return face


def _jp(rng: np.random.Generator) -> _Face:
    face = _Face(330, 165, _near(rng, WHITE, 8), _near(rng, (50, 85, 20), 12), corner_radius_mm=12)
    kind = rng.random()
    if kind < 0.3:
        face.background_bgr, face.ink_bgr = _near(rng, (30, 200, 245), 12), _near(rng, BLACK)
    elif kind < 0.4:
        face.background_bgr, face.ink_bgr = face.ink_bgr, face.background_bgr
    small = _Type(height=_u(rng, 36, 42), letter=34, digit=_u(rng, 22, 30), stroke=5, gap=6, group=12)
    _row(
        rng,
        face,
        _pick(rng, ("品川", "横浜", "大阪", "名古屋", "札幌")) + " " + random_text(rng, "DDD"),
        small,
        left=-90,
        right=100,
        top=-82.5 + _u(rng, 10, 15),
    )
    big = _Type(
        height=_u(rng, 78, 82), letter=40, digit=_u(rng, 38, 43), stroke=_u(rng, 10, 13), gap=_u(rng, 9, 14), group=16
    )
    top = 82.5 - big.height - _u(rng, 10, 16)
    _row(rng, face, random_text(rng, "DD-DD"), big, left=-95, right=152, top=top, row=1, hyphen="bar")
    kana = _Type(height=_u(rng, 36, 42), letter=30, digit=26, stroke=5, gap=6, group=8)
    _row(rng, face, _pick(rng, "あいうえかきくけさすせそ"), kana, left=-150, right=-105, top=top + 20, row=1)
    return face


def _kr(rng: np.random.Generator) -> _Face:
    long = _chance(rng, 0.7)
    face = _Face(
        520 if long else 335, 110 if long else 155, _near(rng, WHITE, 8), _near(rng, BLACK, 8), corner_radius_mm=10
    )
    kind = rng.random()
    if kind < 0.2:
        face.background_bgr = _near(rng, (235, 190, 120), 10)
    elif kind < 0.35:
        face.background_bgr = _near(rng, YELLOW, 10)
    elif kind < 0.45:
        face.background_bgr, face.ink_bgr = _near(rng, (60, 100, 20)), _near(rng, WHITE)
    left = -face.width_mm / 2 + 12
    if long and _chance(rng, 0.5):
        face.mark("rect", -260, -55, 55, 110, _near(rng, (190, 90, 30)))
        face.mark("text", -255, 20, 40, 18, WHITE, text="KOR")
        left += 50
    size = _Type(
        height=_u(rng, 80, 87), letter=60, digit=_u(rng, 40, 48), stroke=_u(rng, 9, 12), gap=_u(rng, 6, 11), group=20
    )
    _row(
        rng,
        face,
        random_text(rng, "DDD" if _chance(rng, 0.6) else "DD")
        + _pick(rng, "가나다라마거너더러머고노도")
        + "_"
        + random_text(rng, "DDDD"),
        size,
        left=left,
        right=face.width_mm / 2 - 12,
        top=-size.height / 2,
    )
    if _chance(rng, 0.5):
        face.border_mm, face.border_inset_mm = 3, _u(rng, 1, 4)
    return face


def _in(rng: np.random.Generator) -> _Face:
    two = _chance(rng, 0.3)
    face = _Face(
        340 if two else 500,
        200 if two else 120,
        _near(rng, YELLOW if _chance(rng, 0.25) else WHITE, 9),
        _near(rng, BLACK),
    )
    left = -face.width_mm / 2 + 14
    if _chance(rng, 0.6):
        face.mark("text", left, 8, 28, 14, EU_BLUE, text="IND")
        face.mark("disc", left + 2, -24, 22, 22, _near(rng, (160, 120, 60)))
        left += 36
    face.border_mm, face.border_inset_mm = (_u(rng, 1.5, 3), _u(rng, 2, 5)) if _chance(rng, 0.7) else (0.0, 0.0)
    size = _Type(
        height=_u(rng, 60, 70),
        letter=_u(rng, 32, 42),
        digit=_u(rng, 32, 40),
        stroke=_u(rng, 8, 11),
        gap=_u(rng, 5, 10),
        group=_u(rng, 8, 18),
    )
    parts = (random_text(rng, "LLDD"), random_text(rng, _pick(rng, ("LLDDDD", "LDDDD"))))
    if two:
        for row, part in enumerate(parts):
            _row(rng, face, part, size, left=left, right=156, top=-82 if row == 0 else 14, row=row)
    else:
        _row(rng, face, " ".join(parts), size, left=left, right=236, top=-size.height / 2 + _u(rng, -3, 3))
    return face


def _br(rng: np.random.Generator) -> _Face:
    face = _Face(400 if _chance(rng, 0.8) else _u(rng, 340, 400), 130, _near(rng, WHITE, 8), _near(rng, BLACK, 8))
    w = face.width_mm
    if _chance(rng, 0.75):
        band = _u(rng, 28, 32)
        face.mark("rect", -w / 2 + 4, -61, w - 8, band, _near(rng, EU_BLUE, 14))
        face.mark(
            "text", -55, -61 + band * 0.22, 110, band * 0.55, WHITE, text=_pick(rng, ("BRASIL", "ARGENTINA", "URUGUAY"))
        )
        face.mark("rect", w / 2 - 44, -61 + band * 0.15, 30, band * 0.6, (80, 160, 40))
        face.mark("text", -w / 2 + 10, 35, 14, 16, face.ink_bgr, text="BR")
        top = -61 + band + _u(rng, 6, 12)
        text = random_text(rng, _pick(rng, ("LLLDLDD", "LL DDD LL", "LLLDDDD")))
        face.border_mm = _u(rng, 1, 3)
    else:  # the older grey one with the town above
        face.background_bgr = _near(rng, (175, 175, 175), 15)
        face.mark("text", -60, -57, 120, 18, face.ink_bgr, text="SP SAO PAULO")
        top, text = -28.0, random_text(rng, "LLL-DDDD")
    size = _Type(
        height=_u(rng, 62, 67),
        letter=_u(rng, 36, 44),
        digit=_u(rng, 35, 42),
        stroke=_u(rng, 8, 10.5),
        gap=_u(rng, 6, 10),
        group=_u(rng, 12, 22),
    )
    _row(rng, face, text, size, left=-w / 2 + 28, right=w / 2 - 14, top=top, hyphen=_pick(rng, ("bar", "dot")))
    return face


def _au(rng: np.random.Generator) -> _Face:
    slim = _chance(rng, 0.25)
    face = _Face(520 if slim else 372, 110 if slim else 134, _near(rng, WHITE, 8), _dark(rng))
    if _chance(rng, 0.35):
        face.background_bgr = _near(rng, YELLOW)
    elif _chance(rng, 0.3):
        face.background_bgr, face.ink_bgr = face.ink_bgr, _near(rng, WHITE)
    size = _Type(
        height=_u(rng, 72, 83),
        letter=_u(rng, 38, 48),
        digit=_u(rng, 38, 46),
        stroke=_u(rng, 8, 11),
        gap=_u(rng, 6, 10),
        group=_u(rng, 14, 30),
    )
    top = -size.height / 2 + (0 if slim else _u(rng, -10, 8))
    text = random_text(rng, _pick(rng, ("LLL-DDD", "LL-DD-LL", "DLL DLL", "LLL DDL", "DDD-LLL", "LDDD-LLL", "XXXXXX")))
    _row(
        rng,
        face,
        text,
        size,
        left=-face.width_mm / 2 + 12,
        right=face.width_mm / 2 - 12,
        top=top,
        hyphen=_pick(rng, ("dot", "bar", "emblem", "none")),
    )
    if not slim and _chance(rng, 0.8):
        name = _pick(rng, ("VICTORIA", "QUEENSLAND", "NEW SOUTH WALES", "SUNSHINE STATE", "GARDEN STATE"))
        y = 67 - 18 if top < -size.height / 2 else -67 + 6
        face.mark("text", -70, y, 140, 12, face.ink_bgr, text=name)
    if _chance(rng, 0.4):
        face.border_mm, face.border_inset_mm = _u(rng, 1, 3), _u(rng, 1, 4)
    return face


def _any(rng: np.random.Generator) -> _Face:
    """What no list has: other proportions, both polarities, vanity numbers, foreign letters."""
    width = _u(rng, 250, 540)
    height = float(np.clip(width / _u(rng, 1.7, 4.9), 95, 190))
    face = _Face(
        width,
        height,
        _pale(rng) if _chance(rng, 0.5) else _near(rng, WHITE, 9),
        _dark(rng),
        corner_radius_mm=_u(rng, 0, 16),
    )
    if _chance(rng, 0.45):
        face.background_bgr, face.ink_bgr = _near(rng, _dark(rng)), _near(rng, WHITE if _chance(rng, 0.7) else YELLOW)
    glyph_h = height * _u(rng, 0.45, 0.76)
    size = _Type(
        height=glyph_h,
        letter=glyph_h * _u(rng, 0.42, 0.72),
        digit=glyph_h * _u(rng, 0.42, 0.68),
        stroke=glyph_h * _u(rng, 0.08, 0.19),
        gap=glyph_h * _u(rng, 0.06, 0.18),
        group=glyph_h * _u(rng, 0.15, 0.5),
    )
    left, right = -width / 2 + _u(rng, 8, 20), width / 2 - _u(rng, 8, 20)
    if _chance(rng, 0.35) and width > 400:
        left, right = _bands(rng, face, random_text(rng, _pick(rng, ("L", "LL", "LLL"))), right=_chance(rng, 0.2))
        left, right = left + 8, right - 8
    text = random_text(
        rng,
        _pick(
            rng,
            (
                "LLLDDD",
                "LLL-DDDD",
                "DDDDDD",
                "DD-DDD-DD",
                "DDD-DD-DDD",
                "LL DD LL LL",
                "LLL DDD LL",
                "LDDDD",
                "XXXXXX",
                "LL-DDDD",
                "LL DDDDDD",
                "DDDDD",
                "DDDDDDD",
                "LLL DDDL",
                "LLLDDDDL",
            ),
        ),
    )
    free = (height - glyph_h) / 2
    shift = _u(rng, -0.5, 0.5) * free
    _row(
        rng,
        face,
        text,
        size,
        left=left,
        right=right,
        top=-glyph_h / 2 + shift,
        hyphen=_pick(rng, ("bar", "dot", "emblem", "none", "seal")),
    )
    small = free - abs(shift)
    if small > 10 and _chance(rng, 0.5):
        side = -1 if shift > 0 else 1
        y = -height / 2 + 4 if side < 0 else height / 2 - 4 - min(small, 16)
        face.mark(
            "text", -width / 4, y, width / 2, min(small, 16) * 0.8, face.ink_bgr, text=_pick(rng, (*_STATES, *_WORDS))
        )
    if _chance(rng, 0.5):
        face.border_mm, face.border_inset_mm = _u(rng, 1, 4), _u(rng, 0, 4)
    return face


STYLES: dict[str, Callable[[np.random.Generator], _Face]] = {
    "us": _us,
    "eu1": _eu1,
    "eu2": _eu2,
    "gb": _gb,
    "ru": _ru,
    "cn": _cn,
    "jp": _jp,
    "kr": _kr,
    "in": _in,
    "br": _br,
    "au": _au,
    "any": _any,
}
_SHARES = (0.30, 0.25, 0.06, 0.06, 0.08, 0.03, 0.02, 0.03, 0.03, 0.04, 0.04, 0.06)
