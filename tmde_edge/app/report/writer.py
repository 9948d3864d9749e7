"""Collects a run into FOLDER: index.html (everything inside), records.jsonl, report.json and thumbnails/."""

from __future__ import annotations

import json
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from tmde_edge.app.records import Record
from tmde_edge.app.report.about import About
from tmde_edge.app.report.page import page
from tmde_edge.app.report.series import Change, Series
from tmde_edge.app.truth import TruthComparison, TruthRow, read_truth
from tmde_edge.errors import InputDataError, InputMissingError, UsageError, writing

Image = NDArray[np.uint8]
THUMBNAIL_WIDTH_PX = 560
MOST_OF_A_KIND = {"warning": 8, "caution": 4, "lead": 2, "lead lost": 2, "fault": 3, "error": 0, "alert over": 0, "fault over": 0}


class ReportWriter:
    """add() every record in order, then finish(). Raises UsageError where the folder cannot be written."""

    def __init__(self, folder: Path, about: About) -> None:
        self._folder, self._name = folder, f"--report {folder}"
        self._about = about
        self._series = Series()
        self._kinds: Counter[str] = Counter()
        self._pictures: list[tuple[Change, bytes]] = []
        self._worst: tuple[float, Record, Callable[[], Image]] | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._records = (folder / "records.jsonl").open("w", encoding="utf-8")
        except OSError as e:
            raise UsageError(f"--report {folder}: cannot be written ({e.strerror or e}); name a folder") from None

    def add(self, record: Record, size_px: tuple[int, int] | None, draw: Callable[[], Image] | None) -> None:
        """Takes a record; `draw` makes its annotated picture and is called only where a thumbnail is wanted."""
        with writing(self._name):
            self._records.write(json.dumps(record, allow_nan=False, separators=(",", ":")) + "\n")
        if size_px is not None and not self._about.width_px:
            self._about = msgspec.structs.replace(self._about, width_px=size_px[0], height_px=size_px[1])
        changes = self._series.add(record)
        if draw is None:
            return
        for change in changes:
            if self._kinds[change.kind] < MOST_OF_A_KIND.get(change.kind, 0):
                self._kinds[change.kind] += 1
                self._pictures.append((change, _thumbnail(draw())))
        lead = record.get("lead")
        if lead is not None and lead["ttc_s"] is not None and (self._worst is None or lead["ttc_s"] < self._worst[0]):
            self._worst = (lead["ttc_s"], record, draw)

    def finish(self, truth: dict[int, TruthRow] | None, comparison: TruthComparison | None) -> Path:
        """Writes the page; returns its path."""
        self.close()
        if self._worst is not None:
            ttc_s, record, draw = self._worst
            self._pictures.append(
                (Change(record["frame"], record["t"], "closest", f"shortest TTC: {ttc_s:.1f} s"), _thumbnail(draw()))
            )
        self._pictures.sort(key=lambda p: p[0].t_s)
        names = [f"{change.frame:06d}-{change.kind.replace(' ', '-')}.jpg" for change, _ in self._pictures]
        listed = [
            {"file": name, "frame": c.frame, "t_s": c.t_s, "text": c.text}
            for name, (c, _) in zip(names, self._pictures, strict=True)
        ]
        about = msgspec.structs.replace(self._about, thumbnails=listed, rate_hz=rate_hz(self._series))
        pictures = self._folder / "thumbnails"
        with writing(self._name):
            pictures.mkdir(exist_ok=True)
            for old in pictures.glob("*.jpg"):  # of an earlier run into the same folder
                old.unlink()
            for name, (_, jpeg) in zip(names, self._pictures, strict=True):
                (pictures / name).write_bytes(jpeg)
            (self._folder / "report.json").write_bytes(msgspec.json.format(msgspec.json.encode(about), indent=1))
            return _write_page(self._folder, self._series, about, [j for _, j in self._pictures], truth, comparison)

    def close(self) -> None:
        """Lets the files go; harmless after finish()."""
        with writing(self._name):
            self._records.close()


def rebuild(source: Path, out: Path | None, truth_path: Path | None) -> Path:
    """Makes the page of kept records again: `source` is a report's folder or any file of JSON lines.

    Raises InputMissingError, InputDataError, UsageError.
    """
    folder = source if source.is_dir() else source.parent
    records = source / "records.jsonl" if source.is_dir() else source
    if not records.exists():
        raise InputMissingError(f"{records}: no such file; name a report's folder or the file that --jsonl wrote")
    about = About(source=str(source))
    pictures: list[bytes] = []
    if source.is_dir() and (folder / "report.json").exists():
        try:
            about = msgspec.json.decode((folder / "report.json").read_bytes(), type=About)
        except (msgspec.MsgspecError, OSError) as e:
            raise InputDataError(
                f"{folder / 'report.json'}: not a report of this version ({e}); remove it to do without"
            ) from None
        kept = [t for t in about.thumbnails if (folder / "thumbnails" / Path(t["file"]).name).is_file()]
        about = msgspec.structs.replace(about, thumbnails=kept)
        pictures = [(folder / "thumbnails" / Path(t["file"]).name).read_bytes() for t in kept]
    truth = read_truth(truth_path) if truth_path is not None else None
    comparison = TruthComparison(truth) if truth is not None else None
    series = Series()
    for record in read_records(records):
        series.add(record)
        if comparison is not None:
            comparison.add(record)
    if not series.frames:
        raise InputDataError(f"{records}: holds no record")
    if not (folder / "report.json").exists() or not source.is_dir():
        about = msgspec.structs.replace(about, rate_hz=rate_hz(series))
    with writing(out or folder):
        target = out if out is not None else folder
        target.mkdir(parents=True, exist_ok=True)
        return _write_page(target, series, about, pictures, truth, comparison)


def read_records(path: Path) -> Iterable[Record]:
    """The records of a file of JSON lines. Raises InputDataError naming the line."""
    with path.open(encoding="utf-8") as f:
        number = 0
        try:
            for number, line in enumerate(f, 1):
                record: Any = json.loads(line)
                if not isinstance(record, dict) or "frame" not in record or "t" not in record:
                    raise InputDataError(f"{path} line {number}: not a record of --dry-run (no frame, no t)")
                yield record
        except (json.JSONDecodeError, UnicodeDecodeError) as e:
            raise InputDataError(f"{path} line {number}: not JSON ({e})") from None


def rate_hz(series: Series) -> float:
    """Frames a second of source time; 30 where one frame cannot tell."""
    t = series["t"]
    return float((len(t) - 1) / (t[-1] - t[0])) if len(t) > 1 and t[-1] > t[0] else 30.0


def _write_page(
    folder: Path, series: Series, about: About, pictures: list[bytes], truth: dict[int, TruthRow] | None,
    comparison: TruthComparison | None,
) -> Path:  # fmt: skip
    addresses = ["data:image/jpeg;base64," + b64encode(p).decode("ascii") for p in pictures]
    path = folder / "index.html"
    path.write_text(page(series, about, addresses, truth, comparison), encoding="utf-8")
    return path


def _thumbnail(image: Image) -> bytes:
    height = round(image.shape[0] * THUMBNAIL_WIDTH_PX / image.shape[1])
    small = (
        cv2.resize(image, (THUMBNAIL_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        if image.shape[1] > THUMBNAIL_WIDTH_PX
        else image
    )
    ok, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 72])
    if not ok:
        raise RuntimeError("a thumbnail could not be encoded")
    return data.tobytes()
