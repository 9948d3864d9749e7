"""Lenient DBC loading and direct descriptions: what works, and what an error says."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest

from tmde_edge.canbus.dbc import load_messages, unavailable_codes
from tmde_edge.canbus.decoder import build_decoder
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.errors import ConfigError

DBC = """VERSION ""
BU_: A B
BO_ 180 SPEED: 8 A
 SG_ SPEED : 47|16@0+ (0.01,0) [0|250] "km/h" B
 SG_ CHECKSUM : 63|8@0+ (1,0) [0|255] "" B

BO_ 36 KINEMATICS: 8 A
 SG_ YAW_RATE : 1|10@0+ (0.244,-125) [0|65535] "deg/s" B

BO_ 300 WHEELS: 8 A
 SG_ FL : 0|16@1+ (0.01,0) [0|0] "mph" B
 SG_ FR : 16|16@1+ (0.01,0) [0|0] "mph" B
 SG_ COUNTER : 56|4@1+ (1,0) [0|15] "" B

BO_ 4000 BROKEN: 8 A
 SG_ A : 0|16@1+ (1,0) [0|0] "" B

BO_ 303 TOO_LONG: 8 A
 SG_ A : 60|16@1+ (1,0) [0|0] "m/s" B

BO_ 302 MUXED: 8 A
 SG_ PAGE M : 0|8@1+ (1,0) [0|0] "" B
 SG_ SPEED m1 : 8|16@1+ (0.01,0) [0|0] "Unit_KiloMeterPerHour" B
 SG_ OTHER m2 : 8|16@1+ (1,0) [0|0] "" B

BO_ 257 ESP_02: 8 A
 SG_ ESP_QBit_Gierrate : 12|1@1+ (1,0) [0|1] "" B
 SG_ ESP_Gierrate : 40|14@1+ (0.01,0) [0|163.82] "Unit_DegreOfArcPerSecon" B
 SG_ ESP_VZ_Gierrate : 54|1@1+ (1,0) [0|1] "" B

BO_ 2566844926 CCVS1: 8 A
 SG_ WheelSpeed : 8|16@1+ (0.00390625,0) [0|250] "km/h" B

CM_ 145 "a comment that cantools rejects";
CM_ SG_ 304 "another";
VAL_ 300 FL 65535 "Signal not available" 65534 "Init" 0 "standing" ;
"""


def settings(**vehicle: Any) -> CanSettings:
    return msgspec.convert({"vehicle": vehicle}, CanSettings)


def decoder(**vehicle: Any):
    return build_decoder(settings(dbc="x.dbc", **vehicle), DBC, "x.dbc")


def test_one_bad_message_or_comment_does_not_lose_the_file() -> None:
    loaded = load_messages(DBC, "x.dbc")
    assert set(loaded.messages) == {"SPEED", "KINEMATICS", "WHEELS", "TOO_LONG", "MUXED", "ESP_02", "CCVS1"}
    assert len(loaded.skipped) == 1
    assert loaded.skipped[0].startswith("BROKEN (line 15): ")
    assert "0xfa0 is more than 11 bits" in loaded.skipped[0]


def test_only_what_is_needed_is_read() -> None:
    made = decoder(speed={"message": "SPEED", "signal": "SPEED", "unit": "km/h"})
    assert made.notes == ("x.dbc: 1 of 8 messages read, only those that are needed",)
    assert made.filters == ((180, 0x7FF, False),)
    plan = made.plans[(180, False)]
    assert plan.rule == "toyota"
    assert plan.readers[0].number(bytes.fromhex("000000001d0b7a5e")) == pytest.approx(0x0B7A * 0.01 / 3.6)


def test_value_table_names_codes_that_are_no_value() -> None:
    signal = load_messages(DBC, "x.dbc", ["WHEELS"]).messages["WHEELS"].signals[0]
    assert unavailable_codes(signal) == (65534, 65535)
    made = decoder(speed={"message": "WHEELS", "signals": ["FL", "FR"]})
    reader = made.plans[(300, False)].readers[0]
    assert reader.number(b"\xe8\x03\xd0\x07" + bytes(4)) == pytest.approx(15.0 * 0.44704)  # mean of 10 and 20 mph
    assert reader.number(b"\xfe\xff\xd0\x07" + bytes(4)) is None
    assert reader.number(b"\xff\xff\xd0\x07" + bytes(4)) is None
    assert made.plans[(300, False)].counter[0].start_bit == 56


def test_units_as_dbc_files_write_them() -> None:
    reader = decoder(speed={"message": "MUXED", "signal": "SPEED"}).plans[(302, False)].readers[0]
    assert reader.to_si == pytest.approx(1 / 3.6)
    assert reader.multiplex is not None
    assert reader.multiplex(b"\x01" + bytes(7))
    assert not reader.multiplex(b"\x02" + bytes(7))


def test_j1939_messages_match_by_pgn_from_any_sender() -> None:
    made = decoder(speed={"message": "CCVS1", "signal": "WheelSpeed"})
    assert made.find(0x18FEF100, True) is not None
    assert made.find(0x0CFEF127, True) is not None
    assert made.find(0x18FEF200, True) is None
    assert made.find(0x18FEF100 & 0x7FF, False) is None
    assert made.filters == ((0xFEF100, 0x03FFFF00, True),)


def test_sign_bit_quality_bit_and_codes_described_directly() -> None:
    made = build_decoder(
        settings(
            yaw_rate={
                "id": 0x101, "start_bit": 40, "length": 14, "scale": 0.01, "unit": "deg/s", "sign": {"start_bit": 54},
                "valid": {"start_bit": 12, "equals": 0}, "valid_max_raw": 16381,
            }
        )
    )  # fmt: skip
    reader = made.plans[(0x101, False)].readers[0]

    def frame(raw: int, negative: int = 0, bad: int = 0) -> bytes:
        return (raw << 40 | negative << 54 | bad << 12).to_bytes(8, "little")

    assert reader.number(frame(1000)) == pytest.approx(math.radians(10))
    assert reader.number(frame(1000, negative=1)) == pytest.approx(math.radians(-10))
    assert reader.number(frame(1000, bad=1)) is None
    assert reader.number(frame(16382)) is None


def test_a_sign_bit_named_after_its_signal_is_found_and_said() -> None:
    made = decoder(yaw_rate={"message": "ESP_02", "signal": "ESP_Gierrate", "unit": "deg/s"})
    reader = made.plans[(257, False)].readers[0]
    assert reader.number((1000 << 40 | 1 << 54).to_bytes(8, "little")) == pytest.approx(math.radians(-10))
    assert reader.number((1000 << 40 | 1 << 12).to_bytes(8, "little")) is None
    assert "ESP_Gierrate: negative where ESP_VZ_Gierrate is 1, by its name" in made.notes
    assert "ESP_Gierrate: valid where ESP_QBit_Gierrate is 0, by its name" in made.notes


def test_all_bits_one_is_not_available() -> None:
    wide = (
        build_decoder(settings(speed={"id": 5, "start_bit": 0, "length": 16, "scale": 0.001, "unit": "m/s"}))
        .plans[(5, False)]
        .readers[0]
    )
    assert wide.number(b"\xff\xff") is None
    assert wide.number(b"\xfe\xff") == pytest.approx(65.534)
    signed = (
        build_decoder(settings(speed={"id": 5, "start_bit": 0, "length": 16, "signed": True, "unit": "m/s"}))
        .plans[(5, False)]
        .readers[0]
    )
    assert signed.number(b"\xff\xff") == -1.0
    narrow = build_decoder(settings(brake={"id": 5, "start_bit": 0, "length": 1})).plans[(5, False)].readers[0]
    assert narrow.pressed(b"\xff") is True


def test_inverted_yaw_rate() -> None:
    made = decoder(yaw_rate={"message": "KINEMATICS", "signal": "YAW_RATE", "unit": "deg/s", "invert": True})
    raw = 600
    value = made.plans[(36, False)].readers[0].number(bytes([raw >> 8, raw & 255]) + bytes(6))
    assert value == pytest.approx(-math.radians(raw * 0.244 - 125))


@pytest.mark.parametrize(
    ("vehicle", "says"),
    [
        (
            {"speed": {"message": "SPED", "signal": "SPEED"}},
            "can.vehicle.speed.message = 'SPED' is not in x.dbc; did you mean 'SPEED'",
        ),
        ({"speed": {"message": "SPEED", "signal": "SPEEED"}}, "'SPEEED' is not in message SPEED of x.dbc; did you mean 'SPEED'"),
        ({"speed": {"message": "SPEED", "signal": "SPEED", "unit": "furlong"}}, "unit = 'furlong' is not known"),
        ({"yaw_rate": {"message": "SPEED", "signal": "SPEED"}}, "can.vehicle.yaw_rate.unit = 'km/h' is not known"),
        ({"speed": {"message": "BROKEN", "signal": "A", "unit": "m/s"}}, "BROKEN (line 15)"),
        ({"speed": {"message": "TOO_LONG", "signal": "A"}}, "reaches beyond the 8 bytes of message TOO_LONG"),
        ({"speed": {"message": "SPEED"}}, "give signal or signals of message SPEED"),
        ({"speed": {"unit": "m/s"}}, "has neither message nor id"),
        ({"speed": {"id": 5, "unit": "m/s"}}, "needs start_bit"),
        ({"speed": {"id": 5, "message": "SPEED", "start_bit": 0, "length": 8, "unit": "m/s"}}, "give one of the two"),
        ({"speed": {"id": 0x18FEF100, "extended": False, "start_bit": 0, "length": 8, "unit": "m/s"}}, "does not fit 11 bits"),
        ({"speed": {"id": 5, "start_bit": 510, "length": 8, "unit": "m/s"}}, "beyond 64 bytes"),
        ({"speed": {"id": 5, "start_bit": 0, "length": 8, "scale": 0, "unit": "m/s"}}, "scale = 0"),
        ({"speed": {"id": 5, "pgn": 6, "start_bit": 0, "length": 8, "unit": "m/s"}}, "both id = 0x5 and pgn = 6"),
        ({"speed": {"id": 5, "start_bit": 0, "length": 8, "unit": "m/s", "sign": {"length": 1}}}, "speed.sign has no start_bit"),
        ({"turn_signal": {"id": 5, "start_bits": [1, 2, 3], "length": 1}}, "has 3 signals"),
    ],
)
def test_errors_say_what_where_and_what_to_do(vehicle: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        decoder(**vehicle)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_dbc() -> None:
    with pytest.raises(ConfigError, match=r"no message .* it begins with 'fx_px = 1200'"):
        load_messages("fx_px = 1200\n", "config.toml")


def test_names_without_a_dbc() -> None:
    with pytest.raises(ConfigError, match=r"can\.vehicle\.dbc is not set"):
        build_decoder(settings(speed={"message": "SPEED", "signal": "SPEED"}))


def test_unknown_checksums_are_said_not_checked() -> None:
    text = DBC.replace("CHECKSUM : 63|8@0+", "CHECKSUM : 7|8@0+")
    made = build_decoder(settings(dbc="x.dbc", speed={"message": "SPEED", "signal": "SPEED", "unit": "km/h"}), text, "x.dbc")
    assert made.plans[(180, False)].rule == ""
    assert any("its checksum is of no known kind" in note for note in made.notes)
