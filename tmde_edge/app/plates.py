"""What `tmde-edge plates` and `tmde-edge range-budget` show."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

from tmde_edge.config import Config
from tmde_edge.errors import ConfigError
from tmde_edge.plates.standard import PlateStandard, load_standards, select, sizes
from tmde_edge.ranging.budget import one_line, range_budget


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
        state = "verified" if size.verified else "unverified"
        yield f"  {name:26} {nominal:>7} mm   limits {limits:16} {state:10}  {size.source or s.source}"


def _limit(value: float | None) -> str:
    return f"{value:g}" if value is not None else "not set"


CUE_COLUMNS = ("char_height", "plate_width", "plate_height", "stroke_width", "char_spacing", "border")


def budget_lines(config: Config, *, as_json: bool) -> Iterator[str]:
    """The expected sigma against distance for the configured camera, per expected standard and cue.

    Raises ConfigError while uncalibrated.
    """
    camera = config.camera.camera()
    if camera is None:
        raise ConfigError("camera.fx_px is not set: a range budget needs a calibrated camera; give --set camera.fx_px=...")
    for standard in select(config.plates.expect):
        rows = range_budget(camera, [standard], config.ranging)
        if as_json:
            for row in rows:
                cues = {c.cue: c.sigma_m for c in row.cues}
                row_values = {f: getattr(row, f) for f in ("distance_m", "plate_width_px", "char_height_px", "sigma_m", "reason")}
                yield json.dumps({"standard": standard.id, **row_values, "cues": cues})
            continue
        yield one_line(camera, [standard], config.ranging)
        yield f"{'distance':>9} {'plate':>8} {'glyph':>8} {'sigma':>9}  " + " ".join(f"{c:>12}" for c in CUE_COLUMNS)
        for row in rows:
            by = {c.cue: c.sigma_m for c in row.cues}
            cells = " ".join(f"{by[c]:10.3f} m" if c in by else f"{'-':>12}" for c in CUE_COLUMNS)
            sigma = f"{row.sigma_m:7.3f} m" if row.sigma_m is not None else f"{'none':>9}"
            note = f"  {row.reason}" if row.reason else ""
            yield f"{row.distance_m:7.1f} m {row.plate_width_px:5.0f} px {row.char_height_px:5.1f} px {sigma}  {cells}{note}"
