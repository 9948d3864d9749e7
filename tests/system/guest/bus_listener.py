"""What candump saw on the bus, decoded by hand after config/tmde_edge.dbc: an outside view of the service."""

from __future__ import annotations

import subprocess
import threading
import time
from dataclasses import dataclass

ALERT, LEAD, STATUS = 0x6D0, 0x6D1, 0x6D2
LEVELS = ("none", "caution", "warning", "not available")
FAULTS = {16: "blind", 17: "can_lost", 18: "uncalibrated", 19: "overload", 20: "camera_lost", 21: "calibration", 22: "depth_lost",
          23: "detector_lost", 24: "can_tx", 25: "hot", 26: "disk", 31: "other"}  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """One frame on the bus."""

    t_s: float  # wall clock of the kernel
    can_id: int
    data: bytes

    def bits(self, start: int, length: int) -> int:
        """A little-endian field."""
        return int.from_bytes(self.data, "little") >> start & (1 << length) - 1

    @property
    def level(self) -> str:
        """Of ALERT."""
        return LEVELS[self.bits(12, 2)]

    @property
    def distance_m(self) -> float | None:
        """Of LEAD."""
        raw = self.bits(16, 15)
        return None if raw == 0x7FFF else raw * 0.01

    @property
    def rate_hz(self) -> float | None:
        """Of STATUS."""
        raw = self.bits(8, 8)
        return None if raw == 0xFF else raw * 0.5

    @property
    def faults(self) -> list[str]:
        """Of STATUS."""
        return [name for bit, name in FAULTS.items() if self.bits(bit, 1)]


class BusListener:
    """candump -L on a thread (-D: it outlives a bus that goes down); `since` gives what came after a moment."""

    def __init__(self, channel: str) -> None:
        self.frames: list[Seen] = []
        self._process = subprocess.Popen(
            ["candump", "-D", "-L", f"{channel},6D0:7FC"], stdout=subprocess.PIPE, text=True, bufsize=1
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            stamp, _, frame = line.split()[:3]
            can_id, data = frame.split("#")
            self.frames.append(Seen(float(stamp.strip("()")), int(can_id, 16), bytes.fromhex(data)))

    def since(self, t_s: float, can_id: int | None = None) -> list[Seen]:
        """Frames from a moment on, in order."""
        return [f for f in list(self.frames) if f.t_s >= t_s and (can_id is None or f.can_id == can_id)]

    def collect(self, seconds: float, can_id: int | None = None) -> list[Seen]:
        """Frames of the next seconds."""
        t_s = time.time()
        time.sleep(seconds)
        return [f for f in self.since(t_s, can_id) if f.t_s < t_s + seconds]

    def close(self) -> None:
        """Stops candump."""
        self._process.terminate()
        self._process.wait()
