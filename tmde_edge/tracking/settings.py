"""The `[tracker]` table."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0)]


class TrackerSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Kalman filter, track life and the choice of the lead. Defaults are derived in docs/tracking.md."""

    model: Literal["singer", "cv"] = "singer"  # singer: exponentially correlated acceleration; cv: the paper's [D, v]
    accel_sigma_mps2: Positive = 1.2  # rms of a vehicle's own acceleration (Singer 1970 with 6 m/s2 at most)
    accel_tau_s: Positive = 2.0  # how long such an acceleration lasts
    cv_accel_sigma_mps2: Positive = 1.0  # cv: acceleration that is white over one second
    initial_speed_sigma_mps: Positive = 8.0  # of the closing speed when a track begins
    gate_sigma: Positive = 4.0  # a range further off than this is not used ...
    gate_rejects: Annotated[int, Meta(ge=1)] = 4  # ... unless this many in a row agree with each other
    depth_error_tau_s: Positive = 4.0  # how long an error of distances by depth lasts
    depth_noise: Positive = 0.02  # relative part of it that is new in every reading
    vehicle_scale: bool = True  # growth of the vehicle's rear carries the distance while the plate is not measured
    coast_s: Positive = 2.0  # a track without any measurement ends after this
    drop_sigma: Positive = 0.3  # or when its sigma exceeds this part of its distance
    confirm_hits: Annotated[int, Meta(ge=1)] = 2  # ranges before a track can be the lead
    path_half_width_m: Positive = 1.1  # a plate nearer than this to the path's middle is in the path
    path_leave_m: Positive = 1.7  # and stays in it up to here
    standing_half_width_m: Positive = 0.9  # what never moved must overlap half of the own width ...
    standing_leave_m: Positive = 1.2  # and stays in the path up to here ...
    standing_sigma: Annotated[float, Meta(ge=0)] = 0.5  # by so many sigmas of its offset
    lead_hold_s: Positive = 0.3  # a nearer candidate must be in the path this long before it takes over
