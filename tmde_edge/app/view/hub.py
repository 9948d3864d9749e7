"""Between the pipeline and the people who watch: keeps the newest, draws and encodes only while somebody looks.

The pipeline's threads only leave references here; drawing, encoding and building records happen on a thread of the
page's own, at a bounded rate and at a lower priority.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.app.overlay import draw
from tmde_edge.app.records import Record, frame_record
from tmde_edge.app.view.aiming import aim, exposure, nominal_camera, sharpness
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Frame, FrameResult, Sighting

_log = logging.getLogger(__name__)
HISTORY_S = 60.0
HISTORY_HZ = 10.0
KEPT_FRAMES = 4  # frames that wait for their decision
AIM_HZ = 2.0
NICE = 5  # of the page's own thread: the pipeline goes first
LEVELS = ("none", "caution", "warning")
Point = list[float | int | None]


class Hub:
    """`look`, `frame` and `service` for the pipeline; the rest for the server. Construct, start(), close()."""

    def __init__(
        self, camera: Camera | None, height_m: float | None, *, rate_hz: float, width_px: int, quality: int,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._camera, self._height_m = camera, height_m
        self._period_s, self._width_px, self._quality = 1.0 / rate_hz, width_px, quality
        self._clock_s = clock_s
        self._lock = threading.Condition()
        self._frames: dict[int, Frame] = {}
        self._newest: tuple[FrameResult, Sighting | None] | None = None
        self._painted: FrameResult | None = None
        self._history: deque[Point] = deque(maxlen=int(HISTORY_S * HISTORY_HZ * 1.5))
        self._history_s = -1.0
        self._watchers = 0  # pictures
        self._readers = 0  # numbers
        self._listeners: list[Callable[[], None]] = []
        self._closing = False
        self._aim_s = -1.0
        self._aim: dict[str, Any] = {}
        self._best_focus = 0.0
        self.jpeg: bytes | None = None
        self.picture_number = 0
        self.state: dict[str, Any] = {}  # what the page shows: built on the page's thread
        self.state_number = 0
        self.service_values: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)

    def start(self) -> None:
        """Begins drawing on its own thread."""
        self._thread.start()

    def close(self) -> None:
        """Ends the thread and everybody's streams."""
        with self._lock:
            self._closing = True
            self._lock.notify_all()
        if self._thread.is_alive():
            self._thread.join(0.5)
        self._wake()

    @property
    def closing(self) -> bool:
        return self._closing

    @property
    def watchers(self) -> int:
        """How many look at the picture."""
        return self._watchers

    # -- from the pipeline ----------------------------------------------------------------------------------------------

    def look(self, frame: Frame) -> None:
        """A frame that is about to be looked at; kept only while somebody watches."""
        if not self._watchers:
            return
        with self._lock:
            self._frames[frame.index] = frame
            while len(self._frames) > KEPT_FRAMES:
                del self._frames[min(self._frames)]

    def frame(self, result: FrameResult, sighting: Sighting | None) -> None:
        """What was decided for a frame, or (`sighting` None) that none came. Returns at once."""
        lead = result.lead
        values = (lead.distance_m, lead.sigma_m, lead.range_rate_mps, lead.ttc_s) if lead is not None else (None,) * 4
        self._remember(result.t_ns * 1e-9, values, result.alert.level)
        if not (self._watchers or self._readers):
            return
        with self._lock:
            self._newest = (result, sighting)
            self._lock.notify()

    def service(self, values: dict[str, Any]) -> None:
        """What the service knows of itself, once a second."""
        with self._lock:
            self.service_values = values
            self._lock.notify()

    def record(self, record: Record) -> None:
        """A record made elsewhere (the service's socket): numbers without a picture."""
        lead = record.get("lead") or {}
        values = tuple(lead.get(k) for k in ("distance_m", "sigma_m", "range_rate_mps", "ttc_s"))
        self._remember(record["t"], values, record["alert"]["level"])
        self._publish({"record": record, "aim": {}})
        self._wake()

    def _remember(self, t_s: float, values: Sequence[float | None], level: str) -> None:
        if 0 <= t_s - self._history_s < 0.95 / HISTORY_HZ:
            return
        if t_s < self._history_s:  # the recording began again
            self._history.clear()
        self._history_s = t_s
        self._history.append([round(t_s, 2), *(None if v is None else round(v, 3) for v in values), LEVELS.index(level)])

    # -- for the server -------------------------------------------------------------------------------------------------

    def history(self) -> list[Point]:
        """The last minute: t, distance, sigma, range rate, TTC, level (0 none, 1 caution, 2 warning)."""
        points = list(self._history)
        return [p for p in points if float(p[0] or 0) >= float(points[-1][0] or 0) - HISTORY_S] if points else []

    def watch(self, picture: bool, change: int) -> None:
        """Somebody came (change = 1) or went (-1)."""
        with self._lock:
            if picture:
                self._watchers += change
                if not self._watchers:
                    self._frames.clear()
            else:
                self._readers += change
            self._lock.notify()

    def listen(self, wake: Callable[[], None]) -> None:
        """`wake` is called from the page's thread whenever there is something new."""
        self._listeners.append(wake)

    def _wake(self) -> None:
        for wake in list(self._listeners):
            wake()

    # -- its own thread -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        if hasattr(os, "setpriority"):
            try:  # of this thread alone: Linux counts threads as processes here
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
            except OSError:
                _log.debug("the page's thread keeps its priority")
        try:
            while self._step():
                pass
        except Exception:  # the thread's top: the page stops, everything else goes on
            _log.exception("the live page stopped")
            self._closing = True
            self._wake()

    def _step(self) -> bool:
        with self._lock:
            while not self._closing and self._newest is None and not self._stale_service():
                self._lock.wait(1.0)
            if self._closing:
                return False
            newest, self._newest = self._newest, None
            frame = self._frames.get(newest[0].frame_index) if newest is not None else None
        start_s = self._clock_s()
        if newest is not None:
            self._show(newest[0], newest[1], frame)
        else:
            self._publish(dict(self.state))
        self._wake()
        rest_s = self._period_s - (self._clock_s() - start_s)
        if rest_s > 0:
            with self._lock:
                self._lock.wait_for(lambda: self._closing, rest_s)
        return True

    def _stale_service(self) -> bool:
        """The service spoke although no frame came: its faults are news."""
        return self._readers > 0 and bool(self.service_values) and self.state.get("service") is not self.service_values

    def _show(self, result: FrameResult, sighting: Sighting | None, frame: Frame | None) -> None:
        if frame is not None:
            picture = draw(frame.image, result, self._camera, width_px=min(self._width_px, frame.image.shape[1]))
            ok, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
            if ok:
                self.jpeg = data.tobytes()
                self.picture_number += 1
            self._judge(frame.image, result)
        timing_ms = sighting.timing_ms if sighting is not None else {}
        self._publish({"record": frame_record(result, sighting, timing_ms), "aim": self._aim})

    def _judge(self, image: NDArray[np.uint8], result: FrameResult) -> None:
        """The aiming aid, at its own low rate."""
        now_s = self._clock_s()
        if 0 <= now_s - self._aim_s < 1.0 / AIM_HZ:
            return
        self._aim_s = now_s
        height_px, width_px = image.shape[:2]
        try:
            camera = self._camera.scaled_to(width_px, height_px) if self._camera is not None else None
        except ValueError:  # a picture that does not fit the calibration
            camera = None
        focus = sharpness(image)
        self._best_focus = max(focus, self._best_focus * 0.999)  # forgets slowly: the view changes
        self._aim = {
            **aim(camera or nominal_camera(width_px, height_px), result.pose, self._height_m),
            "nominal": camera is None,
            "focus": round(focus, 4),
            "focus_share": round(focus / self._best_focus, 3) if self._best_focus > 0 else None,
            "exposure": exposure(image),
        }

    def _publish(self, state: dict[str, Any]) -> None:
        self.state = {**state, "service": self.service_values, "watchers": self._watchers}
        self.state_number += 1
