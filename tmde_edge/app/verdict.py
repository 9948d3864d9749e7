"""Was that warning right? What speed, brake and lead say in the seconds after it; people judge the rest by the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tmde_edge.messages import FrameResult

BRAKED_MPS2 = 2.0  # slowed down harder than this: the driver answered
ANSWER_S = (-1.5, 4.0)  # between these times about the alert
RATE_OVER_S = 0.5
LOST_S = 1.0  # a lead that is gone this soon was perhaps none
YOUNG_S = 0.5
CURVE_RADPS = 0.06
MOST_LATERAL_M = 1.5


@dataclass(frozen=True, slots=True)
class Moment:
    """What matters of one result; times about the alert."""

    t_s: float
    level: str
    speed_mps: float | None
    brake: bool | None
    yaw_rate_radps: float | None
    track: int | None
    lateral_m: float | None
    distance_m: float | None
    ttc_s: float | None


def moment_of(result: FrameResult, alert_ns: int) -> Moment:
    """The short form of a result."""
    lead, ego = result.lead, result.ego
    return Moment(
        t_s=(result.t_ns - alert_ns) * 1e-9,
        level=result.alert.level,
        speed_mps=ego.speed_mps if ego is not None else None,
        brake=ego.brake_pressed if ego is not None else None,
        yaw_rate_radps=ego.yaw_rate_radps if ego is not None else None,
        track=lead.track_id if lead is not None else None,
        lateral_m=lead.lateral_m if lead is not None else None,
        distance_m=lead.distance_m if lead is not None else None,
        ttc_s=lead.ttc_s if lead is not None else None,
    )


def judge(moments: Sequence[Moment]) -> dict[str, Any]:
    """verdict "answered" (the driver braked) or "candidate" (for a false alarm), why, and the numbers behind it."""
    after = [m for m in moments if ANSWER_S[0] <= m.t_s <= ANSWER_S[1]]
    braking = hardest_braking(after)
    brake = any(m.brake for m in after)
    ttcs = [m.ttc_s for m in moments if m.ttc_s is not None and m.t_s >= 0]
    distances = [m.distance_m for m in moments if m.distance_m is not None and m.t_s >= 0]
    numbers = {
        "braking_mps2": None if braking is None else round(braking, 2),
        "brake_pressed": brake if any(m.brake is not None for m in after) else None,
        "min_ttc_s": round(min(ttcs), 2) if ttcs else None,
        "min_distance_m": round(min(distances), 2) if distances else None,
    }
    if brake or (braking is not None and braking >= BRAKED_MPS2):
        return {"verdict": "answered", "why": ["the driver braked"], **numbers}
    return {"verdict": "candidate", "why": _hints(moments, braking), **numbers}


def hardest_braking(moments: Sequence[Moment]) -> float | None:
    """The strongest deceleration over half a second, m/s^2; None where the speed is not known."""
    speeds = [(m.t_s, m.speed_mps) for m in moments if m.speed_mps is not None]
    hardest: float | None = None
    start = 0
    for t_s, speed in speeds:
        while t_s - speeds[start][0] > RATE_OVER_S + 0.1:
            start += 1
        dt_s = t_s - speeds[start][0]
        if dt_s >= 0.8 * RATE_OVER_S:
            rate = (speeds[start][1] - speed) / dt_s
            hardest = rate if hardest is None else max(hardest, rate)
    return hardest


def _hints(moments: Sequence[Moment], braking: float | None) -> list[str]:
    """What speaks for a false alarm, or why nobody can tell."""
    hints = []
    if braking is None:
        hints.append("speed not known: whether the driver braked cannot be told")
    else:
        hints.append("the driver did not brake")
    at = min(moments, key=lambda m: abs(m.t_s), default=None)
    if at is None or at.track is None:
        return hints
    times = [m.t_s for m in moments if m.track == at.track]
    last_s = max(m.t_s for m in moments)
    if max(times) < LOST_S and last_s > LOST_S:
        hints.append(f"the lead was gone {max(max(times), 0.0):.1f} s later")
    if min(times) > -YOUNG_S and min(m.t_s for m in moments) < -YOUNG_S:
        hints.append(f"the lead had been followed for {max(-min(times), 0.0):.1f} s only")
    if at.yaw_rate_radps is not None and abs(at.yaw_rate_radps) > CURVE_RADPS:
        hints.append("in a curve")
    if at.lateral_m is not None and abs(at.lateral_m) > MOST_LATERAL_M:
        hints.append(f"the lead was {abs(at.lateral_m):.1f} m to the {'right' if at.lateral_m > 0 else 'left'}")
    return hints
