"""Per-stage numbers of evaluated rows, whole or by size or distance; two configurations with paired bootstrap intervals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Row = dict[str, Any]
Floats = NDArray[np.float64]

MATCH_IOU = 0.5
DRAWS = 1000
CONFIDENCE = 0.95
_BLOCK_S = 1.0  # neighbouring frames repeat their errors: stretches are drawn, not frames
_PARTS: dict[str, tuple[tuple[str, ...], tuple[float, ...], str]] = {  # columns, edges, unit
    "width": (("true_width_px",), (30.0, 45.0, 60.0, 90.0, 150.0), "px"),
    "distance": (("true_m", "lead_true_m"), (5.0, 10.0, 20.0, 40.0), "m"),
}
_MIN_RECORDINGS = 5  # from so many recordings on these are drawn as a whole


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """One number: which value of a row, how it is summed up, which way is better (0: only told)."""

    stage: str
    name: str
    how: Literal["mean", "median", "p95"]
    better: int
    values: Callable[[Row], Sequence[float]]  # mostly one or none
    percent: bool = True


def _key(name: str) -> Callable[[Row], Sequence[float]]:
    return lambda row: () if row.get(name) is None else (float(row[name]),)


def _size(name: str) -> Callable[[Row], Sequence[float]]:
    return lambda row: () if row.get(name) is None else (abs(float(row[name])),)


def _inside(error: str, sigma: str, k: float) -> Callable[[Row], Sequence[float]]:
    def values(row: Row) -> Sequence[float]:
        if row.get(error) is None or row.get(sigma) is None:
            return ()
        return (float(abs(row[error]) <= k * row[sigma]),)

    return values


def _found_right(row: Row) -> Sequence[float]:
    """1 for a plate that was found, 0 for each false one: their mean is the precision."""
    right = (1.0,) if row.get("found") else ()
    return (*right, *(0.0 for _ in range(int(row.get("false_plates") or 0))))


def _errors(stage: str) -> tuple[Metric, ...]:
    """How large, how biased and how honest a stage's STAGE_error is beside its STAGE_sigma."""
    error, sigma = f"{stage}_error", f"{stage}_sigma"
    return (
        Metric(stage=stage, name="median |error|", how="median", better=-1, values=_size(error)),
        Metric(stage=stage, name="mean |error|", how="mean", better=-1, values=_size(error)),
        Metric(stage=stage, name="p95 |error|", how="p95", better=-1, values=_size(error)),
        Metric(stage=stage, name="bias", how="mean", better=0, values=_key(error)),
        Metric(stage=stage, name="inside 1 sigma", how="mean", better=0, values=_inside(error, sigma, 1)),
        Metric(stage=stage, name="inside 2 sigma", how="mean", better=0, values=_inside(error, sigma, 2)),
    )


METRICS: tuple[Metric, ...] = (
    Metric(stage="detection", name="recall", how="mean", better=1, values=_key("found")),
    Metric(stage="detection", name="precision", how="mean", better=1, values=_found_right),
    Metric(stage="detection", name="false a frame", how="mean", better=-1, values=_key("false_plates"), percent=False),
    Metric(stage="rectification", name="corner error / height", how="median", better=-1, values=_key("corner_error")),
    Metric(stage="segmentation", name="count exact", how="mean", better=1, values=_key("count_exact")),
    Metric(stage="segmentation", name="height error", how="median", better=-1, values=_size("char_height_error")),
    Metric(stage="range", name="ranged", how="mean", better=1, values=_key("ranged")),
    *_errors("range"),
    Metric(stage="lead", name="reported", how="mean", better=1, values=_key("lead_reported")),
    Metric(stage="lead", name="false a frame", how="mean", better=-1, values=_key("lead_false")),
    *_errors("lead"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One metric over all rows; interval: percentiles of the bootstrap; count: rows that have it."""

    metric: Metric
    value: float
    low: float
    high: float
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """B - A of one metric with its interval; worse: the interval lies wholly on the bad side."""

    metric: Metric
    a: float
    b: float
    low: float
    high: float

    @property
    def worse(self) -> bool:
        return self.metric.better != 0 and (self.high < 0 if self.metric.better > 0 else self.low > 0)

    @property
    def better(self) -> bool:
        return self.metric.better != 0 and (self.low > 0 if self.metric.better > 0 else self.high < 0)


def scores(rows: Sequence[Row], *, seed: int = 0, draws: int = DRAWS, confidence: float = CONFIDENCE) -> list[Score]:
    """Every metric that any row has, with its interval."""
    place = _clusters(rows)
    weights = _drawn(max(place.values(), default=0) + 1, draws, seed)
    out = []
    for metric in METRICS:
        values, cluster = _values(rows, metric, place)
        if not len(values):
            continue
        drawn = _estimates(values, cluster, weights, metric.how)
        low, high = _interval(drawn, confidence)
        out.append(Score(metric=metric, value=_estimate(values, metric.how), low=low, high=high, count=len(values)))
    return out


def compare(
    a: Sequence[Row], b: Sequence[Row], *, seed: int = 0, draws: int = DRAWS, confidence: float = CONFIDENCE
) -> list[Difference]:
    """B against A on the same recordings: each draw takes the same stretches of both."""
    place = _clusters([*a, *b])
    weights = _drawn(max(place.values(), default=0) + 1, draws, seed)
    out = []
    for metric in METRICS:
        (va, ca), (vb, cb) = _values(a, metric, place), _values(b, metric, place)
        if not len(va) or not len(vb):
            continue
        drawn = _estimates(vb, cb, weights, metric.how) - _estimates(va, ca, weights, metric.how)
        low, high = _interval(drawn, confidence)
        out.append(Difference(metric=metric, a=_estimate(va, metric.how), b=_estimate(vb, metric.how), low=low, high=high))
    return out


def parts(rows: Sequence[Row], by: str) -> list[tuple[str, list[Row]]]:
    """(words, rows) of each part of `rows` by true plate width in pixels or true distance in metres; "" is all of them."""
    if not by:
        return [("", list(rows))]
    keys, edges, unit = _PARTS[by]

    def place(row: Row) -> float | None:
        return next((float(row[k]) for k in keys if row.get(k) is not None), None)

    found = []
    for low, high in itertools.pairwise((0.0, *edges, math.inf)):
        inside = [r for r in rows if (at := place(r)) is not None and low <= at < high]
        if inside:
            found.append((f"from {low:g} {unit}" if high == math.inf else f"{low:g} to {high:g} {unit}", inside))
    return found


def _cluster_of(row: Row, by_recording: bool) -> tuple[str, int]:
    if by_recording or row.get("t_s") is None:
        return str(row["recording"]), 0 if row.get("t_s") is not None else int(row.get("frame", 0))
    return str(row["recording"]), int(row["t_s"] // _BLOCK_S)


def _clusters(rows: Sequence[Row]) -> dict[tuple[str, int], int]:
    by_recording = len({r["recording"] for r in rows if r.get("t_s") is not None}) >= _MIN_RECORDINGS
    names = sorted({_cluster_of(r, by_recording) for r in rows})
    place = {name: i for i, name in enumerate(names)}
    if by_recording:  # rows find their place by their own block
        place |= {_cluster_of(r, False): place[_cluster_of(r, True)] for r in rows}
    return place


def _values(rows: Sequence[Row], metric: Metric, place: dict[tuple[str, int], int]) -> tuple[Floats, NDArray[np.int64]]:
    found = [(v, place[_cluster_of(r, False)]) for r in rows for v in metric.values(r) if math.isfinite(v)]
    return np.array([v for v, _ in found], np.float64), np.array([c for _, c in found], np.int64)


def _drawn(clusters: int, draws: int, seed: int) -> Floats:
    """How often each cluster is drawn, (draws, clusters)."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.multinomial(clusters, np.full(clusters, 1 / clusters), size=draws), dtype=np.float64)


def _estimate(values: Floats, how: str) -> float:
    if how == "mean":
        return float(values.mean())
    return float(np.quantile(values, 0.5 if how == "median" else 0.95, method="inverted_cdf"))


def _estimates(values: Floats, cluster: NDArray[np.int64], weights: Floats, how: str) -> Floats:
    """The metric of each draw, (draws,); NaN where a draw holds none of its rows."""
    order = np.argsort(values)
    w = weights[:, cluster[order]]
    total = w.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        if how == "mean":
            return np.asarray(w @ values[order] / total)
        rank = np.cumsum(w, axis=1) >= (0.5 if how == "median" else 0.95) * total[:, None] - 1e-9
    found = values[order][rank.argmax(axis=1)]
    return np.asarray(np.where(total > 0, found, np.nan))


def _interval(drawn: Floats, confidence: float) -> tuple[float, float]:
    ok = drawn[np.isfinite(drawn)]
    if not len(ok):
        return -math.inf, math.inf
    tail = (1 - confidence) / 2
    low, high = np.quantile(ok, [tail, 1 - tail])
    return float(low), float(high)


def score_lines(found: Sequence[Score]) -> list[str]:
    """A table for people."""
    out = [f"{'stage':14} {'metric':22} {'value':>9}   {'95 % interval':>20}  {'rows':>7}"]
    for s in found:
        low, high = _text(s.metric, s.low), _text(s.metric, s.high)
        out.append(f"{s.metric.stage:14} {s.metric.name:22} {_text(s.metric, s.value):>9}   {low:>9} .. {high:>8}  {s.count:7d}")
    return out


def difference_lines(found: Sequence[Difference]) -> list[str]:
    """The comparison for people; WORSE and better only where the interval excludes no change."""
    out = [f"{'stage':14} {'metric':22} {'A':>9} {'B':>9} {'B - A':>9}   {'95 % interval':>20}"]
    for d in found:
        verdict = "WORSE" if d.worse else "better" if d.better else ""
        low, high = _text(d.metric, d.low), _text(d.metric, d.high)
        out.append(f"{d.metric.stage:14} {d.metric.name:22} {_text(d.metric, d.a):>9} {_text(d.metric, d.b):>9} "
                   f"{_text(d.metric, d.b - d.a):>9}   {low:>9} .. {high:>8}  {verdict}")  # fmt: skip
    return out


def _text(metric: Metric, value: float) -> str:
    return f"{100 * value:.2f} %" if metric.percent else f"{value:.4f}"


def as_json(found: Score | Difference) -> Row:
    """Plain numbers of a score or a difference."""
    head: Row = {"stage": found.metric.stage, "metric": found.metric.name, "low": _finite(found.low), "high": _finite(found.high)}
    if isinstance(found, Score):
        return {**head, "value": found.value, "count": found.count}
    return {**head, "a": found.a, "b": found.b, "worse": found.worse, "better": found.better}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
