"""What the service answers on its status socket: one JSON object put together from its parts."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, Protocol

from tmde_edge import __version__
from tmde_edge.app.board import BoardState, memory_mb
from tmde_edge.app.live import LiveLoop
from tmde_edge.app.recorder import Recorder
from tmde_edge.app.records import lead_record
from tmde_edge.app.shedding import LEVELS
from tmde_edge.app.teller import Teller
from tmde_edge.config import Config

Json = dict[str, Any]
_SEVERE = {"blind", "camera_lost"}  # nothing can be warned of


class DepthState(Protocol):
    """What is asked of the depth network's keeper."""

    def record(self) -> Json:
        """For `status`."""
        ...


class Reporter:
    """Answers requests on the status thread; reads only what may be read from there."""

    def __init__(
        self,
        config: Config,
        loop: LiveLoop,
        teller: Teller,
        *,
        board: Callable[[], BoardState],
        depth: DepthState | None = None,
        recorder: Recorder | None = None,
        log_waiting: Callable[[], int] = lambda: 0,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._config, self._loop, self._teller = config, loop, teller
        self._board, self._depth, self._recorder, self._log_waiting = board, depth, recorder, log_waiting
        self._now_ns = monotonic_ns
        self._started_ns = monotonic_ns()
        self.bus: Any = None  # set when the bus exists

    def answer(self, request: Json) -> Json:
        """One request of the socket."""
        kind = request.get("request")
        if kind == "status":
            return self.status()
        if kind == "incident":
            evidence = self._recorder.evidence if self._recorder is not None else None
            if evidence is None:
                return {"error": "no evidence is kept; set record.incidents = true (or record.shadow = true while silent)"}
            evidence.ask(str(request.get("note", ""))[:200])
            return {"incident": "will be written", "folder": self._config.record.folder}
        return {"error": f"unknown request {kind!r}; known: status, incident"}

    def status(self) -> Json:
        """Everything that is known about the service now."""
        now_ns = self._now_ns()
        loop, counters = self._loop, self._loop.counters
        faults, last, board = loop.faults(now_ns), loop.last, self._board()
        watched = loop.camera
        begins = last is None and "blind" not in faults
        state = "init" if begins else "fault" if _SEVERE & set(faults) else "degraded" if faults else "ready"
        return {
            "version": __version__,
            "pid": os.getpid(),
            "uptime_s": round((now_ns - self._started_ns) * 1e-9, 1),
            "state": state,
            "faults": list(faults),
            "frames": {
                **loop.stats.record(now_ns), "decided": counters.sightings, "skipped": counters.skipped, "shed": counters.shed,
                "age_s": round((now_ns - last.t_ns) * 1e-9, 3) if last is not None else None,
            },
            "camera": {"name": watched.camera.name, "fault": watched.fault, **asdict(watched.counters)},
            "can": self._can(),
            "depth": self._depth.record() if self._depth is not None else None,
            "queues": {"inbox": loop.inbox_waiting, "inbox_dropped": counters.inbox_dropped, "log": self._log_waiting()},
            "board": {
                "temperature_c": board.temperature_c, "throttled": list(board.throttled),
                "throttled_before": list(board.throttled_before), "memory_mb": memory_mb(),
            },
            "shedding": LEVELS[loop.shedder.level] if loop.shedder is not None else "off",
            "record": self._record(),
            "lead": lead_record(last.lead) if last is not None else None,
            "speed_mps": last.ego.speed_mps if last is not None and last.ego is not None else None,
            "alert": {"level": last.alert.level, "reason": last.alert.reason, "ttc_s": last.alert.ttc_s} if last else None,
            "last_alerts": self._teller.last_alerts,
        }  # fmt: skip

    def _can(self) -> Json | None:
        settings, bus = self._config.can, self.bus
        if not settings.enabled or bus is None:
            return None
        return {
            "name": f"{settings.interface} {settings.channel}", "transmit": settings.transmit,
            "connected": getattr(bus, "connected", None), "faults": list(bus.faults),
            **bus.counters.as_dict(), "withheld": bus.counters.silent,
        }  # fmt: skip

    def _record(self) -> Json | None:
        recorder, settings = self._recorder, self._config.record
        if recorder is None:
            return None
        mode = "shadow" if not self._config.can.transmit else "on"
        return {
            "folder": settings.folder,
            "ring": str(recorder.ring.path) if recorder.ring is not None else "off",
            "incidents": f"{mode}, {recorder.evidence.kept} kept since the start" if recorder.evidence is not None else "off",
            "problem": recorder.problem,
        }
