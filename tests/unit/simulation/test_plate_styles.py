"""Every style draws plates whose characters lie on the plate and do not overlap."""

from __future__ import annotations

import numpy as np
import pytest

from tmde_edge.simulation.plate_face import render_face
from tmde_edge.simulation.plate_styles import STYLES, random_spec


@pytest.mark.parametrize("style", list(STYLES))
def test_characters_lie_on_the_plate_and_apart(style: str) -> None:
    for seed in range(40):
        spec = random_spec(np.random.default_rng(seed), style)
        boxes = [(g.left_mm, g.top_mm, g.left_mm + g.width_mm, g.top_mm + g.height_mm) for g in spec.glyphs if g.counted]
        assert 2 <= len(boxes) <= 12
        for i, (left, top, right, bottom) in enumerate(boxes):
            assert -spec.width_mm / 2 <= left < right <= spec.width_mm / 2
            assert -spec.height_mm / 2 <= top < bottom <= spec.height_mm / 2
            for other in boxes[i + 1 :]:
                apart = right <= other[0] or other[2] <= left or bottom <= other[1] or other[3] <= top
                assert apart, (style, seed, boxes[i], other)


def test_the_same_seed_gives_the_same_plate() -> None:
    first, second = (random_spec(np.random.default_rng(7)) for _ in range(2))
    assert first == second
    np.testing.assert_array_equal(render_face(first, 0.5), render_face(second, 0.5))


def test_russian_plates_have_two_glyph_heights() -> None:
    spec = random_spec(np.random.default_rng(1), "ru")
    heights = {g.char.isdigit(): g.height_mm for g in spec.glyphs[:6]}
    assert heights[False] / heights[True] == pytest.approx(58 / 76, rel=0.05)


def test_unknown_style_is_an_error() -> None:
    with pytest.raises(KeyError):
        random_spec(np.random.default_rng(0), "atlantis")
