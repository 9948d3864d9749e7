"""Load is shed in the stated order, and taken up again when there is room."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.app.shedding import DOWN_S, LEVELS, Load, Shedder


def drive(shedder: Shedder, load: Load, seconds: float, start_s: float = 0.0) -> list[tuple[float, int]]:
    """Steps four times a second; the changes as (time, level)."""
    changes = []
    for i in range(round(seconds * 4)):
        if shedder.step(start_s + i / 4, load):
            changes.append((start_s + i / 4, shedder.level))
    return changes


def test_lateness_sheds_depth_then_searches_then_frames() -> None:
    shedder = Shedder()
    assert [level for _, level in drive(shedder, Load(late_s=0.5), 20)] == [1, 2, 3]
    assert (shedder.depth_factor, shedder.search_factor, shedder.frame_factor) == (4, 2, 2)
    assert LEVELS[shedder.level] == "frames"


def test_skipped_frames_alone_never_cost_frames() -> None:
    shedder = Shedder()
    drive(shedder, Load(skipped=0.5, busy=1.0), 60)
    assert shedder.level == 2
    assert shedder.frame_factor == 1


def test_a_short_burst_changes_nothing() -> None:
    shedder = Shedder()
    assert not drive(shedder, Load(skipped=0.5), 1.5)
    assert not drive(shedder, Load(), 1.0, 2.0)
    assert not drive(shedder, Load(skipped=0.5), 1.5, 4.0)


def test_heat_sheds_at_once_and_then_slowly() -> None:
    shedder = Shedder()
    changes = drive(shedder, Load(hot=True, busy=0.2), 70)
    assert changes[0] == (0.0, 1)
    assert [level for _, level in changes] == [1, 2, 3]
    assert changes[1][0] - changes[0][0] >= 20


def test_room_brings_it_back_step_by_step_but_a_busy_board_stays() -> None:
    shedder = Shedder()
    drive(shedder, Load(late_s=0.5), 20)
    assert not drive(shedder, Load(busy=0.9), 60, 20)
    changes = drive(shedder, Load(busy=0.3), 60, 80)
    assert [level for _, level in changes] == [2, 1, 0]
    assert changes[0][0] - 80 == pytest.approx(DOWN_S, abs=0.3)


def test_vain_tries_become_rarer() -> None:
    shedder = Shedder()
    downs: list[float] = []
    for i in range(4 * 600):
        slow = shedder.level == 0  # one level is just enough
        if shedder.step(i / 4, Load(late_s=0.5 if slow else 0.0, busy=0.3)) and shedder.level == 0:
            downs.append(i / 4)
    gaps = [b - a for a, b in itertools.pairwise(downs)]
    assert len(gaps) >= 3
    assert gaps[-1] > 3 * gaps[0]


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1), st.booleans()), max_size=200))
def test_never_more_than_one_level_at_a_time(loads: list[tuple[float, float, float, bool]]) -> None:
    shedder = Shedder()
    for i, (skipped, busy, late_s, hot) in enumerate(loads):
        before = shedder.level
        changed = shedder.step(float(i), Load(skipped=skipped, busy=busy, late_s=late_s, hot=hot))
        assert abs(shedder.level - before) == int(changed)
        assert 0 <= shedder.level < len(LEVELS)
