"""The verb `evaluate`: many recordings or labelled stills through one or two configurations, in parallel processes."""

from __future__ import annotations

import csv
import importlib.util
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tmde_edge.app.desk import DeskOptions, run_desk
from tmde_edge.app.drive_log import DriveLogReader
from tmde_edge.app.evaluate_metrics import Row
from tmde_edge.app.evaluate_truth import TrueFrame, recording_truth, rows_of, still_labels
from tmde_edge.app.measure import measure_images
from tmde_edge.app.records import frame_record
from tmde_edge.app.truth import read_truth
from tmde_edge.app.wiring import build_eyes, estimation_of_log
from tmde_edge.config import Config, from_tree, merged, read_tree
from tmde_edge.errors import InputDataError, InputMissingError, TmdeError, UsageError, writing
from tmde_edge.messages import FrameResult, Pose, Sighting
from tmde_edge.plates.region import expected
from tmde_edge.ranging.ranger import Ranger

COLUMNS = (
    "config", "recording", "frame", "image", "t_s", "true_m", "true_width_px", "found", "iou", "corner_error", "characters",
    "count_exact", "char_height_error", "standard", "distance_m", "sigma_m", "ranged", "range_error", "range_sigma",
    "false_plates", "lead_true_m", "lead_reported", "lead_false", "lead_m", "lead_error", "lead_sigma", "error",
)
_VIDEOS = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".mjpeg")
_STILLS_A_JOB = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """One piece of work: a recording with its truth, a drive log, or some labelled stills of one folder."""

    kind: Literal["recording", "drive_log", "stills"]
    path: Path
    images: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return str(self.path)


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """One configuration: its name in tables and the tree that is laid over what a recording brings itself."""

    name: str
    tree: dict[str, Any]


def candidates(files: Sequence[Path], overrides: Sequence[str]) -> list[Candidate]:
    """None, one or two configuration files with the same overrides. Raises UsageError, ConfigError."""
    if len(files) > 2:
        raise UsageError(f"{len(files)} configurations: evaluate compares two at most")
    if not files:
        return [Candidate(name="as recorded", tree=read_tree(None, overrides))]
    names = [f.name for f in files] if len({f.name for f in files}) == len(files) else [str(f) for f in files]
    if len(set(names)) < len(names):
        names = [f"{n} ({i + 1})" for i, n in enumerate(names)]
    return [Candidate(name=n, tree=read_tree(f, overrides)) for n, f in zip(names, files, strict=True)]


def find_items(sources: Sequence[str]) -> list[Item]:
    """Work in the named folders and files: recordings (a video or images with truth.csv), labels.csv, MCAP drive logs.

    A folder that is none of these is searched one level deep. Raises InputMissingError.
    """
    found: list[Item] = []
    for source in sources:
        path = Path(source)
        if not path.exists():
            raise InputMissingError(f"{source}: no such file or folder")
        inside = _items_of(path)
        if not inside and path.is_dir():
            inside = [i for child in sorted(path.iterdir()) for i in _items_of(child)]
        if not inside:
            raise InputMissingError(
                f"{source}: nothing to evaluate; a recording is a folder with a video and truth.csv (as `tmde-edge simulate` "
                "makes it), stills are a folder with labels.csv, a drive log NAME.mcap has its truth in NAME.truth.csv"
            )
        found += inside
    return found


def _items_of(path: Path) -> list[Item]:
    if path.is_file():
        if path.suffix == ".mcap":
            return [Item(kind="drive_log", path=path)]
        return []
    if (path / "truth.csv").exists() and _video_of(path) is not None:
        return [Item(kind="recording", path=path)]
    if (path / "labels.csv").exists():
        names = sorted(still_labels(path / "labels.csv"))
        return [
            Item(kind="stills", path=path, images=tuple(names[k : k + _STILLS_A_JOB]))
            for k in range(0, len(names), _STILLS_A_JOB)
        ]
    return []


def _video_of(folder: Path) -> Path | None:
    videos = sorted(p for p in folder.iterdir() if p.suffix.lower() in _VIDEOS)
    preferred = [p for p in videos if p.stem == "video"]
    return next(iter(preferred or videos), folder / "images" if (folder / "images").is_dir() else None)


def evaluate(items: Sequence[Item], configs: Sequence[Candidate], jobs: int) -> Iterator[list[Row]]:
    """Rows of each piece of work as it is done; the order of pieces is not fixed. Raises the worker's own TmdeError."""
    work = [(item, config) for item in items for config in configs]
    if jobs <= 1 or len(work) == 1:
        for item, config in work:
            yield run_item(item, config)
        return
    spawn = multiprocessing.get_context("spawn")  # threads of OpenCV and ONNX Runtime do not survive a fork
    with ProcessPoolExecutor(min(jobs, len(work)), mp_context=spawn) as pool:
        futures = [pool.submit(_worker, item, config) for item, config in work]
        try:
            for future in as_completed(futures):
                rows, error = future.result()
                if error is not None:
                    raise error[0](error[1])
                yield rows
        finally:
            for future in futures:
                future.cancel()


def _worker(item: Item, config: Candidate) -> tuple[list[Row], tuple[type[TmdeError], str] | None]:
    try:
        return run_item(item, config), None
    except TmdeError as e:  # crosses the processes as what it is
        return [], (type(e), str(e))


def run_item(item: Item, config: Candidate) -> list[Row]:
    """All rows of one piece of work with one configuration, on one thread."""
    if item.kind == "stills":
        return _stills(item, config)
    if item.kind == "drive_log":
        return _drive_log(item, config)
    return _recording(item, config)


def _config(item: Item, config: Candidate, own: dict[str, Any]) -> Config:
    tree = merged(merged(own, config.tree), {"runtime": {"threads": 1}})
    return from_tree(tree, f"{config.name} on {item.name}")


def _recording(item: Item, config: Candidate) -> list[Row]:
    folder = item.path
    truth = recording_truth(folder)
    own = folder / "config.toml"
    loaded = _config(item, config, read_tree(own, ()) if own.exists() else {})
    can_log = next((p for p in (folder / "can.log", folder / "can.asc", folder / "can.blf") if p.exists()), None)
    video = _video_of(folder)
    if video is None:
        raise InputMissingError(f"{folder}: no video")
    rows: list[Row] = []
    with run_desk(loaded, folder, DeskOptions(source=str(video), can_log=can_log, fps=loaded.camera.rate_hz)) as desk:
        for record in desk:
            base: Row = {"config": config.name, "recording": item.name, "frame": record["frame"], "t_s": record["t"]}
            rows += rows_of(record, truth.get(record["frame"], TrueFrame()), base)
    return rows


def _stills(item: Item, config: Candidate) -> list[Row]:
    labels = still_labels(item.path / "labels.csv")
    own = item.path / "config.toml"
    loaded = _config(item, config, read_tree(own, ()) if own.exists() else {})
    c = loaded.camera
    eyes = build_eyes(loaded, time.perf_counter_ns)
    ranger = Ranger(loaded.ranging, expected(loaded.plates.expect, loaded.plates.region))
    pose = Pose(pitch_rad=c.pitch_rad, roll_rad=c.roll_rad, yaw_rad=c.yaw_rad)
    missing = [n for n in item.images if not (item.path / n).exists()]
    if missing:
        raise InputMissingError(f"{item.path / 'labels.csv'} names {missing[0]}, which is not there")
    paths = [item.path / n for n in item.images]
    rows: list[Row] = []
    everything = sorted(labels)
    for name, (record, _, _) in zip(
        item.images, measure_images(paths, eyes, c.camera(), ranger, pose, loaded.tracker.path_half_width_m), strict=True
    ):
        base: Row = {"config": config.name, "recording": item.name, "frame": everything.index(name), "image": name}
        rows += rows_of(record, labels[name], base)
    return rows


def _drive_log(item: Item, config: Candidate) -> list[Row]:
    """What was seen is as it was recorded; the estimation decides again with this configuration."""
    path = item.path.with_name(f"{item.path.stem}.truth.csv")
    truth = {frame: TrueFrame(lead_m=row.distance_m) for frame, row in read_truth(path).items()}
    log = DriveLogReader(item.path)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="tmde-evaluate-") as folder:
        estimation = estimation_of_log(item.path, log.config, Path(folder), config.tree)
        first_ns: int | None = None
        for entry in log.entries():
            outputs = estimation.step(entry.event)
            result = next((o for o in outputs if isinstance(o, FrameResult)), None)
            if result is None or not isinstance(entry.event, Sighting):
                continue
            first_ns = result.t_ns if first_ns is None else first_ns
            record = frame_record(result, entry.event, {})
            base: Row = {"config": config.name, "recording": item.name, "frame": record["frame"],
                         "t_s": (result.t_ns - first_ns) * 1e-9}  # fmt: skip
            rows += rows_of(record, truth.get(record["frame"], TrueFrame()), base, has_images=False)
    if log.torn is not None and not rows:
        raise InputDataError(f"{item.path}: {log.torn}")
    return rows


def check_out(path: Path) -> None:
    """What would keep `write_rows` from writing, said before the work is done. Raises UsageError."""
    if path.suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise UsageError(f"{path}: Parquet needs pyarrow (pip install pyarrow), or name a .csv file")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: cannot be written, there is no folder {path.parent}")


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """CSV, or Parquet where the name ends in .parquet. Raises UsageError (cannot be written, pyarrow is missing)."""
    check_out(path)
    with writing(path):
        if path.suffix == ".parquet":
            import pyarrow
            import pyarrow.parquet

            columns = {c: [r.get(c) for r in rows] for c in COLUMNS}
            pyarrow.parquet.write_table(pyarrow.table(columns), str(path))
            return
        with path.open("w", newline="", encoding="utf-8") as f:
            writer = csv.DictWriter(f, COLUMNS, extrasaction="ignore", restval="")
            writer.writeheader()
            for row in rows:
                writer.writerow({k: (f"{v:.6g}" if isinstance(v, float) else v) for k, v in row.items() if v is not None})


def default_jobs() -> int:
    """One process a core."""
    return os.cpu_count() or 1

