"""What a depth network costs: int8 against float on one thread, memory, and the main loop with and without it beside.

python tests/benchmarks/depth_cost.py FLOAT.onnx INT8.onnx [--frames 60]

Times are CPU times of this process's thread, so that a busy machine tells the same; the loop runs the perception of a rendered
drive with the network on its own thread at 4 Hz, and without, in turns. Any MiDaS-like graph will do
(../shared/tools/midas_standin.py, then `tmde-edge models quantize`).
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import cv2
import numpy as np

from tmde_edge.adapters.depth.manifest import ModelSpec
from tmde_edge.adapters.depth.onnx_depth import OnnxDepth
from tmde_edge.adapters.depth.threaded import ThreadedDepth
from tmde_edge.app.wiring import build_eyes
from tmde_edge.config import load
from tmde_edge.messages import Frame
from tmde_edge.simulation.drive import picture
from tmde_edge.simulation.scenarios import build


def network_ms(path: Path, frame: Frame, runs: int = 12) -> tuple[float, float]:
    """Median CPU time of one inference (ms), and the resident memory it took (MB)."""
    before_kb = resident_kb()
    network = OnnxDepth(ModelSpec(name="standin", file=path.name), path, threads=1)
    network.infer(frame)
    grown_mb = (resident_kb() - before_kb) / 1024
    times = []
    for _ in range(runs):
        start = time.process_time()
        network.infer(frame)
        times.append((time.process_time() - start) * 1e3)
    return float(np.median(times)), grown_mb


def resident_kb() -> int:
    """Of this process now (the peak where /proc is not there)."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024
    except OSError:
        return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def loop_ms(frames: list[Frame], path: Path | None) -> list[float]:
    """CPU time of the perception thread alone, a frame (ms)."""
    config = load(None, ["camera.fx_px=1400", "runtime.threads=1"])
    eyes = build_eyes(config, time.perf_counter_ns)
    depth = None
    if path is not None:
        network = OnnxDepth(ModelSpec(name="standin", file=path.name), path, threads=1)
        depth = ThreadedDepth(
            network, rate_hz=4.0, clock_ns=time.monotonic_ns, on_reading=lambda _: None, on_failure=lambda e: print("depth:", e)
        )
        depth.start()
    out = []
    for frame in frames:
        start = time.thread_time()
        if depth is not None:
            depth.submit(frame)
        eyes.see(frame)
        out.append((time.thread_time() - start) * 1e3)
    if depth is not None:
        depth.stop()
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("float_model", type=Path)
    parser.add_argument("int8_model", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    a = parser.parse_args()
    cv2.setNumThreads(1)
    scenario = build("gap-steady")
    frames = [Frame(t_ns=round(k / 30 * 1e9), index=k, image=picture(scenario, k)) for k in range(a.frames)]
    int8 = network_ms(a.int8_model, frames[0])
    full = network_ms(a.float_model, frames[0])
    print(f"float {full[0]:.0f} ms, {full[1]:.0f} MB; int8 {int8[0]:.0f} ms, {int8[1]:.0f} MB; "
          f"{int8[0] / full[0]:.2f} of the float time")  # fmt: skip
    pairs = [(loop_ms(frames, None), loop_ms(frames, a.int8_model)) for _ in range(2)]
    without, with_depth = (np.concatenate([p[i][10:] for p in pairs]) for i in (0, 1))
    print(f"main loop, median: {np.median(without):.2f} ms without, {np.median(with_depth):.2f} ms with depth "
          f"({np.median(with_depth) - np.median(without):+.2f} ms)")  # fmt: skip


if __name__ == "__main__":
    main()
