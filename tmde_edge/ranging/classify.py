"""Which standard? Standards of equal geometry are one class; what the layout says before anything is fitted."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tmde_edge.messages import PlateSighting
from tmde_edge.plates.standard import PlateStandard
from tmde_edge.ranging.features import Features
from tmde_edge.ranging.model import Expectation, expectations
from tmde_edge.ranging.printed import group_count, log_chances
from tmde_edge.ranging.settings import RangingSettings

SAME_SIZE = 0.012  # relative: nearer standards are one class
_WRONG_COLOUR, _WRONG_ROWS = -3.0, -2.0
_TILT_SIGMA, _YAW_SLACK = 0.03, 0.10  # log aspect: lean and noise; a turned plate looks narrower


@dataclass(frozen=True, slots=True)
class StandardClass:
    """Standards that no measurement can tell apart, by the most common of them; shorter plates of one are a class too."""

    expected: Expectation
    members: tuple[PlateStandard, ...]

    @property
    def id(self) -> str:
        return self.expected.id

    @property
    def weight(self) -> float:
        return self.expected.weight * sum(m.weight for m in self.members)


def classes(standards: Sequence[PlateStandard], settings: RangingSettings) -> tuple[StandardClass, ...]:
    """Groups of equal geometry, the most common standard of each group first."""
    groups: list[tuple[Expectation, list[PlateStandard]]] = []
    for standard in sorted(standards, key=lambda s: -s.weight):
        for expected in expectations(standard, settings):
            for leader, members in groups:
                if _same(leader, expected):
                    members.append(standard)
                    break
            else:
                groups.append((expected, [standard]))
    return tuple(StandardClass(leader, tuple(members)) for leader, members in groups)


def _same(a: Expectation, b: Expectation) -> bool:
    if len(a.keys) != len(b.keys):
        return False
    if (a.has_glyph, a.has_outline, a.has_pitch) != (b.has_glyph, b.has_outline, b.has_pitch):
        return False
    if (a.bolts is None) != (b.bolts is None):
        return False
    if a.bolts is not None and b.bolts is not None and abs(np.log(a.bolts.spacing_m / b.bolts.spacing_m)) >= SAME_SIZE:
        return False
    if a.standard.width_floats != b.standard.width_floats or a.standard.light_on_dark != b.standard.light_on_dark:
        return False
    if len(a.standard.rows) != len(b.standard.rows):
        return False
    if (a.standard.background, a.standard.band) != (b.standard.background, b.standard.band):
        return False
    return bool(np.all(np.abs(np.log(a.size_m / b.size_m)) < SAME_SIZE))


def said_by_print(groups: Iterable[StandardClass], plate: PlateSighting) -> dict[str, dict[str, float]]:
    """What ground, bands and groups of characters say of each class, by kind: log chances (printed.py), its members' mean."""
    apart, count = group_count(plate), len(plate.glyphs)
    said: dict[str, dict[str, float]] = {}
    for group in groups:
        weight = sum(m.weight for m in group.members)
        chances: dict[str, float] = {}
        for member in group.members:
            for kind, value in log_chances(member, plate.colours, count, apart).items():
                chances[kind] = chances.get(kind, 0.0) + member.weight / weight * math.exp(value)
        for kind, chance in chances.items():
            said.setdefault(kind, {})[group.id] = math.log(chance)
    return said


def layout_log_likelihood(group: StandardClass, plate: PlateSighting, features: Features) -> float:
    """What can be read without a fit: number of characters, rows, colours; the best of the class's members."""
    rows = len(set(features.row.tolist()))
    return max(_layout(member, plate, len(features.heights), rows) for member in group.members)


def _layout(standard: PlateStandard, plate: PlateSighting, count: int, rows: int) -> float:
    if not count:
        return 0.0
    total = 0.0
    if plate.light_on_dark != standard.light_on_dark:
        total += _WRONG_COLOUR
    if rows and rows != len(standard.rows):
        total += _WRONG_ROWS
    # Characters are missed more easily than invented.
    most, least = max(standard.char_counts), min(standard.char_counts)
    total += -1.5 * max(count - most, 0) - 0.7 * max(least - count, 0)
    if least < count < most and count not in standard.char_counts:
        total -= 0.7
    return total


def shape_log_likelihood(group: StandardClass, features: Features) -> float:
    """A cheap look at aspect and glyph proportion, to decide which classes are worth a fit."""
    e, k = group.expected, group.expected.classes
    width, height = features.width, features.height
    if width is None or height is None or not e.has_outline:
        return -1.0
    spread = e.sizes.covariance.diagonal()
    pixel = features.corner_sigma * (1 / width + 1 / height)
    off = float(np.log(width / height) - np.log(e.size_m[k] / e.size_m[k + 1]))
    sigma = float(np.sqrt(spread[k] + spread[k + 1] + pixel**2 + _TILT_SIGMA**2 + (_YAW_SLACK**2 if off < 0 else 0.0)))
    total = -0.5 * (off / sigma) ** 2 - float(np.log(sigma))
    if len(features.heights) and e.has_glyph:
        tall = float(np.quantile(features.heights, 0.75))
        ratio = np.log(tall / height) - np.log(e.size_m[:k] / e.size_m[k + 1])
        sigma = float(np.sqrt(spread[0] + spread[k + 1] + pixel**2 + 0.04**2))
        total += -0.5 * float(np.min(np.abs(ratio)) / sigma) ** 2 - float(np.log(sigma))
    else:
        total -= float(np.log(0.3))
    return total
