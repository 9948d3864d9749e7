"""What is sent decodes with cantools from our DBC, passes the E2E oracle, saturates and keeps its rate."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cantools.database import load_file
from hypothesis import given, settings
from hypothesis import strategies as st

import tmde_edge.canbus
from tmde_edge.canbus.alert_tx import (
    ALERT_DATA_IDS,
    ALERT_FIELDS,
    FAULT_BITS,
    LEAD_DATA_IDS,
    LEAD_FIELDS,
    REASONS,
    STATUS_FIELDS,
    AlertTransmitter,
    StatusInfo,
)  # fmt: skip
from tmde_edge.canbus.e2e import p02_check
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.messages import Alert, CanFrame, EgoState, FrameResult, LeadEstimate, PlateResult, PlateSighting, Pose

ROOT = Path(__file__).parents[3]
DBC = load_file(ROOT / "config" / "tmde_edge.dbc", strict=True)
MS = 1_000_000


def lead(**changes: Any) -> LeadEstimate:
    base = LeadEstimate(
        track_id=1, distance_m=20.0, sigma_m=0.3, range_rate_mps=-4.0, range_rate_sigma_mps=0.2, ttc_s=5.0, ttc_sigma_s=0.3,
        headway_s=1.25, coasting_s=0.0, source="plate", lateral_m=1.0,
    )  # fmt: skip
    return replace(base, **changes)


def result(t_ns: int = 0, the_lead: LeadEstimate | None = None, **changes: Any) -> FrameResult:
    base = FrameResult(
        t_ns=t_ns, frame_index=0, plates=(), lead=the_lead, ego=None, pose=Pose(pitch_rad=0.0, roll_rad=0.0), depth=None,
        alert=Alert(), faults=(), mode="strict",
    )  # fmt: skip
    return replace(base, **changes)


def decode(frame: CanFrame) -> dict[str, Any]:
    values = DBC.get_message_by_frame_id(frame.can_id).decode(frame.data, decode_choices=True)
    return {name: value if isinstance(value, (int, float)) else str(value) for name, value in values.items()}


def sent(the_result: FrameResult | None, status: StatusInfo | None = None, t_ns: int = 0) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for frame in AlertTransmitter(CanSettings()).frames(the_result, status or StatusInfo(), t_ns):
        out |= decode(frame)
    return out


def test_the_packaged_description_is_the_readable_one() -> None:
    packaged = Path(tmde_edge.canbus.__file__).parent / "data"
    assert (packaged / "tmde_edge.dbc").read_bytes() == (ROOT / "config" / "tmde_edge.dbc").read_bytes()
    names = {p.name for p in (ROOT / "config" / "vehicles").glob("*.toml")}
    assert names == {p.name for p in (packaged / "vehicles").glob("*.toml")}
    for name in names:
        assert (packaged / "vehicles" / name).read_bytes() == (ROOT / "config" / "vehicles" / name).read_bytes()


def test_code_and_description_say_the_same() -> None:
    signals = {s.name: s for m in DBC.messages for s in m.signals}
    for name, field in {**ALERT_FIELDS, **LEAD_FIELDS, **STATUS_FIELDS}.items():
        s = signals[name]
        assert (s.start, s.length, s.scale, s.offset) == (field.bits.start_bit, field.bits.length, field.scale, field.offset)
        assert s.minimum == pytest.approx(field.offset)
        assert s.maximum == pytest.approx((field.bits.all_ones - 1) * field.scale + field.offset)
        assert str(s.choices[field.bits.all_ones]) == "not available"
    assert {str(v): k for k, v in signals["Alert_Reason"].choices.items() if k < 14} == {
        k or "none": v for k, v in REASONS.items()
    }
    assert len(set(FAULT_BITS.values())) == len(FAULT_BITS)
    for fault, bit in FAULT_BITS.items():
        name = "Status_" + {"can_tx": "CanTx"}.get(fault, "".join(w.title() for w in fault.split("_")))
        assert signals[name].start == 16 + bit
    described = {s.name for s in signals.values() if 16 <= s.start < 32 and s.length == 1 and s.name.startswith("Status_")}
    given = {next(n for n in described if signals[n].start == 16 + bit) for bit in FAULT_BITS.values()}
    assert described - given == {"Status_DetectorLost", "Status_Other"}  # reserved, and every fault without a bit


def test_a_warning_as_it_is_decoded() -> None:
    seen = PlateResult(
        sighting=PlateSighting(track_id=1, corners_px=((0, 0),) * 4, corners_sigma_px=0.1, score=1.0),
        range=None,
        in_path=False,
        lead=True,
    )
    warning = result(
        the_lead=lead(),
        alert=Alert(level="warning", reason="ttc", ttc_s=1.84),
        plates=(seen,),
        faults=("can_lost",),
        mode="permissive",
    )
    got = sent(warning, StatusInfo(fps=29.97, faults=("can_lost", "what_is_this"), temperature_c=61.4, version="1.2.3"))
    assert got["Alert_Level"] == "warning"
    assert got["Alert_Reason"] == "ttc"
    assert got["Alert_TTC"] == pytest.approx(1.84)
    assert got["Alert_Headway"] == pytest.approx(1.25)
    assert got["Alert_RequiredDecel"] == pytest.approx(0.4)  # 4^2 / (2 * 20)
    assert (got["Alert_Fault"], got["Alert_CanLost"], got["Alert_Blind"]) == (1, 1, 0)
    assert got["Alert_Mode"] == "permissive"
    assert got["Lead_Source"] == "plate"
    assert got["Lead_Distance"] == pytest.approx(20.0)
    assert got["Lead_Sigma"] == pytest.approx(0.3)
    assert got["Lead_RangeRate"] == pytest.approx(-4.0)
    assert got["Lead_Bearing"] == pytest.approx(math.degrees(math.atan2(1, 20)), abs=0.026)
    assert got["Lead_InPath"] == 0
    assert got["Status_State"] == "degraded"
    assert got["Status_FrameRate"] == pytest.approx(30.0)
    assert (got["Status_CanLost"], got["Status_Other"], got["Status_Blind"]) == (1, 1, 0)
    assert got["Status_Temperature"] == 61
    assert (got["Status_VersionMajor"], got["Status_VersionMinor"], got["Status_VersionPatch"]) == (1, 2, 3)
    assert got["Status_Interface"] == 1


def test_nothing_seen_is_not_the_same_as_nothing_known() -> None:
    empty = sent(result())
    assert (empty["Alert_Level"], empty["Alert_Reason"], empty["Lead_Source"]) == ("none", "none", "none")
    assert empty["Alert_TTC"] == empty["Lead_Distance"] == "not available"
    assert empty["Status_State"] == "ready"
    unknown = sent(None, StatusInfo(faults=("blind",)))
    assert (unknown["Alert_Level"], unknown["Alert_Reason"], unknown["Lead_Source"]) == ("not available",) * 3
    assert (unknown["Alert_Blind"], unknown["Status_State"], unknown["Status_FrameRate"]) == (1, "init", "not available")
    stale = sent(result(the_lead=lead(), alert=Alert(level="warning", reason="ttc", ttc_s=1.0)), t_ns=600 * MS)
    assert (stale["Alert_Level"], stale["Lead_Source"]) == ("not available", "not available")


def test_uncalibrated_gives_ttc_without_metres() -> None:
    got = sent(result(the_lead=lead(distance_m=None, sigma_m=None, range_rate_mps=None, range_rate_sigma_mps=None)))
    assert got["Alert_TTC"] == pytest.approx(5.0)
    assert got["Lead_Distance"] == got["Lead_Sigma"] == got["Lead_RangeRate"] == got["Lead_Bearing"] == "not available"
    assert got["Lead_Source"] == "plate"


wild = st.floats(allow_nan=False) | st.floats(-500, 500)


@settings(max_examples=100, deadline=None)
@given(wild, wild.map(abs), wild, wild | st.none(), wild | st.none(), st.floats(-100, 100))
def test_every_value_round_trips_or_saturates(
    distance: float, sigma: float, rate: float, ttc: float | None, headway: float | None, lateral: float
) -> None:
    the_lead = lead(distance_m=distance, sigma_m=sigma, range_rate_mps=rate, ttc_s=ttc, headway_s=headway, lateral_m=lateral)
    got = sent(result(the_lead=the_lead, alert=Alert(level="caution", reason="ttc", ttc_s=ttc)))
    wanted = {
        "Lead_Distance": distance, "Lead_Sigma": sigma, "Lead_RangeRate": rate, "Alert_TTC": ttc, "Alert_Headway": headway,
        "Lead_Bearing": math.degrees(math.atan2(lateral, distance)),
    }  # fmt: skip
    for name, value in wanted.items():
        signal = next(s for m in DBC.messages for s in m.signals if s.name == name)
        if value is None:
            assert got[name] == "not available"
        else:
            clipped = min(max(value, signal.minimum), signal.maximum)
            assert got[name] == pytest.approx(clipped, abs=signal.scale / 2 + 1e-9)


@pytest.mark.parametrize("name", ["distance_m", "sigma_m", "range_rate_mps", "ttc_s", "headway_s", "lateral_m"])
def test_nan_never_reaches_the_bus(name: str) -> None:
    with pytest.raises(ValueError, match="NaN"):
        sent(result(the_lead=lead(**{name: math.nan})))


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 90), st.booleans())
def test_every_protected_frame_passes_the_oracle(step_ms: int, j1939: bool) -> None:
    p02 = pytest.importorskip("e2e.p02", reason="autosar-e2e has no wheel for this machine")
    sender = AlertTransmitter(CanSettings(j1939=j1939))
    counters: dict[int, list[int]] = {0x6D0: [], 0x6D1: []}
    for n in range(60):
        level = "warning" if n % 7 == 3 else "none"
        for frame in sender.frames(result(n * step_ms * MS, lead(), alert=Alert(level=level)), StatusInfo(), n * step_ms * MS):
            if frame.can_id in counters:
                ids = ALERT_DATA_IDS if frame.can_id == 0x6D0 else LEAD_DATA_IDS
                assert p02.e2e_p02_check(frame.data, ids)
                assert p02_check(frame.data, ids)
                counters[frame.can_id].append(frame.data[1] & 15)
            if not frame.extended:
                decode(frame)
    for seen in counters.values():
        assert seen == [n % 16 for n in range(len(seen))]


@pytest.mark.parametrize("call_hz", [25, 30, 50, 60, 100])
def test_mean_rates_are_kept_whatever_the_frame_rate(call_hz: int) -> None:
    sender = AlertTransmitter(CanSettings())
    frames = [f for n in range(10 * call_hz) for f in sender.frames(None, StatusInfo(), n * 1_000_000_000 // call_hz)]
    count = {i: sum(f.can_id == i for f in frames) for i in (0x6D0, 0x6D1, 0x6D2)}
    assert count[0x6D0] == pytest.approx(200, abs=2)
    assert count[0x6D1] == pytest.approx(200, abs=2)
    assert count[0x6D2] == 10


def test_a_change_of_level_is_sent_at_once() -> None:
    sender = AlertTransmitter(CanSettings())
    sender.frames(result(0), StatusInfo(), 0)
    assert not sender.frames(result(5 * MS), StatusInfo(), 5 * MS)
    out = sender.frames(result(10 * MS, alert=Alert(level="warning", reason="ttc", ttc_s=1.0)), StatusInfo(), 10 * MS)
    assert [f.can_id for f in out] == [0x6D0]
    assert decode(out[0])["Alert_Level"] == "warning"


def test_a_jump_in_time_makes_no_burst() -> None:
    sender = AlertTransmitter(CanSettings())
    for t_ms in (0, 3_600_000, 3_600_010, 5, 15):
        out = sender.frames(None, StatusInfo(), t_ms * MS)
        assert len(out) == (0 if t_ms in (3_600_010, 15) else 3)


def test_pictures_decided_on_late_do_not_raise_the_rate() -> None:
    sender = AlertTransmitter(CanSettings())
    sent: list[int] = []
    last = result(0)
    for t_ms in range(0, 10_000, 20):
        sent += [f.can_id for f in sender.frames(last, StatusInfo(), t_ms * MS)]  # a tick
        if t_ms % 100 == 0:  # a picture taken 0.15 s before
            last = result((t_ms - 150) * MS)
            sent += [f.can_id for f in sender.frames(last, StatusInfo(), (t_ms - 150) * MS)]
    assert 195 <= sent.count(0x6D0) <= 201
    assert 195 <= sent.count(0x6D1) <= 201
    assert sent.count(0x6D2) == 10


def test_configured_ids_are_used() -> None:
    out = AlertTransmitter(CanSettings(alert_id=0x100, lead_id=0x101, status_id=0x102)).frames(None, StatusInfo(), 0)
    assert [f.can_id for f in out] == [0x100, 0x101, 0x102]


def test_j1939_says_what_displays_understand() -> None:
    sender = AlertTransmitter(CanSettings(j1939=True, j1939_source_address=0x2A))
    warning = result(
        the_lead=lead(),
        ego=EgoState(t_ns=0, speed_mps=15.0, yaw_rate_radps=None),
        alert=Alert(level="warning", reason="ttc", ttc_s=1.9),
    )
    frames = {f.can_id: f.data for f in sender.frames(warning, StatusInfo(), 0) if f.extended}
    acc1, aebs1 = frames[0x10FE6F2A], frames[0x0CF02F2A]
    assert acc1[0] == round(3.6 * 11.0)  # the lead's own speed, km/h
    assert acc1[1] == 20  # m
    assert acc1[6] & 0b11 == 1  # target
    assert acc1[6] >> 6 == 1  # forward collision warning
    assert aebs1[0] == 0x25  # level 2, warning active
    assert aebs1[2] == 38  # 1.9 s
    quiet = {f.can_id: f.data for f in AlertTransmitter(CanSettings(j1939=True)).frames(result(), StatusInfo(), 0) if f.extended}
    assert quiet[0x10FE6FE8][:2] == b"\xff\xff"
    assert quiet[0x0CF02FE8][0] == 0x03  # ready, no warning
    blind = {f.can_id: f.data for f in AlertTransmitter(CanSettings(j1939=True)).frames(None, StatusInfo(), 0) if f.extended}
    assert blind[0x0CF02FE8][0] & 15 == 1  # temporarily not available


@given(st.sampled_from(["none", "caution", "warning"]), st.booleans(), st.lists(st.sampled_from(sorted(FAULT_BITS))))
def test_a_warner_never_claims_to_brake(level: Any, known: bool, faults: list[str]) -> None:
    sender = AlertTransmitter(CanSettings(j1939=True))
    the_result = result(the_lead=lead(), alert=Alert(level=level, reason="ttc", ttc_s=1.0)) if known else None
    state = (
        next(f for f in sender.frames(the_result, StatusInfo(faults=tuple(faults)), 0) if f.can_id >> 8 & 0xFFFF == 0xF02F).data[
            0
        ]
        & 15
    )
    assert state in (1, 3, 5)
