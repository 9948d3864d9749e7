"""GPS speed from an NMEA receiver on a serial port (pyserial), for vehicles without usable CAN."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from tmde_edge.adapters.can_ports.retry import BackOff, LastingFault
from tmde_edge.canbus.gps import gps_frame, speed_from_nmea
from tmde_edge.messages import CanFrame

_log = logging.getLogger(__name__)
_LINE_S = 0.5
_LONGEST_LINE = 200  # bytes; NMEA allows 82
_GIVE_UP_S = 10.0  # no sentence for this long: open the port again


class NmeaPort:
    """Reads sentences on a thread; each speed becomes one inside frame (canbus/gps.py) for `on_frame`."""

    def __init__(
        self,
        device: str,
        baud: int,
        on_frame: Callable[[CanFrame], None],
        on_crash: Callable[[BaseException], None] | None = None,
    ) -> None:
        self._device, self._baud, self._on_frame, self._on_crash = device, baud, on_frame, on_crash
        self._fault = LastingFault(_log, f"GPS {device}")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._guard, name="gps", daemon=True)
        self.sentences = 0
        self.speeds = 0

    def start(self) -> None:
        """Opens in the background; a port that is not there is tried again."""
        self._thread.start()

    def close(self) -> None:
        """Stops the thread and closes the port."""
        self._stop.set()
        self._thread.join(timeout=3.0)

    def _guard(self) -> None:
        try:
            self._run()
        except Exception as e:  # a thread's top
            _log.exception("GPS thread stopped")
            if self._on_crash is not None:
                self._on_crash(e)

    def _run(self) -> None:
        import serial  # only where a GPS is configured

        back_off = BackOff()
        while not self._stop.is_set():
            try:
                with serial.Serial(self._device, self._baud, timeout=_LINE_S) as port:
                    self._read(port, back_off)
            except (serial.SerialException, OSError) as e:
                self._fault.set(f"{e}; trying again")
                self._stop.wait(back_off.pause_s())

    def _read(self, port: object, back_off: BackOff) -> None:
        heard_s = time.monotonic()
        while not self._stop.is_set():
            line: bytes = port.readline(_LONGEST_LINE)  # type: ignore[attr-defined]
            t_ns = time.monotonic_ns()
            if not line.startswith(b"$"):
                if time.monotonic() - heard_s > _GIVE_UP_S:
                    raise OSError(f"no NMEA sentence for {_GIVE_UP_S:.0f} s; check can.vehicle.gps_baud")
                continue
            heard_s = time.monotonic()
            self._fault.clear()
            back_off.reset()
            self.sentences += 1
            speed_mps = speed_from_nmea(line.decode("ascii", errors="replace"))
            if speed_mps is not None:
                self.speeds += 1
                self._on_frame(gps_frame(t_ns, speed_mps))
