"""What the board says about itself: temperature, throttling, memory, disk. Reads /sys and /proc below a root folder."""

from __future__ import annotations

import ctypes
import logging
import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

_log = logging.getLogger(__name__)
_M_ARENA_MAX = -8  # of mallopt(3), malloc.h
_PERIOD_S = 2.0
_TOOL_S = 3.0
_TRIM_S = 10.0  # pictures of many sizes come and go: what lies free between them would only grow
# Zones of the processor come first; a battery or a radio module says little about us.
_CPU_ZONES = ("cpu", "soc", "x86_pkg", "gpu", "tj", "bigcore", "littlecore")
_PLAUSIBLE_C = (-40.0, 150.0)
_THROTTLE_BITS = {  # of get_throttled (Raspberry Pi documentation, "vcgencmd"); bits 16 up: has happened since boot
    0: "under-voltage", 1: "frequency capped", 2: "throttled", 3: "soft temperature limit",
    16: "under-voltage since boot", 17: "frequency capped since boot", 18: "throttled since boot",
    19: "soft temperature limit since boot",
}  # fmt: skip

Run = Callable[[Sequence[str]], str | None]  # a command's output; None: not there or it failed


@dataclass(frozen=True, slots=True)
class BoardState:
    """One look at the board."""

    temperature_c: float | None = None
    throttled: tuple[str, ...] = ()  # in force now, as named above
    throttled_before: tuple[str, ...] = ()  # since boot


def run_tool(command: Sequence[str]) -> str | None:
    """The output of a small program; None where it is missing, fails or hangs."""
    if shutil.which(command[0]) is None:
        return None
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TOOL_S, check=False)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout if done.returncode == 0 else None


def read_text(path: Path) -> str | None:
    """A small file's text without surrounding space; None where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None


def temperatures_c(root: Path = Path("/")) -> dict[str, float]:
    """Every thermal zone by name, plausible ones only (Jetson's off-line zones say -256)."""
    found: dict[str, float] = {}
    for zone in sorted((root / "sys/class/thermal").glob("thermal_zone*")):
        text = read_text(zone / "temp")
        if text is None or not re.fullmatch(r"-?\d+", text):
            continue
        value_c = int(text) / 1000
        if _PLAUSIBLE_C[0] <= value_c <= _PLAUSIBLE_C[1]:
            found[read_text(zone / "type") or zone.name] = value_c
    return found


def processor_c(root: Path = Path("/")) -> float | None:
    """The hottest zone of the processor; of any zone where none is named so; None where the board tells nothing."""
    zones = temperatures_c(root)
    ours = [v for name, v in zones.items() if any(k in name.lower() for k in _CPU_ZONES)]
    return max(ours or zones.values(), default=None)


def throttle_flags(root: Path = Path("/"), run: Run | None = run_tool) -> int | None:
    """Raspberry Pi's get_throttled word: from the kernel, or from vcgencmd (`run` None: not asked)."""
    for path in sorted((root / "sys/devices/platform/soc").glob("*firmware/get_throttled")):
        text = read_text(path)
        if text is not None and re.fullmatch(r"[0-9a-fA-F]+", text):
            return int(text, 16)
    text = run(("vcgencmd", "get_throttled")) if run is not None else None
    match = re.search(r"throttled=0x([0-9a-fA-F]+)", text or "")
    return int(match[1], 16) if match is not None else None


def throttle_words(flags: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The word in words: what holds now, and what has happened since boot."""
    words = {bit: text for bit, text in _THROTTLE_BITS.items() if flags >> bit & 1}
    return tuple(t for b, t in words.items() if b < 16), tuple(t for b, t in words.items() if b >= 16)


def look(root: Path = Path("/"), run: Run | None = None) -> BoardState:
    """Temperature and throttling now."""
    flags = throttle_flags(root, run)
    now, before = throttle_words(flags) if flags is not None else ((), ())
    return BoardState(processor_c(root), now, before)


def memory_mb(root: Path = Path("/"), pid: int | str = "self") -> float | None:
    """Resident memory of a process."""
    text = read_text(root / f"proc/{pid}/status") or ""
    match = re.search(r"^VmRSS:\s+(\d+) kB", text, re.MULTILINE)
    return int(match[1]) / 1024 if match is not None else None


def one_heap() -> bool:
    """All threads take memory from one heap of the C library instead of one each; False where it cannot be told (only glibc can).

    A picture is taken by one thread and freed by another: heaps of their own would each keep room for it. To be called before
    the threads start.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and bool(mallopt(_M_ARENA_MAX, 1))


def trim_memory() -> bool:
    """Gives free pages inside the C library's heap back to the system; False where it has no such call (only glibc has)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return trim is not None and bool(trim(ctypes.c_size_t(0)))


class BoardWatch:
    """Looks at the board every two seconds on a thread of its own: a sensor that hangs delays nobody."""

    def __init__(self, root: Path = Path("/"), period_s: float = _PERIOD_S) -> None:
        self._root, self._period_s = root, period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="board", daemon=True)
        self.state = look(root)

    def start(self) -> None:
        """Begins to look again and again."""
        self._thread.start()

    def close(self) -> None:
        """Ends it; does not wait for a sensor that hangs."""
        self._stop.set()

    def _watch(self) -> None:
        trimmed_s = time.monotonic()
        while not self._stop.wait(self._period_s):
            try:
                self.state = look(self._root)
                if time.monotonic() - trimmed_s > _TRIM_S:
                    trim_memory()
                    trimmed_s = time.monotonic()
            except Exception as error:  # a thread's top; without a temperature everything else goes on
                _log.warning("the board's sensors cannot be read any more: %s", error)
                self.state = BoardState()
                return


def limit_processor(cores: Sequence[int]) -> str | None:
    """Binds this process to cores; a sentence where that failed."""
    try:
        os.sched_setaffinity(0, cores)
    except (OSError, ValueError) as error:
        return f"runtime.cpu_affinity = {list(cores)}: not possible ({error}); this board has {os.cpu_count()} cores"
    return None


def raise_priority(priority: int) -> str | None:
    """Real-time priority (SCHED_RR) of the calling thread alone; a sentence where that failed."""
    try:  # threads that it starts would inherit it
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        return (
            f"runtime.realtime_priority = {priority}: not allowed ({getattr(error, 'strerror', None) or error}); "
            "install systemd/tmde-edge.service.d/realtime.conf.example as a drop-in"
        )
    return None
