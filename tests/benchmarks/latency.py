"""From a frame's time stamp to its CAN frame leaving: `python tests/benchmarks/latency.py [--seconds 20] [--width 1280]`.

A rendered drive (`approach`) is played in real time into the live loop with the real perception; a second port on the same
virtual bus notes when each frame arrives. Only CAN frames decided on a picture count (those of ticks carry what was decided
before). Then the same drive through the desk: perception, decision and packing of each frame, one after the other.
Bar: p99 below one frame period + 20 ms. On a machine that does other things run it with `nice -n -15`, and look at cpu_p99_ms.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from pathlib import Path

import can
import cv2
import msgspec
import numpy as np

from tmde_edge import config
from tmde_edge.adapters.cameras.played_file import PlayedFile
from tmde_edge.adapters.cameras.sources import open_source
from tmde_edge.adapters.cameras.video_file import SourceError
from tmde_edge.adapters.can_ports.bus import CanPort
from tmde_edge.app.live import LiveLoop
from tmde_edge.app.simulate import simulate
from tmde_edge.app.wiring import build_estimation, build_eyes
from tmde_edge.messages import CanFrame, Event, Frame, Output, Sighting

RATE_HZ = 30.0
BAR_MS = 1000.0 / RATE_HZ + 20.0


class Noted:
    """The estimation, noting which CAN frames were decided on a picture."""

    def __init__(self, inner: object) -> None:
        self._inner = inner
        self.stamps: dict[tuple[int, bytes], int] = {}

    def step(self, event: Event) -> tuple[Output, ...]:
        out: tuple[Output, ...] = self._inner.step(event)  # type: ignore[attr-defined]
        if isinstance(event, Sighting):
            self.stamps |= {(o.can_id, o.data): o.t_ns for o in out if isinstance(o, CanFrame)}
        return out


def summary(values_ms: list[float]) -> dict[str, object]:
    if not values_ms:
        return {"count": 0}
    p50, p95, p99 = np.percentile(values_ms, [50, 95, 99])
    return {"count": len(values_ms), "p50_ms": round(p50, 1), "p95_ms": round(p95, 1), "p99_ms": round(p99, 1),
            "max_ms": round(max(values_ms), 1), "bar_ms": round(BAR_MS, 1), "reached": bool(p99 < BAR_MS)}  # fmt: skip


def live(settings: config.Config, folder: Path, seconds: float) -> dict[str, object]:
    """The live loop on a virtual bus."""
    channel = "tmde-latency"
    on_bus = msgspec.structs.replace(settings.can, interface="virtual", channel=channel, transmit=True)
    noted = Noted(build_estimation(msgspec.structs.replace(settings, can=on_bus), folder))
    eyes = build_eyes(settings, time.perf_counter_ns)
    camera = PlayedFile(str(folder / "video.mp4"), loop=True, fps=RATE_HZ)
    loop = LiveLoop(camera, eyes.see, noted)
    listener = can.Bus(interface="virtual", channel=channel)
    arrived: list[tuple[int, int, bytes]] = []
    done = threading.Event()

    def listen() -> None:
        while not done.is_set():
            message = listener.recv(0.2)
            if message is not None:
                arrived.append((time.monotonic_ns(), message.arbitration_id, bytes(message.data)))

    thread = threading.Thread(target=listen)
    thread.start()
    threading.Timer(seconds, loop.stop).start()
    loop.run(CanPort(on_bus, loop.on_can, (), loop.crash))
    done.set()
    thread.join()
    listener.shutdown()
    late: list[float] = []
    for t_ns, can_id, data in arrived:  # the alive counter makes neighbouring frames differ
        stamp = noted.stamps.get((can_id, data))
        if stamp is not None and 0 <= t_ns - stamp < 2_000_000_000:
            late.append((t_ns - stamp) * 1e-6)
    return {**summary(late), "sightings": loop.counters.sightings, "skipped": loop.counters.skipped}


def desk(settings: config.Config, folder: Path) -> dict[str, object]:
    """Every frame through perception, decision and packing."""
    eyes, estimation = build_eyes(settings, time.perf_counter_ns), build_estimation(settings, folder)
    took: list[float] = []
    cpu: list[float] = []
    for item in open_source(str(folder / "video.mp4"), RATE_HZ):
        if isinstance(item, SourceError):
            continue
        frame: Frame = item
        start, start_cpu = time.perf_counter(), time.thread_time()
        estimation.step(eyes.see(frame))
        took.append((time.perf_counter() - start) * 1e3)
        cpu.append((time.thread_time() - start_cpu) * 1e3)
    p50, p99 = np.percentile(cpu[5:], [50, 99])  # the first frames load the networks' memory
    return {**summary(took[5:]), "cpu_p50_ms": round(p50, 1), "cpu_p99_ms": round(p99, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--folder", type=Path, help="an already rendered drive of `tmde-edge simulate`")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.folder or Path(scratch)
        if args.folder is None:
            simulate("approach", folder)
        settings = config.load(folder / "config.toml", ["runtime.threads=1"])
        print(json.dumps({"desk": desk(settings, folder)}), flush=True)
        print(json.dumps({"live": live(settings, folder, args.seconds)}), flush=True)


if __name__ == "__main__":
    main()
