"""`--dry-run`: opens everything a run on the desk needs, feeds the sinks, sums up."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from tmde_edge.adapters.cameras.sources import FrameSource, open_source
from tmde_edge.adapters.can_ports.log_files import CandumpWriter, iter_can_log
from tmde_edge.adapters.video_out import VideoWriter
from tmde_edge.app.can_times import CanTimeline
from tmde_edge.app.dry_run import Step, dry_run
from tmde_edge.app.overlay import Image, draw
from tmde_edge.app.recorder import SingleLog, frame_keeper
from tmde_edge.app.records import Record
from tmde_edge.app.report.about import about_run
from tmde_edge.app.report.writer import ReportWriter
from tmde_edge.app.truth import TruthComparison, read_truth
from tmde_edge.app.wiring import build_depth, build_estimation, build_eyes, log_config, threads
from tmde_edge.config import Config
from tmde_edge.errors import UsageError
from tmde_edge.estimation import Estimation
from tmde_edge.messages import Frame


@dataclass(frozen=True, slots=True, kw_only=True)
class DeskOptions:
    """The options of --dry-run that name inputs and outputs."""

    source: str
    fps: float = 30.0
    can_log: Path | None = None
    can_offset_s: float = 0.0
    video_out: Path | None = None
    report: Path | None = None
    record: Path | None = None
    truth: Path | None = None
    can_out: str | None = None


class Desk:
    """Iterate for the records, within `with`: its end closes the outputs, whatever went wrong, with all that came before."""

    def __init__(self, config: Config, base_dir: Path, options: DeskOptions) -> None:
        self._config = config
        self._options = options
        self._stack = ExitStack()
        self._counts: Counter[str] = Counter()
        self._alerts: list[tuple[float, str, str]] = []
        self._total_ms: list[float] = []
        self._base_dir = base_dir
        self._video: VideoWriter | None = None
        self._source: FrameSource = open_source(options.source, options.fps, threads=threads(config))
        truth = read_truth(options.truth) if options.truth is not None else None
        self._true = truth
        self._truth = TruthComparison(truth) if truth is not None else None
        self._report: ReportWriter | None = None
        if options.report is not None:
            made = time.strftime("%Y-%m-%d %H:%M")
            about = about_run(config, options.source, str(options.can_log) if options.can_log is not None else None, made)
            self._report = ReportWriter(options.report, about)
            self._stack.callback(self._finish_report)
        self._can_out = self._stack.enter_context(CandumpWriter(options.can_out)) if options.can_out is not None else None
        self._wall_s = 0.0
        self._estimation: Estimation | None = None
        self._page: Path | None = None

    def __enter__(self) -> Desk:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def frame_count(self) -> int | None:
        return self._source.frame_count

    def __iter__(self) -> Iterator[Record]:
        o, config = self._options, self._config
        if o.can_log is None:  # no bus on this desk: nothing is lost when it is silent
            config = msgspec.structs.replace(config, can=msgspec.structs.replace(config.can, enabled=False))
        log = None
        if o.record is not None:
            keeper = frame_keeper(config.record) if config.record.frames else None
            log = self._stack.enter_context(SingleLog(o.record, log_config(config, self._base_dir), keeper))
        can = CanTimeline(iter_can_log(o.can_log), o.can_offset_s) if o.can_log is not None else None
        start = time.perf_counter()
        self._estimation = build_estimation(config, self._base_dir)
        run = dry_run(
            self._source,
            build_eyes(config, time.perf_counter_ns),
            self._estimation,
            camera=config.camera.camera(),
            can=can,
            depth=build_depth(config, self._base_dir),
            log=log,
            tick_hz=config.runtime.tick_hz,
        )
        for step in run:
            self._take(step)
            yield step.record
        self._wall_s = time.perf_counter() - start

    def _take(self, step: Step) -> None:
        record = step.record
        for sent in step.can_out:
            if self._can_out is not None:
                self._can_out.write(sent)
        self._counts["frames"] += 1
        if "error" in record:
            self._counts["errors"] += 1
        else:
            self._counts["with a plate"] += bool(record["plates"])
            self._counts["with a lead"] += record["lead"] is not None
            self._total_ms.append(record["timing_ms"].get("total", 0.0))
            alert = record["alert"]
            if alert["level"] != (self._alerts[-1][1] if self._alerts else "none"):
                self._alerts.append((record["t"], alert["level"], alert["reason"]))
            if self._truth is not None:
                self._truth.add(record)
        frame = step.frame
        if self._report is not None:
            size_px = (frame.image.shape[1], frame.image.shape[0]) if frame is not None else None
            self._report.add(record, size_px, (lambda: self._picture(step, frame)) if frame is not None else None)
        if self._options.video_out is not None and frame is not None:
            if self._video is None:
                self._video = self._stack.enter_context(VideoWriter(self._options.video_out))
            self._video.write(self._picture(step, frame), frame.t_ns)

    def _picture(self, step: Step, frame: Frame) -> Image:
        return draw(frame.image, step.result, self._config.camera.camera(), step.record.get("error"))

    def finish(self) -> list[str]:
        """Closes the outputs; the summary for people."""
        self._stack.close()
        n = self._counts
        lines = [f"{n['frames']} frames, {n['with a plate']} with a plate, {n['with a lead']} with a lead"]
        if n["errors"]:
            lines.append(f"{n['errors']} frames could not be used; see their error records")
        if self._total_ms:
            p50, p95 = np.quantile(self._total_ms, [0.5, 0.95])
            rate = n["frames"] / self._wall_s if self._wall_s > 0 else 0.0
            lines.append(f"perception {p50:.1f} ms a frame (p95 {p95:.1f}); {rate:.1f} frames a second in all")
        lines += self._estimation.notes if self._estimation is not None else ()
        for t_s, level, reason in self._alerts:
            lines.append(f"{t_s:8.2f} s  {level}{f' ({reason})' if reason else ''}")
        if not self._alerts:
            lines.append("no alert")
        if self._truth is not None:
            lines += self._truth.lines()
        if self._page is not None:
            lines.append(f"report: {self._page}")
        return lines

    def _finish_report(self) -> None:
        if self._report is None:
            return
        if self._counts["frames"]:
            self._page = self._report.finish(self._true, self._truth)
        else:
            self._report.close()


def run_desk(config: Config, base_dir: Path, options: DeskOptions) -> Desk:
    """Checks inputs at once, so that errors come before any work."""
    if options.can_log is None and options.can_offset_s:
        raise UsageError("--can-offset needs --can-log")
    return Desk(config, base_dir, options)
