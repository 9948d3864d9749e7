"""Faults on purpose: each kind N times at random moments, while the service runs; is it healthy again, is it told, is a log lost?

    python tests/benchmarks/faults.py --times 20               all kinds (about half an hour)
    python tests/benchmarks/faults.py --times 3 --only camera_gone --only disk_full

The service is the real one (app/service.py) in a process of its own; only its camera, its depth network and its wall clock
can be broken on command. CAN is a serial adapter on a pseudo-terminal. `disk_full` needs root (a small file system in a mount
namespace). Prints a line a kind and one JSON object. Exit 1 where, 10 s after a fault ended, the service was neither healthy nor
told what is wrong, where a lasting fault was not told within 10 s, or where something recorded more than a second before a fault
is missing. On a busy machine "overload" is true.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tty
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.adapters.cameras.played_file import PlayedFile
from tmde_edge.adapters.video_out import VideoWriter
from tmde_edge.app.drive_log import DriveLogReader
from tmde_edge.app.ring import segments
from tmde_edge.app.status import ask
from tmde_edge.errors import DeviceError, TmdeError
from tmde_edge.messages import DepthReading, Frame, Tick

LIMIT_S = 10.0
LOST_S = 1.0  # what a power cut may take; older than this must be there
ID_SPEED = 0xB4


# -- the broken service --------------------------------------------------------------------------------------------------


class BreakableCamera:
    """A played file that can be gone, frozen or garbled."""

    name = "breakable camera"
    ended = False

    def __init__(self, path: str) -> None:
        self._file = PlayedFile(path, loop=True)
        self.state = "ok"
        self._last: Captured | None = None
        self._count = 0

    def open(self) -> None:
        if self.state == "gone":
            raise DeviceError("no such camera")
        self._file.open()

    def read(self, timeout_s: float) -> Captured | None:
        if self.state == "gone":
            raise DeviceError("is gone")
        captured = self._file.read(timeout_s)
        if captured is None:
            return None
        self._count += 1
        if self.state == "frozen" and self._last is not None:
            return Captured(
                t_ns=captured.t_ns, index=self._count, decode=self._last.decode, fingerprint=self._last.fingerprint
            )
        if self.state == "garbage":
            return Captured(t_ns=captured.t_ns, index=self._count, decode=lambda: None, fingerprint=self._count)
        image = captured.decode()
        mark = zlib.crc32(image.tobytes()) if image is not None else None
        self._last = Captured(t_ns=captured.t_ns, index=self._count, decode=lambda: image, fingerprint=mark)
        return self._last

    def close(self) -> None:
        self._file.close()


class BreakableDepth:
    """A network that gives the same depth everywhere, until it crashes."""

    broken = False

    def infer(self, frame: Frame, ready_t_ns: int | None = None) -> DepthReading:
        if self.broken:
            raise RuntimeError("the network crashed, on purpose")
        h, w = frame.image.shape[:2]
        return DepthReading(
            t_ns=frame.t_ns, ready_t_ns=frame.t_ns, width_px=w, height_px=h, grid_columns=8, grid_rows=6,
            inverse_depth=tuple(1.0 + 0.1 * (i // 8) for i in range(48)), model="made up",
        )  # fmt: skip


def child(folder: Path, settings: list[str]) -> int:
    """The service; takes commands from stdin."""
    from tmde_edge.app.service import serve
    from tmde_edge.config import load

    camera, depth = BreakableCamera(str(folder / "video.mp4")), BreakableDepth()
    offset_s = 0.0
    real_time, real_time_ns = time.time, time.time_ns
    time.time = lambda: real_time() + offset_s
    time.time_ns = lambda: real_time_ns() + round(offset_s * 1e9)
    held: list[int] = []

    def obey() -> None:
        nonlocal offset_s
        for line in sys.stdin:
            kind, _, value = line.strip().partition(" ")
            if kind == "camera":
                camera.state = value
            elif kind == "depth":
                BreakableDepth.broken = value == "crash"
            elif kind == "clock":
                offset_s = float(value)
            elif kind == "hold":
                with contextlib.suppress(OSError):
                    while True:
                        held.append(os.open(os.devnull, os.O_RDONLY))
            elif kind == "release":
                while held:
                    os.close(held.pop())
            elif kind == "fill":
                with contextlib.suppress(OSError), (folder / "disk" / "filler").open("wb", buffering=0) as f:
                    while True:
                        f.write(bytes(65536))
            elif kind == "empty":
                (folder / "disk" / "filler").unlink(missing_ok=True)

    threading.Thread(target=obey, daemon=True).start()
    import resource

    resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))
    config = load(None, settings)
    return serve(config, folder, lambda text: None, camera=camera, depth_network_of=lambda _: depth)


# -- the one who breaks it -----------------------------------------------------------------------------------------------


class Bus:
    """A serial adapter that can be unplugged; speed frames arrive while it is there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = self._slave = -1
        self.lock = threading.Lock()
        self.plug()
        threading.Thread(target=self._traffic, daemon=True).start()

    def plug(self) -> None:
        with self.lock:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self.path.unlink(missing_ok=True)
            self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        with self.lock:
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1
            self.path.unlink(missing_ok=True)

    def write(self, data: bytes) -> None:
        with self.lock, contextlib.suppress(OSError):
            if self._master >= 0:
                os.write(self._master, data)
                with contextlib.suppress(BlockingIOError):
                    os.read(self._master, 65536)

    def _traffic(self) -> None:
        while True:
            self.write(f"t{ID_SPEED:03X}80000000000000BB8\r".encode())
            time.sleep(0.02)


class Service:
    """The process, its status, and its bus."""

    def __init__(self, folder: Path, root: bool) -> None:
        self.folder = folder
        self.bus = Bus(folder / "tty")
        self.socket = folder / "status.sock"
        (folder / "disk").mkdir()
        speed = '{id=180, start_bit=47, length=16, byte_order="big", scale=0.01, unit="km/h"}'
        settings = [
            "camera.kind=disabled", "camera.fx_px=400", "camera.width_px=320", "camera.height_px=180", "can.interface=slcan",
            f"can.channel={self.bus.path}", "can.transmit=true", f"can.vehicle.speed={speed}", "depth.kind=onnx",
            "runtime.threads=1", f"runtime.status_socket={self.socket}", 'publish.socket=""', "record.enabled=true",
            f"record.folder={folder / 'disk' / 'drives'}", "record.min_free_mb=0", "record.segment_s=20", "runtime.shed=false",
        ]  # fmt: skip
        inside = [sys.executable, __file__, "--child", str(folder), *settings]
        if root:
            mount = f"mount -t tmpfs -o size=400m tmpfs {folder / 'disk'} && exec \"$@\""
            inside = ["unshare", "-m", "--propagation", "private", "sh", "-c", mount, "sh", *inside]
        self.stderr = (folder / "stderr.txt").open("w")
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(inside, stdin=subprocess.PIPE, stderr=self.stderr, text=True, env=environment)
        self.normal: set[str] = set()

    def tell(self, command: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()

    def status(self) -> dict[str, Any] | None:
        try:
            return ask(self.socket, {"request": "status"}, timeout_s=1.0)
        except TmdeError:
            return None

    def healthy(self, status: dict[str, Any] | None) -> bool:
        """Frames are decided on, CAN goes both ways, and nothing is wrong that is not always so."""
        if status is None or set(status["faults"]) - self.normal:
            return False
        age_s = status["frames"]["age_s"]
        return age_s is not None and age_s < 1.0 and bool(status["can"]["connected"]) and status["depth"]["state"] == "works"

    def wait_healthy(self, limit_s: float) -> float | None:
        start = time.monotonic()
        while time.monotonic() - start < limit_s:
            if self.process.poll() is not None:
                return None
            if self.healthy(self.status()):
                return time.monotonic() - start
            time.sleep(0.05)
        return None

    def log_folder(self) -> Path:
        """Where the parent sees the recordings of the child's own file system."""
        return Path(f"/proc/{self.process.pid}/root{self.folder}/disk/drives")


def kinds(service: Service, chance: random.Random) -> dict[str, tuple[Callable[[], None], Callable[[], None], set[str]]]:
    """Name: (begin, end, one of these faults must be told while it lasts; empty: it may pass unnoticed)."""
    tell, bus = service.tell, service.bus
    flooding = threading.Event()

    def noise() -> None:
        for _ in range(30):
            bus.write(bytes(chance.randrange(256) for _ in range(64)))
            time.sleep(0.01)

    def flood() -> None:
        flooding.set()

        def run() -> None:
            line = f"t{ID_SPEED:03X}80000000000000BB8\r".encode() * 50
            while flooding.is_set():
                bus.write(line)
                time.sleep(0.01)

        threading.Thread(target=run, daemon=True).start()

    return {
        "camera_gone": (lambda: tell("camera gone"), lambda: tell("camera ok"), {"camera_lost", "blind"}),
        "camera_frozen": (lambda: tell("camera frozen"), lambda: tell("camera ok"), {"camera_frozen", "camera_lost", "blind"}),
        "camera_garbage": (lambda: tell("camera garbage"), lambda: tell("camera ok"), {"camera_garbled", "camera_lost", "blind"}),
        "can_down": (bus.unplug, bus.plug, {"can_tx", "can_lost"}),
        "can_garbage": (noise, lambda: None, set()),
        "can_flood": (flood, flooding.clear, set()),
        "disk_full": (lambda: tell("fill"), lambda: tell("empty"), {"disk"}),
        "clock_jump": (lambda: tell(f"clock {chance.choice((-3600, 3600))}"), lambda: tell("clock 0"), set()),
        "depth_crash": (lambda: tell("depth crash"), lambda: tell("depth ok"), {"depth_lost"}),
        "sigstop": (
            lambda: service.process.send_signal(signal.SIGSTOP), lambda: service.process.send_signal(signal.SIGCONT), set(),
        ),
        "descriptors": (lambda: tell("hold"), lambda: tell("release"), set()),
    }  # fmt: skip


def one(service: Service, name: str, parts: Any, chance: random.Random) -> dict[str, Any]:
    """One fault at a random moment."""
    begin, end, expected = parts
    time.sleep(chance.uniform(2.0, 3.0))  # a stretch of recording before it
    at_ns = time.monotonic_ns()
    begin()
    start, told_s, told = time.monotonic(), None, set()
    lasts_s = chance.uniform(2.0, 4.0)
    while time.monotonic() - start < (lasts_s if told_s is not None or not expected else LIMIT_S):
        status = service.status() if name != "sigstop" else None
        if status is not None:
            told |= set(status["faults"]) - service.normal
            if told_s is None and told & expected:
                told_s = time.monotonic() - start
        time.sleep(0.05)
    end()
    healthy_s, left = service.wait_healthy(LIMIT_S), []
    if healthy_s is None:  # then it must at least say so
        left = sorted(set((service.status() or {}).get("faults", [])) - service.normal)
        more_s = service.wait_healthy(60.0)
        healthy_s = None if more_s is None else LIMIT_S + more_s
    return {
        "at_ns": at_ns, "told_s": told_s, "told": sorted(told), "healthy_s": healthy_s, "expected": bool(expected), "left": left
    }  # fmt: skip


def missing_before(log: Path, at_ns: list[int]) -> list[int]:
    """Faults before which a stretch of ticks is not on the disk."""
    since_s = time.time() - (time.monotonic_ns() - min(at_ns, default=0)) * 1e-9 - 5.0
    recent = [s for s in segments(log) if s.path.stat().st_mtime >= since_s]
    ticks = [e.event.t_ns for s in recent for e in DriveLogReader(s.path).entries() if isinstance(e.event, Tick)]
    found = np.sort(np.array(ticks, np.int64))
    lost = []
    for t_ns in at_ns:
        a, b = np.searchsorted(found, [t_ns - 2_000_000_000, t_ns - round(LOST_S * 1e9)])
        if b - a < 12:  # 20 a second
            lost.append(t_ns)
    return lost


def make_video(path: Path) -> None:
    """Half a minute of moving texture, 320 x 180 at 15 Hz."""
    noise = cv2.resize(np.random.default_rng(1).integers(0, 255, (45, 80, 3), np.uint8), (320, 180))
    with VideoWriter(path, 15) as video:
        for i in range(450):
            video.write(np.asarray(np.roll(noise, 3 * i, axis=1), np.uint8), i * 1_000_000_000 // 15)


def main() -> int:
    if sys.argv[1:2] == ["--child"]:
        return child(Path(sys.argv[2]), sys.argv[3:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--only", action="append", help="this kind only; repeatable")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="also write the JSON there")
    args = parser.parse_args()
    chance = random.Random(args.seed)
    root = os.geteuid() == 0
    found: dict[str, Any] = {}
    bad = 0
    with tempfile.TemporaryDirectory(prefix="tmde-faults-") as scratch:
        folder = Path(scratch)
        make_video(folder / "video.mp4")
        service = Service(folder, root)
        try:
            if service.wait_healthy(60.0) is None:
                print((folder / "stderr.txt").read_text()[-3000:], service.status(), file=sys.stderr)
                sys.exit("the service did not become healthy")
            table = kinds(service, chance)
            names = [n for n in table if (not args.only or n in args.only) and (root or n != "disk_full")]
            tries = [n for n in names for _ in range(args.times)]
            chance.shuffle(tries)
            results: dict[str, list[dict[str, Any]]] = {n: [] for n in names}
            lost: dict[str, int] = dict.fromkeys(names, 0)
            gone: set[int] = set()
            moments: list[int] = []
            for i, name in enumerate(tries):
                result = one(service, name, table[name], chance)
                results[name].append(result)
                moments.append(result["at_ns"])
                if i % 10 == 9 or i == len(tries) - 1:
                    gone |= set(missing_before(service.log_folder(), moments))
                    moments = []
                    lost = {n: sum(r["at_ns"] in gone for r in rs) for n, rs in results.items()}
                note = f"told {result['told_s']}, healthy {result['healthy_s']} {' '.join(result['left'])}"
                print(f"{i + 1}/{len(tries)} {name}: {note}", file=sys.stderr, flush=True)
                if service.process.poll() is not None:
                    print((folder / "stderr.txt").read_text()[-3000:], file=sys.stderr)
                    print(f"the service died ({service.process.returncode}) of {name}")
                    return 1
            for name, rs in results.items():
                late = [r for r in rs if r["healthy_s"] is None or r["healthy_s"] > LIMIT_S]
                mute = [r for r in late if not r["left"]]
                silent = [r for r in rs if r["expected"] and r["told_s"] is None]
                told = [r["told_s"] for r in rs if r["told_s"] is not None]
                worst = max((r["healthy_s"] if r["healthy_s"] is not None else 99.0 for r in rs), default=0.0)
                found[name] = {
                    "times": len(rs), "not_healthy_within_10_s": len(late), "of_these_told": len(late) - len(mute),
                    "not_told": len(silent),
                    "recordings_lost": lost[name], "told_after_s_max": round(max(told), 2) if told else None,
                    "healthy_after_s_max": round(worst, 2),
                    "told": sorted({f for r in rs for f in r["told"]}),
                }  # fmt: skip
                bad += len(mute) + len(silent) + lost[name]
                print(f"{name:15} {found[name]}")
        finally:
            service.process.send_signal(signal.SIGCONT)
            service.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                service.process.wait(10)
            service.process.kill()
    print(json.dumps({"faults": found, "bad": bad, "seed": args.seed}))
    if args.out is not None:
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
