"""Log records for systemd's journal with fields of their own; level prefixes, or plain text, where there is no journal.

A field is what a call passes as `extra={"fields": {"TMDE_EVENT": "alert", ...}}`; read them with
`journalctl -u tmde-edge -o json` or `journalctl TMDE_EVENT=alert`.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import struct
import sys
from collections.abc import Mapping
from pathlib import Path

SOCKET = Path("/run/systemd/journal/socket")
_FIELD = re.compile(r"[A-Z][A-Z0-9_]{0,63}")


def priority(level: int) -> int:
    """syslog(3) priority of a logging level."""
    for least, number in ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6)):
        if level >= least:
            return number
    return 7


def datagram(fields: Mapping[str, str]) -> bytes:
    """systemd's native journal protocol: NAME=value lines; values with line breaks get their length in front."""
    out = bytearray()
    for name, value in fields.items():
        data = value.encode("utf-8", errors="surrogateescape")
        if b"\n" in data:
            out += name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"
        else:
            out += name.encode() + b"=" + data + b"\n"
    return bytes(out)


class JournalHandler(logging.Handler):
    """Sends records to the journal's socket; what it does not take goes to stderr with a level prefix."""

    def __init__(self, path: Path = SOCKET) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.settimeout(0.2)
        self._path = str(path)
        self._fallback = PrefixFormatter()

    def emit(self, record: logging.LogRecord) -> None:
        """One datagram a record; never raises."""
        try:
            fields = {
                "MESSAGE": self.format(record),
                "PRIORITY": str(priority(record.levelno)),
                "SYSLOG_IDENTIFIER": "tmde-edge",
                "TMDE_LOGGER": record.name,
                "TMDE_THREAD": record.threadName or "",
                **own_fields(record),
            }
            self._socket.sendto(datagram(fields), self._path)
        except OSError:  # the journal restarts, or the record is too large for a datagram
            print(self._fallback.format(record), file=sys.stderr, flush=True)
        except Exception:  # logging's own rule: a handler never brings the program down
            self.handleError(record)

    def close(self) -> None:
        """Closes the socket."""
        self._socket.close()
        super().close()


class PrefixFormatter(logging.Formatter):
    """"<4>text": systemd reads the level of a line on stderr from its prefix (sd-daemon(3))."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return "\n".join(f"<{priority(record.levelno)}>{line}" for line in text.splitlines() or [""])


def own_fields(record: logging.LogRecord) -> dict[str, str]:
    """The extra fields of a record that the journal will accept."""
    given = getattr(record, "fields", None)
    if not isinstance(given, Mapping):
        return {}
    return {name: str(value) for name, value in given.items() if _FIELD.fullmatch(name) and value is not None}


def under_journal(environment: Mapping[str, str], stderr_fd: int = 2) -> bool:
    """Whether stderr is connected to the journal: JOURNAL_STREAM names its device and inode (systemd.exec(5))."""
    wanted = environment.get("JOURNAL_STREAM", "")
    try:
        found = os.fstat(stderr_fd)
    except OSError:
        return False
    return wanted == f"{found.st_dev}:{found.st_ino}"


def set_up(environment: Mapping[str, str] = os.environ, path: Path = SOCKET) -> None:
    """Logging of the service: the journal with fields, else stderr (level prefixes under systemd)."""
    handler: logging.Handler
    journal = under_journal(environment)
    if journal and path.exists():
        handler = JournalHandler(path)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(PrefixFormatter() if journal else logging.Formatter("%(levelname)s %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
