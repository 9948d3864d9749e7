"""The `[ranging]` table."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class RangingSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a plate becomes a distance. The defaults are derived in docs/ranging.md."""

    method: Literal["joint", "paper"] = "joint"  # "paper": its cues averaged by their variances
    fusion: bool = True  # "paper": False takes the character height alone
    min_plate_width_px: Positive = 16.0  # below this width and below min_char_height_px: not ranged
    min_char_height_px: Positive = 4.5  # see above
    max_relative_sigma: Positive = 0.25  # a distance less certain than this is no answer
    min_distance_m: Positive = 0.15  # nearer is no answer
    max_distance_m: Positive = 200.0  # farther is no answer
    outline_sigma_mm: NotNegative = 4.0  # where a seen side edge lies against the legal one: frames, lips
    outline_sigma_tb_mm: NotNegative = 5.0  # the same for upper and lower edges: shadows and recesses too
    unrefined_height_sigma: NotNegative = 0.08  # of a plate whose edges were not found to sub-pixels, relative
    unrefined_width_sigma: NotNegative = 0.015  # the same of its width
    outline_bias_px: NotNegative = 0.35  # common error of opposite plate edges
    glyph_bias_px: NotNegative = 0.05  # common outward error of all top and bottom edges (threshold, blur)
    glyph_resolved_px: Positive = 6.0  # of character height: so small, that error is twice as large; it grows with the square
    glyph_jitter: NotNegative = 0.010  # relative height differences between characters of one class
    pitch_jitter_mm: NotNegative = 1.5  # ink is not centred in its cell
    bolt_sigma_mm: NotNegative = 1.5  # where a bolt stands in its slot, on all rows alike
    bolt_jitter_mm: NotNegative = 1.0  # the same, in each row by itself
    yaw_sigma_rad: Positive = 0.12  # heading of a plate nothing is known of; long tails
    lean_sigma_rad: Positive = 0.10  # plates lean with the boot lid; long tails
    roll_sigma_rad: Positive = 0.10  # about the line of sight
    belief_floor: Positive = 0.02  # standards less probable than this are not fitted
    max_fits: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8  # how many standards are fitted to a plate seen for the first time
    memory: bool = True  # learn a track's own proportions
    memory_char_height_px: Positive = 10.0  # from a plate whose characters are at least this tall in the image
    memory_share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.2  # information of one frame that is new to a track
