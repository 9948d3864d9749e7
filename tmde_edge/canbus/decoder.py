"""From `[can.vehicle]` to a plan of which bits of which messages mean what: by DBC name or described directly."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tmde_edge.canbus import checks
from tmde_edge.canbus.bits import BitSlice
from tmde_edge.canbus.dbc import DbcMessages, load_messages, unavailable_codes
from tmde_edge.canbus.j1939 import pgn_of
from tmde_edge.canbus.plan import Flag, MessageKey, MessagePlan, Quantity, Reader, Scaled, VehicleDecoder
from tmde_edge.canbus.settings import BitField, CanSettings, SignalSource, VehicleSettings
from tmde_edge.errors import ConfigError

__all__ = ["VehicleDecoder", "build_decoder"]

_NULL_ADDRESS = 0xFE  # the source address that J1939 DBC files write for "any"
_CHECKSUM = re.compile(r"^checksum$|_crc$|_crc\d?val$", re.IGNORECASE)
_COUNTER = re.compile(r"^_?counter$|_bz$|_alvcnt\d?val$|_alivecounter$", re.IGNORECASE)
_HYUNDAI_MARKS = {"WHL_SPD_Checksum_LSB", "CheckSum_TCS3"}
_FORD_MARKS = {"VehVActlBrk_No_Cs", "VehRollYawW_No_Cs"}
_SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600}
_YAW_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180}
_ALIASES = {  # how DBC files write them
    "kph": "km/h", "kmh": "km/h", "km^h": "km/h", "kilometerperhour": "km/h", "mps": "m/s", "meterpersecon": "m/s",
    "mileperhour": "mph", "milesperhour": "mph", "knots": "kn", "kt": "kn",
    "°/s": "deg/s", "degree/s": "deg/s", "degrees/s": "deg/s", "grad/s": "deg/s", "degreofarcpersecon": "deg/s",
    "degreepersecond": "deg/s", "radians/s": "rad/s",
}  # fmt: skip


def build_decoder(settings: CanSettings, dbc_text: str | None = None, dbc_name: str = "") -> VehicleDecoder:
    """Resolves `[can.vehicle]`.

    Raises ConfigError: a message or signal that is not there, a unit that does not fit, a description with holes.
    """
    vehicle = settings.vehicle
    named: tuple[tuple[Quantity, SignalSource | None], ...] = (
        ("speed", vehicle.speed),
        ("yaw_rate", vehicle.yaw_rate),
        ("brake", vehicle.brake),
        ("turn_signal", vehicle.turn_signal),
    )
    sources = [(quantity, source) for quantity, source in named if source is not None]
    notes: list[str] = []
    dbc = _load(vehicle, sources, dbc_text, dbc_name, notes)
    found: dict[MessageKey, list[_Resolved]] = {}
    for quantity, source in sources:
        resolved = _resolve(quantity, source, dbc, dbc_name, notes)
        found.setdefault(resolved.key, []).append(resolved)
    plans = {key: _plan(key, group, notes) for key, group in found.items()}
    return VehicleDecoder(
        plans=plans,
        quantities=frozenset(q for q, _ in sources),
        notes=tuple(notes),
        gps=bool(vehicle.gps_device),
        skipped=dbc.skipped if dbc is not None else (),
    )


@dataclass(frozen=True, slots=True)
class _Resolved:
    name: str
    key: MessageKey
    min_bytes: int
    reader: Reader
    rule: str  # "", a rule, or "?" where a checksum is named but its kind is not known
    counter: tuple[BitSlice, ...]


def _load(
    vehicle: VehicleSettings,
    sources: Sequence[tuple[Quantity, SignalSource]],
    text: str | None,
    name: str,
    notes: list[str],
) -> DbcMessages | None:
    by_name = {s.message for _, s in sources if not _direct(s)}
    if not by_name:
        return None
    if text is None:
        quantity = next(q for q, s in sources if not _direct(s))
        raise ConfigError(
            f"can.vehicle.{quantity} names a message but can.vehicle.dbc is not set; name the DBC file or describe "
            "the signal directly (id, start_bit, length, byte_order, scale, offset, unit)"
        )
    dbc = load_messages(text, name, by_name)
    notes.append(f"{name}: {len(dbc.messages)} of {len(dbc.known)} messages read, only those that are needed")
    return dbc


def _direct(source: SignalSource) -> bool:
    return source.id is not None or source.pgn is not None


def _resolve(quantity: Quantity, source: SignalSource, dbc: DbcMessages | None, dbc_name: str, notes: list[str]) -> _Resolved:
    at = f"can.vehicle.{quantity}"
    if _direct(source):
        if source.message or source.signal or source.signals:
            raise ConfigError(f"{at} has both an id (or pgn) and names of a DBC; give one of the two")
        return _resolve_direct(at, quantity, source)
    if dbc is None or not source.message:
        raise ConfigError(f"{at} has neither message nor id; give message and signal of a DBC, or id, start_bit and length")
    return _resolve_named(at, quantity, source, dbc, dbc_name, notes)


def _resolve_named(
    at: str, quantity: Quantity, source: SignalSource, dbc: DbcMessages, dbc_name: str, notes: list[str]
) -> _Resolved:
    message = dbc.messages.get(source.message)
    if message is None:
        for line in dbc.skipped:
            if line.startswith(source.message + " "):
                raise ConfigError(f"{at}.message: {dbc_name}: {line}; describe the signal directly (id, start_bit, length ...)")
        near = difflib.get_close_matches(source.message, dbc.known, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"it has {len(dbc.known)} messages, the first is {dbc.known[0]!r}"
        raise ConfigError(f"{at}.message = {source.message!r} is not in {dbc_name}; {hint}")
    signals = {s.name: s for s in message.signals}

    def signal(name: str, key: str) -> Any:
        if name in signals:
            return signals[name]
        near = difflib.get_close_matches(name, signals, n=1, cutoff=0.3)
        hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(signals)}"
        raise ConfigError(f"{at}.{key} = {name!r} is not in message {source.message} of {dbc_name}; {hint}")

    names = [source.signal] if source.signal else list(source.signals)
    if not names or (source.signal and source.signals):
        raise ConfigError(
            f"{at}: give signal or signals of message {source.message}, one of the two; it has {', '.join(signals)}"
        )
    parts = []
    for name in names:
        found = signal(name, "signal")
        if found.conversion.is_float:
            raise ConfigError(f"{at}.signal = {name!r}: floating-point signals are not read; name another")
        if _slice_of(found).bytes_needed > int(message.length):
            raise ConfigError(
                f"{at}.signal = {name!r} reaches beyond the {message.length} bytes of message {source.message} in {dbc_name}; "
                "describe it directly (id, start_bit, length ...)"
            )
        parts.append(
            Scaled(
                _slice_of(found),
                float(found.scale),
                float(found.offset),
                frozenset(unavailable_codes(found)) if quantity in ("speed", "yaw_rate") else frozenset(),
                source.valid_max_raw,
            )
        )
    unit = source.unit or (signal(names[0], "signal").unit or "")
    multiplex = None
    first = signals[names[0]]
    if first.multiplexer_ids:
        multiplex = Flag(_slice_of(signals[first.multiplexer_signal]), int(first.multiplexer_ids[0]))

    def flag(given: BitField | None, key: str) -> Flag | None:
        if given is None:
            return None
        return Flag(_slice_of(signal(given.signal, f"{key}.signal")) if given.signal else _bits(at, key, given), given.equals)

    sign, valid = flag(source.sign, "sign"), flag(source.valid, "valid")
    if quantity in ("speed", "yaw_rate") and len(names) == 1:
        sign = sign or _companion(names[0], signals, ("{head}_VZ_{tail}", "{name}_Sign"), 1, notes)
        valid = valid or _companion(names[0], signals, ("{head}_QBit_{tail}",), 0, notes)
    reader = _reader(at, quantity, source, tuple(parts), unit, sign, valid, multiplex)
    rule, counter = _find_checks(source, message, signals)
    if source.counter is not None:
        given = flag(source.counter, "counter")
        counter = (given.bits,) if given is not None else counter
    key: MessageKey = (int(message.frame_id), bool(message.is_extended_frame))
    if key[1] and key[0] & 0xFF == _NULL_ADDRESS:
        key = (pgn_of(key[0]), None)
    return _Resolved(source.message, key, int(message.length), reader, rule, counter)


def _companion(name: str, signals: Mapping[str, Any], forms: Sequence[str], equals: int, notes: list[str]) -> Flag | None:
    """The sign or quality bit that belongs to a signal by its name (ESP_Gierrate: ESP_VZ_Gierrate, ESP_QBit_Gierrate)."""
    head, _, tail = name.partition("_")
    for form in forms:
        other = form.format(head=head, tail=tail, name=name)
        if other in signals:
            meaning = "negative" if equals else "valid"
            notes.append(f"{name}: {meaning} where {other} is {equals}, by its name")
            return Flag(_slice_of(signals[other]), equals)
    return None


def _resolve_direct(at: str, quantity: Quantity, source: SignalSource) -> _Resolved:
    key = _direct_key(at, source)
    number = key[0]
    starts = [source.start_bit] if source.start_bit is not None else list(source.start_bits)
    if not starts or (source.start_bit is not None and source.start_bits) or source.length is None:
        raise ConfigError(
            f"{at}: message {number:#x} needs start_bit (or start_bits) and length; byte_order, scale, offset as they are"
        )
    big = source.byte_order == "big"
    parts = tuple(
        Scaled(BitSlice(start, source.length, big, source.signed), source.scale, source.offset, max_raw=source.valid_max_raw)
        for start in starts
    )
    sign = Flag(_bits(at, "sign", source.sign), source.sign.equals) if source.sign is not None else None
    valid = Flag(_bits(at, "valid", source.valid), source.valid.equals) if source.valid is not None else None
    reader = _reader(at, quantity, source, parts, source.unit, sign, valid, None)
    rule = "" if source.checksum in ("auto", "none") else source.checksum
    counter = (_bits(at, "counter", source.counter),) if source.counter is not None else checks.implied_counter(rule, number)
    needed = max(b.bytes_needed for b in _all_bits(reader, counter))
    if needed > 64:
        raise ConfigError(f"{at}: start_bit and length reach beyond 64 bytes; check them (DBC numbering)")
    return _Resolved(f"PGN {number}" if key[1] is None else f"{number:#x}", key, needed, reader, rule, counter)


def _direct_key(at: str, source: SignalSource) -> MessageKey:
    if source.pgn is not None:
        if source.id is not None:
            raise ConfigError(f"{at} has both id = {source.id:#x} and pgn = {source.pgn}; give one of the two")
        return source.pgn, None
    can_id = source.id or 0
    extended = can_id > 0x7FF if source.extended is None else source.extended
    if can_id > 0x7FF and not extended:
        raise ConfigError(f"{at}.id = {can_id:#x} does not fit 11 bits; set extended = true")
    return can_id, extended


def _reader(
    at: str,
    quantity: Quantity,
    source: SignalSource,
    parts: tuple[Scaled, ...],
    unit: str,
    sign: Flag | None,
    valid: Flag | None,
    multiplex: Flag | None,
) -> Reader:
    to_si = 1.0
    if quantity in ("speed", "yaw_rate"):
        units = _SPEED_UNITS if quantity == "speed" else _YAW_UNITS
        plain = unit.strip().lower().removeprefix("unit_")
        factor = units.get(_ALIASES.get(plain, plain))
        if factor is None:
            raise ConfigError(f"{at}.unit = {unit!r} is not known for this; give one of {', '.join(units)}")
        to_si = -factor if source.invert else factor
        if any(part.scale == 0 for part in parts):
            raise ConfigError(f"{at}.scale = 0; give the signal's scale")
    if quantity == "turn_signal" and len(parts) > 2:
        raise ConfigError(
            f"{at} has {len(parts)} signals; give one with left and right codes, or two: the left and the right flag"
        )
    return Reader(quantity, parts, to_si, sign, valid, multiplex, above=source.above, left=source.left, right=source.right)


def _bits(at: str, key: str, given: BitField) -> BitSlice:
    if given.start_bit is None:
        raise ConfigError(f"{at}.{key} has no start_bit; give start_bit and length (or the signal's name where a DBC is used)")
    return BitSlice(given.start_bit, given.length, given.byte_order == "big")


def _slice_of(signal: Any) -> BitSlice:
    return BitSlice(int(signal.start), int(signal.length), signal.byte_order == "big_endian", bool(signal.is_signed))


def _all_bits(reader: Reader, counter: Sequence[BitSlice]) -> list[BitSlice]:
    flags = [f.bits for f in (reader.sign, reader.valid, reader.multiplex) if f is not None]
    return [*(p.bits for p in reader.parts), *flags, *counter]


def _find_checks(source: SignalSource, message: Any, signals: Mapping[str, Any]) -> tuple[str, tuple[BitSlice, ...]]:
    """Checksum rule and counter as the DBC names and places them (the layouts by which opendbc tells the makes apart).

    "none" means neither: whoever sets it has a vehicle that does not count, or not so.
    """
    if source.checksum == "none":
        return "", ()
    counter = tuple(_slice_of(s) for name, s in signals.items() if _COUNTER.search(name))[:1]
    if source.checksum != "auto":
        return source.checksum, counter
    for rule, marks in (("hyundai", _HYUNDAI_MARKS), ("ford", _FORD_MARKS)):
        if marks & set(signals) and checks.verifiable(rule, int(message.frame_id)):
            return rule, checks.implied_counter(rule, int(message.frame_id))
    checksum = next((s for name, s in signals.items() if _CHECKSUM.search(name)), None)
    if checksum is None:
        named = any("checksum" in name.lower() or name.endswith("_No_Cs") for name in signals)
        return ("?" if named else ""), counter
    last_byte = 8 * (int(message.length) - 1)
    place = (int(checksum.start), int(checksum.length), checksum.byte_order == "big_endian")
    if place == (last_byte + 7, 8, True):
        return "toyota", counter
    if place == (last_byte + 3, 4, True):
        return "honda", counter
    if place == (0, 16, False) and int(message.length) in (8, 16, 24, 32):
        return "hyundai_canfd", counter
    if place == (0, 8, False) and checks.verifiable("vw_mqb", int(message.frame_id)):
        return "vw_mqb", counter
    return "?", counter


def _plan(key: MessageKey, group: Sequence[_Resolved], notes: list[str]) -> MessagePlan:
    can_id = key[0]
    first = group[0]
    rule = next((r.rule for r in group if r.rule not in ("", "?")), "")
    counter = next((r.counter for r in group if r.counter), ())
    if rule and not checks.verifiable(rule, can_id):
        notes.append(f"message {first.name} ({can_id:#x}): no constants for its {rule} checksum; it is not checked")
        rule = ""
    elif not rule and any(r.rule == "?" for r in group):
        notes.append(f"message {first.name} ({can_id:#x}): its checksum is of no known kind; it is not checked")
    min_bytes = max(r.min_bytes for r in group)
    for resolved in group:
        min_bytes = max(min_bytes, *(b.bytes_needed for b in _all_bits(resolved.reader, counter)))
    return MessagePlan(first.name, key, min_bytes, tuple(r.reader for r in group), rule, counter)
