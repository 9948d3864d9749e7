"""A run in plain words and a few tiles: for who reads only the top of the page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tmde_edge.app.report.about import About
from tmde_edge.app.report.series import Series
from tmde_edge.app.truth import TruthComparison, stats


@dataclass(frozen=True, slots=True)
class Tile:
    """One number with its name; `style` colours it."""

    value: str
    name: str
    style: str = ""


def tiles(s: Series, comparison: TruthComparison | None) -> list[Tile]:
    """The numbers one looks at first."""
    t, distance, ttc = s["t"], s["distance_m"], s["ttc_s"]
    shown = [Tile(f"{float(t[-1]) if len(t) else 0.0:.1f} s", f"{s.frames} frames")]
    shown.append(Tile(f"{100 * _share(s):.0f} %", "of the frames with a vehicle ahead"))
    if s.has("distance_m"):
        shown.append(Tile(f"{np.nanmin(distance):.1f} m", "nearest"))
    if s.has("ttc_s"):
        shown.append(Tile(f"{np.nanmin(ttc):.1f} s", "shortest time to collision"))
    warnings, cautions = _count(s, "warning"), _count(s, "caution")
    shown.append(Tile(str(warnings), _plural(warnings, "warning"), "warning" if warnings else "good"))
    shown.append(Tile(str(cautions), _plural(cautions, "caution"), "caution" if cautions else "good"))
    shown.append(Tile(", ".join(s.faults) or "none", "faults", "caution" if s.faults else "good"))
    error = stats(comparison.column("lead"), comparison.column("true")) if comparison is not None and comparison.count else None
    if error is not None:
        shown.append(Tile(f"{100 * error.median_abs:.1f} %", "typical error against the truth"))
    return shown


def sentences(s: Series, about: About, comparison: TruthComparison | None) -> list[str]:
    """What happened, in order of importance."""
    said = [*_drive(s), *_alerts(s)]
    if about.fx_px is None and s.faults.get("uncalibrated"):
        said.append("The camera is not calibrated: there are no distances in metres. Time to collision works all the same.")
    for name, frames in s.faults.most_common():
        if name != "uncalibrated":
            said.append(f"The fault “{name}” was in force in {frames} of {s.frames} frames ({100 * frames / s.frames:.0f} %).")
    if s.errors:
        said.append(f"{s.errors} frames could not be used; the list of events names the reasons.")
    if comparison is not None:
        said += _truth(comparison)
    ms = s["total_ms"]
    if np.isfinite(ms).any():
        p50, p95 = np.nanquantile(ms, [0.5, 0.95])
        period_ms = 1000 / about.rate_hz
        said.append(f"Looking at a frame took {p50:.0f} ms (95 %: below {p95:.0f} ms); one comes every {period_ms:.0f} ms.")
    return said


def _drive(s: Series) -> list[str]:
    t = s["t"]
    span = f"{float(t[-1] - t[0]):.0f} s" if len(t) else "0 s"
    if not s.has("has_lead"):
        return [f"In {span} of recording no vehicle ahead was followed; plates were seen in {s.with_plate} of {s.frames} frames."]
    said = [f"In {span} of recording a vehicle ahead was followed in {100 * _share(s):.0f} % of the frames"]
    distance, sigma = s["distance_m"], s["sigma_m"]
    if s.has("distance_m"):
        typical = float(np.nanmedian(sigma / distance))
        said[0] += (
            f", between {np.nanmax(distance):.1f} m and {np.nanmin(distance):.1f} m. The program itself puts the typical "
            f"uncertainty of a distance at {100 * typical:.1f} % (one standard deviation)"
        )
    said[0] += "."
    if s.standards:
        name, count = s.standards.most_common(1)[0]
        said.append(f"The plates fit the standard {name} best ({100 * count / s.standards.total():.0f} % of those measured).")
    return said


def _alerts(s: Series) -> list[str]:
    first = next((c for c in s.changes if c.kind == "warning"), None)
    cautions = _count(s, "caution")
    if first is None:
        return [
            "There was no warning" + (f", and {cautions} {_plural(cautions, 'caution')}." if cautions else " and no caution.")
        ]
    k = int(np.argmin(np.abs(s["frame"] - first.frame)))
    where = f" at {s['distance_m'][k]:.1f} m" if np.isfinite(s["distance_m"][k]) else ""
    warnings = _count(s, "warning")
    times = "once" if warnings == 1 else f"{warnings} times"
    also = f"{cautions or 'no'} {_plural(cautions or 2, 'caution')}"
    return [f"It warned {times}, first at {first.t_s:.1f} s{where}: {first.text}. There {_was(cautions)} {also}."]


def _truth(c: TruthComparison) -> list[str]:
    s = stats(c.column("lead"), c.column("true"), c.column("sigma"))
    if s is None:
        return ["No frame of the recording has both a true and a measured distance."]
    way = "long" if s.bias > 0 else "short"
    said = [
        f"Against {s.count} true distances the typical (median) error is {100 * s.median_abs:.1f} %, 95 % of the errors are "
        f"below {100 * s.p95_abs:.1f} %, and on average the distance is {abs(100 * s.bias):.1f} % too {way}."
    ]
    if s.inside_1_sigma is not None and s.inside_2_sigma is not None:
        said.append(
            f"{100 * s.inside_1_sigma:.0f} % of the errors lie inside one stated standard deviation and "
            f"{100 * s.inside_2_sigma:.0f} % inside two (an honest one has 68 % and 95 %)."
        )
    return said


def _share(s: Series) -> float:
    return float(np.isfinite(s["has_lead"]).mean()) if s.frames else 0.0


def _count(s: Series, kind: str) -> int:
    return sum(c.kind == kind for c in s.changes)


def _was(count: int) -> str:
    return "was" if count == 1 else "were"


def _plural(count: int, word: str) -> str:
    return word if count == 1 else word + "s"
