"""`tmde-edge bench`: how fast each stage is here, on a rendered drive, by resolution."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from tmde_edge.app.wiring import build_eyes
from tmde_edge.config import Config
from tmde_edge.messages import Frame
from tmde_edge.simulation.drive import picture
from tmde_edge.simulation.scenarios import build

SIZES_PX = ((640, 360), (1280, 720), (1920, 1080))
FRAMES = 90
FIRST_FRAME = 40  # of the scenario: the lead is about 20 m ahead
WARM_UP = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchRow:
    """Milliseconds of one stage of one kind of look."""

    size: str
    look: str  # "still", "full search", "tracked"
    stage: str
    p50_ms: float
    p95_ms: float
    p99_ms: float
    count: int

    def as_dict(self) -> dict[str, Any]:
        return {f: getattr(self, f) for f in self.__slots__}


def bench_detect(config: Config, say: Callable[[str], None]) -> Iterator[BenchRow]:
    """Renders one drive, scales it to every size, and times perception on it (threads as configured)."""
    scenario = build("approach")
    say(f"rendering {FRAMES} frames")
    pictures = [picture(scenario, FIRST_FRAME + k) for k in range(FRAMES)]
    for width_px, height_px in SIZES_PX:
        images = [_scaled(p, width_px, height_px) for p in pictures]
        size = f"{width_px}x{height_px}"
        yield from _rows(size, _timings(config, images))


def _scaled(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    shrink = width_px < image.shape[1]
    small = cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_CUBIC)
    return np.asarray(small, dtype=np.uint8)


def _timings(config: Config, images: list[NDArray[np.uint8]]) -> dict[str, list[dict[str, float]]]:
    eyes = build_eyes(config, time.perf_counter_ns)
    found: dict[str, list[dict[str, float]]] = {"still": [], "full search": [], "tracked": []}
    for k, image in enumerate(images):
        seen = eyes.see_still(Frame(t_ns=0, index=k, image=image))
        if k >= WARM_UP:
            found["still"].append(seen.timing_ms)
    for k, image in enumerate(images):
        seen = eyes.see(Frame(t_ns=round(k * 1e9 / 30), index=k, image=image))
        if k >= WARM_UP:
            found["full search" if seen.searched else "tracked"].append(seen.timing_ms)
    return found


def _rows(size: str, timings: dict[str, list[dict[str, float]]]) -> Iterator[BenchRow]:
    for look, all_ms in timings.items():
        for stage in sorted({s for t in all_ms for s in t}, key=lambda s: (s != "total", s)):
            values = np.array([t[stage] for t in all_ms if stage in t])
            p50, p95, p99 = np.quantile(values, [0.5, 0.95, 0.99])
            yield BenchRow(
                size=size, look=look, stage=stage, p50_ms=float(p50), p95_ms=float(p95), p99_ms=float(p99), count=len(values)
            )


def header() -> str:
    return f"{'size':10} {'look':12} {'stage':8} {'p50 ms':>8} {'p95 ms':>8} {'p99 ms':>8} {'frames':>7}"


def line(row: BenchRow) -> str:
    return f"{row.size:10} {row.look:12} {row.stage:8} {row.p50_ms:8.2f} {row.p95_ms:8.2f} {row.p99_ms:8.2f} {row.count:7d}"


def one_thread(config: Config) -> Config:
    """The same configuration with every pool at one thread, unless the user set a number."""
    if config.runtime.threads:
        return config
    return msgspec.structs.replace(config, runtime=msgspec.structs.replace(config.runtime, threads=1))
