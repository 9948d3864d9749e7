"""`[alerts] command`: a program of the user's (a buzzer, a lamp) is run when the alert's level changes. Off by default."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import threading
from collections.abc import Sequence

from tmde_edge.messages import Alert, AlertLevel

_log = logging.getLogger(__name__)


class AlertCommand:
    """Runs `command LEVEL REASON TTC` on a thread of its own, one at a time; while one runs only the newest change waits."""

    def __init__(self, command: Sequence[str], timeout_s: float) -> None:
        self._command = list(command)
        self._timeout_s = timeout_s
        self._level: AlertLevel = "none"
        self._next: Alert | None = None
        self._changed = threading.Condition()
        self._closing = False
        self._failing = False
        self._process: subprocess.Popen[bytes] | None = None
        self.runs = self.failures = 0
        self._thread = threading.Thread(target=self._run, name="alert-command", daemon=True)
        self._thread.start()

    def take(self, alert: Alert) -> None:
        """The alert of this moment; returns at once."""
        if alert.level == self._level:
            return
        self._level = alert.level
        with self._changed:
            self._next = alert
            self._changed.notify()

    def close(self) -> None:
        """Ends the thread and what it runs."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        process = self._process
        if process is not None:
            _kill(process)
        self._thread.join(2.0)

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._next is not None or self._closing)
                    if self._closing:
                        return
                    alert, self._next = self._next, None
                if alert is not None:
                    self._judge(self._once(alert))
        except Exception:  # the thread's top: the warnings themselves do not hang on a buzzer
            _log.exception("alerts.command stopped")

    def _once(self, alert: Alert) -> str:
        """Why it failed; empty where it did not."""
        ttc = "" if alert.ttc_s is None else f"{alert.ttc_s:.2f}"
        values = {"TMDE_ALERT_LEVEL": alert.level, "TMDE_ALERT_REASON": alert.reason, "TMDE_ALERT_TTC_S": ttc}
        self.runs += 1
        try:
            process = subprocess.Popen(
                [*self._command, alert.level, alert.reason, ttc], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL, env={**os.environ, **values}, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            return error.strerror or str(error)
        self._process = process
        try:
            code = process.wait(self._timeout_s)
        except subprocess.TimeoutExpired:
            _kill(process)
            process.wait()
            return f"killed after {self._timeout_s:g} s"
        finally:
            self._process = None
        return f"exit code {code}" if code and not self._closing else ""

    def _judge(self, fault: str) -> None:
        """A lasting fault is logged once, and its end once."""
        self.failures += bool(fault)
        if fault and not self._failing:
            _log.error("alerts.command %s: %s", self._command[0], fault)
        elif not fault and self._failing:
            _log.info("alerts.command %s works again", self._command[0])
        self._failing = bool(fault)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Its whole group: a shell script's children too."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
