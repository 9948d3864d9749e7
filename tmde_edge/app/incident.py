"""The evidence of a warning: ten seconds before it and after, kept in memory until there is one, then in a folder of its own.

    incidents/000012-20261122T063512Z-warning/
        incident.json   what was said, and what the driver did      drive.mcap   every input, output and frame of these seconds
        config.toml     configuration and calibration in force      before.jpg, alert.jpg, after.jpg
"""

from __future__ import annotations

import json
import logging
import re
import shutil
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tmde_edge import __version__
from tmde_edge.app.drive_log import DriveLogWriter, Json, Part
from tmde_edge.app.odometer import write_verdict
from tmde_edge.app.overlay import draw
from tmde_edge.app.records import lead_record
from tmde_edge.app.ring import free_mb, utc_name
from tmde_edge.app.toml_out import write_config
from tmde_edge.app.verdict import Moment, judge, moment_of
from tmde_edge.config import RecordConfig
from tmde_edge.messages import Event, FrameResult, Output, RangeReference

_log = logging.getLogger(__name__)
FOLDER = "incidents"
_NAME = re.compile(r"(\d{6})-\d{8}T\d{6}Z-(caution|warning|manual)")
_STEPS = 30_000  # of memory: a flood on the bus must not eat it
_PICTURE_BYTES = 48_000_000
_LONGEST_S = 60.0  # alerts that follow one another make one incident, up to this
_THUMB_WIDTH_PX = 640
_THUMB_APART_S = 1.0
_RANK = {"none": 0, "caution": 1, "warning": 2, "manual": 3}
_MB = 1_000_000


def incident_folders(folder: Path) -> list[Path]:
    """The kept incidents below a recording folder, oldest first."""
    try:
        found = [p for p in (folder / FOLDER).iterdir() if _NAME.fullmatch(p.name) and p.is_dir()]
    except FileNotFoundError:
        return []
    return sorted(found, key=lambda p: p.name)


def warnings_of(info: Json) -> int:
    """How many warnings an incident holds; those that followed one another are all counted."""
    levels = [info.get("level"), *(a.get("level") for a in info.get("alerts") or [])]
    return levels.count("warning")


class _Open:
    """An incident being written."""

    def __init__(self, folder: Path, info: Json, t_ns: int, until_ns: int, config: Json, wall_ns: int, now_ns: int) -> None:
        self.folder, self.info, self.t_ns, self.until_ns = folder, info, t_ns, until_ns
        folder.mkdir(parents=True)
        part = Part(begins="cut", wall_ns=wall_ns, monotonic_ns=now_ns)
        self.writer = DriveLogWriter(folder / "drive.mcap", config, part=part)
        self.moments: list[Moment] = []
        self.thumbs: dict[str, tuple[int, bytes]] = {}
        self.results: dict[int, FrameResult] = {}
        self.pictures = 0

    def step(self, event: Event, outputs: tuple[Output, ...]) -> None:
        """Adds a step."""
        for output in outputs:
            if isinstance(output, FrameResult):
                self.moments.append(moment_of(output, self.t_ns))
                if abs(output.t_ns - self.t_ns) < 1.5e9 * _THUMB_APART_S:
                    self.results[output.t_ns] = output
        self.writer.write(event, outputs)

    def picture(self, t_ns: int, jpeg: bytes) -> None:
        """Adds a frame, and keeps it as a picture of the report where it is the nearest to one of three moments."""
        self.writer.picture(t_ns, jpeg)
        self.pictures += 1
        for name, at_s in (("before", -_THUMB_APART_S), ("alert", 0.0), ("after", _THUMB_APART_S)):
            want_ns = self.t_ns + round(at_s * 1e9)
            known = self.thumbs.get(name)
            if known is None or abs(t_ns - want_ns) < abs(known[0] - want_ns):
                self.thumbs[name] = (t_ns, jpeg)


class Evidence:
    """Remembers the last seconds; at an alert writes them down and goes on for some seconds. Used by one thread."""

    def __init__(
        self, settings: RecordConfig, config: Json, *, transmits: bool, wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._s, self._config, self._transmits, self._wall_ns = settings, config, transmits, wall_ns
        self._root = Path(settings.folder)
        self._steps: deque[tuple[Event, tuple[Output, ...]]] = deque(maxlen=_STEPS)
        self._pictures: deque[tuple[int, bytes]] = deque()
        self._picture_bytes = 0
        self._references: deque[RangeReference] = deque(maxlen=_STEPS)
        self._before_ns = round(settings.incident_before_s * 1e9)
        self._after_ns = round(settings.incident_after_s * 1e9)
        self._level = "none"
        self._newest_ns = 0
        self._open: _Open | None = None
        self._asked: str | None = None
        self.problem: str | None = None
        self.kept = 0

    def ask(self, note: str) -> None:
        """Someone wants the last seconds kept (`tmde-edge incident --now`); from any thread."""
        self._asked = note

    def write(self, event: Event, outputs: tuple[Output, ...]) -> None:
        """Takes one step."""
        self._newest_ns = max(self._newest_ns, event.t_ns)
        if self._open is not None:
            self._try(self._open.step, event, outputs)
        self._steps.append((event, outputs))
        while self._steps and self._newest_ns - self._steps[0][0].t_ns > self._before_ns:
            self._steps.popleft()
        for output in outputs:
            if isinstance(output, FrameResult):
                self._watch(output)
        note, self._asked = self._asked, None
        if note is not None:
            self._begin("manual", self._newest_ns, {"note": note, "reason": "asked for", "ttc_s": None})
        if self._open is not None and self._newest_ns > self._open.until_ns:
            self._finish(complete=True)

    def picture(self, t_ns: int, jpeg: bytes) -> None:
        """Takes a frame."""
        self._pictures.append((t_ns, jpeg))
        self._picture_bytes += len(jpeg)
        oldest_ns = self._newest_ns - self._before_ns
        while self._pictures and (self._pictures[0][0] < oldest_ns or self._picture_bytes > _PICTURE_BYTES):
            self._picture_bytes -= len(self._pictures.popleft()[1])
        if self._open is not None:
            self._try(self._open.picture, t_ns, jpeg)

    def reference(self, reference: RangeReference) -> None:
        """Takes what another instrument measured."""
        self._references.append(reference)
        while self._newest_ns - self._references[0].t_ns > self._before_ns:
            self._references.popleft()
            if not self._references:
                break
        if self._open is not None:
            self._try(self._open.writer.reference, reference)

    def close(self) -> None:
        """Ends an open incident early."""
        if self._open is not None:
            self._finish(complete=False)

    # -- inside -------------------------------------------------------------------------------------------------------

    def _watch(self, result: FrameResult) -> None:
        level, before = result.alert.level, self._level
        self._level = level
        if _RANK[level] <= _RANK[before] or _RANK[level] < _RANK[self._s.incident_level]:
            return
        what = {"reason": result.alert.reason, "ttc_s": result.alert.ttc_s}
        if self._open is not None:
            now = self._open
            now.info["alerts"].append({"after_s": round((result.t_ns - now.t_ns) * 1e-9, 3), "level": level, **what})
            now.until_ns = min(max(now.until_ns, result.t_ns + self._after_ns), now.t_ns + round(_LONGEST_S * 1e9))
            return
        self._begin(level, result.t_ns, what, result)

    def _begin(self, level: str, t_ns: int, what: Json, result: FrameResult | None = None) -> None:
        if self._open is not None:
            return
        wall_ns = self._wall_ns()
        number = max((int(p.name[:6]) for p in incident_folders(self._root)), default=0) + 1
        folder = self._root / FOLDER / f"{number:06d}-{utc_name(wall_ns)}-{level}"
        info: Json = {
            "time": utc_name(wall_ns), "version": __version__, "level": level, **what, "transmitted": self._transmits,
            "t_s": round(t_ns * 1e-9, 3), "lead": lead_record(result.lead) if result is not None else None,
            "speed_mps": result.ego.speed_mps if result is not None and result.ego is not None else None,
            "faults": list(result.faults) if result is not None else [], "alerts": [], "complete": False,
        }  # fmt: skip
        now: _Open | None = None
        try:
            self._make_room()
            now = _Open(folder, info, t_ns, t_ns + self._after_ns, self._config, wall_ns, self._newest_ns)
            for event, outputs in self._steps:
                now.step(event, outputs)
            for picture in self._pictures:
                now.picture(*picture)
            for reference in self._references:
                now.writer.reference(reference)
            now.writer.flush()  # the seconds before are on the disk now
            self._write_info(now)
            write_config(folder, self._config)
        except OSError as error:
            if now is not None:
                now.writer.abandon()
            self._fail(error)
            return
        self._open = now

    def _finish(self, *, complete: bool) -> None:
        now, self._open = self._open, None
        if now is None:
            return
        try:
            now.info |= {"complete": complete, "frames": now.pictures, **judge(now.moments)}
            write_verdict(self._root, now.folder.name, now.info["verdict"], warnings_of(now.info), self._wall_ns())
            for name, (t_ns, jpeg) in now.thumbs.items():
                (now.folder / f"{name}.jpg").write_bytes(_thumbnail(jpeg, now.results.get(t_ns)))
            now.writer.close()
            self._write_info(now)
        except OSError as error:
            now.writer.abandon()
            self._fail(error)
            return
        self.kept += 1
        self.problem = None
        fields = {"TMDE_EVENT": "incident", "TMDE_FOLDER": now.folder}
        _log.info("%s kept in %s", now.info["level"], now.folder, extra={"fields": fields})

    def _write_info(self, now: _Open) -> None:
        part = now.folder / "incident.json.part"
        part.write_text(json.dumps(now.info, indent=1, allow_nan=False), encoding="utf-8")
        part.replace(now.folder / "incident.json")

    def _make_room(self) -> None:
        """Removes the oldest incidents beyond the limit. Raises OSError where the disk is nearly full."""
        root = self._root / FOLDER
        root.mkdir(parents=True, exist_ok=True)
        sizes = {p: sum(f.stat().st_size for f in p.iterdir()) for p in incident_folders(self._root)}
        for path, size in list(sizes.items()):
            if sum(sizes.values()) <= self._s.incidents_max_mb * _MB:
                break
            shutil.rmtree(path)
            sizes[path] -= size
        free = free_mb(root)
        if free < self._s.min_free_mb:
            raise OSError(f"only {free:.0f} MB free on the disk of {root}, record.min_free_mb = {self._s.min_free_mb}")

    def _try(self, act: Callable[..., None], *values: Any) -> None:
        try:
            act(*values)
        except OSError as error:
            if self._open is not None:
                self._open.writer.abandon()
                self._open = None
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        if self.problem is None:
            _log.error("the evidence of a warning cannot be kept (%s); everything else goes on", error.strerror or error)
        self.problem = f"incidents: {error.strerror or error}"


def _thumbnail(jpeg: bytes, result: FrameResult | None) -> bytes:
    """A small picture with what was decided on it."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return jpeg
    picture = draw(np.asarray(image, np.uint8), result)
    height = max(round(picture.shape[0] * _THUMB_WIDTH_PX / picture.shape[1]), 1)
    small = cv2.resize(picture, (_THUMB_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return data.tobytes() if ok else jpeg
