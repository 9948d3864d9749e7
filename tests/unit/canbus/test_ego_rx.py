"""What a receiver makes of frames: only good ones count, and what is old is not known."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.canbus.decoder import build_decoder
from tmde_edge.canbus.ego_rx import EgoReceiver
from tmde_edge.canbus.gps import gps_frame
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.messages import CanFrame

MS = 1_000_000
SPEED = {"id": 0xB4, "start_bit": 47, "length": 16, "byte_order": "big", "scale": 0.01, "unit": "km/h", "checksum": "toyota"}
YAW = {"id": 0x24, "start_bit": 1, "length": 10, "byte_order": "big", "scale": 0.244, "offset": -125, "unit": "deg/s"}
BRAKE = {"id": 0x224, "start_bit": 5, "length": 1, "byte_order": "big"}
TURN = {"id": 0x326, "start_bits": [26, 27], "length": 1, "byte_order": "big"}


def receiver(**vehicle: Any) -> EgoReceiver:
    made = msgspec.convert({"vehicle": {"speed": SPEED, "yaw_rate": YAW, **vehicle}}, CanSettings)
    return EgoReceiver(build_decoder(made), made)


def speed(t_ms: float, mps: float, channel: str = "can0") -> CanFrame:
    data = bytearray(8)
    data[5:7] = round(mps * 360).to_bytes(2, "big")
    data[7] = (8 + 0xB4 + sum(data[:7])) & 0xFF
    return CanFrame(t_ns=round(t_ms * MS), can_id=0xB4, data=bytes(data), channel=channel)


def yaw(t_ms: float, dps: float) -> CanFrame:
    return CanFrame(
        t_ns=round(t_ms * MS), can_id=0x24, data=round((dps + 125) / 0.244).to_bytes(2, "big") + bytes(6), channel="can0"
    )


def bits(t_ms: float, can_id: int, value: int) -> CanFrame:
    return CanFrame(t_ns=round(t_ms * MS), can_id=can_id, data=value.to_bytes(8, "little"), channel="can0")


def test_speed_and_yaw_rate_make_a_state() -> None:
    rx = receiver()
    state = rx.update(speed(0, 10.0))
    assert state is not None
    assert state.speed_mps == pytest.approx(10.0)
    assert state.yaw_rate_radps is None
    state = rx.update(yaw(5, 3.17))  # positive: to the left
    assert state is not None
    assert state.yaw_rate_radps == pytest.approx(math.radians(3.17), abs=math.radians(0.13))
    assert state.t_ns == 0  # the time of its speed
    assert state.yaw_rate_sigma_radps > 0.003
    assert rx.update(CanFrame(t_ns=6 * MS, can_id=0x123, data=bytes(8), channel="can0")) is None


def test_a_bad_checksum_or_a_short_frame_updates_nothing() -> None:
    rx = receiver()
    rx.update(speed(0, 10.0))
    wrong = speed(20, 30.0)
    assert rx.update(CanFrame(t_ns=wrong.t_ns, can_id=0xB4, data=wrong.data[:7] + b"\0", channel="can0")) is None
    assert rx.update(CanFrame(t_ns=30 * MS, can_id=0xB4, data=wrong.data[:6], channel="can0")) is None
    state = rx.state(30 * MS)
    assert state is not None
    assert (state.speed_mps, state.t_ns) == (pytest.approx(10.0), 0)
    assert rx.counts["bad_checksum"] == 1
    assert rx.counts["short"] == 1


def test_a_message_that_always_fails_is_named() -> None:
    rx = receiver()
    for n in range(60):
        rx.update(CanFrame(t_ns=n * 20 * MS, can_id=0xB4, data=b"\0\0\0\0\0\1\0\0", channel="can0"))
    assert len(rx.complaints) == 1
    assert rx.complaints[0].startswith("60 of 60 frames of message 0xb4 fail its toyota check; ")
    healthy = receiver()
    for n in range(60):
        healthy.update(speed(20 * n, 10.0))
    assert healthy.complaints == ()


COUNTED_DBC = """VERSION ""
BU_: X
BO_ 256 SPD: 8 X
 SG_ SPEED : 0|16@1+ (0.01,0) [0|100] "m/s" X
 SG_ YAW : 32|16@1- (0.0001,0) [0|1] "rad/s" X
 SG_ COUNTER : 16|4@1+ (1,0) [0|15] "" X
"""


def counted(**more: Any) -> EgoReceiver:
    """After 60 frames whose counter stands still."""
    both = {name: {"message": "SPD", "signal": name.upper(), **more} for name in ("speed", "yaw")}
    made = msgspec.convert({"vehicle": {"dbc": "x.dbc", "speed": both["speed"], "yaw_rate": both["yaw"]}}, CanSettings)
    rx = EgoReceiver(build_decoder(made, COUNTED_DBC, "x.dbc"), made)
    for n in range(60):
        rx.update(CanFrame(t_ns=n * 20 * MS, can_id=256, data=(1500).to_bytes(2, "little") + bytes(6)))
    return rx


def test_what_the_complaint_advises_ends_it() -> None:
    rx = counted()
    assert rx.counts["used"] == 1
    assert rx.complaints[0].startswith("59 of 60 frames of message SPD fail its counter check; ")
    assert 'set checksum = "none" and no counter on its signals' in rx.complaints[0]
    follows = counted(checksum="none")
    assert follows.counts["used"] == 60
    assert follows.complaints == ()
    described = counted(checksum="none", counter={"signal": "COUNTER"})  # what is described is checked
    assert described.counts["used"] == 1


def test_speed_is_lost_after_ten_learned_periods() -> None:
    rx = receiver()
    for n in range(50):
        rx.update(speed(20 * n, 10.0))
    last = 20 * 49 * MS
    assert rx.state(last + 199 * MS) is not None
    assert not rx.lost(last + 199 * MS)
    assert rx.state(last + 201 * MS) is None
    assert rx.lost(last + 201 * MS)
    rx.update(speed(20 * 49 + 500, 12.0))
    assert not rx.lost(last + 500 * MS)


def test_a_dropout_does_not_stretch_the_learned_period() -> None:
    rx = receiver()
    for n in range(50):
        rx.update(speed(20 * n, 10.0))
    for n in range(3):
        rx.update(speed(20_000 + 20 * n, 10.0))
    assert rx.state((20_040 + 250) * MS) is None


PAGED_DBC = """VERSION ""
BU_: X
BO_ 256 CAR: 8 X
 SG_ PAGE M : 24|8@1+ (1,0) [0|255] "" X
 SG_ SPEED m3 : 0|16@1+ (0.01,0) [0|100] "m/s" X
 SG_ YAW : 32|16@1- (0.0001,0) [0|1] "rad/s" X
"""


def test_a_speed_on_one_page_of_a_multiplexed_message_is_not_lost_between_its_pages() -> None:
    """20 pages of a 10 ms message: the speed comes every 200 ms, the yaw rate beside it every 10 ms."""
    car = {"message": "CAR", "signal": "SPEED"}, {"message": "CAR", "signal": "YAW"}
    made = msgspec.convert({"vehicle": {"dbc": "car.dbc", "speed": car[0], "yaw_rate": car[1]}}, CanSettings)
    rx = EgoReceiver(build_decoder(made, PAGED_DBC, "car.dbc"), made)
    for n in range(600):
        data = (1500).to_bytes(2, "little") + bytes([0, n % 20]) + bytes(4)
        rx.update(CanFrame(t_ns=10 * n * MS, can_id=256, data=data))
        assert (rx.state(10 * n * MS) is None) == (n < 3)
        assert not rx.lost(10 * n * MS)
    page_ms = 10 * (600 - 20 + 3)
    state = rx.state((page_ms + 1_990) * MS)  # ten periods of the speed are 2 s, of the yaw rate 0.1 s
    assert state is not None
    assert state.yaw_rate_radps is None
    assert rx.lost((page_ms + 2_010) * MS)


def test_nothing_is_lost_where_nothing_is_configured_or_not_yet() -> None:
    none = CanSettings()
    assert not EgoReceiver(build_decoder(none), none).lost(10**12)
    rx = receiver()
    assert not rx.lost(5 * MS)
    assert not rx.lost(905 * MS)
    assert rx.lost(1_100 * MS)


def test_old_yaw_rate_is_unknown_while_speed_goes_on() -> None:
    rx = receiver()
    for n in range(40):
        rx.update(speed(10 * n, 10.0))
        rx.update(yaw(10 * n, 0.0))
    for n in range(40, 80):
        state = rx.update(speed(10 * n, 10.0))
    assert state is not None
    assert state.yaw_rate_radps is None


def test_one_implausible_value_is_ignored_a_lasting_one_believed() -> None:
    rx = receiver()
    for n in range(10):
        rx.update(speed(20 * n, 10.0))
    assert rx.update(speed(200, 40.0)) is None
    state = rx.update(speed(220, 10.1))
    assert state is not None
    assert state.speed_mps == pytest.approx(10.1, abs=0.01)
    results = [rx.update(speed(240 + 20 * n, 40.0)) for n in range(4)]
    assert [r is None for r in results] == [True, True, False, False]


def test_values_beyond_any_car_are_never_believed() -> None:
    rx = receiver()
    for n in range(20):
        assert rx.update(speed(20 * n, 120.0)) is None
    assert rx.counts["implausible"] == 20


def test_times_that_step_back() -> None:
    rx = receiver()
    rx.update(speed(10_000, 10.0))
    assert rx.update(speed(9_990, 11.0)) is None  # out of order
    assert rx.update(speed(100, 12.0)) is not None  # a clock that was set
    state = rx.state(100 * MS)
    assert state is not None
    assert state.speed_mps == pytest.approx(12.0, abs=0.01)


def test_the_bus_of_the_first_speed_is_kept_while_it_lives() -> None:
    rx = receiver()
    rx.update(speed(0, 10.0, "can1"))
    assert rx.update(speed(10, 20.0, "can0")) is None
    assert rx.update(speed(20, 10.2, "can1")) is not None
    assert rx.update(speed(5_000, 20.0, "can0")) is not None  # can1 has gone
    chosen = receiver(channel="can0")
    assert chosen.update(speed(0, 10.0, "can1")) is None
    assert chosen.update(speed(10, 10.0, "can0")) is not None
    both = receiver(channel="*")
    assert both.update(speed(0, 10.0, "can1")) is not None
    assert both.update(speed(20, 10.0, "can0")) is not None


def test_brake_and_indicator() -> None:
    rx = receiver(brake=BRAKE, turn_signal=TURN)
    for n in range(30):
        rx.update(speed(20 * n, 10.0))
    state = rx.update(bits(600, 0x224, 1 << 5))
    assert state is not None
    assert state.brake_pressed is True
    assert state.turn_signal is None
    state = rx.update(bits(610, 0x326, 1 << 26))
    assert state is not None
    assert state.turn_signal == "left"
    state = rx.update(bits(620, 0x326, 0))  # between two blinks
    assert state is not None
    assert state.turn_signal == "left"
    for n in range(31, 120):
        state = rx.update(speed(20 * n, 10.0))
        rx.update(bits(20 * n + 1, 0x326, 0))
    assert state is not None
    assert state.turn_signal == "none"
    state = rx.update(bits(2400, 0x326, 3 << 26))  # hazard lights: no turn
    assert state is not None
    assert state.turn_signal == "none"


def test_gps_serves_where_the_bus_gives_no_speed() -> None:
    rx = receiver(gps_device="/dev/ttyUSB0")
    state = rx.update(gps_frame(0, 8.0))
    assert state is not None
    assert state.speed_mps == pytest.approx(8.0)
    assert state.speed_sigma_mps == pytest.approx(0.3)
    rx.update(speed(100, 9.0))
    state = rx.state(110 * MS)
    assert state is not None
    assert state.speed_mps == pytest.approx(9.0, abs=0.01)
    state = rx.state(2_000 * MS)
    assert state is not None
    assert state.speed_mps == pytest.approx(8.0)
    assert rx.lost(4_000 * MS)
    assert receiver().update(gps_frame(0, 8.0)) is None


def test_a_pgn_is_followed_from_its_first_sender() -> None:
    made = msgspec.convert(
        {
            "vehicle": {
                "speed": {"pgn": 65265, "start_bit": 8, "length": 16, "scale": 1 / 256, "unit": "km/h", "valid_max_raw": 64255}
            }
        },
        CanSettings,
    )
    rx = EgoReceiver(build_decoder(made), made)

    def ccvs(t_ms: int, kmh: float, source: int) -> CanFrame:
        data = b"\xff" + round(kmh * 256).to_bytes(2, "little") + b"\xff" * 5
        return CanFrame(t_ns=t_ms * MS, can_id=0x18FEF100 | source, data=data, extended=True)

    assert rx.update(ccvs(0, 36.0, 0x00)) is not None
    assert rx.update(ccvs(50, 36.5, 0x27)) is None  # plausible, but of another sender
    state = rx.update(ccvs(100, 36.0, 0x00))
    assert state is not None
    assert state.speed_mps == pytest.approx(10.0)
    assert rx.update(ccvs(200, 255.0, 0x00)) is None  # 0xFF00: not available
    assert rx.update(ccvs(3_000, 18.0, 0x27)) is not None  # the first sender has gone


frames = st.builds(
    CanFrame,
    t_ns=st.integers(-(10**12), 10**13),
    can_id=st.sampled_from([0xB4, 0x24, 0x224, 0x326, 0x1FFFFF47, 0x18FEF100]) | st.integers(0, 0x1FFFFFFF),
    data=st.binary(max_size=64),
    extended=st.booleans(),
    channel=st.sampled_from(["can0", "can1", "gps", ""]),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(frames, max_size=60))
def test_no_frame_breaks_it_and_no_value_is_wild(stream: list[CanFrame]) -> None:
    rx = receiver(brake=BRAKE, turn_signal=TURN, gps_device="x")
    for frame in stream:
        state = rx.update(frame)
        rx.lost(frame.t_ns)
        if state is not None:
            assert -30.0 <= state.speed_mps <= 90.0
            assert state.yaw_rate_radps is None or abs(state.yaw_rate_radps) <= 2.1
            assert math.isfinite(state.yaw_rate_sigma_radps)


@settings(max_examples=50, deadline=None)
@given(st.lists(frames.filter(lambda f: f.channel != "gps"), max_size=40))
def test_frames_without_a_right_checksum_never_set_the_speed(stream: list[CanFrame]) -> None:
    rx = receiver()
    for frame in stream:
        good = frame.can_id == 0xB4 and len(frame.data) > 1
        good = good and frame.data[-1] == (len(frame.data) + 0xB4 + sum(frame.data[:-1])) & 0xFF
        if not good:
            rx.update(frame)
            assert rx.state(frame.t_ns) is None
