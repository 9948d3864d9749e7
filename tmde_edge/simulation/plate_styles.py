"""Random plate faces in the manner of many jurisdictions: sizes near the standards', everything else invented."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tmde_edge.simulation.plate_face import FaceSpec
from tmde_edge.simulation.plate_parts import (
    SLOGANS,
    STATES,
    WHITE,
    YELLOW,
    Face,
    Type,
    bands,
    chance,
    dark,
    near,
    pale,
    pick,
    random_text,
    row_of,
    screws,
    uniform,
)
from tmde_edge.simulation.styles_america import style_au, style_br, style_us
from tmde_edge.simulation.styles_asia import style_cn, style_in, style_jp, style_kr
from tmde_edge.simulation.styles_europe import style_eu1, style_eu2, style_gb, style_ru


def random_spec(rng: np.random.Generator, style: str | None = None) -> FaceSpec:
    """A random face; style is a key of STYLES. Raises KeyError for an unknown one."""
    name = style if style is not None else str(rng.choice(list(STYLES), p=_SHARES))
    face = STYLES[name](rng)
    if rng.random() < 0.5:
        screws(rng, face)
    return face.done()


def style_any(rng: np.random.Generator) -> Face:
    """What no list has: other proportions, both polarities, vanity numbers, foreign letters."""
    width = uniform(rng, 250, 540)
    height = float(np.clip(width / uniform(rng, 1.7, 4.9), 95, 190))
    face = Face(
        width,
        height,
        pale(rng) if chance(rng, 0.5) else near(rng, WHITE, 9),
        dark(rng),
        corner_radius_mm=uniform(rng, 0, 16),
    )
    if chance(rng, 0.45):
        face.background_bgr, face.ink_bgr = near(rng, dark(rng)), near(rng, WHITE if chance(rng, 0.7) else YELLOW)
    glyph_h = height * uniform(rng, 0.45, 0.76)
    size = Type(
        height=glyph_h,
        letter=glyph_h * uniform(rng, 0.42, 0.72),
        digit=glyph_h * uniform(rng, 0.42, 0.68),
        stroke=glyph_h * uniform(rng, 0.08, 0.19),
        gap=glyph_h * uniform(rng, 0.06, 0.18),
        group=glyph_h * uniform(rng, 0.15, 0.5),
    )
    left, right = -width / 2 + uniform(rng, 8, 20), width / 2 - uniform(rng, 8, 20)
    if chance(rng, 0.35) and width > 400:
        left, right = bands(rng, face, random_text(rng, pick(rng, ("L", "LL", "LLL"))), right=chance(rng, 0.2))
        left, right = left + 8, right - 8
    text = random_text(
        rng,
        pick(
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
    shift = uniform(rng, -0.5, 0.5) * free
    row_of(
        rng,
        face,
        text,
        size,
        left=left,
        right=right,
        top=-glyph_h / 2 + shift,
        hyphen=pick(rng, ("bar", "dot", "emblem", "none", "seal")),
    )
    small = free - abs(shift)
    if small > 10 and chance(rng, 0.5):
        side = -1 if shift > 0 else 1
        y = -height / 2 + 4 if side < 0 else height / 2 - 4 - min(small, 16)
        face.mark("text", -width / 4, y, width / 2, min(small, 16) * 0.8, face.ink_bgr, text=pick(rng, (*STATES, *SLOGANS)))
    if chance(rng, 0.5):
        face.border_mm, face.border_inset_mm = uniform(rng, 1, 4), uniform(rng, 0, 4)
    return face


STYLES: dict[str, Callable[[np.random.Generator], Face]] = {
    "us": style_us,
    "eu1": style_eu1,
    "eu2": style_eu2,
    "gb": style_gb,
    "ru": style_ru,
    "cn": style_cn,
    "jp": style_jp,
    "kr": style_kr,
    "in": style_in,
    "br": style_br,
    "au": style_au,
    "any": style_any,
}

_SHARES = (0.34, 0.30, 0.05, 0.05, 0.06, 0.03, 0.02, 0.02, 0.02, 0.03, 0.03, 0.05)
