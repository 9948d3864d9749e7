"""What the live page costs the pipeline: blocks of a rendered drive with and without a browser's requests, paired.

    python tests/benchmarks/view_cost.py [--pairs 10] [--frames 60]

The pipeline runs at 30 frames a second of its own clock; a process of its own (curl) reads picture and numbers in every
second block. Printed: pipeline thread's CPU time a frame (waiting for other programs is not in it), its wall time, the
page's own CPU time as a share of one core.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from tmde_edge.adapters.cameras.sources import open_source
from tmde_edge.app.simulate import simulate
from tmde_edge.app.view.run import build_page
from tmde_edge.app.wiring import build_estimation, build_eyes
from tmde_edge.config import load
from tmde_edge.messages import Frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--drive", type=Path, help="a folder that `simulate` made; without it one is rendered")
    parser.add_argument("--rate-hz", type=float, default=30.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.drive if args.drive is not None else Path(scratch)
        if args.drive is None:
            simulate("approach", folder, seed=0, plate=None)
        config = load(folder / "config.toml", ["runtime.threads=1", "view.port=0"])
        images = [f.image for f in open_source(str(folder / "video.mp4"), threads=1) if isinstance(f, Frame)][40:160]
        hub, server = build_page(config, "benchmark")
        hub.start()
        server.start()
        eyes, estimation = build_eyes(config, time.perf_counter_ns), build_estimation(config, folder)
        cost: dict[bool, list[tuple[float, float, float]]] = {False: [], True: []}
        k = 0
        for block in range(2 * args.pairs + 1):
            watched = block % 2 == 1
            readers = []
            if watched:
                url = f"http://127.0.0.1:{server.port}"
                readers = [subprocess.Popen(["curl", "-s", "-o", "/dev/null", f"{url}/{what}"]) for what in ("video", "events")]
                while hub.watchers < 1:
                    time.sleep(0.01)
            cpu, wall, whole = time.thread_time(), 0.0, time.process_time()
            start = time.perf_counter()
            for i in range(args.frames):
                due = start + i / args.rate_hz
                time.sleep(max(due - time.perf_counter(), 0.0))
                frame = Frame(t_ns=round(k * 1e9 / 30), index=k, image=images[i % len(images)])
                k += 1
                began = time.perf_counter()
                hub.look(frame)
                sighting = eyes.see(frame)
                for output in estimation.step(sighting):
                    if hasattr(output, "plates"):
                        hub.frame(output, sighting)
                wall += time.perf_counter() - began
            cpu, whole = time.thread_time() - cpu, time.process_time() - whole
            span = time.perf_counter() - start
            for reader in readers:
                reader.kill()
                reader.wait()
            while hub.watchers:
                time.sleep(0.01)
            if block:  # the first warms up
                cost[watched].append((1e3 * cpu / args.frames, 1e3 * wall / args.frames, 100 * (whole - cpu) / span))
        server.close()
        pictures = hub.picture_number
    off, on = np.array(cost[False]), np.array(cost[True])
    ratio = 100 * (on[:, :2] / off[:, :2] - 1)
    print(f"{args.pairs} pairs of {args.frames} frames at {args.rate_hz:g} Hz, {pictures} pictures drawn")
    for column, name in ((0, "CPU time of the pipeline's thread"), (1, "wall time of the pipeline")):
        low, middle, high = np.quantile(ratio[:, column], [0.25, 0.5, 0.75])
        means = f"{off[:, column].mean():.2f} -> {on[:, column].mean():.2f} ms a frame"
        print(f"{name}: {means}, paired {middle:+.1f} % ({low:+.1f} to {high:+.1f})")
    print(f"all other threads: {off[:, 2].mean():.1f} % of one core without, {on[:, 2].mean():.1f} % with a watcher")


main()
