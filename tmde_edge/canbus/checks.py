"""Checksums and alive counters of vehicle messages: a frame that fails updates nothing.

The rules are facts about the vehicles, taken from public reverse engineering (opendbc, MIT licence, snapshot of 2026):
Toyota, Honda, VW MQB (AUTOSAR E2E profile 2 with one list of data ids a message), Ford, Hyundai/Kia CAN and CAN FD.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from tmde_edge.canbus.bits import BitSlice
from tmde_edge.canbus.e2e import p02_check

MAX_BAD_COUNTER = 5  # as opendbc's parser

_VW_DATA_IDS: dict[int, bytes] = {  # by message id; a message that is not here cannot be checked
    0x86: bytes([0x86] * 16),
    0x9F: bytes([0xF5] * 16),
    0xFD: bytes.fromhex("b4eff8491ee5c2c097193cc9f198d661"),
    0x101: bytes([0xAA] * 16),
    0x106: bytes([0x07] * 16),
    0x116: bytes([0xAC] * 16),
    0x121: bytes.fromhex("e965ae6b7b35e55f4ec786a2bbddebb4"),
    0x3BE: bytes.fromhex("1f28c685e6f8b0195b643521e4f79c24"),
}
_HYUNDAI_FD_XOR = {8: 0x5F29, 16: 0x041D, 24: 0x819D, 32: 0x9F5B}  # by length


def toyota(can_id: int, data: bytes) -> bool:
    """Last byte: sum of length, id bytes and the bytes before it."""
    return len(data) > 1 and data[-1] == (len(data) + (can_id >> 8) + (can_id & 0xFF) + sum(data[:-1])) & 0xFF


def honda(can_id: int, data: bytes) -> bool:
    """Low nibble of the last byte: 8 less the sum of all other nibbles and those of the id (3 more for a 29-bit id)."""
    if len(data) < 2:
        return False
    total = sum(can_id >> shift & 0xF for shift in range(0, 32, 4))
    total += sum((byte & 0xF) + (byte >> 4) for byte in data[:-1]) + (data[-1] >> 4)
    return data[-1] & 0xF == (8 - total + (3 if can_id > 0x7FF else 0)) & 0xF


def vw_mqb(can_id: int, data: bytes) -> bool:
    """Byte 0: AUTOSAR E2E profile 2."""
    return can_id in _VW_DATA_IDS and p02_check(data, _VW_DATA_IDS[can_id])


def hyundai(can_id: int, data: bytes) -> bool:
    """WHL_SPD11 (0x386): number of set bits xor 9; TCS13 (0x394): 16 less the sum of nibbles."""
    if len(data) < 8:
        return False
    if can_id == 0x386:
        bits = sum((byte & 0x3F if i % 2 else byte).bit_count() for i, byte in enumerate(data[:8]))
        return (data[7] >> 6) << 2 | data[5] >> 6 == (bits ^ 9) & 0xF
    if can_id == 0x394:
        nibbles = sum((b & 0xF) + (b >> 4) for b in data[:6]) + (data[6] >> 4)
        return data[6] & 0xF == -nibbles & 0xF
    return False


def ford(can_id: int, data: bytes) -> bool:
    """BrakeSysFeatures (0x415), Yaw_Data_FD1 (0x91): 255 less the sum of the values, counter and quality flags."""
    if len(data) < 8:
        return False
    if can_id == 0x415:
        return data[3] == (0xFF - data[0] - data[1] - (data[2] >> 6) - (data[2] >> 2 & 0xF)) & 0xFF
    if can_id == 0x91:
        return data[4] == (0xFF - sum(data[:4]) - data[5] - (data[6] >> 6) - (data[6] >> 4 & 0x3)) & 0xFF
    return False


def hyundai_canfd(can_id: int, data: bytes) -> bool:
    """Bytes 0-1, little-endian: CRC-16/XMODEM over bytes 2.. and the id (low byte first), xor a constant for the length."""
    if len(data) not in _HYUNDAI_FD_XOR:
        return False
    crc = 0
    for byte in data[2:] + bytes([can_id & 0xFF, can_id >> 8 & 0xFF]):
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return int.from_bytes(data[:2], "little") == crc ^ _HYUNDAI_FD_XOR[len(data)]


Rule = Callable[[int, bytes], bool]
RULES: Mapping[str, Rule] = {
    "toyota": toyota,
    "honda": honda,
    "vw_mqb": vw_mqb,
    "ford": ford,
    "hyundai": hyundai,
    "hyundai_canfd": hyundai_canfd,
}


def verifiable(rule: str, can_id: int) -> bool:
    """False where the rule has no constants for this message."""
    if rule == "vw_mqb":
        return can_id in _VW_DATA_IDS
    if rule == "ford":
        return can_id in (0x415, 0x91)
    if rule == "hyundai":
        return can_id in (0x386, 0x394)
    return True


def implied_counter(rule: str, can_id: int) -> tuple[BitSlice, ...]:
    """Where the rule's family keeps the alive counter: its parts, least significant first; empty where it must be described."""
    if rule == "vw_mqb":
        return (BitSlice(8, 4),)
    if rule == "ford" and can_id == 0x415:
        return (BitSlice(18, 4),)
    if rule == "ford" and can_id == 0x91:
        return (BitSlice(40, 8),)
    if rule == "hyundai" and can_id == 0x386:
        return (BitSlice(14, 2), BitSlice(30, 2))
    if rule == "hyundai" and can_id == 0x394:
        return (BitSlice(13, 3),)
    if rule == "hyundai_canfd":
        return (BitSlice(16, 8),)
    return ()


@dataclass(slots=True)
class CounterState:
    """Follows one alive counter: a repeated value is never used, and after five wrong steps none is until they are made good."""

    parts: tuple[BitSlice, ...]
    last: int | None = None
    bad: int = 0

    def accept(self, data: bytes) -> bool:
        """True where this frame may be used; call it once a frame, after the checksum."""
        value = shift = 0
        for part in self.parts:
            value |= part.unsigned(data) << shift
            shift += part.length
        last, self.last = self.last, value
        if last is None:
            return True
        step = (value - last) % (1 << shift)
        if step == 1:
            self.bad = max(self.bad - 1, 0)
        else:
            self.bad = min(self.bad + 1, MAX_BAD_COUNTER)
        return step != 0 and self.bad < MAX_BAD_COUNTER
