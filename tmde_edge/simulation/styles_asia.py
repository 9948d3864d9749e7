"""Invented plates in the manner of China, Japan, Korea and India."""

from __future__ import annotations

import numpy as np

from tmde_edge.simulation.plate_parts import (
    BLACK,
    EU_BLUE,
    WHITE,
    YELLOW,
    Face,
    Type,
    chance,
    near,
    pick,
    random_text,
    row_of,
    uniform,
)


def style_cn(rng: np.random.Generator) -> Face:
    green = chance(rng, 0.35)
    face = Face(
        480 if green else 440,
        140,
        near(rng, (150, 60, 10), 14),
        near(rng, WHITE, 8),
        border_mm=uniform(rng, 2, 4),
        border_inset_mm=uniform(rng, 3, 7),
        corner_radius_mm=10,
    )
    if green:
        face.ink_bgr = near(rng, BLACK)
        face.mark("rect", -240, -70, 480, 140, near(rng, (225, 240, 225), 8), colour2=near(rng, (100, 190, 70), 15))
    elif chance(rng, 0.2):
        face.background_bgr, face.ink_bgr = near(rng, YELLOW), near(rng, BLACK)
    size = Type(
        height=uniform(rng, 87, 92),
        letter=uniform(rng, 42, 46),
        digit=uniform(rng, 42, 46),
        stroke=uniform(rng, 9, 12),
        gap=uniform(rng, 9, 13),
        group=20,
    )
    text = pick(rng, "京沪粤苏浙鲁川渝津冀豫云辽黑湘皖") + random_text(rng, "L-XXXXXX" if green else "L-XXXXX")
    row_of(
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


def style_jp(rng: np.random.Generator) -> Face:
    face = Face(330, 165, near(rng, WHITE, 8), near(rng, (50, 85, 20), 12), corner_radius_mm=12)
    kind = rng.random()
    if kind < 0.3:
        face.background_bgr, face.ink_bgr = near(rng, (30, 200, 245), 12), near(rng, BLACK)
    elif kind < 0.4:
        face.background_bgr, face.ink_bgr = face.ink_bgr, face.background_bgr
    small = Type(height=uniform(rng, 36, 42), letter=34, digit=uniform(rng, 22, 30), stroke=5, gap=6, group=12)
    row_of(
        rng,
        face,
        pick(rng, ("品川", "横浜", "大阪", "名古屋", "札幌")) + " " + random_text(rng, "DDD"),
        small,
        left=-90,
        right=100,
        top=-82.5 + uniform(rng, 10, 15),
    )
    big = Type(
        height=uniform(rng, 78, 82),
        letter=40,
        digit=uniform(rng, 38, 43),
        stroke=uniform(rng, 10, 13),
        gap=uniform(rng, 9, 14),
        group=16,
    )
    top = 82.5 - big.height - uniform(rng, 10, 16)
    row_of(rng, face, random_text(rng, "DD-DD"), big, left=-95, right=152, top=top, row=1, hyphen="bar")
    kana = Type(height=uniform(rng, 36, 42), letter=30, digit=26, stroke=5, gap=6, group=8)
    row_of(rng, face, pick(rng, "あいうえかきくけさすせそ"), kana, left=-150, right=-105, top=top + 20, row=1)
    return face


def style_kr(rng: np.random.Generator) -> Face:
    long = chance(rng, 0.7)
    face = Face(520 if long else 335, 110 if long else 155, near(rng, WHITE, 8), near(rng, BLACK, 8), corner_radius_mm=10)
    kind = rng.random()
    if kind < 0.2:
        face.background_bgr = near(rng, (235, 190, 120), 10)
    elif kind < 0.35:
        face.background_bgr = near(rng, YELLOW, 10)
    elif kind < 0.45:
        face.background_bgr, face.ink_bgr = near(rng, (60, 100, 20)), near(rng, WHITE)
    left = -face.width_mm / 2 + 12
    if long and chance(rng, 0.5):
        face.mark("rect", -260, -55, 55, 110, near(rng, (190, 90, 30)))
        face.mark("text", -255, 20, 40, 18, WHITE, text="KOR")
        left += 50
    size = Type(
        height=uniform(rng, 80, 87),
        letter=60,
        digit=uniform(rng, 40, 48),
        stroke=uniform(rng, 9, 12),
        gap=uniform(rng, 6, 11),
        group=20,
    )
    row_of(
        rng,
        face,
        random_text(rng, "DDD" if chance(rng, 0.6) else "DD")
        + pick(rng, "가나다라마거너더러머고노도")
        + "_"
        + random_text(rng, "DDDD"),
        size,
        left=left,
        right=face.width_mm / 2 - 12,
        top=-size.height / 2,
    )
    if chance(rng, 0.5):
        face.border_mm, face.border_inset_mm = 3, uniform(rng, 1, 4)
    return face


def style_in(rng: np.random.Generator) -> Face:
    two = chance(rng, 0.3)
    face = Face(
        340 if two else 500,
        200 if two else 120,
        near(rng, YELLOW if chance(rng, 0.25) else WHITE, 9),
        near(rng, BLACK),
    )
    left = -face.width_mm / 2 + 14
    if chance(rng, 0.6):
        face.mark("text", left, 8, 28, 14, EU_BLUE, text="IND")
        face.mark("disc", left + 2, -24, 22, 22, near(rng, (160, 120, 60)))
        left += 36
    face.border_mm, face.border_inset_mm = (uniform(rng, 1.5, 3), uniform(rng, 2, 5)) if chance(rng, 0.7) else (0.0, 0.0)
    size = Type(
        height=uniform(rng, 60, 70),
        letter=uniform(rng, 32, 42),
        digit=uniform(rng, 32, 40),
        stroke=uniform(rng, 8, 11),
        gap=uniform(rng, 5, 10),
        group=uniform(rng, 8, 18),
    )
    parts = (random_text(rng, "LLDD"), random_text(rng, pick(rng, ("LLDDDD", "LDDDD"))))
    if two:
        for row, part in enumerate(parts):
            row_of(rng, face, part, size, left=left, right=156, top=-82 if row == 0 else 14, row=row)
    else:
        row_of(rng, face, " ".join(parts), size, left=left, right=236, top=-size.height / 2 + uniform(rng, -3, 3))
    return face
