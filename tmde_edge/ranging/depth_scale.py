"""From relative inverse depth to metres: the paper's smoothed scale, and a robust recursive fit of scale and shift."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


class DepthSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[depth]` table."""

    kind: Literal["none", "onnx", "recorded"] = "none"  # where relative depth comes from; none: depth is off
    model: str = "midas-v21-small"  # kind onnx: a name of `tmde-edge models list`, or a path to an .onnx file
    path: str = ""  # kind recorded: the depth track; kind onnx: "" or the folder that holds the models
    alignment: Literal["affine", "paper"] = "affine"  # 1/D = a m + b by robust recursive fit, or the paper's scale
    rate_hz: Positive = 4.0  # how often the network runs, on the newest frame
    latency_s: NotNegative = 0.15  # --dry-run: a reading is ready this long after its frame
    threads: Annotated[int, Meta(ge=1)] = 1  # of the network; bounded so that depth never starves the main loop
    grid_columns: Annotated[int, Meta(ge=8)] = 64  # the network's output is kept at this size
    grid_rows: Annotated[int, Meta(ge=6)] = 48
    memory_s: Positive = 4.0  # the fit forgets with this time constant
    ground_points: bool = True  # the road below the horizon also aligns (needs camera.height_m and a known pose)
    min_sigma: Positive = 0.05  # relative, of any distance by depth
    max_age_s: Positive = 1.0  # an older reading says nothing
