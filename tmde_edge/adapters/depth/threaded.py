"""A network in its own thread, for the service: always the newest frame, at most at the configured rate."""

from __future__ import annotations

import threading
from collections.abc import Callable

from tmde_edge.adapters.depth.paced import Network
from tmde_edge.adapters.depth.recorded import Pace
from tmde_edge.messages import DepthReading, Frame


class ThreadedDepth:
    """`submit` never waits: a frame that was not taken yet is replaced by the newer one."""

    def __init__(
        self,
        network: Network,
        *,
        rate_hz: float,
        clock_ns: Callable[[], int],
        on_reading: Callable[[DepthReading], None],
        on_failure: Callable[[BaseException], None],
    ) -> None:
        """`on_reading` and `on_failure` are called in the network's thread; after a failure the thread has ended."""
        self._network = network
        self._pace = Pace(rate_hz)
        self._clock_ns = clock_ns
        self._on_reading, self._on_failure = on_reading, on_failure
        self._wake = threading.Condition()
        self._newest: Frame | None = None
        self._stopping = False
        self.skipped = 0  # frames that were due but replaced before the network was free
        self._thread = threading.Thread(target=self._run, name="depth", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def submit(self, frame: Frame) -> bool:
        """Offers a frame; True where it is taken (or waits for the network), False where none is due."""
        with self._wake:
            if not self._pace.is_due(frame.t_ns):
                return False
            if self._newest is not None:
                self.skipped += 1
            self._newest = frame
            self._wake.notify()
        return True

    def stop(self, timeout_s: float = 5.0) -> bool:
        """Ends the thread; False where it is still inside the network after the timeout."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while True:
                with self._wake:
                    while self._newest is None and not self._stopping:
                        self._wake.wait()
                    if self._stopping or self._newest is None:
                        return
                    frame, self._newest = self._newest, None
                    self._pace.took(frame.t_ns)
                self._deliver(self._network.infer(frame))
        except Exception as error:  # a thread's top: whatever it was, the service hears of it
            if not self._stopping:
                self._on_failure(error)

    def _deliver(self, reading: DepthReading) -> None:
        if self._stopping:  # given up meanwhile: another network may be at work by now
            return
        ready = max(self._clock_ns(), reading.t_ns)
        self._on_reading(
            DepthReading(
                t_ns=reading.t_ns, ready_t_ns=ready, width_px=reading.width_px, height_px=reading.height_px,
                grid_columns=reading.grid_columns, grid_rows=reading.grid_rows, inverse_depth=reading.inverse_depth,
                model=reading.model,
            )
        )  # fmt: skip
