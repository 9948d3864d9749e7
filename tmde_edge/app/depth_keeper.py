"""Keeps the depth network running: loads it beside the start, loads it again after it failed, and says so meanwhile."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from tmde_edge.adapters.can_ports.retry import BackOff
from tmde_edge.adapters.depth.paced import Network
from tmde_edge.adapters.depth.recorded import Pace
from tmde_edge.adapters.depth.threaded import ThreadedDepth
from tmde_edge.errors import TmdeError
from tmde_edge.messages import DepthReading, Frame

_log = logging.getLogger(__name__)
_SILENT_NS = 10_000_000_000  # frames went in and nothing came out for so long: it hangs
_FIRST_NS = 120_000_000_000  # a first answer may take so long before it is loaded again: some accelerators compile then
_LOOK_S, _STOP_S = 0.5, 1.0
_LEFT_BEHIND = 3  # a network that hangs keeps its memory: no more are loaded beside so many


class DepthKeeper:
    """`submit` frames from the perception thread; without the network everything else runs on (fault "depth_lost")."""

    def __init__(
        self,
        make: Callable[[], Network],
        *,
        rate_hz: float,
        on_reading: Callable[[DepthReading], None],
        factor: Callable[[], int] = lambda: 1,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        back_off: BackOff | None = None,
    ) -> None:
        """`make` loads the network and may raise any TmdeError; `factor`: the rate is divided by it, to shed load."""
        self._make, self._rate_hz, self._on_reading, self._factor, self._clock_ns = make, rate_hz, on_reading, factor, clock_ns
        self._back_off = back_off or BackOff(1.0, 60.0)
        self._stopping, self._failed = threading.Event(), threading.Event()
        self._running: ThreadedDepth | None = None
        self._thin = Pace(rate_hz)
        self._lost = False
        self._providers: tuple[str, ...] = ()
        self._waits_since_ns: int | None = None
        self._hanging: list[ThreadedDepth] = []
        self.readings = self.restarts = 0
        self._thread = threading.Thread(target=self._keep, name="depth-keeper", daemon=True)

    @property
    def faults(self) -> tuple[str, ...]:
        """("depth_lost",) while no depth comes."""
        return ("depth_lost",) if self._lost or self._silent_for(_SILENT_NS) else ()

    def start(self) -> None:
        """Begins to load."""
        self._thread.start()

    def stop(self) -> None:
        """Ends it; a network that hangs is left behind."""
        self._stopping.set()
        self._failed.set()
        self._thread.join(3.0)

    def submit(self, frame: Frame) -> None:
        """Offers a frame; never waits."""
        running, factor = self._running, self._factor()
        if running is None:
            return
        if factor > 1:
            if not self._thin.is_due(frame.t_ns):
                return
            self._thin = Pace(self._rate_hz / factor)
            self._thin.took(frame.t_ns)
        idle = self._waits_since_ns is None
        if idle:  # before it is offered: the answer may be quicker than we are
            self._waits_since_ns = self._clock_ns()
        if not running.submit(frame) and idle:
            self._waits_since_ns = None

    def record(self) -> dict[str, Any]:
        """For `status`."""
        state = "lost" if self.faults else "works" if self.readings else "loading"
        return {"state": state, "providers": list(self._providers), "readings": self.readings, "restarts": self.restarts}

    def _silent_for(self, limit_ns: int) -> bool:
        waits = self._waits_since_ns
        return waits is not None and self._clock_ns() - waits > limit_ns

    def _keep(self) -> None:
        try:
            while not self._stopping.is_set():
                self._failed.clear()
                try:
                    network = self._make()
                except TmdeError as error:
                    self._fail(error)
                else:
                    self._run(network)
                self._stopping.wait(self._back_off.pause_s())
                while not self._stopping.is_set() and len(self._hanging) >= _LEFT_BEHIND:
                    self._stopping.wait(_LOOK_S)
                    self._hanging = [depth for depth in self._hanging if not depth.stop(0.0)]
                if not self._stopping.is_set():
                    self.restarts += 1
        except Exception as error:  # a thread's top: depth is an aid, the service goes on without it
            _log.exception("depth stopped for good")
            self._fail(error)

    def _run(self, network: Network) -> None:
        self._providers = tuple(getattr(network, "providers", ()))
        running = ThreadedDepth(
            network, rate_hz=self._rate_hz, clock_ns=self._clock_ns, on_reading=self._deliver, on_failure=self._fail
        )
        running.start()
        self._waits_since_ns = None
        self._running = running
        before, late = self.readings, 0
        while not self._failed.wait(_LOOK_S):
            late = late + 1 if self._silent_for(_SILENT_NS if self.readings > before else _FIRST_NS) else 0
            if late > 1:  # twice: after a pause of the whole process it is given a moment to answer
                self._fail(TimeoutError("the network hangs"))
        self._running = None
        self._waits_since_ns = None
        if not running.stop(_STOP_S):
            self._hanging.append(running)

    def _deliver(self, reading: DepthReading) -> None:
        self.readings += 1
        self._waits_since_ns = None
        self._back_off.reset()
        if self._lost:
            _log.warning("depth works again")
            self._lost = False
        self._on_reading(reading)

    def _fail(self, error: BaseException) -> None:
        if not self._lost:
            _log.error("depth is lost: %s; trying again", error, extra={"fields": {"TMDE_EVENT": "depth_lost"}})
        self._lost = True
        self._failed.set()
