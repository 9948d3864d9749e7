"""Lines from a serial port (pyserial) on a thread of their own; a port that is not there, or falls silent, is opened again."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from tmde_edge.adapters.can_ports.retry import BackOff, LastingFault

_LINE_S = 0.5
_LONGEST_LINE = 200  # bytes; NMEA allows 82
_GIVE_UP_S = 10.0  # no line for this long: open the port again


class SerialLines:
    """Gives each whole line that `is_line` takes, with the time of its end (monotonic ns), to `on_line`."""

    def __init__(
        self,
        device: str,
        baud: int,
        on_line: Callable[[bytes, int], None],
        *,
        is_line: Callable[[bytes], bool],
        name: str,
        silent: tuple[str, str],
        log: logging.Logger,
        on_crash: Callable[[BaseException], None] | None = None,
    ) -> None:
        """`name` is the thread's and the fault's; `silent`: what is missing when no line comes, and which setting to check."""
        self._device, self._baud, self._on_line, self._is_line = device, baud, on_line, is_line
        self._name, self._silent, self._log, self._on_crash = name, silent, log, on_crash
        self._fault = LastingFault(log, f"{name} {device}")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._guard, name=name, daemon=True)

    def start(self) -> None:
        """Opens in the background."""
        self._thread.start()

    def close(self) -> None:
        """Stops the thread and closes the port."""
        self._stop.set()
        self._thread.join(timeout=3.0)

    def _guard(self) -> None:
        try:
            self._run()
        except Exception as e:  # a thread's top
            self._log.exception("%s thread stopped", self._name)
            if self._on_crash is not None:
                self._on_crash(e)

    def _run(self) -> None:
        import serial  # only where a port is configured

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
        line, whole = b"", False  # the port may open in the middle of a line, and a part of a line is a wrong number
        while not self._stop.is_set():
            more: bytes = port.readline(_LONGEST_LINE - len(line))  # type: ignore[attr-defined]
            t_ns = time.monotonic_ns()
            whole = whole or not (more or line)  # after a silence a line begins
            line += more
            ended = line.endswith(b"\n")
            if whole and ended and self._is_line(line):
                heard_s = time.monotonic()
                self._fault.clear()
                back_off.reset()
                self._on_line(line, t_ns)
            elif time.monotonic() - heard_s > _GIVE_UP_S:
                raise OSError(f"no {self._silent[0]} for {_GIVE_UP_S:.0f} s; check {self._silent[1]}")
            if ended or len(line) >= _LONGEST_LINE:
                line, whole = b"", ended  # what follows the longest line is its tail
