"""A recorded depth track: relative inverse depth grids with their times, as a simulator or an offline run wrote them.

The file is a NumPy .npz: `t_ns` (n,) int64 since the start of the recording, `inverse_depth` (n, rows, columns) float32,
`size_px` (2,) the width and height of the images, `model` a text. Nothing in it is executed.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tmde_edge.errors import InputDataError, InputMissingError
from tmde_edge.messages import DepthReading, Frame

NEAREST_NS = 60_000_000  # a frame takes the reading no further off than this


def write_track(
    path: Path, t_ns: Sequence[int], inverse_depth: NDArray[np.float32], size_px: tuple[int, int], model: str
) -> None:
    """Writes a track whole or not at all. Raises ValueError when it is not finite or its lengths differ."""
    grids = np.asarray(inverse_depth, dtype=np.float32)
    times = np.asarray(t_ns, dtype=np.int64)
    if grids.ndim != 3 or len(grids) != len(times) or not np.isfinite(grids).all() or (np.diff(times) <= 0).any():
        raise ValueError(f"depth track: {grids.shape} grids for {len(times)} times, finite and in growing order, are needed")
    part = path.with_name(path.name + ".part")
    with part.open("wb") as f:
        np.savez_compressed(f, t_ns=times, inverse_depth=grids, size_px=np.array(size_px, dtype=np.int64), model=np.array(model))
    os.replace(part, path)


class RecordedDepth:
    """Plays a track on source time: a reading is ready a fixed latency after the frame it belongs to."""

    def __init__(self, path: Path, *, rate_hz: float, latency_s: float) -> None:
        """Raises InputMissingError, InputDataError."""
        if not path.is_file():
            raise InputMissingError(f"depth track {path}: no such file; check depth.path")
        try:
            with np.load(path, allow_pickle=False) as data:
                self._t_ns = np.asarray(data["t_ns"], dtype=np.int64)
                self._grids = np.asarray(data["inverse_depth"], dtype=np.float64)
                self._size_px = int(data["size_px"][0]), int(data["size_px"][1])
                self._model = str(data["model"])
        except (OSError, ValueError, KeyError, IndexError, zipfile.BadZipFile, EOFError) as e:
            raise InputDataError(f"depth track {path}: cannot be read ({e}); it is written by `tmde-edge simulate`") from None
        if self._grids.ndim != 3 or len(self._grids) != len(self._t_ns) or not np.isfinite(self._grids).all():
            raise InputDataError(f"depth track {path}: its grids and times do not fit together or are not finite")
        self._pace = Pace(rate_hz)
        self._latency_ns = round(latency_s * 1e9)
        self._start_ns: int | None = None
        self._waiting: list[DepthReading] = []

    def submit(self, frame: Frame) -> None:
        """Offers a frame; its reading waits where one is due and recorded."""
        if self._start_ns is None:
            self._start_ns = frame.t_ns
        if len(self._t_ns) == 0 or not self._pace.is_due(frame.t_ns):
            return
        at_ns = frame.t_ns - self._start_ns
        nearest = int(np.argmin(np.abs(self._t_ns - at_ns)))
        if abs(int(self._t_ns[nearest]) - at_ns) > NEAREST_NS:
            return
        self._pace.took(frame.t_ns)
        grid = self._grids[nearest]
        self._waiting.append(
            DepthReading(
                t_ns=frame.t_ns, ready_t_ns=frame.t_ns + self._latency_ns, width_px=self._size_px[0],
                height_px=self._size_px[1], grid_columns=grid.shape[1], grid_rows=grid.shape[0],
                inverse_depth=tuple(float(v) for v in grid.ravel()), model=self._model,
            )
        )  # fmt: skip

    def ready(self, t_ns: int) -> Iterator[DepthReading]:
        """Readings available by t_ns, in order."""
        while self._waiting and self._waiting[0].ready_t_ns <= t_ns:
            yield self._waiting.pop(0)


class Pace:
    """Lets frames through at a rate on source time, with a tolerance of a fifth of the period."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = round(0.8e9 / rate_hz)
        self._last_ns: int | None = None

    def is_due(self, t_ns: int) -> bool:
        """True where a period has passed, or time went back."""
        return self._last_ns is None or not 0 <= t_ns - self._last_ns < self._period_ns

    def took(self, t_ns: int) -> None:
        """Starts the next period."""
        self._last_ns = t_ns
