"""GPS speed from an NMEA receiver on a serial port (pyserial), for vehicles without usable CAN."""

from __future__ import annotations

import logging
from collections.abc import Callable

from tmde_edge.adapters.serial_lines import SerialLines
from tmde_edge.canbus.gps import gps_frame, speed_from_nmea
from tmde_edge.messages import CanFrame

_log = logging.getLogger(__name__)


class NmeaPort:
    """Reads sentences on a thread; each speed becomes one inside frame (canbus/gps.py) for `on_frame`."""

    def __init__(
        self,
        device: str,
        baud: int,
        on_frame: Callable[[CanFrame], None],
        on_crash: Callable[[BaseException], None] | None = None,
    ) -> None:
        self._on_frame = on_frame
        self._lines = SerialLines(
            device, baud, self._take, is_line=lambda line: line.startswith(b"$"), name="GPS",
            silent=("NMEA sentence", "can.vehicle.gps_baud"), log=_log, on_crash=on_crash,
        )  # fmt: skip
        self.sentences = 0
        self.speeds = 0

    def start(self) -> None:
        """Opens in the background; a port that is not there is tried again."""
        self._lines.start()

    def close(self) -> None:
        """Stops the thread and closes the port."""
        self._lines.close()

    def _take(self, line: bytes, t_ns: int) -> None:
        self.sentences += 1
        speed_mps = speed_from_nmea(line.decode("ascii", errors="replace"))
        if speed_mps is not None:
            self.speeds += 1
            self._on_frame(gps_frame(t_ns, speed_mps))
