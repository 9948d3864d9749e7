"""SAE J1939: ids, and the two messages by which existing displays understand a warner (ACC1, AEBS1).

Layouts after two independent public implementations (docs/can.md); a field that is not used is all ones. A warner never
claims a braking state.
"""

from __future__ import annotations

import math

from tmde_edge.messages import CanFrame, FrameResult

PGN_ACC1 = 65135  # 0xFE6F
PGN_AEBS1 = 61487  # 0xF02F
PGN_CCVS1 = 65265  # 0xFEF1
PGN_VDC2 = 61449  # 0xF009
_PERIOD_NS = {PGN_ACC1: 100_000_000, PGN_AEBS1: 50_000_000}
PRIORITY = {PGN_ACC1: 4, PGN_AEBS1: 3}


def j1939_id(pgn: int, source_address: int, priority: int = 6) -> int:
    """The 29-bit id of a broadcast PGN (SAE J1939-21)."""
    return priority << 26 | pgn << 8 | source_address


def pgn_of(can_id: int) -> int:
    """The PGN in a 29-bit id; the destination of a PDU1 message (format below 240) is no part of it."""
    pgn = can_id >> 8 & 0x3FFFF
    return pgn & 0x3FF00 if pgn >> 8 & 0xFF < 240 else pgn


class J1939Transmitter:
    """ACC1 each 100 ms and AEBS1 each 50 ms; time comes with every call."""

    def __init__(self, source_address: int) -> None:
        self._source_address = source_address
        self._due_ns: dict[int, int] = {}
        self._level = ""

    def frames(self, result: FrameResult | None, faults: tuple[str, ...], t_ns: int) -> tuple[CanFrame, ...]:
        """Frames due at t_ns; None: no current result. A change of level is sent at once. Raises ValueError on NaN."""
        level = result.alert.level if result is not None else "none"
        at_once, self._level = level != self._level, level
        out = []
        for pgn, data in ((PGN_ACC1, acc1(result)), (PGN_AEBS1, aebs1(result, faults))):
            due, period = self._due_ns.get(pgn), _PERIOD_NS[pgn]
            jumped = due is None or not -period < t_ns - due < 2 * period
            if due is None or jumped or at_once or t_ns >= due:
                self._due_ns[pgn] = t_ns + period if due is None or jumped or at_once else due + period
                can_id = j1939_id(pgn, self._source_address, PRIORITY[pgn])
                out.append(CanFrame(t_ns=t_ns, can_id=can_id, data=data, extended=True))
        return tuple(out)


def acc1(result: FrameResult | None) -> bytes:
    """ACC1: speed of and distance to the vehicle ahead, target detected, distance alert, forward collision warning."""
    lead = result.lead if result is not None else None
    data = bytearray(b"\xff" * 8)
    if result is None:
        return bytes(data)
    if lead is not None:
        if result.ego is not None and lead.range_rate_mps is not None:
            data[0] = _scaled(3.6 * (result.ego.speed_mps + lead.range_rate_mps), 1.0)
        if lead.distance_m is not None:
            data[1] = _scaled(lead.distance_m, 1.0)
    warning = result.alert.level == "warning"
    distance_alert = result.alert.level != "none" and result.alert.reason in ("headway", "parking")
    data[6] = (lead is not None) | 0b11 << 2 | distance_alert << 4 | warning << 6
    return bytes(data)


def aebs1(result: FrameResult | None, faults: tuple[str, ...]) -> bytes:
    """AEBS1: state 3 ready, 5 warning, 1 temporarily not available; warning level 0..2; time to collision 0.05 s a bit."""
    data = bytearray(b"\xff" * 8)
    if result is None or set(faults) & {"blind", "camera_lost"}:
        data[0] = 0xF1
    if result is not None:
        level = {"none": 0, "caution": 1, "warning": 2}[result.alert.level]
        if level == 2:
            data[0] = level << 4 | 5  # a fault never hides a warning
        elif data[0] == 0xFF:
            data[0] = level << 4 | 3
        data[1] = 0xF8 | (1 if result.lead is not None else 0)  # relevant object: 1 vehicle, 0 none
        ttc_s = result.alert.ttc_s if result.alert.ttc_s is not None else result.lead.ttc_s if result.lead is not None else None
        if ttc_s is not None:
            data[2] = _scaled(ttc_s, 0.05)
    return bytes(data)


def _scaled(value: float, scale: float) -> int:
    """One byte, saturated at 250 (above are J1939's error and not-available codes)."""
    if math.isnan(value):
        raise ValueError("a J1939 value is NaN; it must not reach the bus")
    return round(min(max(value / scale, 0.0), 250.0))
