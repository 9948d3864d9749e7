"""Raw bits of a CAN payload, in DBC numbering: little-endian start is the least, big-endian start the most significant bit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BitSlice:
    """Where one raw value lies in a payload."""

    start_bit: int
    length: int
    big_endian: bool = False
    signed: bool = False

    @property
    def bytes_needed(self) -> int:
        """Payload bytes that must be there."""
        if self.big_endian:
            return (_sequential(self.start_bit) + self.length + 7) // 8
        return (self.start_bit + self.length + 7) // 8

    @property
    def all_ones(self) -> int:
        """The unsigned raw value with every bit set."""
        return (1 << self.length) - 1

    def unsigned(self, data: bytes) -> int:
        """The raw bits as an unsigned number; the payload must be long enough."""
        if self.big_endian:
            shift = len(data) * 8 - _sequential(self.start_bit) - self.length
            return (int.from_bytes(data, "big") >> shift) & self.all_ones
        return (int.from_bytes(data, "little") >> self.start_bit) & self.all_ones

    def raw(self, data: bytes) -> int:
        """The raw value, two's complement where signed; the payload must be long enough."""
        value = self.unsigned(data)
        if self.signed and value >> (self.length - 1):
            value -= 1 << self.length
        return value


def put(data: bytearray, bits: BitSlice, value: int) -> None:
    """Writes an unsigned raw value. Raises ValueError where it does not fit (a caller saturates before)."""
    if not 0 <= value <= bits.all_ones:
        raise ValueError(f"raw value {value} does not fit {bits.length} bits")
    order = "big" if bits.big_endian else "little"
    shift = len(data) * 8 - _sequential(bits.start_bit) - bits.length if bits.big_endian else bits.start_bit
    whole = int.from_bytes(data, order)  # type: ignore[arg-type]
    whole = whole & ~(bits.all_ones << shift) | value << shift
    data[:] = whole.to_bytes(len(data), order)  # type: ignore[arg-type]


def _sequential(start_bit: int) -> int:
    """Position of a DBC bit counted from the most significant bit of byte 0."""
    return 8 * (start_bit // 8) + 7 - start_bit % 8
