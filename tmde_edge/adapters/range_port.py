"""A laser or lidar rangefinder on a serial port (pyserial), recorded as truth beside the drive; no decision ever sees it."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable

from tmde_edge.adapters.serial_lines import SerialLines
from tmde_edge.config import RecordConfig
from tmde_edge.messages import RangeReference

_log = logging.getLogger(__name__)
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
_NUMBER = re.compile(r"(?<![\w.])([-+]?\d+(?:\.\d+)?)\s*(mm|cm|m|ft)?(?![\w.])", re.IGNORECASE)
_LABELLED = re.compile(r"(?:^|[^A-Za-z])[A-Za-z]{1,8}\s*[:=]\s*([-+]?\d+(?:\.\d+)?)\s*(mm|cm|m|ft)?", re.IGNORECASE)
_COMPLAINT = re.compile(r"\s*(e|err|error)\b", re.IGNORECASE)
_FARTHEST_M = 1000.0


def parse_line(line: str, unit: str = "m", field: int = 0) -> float | None:
    """The distance in a line, metres; None where it holds none (an error message, "no target").

    `field`: which comma-separated field (1 is the first; of NMEA-like lines the talker is field 1), 0: the first number of the
    line. A unit in the line wins over `unit`. Negative, zero and absurd distances are "no target".
    """
    text = line.strip()
    if text.startswith("$"):
        body, star, checksum = text[1:].partition("*")
        if star and not _checksum_fits(body, checksum):
            return None
        text = body
    if field > 0:
        parts = text.split(",")
        if field > len(parts):
            return None
        unit_after = parts[field].strip().lower() if field < len(parts) else ""  # NMEA: value, unit
        unit = unit_after if unit_after in _METRES else unit
        text = parts[field - 1].strip()
    if _COMPLAINT.match(text):
        return None
    match = _LABELLED.search(text) or _NUMBER.search(text)
    if match is None:
        return None
    metres = float(match[1]) * _METRES[(match[2] or unit).lower()]
    return metres if math.isfinite(metres) and 0.0 < metres <= _FARTHEST_M else None


def _checksum_fits(body: str, checksum: str) -> bool:
    value = 0
    for byte in body.encode("ascii", errors="replace"):
        value ^= byte
    return checksum[:2].upper() == f"{value:02X}"


class RangePort:
    """Reads lines on a thread; each becomes a RangeReference for `on_range`. A port that is not there is tried again."""

    def __init__(self, settings: RecordConfig, on_range: Callable[[RangeReference], None]) -> None:
        self._s, self._on_range = settings, on_range
        # its end leaves the truth missing, nothing else: the service goes on
        self._lines = SerialLines(
            settings.range_device, settings.range_baud, self._take, is_line=lambda _: True, name="rangefinder",
            silent=("line", "record.range_baud"), log=_log,
        )  # fmt: skip
        self.lines = self.ranges = 0

    def start(self) -> None:
        """Opens in the background."""
        self._lines.start()

    def close(self) -> None:
        """Stops the thread and closes the port."""
        self._lines.close()

    def _take(self, line: bytes, t_ns: int) -> None:
        self.lines += 1
        text = line.decode("ascii", errors="replace").strip()
        distance_m = parse_line(text, self._s.range_unit, self._s.range_field)
        self.ranges += distance_m is not None
        self._on_range(RangeReference(t_ns=t_ns, distance_m=distance_m, text=text))
