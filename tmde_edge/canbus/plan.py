"""The plan of what to read from which message: immutable, built once from the configuration (decoder.py)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from tmde_edge.canbus.bits import BitSlice
from tmde_edge.canbus.j1939 import pgn_of

Quantity: TypeAlias = Literal["speed", "yaw_rate", "brake", "turn_signal"]
MessageKey: TypeAlias = tuple[int, bool | None]  # id and whether it is extended; J1939: PGN and None


@dataclass(frozen=True, slots=True)
class Flag:
    """True where the raw bits equal a value."""

    bits: BitSlice
    equals: int

    def __call__(self, data: bytes) -> bool:
        return self.bits.raw(data) == self.equals


@dataclass(frozen=True, slots=True)
class Scaled:
    """One raw value with its scale, its limits and the codes that mean "not available"."""

    bits: BitSlice
    scale: float = 1.0
    offset: float = 0.0
    unavailable: frozenset[int] = frozenset()  # raw
    max_raw: int | None = None

    def value(self, data: bytes) -> float | None:
        """The physical value in the signal's unit; None: not available."""
        raw = self.bits.raw(data)
        if raw in self.unavailable or (self.max_raw is not None and raw > self.max_raw):
            return None
        if self.bits.length >= 8 and not self.bits.signed and raw == self.bits.all_ones:
            return None
        return raw * self.scale + self.offset


@dataclass(frozen=True, slots=True)
class Reader:
    """Reads one quantity from one message."""

    quantity: Quantity
    parts: tuple[Scaled, ...]
    to_si: float = 1.0  # with the sign of our convention
    sign: Flag | None = None
    valid: Flag | None = None
    multiplex: Flag | None = None
    above: float = 0.0
    left: int = 1
    right: int = 2

    @property
    def resolution(self) -> float:
        """One raw step in SI units."""
        return abs(self.parts[0].scale * self.to_si)

    def number(self, data: bytes) -> float | None:
        """Mean of the parts in SI units (m/s, rad/s); None: not available."""
        if self.valid is not None and not self.valid(data):
            return None
        total = 0.0
        for part in self.parts:
            value = part.value(data)
            if value is None:
                return None
            total += value
        result = total / len(self.parts) * self.to_si
        if self.sign is not None and self.sign(data):
            result = -result
        return result

    def pressed(self, data: bytes) -> bool | None:
        """The brake: any part above its threshold."""
        if self.valid is not None and not self.valid(data):
            return None
        values = [part.value(data) for part in self.parts]
        if any(v is None for v in values):
            return None
        return any(v is not None and v > self.above for v in values)

    def turn(self, data: bytes) -> Literal["left", "right", "none"] | None:
        """The indicator; both flags on is the hazard light, which is no turn."""
        if self.valid is not None and not self.valid(data):
            return None
        if len(self.parts) == 2:
            left, right = (part.bits.unsigned(data) != 0 for part in self.parts)
        else:
            raw = self.parts[0].bits.raw(data)
            left, right = raw == self.left, raw == self.right
        if left == right:
            return "none"
        return "left" if left else "right"


@dataclass(frozen=True, slots=True)
class MessagePlan:
    """What to check in one message and what to read from it."""

    name: str
    key: MessageKey  # id and whether it is extended; of J1939: PGN and None
    min_bytes: int
    readers: tuple[Reader, ...]
    rule: str = ""  # name in checks.RULES; empty: none
    counter: tuple[BitSlice, ...] = ()


@dataclass(frozen=True, slots=True)
class VehicleDecoder:
    """The plan for one vehicle: immutable, shared by every receiver."""

    plans: Mapping[MessageKey, MessagePlan]
    quantities: frozenset[Quantity]
    notes: tuple[str, ...] = ()  # what was skipped or cannot be checked, for the user
    gps: bool = False
    skipped: tuple[str, ...] = ()  # messages of the DBC that do not load

    def find(self, can_id: int, extended: bool) -> MessagePlan | None:
        """The plan for a received id: the id itself, else its PGN."""
        plan = self.plans.get((can_id, extended))
        return self.plans.get((pgn_of(can_id), None)) if plan is None and extended else plan

    @property
    def filters(self) -> tuple[tuple[int, int, bool], ...]:
        """(id, mask, extended) of every message that is needed, for the adapter."""
        made = []
        for number, extended in self.plans:
            if extended is None:
                made.append((number << 8, 0x03FFFF00 if number >> 8 & 0xFF >= 240 else 0x03FF0000, True))
            else:
                made.append((number, 0x1FFFFFFF if extended else 0x7FF, extended))
        return tuple(made)
