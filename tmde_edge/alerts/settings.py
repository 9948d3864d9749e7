"""The `[alerts]` table. Every default is argued in docs/alerts.md."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


class AlertSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Thresholds of caution and warning."""

    warning_ttc_s: Positive = 3.2  # NHTSA FCW: at or before 2.4 s of a braking lead; margin for noticing that it brakes
    standing_ttc_s: Positive = 2.5  # warning and caution for what never moved, at the most: mostly it is parked ...
    standing_reaction_s: Positive = 1.0  # ... and not before a driver who takes so long ...
    standing_decel_mps2: Positive = 7.0  # ... and brakes so hard has to be told (NHTSA FCW: 2.1 s at 20 m/s)
    caution_ttc_s: Positive = 3.6  # GB/T 33577: nothing above 4 s
    max_ttc_s: Positive = 4.0  # no alert of any reason but headway above this TTC
    warning_decel_mps2: Positive = 5.0  # required deceleration v^2 / (2 D)
    caution_headway_s: NotNegative = 0.6  # 0: off. Headway never raises a warning
    hysteresis: Annotated[float, Meta(ge=1)] = 1.2  # an alert ends when its threshold times this is passed
    confirm_s: NotNegative = 0.1  # the condition must hold this long
    hold_s: NotNegative = 0.8  # shortest alert
    confidence_sigma: NotNegative = 1.5  # closing must be certain by this many sigmas
    active_speed_mps: NotNegative = 4.2  # on from here (GB/T 33577: relative speed min) ...
    inactive_speed_mps: NotNegative = 3.3  # ... off below here
    min_closing_mps: NotNegative = 1.0  # slower closing never alerts by TTC
    parking_distance_m: NotNegative = 0.5  # below inactive speed: caution nearer than this while closing; 0: off
    suppress_on_brake: bool = True  # where the brake signal is configured: no caution and no warning while braking
    suppress_on_turn_signal: bool = False  # where configured: a set indicator holds back cautions
    command: list[str] = []  # run by the service as COMMAND LEVEL REASON TTC when the level changes; empty: none
    command_timeout_s: Positive = 2.0  # it is killed after this
