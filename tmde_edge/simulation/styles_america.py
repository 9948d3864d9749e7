"""Invented plates in the manner of the Americas and Australia."""

from __future__ import annotations

import numpy as np

from tmde_edge.simulation.plate_parts import (
    BLACK,
    EU_BLUE,
    SLOGANS,
    STATES,
    WHITE,
    YELLOW,
    Face,
    Type,
    chance,
    dark,
    near,
    pale,
    pick,
    picture,
    random_text,
    row_of,
    sticker,
    uniform,
)


def style_us(rng: np.random.Generator) -> Face:
    face = Face(304.8, 152.4, near(rng, WHITE, 10) if chance(rng, 0.55) else pale(rng), dark(rng))
    if chance(rng, 0.1):
        face.background_bgr, face.ink_bgr = dark(rng), near(rng, WHITE)
    w, h = face.width_mm, face.height_mm
    if chance(rng, 0.45):  # a graphic sky
        face.mark("rect", -w / 2, -h / 2, w, h * uniform(rng, 0.5, 1.0), pale(rng), colour2=face.background_bgr)
    if chance(rng, 0.3):  # hills, sun, fruit
        for _ in range(int(rng.integers(1, 5))):
            blob = uniform(rng, 20, 160)
            face.mark(
                "disc" if chance(rng, 0.7) else "rect",
                uniform(rng, -w / 2, w / 2) - blob / 2,
                uniform(rng, -10, h / 2),
                blob,
                blob * uniform(rng, 0.3, 0.8),
                pale(rng),
                opacity=uniform(rng, 0.2, 0.7),
            )
    if chance(rng, 0.35):
        band = near(rng, dark(rng), 40)
        face.mark("rect", -w / 2, -h / 2, w, uniform(rng, 18, 34), band)
        if chance(rng, 0.5):
            face.mark("rect", -w / 2, h / 2 - 26, w, 26, band if chance(rng, 0.6) else near(rng, dark(rng), 40))
        name_colour = near(rng, WHITE)
    else:
        name_colour = near(rng, dark(rng), 30)
    name = pick(rng, STATES)
    name_h = uniform(rng, 12, 22) if chance(rng, 0.7) else uniform(rng, 20, 30)
    top_mm = -h / 2 + uniform(rng, 3, 10)
    if chance(rng, 0.92):
        wide = min(len(name) * name_h * uniform(rng, 0.65, 1.1), 0.75 * w)
        face.mark(
            "text",
            -wide / 2,
            top_mm,
            wide,
            name_h,
            name_colour,
            text=name,
            stroke=name_h * uniform(rng, 0.12, 0.22),
        )
    slogan = pick(rng, (*SLOGANS, "", "EXPLORE", "WWW.STATE.GOV", random_text(rng, "LLLLLL COUNTY")))
    if slogan and chance(rng, 0.75):
        slogan_h = uniform(rng, 7, 14)
        wide = min(len(slogan) * slogan_h * uniform(rng, 0.6, 1.0), 0.72 * w)
        face.mark(
            "text",
            -wide / 2,
            h / 2 - slogan_h - uniform(rng, 6, 10),
            wide,
            slogan_h,
            near(rng, dark(rng), 30) if sum(face.background_bgr) > 300 else near(rng, WHITE),
            text=slogan,
        )
    for side_x in (-1, 1):
        for side_y in (-1, 1):
            if chance(rng, 0.3):
                sticker(rng, face, side_x * 130 - 16, side_y * 60 - 10 + uniform(rng, -3, 3), 32, 20)
    height = uniform(rng, 60, 76)
    size = Type(
        height=height,
        letter=height * uniform(rng, 0.42, 0.56),
        digit=height * uniform(rng, 0.42, 0.54),
        stroke=uniform(rng, 6, 10.5),
        gap=uniform(rng, 4, 11),
        group=uniform(rng, 8, 26),
    )
    pattern = pick(
        rng,
        (
            "LLLDDDD",
            "LLL-DDDD",
            "LLL-DDD",
            "XXX-XXX",
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
    left, right = -w / 2 + uniform(rng, 8, 22), w / 2 - uniform(rng, 8, 22)
    top = -height / 2 + uniform(rng, -2, 8)
    if chance(rng, 0.07):  # two small letters, stacked, before the number
        small = Type(height=height * 0.44, letter=height * 0.3, digit=height * 0.3, stroke=5, gap=3, group=8)
        for k in range(2):
            row_of(rng, face, random_text(rng, "L"), small, left=left, right=left + 24, top=top + k * height * 0.55, row=k)
        left += 32
        pattern = pattern[:6]
    if chance(rng, 0.5):
        pattern = pattern.replace(" ", "-")
    if chance(rng, 0.12):  # a cactus, a tower, a bird beside the characters
        wide = uniform(rng, 16, 34)
        on_left = chance(rng, 0.6)
        x = left - 4 if on_left else right + 4 - wide
        picture(rng, face, x, top + uniform(rng, -0.1, 0.5) * height, wide, height * uniform(rng, 0.5, 1.1))
        left, right = (left + wide - 2, right) if on_left else (left, right - wide + 2)
    row_of(
        rng,
        face,
        random_text(rng, pattern),
        size,
        left=left,
        right=right,
        top=top,
        hyphen=pick(rng, ("bar", "dot", "emblem", "tab", "tab", "tab", "shape", "picture", "picture", "none")),
    )
    if chance(rng, 0.5):
        face.border_mm, face.border_inset_mm = uniform(rng, 1, 3), uniform(rng, 0, 4)
        face.border_bgr = near(rng, face.ink_bgr, 40) if chance(rng, 0.5) else near(rng, face.background_bgr, 30)
    face.corner_radius_mm = uniform(rng, 8, 16)
    return face


def style_br(rng: np.random.Generator) -> Face:
    face = Face(400 if chance(rng, 0.8) else uniform(rng, 340, 400), 130, near(rng, WHITE, 8), near(rng, BLACK, 8))
    w = face.width_mm
    if chance(rng, 0.75):
        band = uniform(rng, 28, 32)
        face.mark("rect", -w / 2 + 4, -61, w - 8, band, near(rng, EU_BLUE, 14))
        face.mark("text", -55, -61 + band * 0.22, 110, band * 0.55, WHITE, text=pick(rng, ("BRASIL", "ARGENTINA", "URUGUAY")))
        face.mark("rect", w / 2 - 44, -61 + band * 0.15, 30, band * 0.6, (80, 160, 40))
        face.mark("text", -w / 2 + 10, 35, 14, 16, face.ink_bgr, text="BR")
        top = -61 + band + uniform(rng, 6, 12)
        text = random_text(rng, pick(rng, ("LLLDLDD", "LL DDD LL", "LLLDDDD")))
        face.border_mm = uniform(rng, 1, 3)
    else:  # the older grey one with the town above
        face.background_bgr = near(rng, (175, 175, 175), 15)
        face.mark("text", -60, -57, 120, 18, face.ink_bgr, text="SP SAO PAULO")
        top, text = -28.0, random_text(rng, "LLL-DDDD")
    size = Type(
        height=uniform(rng, 62, 67),
        letter=uniform(rng, 36, 44),
        digit=uniform(rng, 35, 42),
        stroke=uniform(rng, 8, 10.5),
        gap=uniform(rng, 6, 10),
        group=uniform(rng, 12, 22),
    )
    row_of(rng, face, text, size, left=-w / 2 + 28, right=w / 2 - 14, top=top, hyphen=pick(rng, ("bar", "dot")))
    return face


def style_au(rng: np.random.Generator) -> Face:
    slim = chance(rng, 0.25)
    face = Face(520 if slim else 372, 110 if slim else 134, near(rng, WHITE, 8), dark(rng))
    if chance(rng, 0.35):
        face.background_bgr = near(rng, YELLOW)
    elif chance(rng, 0.3):
        face.background_bgr, face.ink_bgr = face.ink_bgr, near(rng, WHITE)
    size = Type(
        height=uniform(rng, 72, 83),
        letter=uniform(rng, 38, 48),
        digit=uniform(rng, 38, 46),
        stroke=uniform(rng, 8, 11),
        gap=uniform(rng, 6, 10),
        group=uniform(rng, 14, 30),
    )
    top = -size.height / 2 + (0 if slim else uniform(rng, -10, 8))
    text = random_text(rng, pick(rng, ("LLL-DDD", "LL-DD-LL", "DLL DLL", "LLL DDL", "DDD-LLL", "LDDD-LLL", "XXXXXX")))
    row_of(
        rng,
        face,
        text,
        size,
        left=-face.width_mm / 2 + 12,
        right=face.width_mm / 2 - 12,
        top=top,
        hyphen=pick(rng, ("dot", "bar", "emblem", "none")),
    )
    if not slim and chance(rng, 0.8):
        name = pick(rng, ("VICTORIA", "QUEENSLAND", "NEW SOUTH WALES", "SUNSHINE STATE", "GARDEN STATE"))
        y = 67 - 18 if top < -size.height / 2 else -67 + 6
        face.mark("text", -70, y, 140, 12, face.ink_bgr, text=name)
    if chance(rng, 0.4):
        face.border_mm, face.border_inset_mm = uniform(rng, 1, 3), uniform(rng, 1, 4)
    return face
