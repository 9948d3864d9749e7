"""The rangefinder on a serial port: lines of many makes, and a port that comes and goes."""

from __future__ import annotations

import os
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.adapters.range_port import RangePort, parse_line
from tmde_edge.config import RecordConfig
from tmde_edge.messages import RangeReference


@pytest.mark.parametrize(
    ("line", "unit", "field", "metres"),
    [
        ("12.345\r\n", "m", 0, 12.345),
        ("D=7.250m,S=0\n", "m", 0, 7.25),
        ("D: 5.123m, 0034\n", "m", 0, 5.123),
        ("1234\n", "mm", 0, 1.234),
        ("1234 cm\n", "m", 0, 12.34),
        ("17.5,240,12\n", "m", 1, 17.5),
        ("240;x,17.5,3\n", "m", 2, 17.5),
        ("$RNG,11.20,M*3A\n", "m", 2, 11.2),
        ("$RNG,1120,CM\n", "m", 2, 11.2),
        ("$RNG,11.20,M*00\n", "m", 2, None),  # a wrong checksum
        ("ERR 1\n", "m", 0, None),
        ("NO TARGET\n", "m", 0, None),
        ("-1\n", "m", 0, None),
        ("0.000\n", "m", 0, None),
        ("99999\n", "m", 0, None),
        ("10\n", "ft", 0, 3.048),
        ("1,2\n", "m", 5, None),
        ("", "m", 0, None),
    ],
)
def test_lines_of_many_makes(line: str, unit: str, field: int, metres: float | None) -> None:
    found = parse_line(line, unit, field)
    assert found == (None if metres is None else pytest.approx(metres))


@given(st.text(max_size=80), st.sampled_from(["m", "cm", "mm", "ft"]), st.integers(0, 6))
def test_any_line_is_survived(line: str, unit: str, field: int) -> None:
    found = parse_line(line, unit, field)
    assert found is None or 0 < found <= 1000


def test_the_checksum_of_the_example_is_right() -> None:
    value = 0
    for byte in b"RNG,11.20,M":
        value ^= byte
    assert f"{value:02X}" == "3A"


def until(true: object, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not true():  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_port_that_comes_late_and_goes(tmp_path: Path) -> None:
    link = tmp_path / "laser"
    got: list[RangeReference] = []
    port = RangePort(RecordConfig(range_device=str(link)), got.append)
    port.start()
    try:
        for distance in (7.5, 8.5):  # the second after it was pulled out
            master, slave = os.openpty()
            tty.setraw(slave)
            link.unlink(missing_ok=True)
            link.symlink_to(os.ttyname(slave))
            count, before_ns = len(got), time.monotonic_ns()
            while len(got) == count:
                os.write(master, f"D={distance:.3f}m\n".encode())
                time.sleep(0.05)
                assert time.monotonic_ns() - before_ns < 15e9
            assert got[-1].distance_m == distance
            assert before_ns <= got[-1].t_ns <= time.monotonic_ns()
            os.close(slave)
            os.close(master)
    finally:
        port.close()


@contextmanager
def rangefinder() -> Iterator[tuple[int, list[RangeReference]]]:
    """The instrument's end of the line, and what a port that is open on the other end has heard."""
    master, slave = os.openpty()
    tty.setraw(slave)
    got: list[RangeReference] = []
    port = RangePort(RecordConfig(range_device=os.ttyname(slave)), got.append)
    port.start()
    try:
        yield master, got
    finally:
        port.close()
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize(
    ("writes", "expected_m"),
    [
        ([b"12.3", 0.7, b"45\r\n", b"7.25\r\n"], [12.345, 7.25]),  # the bytes of a line come with a pause
        ([b"9" * 230 + b" 3.5\n", b"7.25\n"], [7.25]),  # the tail of an endless line is no line
    ],
)
def test_a_part_of_a_line_is_no_measurement(writes: list[bytes | float], expected_m: list[float]) -> None:
    with rangefinder() as (line, got):
        time.sleep(0.8)  # open, and silent for so long that what comes begins a line
        for what in writes:
            time.sleep(what) if isinstance(what, float) else os.write(line, what)
        until(lambda: len(got) >= len(expected_m))
        assert [g.distance_m for g in got] == pytest.approx(expected_m)


def test_a_port_that_opens_in_the_middle_of_a_line_waits_for_the_next() -> None:
    with rangefinder() as (line, got):
        time.sleep(0.2)  # open, but nothing says that a line begins here
        os.write(line, b"345\n12.345\n")
        until(lambda: bool(got))
        assert [g.distance_m for g in got] == [12.345]
