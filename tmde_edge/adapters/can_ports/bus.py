"""A CAN bus through python-can: receives on one thread, sends on another, never blocks the caller, comes back by itself."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from tmde_edge.adapters.can_ports.retry import BackOff, LastingFault
from tmde_edge.adapters.can_ports.serial_blocks import open_bus
from tmde_edge.adapters.can_ports.serial_hold import hold_serial
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.messages import CanFrame

_log = logging.getLogger(__name__)
_RECEIVE_S = 0.2
_SEND_S = 0.05
_STALE_S = 1.0  # a stamp older than this, or from the future, tells that the wall clock was set
_OPEN_PATIENCE_S = 5.0
_CALM_S = 1.0
_BUS_OFF = 0x40  # of an error frame's id (linux/can/error.h)
_RESTARTED = 0x100


@dataclass(slots=True)
class CanCounters:
    """What happened on the port since the start."""

    received: int = 0
    sent: int = 0
    silent: int = 0  # held back: can.transmit = false
    dropped: int = 0  # the queue was full or the bus was down
    failed: int = 0  # the adapter refused
    error_frames: int = 0
    garbled: int = 0  # lines of a serial adapter that make no sense
    bus_off: int = 0
    opened: int = 0
    clock_jumps: int = 0

    def as_dict(self) -> dict[str, int]:
        """For logs and status pages."""
        return asdict(self)


def monotonic_from_wall(stamp_s: float, wall_now_ns: int, monotonic_now_ns: int) -> tuple[int, bool]:
    """Monotonic time of a wall-clock stamp read just now, and whether the wall clock jumped (then: the time of arrival)."""
    if stamp_s <= 0:
        return monotonic_now_ns, False  # the adapter gives no stamp
    age_ns = wall_now_ns - round(stamp_s * 1e9)
    if -1_000_000 <= age_ns <= _STALE_S * 1e9:  # floats and clock steps of a microsecond are no jump
        return monotonic_now_ns - max(age_ns, 0), False
    return monotonic_now_ns, True


class CanPort:
    """One bus. `on_frame` is called on the receiving thread, in order; `on_crash` where a thread meets an unknown error."""

    def __init__(
        self,
        settings: CanSettings,
        on_frame: Callable[[CanFrame], None],
        wanted: Sequence[tuple[int, int, bool]] = (),
        on_crash: Callable[[BaseException], None] | None = None,
        open_pause_s: float = 2.0,
    ) -> None:
        """`wanted`: (id, mask, extended) let through, as VehicleDecoder.filters; `open_pause_s`: for slcan to start up."""
        self._s = settings
        self._on_frame = on_frame
        ids = [(i, 0x1FFFFFFF if i > 0x7FF else 0x7FF, i > 0x7FF) for i in settings.receive_ids]
        self._wanted = ids or list(wanted)
        self._on_crash = on_crash
        self._open_pause_s = open_pause_s
        self.counters = CanCounters()
        self._bus: Any = None
        self._held: int | None = None
        self._queue: deque[CanFrame] = deque()
        self._wake = threading.Condition()
        self._stop = threading.Event()
        self._last_ns = 0
        self._started_s = 0.0
        where = f"CAN {settings.interface} {settings.channel}"
        self._bus_fault = LastingFault(_log, where)
        self._send_fault = LastingFault(_log, f"{where} sending", _CALM_S)
        self._threads: list[threading.Thread] = []

    @property
    def faults(self) -> tuple[str, ...]:
        """For Tick and STATUS: "can_tx" while frames cannot be sent."""
        down = self._bus_fault.present or self._send_fault.present
        return ("can_tx",) if down and self._s.transmit else ()

    @property
    def connected(self) -> bool:
        """True while the adapter is open."""
        return self._bus is not None

    def start(self) -> None:
        """Opens in the background: a bus that is not there yet is tried again and again."""
        if not self._s.transmit:
            _log.warning(
                "CAN %s %s: silent, nothing is sent; set can.transmit = true to send", self._s.interface, self._s.channel
            )
        self._started_s = time.monotonic()
        work = [("can-rx", self._receive)] + ([("can-tx", self._transmit)] if self._s.transmit else [])
        for name, target in work:
            thread = threading.Thread(target=self._guard, args=(target,), name=name, daemon=True)
            self._threads.append(thread)
            thread.start()

    def send(self, frame: CanFrame) -> None:
        """Queues a frame and returns at once; the oldest goes where the queue is full."""
        if not self._s.transmit:
            self.counters.silent += 1
            return
        with self._wake:
            if len(self._queue) >= self._s.queue_frames:
                self._queue.popleft()
                self.counters.dropped += 1
                self._send_fault.set("the bus takes no frames and the queue is full; the oldest are dropped and counted")
            self._queue.append(frame)
            self._wake.notify()

    def close(self) -> None:
        """Stops both threads and closes the adapter."""
        self._stop.set()
        with self._wake:
            self._wake.notify_all()
        for thread in self._threads:
            thread.join(timeout=3.0)

    # -- threads ------------------------------------------------------------------------------------------------------

    def _guard(self, target: Callable[[], None]) -> None:
        try:
            target()
        except Exception as e:  # a thread's top: an unknown error stops the service instead of going unnoticed
            _log.exception("CAN thread stopped")
            if self._on_crash is not None:
                self._on_crash(e)

    def _receive(self) -> None:
        import can  # slow to import

        back_off = BackOff()
        while not self._stop.is_set():
            try:
                self._hold()
                bus = self._open()
            except (can.CanError, OSError, ValueError, RuntimeError) as e:  # RuntimeError: msgpack missing, of udp_multicast
                self._release()
                self._bus_fault.set(f"cannot be opened ({e}); trying again")
                self._stop.wait(back_off.pause_s())
                continue
            self._bus = bus
            self.counters.opened += 1
            try:
                self._receive_from(bus, back_off)
            except (can.CanError, OSError) as e:
                self._bus_fault.set(f"failed ({e}); opening it again")
            finally:
                self._bus = None
                self._shut(bus)
                self._release()
            self._stop.wait(0.0 if self._stop.is_set() else back_off.pause_s())

    def _receive_from(self, bus: Any, back_off: BackOff) -> None:
        import can

        opened_s = time.monotonic()
        while not self._stop.is_set():
            try:
                message = bus.recv(_RECEIVE_S)
            except (ValueError, IndexError):  # noise on a serial line
                self._on_noise(bus)
                continue
            except can.CanOperationError as e:
                if not isinstance(e.__cause__, ValueError):
                    raise
                self._on_noise(bus)  # bytes that are no text: python-can wraps them
                continue
            if message is not None or time.monotonic() - opened_s > 1.0:
                self._bus_fault.clear()
                back_off.reset()
            if message is None:
                continue
            if message.is_error_frame:
                self._on_error_frame(message.arbitration_id)
            elif not message.is_remote_frame:
                self._deliver(message)

    def _on_noise(self, bus: Any) -> None:
        self.counters.garbled += 1
        if hasattr(bus, "flush"):
            bus.flush()  # slcan keeps the bad bytes otherwise

    def _on_error_frame(self, flags: int) -> None:
        self.counters.error_frames += 1
        if flags & _BUS_OFF:
            self.counters.bus_off += 1
            self._send_fault.set("bus off: check bit rate, wiring and termination; it restarts by the system's RestartSec")
        elif flags & _RESTARTED:
            self._send_fault.clear(at_once=True)

    def _deliver(self, message: Any) -> None:
        t_ns, jumped = monotonic_from_wall(message.timestamp, time.time_ns(), time.monotonic_ns())
        self.counters.clock_jumps += jumped
        self._last_ns = max(self._last_ns, t_ns)  # arrival order is time order
        self.counters.received += 1
        self._on_frame(
            CanFrame(
                t_ns=self._last_ns,
                can_id=message.arbitration_id,
                data=bytes(message.data),
                extended=message.is_extended_id,
                channel=self._s.channel,
            )
        )

    def _transmit(self) -> None:
        import can

        while not self._stop.is_set():
            with self._wake:
                if not self._queue:
                    self._wake.wait(timeout=0.5)
                    continue
                frame = self._queue.popleft()
            bus = self._bus
            if bus is None:
                self.counters.dropped += 1  # an old warning is no use later
                if time.monotonic() - self._started_s > _OPEN_PATIENCE_S and not self._bus_fault.present:
                    self._send_fault.set("the adapter does not open (it hangs); frames are dropped and counted")
                continue
            message = can.Message(arbitration_id=frame.can_id, is_extended_id=frame.extended, data=frame.data)
            try:
                bus.send(message, timeout=_SEND_S)
            except (can.CanError, OSError, ValueError, AttributeError, TypeError) as e:
                if self._bus is not bus:  # closed by the other thread meanwhile; pyserial then fails in its own ways
                    self.counters.dropped += 1
                    continue
                if isinstance(e, (AttributeError, TypeError)):
                    raise
                self.counters.failed += 1
                self._send_fault.set(f"failed ({e}); frames are dropped and counted")
            else:
                self.counters.sent += 1
                self._send_fault.clear()

    def _hold(self) -> None:
        if self._s.interface == "slcan":
            self._held = hold_serial(self._s.channel)

    def _release(self) -> None:
        held, self._held = self._held, None
        if held is not None:
            os.close(held)

    def _open(self) -> Any:
        s = self._s
        options: dict[str, Any] = {"interface": s.interface, "channel": s.channel}
        if self._wanted:
            options["can_filters"] = [{"can_id": i, "can_mask": m, "extended": e} for i, m, e in self._wanted]
        if s.fd:
            options["fd"] = True
        if s.interface == "slcan":
            options |= {
                "bitrate": s.bitrate,
                "sleep_after_open": self._open_pause_s,
                "timeout": 0.1,
                "listen_only": not s.transmit,
            }
        elif s.interface == "udp_multicast":
            options |= {"hop_limit": 0}  # between processes of this machine; a packet never leaves it
        return open_bus(options)

    def _shut(self, bus: Any) -> None:
        import can

        try:
            bus.shutdown()
        except (can.CanError, OSError) as e:
            _log.debug("closing the CAN adapter: %s", e)
