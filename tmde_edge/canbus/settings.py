"""The `[can]` table: the bus, what is read from the vehicle and what is sent."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

StandardId = Annotated[int, Meta(ge=0, le=0x7FF)]
CanId = Annotated[int, Meta(ge=0, le=0x1FFFFFFF)]
Positive = Annotated[float, Meta(gt=0)]
Rate = Annotated[float, Meta(gt=0, le=200)]
ByteOrder = Literal["little", "big"]
ChecksumRule = Literal["auto", "none", "toyota", "honda", "vw_mqb", "ford", "hyundai", "hyundai_canfd"]


class BitField(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A few bits of the same message that qualify a signal: a sign bit, a quality flag, a counter."""

    signal: str = ""  # name in the DBC; or the four below
    start_bit: Annotated[int, Meta(ge=0, le=511)] | None = None  # DBC numbering (big-endian: of the most significant bit)
    length: Annotated[int, Meta(ge=1, le=32)] = 1  # bits
    byte_order: ByteOrder = "little"  # "big": Motorola
    equals: int = 1  # the raw value that makes it true


class SignalSource(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where one quantity comes from: by name in a DBC (message, signal), or described directly (id, start_bit, length ...)."""

    # by name, of the DBC in [can.vehicle] dbc
    message: str = ""  # name in the DBC
    signal: str = ""  # name in that message
    signals: list[str] = []  # instead of signal: their mean (wheel speeds); for turn_signal: the left and the right flag
    # described directly, where no DBC loads
    id: CanId | None = None  # of the message, where no DBC names it
    pgn: Annotated[int, Meta(ge=0, le=0x3FFFF)] | None = None  # instead of id: J1939, from whichever source address comes first
    extended: bool | None = None  # 29-bit id; default: from the id's size
    start_bit: Annotated[int, Meta(ge=0, le=511)] | None = None  # DBC numbering
    start_bits: list[Annotated[int, Meta(ge=0, le=511)]] = []  # instead of start_bit: as signals
    length: Annotated[int, Meta(ge=1, le=64)] | None = None  # bits
    byte_order: ByteOrder = "little"  # "big": Motorola, @0 in a DBC
    signed: bool = False  # two's complement
    scale: float = 1.0  # physical value a raw unit
    offset: float = 0.0  # added after scaling
    # both
    unit: str = ""  # km/h, mph, m/s, kn, deg/s, rad/s; empty: as the DBC says
    invert: bool = False  # yaw_rate: the signal is positive to the right
    sign: BitField | None = None  # a sign bit of its own: negative when it is true
    valid: BitField | None = None  # a quality flag: the value counts only when it is true
    valid_max_raw: int | None = (
        None  # raw values above are "not available" or "error" codes (all bits one always is, from 8 bits up)
    )
    above: float = 0.0  # brake: pressed when the value is above this
    left: int = 1  # turn_signal: raw value for left
    right: int = 2  # turn_signal: raw value for right
    checksum: ChecksumRule = "auto"  # "auto": as the DBC names it (directly described: none); "none": no counter by name either
    counter: BitField | None = None  # alive counter, where the checksum's rule does not imply it


class VehicleSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[can.vehicle]` table: which signals tell what the own vehicle does."""

    profile: str = ""  # "toyota", "honda" ... (config/vehicles), or a TOML file relative to the configuration; own keys win
    dbc: str | None = None  # DBC file, relative to the configuration
    channel: str = ""  # of logs with several buses; empty: the bus on which the speed is seen first; "*": any
    speed: SignalSource | None = None  # where own speed comes from
    yaw_rate: SignalSource | None = None  # and the yaw rate
    brake: SignalSource | None = None  # the brake pedal
    turn_signal: SignalSource | None = None  # the indicators
    speed_sigma_mps: Positive = 0.1  # one sigma of the speed signal
    speed_max_mps: Positive = 90.0  # above is not plausible
    accel_max_mps2: Positive = 15.0  # a change of speed faster than this is not plausible
    yaw_rate_max_radps: Positive = 2.0  # above is not plausible
    yaw_accel_max_radps2: Positive = 15.0  # a change of yaw rate faster than this is not plausible
    yaw_offset: bool = True  # estimate and remove the zero offset of the yaw rate
    gps_device: str = ""  # serial port of an NMEA receiver: its speed where the bus gives none
    gps_baud: Annotated[int, Meta(gt=0)] = 9600  # of that port


class CanSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[can]` table."""

    enabled: bool = True  # false: no bus is opened
    interface: Literal["socketcan", "slcan", "virtual", "udp_multicast"] = "socketcan"  # of python-can
    channel: str = "can0"  # socketcan: interface; slcan: serial port; udp_multicast: group; virtual: any name
    bitrate: Annotated[int, Meta(gt=0)] = 500_000  # slcan only: socketcan's is set by the system
    fd: bool = False  # CAN FD (socketcan, udp_multicast): needed to receive frames of more than 8 bytes
    transmit: bool = False  # nothing is sent until this is true
    receive_ids: list[CanId] = []  # what the adapter lets through; empty: the ids that the vehicle signals need
    alert_id: StandardId = 0x6D0  # of ALERT
    lead_id: StandardId = 0x6D1  # of LEAD
    status_id: StandardId = 0x6D2  # of STATUS
    alert_rate_hz: Rate = 20.0  # frames a second
    lead_rate_hz: Rate = 20.0  # frames a second
    status_rate_hz: Rate = 1.0  # frames a second
    hold_s: Positive = 0.5  # no new result for longer: the sent alert and lead become "not available"
    timeout_periods: Annotated[int, Meta(ge=2)] = 10  # of a received signal, in periods of its own arrival
    j1939: bool = False  # send ACC1 and AEBS1 too (29-bit ids)
    j1939_source_address: Annotated[int, Meta(ge=0, le=253)] = 0xE8  # 232: forward collision avoidance / ADAS
    queue_frames: Annotated[int, Meta(gt=0)] = 64  # of frames waiting to be sent; the oldest is dropped
    vehicle: VehicleSettings = msgspec.field(default_factory=VehicleSettings)  # below
