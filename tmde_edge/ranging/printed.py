"""What is printed on a plate, beside its sizes, tells its standard: the ground's colour, blue bands, groups of characters.

It is the same in every frame, so a track counts it once (the mean over the frames that could tell it), not with every look.
"""

from __future__ import annotations

from itertools import pairwise
from math import log
from statistics import median

import numpy as np

from tmde_edge.messages import Ground, PlateColours, PlateSighting
from tmde_edge.plates.standard import PlateStandard

# Chances of what is seen.
ODD_GROUND = 0.05  # a ground that the standard does not have, or a lamp's colour
BAND_SEEN, NO_BAND_SEEN, OPTIONAL_SEEN = 0.55, 0.97, 0.3  # where there is one, where there is none, where there may be one
GROUPS_OFF = (0.7, 0.2, 0.1)  # as many groups as the usual layout, one more or fewer, still others
GROUP_GAP = 0.2  # of a character's height: so much wider than the narrowest third of a row's gaps
LEAST_CHARACTERS, LEAST_HEIGHT_PX = 4, 6.0  # for groups to be told


def log_chances(standard: PlateStandard, colours: PlateColours | None, count: int, groups: int | None) -> dict[str, float]:
    """Log chance of each kind of print on a plate of so many characters, if it is of this standard.

    What could not be told is absent. groups: as group_count counts them.
    """
    found = {}
    if colours is not None:
        if colours.ground is not None:
            found["ground"] = log(_ground(standard, colours.ground))
        for end, band in (("left", colours.left_band), ("right", colours.right_band)):
            if band is not None:
                chance = BAND_SEEN if standard.band in (end, "both") else 1 - NO_BAND_SEEN
                chance = OPTIONAL_SEEN if standard.optional_band == end else chance
                found[f"{end} band"] = log(chance if band else 1 - chance)
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


def _ground(standard: PlateStandard, seen: Ground) -> float:
    usual = "white" if standard.background == "grey" else standard.background
    shares = {**standard.other_backgrounds, usual: 1 - sum(standard.other_backgrounds.values())}
    return (1 - ODD_GROUND) * shares.get(seen, 0.0) + ODD_GROUND
