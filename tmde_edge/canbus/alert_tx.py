"""What is sent: ALERT and LEAD at a steady rate (E2E profile 2), STATUS; bit by bit as config/tmde_edge.dbc describes it.

Values saturate, an unknown value is "not available" (all bits one), NaN raises before anything is packed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from tmde_edge.canbus.bits import BitSlice, put
from tmde_edge.canbus.e2e import p02_protect
from tmde_edge.canbus.j1939 import J1939Transmitter
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.messages import CanFrame, FrameResult

INTERFACE_VERSION = 1  # of the layout in tmde_edge.dbc
LATE_NS = 2_000_000_000  # a picture's decision comes at most this long after its time
ALERT_DATA_IDS = bytes(range(0xA0, 0xB0))
LEAD_DATA_IDS = bytes(range(0xB0, 0xC0))

LEVELS = {"none": 0, "caution": 1, "warning": 2}
REASONS = {"": 0, "ttc": 1, "deceleration": 2, "headway": 3, "parking": 4}
SOURCES = {"plate": 1, "vehicle": 2, "flow": 3, "depth": 4}
STATES = {"init": 0, "ready": 1, "degraded": 2, "fault": 3}
FAULT_BITS = {  # of STATUS; any other name sets bit 15, bit 7 (Status_DetectorLost) is reserved
    "blind": 0, "can_lost": 1, "uncalibrated": 2, "overload": 3, "camera_lost": 4, "calibration": 5,
    "depth_lost": 6, "can_tx": 8, "hot": 9, "disk": 10,
}  # fmt: skip
_OTHER_FAULT = 15
_SEVERE = frozenset({"blind", "camera_lost"})  # nothing can be warned of


@dataclass(frozen=True, slots=True)
class Field:
    """One numeric field: bits, scale and offset of the DBC; the top code is "not available"."""

    bits: BitSlice
    scale: float
    offset: float = 0.0

    def raw(self, value: float | None, name: str) -> int:
        """Nearest code, saturated; None gives "not available". Raises ValueError on NaN."""
        if value is None:
            return self.bits.all_ones
        if math.isnan(value):
            raise ValueError(f"{name} is NaN; it must not reach the bus")
        steps = (value - self.offset) / self.scale
        return round(min(max(steps, 0.0), self.bits.all_ones - 1))


ALERT_FIELDS = {
    "Alert_TTC": Field(BitSlice(24, 16), 0.01),
    "Alert_Headway": Field(BitSlice(40, 16), 0.01),
    "Alert_RequiredDecel": Field(BitSlice(56, 8), 0.05),
}
LEAD_FIELDS = {
    "Lead_Distance": Field(BitSlice(16, 15), 0.01),
    "Lead_Sigma": Field(BitSlice(31, 10), 0.01),
    "Lead_RangeRate": Field(BitSlice(41, 12), 0.02, -40.94),
    "Lead_Bearing": Field(BitSlice(53, 11), 0.05, -51.15),
}
STATUS_FIELDS = {
    "Status_FrameRate": Field(BitSlice(8, 8), 0.5),
    "Status_Temperature": Field(BitSlice(32, 8), 1.0, -60.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusInfo:
    """What STATUS tells beside the last result."""

    fps: float | None = None
    faults: tuple[str, ...] = ()
    temperature_c: float | None = None
    state: Literal["init", "ready", "degraded", "fault"] | None = None  # None: from the faults
    version: str = ""  # "1.2.3"; empty: the package's own


class AlertTransmitter:
    """Makes the frames that are due; time comes with every call (each frame and each Tick)."""

    def __init__(self, settings: CanSettings) -> None:
        self._s = settings
        self._due_ns: dict[str, int] = {}
        self._latest_ns = 0
        self._counter = {"alert": 0, "lead": 0, "status": 0}
        self._sent_level: int | None = None
        self._j1939 = J1939Transmitter(settings.j1939_source_address) if settings.j1939 else None

    def frames(self, result: FrameResult | None, status: StatusInfo, t_ns: int) -> tuple[CanFrame, ...]:
        """Frames due at t_ns. A change of level is sent at once, the rest at its rate. Raises ValueError on NaN."""
        # A picture is decided on after its time, when later ticks have been heard: that is no step back of the clock.
        if 0 < self._latest_ns - t_ns <= LATE_NS:
            t_ns = self._latest_ns
        self._latest_ns = t_ns
        stale = result is None or abs(t_ns - result.t_ns) > self._s.hold_s * 1e9
        current = None if stale else result
        alert = pack_alert(current, status)
        level = alert[1] >> 4 & 3
        out: list[CanFrame] = []
        if self._due("alert", self._s.alert_rate_hz, t_ns, at_once=level != self._sent_level):
            p02_protect(alert, ALERT_DATA_IDS, self._count("alert"))
            out.append(CanFrame(t_ns=t_ns, can_id=self._s.alert_id, data=bytes(alert)))
            self._sent_level = level
        if self._due("lead", self._s.lead_rate_hz, t_ns):
            lead = pack_lead(current)
            p02_protect(lead, LEAD_DATA_IDS, self._count("lead"))
            out.append(CanFrame(t_ns=t_ns, can_id=self._s.lead_id, data=bytes(lead)))
        if self._due("status", self._s.status_rate_hz, t_ns):
            data = pack_status(status, seen=result is not None, transmit=self._s.transmit, counter=self._count("status"))
            out.append(CanFrame(t_ns=t_ns, can_id=self._s.status_id, data=bytes(data)))
        if self._j1939 is not None:
            out.extend(self._j1939.frames(current, status.faults, t_ns))
        return tuple(out)

    def _due(self, name: str, rate_hz: float, t_ns: int, *, at_once: bool = False) -> bool:
        due = due_after(self._due_ns.get(name), rate_hz, t_ns, at_once=at_once)
        if due is None:
            return False
        self._due_ns[name] = due
        return True

    def _count(self, name: str) -> int:
        value = self._counter[name]
        self._counter[name] = (value + 1) % 16
        return value


def due_after(due_ns: int | None, rate_hz: float, t_ns: int, *, at_once: bool = False) -> int | None:
    """The next due time where a frame is due at t_ns, else None. Keeps the mean rate; a jump in time makes no burst."""
    period_ns = round(1e9 / rate_hz)
    if at_once or due_ns is None or not -period_ns <= t_ns - due_ns < 2 * period_ns:
        return t_ns + period_ns
    return due_ns + period_ns if t_ns >= due_ns else None


def pack_alert(result: FrameResult | None, status: StatusInfo) -> bytearray:
    """ALERT without counter and CRC; None: no current result, all "not available"."""
    faults = set(status.faults) | set(result.faults if result is not None else ())
    data = bytearray(8)
    if result is None:
        level, reason, permissive = 3, 15, 0
        ttc_s = headway_s = decel_mps2 = None
    else:
        alert, lead = result.alert, result.lead
        level, reason = LEVELS[alert.level], REASONS.get(alert.reason, 14)
        permissive = int(result.mode == "permissive")
        ttc_s = alert.ttc_s if alert.ttc_s is not None else lead.ttc_s if lead is not None else None
        headway_s = lead.headway_s if lead is not None else None
        decel_mps2 = None
        rate_mps = lead.range_rate_mps if lead is not None else None
        if lead is not None and lead.ttc_s is not None and rate_mps is not None and rate_mps < 0 and lead.ttc_s > 0:
            decel_mps2 = -rate_mps / (2 * lead.ttc_s)  # v^2 / (2 D) with D = v ttc
    data[1] = level << 4 | permissive << 6 | bool(faults) << 7
    data[2] = reason
    for bit, name in enumerate(("blind", "can_lost", "uncalibrated", "overload"), start=4):
        data[2] |= (name in faults) << bit
    _put_all(data, ALERT_FIELDS, {"Alert_TTC": ttc_s, "Alert_Headway": headway_s, "Alert_RequiredDecel": decel_mps2})
    return data


def pack_lead(result: FrameResult | None) -> bytearray:
    """LEAD without counter and CRC; None: no current result, source "not available"."""
    data = bytearray(8)
    values: dict[str, float | None] = dict.fromkeys(LEAD_FIELDS)
    if result is None:
        source, in_path = 7, False
    elif result.lead is None:
        source, in_path = 0, False
    else:
        lead = result.lead
        source = SOURCES[lead.source]
        in_path = next((p.in_path for p in result.plates if p.lead), True)  # unseen right now: it was chosen in the path
        bearing_rad = math.atan2(lead.lateral_m, lead.distance_m) if lead.distance_m is not None else None
        values = {
            "Lead_Distance": lead.distance_m,
            "Lead_Sigma": lead.sigma_m,
            "Lead_RangeRate": lead.range_rate_mps,
            "Lead_Bearing": None if bearing_rad is None else math.degrees(bearing_rad),
        }
    data[1] = source << 4 | in_path << 7
    _put_all(data, LEAD_FIELDS, values)
    return data


def pack_status(status: StatusInfo, *, seen: bool, transmit: bool, counter: int) -> bytearray:
    """STATUS; `seen`: there has been a result."""
    state = status.state
    if state is None:
        if set(status.faults) & _SEVERE:
            state = "fault" if seen else "init"
        else:
            state = "init" if not seen else "degraded" if status.faults else "ready"
    faults = 0
    for name in status.faults:
        faults |= 1 << FAULT_BITS.get(name, _OTHER_FAULT)
    major, minor, patch = _version(status.version)
    data = bytearray(8)
    data[0] = STATES[state] | transmit << 3 | (counter & 0xF) << 4
    data[2:4] = faults.to_bytes(2, "little")
    data[5] = INTERFACE_VERSION | min(major, 15) << 4
    data[6], data[7] = min(minor, 255), min(patch, 255)
    _put_all(data, STATUS_FIELDS, {"Status_FrameRate": status.fps, "Status_Temperature": status.temperature_c})
    return data


def _put_all(data: bytearray, fields: Mapping[str, Field], values: Mapping[str, float | None]) -> None:
    for name, field in fields.items():
        put(data, field.bits, field.raw(values[name], name))


def _version(text: str) -> tuple[int, int, int]:
    if not text:
        from tmde_edge import __version__ as text
    parts = [int("".join(c for c in part if c.isdigit()) or 0) for part in text.split("+")[0].split(".")[:3]]
    major, minor, patch = [*parts, 0, 0, 0][:3]
    return major, minor, patch
