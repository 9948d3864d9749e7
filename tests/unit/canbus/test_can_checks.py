"""E2E profile 2 against AUTOSAR's rules and the oracle; vehicle checksums against recorded frames; alive counters."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.canbus.bits import BitSlice
from tmde_edge.canbus.checks import RULES, CounterState, implied_counter, verifiable
from tmde_edge.canbus.e2e import crc8h2f, p02_check, p02_protect

# Frames recorded from a Golf (ESP_21, public test vectors of opendbc), one for each counter value.
VW_ESP_21 = [
    "66d01f8045050000", "87d11f8052050000", "cdd21f8050060000", "fdd31f8035020000", "fad41f8022050000", "fdd51f8084040000",
    "2ed61f80f0030000", "9fd71f8000000000", "1ed81f80b3030000", "61d91f806d050000", "44da1f8047020000", "86db1f803a020000",
    "39dc1f80cb010000", "19dd1f8000000000", "8cde1f80ba040000", "fbdf1f8046000000",
]  # fmt: skip


def test_crc_check_value() -> None:
    assert crc8h2f(b"123456789") == 0xDF  # CRC-8/AUTOSAR (SWS CRC Library, table of check values)


def test_profile_2_vector() -> None:
    data = bytearray(bytes([0, 0, 0x10, 0x11, 0x12, 0x13, 0x14, 0x15]))
    p02_protect(data, bytes(range(16)), 5)
    assert data.hex() == "df05101112131415"
    assert p02_check(bytes(data), bytes(range(16)))


@given(st.binary(min_size=2, max_size=8), st.binary(min_size=16, max_size=16), st.integers(0, 15))
def test_profile_2_equals_the_oracle(payload: bytes, ids: bytes, counter: int) -> None:
    p02 = pytest.importorskip("e2e.p02", reason="autosar-e2e has no wheel for this machine")
    ours = bytearray(payload)
    p02_protect(ours, ids, counter)
    theirs = bytearray(payload)
    theirs[1] = theirs[1] & 0xF0 | counter
    p02.e2e_p02_protect(theirs, ids, increment_counter=False)
    assert ours == theirs
    assert p02.e2e_p02_check(bytes(ours), ids)


@pytest.mark.parametrize("frame", VW_ESP_21)
def test_vw_frames_pass_and_one_flipped_bit_fails(frame: str) -> None:
    data = bytes.fromhex(frame)
    assert RULES["vw_mqb"](0xFD, data)
    for bit in range(64):
        wrong = (int.from_bytes(data, "little") ^ 1 << bit).to_bytes(8, "little")
        assert not RULES["vw_mqb"](0xFD, wrong)


def test_toyota_rule_by_hand() -> None:
    # length 8 + id 0x00 + 0xB4 + 0x1D + 0x0B + 0x7A = 0x15E
    assert RULES["toyota"](0xB4, bytes.fromhex("000000001d0b7a5e"))
    assert not RULES["toyota"](0xB4, bytes.fromhex("000000001d0b7b5e"))


def test_honda_rule_by_hand() -> None:
    # id 1+5+8, data 1+2+3+4, counter nibble 2: total 26, 8 - 26 = -18 = 14 mod 16
    assert RULES["honda"](0x158, bytes.fromhex("123400000000002e"))
    assert not RULES["honda"](0x158, bytes.fromhex("123500000000002e"))
    # a 29-bit id adds 3
    assert RULES["honda"](
        0x12F85158, bytes([0x12, 0x34, 0, 0, 0, 0, 0, 0x20 | (8 - (1 + 2 + 15 + 8 + 5 + 1 + 5 + 8) - 12 + 3) & 15])
    )


def test_hyundai_rules_by_hand() -> None:
    # 0x386: three bits set outside counter and checksum; 3 xor 9 = 10 = 0b1010: high pair in byte 7, low pair in byte 5
    data = bytearray(bytes.fromhex("0700000000000000"))
    data[7] |= 0b10 << 6
    data[5] |= 0b10 << 6
    assert RULES["hyundai"](0x386, bytes(data))
    data[1] |= 0xC0  # the counter is not summed
    assert RULES["hyundai"](0x386, bytes(data))
    data[0] ^= 8
    assert not RULES["hyundai"](0x386, bytes(data))
    # 0x394: nibbles 1+2+3, checksum 16 - 6
    assert RULES["hyundai"](0x394, bytes.fromhex("1230000000000aff"))
    assert not RULES["hyundai"](0x394, bytes.fromhex("1330000000000aff"))


def test_hyundai_canfd_rule_against_a_plain_crc() -> None:
    def crc16_xmodem(data: bytes) -> int:
        register = int.from_bytes(data + b"\0\0", "big")
        for shift in range(8 * len(data) - 1, -1, -1):  # long division by x^16 + x^12 + x^5 + 1
            if register >> shift + 16 & 1:
                register ^= 0x11021 << shift
        return register

    body = bytes(range(1, 23))
    crc = crc16_xmodem(body + bytes([0xA0, 0x00])) ^ 0x819D
    assert RULES["hyundai_canfd"](0xA0, crc.to_bytes(2, "little") + body)
    assert not RULES["hyundai_canfd"](0xA1, crc.to_bytes(2, "little") + body)


def test_ford_rules_by_hand() -> None:
    assert RULES["ford"](0x415, bytes([0x10, 0x20, 0b11_0101_00, 0xFF - 0x10 - 0x20 - 3 - 5, 0, 0, 0, 0]))
    assert not RULES["ford"](0x415, bytes([0x11, 0x20, 0b11_0101_00, 0xFF - 0x10 - 0x20 - 3 - 5, 0, 0, 0, 0]))
    assert RULES["ford"](0x91, bytes([1, 2, 3, 4, 0xFF - 10 - 9 - 3 - 2, 9, 0b11_10_0000, 0]))


@given(st.sampled_from(sorted(RULES)), st.integers(0, 0x1FFFFFFF), st.binary(max_size=64))
def test_no_payload_breaks_a_rule(rule: str, can_id: int, data: bytes) -> None:
    assert RULES[rule](can_id, data) in (True, False)


def test_a_message_without_constants_cannot_be_checked() -> None:
    assert not verifiable("vw_mqb", 0x123)
    assert verifiable("toyota", 0x123)


def test_counter_repeats_are_refused_and_single_losses_are_not() -> None:
    state = CounterState(implied_counter("vw_mqb", 0xFD))
    frames = [bytes([0, n]) for n in range(16)]
    assert [state.accept(frames[n]) for n in (14, 15, 0, 1)] == [True] * 4  # wraps
    assert not state.accept(frames[1])  # frozen sender
    assert state.accept(frames[3])  # one lost
    assert state.accept(frames[4])


def test_counter_that_runs_wrong_is_refused_until_it_has_made_good() -> None:
    state = CounterState((BitSlice(0, 4),))
    used = [state.accept(bytes([n * 5 % 16])) for n in range(12)]
    assert used[:5] == [True] * 5
    assert used[6:] == [False] * 6
    last = 11 * 5 % 16
    good = [state.accept(bytes([(last + 1 + n) % 16])) for n in range(3)]
    assert good == [True, True, True]


def test_a_counter_in_two_parts() -> None:
    state = CounterState(implied_counter("hyundai", 0x386))
    first = bytes([0, 0b11 << 6, 0, 0b00 << 6, 0, 0, 0, 0])  # 3
    second = bytes([0, 0b00 << 6, 0, 0b01 << 6, 0, 0, 0, 0])  # 4
    assert state.accept(first)
    assert state.accept(second)
    assert state.bad == 0
