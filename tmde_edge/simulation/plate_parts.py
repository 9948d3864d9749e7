"""What plate faces are put together from: rows of characters, bands, seals, screws, stickers, colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tmde_edge.simulation.plate_face import Colour, FaceSpec, GlyphSpec, Mark

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"

DIGITS = "0123456789"

WHITE: Colour = (238.0, 240.0, 240.0)

BLACK: Colour = (26.0, 24.0, 24.0)

EU_BLUE: Colour = (150.0, 62.0, 12.0)

YELLOW: Colour = (20.0, 190.0, 245.0)

SLOGANS = (
    "SUNSHINE STATE",
    "GREAT LAKES",
    "LAND OF LINCOLN",
    "WILD WONDERFUL",
    "GOLDEN",
    "MOUNTAINS",
    "FIRST IN FLIGHT",
)

STATES = (
    "ALABAMA", "ALASKA", "ARIZONA", "ARKANSAS", "CALIFORNIA", "COLORADO", "CONNECTICUT", "DELAWARE", "FLORIDA",
    "GEORGIA", "HAWAII", "IDAHO", "ILLINOIS", "INDIANA", "IOWA", "KANSAS", "KENTUCKY", "LOUISIANA", "MAINE",
    "MARYLAND", "MASSACHUSETTS", "MICHIGAN", "MINNESOTA", "MISSISSIPPI", "MISSOURI", "MONTANA", "NEBRASKA",
    "NEVADA", "NEW HAMPSHIRE", "NEW JERSEY", "NEW MEXICO", "NEW YORK", "NORTH CAROLINA", "NORTH DAKOTA", "OHIO",
    "OKLAHOMA", "OREGON", "PENNSYLVANIA", "RHODE ISLAND", "SOUTH CAROLINA", "SOUTH DAKOTA", "TENNESSEE", "TEXAS",
    "UTAH", "VERMONT", "VIRGINIA", "WASHINGTON", "WEST VIRGINIA", "WISCONSIN", "WYOMING", "ALBERTA", "QUEBEC",
    "ONTARIO", "SONORA", "JALISCO",
)  # fmt: skip


@dataclass(slots=True)
class Face:
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
        points: tuple[tuple[float, float], ...] = (),
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
                points=points,
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


_SEPARATOR_MM = {
    "bar": 15.0, "dot": 11.0, "seal": 34.0, "emblem": 30.0, "tab": 30.0, "shape": 26.0, "shield": 32.0, "picture": 30.0,
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Type:
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


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def pick(rng: np.random.Generator, options: Sequence[str]) -> str:
    return options[int(rng.integers(len(options)))]


def chance(rng: np.random.Generator, p: float) -> bool:
    return bool(rng.random() < p)


def near(rng: np.random.Generator, colour: Colour, spread: float = 18.0) -> Colour:
    b, g, r = (float(np.clip(c + rng.normal(0, spread), 0, 255)) for c in colour)
    return b, g, r


def dark(rng: np.random.Generator) -> Colour:
    options = (BLACK, BLACK, (110.0, 40.0, 20.0), (40.0, 90.0, 20.0), (40.0, 30.0, 140.0), (90.0, 20.0, 60.0))
    return near(rng, options[int(rng.integers(len(options)))])


def pale(rng: np.random.Generator) -> Colour:
    level = uniform(rng, 150, 250)
    b, g, r = (float(np.clip(level + rng.normal(0, 30), 90, 255)) for _ in range(3))
    return b, g, r


def row_of(
    rng: np.random.Generator,
    face: Face,
    text: str,
    size: Type,
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
            advance.append((char, _SEPARATOR_MM.get(hyphen, size.group)))
        elif char == "I":
            advance.append((char, size.stroke if chance(rng, 0.7) else 2.2 * size.stroke))
        elif char == "1":
            advance.append((char, max(size.digit * 0.55, 1.3 * size.stroke)))
        elif char in DIGITS:
            advance.append((char, size.digit))
        elif char in "MW" and chance(rng, 0.5):
            advance.append((char, size.letter * 1.12))
        elif not char.isascii():
            advance.append((char, min(size.height * uniform(rng, 0.7, 1.0), size.letter * 1.5)))
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


def _separator(rng: np.random.Generator, face: Face, kind: str, x: float, width: float, top: float, size: Type) -> None:
    middle = top + size.height / 2
    if kind == "bar":
        face.mark("rect", x, middle - size.stroke / 2, width, size.stroke, face.ink_bgr)
    elif kind == "dot":
        face.mark("disc", x, middle - width / 2, width, width, face.ink_bgr)
    elif kind == "seal":
        seals(rng, face, x, width, middle, size)
    elif kind == "tab":  # a renewal sticker between the groups, as tall as half a character or more
        h = size.height * uniform(rng, 0.4, 0.85)
        sticker(rng, face, x + width * 0.08, middle - h / 2 + size.height * uniform(rng, -0.08, 0.08), width * 0.84, h)
    elif kind == "shape":  # the outline of a state, a star, a cross: an irregular blob in ink
        blob(rng, face, x + width / 2, middle, width * uniform(rng, 0.5, 1.0), size.height * uniform(rng, 0.25, 0.6))
    elif kind == "shield":
        h = min(size.height * uniform(rng, 0.4, 0.75), width * 1.35)
        shield(rng, face, x + width * 0.08, middle - h / 2 + size.height * uniform(rng, -0.1, 0.1), width * 0.84, h)
    elif kind == "picture":  # a fruit, a mountain, a bird: it may lie under the neighbouring characters
        wide, tall = max(width, 18.0) * uniform(rng, 0.9, 2.0), size.height * uniform(rng, 0.6, 1.3)
        picture(rng, face, x + width / 2 - wide / 2, middle - tall / 2, wide, tall)
    elif kind == "emblem":
        colour = near(rng, face.ink_bgr, 60)
        for _ in range(int(rng.integers(1, 4))):
            w, h = width * uniform(rng, 0.4, 1.0), size.height * uniform(rng, 0.3, 0.8)
            kind2 = "disc" if chance(rng, 0.5) else "rect"
            face.mark(
                kind2,
                x + (width - w) / 2,
                middle - h / 2,
                w,
                h,
                colour,
                opacity=uniform(rng, 0.3, 0.9),
                stroke=0.0 if chance(rng, 0.7) else 3.0,
            )


def seals(rng: np.random.Generator, face: Face, x: float, width: float, middle: float, size: Type) -> None:
    """One or two round or hexagonal seals one above the other, of any colour, sometimes with a dash between them."""
    d = min(width * uniform(rng, 0.45, 0.98), size.height * 0.48)
    gap = uniform(rng, 0.05, 0.25) * d
    rows = [middle - d - gap / 2, middle + gap / 2]
    if chance(rng, 0.35):
        face.mark("rect", x, middle - size.stroke / 2, width, size.stroke, face.ink_bgr)
        rows = [middle - d - size.stroke, middle + size.stroke] if chance(rng, 0.6) else [middle - d - size.stroke]
    elif chance(rng, 0.3):
        rows = rows[:1] if chance(rng, 0.5) else [middle - d / 2]
    left = x + (width - d) / 2
    for y in rows:
        figure = "disc" if chance(rng, 0.8) else "rect"
        colour = near(rng, pick_colour(rng), 40)
        face.mark(figure, left, y, d, d, colour)
        if chance(rng, 0.6):
            face.mark(figure, left, y, d, d, near(rng, (150, 150, 150), 70), stroke=d * uniform(rng, 0.06, 0.16))
        core = uniform(rng, 0.2, 0.6)
        face.mark(
            "disc" if chance(rng, 0.4) else "rect",
            left + d * (1 - core) / 2,
            y + d * (1 - core) / 2,
            d * core,
            d * core,
            near(rng, pick_colour(rng), 50),
        )


def pick_colour(rng: np.random.Generator) -> Colour:
    """What seals and stickers are printed in."""
    options = ((40, 40, 200), (190, 90, 30), (60, 150, 60), (30, 140, 240), (40, 200, 230), (235, 235, 235), (60, 60, 60))
    return options[int(rng.integers(len(options)))]


def crest(rng: np.random.Generator, face: Face, code: str, size: Type) -> float:
    """A shield with the country's letters below it at the left, without a band; where the characters may begin (mm)."""
    left = -face.width_mm / 2 + uniform(rng, 8, 16)
    wide = uniform(rng, 24, 38)
    top = -size.height / 2 + uniform(rng, -4, 6)
    shield_h = min(size.height * uniform(rng, 0.4, 0.62), 1.4 * wide)
    shield(rng, face, left, top, wide, shield_h)
    letters_h = size.height * uniform(rng, 0.25, 0.36)
    stroke = letters_h * uniform(rng, 0.12, 0.2)
    face.mark("text", left, size.height / 2 - letters_h, wide, letters_h, face.ink_bgr, text=code, stroke=stroke)
    return left + wide


def shield(rng: np.random.Generator, face: Face, left: float, top: float, width: float, height: float) -> None:
    """A coat of arms: flat above, pointed or round below, one or more figures or fields in it."""
    rim = near(rng, pick_colour(rng), 40)
    inner = near(rng, pick_colour(rng), 40)
    waist = uniform(rng, 0.45, 0.75)
    outline = ((0.0, 0.0), (1.0, 0.0), (1.0, waist), (0.85, 0.5 + waist / 2), (0.5, 1.0), (0.15, 0.5 + waist / 2), (0.0, waist))
    face.mark("poly", left, top, width, height, rim, points=outline)
    edge = uniform(rng, 0.04, 0.14)
    w, h = width * (1 - 2 * edge), height * (1 - 2 * edge)
    face.mark("poly", left + width * edge, top + height * edge, w, h, inner, points=outline)
    for _ in range(int(rng.integers(0, 3))):
        kind = "disc" if chance(rng, 0.4) else "rect"
        fw, fh = w * uniform(rng, 0.2, 0.7), h * uniform(rng, 0.1, 0.45)
        x = left + width / 2 - fw / 2 + uniform(rng, -0.1, 0.1) * w
        face.mark(kind, x, top + uniform(rng, 0.1, 0.55) * h, fw, fh, near(rng, pick_colour(rng), 50))


def picture(rng: np.random.Generator, face: Face, left: float, top: float, width: float, height: float) -> None:
    """A printed picture: jagged polygons and discs of some colours that are never quite the ink's."""
    for _ in range(int(rng.integers(1, 5))):
        level = uniform(rng, 0.25, 0.85)
        tone = near(rng, pick_colour(rng) if chance(rng, 0.6) else face.ink_bgr, 50)
        b, g, r = (level * p + (1 - level) * q for p, q in zip(face.background_bgr, tone, strict=True))
        w, h = width * uniform(rng, 0.3, 1.0), height * uniform(rng, 0.3, 1.0)
        x, y = left + uniform(rng, 0, 1) * (width - w), top + uniform(rng, 0, 1) * (height - h)
        if chance(rng, 0.3):
            face.mark("disc", x, y, w, h, (b, g, r))
            continue
        n = int(rng.integers(4, 12))
        angles = np.sort(rng.uniform(0, 2 * np.pi, n))
        reach = rng.uniform(0.15 if chance(rng, 0.4) else 0.3, 0.5, n)
        points = tuple((0.5 + float(q * np.cos(a)), 0.5 + float(q * np.sin(a))) for a, q in zip(angles, reach, strict=True))
        face.mark("poly", x, y, w, h, (b, g, r), points=points)


def blob(rng: np.random.Generator, face: Face, x: float, y: float, width: float, height: float) -> None:
    """Overlapping bars and discs about a centre: an irregular figure that is no character."""
    colour = near(rng, face.ink_bgr, 60)
    for _ in range(int(rng.integers(3, 6))):
        w, h = width * uniform(rng, 0.3, 0.9), height * uniform(rng, 0.2, 0.8)
        left = x - w / 2 + uniform(rng, -0.2, 0.2) * width
        top = y - h / 2 + uniform(rng, -0.2, 0.2) * height
        face.mark("disc" if chance(rng, 0.4) else "rect", left, top, w, h, colour)


def screws(rng: np.random.Generator, face: Face) -> None:
    """Bolt heads or holes, two or four, anywhere that people put them."""
    dx = uniform(rng, 0.25, 0.46) * face.width_mm
    dy = face.height_mm / 2 - uniform(rng, 8, 16) if face.height_mm > 125 else uniform(rng, -5, 5)
    d = uniform(rng, 6, 13)
    colour = near(rng, (120, 120, 120), 60) if chance(rng, 0.6) else face.background_bgr
    for side_x in (-1, 1):
        for side_y in (-1, 1) if face.height_mm > 125 and chance(rng, 0.5) else (-1,):
            face.mark("disc", side_x * dx - d / 2, side_y * dy - d / 2, d, d, near(rng, colour, 8), above=True)
            if chance(rng, 0.5):
                face.mark("disc", side_x * dx - d / 2, side_y * dy - d / 2, d, d, (60, 60, 60), stroke=1.0, above=True)


def sticker(rng: np.random.Generator, face: Face, left: float, top: float, width: float, height: float) -> None:
    colour = near(rng, (120, 120, 120), 90)
    face.mark("rect", left, top, width, height, colour)
    text = pick(rng, ("24", "25", "JUN", "12", "2026", "DEC", "07"))
    face.mark(
        "text",
        left + 0.1 * width,
        top + 0.25 * height,
        0.8 * width,
        0.5 * height,
        BLACK if sum(colour) > 360 else WHITE,
        text=text,
    )


def _stars(face: Face, x: float, width: float, y: float) -> None:
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


def bands(rng: np.random.Generator, face: Face, code: str, *, right: bool = False) -> tuple[float, float]:
    """Blue band at the left (and right); gives the free space between."""
    w, h = face.width_mm, face.height_mm
    wide = uniform(rng, 38, 46) if w > 400 else uniform(rng, 32, 44)
    inset = face.border_inset_mm + face.border_mm if chance(rng, 0.5) else 0.0
    blue = near(rng, EU_BLUE, 14)
    face.mark("rect", -w / 2 + inset, -h / 2 + inset, wide, h - 2 * inset, blue)
    band_h = h if h < 130 else h / 2
    if chance(rng, 0.85):
        _stars(face, -w / 2, wide, -h / 2 + band_h * 0.33)
    letter_h = uniform(rng, 16, 24)
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
            text=random_text(rng, "DD") if chance(rng, 0.7) else random_text(rng, "LL"),
        )
    return -w / 2 + wide + inset, w / 2 - (wide if right else 0.0) - inset
