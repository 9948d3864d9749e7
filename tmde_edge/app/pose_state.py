"""The learnt resting pose on disk: read at the start, written whole or not at all, never from the deciding thread.

The file is JSON: what driving has taught (blocks of pitch and yaw, radians), `percent` and `spread_rad` for people, and the
mounting that it belongs to. Another calibration, lens or picture size makes it void.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tmde_edge.config import Config
from tmde_edge.pose.resting import BLOCKS_KEPT, MAX_OFFSET_RAD, RestingPose

VERSION = 1
NAME = "pose.json"
PERIOD_S = 30.0  # between two writes: a block takes 5 s at best
_log = logging.getLogger(__name__)


def state_path(configured: str, base_dir: Path) -> Path | None:
    """The file of `[pose] state_file`: a path, "auto" for systemd's state folder where there is one, or "" for none."""
    if configured != "auto":
        return base_dir / configured if configured else None
    state = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(state) / NAME if state else None


def mounting(config: Config) -> dict[str, float | int | None]:
    """What must be the same for a learnt pose to hold."""
    c = config.camera
    return {
        "width_px": c.width_px, "height_px": c.height_px, "fx_px": c.fx_px, "fy_px": c.fy_px, "cx_px": c.cx_px, "cy_px": c.cy_px,
        "pitch_rad": c.pitch_rad, "roll_rad": c.roll_rad, "yaw_rad": c.yaw_rad,
    }  # fmt: skip


def to_tree(resting: RestingPose) -> dict[str, Any]:
    """Plain numbers, exact."""
    return asdict(resting)


def from_tree(tree: Mapping[str, Any]) -> RestingPose:
    """The pose of `to_tree`. Raises ValueError for anything else."""
    try:
        blocks = tuple((float(p), float(y)) for p, y in tree["blocks_rad"])
        samples, sums = int(tree["samples"]), (float(tree["pitch_sum_rad"]), float(tree["yaw_sum_rad"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"no resting pose: {type(error).__name__} {error}") from None
    values = [*(v for b in blocks for v in b), *(s / max(samples, 1) for s in sums)]
    if len(blocks) > BLOCKS_KEPT or samples < 0 or not all(math.isfinite(v) and abs(v) <= MAX_OFFSET_RAD for v in values):
        raise ValueError("no resting pose: its angles are no mounting's")
    return RestingPose(blocks_rad=blocks, pitch_sum_rad=sums[0], yaw_sum_rad=sums[1], samples=samples)


def load_resting(path: Path, config: Config) -> RestingPose | None:
    """What the file holds for this mounting; None, with a line in the log, where it is missing, damaged or of another one."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data, dict) or data.get("version") != VERSION:
            raise ValueError("of another version")
        if data["mounting"] != mounting(config):
            _log.info("%s: the learnt pose belongs to another calibration; learning anew", path)
            return None
        return from_tree(data["resting"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        _log.warning("%s: not a learnt pose (%s); learning anew", path, error)
        return None


def save_resting(path: Path, resting: RestingPose, config: Config) -> None:
    """Writes the file whole or not at all. Raises OSError."""
    spread_rad = resting.spread_rad
    data = {
        "version": VERSION, "mounting": mounting(config), "percent": resting.percent,
        "spread_rad": spread_rad if math.isfinite(spread_rad) else None, "resting": to_tree(resting),
    }  # fmt: skip
    part = path.with_name(path.name + ".part")
    with part.open("w", encoding="utf-8") as file:
        json.dump(data, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


class PoseKeeper:
    """Saves the resting pose now and then on its own thread, and once more at the end."""

    def __init__(self, path: Path, config: Config, current: Callable[[], RestingPose], period_s: float = PERIOD_S) -> None:
        """`current` is called on this thread: a frozen value comes back."""
        self._path, self._config, self._current, self._period_s = path, config, current, period_s
        self._saved = current()
        self._failing = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pose-state", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def close(self) -> None:
        """Saves what is new and ends the thread."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join(5.0)

    def _run(self) -> None:
        while not self._stopping.wait(self._period_s):
            self._save()
        self._save()

    def _save(self) -> None:
        now = self._current()
        if now.blocks_rad == self._saved.blocks_rad:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            save_resting(self._path, now, self._config)
            self._saved, self._failing = now, False
        except OSError as error:
            if not self._failing:  # once, not twice a minute
                _log.warning("pose.state_file %s: cannot be written (%s)", self._path, error.strerror or error)
            self._failing = True
