"""Soak: the service for N minutes at 30 frames a second on a rendered drive, a serial CAN bus with traffic both ways.

    python tests/benchmarks/soak.py --minutes 30                      renders its own drive first (about a minute)
    python tests/benchmarks/soak.py --minutes 30 --drive FOLDER       a folder of `tmde-edge simulate`
    python tests/benchmarks/soak.py --minutes 30 --width 640          a smaller picture, for a machine that is busy

Prints one JSON object: memory after the first minute and its growth, dropped frames, the watchdog's longest silence, start
to first decision, CPU, and what an idle service takes. Exit 1 where a bar is missed (growth 5 MB, dropped 1 %, watchdog 10 s,
first decision 6 s).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from pathlib import Path
from statistics import mean
from typing import Any

import cv2
import numpy as np

from tmde_edge.adapters.cameras.sources import open_source
from tmde_edge.adapters.can_ports.log_files import iter_can_log
from tmde_edge.adapters.video_out import VideoWriter
from tmde_edge.app.status import ask
from tmde_edge.errors import TmdeError
from tmde_edge.messages import Frame

WATCHDOG_S = 10.0
GROWTH_MB, DROPPED, FIRST_S = 5.0, 0.01, 6.0


class SerialBus:
    """The far end of an slcan adapter: swallows what the service sends, sends the drive's own frames again and again."""

    def __init__(self, log: Path | None) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.received = self.sent = 0
        self._stop = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()
        if log is not None:
            threading.Thread(target=self._write, args=(log,), daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self.received += os.read(self._master, 4096).count(b"\r")

    def _write(self, log: Path) -> None:
        frames = list(iter_can_log(log))
        with contextlib.suppress(OSError):
            while not self._stop.is_set():
                start, first = time.monotonic(), frames[0].t_ns
                for frame in frames:
                    wait = start + (frame.t_ns - first) * 1e-9 - time.monotonic()
                    if wait > 0 and self._stop.wait(wait):
                        return
                    line = f"t{frame.can_id:03X}{len(frame.data)}{frame.data.hex().upper()}\r"
                    os.write(self._master, line.encode())
                    self.sent += 1

    def close(self) -> None:
        self._stop.set()


class Watched:
    """A service process with systemd's socket and the status socket."""

    def __init__(self, folder: Path, settings: dict[str, str], config: Path | None = None) -> None:
        folder.mkdir(exist_ok=True)
        self._notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._notify.bind(str(folder / "notify"))
        self.ready_s: float | None = None
        self.fed: list[float] = []
        threading.Thread(target=self._listen, daemon=True).start()
        self.socket = folder / "status.sock"
        settings = {**settings, "runtime.status_socket": str(self.socket), "publish.socket": '""'}
        arguments = [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
        where = ["-c", str(config)] if config is not None else []
        environment = {
            **os.environ, "NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6)),
            "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
        }  # fmt: skip
        self.log = folder / "stderr.txt"
        self.started_s = time.monotonic()
        with self.log.open("w") as stderr:
            command = [sys.executable, "-m", "tmde_edge.cli", "run", *where, *arguments]
            self.process = subprocess.Popen(command, env=environment, stderr=stderr)

    def _listen(self) -> None:
        while True:
            text = self._notify.recv(4096).decode()
            if text == "READY=1":
                self.ready_s = time.monotonic() - self.started_s
            elif text == "WATCHDOG=1":
                self.fed.append(time.monotonic())

    def status(self) -> dict[str, Any] | None:
        try:
            return ask(self.socket, {"request": "status"}, timeout_s=3.0)
        except TmdeError:
            return None

    def cpu_s(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def memory_mb(self) -> float:
        text = Path(f"/proc/{self.process.pid}/status").read_text()
        return next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmRSS")) / 1024

    def stop(self) -> float:
        start = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(30)
        return time.monotonic() - start


def idle(folder: Path, seconds: float) -> dict[str, float]:
    """What a service without camera and bus takes."""
    service = Watched(folder, {"camera.kind": "disabled", "can.enabled": "false", "depth.kind": "none", "record.shadow": "false"})
    time.sleep(5)
    before = service.cpu_s()
    time.sleep(seconds)
    found = {"idle_cpu": round((service.cpu_s() - before) / seconds, 4), "idle_memory_mb": round(service.memory_mb(), 1)}
    service.stop()
    return found


def soak(folder: Path, drive: Path, minutes: float, more: list[str]) -> dict[str, Any]:
    """Runs it and measures; see the module."""
    bus = SerialBus(drive / "can.log" if (drive / "can.log").exists() else None)
    settings = {
        "camera.kind": "video_file", "camera.device": str(drive / "video.mp4"), "camera.loop": "true", "can.enabled": "true",
        "can.interface": "slcan", "can.channel": bus.path, "can.transmit": "true", "runtime.threads": "1", "depth.kind": "none",
        "record.enabled": "true", "record.incidents": "true", "record.folder": str(folder / "drives"), "record.max_mb": "200",
        "record.incidents_max_mb": "200", **dict(m.split("=", 1) for m in more),
    }  # fmt: skip
    service = Watched(folder / "run", settings, drive / "config.toml")
    first_s = None
    while first_s is None and time.monotonic() - service.started_s < 120:
        status = service.status()
        if status is not None and status["frames"]["decided"] > 0:
            first_s = time.monotonic() - service.started_s
        time.sleep(0.05)
    memory: list[tuple[float, float]] = []
    load: list[float] = []
    cpu = service.cpu_s()
    start = time.monotonic()
    last: dict[str, Any] = {}
    faults: dict[str, int] = {}
    while time.monotonic() - start < 60 * minutes and service.process.poll() is None:
        time.sleep(1.0)
        memory.append((time.monotonic() - start, service.memory_mb()))
        load.append(os.getloadavg()[0])
        if (status := service.status()) is not None:
            last = status
            for fault in status["faults"]:
                faults[fault] = faults.get(fault, 0) + 1
    seconds = time.monotonic() - start
    cpu = (service.cpu_s() - cpu) / seconds
    died = service.process.poll()
    stop_s = service.stop() if died is None else None
    bus.close()
    after_one = [m for t, m in memory if 60 <= t < 90] or [m for _, m in memory]
    end = [m for t, m in memory if t >= seconds - 30]
    frames, camera = last["frames"], last["camera"]
    dropped = frames["skipped"] + camera["lost"] + frames["shed"]
    fed = service.fed
    gaps = [b - a for a, b in zip(fed, fed[1:])]  # noqa: B905, RUF007
    return {
        "minutes": round(seconds / 60, 2), "died": died, "ready_s": service.ready_s and round(service.ready_s, 2),
        "first_decision_s": first_s and round(first_s, 2), "stop_s": stop_s and round(stop_s, 2),
        "memory_after_first_minute_mb": round(mean(after_one), 1), "memory_end_mb": round(mean(end), 1),
        "growth_mb": round(mean(end) - mean(after_one), 2),
        "memory_max_mb": round(max(m for _, m in memory), 1),
        "memory_each_5_min_mb": [
            round(mean(m for t, m in memory if t // 300 == i), 1) for i in sorted({t // 300 for t, _ in memory})
        ],
        "decided": frames["decided"], "skipped": frames["skipped"], "lost": camera["lost"], "shed": frames["shed"],
        "dropped": round(dropped / max(dropped + frames["decided"], 1), 5), "rate_hz": frames["rate_hz"],
        "latency_p50_ms": frames["latency_p50_ms"], "latency_p99_ms": frames["latency_p99_ms"],
        "watchdog_longest_s": round(max(gaps, default=float("inf")), 2), "watchdog_missed": sum(g > WATCHDOG_S for g in gaps),
        "can_received": last["can"]["received"], "can_sent": last["can"]["sent"], "seconds_with_fault": faults,
        "cpu": round(cpu, 3), "machine_load": round(mean(load), 1), "cores": os.cpu_count(), "record": last["record"],
    }  # fmt: skip


def resized(drive: Path, folder: Path, width_px: int) -> Path:
    """The same drive with a smaller picture; the calibration scales with it."""
    folder.mkdir()
    for name in ("can.log", "config.toml"):
        (folder / name).write_bytes((drive / name).read_bytes())
    with VideoWriter(folder / "video.mp4", 30) as video:
        for frame in open_source(str(drive / "video.mp4")):
            if isinstance(frame, Frame):
                size = width_px, round(frame.image.shape[0] * width_px / frame.image.shape[1])
                video.write(np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8), frame.t_ns)
    return folder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--drive", type=Path, help="folder of `tmde-edge simulate`; default: renders `approach`")
    parser.add_argument("--width", type=int, metavar="PIXELS", help="of the picture; default: as the drive has it")
    parser.add_argument("--set", action="append", default=[], help="configuration of the service, table.key=value")
    parser.add_argument("--out", type=Path, help="also write the JSON there")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tmde-soak-") as scratch:
        folder = Path(scratch)
        drive = args.drive
        if drive is None:
            drive = folder / "drive"
            command = [sys.executable, "-m", "tmde_edge.cli", "simulate", "approach", "--out", str(drive), "-q"]
            subprocess.run(command, check=True)
        drive = resized(drive, folder / "small", args.width) if args.width else drive
        found = soak(folder, drive.resolve(), args.minutes, args.set) | idle(folder / "idle", 20)
    missed = [
        name
        for name, bad in (
            ("died", found["died"] is not None), ("growth", found["growth_mb"] > GROWTH_MB),
            ("dropped", found["dropped"] > DROPPED), ("watchdog", found["watchdog_missed"] > 0),
            ("first decision", not (found["first_decision_s"] or 1e9) <= FIRST_S),
        )
        if bad
    ]  # fmt: skip
    found["missed"] = missed
    print(json.dumps(found, indent=1))
    if args.out is not None:
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
