"""What `tmde-edge plates` and `tmde-edge range-budget` show."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

from tmde_edge.config import Config
from tmde_edge.errors import ConfigError
from tmde_edge.plates.standard import PlateStandard, load_standards, select, sizes
from tmde_edge.ranging.budget import budget


def list_lines() -> Iterator[str]:
    """One line a standard."""
    for s in load_standards().values():
        outline = s.outline_belief()
        size = f"{outline[0][0]:.0f} x {outline[1][0]:.0f} mm" if outline is not None else "size varies"
        yield f"{s.id:14} {s.country:4} {size:16} {s.name}"


def show_lines(ids: Sequence[str]) -> Iterator[str]:
    """Every size of each standard with tolerance, state of verification and source. Raises ConfigError for unknown ids."""
    for s in select(ids) if ids else tuple(load_standards().values()):
        yield from _show(s)


def _show(s: PlateStandard) -> Iterator[str]:
    yield f"{s.id} ({s.country}): {s.name}"
    for name, size in sizes(s):
        nominal = f"{size.mm:g}" if size.mm is not None else "-"
        limits = f"{_limit(size.min)} .. {_limit(size.max)}"
        yield f"  {name:26} {nominal:>7} mm   limits {limits:16} {'verified' if size.verified else 'unverified':10}  {size.source or s.source}"


def _limit(value: float | None) -> str:
    return f"{value:g}" if value is not None else "not set"


def budget_lines(config: Config, *, as_json: bool) -> Iterator[str]:
    """The expected sigma of each cue against distance for the configured camera and plates."""
    camera = config.camera.camera()
    if camera is None:
        raise ConfigError("camera.fx_px is not set: a range budget needs a calibrated camera; give --set camera.fx_px=...")
    for standard in select(config.plates.expect):
        rows = budget(camera, standard, config.ranging)
        for row in rows:
            yield json.dumps({"standard": standard.id, **row.as_dict()}) if as_json else row.as_text()
