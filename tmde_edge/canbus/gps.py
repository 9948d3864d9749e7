"""GPS speed: NMEA 0183 sentences, and the frame in which such a speed travels inside (so that a drive log replays it)."""

from __future__ import annotations

import math

from tmde_edge.messages import CanFrame

GPS_CAN_ID = 0x1FFFFF47  # extended; only with the channel below, never on a bus
GPS_CHANNEL = "gps"
_KNOT_MPS = 1852 / 3600
_MAX_MPS = 150.0


def speed_from_nmea(sentence: str) -> float | None:
    """Speed over ground in m/s of an RMC or VTG sentence; None: another sentence, a bad checksum, or no fix (NMEA 0183)."""
    sentence = sentence.strip()
    body, star, given = sentence[1:].partition("*")
    if not sentence.startswith("$") or not star or len(given) != 2:
        return None
    total = 0
    for char in body:
        total ^= ord(char)
    try:
        if total != int(given, 16):
            return None
    except ValueError:
        return None
    fields = body.split(",")
    kind = fields[0][-3:]
    if kind == "RMC" and len(fields) > 7 and fields[2] == "A":
        text = fields[7]
    elif kind == "VTG" and len(fields) > 5 and (len(fields) < 10 or fields[9] not in ("N", "")):
        text = fields[5]
    else:
        return None
    try:
        speed = float(text) * _KNOT_MPS
    except ValueError:
        return None
    return speed if math.isfinite(speed) and 0 <= speed <= _MAX_MPS else None


def gps_frame(t_ns: int, speed_mps: float) -> CanFrame:
    """The speed as a frame: unsigned mm/s, little-endian, 4 bytes."""
    return CanFrame(
        t_ns=t_ns,
        can_id=GPS_CAN_ID,
        data=round(speed_mps * 1000).to_bytes(4, "little"),
        extended=True,
        channel=GPS_CHANNEL,
    )


def speed_from_frame(frame: CanFrame) -> float | None:
    """Speed in m/s of such a frame; None: it is none."""
    if frame.can_id != GPS_CAN_ID or frame.channel != GPS_CHANNEL or len(frame.data) != 4:
        return None
    speed = int.from_bytes(frame.data, "little") / 1000
    return speed if speed <= _MAX_MPS else None
