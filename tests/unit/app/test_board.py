"""What the board says about itself, read from made-up /sys and /proc trees."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from tmde_edge.app import board


def put(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_the_processors_hottest_zone_counts_and_dead_sensors_do_not(tmp_path: Path) -> None:
    for i, (kind, milli) in enumerate([("cpu-thermal", "61234\n"), ("gpu-thermal", "63500\n"), ("battery", "90000\n"),
                                       ("soc2-thermal", "-256000\n"), ("iwlwifi", "")]):  # fmt: skip
        put(tmp_path, f"sys/class/thermal/thermal_zone{i}/type", kind + "\n")
        put(tmp_path, f"sys/class/thermal/thermal_zone{i}/temp", milli)
    assert board.processor_c(tmp_path) == pytest.approx(63.5)
    assert set(board.temperatures_c(tmp_path)) == {"cpu-thermal", "gpu-thermal", "battery"}
    assert board.processor_c(tmp_path / "nothing") is None


def test_throttling_from_the_kernel_or_from_vcgencmd(tmp_path: Path) -> None:
    assert board.look(tmp_path).throttled == ()
    asked: list[object] = []

    def run(command: object) -> str:
        asked.append(command)
        return "throttled=0x50005\n"

    state = board.look(tmp_path, run)
    assert asked == [("vcgencmd", "get_throttled")]
    assert state.throttled == ("under-voltage", "throttled")
    assert state.throttled_before == ("under-voltage since boot", "throttled since boot")
    put(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "0\n")
    assert board.throttle_flags(tmp_path, run) == 0
    assert len(asked) == 1


def test_resident_memory_of_this_process() -> None:
    mine = board.memory_mb()
    assert mine is not None
    assert 5 < mine < 5000
    assert board.memory_mb(pid=2**22 + 1) is None


def test_a_tool_that_is_missing_or_fails_gives_nothing() -> None:
    assert board.run_tool(["no-such-tool-here"]) is None
    assert board.run_tool(["false"]) is None
    assert board.run_tool(["echo", "yes"]) == "yes\n"


def test_cores_that_are_not_there_are_a_sentence() -> None:
    before = os.sched_getaffinity(0)
    try:
        assert "cpu_affinity" in str(board.limit_processor([4000]))
        assert board.limit_processor(sorted(before)) is None
    finally:
        os.sched_setaffinity(0, before)


def test_free_memory_between_living_blocks_goes_back_to_the_system() -> None:
    def resident() -> float:
        found = board.memory_mb()
        assert found is not None
        return found

    blocks = [bytearray(100_000) for _ in range(2000)]  # too small to be mapped one by one
    last = bytearray(100_000)  # at the heap's top: nothing below it is given back by itself
    full = resident()
    blocks.clear()
    board.trim_memory()
    assert resident() < full - 100
    assert len(last) == 100_000


_THREADS_TAKE_MEMORY = """
import sys, threading
from pathlib import Path
from tmde_edge.app.board import one_heap
if sys.argv[1] == "one" and not one_heap():
    sys.exit("no mallopt")
taken, gate = [], threading.Barrier(9)
def take():
    taken.extend(bytearray(50_000) for _ in range(20))
    gate.wait()
for _ in range(8):
    threading.Thread(target=take).start()
gate.wait()
spans = (line.split()[0].split("-") for line in Path("/proc/self/maps").read_text().splitlines() if " ---p " in line)
print(sum(int(b, 16) - int(a, 16) > 32 << 20 for a, b in spans))  # what each further heap keeps reserved
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no heaps for threads")
def test_threads_share_one_heap() -> None:
    def heaps(how: str) -> int:
        command = [sys.executable, "-c", _THREADS_TAKE_MEMORY, how]
        return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    assert heaps("one") < heaps("many")


def in_a_thread(work: Callable[[], object]) -> None:
    thread = threading.Thread(target=work)  # priorities are a thread's own: later tests must not run with them
    thread.start()
    thread.join()


def test_real_time_priority_is_of_one_thread_alone() -> None:
    policies: list[int | str] = []

    def decide() -> None:
        failed = board.raise_priority(1)
        if failed is not None:
            policies.append(failed)
            return
        policies.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
        in_a_thread(lambda: policies.append(os.sched_getscheduler(0)))

    in_a_thread(decide)
    if len(policies) == 1:
        pytest.skip(str(policies[0]))
    assert policies == [os.SCHED_RR, os.SCHED_OTHER]


def test_real_time_priority_is_not_handed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "SCHED_RR", os.SCHED_BATCH)  # asks for no privilege; the flag is the same
    flags: list[int] = []

    def decide() -> None:
        assert board.raise_priority(0) is None
        flags.append(os.sched_getscheduler(0))

    in_a_thread(decide)
    assert flags == [os.SCHED_BATCH | os.SCHED_RESET_ON_FORK]


def test_the_watch_looks_again(tmp_path: Path) -> None:
    put(tmp_path, "sys/class/thermal/thermal_zone0/temp", "40000")
    watch = board.BoardWatch(tmp_path, period_s=0.01)
    assert watch.state.temperature_c == 40.0
    watch.start()
    put(tmp_path, "sys/class/thermal/thermal_zone0/temp", "50000")
    deadline = 200
    while watch.state.temperature_c != 50.0 and deadline:
        watch._stop.wait(0.01)
        deadline -= 1
    watch.close()
    assert watch.state.temperature_c == 50.0
