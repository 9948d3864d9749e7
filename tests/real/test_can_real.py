"""Recorded traffic of a RAV4 (60 s, two buses) and DBC files of common cars."""

from __future__ import annotations

import csv
import gzip
import math
import os
import time
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tmde_edge.adapters.can_ports.dbc_files import load_vehicle_decoder
from tmde_edge.adapters.can_ports.log_files import iter_can_log
from tmde_edge.canbus.checks import RULES
from tmde_edge.canbus.dbc import load_messages
from tmde_edge.canbus.ego_rx import EgoReceiver
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.errors import ConfigError
from tmde_edge.messages import EgoState

DATA = Path(os.environ.get("TMDE_SHARED", Path(__file__).parents[3] / "shared")) / "data"
LOG = DATA / "can_rav4" / "rav4_60s_candump.log.gz"
pytestmark = [pytest.mark.real, pytest.mark.skipif(not LOG.is_file(), reason=f"no recordings at {DATA}; set TMDE_SHARED")]

BY_NAME = {
    "dbc": "toyota_new_mc_pt_generated.dbc",
    "speed": {"message": "SPEED", "signal": "SPEED", "unit": "km/h"},
    "yaw_rate": {"message": "KINEMATICS", "signal": "YAW_RATE", "unit": "deg/s"},
    "brake": {"message": "BRAKE_MODULE", "signal": "BRAKE_PRESSED"},
    "turn_signal": {"message": "BLINKERS_STATE", "signal": "TURN_SIGNALS"},
}


def receiver(vehicle: dict[str, object]) -> EgoReceiver:
    settings = msgspec.convert({"vehicle": vehicle}, CanSettings)
    return EgoReceiver(load_vehicle_decoder(settings, DATA / "dbc"), settings)


@pytest.fixture(scope="module")
def drive() -> tuple[EgoReceiver, list[EgoState], float]:
    """The receiver after the drive, every state on the way, and the processor seconds of reading and decoding it all."""
    rx, states = receiver(BY_NAME), []
    start_s = time.process_time()
    for frame in iter_can_log(LOG):
        state = rx.update(frame)
        if state is not None:
            states.append(state)
    return rx, states, time.process_time() - start_s


def test_speed_equals_the_decoded_reference(drive: tuple[EgoReceiver, list[EgoState], float]) -> None:
    _, states, _ = drive
    with gzip.open(LOG, "rt") as file:
        first_s = float(file.readline().split()[0][1:-1])
    with (DATA / "can_rav4" / "lead_gt_20hz.csv").open() as file:
        rows = [(float(r["t_boot_s"]), float(r["v_SPEED_msg_mps"])) for r in csv.DictReader(file) if r["v_SPEED_msg_mps"]]
    t_s = [s.t_ns * 1e-9 + first_s for s in states]
    ours = np.interp([t for t, _ in rows], t_s, [s.speed_mps for s in states])
    inside = [t_s[0] <= t <= t_s[-1] for t, _ in rows]
    error = np.abs(ours - [v for _, v in rows])[inside]
    assert sum(inside) > 1100
    assert error.max() < 0.1


def test_yaw_offset_is_found(drive: tuple[EgoReceiver, list[EgoState], float]) -> None:
    rx, states, _ = drive
    assert math.degrees(rx.yaw_offset.offset_radps) == pytest.approx(-0.43, abs=0.15)
    late = [math.degrees(s.yaw_rate_radps) for s in states if s.t_ns > 40e9 and s.yaw_rate_radps is not None]
    assert abs(np.mean(late)) < 0.15


def test_every_frame_was_good(drive: tuple[EgoReceiver, list[EgoState], float]) -> None:
    rx, states, _ = drive
    assert set(rx.counts) == {"used"}
    assert len(states) == 2487 + 4974 + 2487 + 8 - _before_speed()
    assert not rx.lost(states[-1].t_ns)
    assert {s.turn_signal for s in states} <= {None, "none", "left", "right"}


def _before_speed() -> int:
    """Good frames of other messages that came before the first speed (no state without a speed)."""
    count = 0
    for frame in iter_can_log(LOG):
        if frame.can_id == 0xB4:
            return count
        count += frame.channel == "can0" and frame.can_id in (0x24, 0x224, 0x614)
    return count


def test_two_buses_at_twenty_times_real_time(drive: tuple[EgoReceiver, list[EgoState], float]) -> None:
    assert 60.0 / drive[2] > 20.0


def test_direct_description_gives_the_same_states(drive: tuple[EgoReceiver, list[EgoState], float]) -> None:
    rx = receiver({"profile": "toyota"})
    states = [s for frame in iter_can_log(LOG) if (s := rx.update(frame)) is not None]
    assert states == drive[1]


def test_a_flipped_bit_in_any_frame_changes_no_value(drive: tuple[EgoReceiver, list[EgoState], float]) -> None:
    rx, chance = receiver(BY_NAME), np.random.default_rng(5)
    good = {s.t_ns: s.speed_mps for s in drive[1]}
    for frame in iter_can_log(LOG):
        if frame.can_id == 0xB4 and chance.random() < 0.3:
            flipped = int.from_bytes(frame.data, "big") ^ 1 << int(chance.integers(64))
            frame = replace(frame, data=flipped.to_bytes(8, "big"))
        state = rx.update(frame)
        assert state is None or state.speed_mps == good[state.t_ns]
    assert rx.counts["bad_checksum"] > 500


@pytest.mark.parametrize("path", sorted((DATA / "dbc").glob("*.dbc")), ids=lambda p: p.stem)
def test_every_dbc_loads_or_explains_itself(path: Path) -> None:
    loaded = load_messages(path.read_text(errors="replace"), path.name)
    assert len(loaded.messages) + len(loaded.skipped) >= len(set(loaded.known))
    assert len(loaded.messages) > 0.9 * len(loaded.known)
    for line in loaded.skipped:
        assert "(line " in line
        assert "\n" not in line


CARS = {
    row[0]: row[1:]
    for row in [
        ("toyota_new_mc_pt_generated", "SPEED", "SPEED", "KINEMATICS", "YAW_RATE", "toyota", ""),
        ("toyota_nodsu_pt_generated", "SPEED", "SPEED", "KINEMATICS", "YAW_RATE", "toyota", ""),
        ("honda_civic_touring_2016_can_generated", "ENGINE_DATA", "XMISSION_SPEED", "", "", "honda", ""),
        ("vw_mqb", "ESP_21", "ESP_v_Signal", "ESP_02", "ESP_Gierrate", "vw_mqb", "vw_mqb"),
        ("vw_mqbevo", "ESP_21", "ESP_v_Signal", "ESP_02", "ESP_Gierrate", "vw_mqb", "vw_mqb"),
        ("ford_lincoln_base_pt", "BrakeSysFeatures", "Veh_V_ActlBrk", "Yaw_Data_FD1", "VehYaw_W_Actl", "ford", "ford"),
        ("hyundai_can", "WHL_SPD11", "WHL_SPD_FL", "ESP12", "YAW_RATE", "hyundai", ""),
        ("hyundai_can_generated", "WHL_SPD11", "WHL_SPD_FL", "ESP12", "YAW_RATE", "hyundai", ""),
        ("hyundai_canfd", "WHEEL_SPEEDS", "WHL_SpdFLVal", "IMU_01_10ms", "IMU_YawRtVal", "hyundai_canfd", "hyundai_canfd"),
        (
            "hyundai_canfd_generated",
            "WHEEL_SPEEDS",
            "WHL_SpdFLVal",
            "IMU_01_10ms",
            "IMU_YawRtVal",
            "hyundai_canfd",
            "hyundai_canfd",
        ),
    ]
}


@pytest.mark.parametrize("name", sorted(CARS))
def test_speed_and_yaw_rate_of_every_car(name: str) -> None:
    message, signal, yaw_message, yaw_signal, rule, yaw_rule = CARS[name]
    vehicle: dict[str, object] = {
        "dbc": f"{name}.dbc", "speed": {"message": message, "signal": signal},
    }  # fmt: skip
    if yaw_message:
        yaw = {"message": yaw_message, "signal": yaw_signal}
        vehicle["yaw_rate"] = yaw if name.startswith(("toyota", "vw", "ford")) else {**yaw, "unit": "deg/s"}
    settings = msgspec.convert({"vehicle": vehicle}, CanSettings)
    decoder = load_vehicle_decoder(settings, DATA / "dbc")
    plans = {p.name: p for p in decoder.plans.values()}
    assert plans[message].rule == rule
    if yaw_message:
        assert plans[yaw_message].rule == yaw_rule
        assert plans[yaw_message].counter or name.startswith("toyota")


def test_a_wrong_message_name_gets_the_nearest_right_one() -> None:
    with pytest.raises(ConfigError, match="did you mean 'ESP_21'"):
        receiver({"dbc": "vw_mqb.dbc", "speed": {"message": "ESP_12", "signal": "ESP_v_Signal"}})


def _full(path: Path, name: str) -> object:
    return load_messages(path.read_text(errors="replace"), path.name, [name]).messages[name]


PROFILES = {  # profile: (DBC, quantity: (message, signals))
    "toyota": ("toyota_new_mc_pt_generated", {
        "speed": ("SPEED", ["SPEED"]), "yaw_rate": ("KINEMATICS", ["YAW_RATE"]), "brake": ("BRAKE_MODULE", ["BRAKE_PRESSED"]),
        "turn_signal": ("BLINKERS_STATE", ["TURN_SIGNALS"]),
    }),
    "honda": ("honda_civic_touring_2016_can_generated", {
        "speed": ("ENGINE_DATA", ["XMISSION_SPEED"]), "brake": ("POWERTRAIN_DATA", ["BRAKE_PRESSED"]),
        "turn_signal": ("SCM_FEEDBACK", ["LEFT_BLINKER", "RIGHT_BLINKER"]),
    }),
    "vw_mqb": ("vw_mqb", {
        "speed": ("ESP_21", ["ESP_v_Signal"]), "yaw_rate": ("ESP_02", ["ESP_Gierrate"]),
        "brake": ("Motor_14", ["MO_Fahrer_bremst"]),
        "turn_signal": ("Blinkmodi_02", ["Comfort_Signal_Left", "Comfort_Signal_Right"]),
    }),
    "ford": ("ford_lincoln_base_pt", {
        "speed": ("BrakeSysFeatures", ["Veh_V_ActlBrk"]), "yaw_rate": ("Yaw_Data_FD1", ["VehYaw_W_Actl"]),
        "brake": ("EngBrakeData", ["BpedDrvAppl_D_Actl"]), "turn_signal": ("Steering_Data_FD1", ["TurnLghtSwtch_D_Stat"]),
    }),
    "hyundai_kia": ("hyundai_can_generated", {
        "speed": ("WHL_SPD11", ["WHL_SPD_FL", "WHL_SPD_FR", "WHL_SPD_RL", "WHL_SPD_RR"]), "yaw_rate": ("ESP12", ["YAW_RATE"]),
        "brake": ("TCS13", ["DriverOverride"]), "turn_signal": ("CGW1", ["CF_Gway_TurnSigLh", "CF_Gway_TurnSigRh"]),
    }),
    "hyundai_kia_canfd": ("hyundai_canfd_generated", {
        "speed": ("WHEEL_SPEEDS", ["WHL_SpdFLVal", "WHL_SpdFRVal", "WHL_SpdRLVal", "WHL_SpdRRVal"]),
        "yaw_rate": ("IMU_01_10ms", ["IMU_YawRtVal"]),
    }),
}  # fmt: skip


@pytest.mark.parametrize("profile", sorted(PROFILES))
def test_profiles_read_the_bits_that_the_dbc_describes(profile: str) -> None:
    """Random payloads: the raw value of each signal in the profile is the one that cantools decodes."""
    dbc, quantities = PROFILES[profile]
    settings = msgspec.convert({"vehicle": {"profile": profile}}, CanSettings)
    decoder = load_vehicle_decoder(settings, DATA / "dbc")
    assert decoder.quantities == set(quantities)
    readers = {r.quantity: (p, r) for p in decoder.plans.values() for r in p.readers}
    chance = np.random.default_rng(1)
    for quantity, (message_name, signals) in quantities.items():
        plan, reader = readers[quantity]
        message = _full(DATA / "dbc" / f"{dbc}.dbc", message_name)
        assert plan.key == (message.frame_id, False)
        assert len(reader.parts) == len(signals)
        for _ in range(30):
            data = chance.bytes(message.length)
            decoded = message.decode(data, decode_choices=False, scaling=True)
            for part, name in zip(reader.parts, signals, strict=True):
                assert part.bits.raw(data) * part.scale + part.offset == pytest.approx(decoded[name])


def test_honda_checksum_against_known_frames() -> None:
    """Public test values: LKAS_HUD with these signals has checksum 11, 10, 9, 8 for counters 0..3."""
    message = _full(DATA / "dbc" / "honda_civic_touring_2016_can_generated.dbc", "LKAS_HUD")
    names = {s.name for s in message.signals}
    values = dict.fromkeys(names, 0) | {"STEERING_REQUIRED": 1, "SOLID_LANES": 1}
    for counter, checksum in enumerate([11, 10, 9, 8]):
        data = bytearray(message.encode(values | {"COUNTER": counter}, strict=False))
        data[0] = 0x41  # SET_ME_X41
        assert RULES["honda"](0x33D, bytes(data[:4]) + bytes([data[4] & 0xF0 | checksum]))
