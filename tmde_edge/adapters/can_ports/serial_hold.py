"""A serial adapter serves one program: a second one that opens it closes the first one's channel, and nobody is told."""

from __future__ import annotations

import errno
import fcntl
import os
import stat


def hold_serial(channel: str) -> int | None:
    """Holds the serial port of an slcan channel; os.close() what comes back. None: no device file (python-can says it).

    Raises OSError where another program holds it (a lock as pyserial's `exclusive` sets it).
    """
    path = channel.split("@")[0]  # python-can: port@rate
    try:
        if not stat.S_ISCHR(os.stat(path).st_mode):
            return None
    except FileNotFoundError:
        return None
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(fd)
        raise OSError(errno.EBUSY, "another program holds it") from None
    return fd
