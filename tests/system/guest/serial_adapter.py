"""An slcan adapter on a pseudo-terminal: the kernel makes a real CAN interface of it, which systemd-networkd sets up."""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import subprocess
import termios
import threading
import tty

N_SLCAN = 17
SIOCGIFNAME = 0x8910


class SerialAdapter:
    """`heard`: what the kernel told the adapter: S6 (500 kbit/s), L (open, listen only), O (open), C (close), t... (frames)."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.heard: list[str] = []
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        fcntl.ioctl(self._slave, termios.TIOCSETD, struct.pack("i", N_SLCAN))
        made = fcntl.ioctl(self._slave, SIOCGIFNAME, bytes(16)).rstrip(b"\0").decode()
        threading.Thread(target=self._read, daemon=True).start()
        subprocess.run(["ip", "link", "set", made, "name", name], check=True)

    def _read(self) -> None:
        pending = b""
        with contextlib.suppress(OSError):
            while True:
                *lines, pending = (pending + os.read(self._master, 4096)).split(b"\r")
                for line in lines:
                    self.heard.append(line.decode("ascii", "replace"))

    def receive(self, can_id: int, data: bytes) -> None:
        """A frame from the wire."""
        os.write(self._master, f"t{can_id:03X}{len(data)}{data.hex().upper()}\r".encode())

    def close(self) -> None:
        """Pulls it out."""
        os.close(self._slave)
        os.close(self._master)
