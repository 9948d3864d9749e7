"""AUTOSAR E2E profile 2: CRC-8H2F in byte 0, a 4-bit counter in the low half of byte 1 (SWS E2E Library, R4.x, ch. 7.4)."""

from __future__ import annotations


def _table(poly: int) -> tuple[int, ...]:
    rows = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ poly if value & 0x80 else value << 1
        rows.append(value & 0xFF)
    return tuple(rows)


_CRC8H2F = _table(0x2F)


def crc8h2f(data: bytes, crc: int = 0xFF) -> int:
    """CRC-8 with polynomial 0x2F, start 0xFF, final inversion; "123456789" gives 0xDF. Raw, to continue: xor 0xFF again."""
    for byte in data:
        crc = _CRC8H2F[crc ^ byte]
    return crc ^ 0xFF


def p02_crc(data: bytes, data_ids: bytes) -> int:
    """Byte 0 of a profile 2 frame: over bytes 1.. and then the data id that belongs to the counter in byte 1."""
    return crc8h2f(data[1:] + data_ids[data[1] & 0x0F : (data[1] & 0x0F) + 1])


def p02_protect(data: bytearray, data_ids: bytes, counter: int) -> None:
    """Writes counter (0..15) and CRC in place; `data_ids` has 16 bytes."""
    data[1] = data[1] & 0xF0 | counter & 0x0F
    data[0] = p02_crc(bytes(data), data_ids)


def p02_check(data: bytes, data_ids: bytes) -> bool:
    """True where the frame is long enough and its CRC is right."""
    return len(data) >= 2 and data[0] == p02_crc(data, data_ids)
