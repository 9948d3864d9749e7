"""A lasting fault is logged once, and its recovery once; a broken device is tried again with growing pauses."""

from __future__ import annotations

import logging
import time


class LastingFault:
    """Turns many errors of one cause into two log lines."""

    def __init__(self, log: logging.Logger, subject: str, calm_s: float = 0.0) -> None:
        """`calm_s`: without errors for this long before it counts as recovered (so that a fault that flutters is one fault)."""
        self._log = log
        self._subject = subject
        self._calm_s = calm_s
        self._count = 0
        self._last_s = 0.0

    @property
    def present(self) -> bool:
        """True between the first error and the recovery."""
        return self._count > 0

    def set(self, text: str) -> None:
        """An error; only the first one is logged."""
        self._last_s = time.monotonic()
        self._count += 1
        if self._count == 1:
            self._log.error("%s: %s", self._subject, text)

    def clear(self, *, at_once: bool = False) -> None:
        """It works (again)."""
        if self._count and (at_once or time.monotonic() - self._last_s >= self._calm_s):
            self._log.warning("%s: works again after %d errors", self._subject, self._count)
            self._count = 0


class BackOff:
    """Pauses between tries: doubled up to a limit."""

    def __init__(self, first_s: float = 0.25, limit_s: float = 5.0) -> None:
        self._first_s, self._limit_s = first_s, limit_s
        self._next_s = first_s

    def pause_s(self) -> float:
        """The pause before the next try."""
        pause_s, self._next_s = self._next_s, min(self._next_s * 2, self._limit_s)
        return pause_s

    def reset(self) -> None:
        """The last try went well."""
        self._next_s = self._first_s
