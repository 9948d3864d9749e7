"""Invented plates in the manner of Europe: one and two lines, Great Britain, Russia."""

from __future__ import annotations

import numpy as np

from tmde_edge.simulation.plate_face import Mark
from tmde_edge.simulation.plate_parts import (
    BLACK,
    WHITE,
    YELLOW,
    Face,
    Type,
    bands,
    chance,
    crest,
    near,
    pick,
    random_text,
    row_of,
    uniform,
)

_EU = {  # pattern options, separator, country letters, share of yellow, second band
    "D": (("LL-LL DDDD", "L-LL DDD", "LLL-L DDD", "L-L DDDD", "LL-L DDD", "LLL-LL DD"), "seal", "D", 0.0, False),
    "NL": (("LL-DDD-L", "DD-LLL-D", "L-DDD-LL", "DD-LL-LL", "LL-LL-DD"), "bar", "NL", 0.95, False),
    "F": (("LL-DDD-LL",), "bar", "F", 0.02, True),
    "I": (("LL DDDLL", "LLDDDLL"), "none", "I", 0.0, True),
    "PL": (("LLL DDDDD", "LL DDDDD", "LLL LLDD", "LL DDDDL", "LL-DDDDD"), "emblem", "PL", 0.0, False),
    "RO": (("L DDD LLL", "LL DD LLL", "L DD LLL"), "none", "RO", 0.0, False),
    "CZ": (("DLD-DDDD", "DLD DDDD"), "seal", "CZ", 0.0, False),
    "E": (("DDDD LLL",), "none", "E", 0.0, False),
    "A": (("L-DDDDDL", "LL-DDD LL", "L-DDDD L"), "shield", "A", 0.0, False),
    "B": (("D-LLL-DDD",), "bar", "B", 0.0, False),
    "H": (("LLL-DDD", "LL-LL DDD"), "bar", "H", 0.0, False),
    "S": (("LLL DDD", "LLL DDL"), "none", "S", 0.0, False),
    "FIN": (("LLL-DDD",), "bar", "FIN", 0.0, False),
    "P": (("LL-DD-LL", "DD-LL-DD"), "bar", "P", 0.0, True),
    "BG": (("LL DDDD LL", "L DDDD LL"), "none", "BG", 0.0, False),
    "SK": (("LL-DDDLL",), "shield", "SK", 0.0, False),
    "UA": (("LL DDDD LL",), "none", "UA", 0.0, False),
    "GR": (("LLL-DDDD",), "bar", "GR", 0.0, False),
    "LT": (("LLL DDD", "LLL-DDD"), "emblem", "LT", 0.0, False),
}


def _eu_type(rng: np.random.Generator) -> Type:
    height = uniform(rng, 69, 81)
    return Type(
        height=height,
        letter=uniform(rng, 38, 50),
        digit=uniform(rng, 37, 47),
        stroke=uniform(rng, 8, 12),
        gap=uniform(rng, 5, 13),
        group=uniform(rng, 14, 36),
    )


def _eu_face(rng: np.random.Generator, width: float, height: float, yellow: float) -> Face:
    face = Face(width, height, near(rng, YELLOW if chance(rng, yellow) else WHITE, 9), near(rng, BLACK, 9))
    if chance(rng, 0.1):
        face.ink_bgr = near(rng, (40, 110, 30) if chance(rng, 0.5) else (40, 30, 170))
    face.corner_radius_mm = uniform(rng, 4, 11)
    if chance(rng, 0.6):
        face.border_mm, face.border_inset_mm = uniform(rng, 1.5, 4.5), uniform(rng, 0, 3.5)
        if chance(rng, 0.25):
            face.border_bgr = near(rng, (160, 160, 160), 30)
    return face


def style_eu1(rng: np.random.Generator) -> Face:
    patterns, hyphen, code, yellow, second = _EU[pick(rng, list(_EU))]
    pattern = pick(rng, patterns)
    if chance(rng, 0.35):
        hyphen = pick(rng, ("none", "bar", "dot", "emblem", "seal", "seal", "seal", "tab", "shield", "shield"))
        pattern = pattern.replace(" ", "-", 1) if chance(rng, 0.5) else pattern
    face = _eu_face(rng, 520 if chance(rng, 0.8) else uniform(rng, 440, 525), uniform(rng, 108, 114), max(yellow, 0.05))
    left, right = bands(rng, face, code, right=second and chance(rng, 0.9))
    if chance(rng, 0.06):  # no band at all: older plates
        face.marks.clear()
        left, right = -face.width_mm / 2, face.width_mm / 2
    size = _eu_type(rng)
    if chance(rng, 0.25):
        face.marks.clear()
        left, right = crest(rng, face, code, size), face.width_mm / 2
    row_of(
        rng,
        face,
        random_text(rng, pattern),
        size,
        left=left + uniform(rng, 6, 16),
        right=right - uniform(rng, 6, 16),
        top=-size.height / 2 + uniform(rng, -3, 3),
        hyphen=hyphen,
        align=pick(rng, ("centre", "centre", "left")),
    )
    return face


def style_eu2(rng: np.random.Generator) -> Face:
    width, height = [(340, 200), (340, 220), (275, 200), (305, 214), (280, 200), (340, 200), (297, 210)][rng.integers(7)]
    _, hyphen, code, yellow, _second = _EU[pick(rng, list(_EU))]
    face = _eu_face(rng, width, height, max(yellow, 0.1))
    left, right = bands(rng, face, code)
    size = _eu_type(rng)
    gap_mid = (height - 2 * size.height) / 3
    tops = (-height / 2 + gap_mid + uniform(rng, -3, 3), height / 2 - size.height - gap_mid + uniform(rng, -3, 3))
    patterns = pick(
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
    free = left + uniform(rng, 6, 14)
    for row, (pattern, top) in enumerate(zip(patterns, tops, strict=True)):
        start = free if row == 0 or chance(rng, 0.4) else -width / 2 + uniform(rng, 10, 20)
        row_of(
            rng,
            face,
            random_text(rng, pattern),
            size,
            left=start,
            right=right - uniform(rng, 8, 16),
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


def style_gb(rng: np.random.Generator) -> Face:
    two = chance(rng, 0.12)
    face = Face(
        285 if two else 520,
        203 if two else 111,
        near(rng, YELLOW if chance(rng, 0.5) else WHITE, 9),
        near(rng, BLACK, 8),
        corner_radius_mm=uniform(rng, 4, 12),
    )
    if chance(rng, 0.12):  # before 1973
        face.background_bgr, face.ink_bgr = near(rng, BLACK, 8), near(rng, (190, 195, 200), 25)
    left, right = -face.width_mm / 2, face.width_mm / 2
    if not two and chance(rng, 0.35):
        left, right = bands(rng, face, pick(rng, ("GB", "UK")))
    height = uniform(rng, 77, 81)
    size = Type(
        height=height,
        letter=uniform(rng, 46, 56),
        digit=uniform(rng, 46, 54),
        stroke=uniform(rng, 12, 15.5),
        gap=uniform(rng, 9, 12.5),
        group=uniform(rng, 26, 36),
    )
    text = random_text(rng, pick(rng, ("LLDD|LLL", "LLDD|LLL", "LDDD|LLL", "LLL|DDDL", "LLL|DDD", "L|LLL", "DD|LL", "DDDD|LL")))
    if chance(rng, 0.6):  # the maker's name below
        word = pick(rng, ("MOTORS LTD", "WWW.DEALER.CO.UK", "AUTO SALES 01234"))
        wide = uniform(rng, 60, 180)
        face.mark("text", -wide / 2, face.height_mm / 2 - 9.5, wide, uniform(rng, 4, 6.5), face.ink_bgr, text=word)
    if two:
        for row, part in enumerate(text.split("|")):
            row_of(
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
        row_of(rng, face, text.replace("|", " "), size, left=left + 9, right=right - 9, top=-height / 2 + uniform(rng, -4, 1))
    return face


def style_ru(rng: np.random.Generator) -> Face:
    face = Face(
        520,
        112,
        near(rng, WHITE, 9),
        near(rng, BLACK, 9),
        corner_radius_mm=10,
        border_mm=uniform(rng, 2, 5),
        border_inset_mm=uniform(rng, 0, 3),
    )
    pool = list("ABEKMHOPCTYX")
    big = Type(
        height=uniform(rng, 74, 78),
        letter=50,
        digit=uniform(rng, 44, 54),
        stroke=uniform(rng, 10.5, 12.5),
        gap=uniform(rng, 5, 11),
        group=14,
    )
    small = Type(
        height=big.height * 58 / 76 * uniform(rng, 0.97, 1.03),
        letter=uniform(rng, 44, 54),
        digit=40,
        stroke=uniform(rng, 9, 11),
        gap=big.gap,
        group=12,
    )
    base = big.height / 2 + uniform(rng, -1, 4)
    split = 260 - uniform(rng, 128, 142)
    letters = [str(rng.choice(pool)) for _ in range(3)]
    left = -260 + uniform(rng, 22, 34)
    _, x = row_of(rng, face, letters[0], small, left=left, right=left + small.letter, top=base - small.height, align="left")
    _, x = row_of(
        rng,
        face,
        random_text(rng, "DDD"),
        big,
        left=x + big.gap + uniform(rng, 4, 12),
        right=split,
        top=base - big.height,
        align="left",
    )
    room = split - uniform(rng, 8, 14)
    row_of(
        rng,
        face,
        "".join(letters[1:]),
        small,
        left=x + big.gap + uniform(rng, 4, 10),
        right=room,
        top=base - small.height,
        align="left",
    )
    face.mark("line", split, -56, 0, 112, face.ink_bgr, stroke=uniform(rng, 2, 4))
    region_h = uniform(rng, 52, 60)
    region = Type(
        height=region_h, letter=40, digit=uniform(rng, 30, 38), stroke=uniform(rng, 8, 10), gap=uniform(rng, 4, 8), group=10
    )
    row_of(
        rng,
        face,
        random_text(rng, "DD" if chance(rng, 0.5) else "DDD"),
        region,
        left=split + 8,
        right=260 - 9,
        top=-56 + uniform(rng, 8, 13),
    )
    face.mark("text", split + uniform(rng, 12, 26), 56 - 20 - uniform(rng, 9, 12), 52, 20, face.ink_bgr, text="RUS", stroke=4)
    if chance(rng, 0.85):
        for k, colour in enumerate(((235, 235, 235), (180, 60, 20), (40, 30, 200))):
            face.mark("rect", 260 - 48, 56 - 31 + k * 6.7, 34, 6.7, colour)
        face.mark("rect", 260 - 48, 56 - 31, 34, 20, face.ink_bgr, stroke=1)
    if chance(rng, 0.6):
        for x in (-260 + 12, split - 2 + 135 - 16):
            face.mark("disc", x, -3, 8, 8, (90, 90, 90), above=True)
    return face
