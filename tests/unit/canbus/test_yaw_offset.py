"""The zero offset of the yaw rate: found at standstill, on straight roads and by the lane, not made up in bends."""

from __future__ import annotations

import math
import random

import pytest

from tmde_edge.canbus.yaw_offset import YawOffset

DEG = math.pi / 180
S = 1_000_000_000


def drive(
    offset: YawOffset, seconds: float, true_dps, bias_dps: float, speed_mps: float, start_s: float = 0.0, seed: int = 1
) -> None:
    noise = random.Random(seed)
    for n in range(int(seconds * 50)):
        t_s = start_s + n / 50
        raw_dps = true_dps(t_s) + bias_dps + noise.gauss(0, 0.1)
        raw_dps = round(raw_dps / 0.244) * 0.244  # what a real sensor's step does
        offset.observe(round(t_s * S), raw_dps * DEG, speed_mps)


@pytest.mark.parametrize("bias_dps", [-1.0, -0.43, 0.0, 0.8])
def test_standstill_finds_it_in_seconds(bias_dps: float) -> None:
    offset = YawOffset()
    drive(offset, 10, lambda t: 0.0, bias_dps, 0.0)
    assert offset.offset_radps / DEG == pytest.approx(bias_dps, abs=0.08)
    assert offset.sigma_radps / DEG < 0.05


@pytest.mark.parametrize("seed", range(5))
def test_a_minute_of_straight_road(seed: int) -> None:
    offset = YawOffset()
    wander = random.Random(seed).uniform(0, 6)
    drive(offset, 60, lambda t: 0.25 * math.sin(t / 2 + wander), -0.43, 18.0, seed=seed)
    assert offset.offset_radps / DEG == pytest.approx(-0.43, abs=0.15)
    assert abs(offset.offset_radps / DEG + 0.43) < 3 * offset.sigma_radps / DEG


def test_turns_in_town_are_not_taken_for_an_offset() -> None:
    offset = YawOffset()
    drive(offset, 60, lambda t: 20.0 * math.sin(t / 4), 0.0, 12.0)
    assert abs(offset.offset_radps / DEG) < 0.15


def test_a_long_bend_after_settling_moves_it_little() -> None:
    offset = YawOffset()
    drive(offset, 60, lambda t: 0.2 * math.sin(t), -0.4, 20.0)
    drive(offset, 20, lambda t: 2.3, -0.4, 20.0, start_s=61)  # radius 500 m
    assert offset.offset_radps / DEG == pytest.approx(-0.4, abs=0.2)


def test_the_lane_teaches_it_in_a_bend() -> None:
    offset = YawOffset()
    for n in range(200):
        t_ns = n * S // 20
        offset.observe(t_ns, (4.0 + 0.6) * DEG, 15.0)
        offset.observe_lane_yaw(t_ns, 4.0 * DEG, 0.5 * DEG)
    assert offset.offset_radps / DEG == pytest.approx(0.6, abs=0.1)


def test_slow_driving_and_broken_values_teach_nothing() -> None:
    offset = YawOffset()
    drive(offset, 20, lambda t: 0.0, 0.7, 3.0)
    assert offset.offset_radps == 0.0
    offset.observe_lane_yaw(20 * S, math.nan, 0.1)
    offset.observe_lane_yaw(20 * S, 0.1, 0.0)
    offset.observe_lane_yaw(200 * S, 0.1, 0.1)  # no raw reading near it
    assert offset.offset_radps == 0.0


def test_time_that_jumps_begins_a_new_window() -> None:
    offset = YawOffset()
    for n in range(1000):
        offset.observe(n % 2 * 10**12, 5 * DEG, 0.0)
    assert offset.offset_radps == 0.0
