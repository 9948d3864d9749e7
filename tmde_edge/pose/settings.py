"""The `[pose]` table: how the camera's attitude is measured, filtered and used."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


class PoseSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[pose]` table."""

    method: Literal["robust", "paper", "network", "none"] = "robust"  # how the lanes' vanishing point is found; network: the
    # horizon network instead of lanes; none: calibrated pose only
    network: bool = True  # where no lanes are found the horizon network is asked ...
    network_rate_hz: Positive = 10.0  # ... this often at most
    rate_hz: Positive = 10.0  # how often lanes are looked for
    working_width_px: Annotated[int, Meta(ge=160)] = 640  # the image is reduced to about this width for the search
    search_fraction: Positive = 0.05  # of the image width: how far above or below the prior the vanishing row may lie
    max_sigma_px: Positive = 12.0  # a vanishing row less certain than this is none (source pixels at 1280 px width)
    correction: Literal["rotate", "paper", "none"] = "rotate"  # of distances: rays rotated; the paper's cosine ratio; none
    hold_s: Positive = 1.0  # without lanes for longer than this the source is "none" and the pitch is the resting one
    pitch_spread_rad: Positive = 0.015  # one sigma of the body's pitching about its rest (braking, bumps)
    natural_hz: Positive = 1.2  # of the body's pitching on its springs
    damping: Annotated[float, Meta(gt=0, lt=1)] = 0.5  # of the same, as a fraction of critical
    gate_sigma: Positive = 3.5  # a vanishing point further off than this many sigma must be confirmed by the next one
    road_sigma_rad: NotNegative = 0.002  # of the road's slope ahead against the road under the car, one sigma
    track_motion: bool = True  # also follow the picture's own movement from frame to frame
    offset_time_s: Positive = 4.0  # how long braking, load or the begin of a slope keep the pitch off its rest
    road_turn_radps: Positive = 0.02  # one sigma of how fast the road itself turns up or down (crests, dips) ...
    road_turn_time_s: Positive = 1.0  # ... and for how long it keeps on
    rest_sigma_rad: Positive = 0.006  # of the calibrated pitch and roll, until driving has confirmed them
    auto_calibrate: bool = True  # learn the resting pitch and yaw while driving straight
    calibrate_speed_mps: Positive = 7.0  # learn only at this speed or more ...
    calibrate_yaw_rate_radps: Positive = 0.035  # ... and turning less than this
    state_file: str = "auto"  # of the learnt resting pose; "auto": pose.json in systemd's state folder, else none; "": none
