"""The report's plots, one function each: columns in, SVG text out. `width` is the picture's own, in pixels."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from tmde_edge.alerts.settings import AlertSettings
from tmde_edge.app.report.series import Series
from tmde_edge.app.report.svg import Plot, padded
from tmde_edge.app.truth import TruthComparison, TruthRow

Array = NDArray[np.float64]
TTC_TOP_S = 10.0  # beyond this nothing is decided by it
CUE_STYLES = {
    "char_height": "c1",
    "plate_width": "c2",
    "char_spacing": "c3",
    "stroke_width": "c4",
    "plate_height": "c5",
    "border": "c6",
    "bolt_spacing": "c7",
}


def cue_style(name: str) -> str:
    """The colour class of a cue."""
    return CUE_STYLES.get(name, "c6")


def _times(s: Series) -> tuple[float, float]:
    t = s["t"]
    return (float(t[0]), float(t[-1])) if len(t) else (0.0, 1.0)


def _alerts(plot: Plot, s: Series) -> None:
    for level in ("caution", "warning"):
        for a, b in s.spans(level):
            plot.span(a, b, f"during {level}")


def distance(s: Series, truth: dict[int, TruthRow] | None, width: int) -> str:
    """Lead's distance with its 1 and 2 sigma bands, every cue, depth, and the truth where it is known."""
    t, d, sigma = s["t"], s["distance_m"], s["sigma_m"]
    true = (
        np.array([truth[int(f)].distance_m if int(f) in truth else np.nan for f in s["frame"]])
        if truth
        else np.full(len(t), np.nan)
    )
    low, high = padded([d, d + 2 * sigma, d - 2 * sigma, true], least=1.0)
    plot = Plot(_times(s), (max(low, 0.0), high), width=width, height=300, x_label="time, s", y_label="distance, m", kind="time")
    _alerts(plot, s)
    plot.band(t, d - 2 * sigma, d + 2 * sigma, "band2", "2 sigma")
    plot.band(t, d - sigma, d + sigma, "band1", "1 sigma")
    for name, rows in s.cues().items():
        inside = rows[(rows[:, 1] <= high) & (rows[:, 1] >= low)]
        plot.dots(inside[:, 0], inside[:, 1], f"dot {cue_style(name)}", name.replace("_", " "), radius=1.2, most=600)
    plot.line(t, s["depth_m"], "line depth", "depth network" if s.has("depth_m") else "")
    plot.line(t, d, "line main", "lead")
    if np.isfinite(true).any():
        plot.line(t, true, "line truth", "true")
    return plot.text("Distance to the vehicle ahead over time, with its standard deviation")


def range_rate(s: Series, width: int) -> str:
    """Range rate with its bands; closing is negative."""
    t, v, sigma = s["t"], s["range_rate_mps"], s["range_rate_sigma_mps"]
    y = padded([v, np.zeros(1)], least=2.0, pad=0.12)
    plot = Plot(_times(s), y, width=width, x_label="time, s", y_label="range rate, m/s", kind="time")
    _alerts(plot, s)
    plot.band(t, v - 2 * sigma, v + 2 * sigma, "band2", "2 sigma")
    plot.band(t, v - sigma, v + sigma, "band1", "1 sigma")
    plot.across(0.0, "zero")
    plot.line(t, v, "line main", "range rate (negative: closing)")
    return plot.text("Range rate over time")


def ttc(s: Series, alerts: AlertSettings, width: int) -> str:
    """Time to collision against the thresholds of caution and warning."""
    t, value = s["t"], s["ttc_s"]
    plot = Plot(_times(s), (0.0, TTC_TOP_S), width=width, x_label="time, s", y_label="TTC, s", kind="time")
    _alerts(plot, s)
    plot.across(alerts.caution_ttc_s, "limit caution", f"caution {alerts.caution_ttc_s:g} s")
    plot.across(alerts.warning_ttc_s, "limit warning", f"warning {alerts.warning_ttc_s:g} s", below=True)
    plot.line(t, np.where(value > TTC_TOP_S, np.nan, value), "line main", f"TTC (above {TTC_TOP_S:g} s not drawn)")
    plot.line(t, np.where(s["headway_s"] > TTC_TOP_S, np.nan, s["headway_s"]), "line second", "headway")
    return plot.text("Time to collision over time, with the alert thresholds")


def alerts(s: Series, width: int) -> str:
    """What the driver was told, and the lead's presence, as strips."""
    plot = Plot(_times(s), (0.0, 3.0), width=width, height=130, x_label="time, s", kind="time",
                y_ticks=[(0.5, "lead"), (1.5, "caution"), (2.5, "warning")])  # fmt: skip
    t, lead = s["t"], np.isfinite(s["has_lead"])
    start: int | None = None
    for k in range(len(t) + 1):
        on = k < len(t) and bool(lead[k])
        if on and start is None:
            start = k
        elif not on and start is not None:
            plot.span(float(t[start]), float(t[min(k, len(t) - 1)]), "strip lead", 0.2, 0.8)
            start = None
    for level, low in (("caution", 1.2), ("warning", 2.2)):
        for a, b in s.spans(level):
            plot.span(a, b, f"strip {level}", low, low + 0.6)
    return plot.text("Alerts over time")


def _curve(
    s: Series,
    values: Array,
    y: tuple[float, float],
    label: str,
    y_label: str,
    title: str,
    width: int,
    *,
    alerts: bool = False,
    zero: bool = False,
) -> str:
    """One value over time; `alerts` shades what was said, `zero` draws the line at 0."""
    plot = Plot(_times(s), y, width=width, height=180, x_label="time, s", y_label=y_label, kind="time")
    if alerts:
        _alerts(plot, s)
    if zero:
        plot.across(0.0, "zero")
    plot.line(s["t"], values, "line main", label)
    return plot.text(title)


def own_motion(s: Series, width: int) -> str:
    """Own speed from CAN."""
    speed = s["speed_mps"] * 3.6
    y = padded([speed], least=10.0, zero=True)
    return _curve(s, speed, y, "own speed", "speed, km/h", "Own speed over time", width, alerts=True)


def yaw_rate(s: Series, width: int) -> str:
    """Yaw rate; left is positive."""
    yaw = np.degrees(s["yaw_rate_radps"])
    y = padded([yaw], least=4.0)
    return _curve(s, yaw, y, "yaw rate (left positive)", "yaw rate, deg/s", "Yaw rate over time", width, zero=True)


def pitch(s: Series, width: int) -> str:
    """Pitch of the camera against the road."""
    value = np.degrees(s["pitch_rad"])
    y = padded([value], least=1.0)
    return _curve(s, value, y, "pitch (nose down positive)", "pitch, deg", "Pitch of the camera over time", width)


def characters(s: Series, truth: dict[int, TruthRow] | None, width: int) -> str:
    """Characters found on the lead's plate in every frame, against the true count where it is known."""
    t, found = s["t"], s["characters"]
    true = np.array([_count(truth, int(f)) for f in s["frame"]]) if truth else np.full(len(t), np.nan)
    top = max(float(np.nanmax(np.concatenate([found, true, [4.0]]))), 4.0) + 1
    plot = Plot(_times(s), (0.0, top), width=width, height=180, x_label="time, s", y_label="characters", kind="time")
    if np.isfinite(true).any():
        plot.line(t, true, "line truth", "true count")
    plot.dots(t, found, "dot main", "found on the lead's plate", radius=1.8, most=2000)
    return plot.text("Characters found on the plate of the vehicle ahead, frame by frame")


def _count(truth: dict[int, TruthRow], frame: int) -> float:
    row = truth.get(frame)
    return float(row.characters) if row is not None and row.characters is not None else np.nan


def char_height(s: Series, width: int) -> str:
    """Mean character height in source pixels: what every distance rests on."""
    h = s["char_height_px"]
    y = padded([h], least=4.0, zero=True)
    return _curve(s, h, y, "mean character height", "height, px", "Character height in pixels over time", width)


def residuals(s: Series, width: int) -> str:
    """Every cue against the lead's distance, per cent."""
    cues = s.cues()
    percent = {name: 100 * (rows[:, 1] / rows[:, 2] - 1) for name, rows in cues.items()}
    limit = 20.0
    plot = Plot(_times(s), (-limit, limit), width=width, height=260, x_label="time, s", y_label="cue / lead - 1, %", kind="time")
    plot.across(0.0, "zero")
    for name, rows in cues.items():
        plot.dots(rows[:, 0], np.clip(percent[name], -limit, limit), f"dot {cue_style(name)}", name.replace("_", " "), most=800)
    return plot.text("Residuals of the cues against the fused distance over time")


def total_time(s: Series, budget_ms: float, width: int) -> str:
    """Milliseconds of perception in every frame."""
    t, ms = s["t"], s["total_ms"]
    high = float(np.nanquantile(ms, 0.99)) * 1.4 if np.isfinite(ms).any() else 1.0
    plot = Plot(
        _times(s),
        (0.0, max(high, budget_ms * 1.1)),
        width=width,
        height=180,
        x_label="time, s",
        y_label="ms a frame",
        kind="time",
    )
    plot.across(budget_ms, "limit", f"one frame: {budget_ms:.0f} ms")
    plot.line(t, ms, "line main", "perception")
    return plot.text("Milliseconds of computing a frame")


def where(s: Series, size_px: tuple[int, int], width: int) -> str:
    """Where in the image plates were; the lead's in another colour."""
    w, h = size_px
    plot = Plot((0.0, float(w)), (float(-h), 0.0), width=width, height=420, square=True, x_label="image column, px",
                y_ticks=[(-v, f"{v:g}") for v in (0, h // 4, h // 2, 3 * h // 4, h)])  # fmt: skip
    plates = s.plates()
    for mask, style, label in (
        (plates[:, 3] < 0.5, "dot other", "other plates"),
        (plates[:, 3] > 0.5, "dot main", "the lead's plate"),
    ):
        if mask.any():
            plot.dots(plates[mask, 0], -plates[mask, 1], style, label, radius=2.0)
    return plot.text("Positions of plates in the image")


# -- against the truth ---------------------------------------------------------------------------------------------------


def predicted_against_true(c: TruthComparison, width: int) -> str:
    """Measured distance against the true one, all frames."""
    true = c.column("true")
    measured = np.isfinite(c.column("lead"))  # what was never measured would only make room
    top = float(np.nanmax(np.concatenate([true[measured], c.column("lead")[measured], [1.0]]))) * 1.05
    plot = Plot(
        (0.0, top),
        (0.0, top),
        width=width,
        height=min(width, 420),
        square=True,
        x_label="true distance, m",
        y_label="measured, m",
    )
    plot.segment((0.0, 0.0), (top, top), "line truth")
    for name, style, label in _SERIES:
        plot.dots(true, c.column(name), f"dot {style}", label, radius=2.0 if name == "lead" else 1.3)
    return plot.text("Measured against true distance")


_SERIES = (("plate_width", "c2", "plate width alone"), ("char_height", "c1", "character height alone"), ("lead", "main", "lead"))


def error_histogram(c: TruthComparison, width: int) -> str:
    """Relative errors of the lead's distance, counted."""
    error = 100 * (c.column("lead") / c.column("true") - 1)
    error = error[np.isfinite(error)]
    limit = max(float(np.quantile(np.abs(error), 0.98)) * 1.2, 1.0) if error.size else 1.0
    counts, edges = np.histogram(np.clip(error, -limit, limit), bins=31, range=(-limit, limit))
    top = max(float(counts.max()), 1.0) * 1.08
    plot = Plot(
        (-limit, limit), (0.0, top), width=width, height=240, x_label="error, % (outliers at the edges)", y_label="frames"
    )
    for n, a, b in zip(counts, edges[:-1], edges[1:], strict=True):
        if n:
            plot.span(float(a), float(b), "bar", 0.0, float(n))
    plot.segment((0.0, 0.0), (0.0, float(counts.max())), "zero")
    return plot.text("Histogram of the errors")


def error_over_distance(c: TruthComparison, width: int) -> str:
    """Relative error against the true distance, with the stated sigma as a band of medians."""
    true, error = c.column("true"), 100 * (c.column("lead") / c.column("true") - 1)
    sigma = 100 * c.column("sigma") / c.column("lead")
    ok = np.isfinite(error)
    if not ok.any():
        return Plot((0.0, 1.0), (-1.0, 1.0), width=width).text("No errors to show")
    limit = max(float(np.quantile(np.abs(error[ok]), 0.98)) * 1.2, 2.0)
    plot = Plot(
        padded([true[ok]], least=1.0), (-limit, limit), width=width, height=240, x_label="true distance, m", y_label="error, %"
    )
    edges = np.linspace(true[ok].min(), true[ok].max() + 1e-9, 21)
    middle = (edges[:-1] + edges[1:]) / 2
    typical = np.array([_median(sigma[ok & (true >= a) & (true < b)]) for a, b in itertools.pairwise(edges)])
    known = np.isfinite(typical)
    plot.band(middle[known], -2 * typical[known], 2 * typical[known], "band2", "2 sigma, as stated")
    plot.band(middle[known], -typical[known], typical[known], "band1", "1 sigma, as stated")
    plot.across(0.0, "zero")
    plot.dots(true, np.clip(error, -limit, limit), "dot main", "error of the lead's distance")
    return plot.text("Error against distance")


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size else np.nan
