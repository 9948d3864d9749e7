"""What is printed on a plate, beside its sizes, tells its standard: the ground's colour, blue bands, groups of characters.

It is the same in every frame, so a track counts it once (the mean over its frames), not with every look.
"""

from __future__ import annotations

from itertools import pairwise
from math import log
from statistics import median

import numpy as np

from tmde_edge.messages import Ground, PlateColours, PlateSighting
from tmde_edge.plates.standard import PlateStandard

# Chances of what is seen. Other grounds of a standard (taxis, front plates, states) share what its usual one leaves.
USUAL_GROUND, ODD_GROUND = 0.65, 0.05
BAND_SEEN, NO_BAND_SEEN = 0.55, 0.97  # where there is one, where there is none: old plates, covers and dirt hide bands
GROUPS_OFF = (0.7, 0.2, 0.1)  # as many groups as the usual layout, one more or fewer, still others
GROUP_GAP = 0.2  # of a character's height: so much wider than the narrowest third of a row's gaps
LEAST_CHARACTERS, LEAST_HEIGHT_PX = 4, 6.0  # for groups to be told


def print_log_likelihoods(
    standard: PlateStandard, colours: PlateColours | None, count: int, groups: int | None
) -> dict[str, float]:
    """Log chance of each kind of print on a plate of so many characters, if it is of this standard; kinds not seen are absent."""
    found = {}
    if colours is not None:
        found["colours"] = _ground(standard, colours.ground) + _bands(standard, colours)
    if groups is not None:
        usual = sum(len(row.split()) for row in standard.rows)
        off = min(abs(groups - usual), len(GROUPS_OFF) - 1) if count in standard.char_counts else 1  # some were missed
        found["groups"] = log(GROUPS_OFF[off])
    return found


def group_count(plate: PlateSighting) -> int | None:
    """Groups of characters in all rows; None where that cannot be told."""
    heights = [g.height_px for g in plate.glyphs]
    if len(heights) < LEAST_CHARACTERS or median(heights) < LEAST_HEIGHT_PX:
        return None
    count = 0
    for row in {g.row for g in plate.glyphs}:
        glyphs = sorted((g for g in plate.glyphs if g.row == row), key=lambda g: g.left_px[0] + g.right_px[0])
        count += 1
        if len(glyphs) > 1:
            gaps = np.array([b.left_px[0] - a.right_px[0] for a, b in pairwise(glyphs)])
            count += int(np.sum(gaps > np.quantile(gaps, 0.3) + GROUP_GAP * median(g.height_px for g in glyphs)))
    return count


def _ground(standard: PlateStandard, seen: Ground | None) -> float:
    if seen is None:
        return 0.0
    usual = "white" if standard.background == "grey" else standard.background
    others = len(standard.other_backgrounds)
    if seen == usual:
        return log(USUAL_GROUND if others else 1 - ODD_GROUND)
    if seen in standard.other_backgrounds:
        return log(max((1 - USUAL_GROUND - ODD_GROUND) / others, ODD_GROUND))
    return log(ODD_GROUND)


def _bands(standard: PlateStandard, seen: PlateColours) -> float:
    total = 0.0
    for band, end in ((seen.left_band, "left"), (seen.right_band, "right")):
        if band is not None:
            chance = BAND_SEEN if standard.band in (end, "both") else 1 - NO_BAND_SEEN
            total += log(chance if band else 1 - chance)
    return total
