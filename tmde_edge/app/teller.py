"""Alerts and faults as structured lines of the log, each change once; and the last alerts, for `status`."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from typing import Any

from tmde_edge.messages import AlertLevel, FrameResult, Sighting

_log = logging.getLogger(__name__)
_LASTING_NS = 300_000_000  # a fault is told when it lasts; the camera's first frame may take as long
_CALM_NS = 5_000_000_000  # a fault is over when it has been away for so long: one that flutters is one fault
_SERIOUS = {"none": logging.INFO, "caution": logging.INFO, "warning": logging.WARNING}


class Teller:
    """An outlet of the live loop; or `take` each result. On the deciding thread."""

    def __init__(self, wall_s: Callable[[], float] = time.time) -> None:
        self._wall_s = wall_s
        self._level: AlertLevel = "none"
        self._decided = False
        self._since: dict[str, int] = {}  # faults in force: since when
        self._faults: dict[str, int] = {}  # told and not yet over: when it was seen last
        self._last: deque[dict[str, Any]] = deque(maxlen=10)

    @property
    def last_alerts(self) -> list[dict[str, Any]]:
        """The newest first."""
        return list(self._last)[::-1]

    def take(self, result: FrameResult) -> None:
        """Logs what changed."""
        if result.alert.level != self._level:
            self._tell_alert(result)
        self._tell_faults(result.t_ns, result.faults)

    def frame(self, result: FrameResult, sighting: Sighting | None) -> None:
        """As an outlet of the loop: takes the result."""
        self._decided = True
        self.take(result)

    def service(self, values: dict[str, Any]) -> None:
        """As an outlet of the loop: before the first picture there are no results that could tell that none comes."""
        if not self._decided and "blind" in values["faults"]:
            self._tell_faults(round(values["t"] * 1e9), values["faults"])

    def _tell_faults(self, t_ns: int, faults: Sequence[str]) -> None:
        self._since = {f: self._since.get(f, t_ns) for f in faults}
        for fault, since_ns in self._since.items():
            if fault not in self._faults and t_ns - since_ns < _LASTING_NS:
                continue
            if fault not in self._faults:
                _log.warning("fault: %s", fault, extra={"fields": {"TMDE_EVENT": "fault", "TMDE_FAULT": fault}})
            self._faults[fault] = t_ns
        for fault in [f for f, t in self._faults.items() if t_ns - t > _CALM_NS]:
            del self._faults[fault]
            _log.info("no longer: %s", fault, extra={"fields": {"TMDE_EVENT": "fault_over", "TMDE_FAULT": fault}})

    def _tell_alert(self, result: FrameResult) -> None:
        alert, lead = result.alert, result.lead
        self._level = alert.level
        metres = lead.distance_m if lead is not None else None
        words = [f"alert {alert.level}"] + ([alert.reason] if alert.reason else [])
        words += [f"TTC {alert.ttc_s:.1f} s"] if alert.ttc_s is not None else []
        words += [f"lead {metres:.1f} m"] if metres is not None else []
        fields = {
            "TMDE_EVENT": "alert", "TMDE_LEVEL": alert.level, "TMDE_REASON": alert.reason,
            "TMDE_TTC_S": None if alert.ttc_s is None else f"{alert.ttc_s:.2f}",
            "TMDE_DISTANCE_M": None if metres is None else f"{metres:.2f}",
        }  # fmt: skip
        _log.log(_SERIOUS[alert.level], ", ".join(words), extra={"fields": fields})
        if alert.level != "none":
            when = datetime.fromtimestamp(self._wall_s(), timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
            self._last.append(
                {"time": when, "level": alert.level, "reason": alert.reason, "ttc_s": alert.ttc_s, "distance_m": metres}
            )
