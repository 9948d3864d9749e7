"""Raw bits against cantools, over every place, length, byte order and sign."""

from __future__ import annotations

import pytest
from cantools.database import load_string
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.canbus.bits import BitSlice, put


@st.composite
def slices(draw: st.DrawFn) -> tuple[BitSlice, int]:
    """A slice that lies within a payload of 1 to 8 bytes, and that payload's size."""
    size = draw(st.integers(1, 8))
    big = draw(st.booleans())
    first = draw(st.integers(0, 8 * size - 1))
    length = draw(st.integers(1, 8 * size - first))
    start = 8 * (first // 8) + 7 - first % 8 if big else first
    return BitSlice(start, length, big, draw(st.booleans())), size


def _cantools(bits: BitSlice, size: int):
    order, sign = (0 if bits.big_endian else 1), ("-" if bits.signed else "+")
    text = f'VERSION ""\nBU_:\nBO_ 1 M: {size} X\n SG_ S : {bits.start_bit}|{bits.length}@{order}{sign} (1,0) [0|0] "" X\n'
    return load_string(text, database_format="dbc", strict=True).messages[0]


@settings(max_examples=80, deadline=None)
@given(slices(), st.binary(min_size=8, max_size=8))
def test_raw_value_is_what_cantools_decodes(case: tuple[BitSlice, int], payload: bytes) -> None:
    bits, size = case
    data = payload[:size]
    assert bits.raw(data) == _cantools(bits, size).decode(data)["S"]
    assert bits.bytes_needed <= size


@settings(max_examples=80, deadline=None)
@given(slices(), st.binary(min_size=8, max_size=8), st.integers(0))
def test_put_writes_what_reads_back_and_nothing_else(case: tuple[BitSlice, int], payload: bytes, value: int) -> None:
    bits, size = case
    value %= bits.all_ones + 1
    data = bytearray(payload[:size])
    put(data, bits, value)
    assert bits.unsigned(bytes(data)) == value
    put(data, bits, bits.unsigned(payload[:size]))
    assert bytes(data) == payload[:size]


def test_put_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="does not fit 4 bits"):
        put(bytearray(2), BitSlice(0, 4), 16)
    with pytest.raises(ValueError, match="does not fit"):
        put(bytearray(2), BitSlice(0, 4), -1)
