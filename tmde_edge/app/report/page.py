"""Puts the page together: summary, plots in two widths (desk and phone), tables, thumbnails."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np

from tmde_edge.app.report import charts
from tmde_edge.app.report.about import About
from tmde_edge.app.report.series import Series
from tmde_edge.app.report.summary import sentences, tiles
from tmde_edge.app.truth import ErrorStats, TruthComparison, TruthRow, stats

WIDE, NARROW = 940, 400
MOST_EVENTS = 80
MOST_POINTS = 4000  # of the values under the pointer
BINS_M = ((0, 5), (5, 10), (10, 15), (15, 20), (20, 30), (30, 1000))


def page(
    s: Series, about: About, pictures: Sequence[str], truth: dict[int, TruthRow] | None, comparison: TruthComparison | None
) -> str:
    """The whole HTML; `pictures` are addresses (data: URLs) of about.thumbnails."""
    if comparison is not None and not comparison.count:
        comparison = None
    body = [_head(s, about, comparison), _distance(s, about, truth), _alert_section(s, about)]
    if pictures:
        body.append(_thumbnails(about, pictures))
    if comparison is not None:
        body.append(_truth(comparison))
    body += [_plates(s, about, truth), _motion(s), _timing(s, about), _events(s)]
    text = files("tmde_edge.app.report").joinpath("page.html").read_text(encoding="utf-8")
    title = escape(f"tmde-edge: {about.source}")
    # The data goes last: nothing in it is taken for a place holder, and </script> cannot end the script.
    return text.replace("{{title}}", title).replace("{{body}}", "".join(body)).replace("{{data}}", _data(s))


def _data(s: Series) -> str:
    step = max(1, -(-s.frames // MOST_POINTS))
    columns = {
        "f": ("frame", 0, 1.0), "t": ("t", 3, 1.0), "d": ("distance_m", 2, 1.0), "s": ("sigma_m", 2, 1.0),
        "v": ("range_rate_mps", 2, 1.0), "ttc": ("ttc_s", 2, 1.0), "kmh": ("speed_mps", 1, 3.6),
        "n": ("characters", 0, 1.0),
    }  # fmt: skip
    tree = {
        key: [round(float(v) * factor, digits) if np.isfinite(v) else None for v in s[name][::step]]
        for key, (name, digits, factor) in columns.items()
    }
    return json.dumps(tree, separators=(",", ":")).replace("</", "<\\/")


def _chart(draw: Callable[[int], str]) -> str:
    """One plot for wide and one for narrow screens: scaled down, its text could not be read."""
    return f'<div class="chart wide">{draw(WIDE)}</div><div class="chart narrow">{draw(NARROW)}</div>'


def _section(title: str, *parts: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{''.join(parts)}</section>"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], style: str = "") -> str:
    top = "".join(f"<th>{escape(h)}</th>" for h in head)
    lines = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table class="{style}"><thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table></div>'


def _head(s: Series, about: About, comparison: TruthComparison | None) -> str:
    facts = [f"{about.width_px}x{about.height_px} px at {about.rate_hz:.3g} Hz" if about.width_px else f"{about.rate_hz:.3g} Hz"]
    facts.append(f"f = {about.fx_px:g} px" if about.fx_px is not None else "not calibrated")
    facts += [f"plates {', '.join(about.expect)}"] if about.expect else []
    facts += [f"CAN {about.can_log}"] if about.can_log else []
    facts += [f"depth {about.depth}"] if about.depth != "none" else []
    facts.append(f"tmde-edge {about.version}" + (f", {about.made}" if about.made else ""))
    shown = "".join(
        f'<div class="tile {t.style}"><b>{escape(t.value)}</b><span>{escape(t.name)}</span></div>' for t in tiles(s, comparison)
    )
    said = "".join(f"<p>{escape(text)}</p>" for text in sentences(s, about, comparison))
    return (
        f"<h1>{escape('/'.join(Path(about.source).parts[-2:]))}</h1><p class='soft'>{escape('; '.join(facts))}</p>"
        f'<div class="tiles">{shown}</div>{_section("In short", said)}'
    )


def _distance(s: Series, about: About, truth: dict[int, TruthRow] | None) -> str:
    if not s.has("distance_m"):
        why = "The camera is not calibrated." if about.fx_px is None else "No vehicle ahead was followed."
        return _section("Distance", f"<p>No distances. {why}</p>")
    parts = [_chart(lambda w: charts.distance(s, truth, w)), "<h2>Range rate</h2>", _chart(lambda w: charts.range_rate(s, w))]
    if s.cues():
        parts.append(
            "<h2>What each cue says</h2><p class='soft'>Each cue's own distance against the lead's. A cue that is always off by "
            "the same share points at a wrong plate standard or focal length.</p>"
        )
        parts.append(_chart(lambda w: charts.residuals(s, w)))
    return _section("Distance", *parts)


def _alert_section(s: Series, about: About) -> str:
    return _section(
        "Time to collision and alerts", _chart(lambda w: charts.ttc(s, about.alerts, w)), _chart(lambda w: charts.alerts(s, w))
    )


def _thumbnails(about: About, pictures: Sequence[str]) -> str:
    shown = []
    for t, address in zip(about.thumbnails, pictures, strict=True):
        text = escape(t["text"])
        caption = f"{t['t_s']:.2f} s, frame {t['frame']}: {text}"
        shown.append(f'<figure><img src="{address}" alt="{text}"><figcaption>{caption}</figcaption></figure>')
    return _section("Pictures", f'<div class="thumbs">{"".join(shown)}</div>')


def _plates(s: Series, about: About, truth: dict[int, TruthRow] | None) -> str:
    plates = s.plates()
    if not len(plates):
        return _section("Plates", "<p>No plate was seen.</p>")
    size = (about.width_px, about.height_px) if about.width_px else (int(plates[:, 0].max()) + 1, int(plates[:, 1].max()) + 1)
    rows = [
        [escape(name), str(count), f"{100 * count / s.standards.total():.0f} %"] for name, count in s.standards.most_common(6)
    ]
    narrowest, widest = plates[:, 2].min(), plates[:, 2].max()
    return _section(
        "Plates",
        f"<p>Seen in {s.with_plate} of {s.frames} frames; {narrowest:.0f} to {widest:.0f} px wide.</p>",
        _table(["standard", "plates", "share"], rows) if rows else "",
        "<h2>Characters</h2>",
        _chart(lambda w: charts.characters(s, truth, w)),
        _chart(lambda w: charts.char_height(s, w)),
        "<h2>Where they were in the image</h2>",
        _chart(lambda w: charts.where(s, size, w)),
    )


def _motion(s: Series) -> str:
    parts = []
    if s.has("speed_mps"):
        parts.append(_chart(lambda w: charts.own_motion(s, w)))
    if s.has("yaw_rate_radps"):
        parts.append(_chart(lambda w: charts.yaw_rate(s, w)))
    if not parts:
        parts.append("<p>No speed and no yaw rate: no CAN log was given, or it does not hold them.</p>")
    if s.has("pitch_rad"):
        parts.append(_chart(lambda w: charts.pitch(s, w)))
    return _section("Own motion", *parts)


def _timing(s: Series, about: About) -> str:
    rows = []
    for stage, ms in sorted(s.timing().items(), key=lambda kv: kv[0] != "total"):
        p50, p95, p99 = np.quantile(ms, [0.5, 0.95, 0.99])
        rows.append([escape(stage), f"{p50:.2f}", f"{p95:.2f}", f"{p99:.2f}", f"{ms.max():.1f}", str(len(ms))])
    if not rows:
        return ""
    return _section(
        "Timing", _table(["stage", "p50 ms", "p95 ms", "p99 ms", "max ms", "frames"], rows),
        _chart(lambda w: charts.total_time(s, 1000 / about.rate_hz, w)),
    )  # fmt: skip


def _events(s: Series) -> str:
    styles = {"warning": "warning-text", "caution": "caution-text", "fault": "fault-text", "error": "fault-text"}
    rows = [
        [f"{c.t_s:.2f} s", str(c.frame), f'<span class="{styles.get(c.kind, "")}">{escape(c.text)}</span>']
        for c in s.changes[:MOST_EVENTS]
    ]
    more = (
        f"<p class='soft'>and {len(s.changes) - MOST_EVENTS} more; records.jsonl has them all</p>"
        if len(s.changes) > MOST_EVENTS
        else ""
    )
    return _section("Events", _table(["time", "frame", "what"], rows, "events") if rows else "<p>Nothing happened.</p>", more)


# -- against the truth ---------------------------------------------------------------------------------------------------


def _truth(c: TruthComparison) -> str:
    true = c.column("true")
    series = [
        ("lead (filtered)", stats(c.column("lead"), true, c.column("sigma"))),
        ("character height alone", stats(c.column("char_height"), true)),
        ("plate width alone", stats(c.column("plate_width"), true)),
    ]
    head = ["", "frames", "median |error|", "bias", "sd", "CV", "p95", "MAE", "RMSE", "inside 1/2 sigma"]
    rows = [[escape(name), *_cells(x)] for name, x in series if x is not None]
    height, width = series[1][1], series[2][1]
    both = ""
    if height is not None and width is not None and width.sd > 0:
        both = (
            "<p>Character height against plate width, as in the paper's Table 2: the standard deviation of its errors is "
            f"{_ratio(height.sd, width.sd)}, its MAE {_ratio(height.mae_m, width.mae_m)}.</p>"
        )
    right = c.column("characters_right")
    counted = ""
    if np.isfinite(right).any():
        frames = int(np.isfinite(right).sum())
        counted = f"<p>The number of characters was right in {100 * np.nanmean(right):.0f} % of {frames} frames.</p>"
    return _section(
        "Against the truth",
        "<p class='soft'>Errors relative to the true distance. CV: spread of measured / true over its mean (Table 1).</p>",
        _table(head, rows),
        both,
        counted,
        "<h2>By distance</h2>",
        _by_distance(c),
        "<h2>Measured against true</h2>",
        _chart(lambda w: charts.predicted_against_true(c, w)),
        "<h2>Histogram of errors</h2>",
        _chart(lambda w: charts.error_histogram(c, w)),
        "<h2>Error against distance</h2>",
        _chart(lambda w: charts.error_over_distance(c, w)),
    )


def _ratio(a: float, b: float) -> str:
    if b <= 0 or a <= 0:
        return "not comparable"
    return f"{100 * (1 - a / b):.0f} % lower" if a < b else f"{a / b:.2f} times as large"


def _cells(s: ErrorStats) -> list[str]:
    inside = (
        f"{100 * s.inside_1_sigma:.0f} / {100 * s.inside_2_sigma:.0f} %"
        if s.inside_1_sigma is not None and s.inside_2_sigma is not None
        else ""
    )
    return [
        str(s.count), f"{100 * s.median_abs:.2f} %", f"{100 * s.bias:+.2f} %", f"{100 * s.sd:.2f} %", f"{100 * s.cv:.2f} %",
        f"{100 * s.p95_abs:.2f} %", f"{s.mae_m:.3f} m", f"{s.rmse_m:.3f} m", inside,
    ]  # fmt: skip


def _by_distance(c: TruthComparison) -> str:
    true, lead, sigma, height = c.column("true"), c.column("lead"), c.column("sigma"), c.column("char_height_px")
    rows = []
    for low, high in BINS_M:
        inside = (true >= low) & (true < high)
        s = stats(lead[inside], true[inside], sigma[inside]) if inside.any() else None
        if s is None:
            continue
        px = height[inside][np.isfinite(height[inside])]
        name = f"{low} to {high} m" if high < 1000 else f"over {low} m"
        rows.append([name, f"{np.median(px):.1f} px" if px.size else "", *_cells(s)])
    head = [
        "true distance",
        "character height",
        "frames",
        "median |error|",
        "bias",
        "sd",
        "CV",
        "p95",
        "MAE",
        "RMSE",
        "inside 1/2 sigma",
    ]
    return _table(head, rows)
