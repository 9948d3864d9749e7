"""What the report says of the run as a whole."""

from __future__ import annotations

from typing import Any

import msgspec

from tmde_edge import __version__
from tmde_edge.alerts.settings import AlertSettings
from tmde_edge.config import Config


class About(msgspec.Struct, frozen=True, kw_only=True):
    """Kept as report.json beside the records, so that the page can be made again."""

    source: str
    version: str = __version__
    made: str = ""  # date and time, local
    width_px: int = 0
    height_px: int = 0
    fx_px: float | None = None
    focal_sigma: float = 0.0
    expect: list[str] = msgspec.field(default_factory=list)
    can_log: str | None = None
    depth: str = "none"
    rate_hz: float = 30.0
    alerts: AlertSettings = msgspec.field(default_factory=AlertSettings)
    thumbnails: list[dict[str, Any]] = msgspec.field(default_factory=list)  # file, frame, t_s, text


def about_run(config: Config, source: str, can_log: str | None, made: str) -> About:
    """The facts of a dry run before its first frame."""
    camera = config.camera.camera()
    return About(
        source=source, made=made, fx_px=camera.fx_px if camera is not None else None,
        focal_sigma=camera.focal_sigma if camera is not None else config.camera.focal_sigma,
        expect=list(config.plates.expect), can_log=can_log, depth=config.depth.kind, alerts=config.alerts,
    )  # fmt: skip
