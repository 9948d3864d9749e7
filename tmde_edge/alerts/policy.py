"""When to say something: TTC, required deceleration, headway; hysteresis, confirmation, shortest duration, reasons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tmde_edge.alerts.settings import AlertSettings
from tmde_edge.messages import Alert, AlertLevel

_ORDER: dict[AlertLevel, int] = {"none": 0, "caution": 1, "warning": 2}
_RAISED: tuple[AlertLevel, ...] = ("warning", "caution")


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """What the policy judges: the lead in the path against the own bumper. None: not known."""

    t_ns: int
    present: bool = False
    gap_m: float | None = None
    ttc_s: float | None = None  # braking of the lead counted
    ttc_sigma_s: float | None = None
    closing_mps: float | None = None  # positive when closing
    closing_sigma_mps: float | None = None
    required_decel_mps2: float | None = None
    headway_s: float | None = None
    ego_speed_mps: float | None = None
    standing: bool = False  # was never seen to move, and no lane tells that it stands in the path
    brake_pressed: bool | None = None
    turn_signal: Literal["left", "right", "none"] | None = None


class AlertPolicy:
    """Holds the alert's state between frames; time comes in the Situation."""

    def __init__(self, settings: AlertSettings) -> None:
        self._s = settings
        self._active = False
        self._alert = Alert()
        self._since_ns = 0
        self._judged: dict[AlertLevel, tuple[bool, int]] = dict.fromkeys(_RAISED, (False, 0))  # wanted or not, since when

    def step(self, now: Situation) -> Alert:
        """The alert of this moment. A level comes when it has been wanted for confirm_s, and goes when unwanted as long."""
        level, reason = self._wanted(now)
        current = self._alert.level
        for name in _RAISED:
            wanted = _ORDER[level] >= _ORDER[name]
            if wanted != self._judged[name][0]:
                self._judged[name] = wanted, now.t_ns
        sure = {n: w for n, (w, t) in self._judged.items() if (now.t_ns - t) * 1e-9 >= self._s.confirm_s - 1e-9}
        if _ORDER[level] > _ORDER[current]:
            if sure.get(level):
                self._set(level, reason, now)
            elif current == "none" and sure.get("caution"):
                self._set("caution", reason, now)
        elif level == current:
            if level != "none":
                self._alert = Alert(level=level, reason=reason, ttc_s=now.ttc_s)
        else:
            left: AlertLevel = next((n for n in _RAISED if sure.get(n, True)), "none")
            held = (now.t_ns - self._since_ns) * 1e-9 < self._s.hold_s
            if held or _ORDER[left] >= _ORDER[current]:
                self._alert = Alert(level=current, reason=self._alert.reason, ttc_s=now.ttc_s)
            else:
                self._set(left, reason or self._alert.reason, now)
        return self._alert

    def _set(self, level: AlertLevel, reason: str, now: Situation) -> None:
        self._since_ns = now.t_ns
        self._alert = Alert() if level == "none" else Alert(level=level, reason=reason, ttc_s=now.ttc_s)

    def _wanted(self, now: Situation) -> tuple[AlertLevel, str]:
        s = self._s
        speed = now.ego_speed_mps
        if speed is not None:
            self._active = speed >= (s.inactive_speed_mps if self._active else s.active_speed_mps)
            if not self._active:
                return self._parking(now)
        if not now.present or (s.suppress_on_brake and now.brake_pressed):
            return "none", ""
        ease = [s.hysteresis if _ORDER[self._alert.level] >= n else 1.0 for n in (0, 1, 2)]
        if now.ttc_s is not None and self._closing(now, ease[1]):
            warning_s, caution_s = s.warning_ttc_s, s.caution_ttc_s
            if now.standing:
                last_s = min(s.standing_ttc_s, self._last_moment_s(now))
                warning_s, caution_s = min(warning_s, last_s), min(caution_s, last_s)
            if self._closing(now, ease[2]):
                if now.ttc_s <= min(warning_s * ease[2], s.max_ttc_s):
                    return "warning", "ttc"
                within = now.ttc_s <= (warning_s if now.standing else s.max_ttc_s)
                decel = now.required_decel_mps2
                if within and decel is not None and decel >= s.warning_decel_mps2 / ease[2]:
                    return "warning", "deceleration"
            if not self._held_back(now) and now.ttc_s <= min(caution_s * ease[1], s.max_ttc_s):
                return "caution", "ttc"
        if (
            now.headway_s is not None
            and s.caution_headway_s > 0
            and now.headway_s <= s.caution_headway_s * ease[1]
            and not self._held_back(now)
        ):
            return "caution", "headway"
        return "none", ""

    def _parking(self, now: Situation) -> tuple[AlertLevel, str]:
        limit = self._s.parking_distance_m * (self._s.hysteresis if self._alert.level != "none" else 1.0)
        near = now.gap_m is not None and limit > 0 and now.gap_m <= limit
        if now.present and near and (now.closing_mps or 0.0) > 0.02:
            return "caution", "parking"
        return "none", ""

    def _closing(self, now: Situation, ease: float) -> bool:
        """Closing for certain: by confidence_sigma above the least closing speed that matters."""
        if now.closing_mps is None:
            # Without metres only the relative sigma of TTC says how certain the closing is.
            if now.ttc_s is None or now.ttc_sigma_s is None:
                return False
            return now.ttc_sigma_s * max(self._s.confidence_sigma, 0.5) <= 0.5 * now.ttc_s * ease
        sigma = now.closing_sigma_mps or 0.0
        return now.closing_mps * ease - self._s.confidence_sigma * sigma >= self._s.min_closing_mps

    def _last_moment_s(self, now: Situation) -> float:
        """TTC at which a standing obstacle must be told of: reaction, then half of the time to brake to a stop."""
        closing = now.closing_mps if now.closing_mps is not None else now.ego_speed_mps or 0.0
        return self._s.standing_reaction_s + closing / (2.0 * self._s.standing_decel_mps2)

    def _held_back(self, now: Situation) -> bool:
        return self._s.suppress_on_turn_signal and now.turn_signal in ("left", "right")
