"""`tmde-edge bench`: how fast each stage is here, on a rendered drive, by resolution; two runs can be compared."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from tmde_edge import __version__
from tmde_edge.adapters.depth.paced import Network
from tmde_edge.adapters.depth.threaded import ThreadedDepth
from tmde_edge.app.wiring import MAX_THREADS, build_estimation, build_eyes, depth_network
from tmde_edge.config import Config
from tmde_edge.errors import InputDataError, InputMissingError, ModelError
from tmde_edge.messages import Frame
from tmde_edge.simulation.drive import picture
from tmde_edge.simulation.scenarios import build

SIZES_PX = ((640, 360), (1280, 720), (1920, 1080))
FRAMES = 90
STILLS = 20
FIRST_FRAME = 40  # of the scenario: the lead is about 20 m ahead
WARM_UP = 10
SLOWER = 1.2  # --compare: a total that takes this many times as long is a step back
Image = NDArray[np.uint8]
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchRow:
    """Milliseconds of one stage of one kind of look; fps where the stage is a whole frame."""

    size: str
    threads: int
    look: str  # "still", "full search", "tracked", "region search", "end to end", "end to end, depth beside", "depth network"
    stage: str
    p50_ms: float
    p95_ms: float
    p99_ms: float
    fps: float | None
    count: int

    def as_dict(self) -> dict[str, Any]:
        """For --json."""
        return asdict(self)


def bench_detect(config: Config, say: Say) -> Iterator[BenchRow]:
    """Renders one drive, scales it to every size, and times perception on it (one thread, unless configured)."""
    config = with_threads(config, config.runtime.threads or 1)
    pictures = _pictures(say)
    for size_px in SIZES_PX:
        yield from _perception(config, _scaled(pictures, size_px), size_px)


def bench_all(config: Config, say: Say) -> Iterator[BenchRow]:
    """Perception and the whole way to a decision, by resolution, with one thread and with many, with depth and without."""
    pictures = _pictures(say)
    many = min(os.cpu_count() or 1, MAX_THREADS)
    counts = [config.runtime.threads] if config.runtime.threads else sorted({1, many})
    for count in counts:
        chosen = with_threads(config, count)
        network = _network(chosen, say if count == counts[0] else lambda text: None)
        for size_px in SIZES_PX:
            images = _scaled(pictures, size_px)
            yield from _perception(chosen, images, size_px)
            yield _end_to_end(chosen, images, size_px, None)
            if network is not None:
                yield _depth_alone(chosen, network, images, size_px)
                yield _end_to_end(chosen, images, size_px, network)


def with_threads(config: Config, count: int) -> Config:
    """The same configuration with every pool at that many threads."""
    depth = msgspec.structs.replace(config.depth, threads=count)
    return msgspec.structs.replace(config, runtime=msgspec.structs.replace(config.runtime, threads=count), depth=depth)


def _pictures(say: Say) -> list[Image]:
    scenario = build("approach")
    say(f"rendering {FRAMES} frames")
    return [picture(scenario, FIRST_FRAME + k) for k in range(FRAMES)]


def _scaled(images: Iterable[Image], size_px: tuple[int, int]) -> list[Image]:
    found = []
    for image in images:
        way = cv2.INTER_AREA if size_px[0] < image.shape[1] else cv2.INTER_CUBIC
        found.append(np.asarray(cv2.resize(image, size_px, interpolation=way), dtype=np.uint8))
    return found


def _network(config: Config, say: Say) -> Network | None:
    try:
        return depth_network(config)
    except ModelError as error:
        say(f"without depth: {error}")
        return None


def _frames(images: Sequence[Image]) -> Iterator[Frame]:
    for k, image in enumerate(images):
        yield Frame(t_ns=round(k * 1e9 / 30), index=k, image=image)


def _perception(config: Config, images: list[Image], size_px: tuple[int, int]) -> Iterator[BenchRow]:
    eyes = build_eyes(config, time.perf_counter_ns)
    found: dict[str, list[dict[str, float]]] = {"still": [], "full search": [], "tracked": []}
    for k, frame in enumerate(_frames(images[: STILLS + 2])):
        seen = eyes.see_still(frame)
        if k >= 2:
            found["still"].append(seen.timing_ms)
    for k, frame in enumerate(_frames(images)):
        seen = eyes.see(frame)
        if k >= WARM_UP:
            found["full search" if seen.searched else "tracked"].append(seen.timing_ms)
    for look, all_ms in found.items():
        for stage in sorted({s for t in all_ms for s in t}, key=lambda s: (s != "total", s)):
            values = [t[stage] for t in all_ms if stage in t]
            # Between two full searches all that is searched is the regions round the tracks (and the fovea, where it is on).
            name = "region search" if look == "tracked" and stage == "detect" else look
            yield _row(config, size_px, name, stage, values, whole=stage == "total")


def _end_to_end(config: Config, images: list[Image], size_px: tuple[int, int], network: Network | None) -> BenchRow:
    """Frame to decision, one after the other as fast as it goes; `network` runs beside it at its configured rate."""
    eyes, estimation = build_eyes(config, time.perf_counter_ns), build_estimation(config, Path.cwd())
    depth = None
    if network is not None:
        depth = ThreadedDepth(
            network,
            rate_hz=config.depth.rate_hz,
            clock_ns=time.monotonic_ns,
            on_reading=lambda _: None,
            on_failure=lambda _: None,
        )
        depth.start()
    values = []
    try:
        for k, frame in enumerate(_frames(images)):
            start = time.perf_counter()
            if depth is not None:
                # The drive passes faster than in truth: the network's rate is kept by the clock.
                depth.submit(Frame(t_ns=time.monotonic_ns(), index=frame.index, image=frame.image))
            estimation.step(eyes.see(frame))
            if k >= WARM_UP:
                values.append((time.perf_counter() - start) * 1e3)
    finally:
        if depth is not None:
            depth.stop()
    return _row(config, size_px, "end to end" if network is None else "end to end, depth beside", "total", values, whole=True)


def _depth_alone(config: Config, network: Network, images: list[Image], size_px: tuple[int, int]) -> BenchRow:
    values = []
    for k, frame in enumerate(_frames(images[: STILLS + 3])):
        start = time.perf_counter()
        network.infer(frame)
        if k >= 3:
            values.append((time.perf_counter() - start) * 1e3)
    return _row(config, size_px, "depth network", "total", values, whole=True)


def _row(config: Config, size_px: tuple[int, int], look: str, stage: str, ms: list[float], *, whole: bool) -> BenchRow:
    values = np.array(ms)
    p50, p95, p99 = (round(float(v), 3) for v in np.quantile(values, [0.5, 0.95, 0.99]))
    return BenchRow(
        size=f"{size_px[0]}x{size_px[1]}", threads=config.runtime.threads, look=look, stage=stage, p50_ms=p50, p95_ms=p95,
        p99_ms=p99, fps=round(1e3 / float(values.mean()), 2) if whole else None, count=len(values),
    )  # fmt: skip


# -- for people and for the next run -------------------------------------------------------------------------------------


def machine() -> str:
    """One line that says what was measured: to stand above a table that is pasted somewhere."""
    import onnxruntime

    versions = f"Python {platform.python_version()}, OpenCV {cv2.__version__}, ONNX Runtime {onnxruntime.__version__}"
    return (
        f"tmde-edge {__version__} on {_processor()}, {os.cpu_count()} cores, {platform.system()} {platform.release()} "
        f"{platform.machine()}, {versions}"
    )


def _processor() -> str:
    for path, key in (("/proc/device-tree/model", ""), ("/proc/cpuinfo", "model name")):
        try:
            text = Path(path).read_text(errors="replace").strip("\x00\n ")
        except OSError:
            continue
        if not key:
            return text
        for row in text.splitlines():
            if row.startswith(key):
                return row.partition(":")[2].strip()
    return platform.processor() or "unknown processor"


def header() -> str:
    """The table's head: Markdown, also readable as it is."""
    names = ("size     ", "threads", "look                    ", "stage  ", "p50 ms", "p95 ms", "p99 ms", "  fps", "frames")
    return "| " + " | ".join(names) + " |\n|" + "|".join("-" * (len(n) + 2) for n in names) + "|"


def line(row: BenchRow) -> str:
    """One row of the table."""
    fps = f"{row.fps:5.1f}" if row.fps is not None else "     "
    return (
        f"| {row.size:9} | {row.threads:7d} | {row.look:24} | {row.stage:7} | {row.p50_ms:6.2f} | {row.p95_ms:6.2f} | "
        f"{row.p99_ms:6.2f} | {fps} | {row.count:6d} |"
    )


def read_rows(path: Path) -> list[BenchRow]:
    """What an earlier `bench --json` printed. Raises InputMissingError, InputDataError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputMissingError(f"{path}: no such file; make one with `tmde-edge bench --json > {path}`") from None
    except (OSError, UnicodeDecodeError) as e:
        raise InputDataError(f"{path}: cannot be read ({e})") from None
    rows = []
    for number, text in enumerate(lines, 1):
        try:
            rows.append(BenchRow(**json.loads(text)))
        except (ValueError, TypeError) as e:
            raise InputDataError(f"{path} line {number}: not a row of `tmde-edge bench --json` ({e})") from None
    if not rows:
        raise InputDataError(f"{path}: holds no row")
    return rows


def compared(old: Sequence[BenchRow], new: Sequence[BenchRow]) -> tuple[list[str], bool]:
    """Lines for people, and whether a whole frame takes longer by more than SLOWER. Raises InputDataError: nothing common."""
    before = {(r.size, r.threads, r.look, r.stage): r for r in old}
    lines, worse = [], False
    for row in new:
        was = before.get((row.size, row.threads, row.look, row.stage))
        if was is None or was.p50_ms <= 0:
            continue
        ratio = row.p50_ms / was.p50_ms
        back = row.stage == "total" and ratio > SLOWER
        worse |= back
        mark = "  SLOWER" if back else ""
        lines.append(
            f"{row.size:9} {row.threads} threads  {row.look:24} {row.stage:7} p50 {was.p50_ms:8.2f} -> {row.p50_ms:8.2f} ms  "
            f"{100 * (ratio - 1):+6.1f} %{mark}"
        )
    if not lines:
        raise InputDataError("--compare: the two runs have no row in common (other sizes or numbers of threads)")
    return lines, worse
