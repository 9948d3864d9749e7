"""The service's loop: cameras and CAN deliver on their threads, one thread decides, in the order of one queue.

    capture --newest frame--> perception --Sighting--+
    CAN receiving ------------------------CanFrame---+--> inbox --> estimation.step --> CAN sending, drive log, status
    silence ---------------------------------Tick----+
"""

from __future__ import annotations

import gc
import logging
import queue
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol, TypeAlias

from tmde_edge.adapters.cameras.live_camera import Captured, LiveCamera, WatchedCamera
from tmde_edge.app.background_log import BackgroundLog
from tmde_edge.app.board import BoardState
from tmde_edge.app.dry_run import size_error
from tmde_edge.app.live_stats import LiveStats
from tmde_edge.app.sdnotify import Notifier
from tmde_edge.app.shedding import LEVELS, Shedder
from tmde_edge.errors import ConfigError, TmdeError
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Alert, CanFrame, DepthReading, Event, Frame, FrameResult, Output, Sighting, Tick

_log = logging.getLogger(__name__)
SWITCH_INTERVAL_S = 0.001  # a decision waits this long at most for the interpreter; Python's own 5 ms add up over three threads
INBOX_EVENTS = 4000  # at 5,000 CAN frames a second still most of a second
OVERLOAD_HOLD_NS = 2_000_000_000  # "overload" stays in force this long after its cause
LATE_NS = 500_000_000  # a sighting that waited longer for its decision is a sign of overload
STATUS_PERIOD_NS = 1_000_000_000
START_NS = 5_000_000_000  # a camera may take so long to give its first picture: after it the service is blind
JOIN_S = 2.0
COOL_C = 5.0  # a hot board is no longer hot this far below its limit


class Decider(Protocol):
    """The estimation."""

    def step(self, event: Event) -> tuple[Output, ...]:
        """Takes one event and returns what follows from it."""
        ...


class BusPort(Protocol):
    """The CAN bus as the loop uses it."""

    @property
    def faults(self) -> tuple[str, ...]:
        """What is wrong with it."""
        ...

    def start(self) -> None:
        """Begins receiving and sending on its own threads."""
        ...

    def send(self, frame: CanFrame) -> None:
        """Queues a frame; never blocks."""
        ...

    def close(self) -> None:
        """Stops its threads."""
        ...


class Outlet(Protocol):
    """Where the records go: local programs (app/publish.py), the web page (app/view)."""

    def frame(self, result: FrameResult, sighting: Sighting | None) -> None:
        """What was decided for a frame, or (`sighting` None) that none came; never blocks."""
        ...

    def service(self, values: dict[str, Any]) -> None:
        """The state of the service; never blocks."""
        ...


@dataclass(slots=True)
class LiveCounters:
    """What happened since the start."""

    sightings: int = 0
    can_frames: int = 0
    ticks: int = 0
    skipped: int = 0  # frames that a newer one replaced before they were looked at
    shed: int = 0  # frames left out on purpose, to shed load
    inbox_dropped: int = 0


_Item: TypeAlias = "tuple[Event, Frame | None]"


class LiveLoop:
    """Construct, give `on_can` and `crash` to the CAN port, then `run` on the main thread; `stop` from anywhere."""

    def __init__(
        self,
        camera: LiveCamera,
        see: Callable[[Frame], Sighting],
        estimation: Decider,
        *,
        calibration: Camera | None = None,
        notifier: Notifier | None = None,
        log: BackgroundLog | None = None,
        outlets: Sequence[Outlet] = (),
        on_alert: Callable[[Alert], None] | None = None,
        on_frame: Callable[[Frame], None] | None = None,
        on_result: Sequence[Callable[[FrameResult], None]] = (),
        more_faults: Callable[[], tuple[str, ...]] | None = None,
        board: Callable[[], BoardState] | None = None,
        hot_c: float = 80.0,
        shedder: Shedder | None = None,
        on_thread: Callable[[str], None] | None = None,
        tick_hz: float = 20.0,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`see` and `on_frame` (depth, a live page) run on the perception thread, all else that is called on the deciding one.

        `on_thread` is called first on each thread, with its name. `shedder`: None never sheds load. `calibration`: pictures
        must fit it.
        """
        self._stopping = threading.Event()
        self.camera = WatchedCamera(camera, pause=self._stopping.wait)
        self._see = see
        self._calibration = calibration
        self._estimation = estimation
        self._notifier = notifier or Notifier({})
        self._log_to = log
        self._outlets = tuple(outlets)
        self._on_alert = on_alert
        self._on_frame = on_frame
        self._on_result = tuple(on_result)
        self._more_faults = more_faults or tuple
        self._board = board or BoardState
        self._hot_c, self._hot = hot_c, False
        self.shedder = shedder
        self._on_thread = on_thread or (lambda name: None)
        self.stats = LiveStats()
        self._tick_ns = round(1e9 / tick_hz)
        self._now_ns = monotonic_ns
        self.counters = LiveCounters()
        self._inbox: queue.Queue[_Item] = queue.Queue(INBOX_EVENTS)
        self._newest: Captured | None = None
        self._fresh = threading.Condition()
        self._seen_all = threading.Event()  # the recording is over and its last frame was looked at
        self._error: BaseException | None = None
        self._overload_ns: int | None = None
        self._fed_ns = self._status_ns = 0
        self._started_ns = monotonic_ns()
        self._last: FrameResult | None = None
        self._bus: BusPort | None = None

    # -- from other threads -------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Ends `run` soon; safe in a signal handler."""
        self._stopping.set()

    def crash(self, error: BaseException) -> None:
        """A thread died of an unknown error: the service stops, `run` raises it."""
        if self._error is None:
            self._error = error
        self._stopping.set()

    def on_can(self, frame: CanFrame) -> None:
        """Takes a received CAN frame."""
        self._put(frame)

    def on_depth(self, reading: DepthReading) -> None:
        """Takes a depth reading."""
        self._put(reading)

    # -- the deciding thread ------------------------------------------------------------------------------------------

    def run(self, bus: BusPort) -> None:
        """Decides until `stop`, or until a played recording is over. Raises what a thread died of."""
        self._bus = bus
        switch_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.freeze()  # what is built by now lives on: looking through all of it for garbage again would cost a frame
        self._on_thread("decision")
        threads = [self._thread("capture", self._capture), self._thread("perception", self._perceive)]
        bus.start()
        for thread in threads:
            thread.start()
        self._notifier.status("running; waiting for the camera")
        self._notifier.ready()
        try:
            self._decide_all()
        finally:
            sys.setswitchinterval(switch_s)
            gc.unfreeze()
            self._stopping.set()
            self._notifier.stopping()
            bus.close()
            for thread in threads:
                thread.join(JOIN_S)
            self.camera.close()
            if self._log_to is not None:
                self._log_to.close()
        if self._error is not None:
            raise self._error

    def _decide_all(self) -> None:
        next_tick_ns = self._now_ns()
        while not self._stopping.is_set():
            if self._seen_all.is_set() and self._inbox.empty():
                return
            now_ns = self._now_ns()
            if now_ns >= next_tick_ns:
                # Never two ticks for one silence: after a pause of the whole process time goes on from now.
                next_tick_ns = max(next_tick_ns + self._tick_ns, now_ns)
                self._decide(self._tick(now_ns), None)
                continue
            try:
                event, frame = self._inbox.get(timeout=(next_tick_ns - now_ns) * 1e-9)
            except queue.Empty:
                continue
            self._decide(event, frame)

    def _tick(self, now_ns: int) -> Tick:
        temperature_c = self._board().temperature_c
        return Tick(t_ns=now_ns, faults=self._faults(now_ns), temperature_c=temperature_c)

    def _decide(self, event: Event, frame: Frame | None) -> None:
        outputs = self._estimation.step(event)
        for output in outputs:
            if isinstance(output, CanFrame):
                if self._bus is not None:
                    self._bus.send(output)
            else:
                self._last = output
                if self._on_alert is not None:
                    self._on_alert(output.alert)
                for outlet in self._outlets:
                    outlet.frame(output, event if isinstance(event, Sighting) else None)
                for listener in self._on_result:
                    listener(output)
        if self._log_to is not None:
            self._log_to.write(event, outputs, frame)
        now_ns = self._now_ns()
        if isinstance(event, Sighting):
            self.counters.sightings += 1
            self.stats.decided(event.t_ns, now_ns)
            if now_ns - event.t_ns > LATE_NS:
                self._overload_ns = now_ns
        elif isinstance(event, CanFrame):
            self.counters.can_frames += 1
        elif isinstance(event, Tick):
            self.counters.ticks += 1
        self._sign_of_life(event, now_ns)

    def _sign_of_life(self, event: Event, now_ns: int) -> None:
        """Frames decided, or time passing while the camera is known to be dead: nothing else counts as progress."""
        progress = isinstance(event, Sighting) or (isinstance(event, Tick) and self._blind_for_a_reason())
        period_s = self._notifier.watchdog_s
        if progress and period_s is not None and now_ns - self._fed_ns >= period_s * 1e9 / 4:
            self._notifier.watchdog()
            self._fed_ns = now_ns
        if now_ns - self._status_ns >= STATUS_PERIOD_NS:
            self._shed(now_ns)
            self._notifier.status(self.status_text(now_ns))
            self._status_ns = now_ns
            if self._outlets:
                values = self.service_values(now_ns)
                for outlet in self._outlets:
                    outlet.service(values)

    def _shed(self, now_ns: int) -> None:
        """Takes the board's pulse once a second and does less, or more again."""
        state, c = self._board(), self.counters
        limit_c = self._hot_c - (COOL_C if self._hot else 0.0)
        self._hot = (state.temperature_c is not None and state.temperature_c >= limit_c) or any(
            "temperature" in word for word in state.throttled
        )
        load = self.stats.load(
            now_ns, sightings=c.sightings, skipped=c.skipped, inbox_dropped=c.inbox_dropped, hot=self._hot
        )
        if self.shedder is not None and self.shedder.step(now_ns * 1e-9, load):
            _log.warning("load shed: %s (%s)", LEVELS[self.shedder.level], load)

    def _blind_for_a_reason(self) -> bool:
        return self.camera.fault is not None or self.camera.camera.ended

    def _faults(self, now_ns: int) -> tuple[str, ...]:
        faults: list[str] = []
        if self.camera.fault is not None:
            faults.append(self.camera.fault)
        late = self._overload_ns is not None and now_ns - self._overload_ns < OVERLOAD_HOLD_NS
        if late or (self.shedder is not None and self.shedder.level > 0):
            faults.append("overload")
        if self._hot:
            faults.append("hot")
        if self._log_to is not None and self._log_to.problem is not None:
            faults.append("disk")
        return (*faults, *self._more_faults(), *(self._bus.faults if self._bus is not None else ()))

    def faults(self, now_ns: int) -> tuple[str, ...]:
        """Everything that is wrong now, as the adapters and the estimation know it."""
        last = self._last
        if last is not None:
            decided = last.faults
        else:
            decided = ("blind",) if now_ns - self._started_ns > START_NS else ()
        return tuple(dict.fromkeys((*self._faults(now_ns), *decided)))

    @property
    def last(self) -> FrameResult | None:
        """The last result."""
        return self._last

    @property
    def inbox_waiting(self) -> int:
        """Events that wait for a decision."""
        return self._inbox.qsize()

    def status_text(self, now_ns: int) -> str:
        """One line for people."""
        parts = [f"{self.stats.rate_hz(now_ns):.1f} frames/s"]
        last = self._last
        if last is not None:
            lead = last.lead
            if lead is not None and lead.distance_m is not None:
                parts.append(f"lead {lead.distance_m:.1f} m")
            parts.append(f"alert {last.alert.level}")
        faults = self.faults(now_ns)
        parts.append("faults " + ", ".join(faults) if faults else "no faults")
        return "; ".join(parts)

    def service_values(self, now_ns: int) -> dict[str, Any]:
        """What the service line of the socket holds."""
        return {
            "t": round(now_ns * 1e-9, 3), "status": self.status_text(now_ns), "faults": list(self.faults(now_ns)),
            **asdict(self.counters),
        }  # fmt: skip

    # -- the other threads --------------------------------------------------------------------------------------------

    def _thread(self, name: str, work: Callable[[], None]) -> threading.Thread:
        def guarded() -> None:
            try:
                self._on_thread(name)
                work()
            except TmdeError as error:  # known: one line, and its own exit code
                self.crash(error)
            except Exception as error:  # a thread's top: it stops the service instead of going unnoticed
                _log.exception("the %s thread stopped", name)
                self.crash(error)

        return threading.Thread(target=guarded, name=name, daemon=True)

    def _capture(self) -> None:
        while not self._stopping.is_set():
            captured = self.camera.next(0.2)
            if captured is None and self.camera.camera.ended:
                break
            if captured is not None:
                with self._fresh:
                    if self._newest is not None:
                        self.counters.skipped += 1
                    self._newest = captured
                    self._fresh.notify()
        with self._fresh:
            self._fresh.notify()

    def _perceive(self) -> None:
        index = count = 0
        while not self._stopping.is_set():
            with self._fresh:
                if self._newest is None:
                    if self.camera.camera.ended:
                        break
                    self._fresh.wait(0.2)
                captured, self._newest = self._newest, None
            if captured is None:
                continue
            image = captured.decode()
            misfit = size_error(self._calibration, image.shape[1], image.shape[0]) if image is not None else None
            if misfit is not None and count == 0:
                raise ConfigError(f"{self.camera.camera.name}: {misfit}")
            if image is None or misfit is not None:  # a single picture of another size is a broken one
                self.camera.garbled()
                continue
            self.camera.good()
            count += 1
            if self.shedder is not None and count % self.shedder.frame_factor:
                self.counters.shed += 1
                continue
            frame = Frame(t_ns=captured.t_ns, index=index, image=image)
            index += 1
            start_ns = self._now_ns()
            if self._on_frame is not None:
                self._on_frame(frame)
            sighting = self._see(frame)
            self.stats.perceived(self._now_ns() - start_ns)
            self._put(sighting, frame)
        self._seen_all.set()

    def _put(self, event: Event, frame: Frame | None = None) -> None:
        try:
            self._inbox.put_nowait((event, frame))
        except queue.Full:
            self.counters.inbox_dropped += 1
            self._overload_ns = self._now_ns()
