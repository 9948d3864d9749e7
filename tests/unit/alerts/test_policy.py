"""The policy's levels, hysteresis, confirmation and suppression."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace

import pytest

from tmde_edge.alerts.policy import AlertPolicy, Situation
from tmde_edge.alerts.settings import AlertSettings

S = AlertSettings()
BASE = Situation(
    t_ns=0, present=True, gap_m=30.0, ttc_s=10.0, ttc_sigma_s=0.1, closing_mps=3.0, closing_sigma_mps=0.2,
    required_decel_mps2=0.2, headway_s=2.0, ego_speed_mps=15.0,
)  # fmt: skip


def run(policy: AlertPolicy, start_s: float, seconds: float, **changes: object) -> list[tuple[str, str]]:
    out = []
    for k in range(round(seconds * 30)):
        alert = policy.step(replace(BASE, t_ns=round((start_s + k / 30) * 1e9), **changes))  # type: ignore[arg-type]
        out.append((alert.level, alert.reason))
    return out


def test_levels_by_ttc() -> None:
    assert run(AlertPolicy(S), 0, 1, ttc_s=5.0)[-1][0] == "none"
    assert run(AlertPolicy(S), 0, 1, ttc_s=3.4)[-1] == ("caution", "ttc")
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.5)[-1] == ("warning", "ttc")


def test_one_wild_frame_says_nothing() -> None:
    p = AlertPolicy(S)
    run(p, 0, 1, ttc_s=5.0)
    assert run(p, 1, 1 / 30, ttc_s=1.0)[-1][0] == "none"
    assert run(p, 1 + 1 / 30, 1, ttc_s=5.0)[-1][0] == "none"


def test_a_warning_comes_within_confirm_time_of_its_own() -> None:
    p = AlertPolicy(S)
    run(p, 0, 1, ttc_s=3.4)
    levels = [level for level, _ in run(p, 1, 0.3, ttc_s=2.0)]
    assert levels[0] == "caution"
    assert "warning" in levels[: round(S.confirm_s * 30) + 2]


def test_hysteresis_and_hold() -> None:
    p = AlertPolicy(S)
    run(p, 0, 1, ttc_s=2.5)
    assert run(p, 1, 2, ttc_s=3.0)[-1][0] == "warning"
    after = run(p, 3, 2, ttc_s=6.0)
    assert after[-1][0] == "none"


def test_hold_keeps_the_shortest_alert() -> None:
    p = AlertPolicy(S)
    run(p, 0, 0.2, ttc_s=2.5)
    assert run(p, 0.2, 0.3, ttc_s=9.0)[-1][0] == "warning"


def changes(levels: list[tuple[str, str]]) -> int:
    return sum(a[0] != b[0] for a, b in itertools.pairwise(levels))


def test_one_frame_without_a_lead_ends_no_alert() -> None:
    p = AlertPolicy(S)
    levels = run(p, 0, 2, ttc_s=2.0) + run(p, 2, 1 / 30, present=False) + run(p, 2 + 1 / 30, 1, ttc_s=2.0)
    assert changes(levels) == 1
    assert levels[60] == ("warning", "ttc")
    gone = [level for level, _ in run(p, 3 + 1 / 30, 1, present=False)]
    assert gone[: round(S.confirm_s * 30)] == ["warning"] * round(S.confirm_s * 30)
    assert gone[round(S.confirm_s * 30) :] == ["none"] * (30 - round(S.confirm_s * 30))


def test_a_warning_ends_in_a_caution_only_where_one_is_wanted() -> None:
    p = AlertPolicy(S)
    run(p, 0, 1, ttc_s=2.0)
    assert run(p, 1, 0.5, ttc_s=3.9)[-1] == ("caution", "ttc")
    run(p, 1.5, 1, ttc_s=2.0)
    assert "caution" not in {level for level, _ in run(p, 2.5, 1, ttc_s=9.0)}


@pytest.mark.parametrize("metric", [True, False])
def test_no_flicker_where_the_closing_is_just_certain(metric: bool) -> None:
    """1.15 m/s and a little noise, 2.6 m ahead: one warning, not thirty."""
    rng = random.Random(1)
    p, levels = AlertPolicy(S), []
    for k in range(600):
        closing = 1.15 + rng.gauss(0, 0.05)
        now = replace(BASE, t_ns=round(k / 30 * 1e9), ttc_s=2.6 / closing, closing_mps=closing, closing_sigma_mps=0.1, gap_m=2.6)
        if not metric:
            now = replace(now, gap_m=None, closing_mps=None, closing_sigma_mps=None, ttc_s=2.2, ttc_sigma_s=0.84 / closing)
        levels.append((p.step(now).level, ""))
    assert changes(levels) == 1
    assert levels[-1][0] == "warning"


def test_a_standing_caution_makes_no_warning_easier() -> None:
    """Closing that is too uncertain to warn of stays so beside a caution by headway."""
    close = {"ttc_s": 3.0, "closing_mps": 1.1, "closing_sigma_mps": 0.2, "headway_s": 0.5}
    assert {level for level, _ in run(AlertPolicy(S), 0, 3, **close)} == {"none", "caution"}


def test_headway_never_warns() -> None:
    assert run(AlertPolicy(S), 0, 2, ttc_s=None, closing_mps=0.0, headway_s=0.2)[-1] == ("caution", "headway")


def test_uncertain_closing_is_silent() -> None:
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.5, closing_mps=2.0, closing_sigma_mps=2.0)[-1][0] == "none"


def test_speed_gate_with_hysteresis() -> None:
    p = AlertPolicy(S)
    assert run(p, 0, 1, ttc_s=2.0, ego_speed_mps=3.9)[-1][0] == "none"
    assert run(p, 1, 1, ttc_s=2.0, ego_speed_mps=4.3)[-1][0] == "warning"
    assert run(p, 2, 1, ttc_s=2.0, ego_speed_mps=3.5)[-1][0] == "warning"
    assert run(p, 3, 2, ttc_s=2.0, ego_speed_mps=3.0)[-1][0] == "none"


def test_parking_by_distance() -> None:
    p = AlertPolicy(S)
    assert run(p, 0, 1, ego_speed_mps=0.5, gap_m=0.4, closing_mps=0.3)[-1] == ("caution", "parking")


def test_braking_driver_is_left_alone() -> None:
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.0, brake_pressed=True)[-1][0] == "none"


def test_uncalibrated_ttc_still_warns() -> None:
    metric_free = {
        "gap_m": None,
        "closing_mps": None,
        "closing_sigma_mps": None,
        "required_decel_mps2": None,
        "headway_s": None,
    }
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.0, ttc_sigma_s=0.3, **metric_free)[-1][0] == "warning"
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.0, ttc_sigma_s=3.0, **metric_free)[-1][0] == "none"


def test_required_deceleration() -> None:
    assert run(AlertPolicy(S), 0, 1, ttc_s=3.9, required_decel_mps2=6.0)[-1] == ("warning", "deceleration")


def test_nothing_but_headway_above_the_highest_ttc() -> None:
    early = AlertSettings(warning_ttc_s=3.9, caution_ttc_s=4.0)
    p = AlertPolicy(early)
    assert run(p, 0, 1, ttc_s=3.8)[-1] == ("warning", "ttc")
    assert run(p, 1, 1, ttc_s=4.2)[-1][0] == "none"  # nor by hysteresis
    assert run(p, 2, 1, ttc_s=4.2, headway_s=0.5)[-1] == ("caution", "headway")


def test_what_never_moved_is_told_of_late() -> None:
    """A car that stands at the bend's outer kerb lies ahead until the bend begins."""
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.7, required_decel_mps2=8.0, standing=True)[-1][0] == "none"
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.3, closing_mps=20.0, standing=True)[-1] == ("warning", "ttc")
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.3, closing_mps=12.0, standing=True)[-1][0] == "none"
    assert run(AlertPolicy(S), 0, 1, ttc_s=2.7, standing=False)[-1] == ("warning", "ttc")


def test_the_turn_signal_holds_back_cautions_and_never_warnings() -> None:
    s = AlertSettings(suppress_on_turn_signal=True)
    assert run(AlertPolicy(s), 0, 1, ttc_s=3.4, turn_signal="left")[-1][0] == "none"
    assert run(AlertPolicy(s), 0, 1, ttc_s=None, closing_mps=0.0, headway_s=0.2, turn_signal="right")[-1][0] == "none"
    assert run(AlertPolicy(s), 0, 1, ttc_s=2.0, turn_signal="left")[-1] == ("warning", "ttc")
    assert run(AlertPolicy(S), 0, 1, ttc_s=3.4, turn_signal="left")[-1] == ("caution", "ttc")
