"""A small plotter that writes SVG text; colours and line widths are the page's CSS classes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 10, 36  # margins, pixels of the picture
LETTER_PX = 6.4  # mean width of a letter at the page's 12 px


def nice_ticks(low: float, high: float, wanted: int) -> list[float]:
    """Round numbers inside [low, high], about `wanted` of them, in steps of 1, 2 or 5 times a power of ten."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low] if math.isfinite(low) else []
    raw = span / max(wanted, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_text(value: float) -> str:
    """A tick's number without noise digits."""
    text = f"{value:.6g}"
    return "0" if text == "-0" else text


def padded(values: Sequence[Array], *, least: float, pad: float = 0.06, zero: bool = False) -> tuple[float, float]:
    """A range that holds all finite values with some room, at least `least` wide; `zero`: also 0."""
    parts = [v[np.isfinite(v)] for v in values]
    joined = np.concatenate([*parts, np.zeros(1 if zero else 0)]) if parts else np.zeros(1)
    if not joined.size:
        return 0.0, least
    low, high = float(joined.min()), float(joined.max())
    room = max((high - low) * pad, (least - (high - low)) / 2, 0.0)
    return (0.0 if zero and low >= 0 else low - room), high + room


def thinned(x: Array, y: Array, columns: int) -> tuple[Array, Array]:
    """At most about two points a picture column, the extremes of each kept; gaps (NaN) stay gaps."""
    if len(x) <= 2 * columns:
        return x, y
    keep: list[int] = []
    for part in np.array_split(np.arange(len(x)), columns):
        values = y[part]
        finite = np.isfinite(values)
        if not finite.all():  # the gap itself must survive
            keep.append(int(part[np.flatnonzero(~finite)[0]]))
        if finite.any():
            shown = part[finite]
            keep += [int(shown[np.argmin(y[shown])]), int(shown[np.argmax(y[shown])])]
    index = np.unique(keep)
    return x[index], y[index]


class Plot:
    """One set of axes. Data is drawn in the order of the calls; text() gives the SVG."""

    def __init__(
        self, x: tuple[float, float], y: tuple[float, float], *, width: int, height: int = 220, x_label: str = "",
        y_label: str = "", kind: str = "", y_ticks: Sequence[tuple[float, str]] | None = None, square: bool = False,
    ) -> None:  # fmt: skip
        self.width, self.height, self._kind = width, height, kind
        self.x0, self.x1 = x if x[1] > x[0] else (x[0] - 0.5, x[0] + 0.5)
        self.y0, self.y1 = y if y[1] > y[0] else (y[0] - 0.5, y[0] + 0.5)
        self.left, self.right, self.top, self.bottom = LEFT, width - RIGHT, TOP, height - BOTTOM
        if square:  # one unit is as long on both axes
            scale = min((self.right - self.left) / (self.x1 - self.x0), (self.bottom - self.top) / (self.y1 - self.y0))
            self.right = self.left + round(scale * (self.x1 - self.x0))
            self.bottom = self.top + round(scale * (self.y1 - self.y0))
            self.height = self.bottom + BOTTOM
        self._x_label, self._y_label = x_label, y_label
        self._y_ticks = y_ticks
        self._legend: list[tuple[str, str]] = []
        self._body: list[str] = []

    # -- what is drawn --------------------------------------------------------------------------------------------------

    def line(self, x: Array, y: Array, style: str, label: str = "") -> None:
        """A polyline; NaN breaks it."""
        x, y = thinned(x, y, self.right - self.left)
        for run in _runs(np.isfinite(y)):
            points = " ".join(f"{self._px(a):.1f},{self._py(b):.1f}" for a, b in zip(x[run], y[run], strict=True))
            if run.stop - run.start > 1:
                self._body.append(f'<polyline class="{style}" points="{points}"/>')
            else:
                self._dot(float(x[run][0]), float(y[run][0]), style + " lone", 1.2)
        self._named(style, label)

    def band(self, x: Array, low: Array, high: Array, style: str, label: str = "") -> None:
        """The area between two curves; NaN breaks it."""
        columns = self.right - self.left
        if len(x) > 2 * columns:  # an area needs no more than a point a column
            keep = np.unique(np.linspace(0, len(x) - 1, columns).round().astype(int))
            x, low, high = x[keep], low[keep], high[keep]
        for run in _runs(np.isfinite(low) & np.isfinite(high)):
            there = [f"{self._px(a):.1f},{self._py(b):.1f}" for a, b in zip(x[run], high[run], strict=True)]
            back = [f"{self._px(a):.1f},{self._py(b):.1f}" for a, b in zip(x[run], low[run], strict=True)]
            self._body.append(f'<polygon class="{style}" points="{" ".join(there + back[::-1])}"/>')
        self._named(style, label)

    def dots(self, x: Array, y: Array, style: str, label: str = "", *, radius: float = 1.6, most: int = 1500) -> None:
        """Points; more than `most` are thinned evenly."""
        ok = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
        if len(ok) > most:
            ok = ok[np.linspace(0, len(ok) - 1, most).round().astype(int)]
        for i in ok:
            self._dot(float(x[i]), float(y[i]), style, radius)
        self._named(style, label)

    def span(self, x0: float, x1: float, style: str, y0: float | None = None, y1: float | None = None) -> None:
        """A filled rectangle in data units, by default over the whole height."""
        top, bottom = self._py(self.y1 if y1 is None else y1), self._py(self.y0 if y0 is None else y0)
        left, right = self._px(x0), self._px(x1)
        self._body.append(
            f'<rect class="{style}" x="{left:.1f}" y="{top:.1f}" width="{max(right - left, 1):.1f}" height="{bottom - top:.1f}"/>'
        )

    def across(self, y: float, style: str, label: str = "", *, below: bool = False) -> None:
        """A horizontal line over the whole width, labelled at its right end above or below it."""
        if self.y0 <= y <= self.y1:
            at = self._py(y)
            self._body.append(f'<line class="{style}" x1="{self.left}" x2="{self.right}" y1="{at:.1f}" y2="{at:.1f}"/>')
            if label:
                base = at + (13 if below else -4)
                self._body.append(
                    f'<text class="note" x="{self.right - 4}" y="{base:.1f}" text-anchor="end">{escape(label)}</text>'
                )

    def segment(self, a: tuple[float, float], b: tuple[float, float], style: str) -> None:
        """A straight line in data units."""
        self._body.append(
            f'<line class="{style}" x1="{self._px(a[0]):.1f}" y1="{self._py(a[1]):.1f}" '
            f'x2="{self._px(b[0]):.1f}" y2="{self._py(b[1]):.1f}"/>'
        )

    def note(self, x: float, y: float, text: str, anchor: str = "start") -> None:
        """Small text at a point of the data."""
        self._body.append(
            f'<text class="note" x="{self._px(x):.1f}" y="{self._py(y):.1f}" text-anchor="{anchor}">{escape(text)}</text>'
        )

    # -- the whole ------------------------------------------------------------------------------------------------------

    def text(self, label: str) -> str:
        """The finished `<svg>`; `label` says what it shows to who cannot see it."""
        legend, extra = self._legend_text()
        height = self.height + extra
        # The page's script reads the frame from data-: which value lies where.
        data = f'data-kind="{self._kind}" data-x="{self.x0:.6g} {self.x1:.6g} {self.left} {self.right}"' if self._kind else ""
        wide, high = self.right - self.left, self.bottom - self.top
        return (
            f'<svg viewBox="0 0 {self.width} {height}" width="{self.width}" height="{height}" role="img" '
            f'aria-label="{escape(label)}" {data}>'
            f'<rect class="ground" x="{self.left}" y="{self.top}" width="{wide}" height="{high}"/>'
            f"{self._grid()}{''.join(self._body)}{legend}</svg>"
        )

    def _grid(self) -> str:
        parts = []
        for v in nice_ticks(self.x0, self.x1, max((self.right - self.left) // 90, 2)):
            x = self._px(v)
            parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{self.top}" y2="{self.bottom}"/>')
            parts.append(f'<text x="{x:.1f}" y="{self.bottom + 15}" text-anchor="middle">{tick_text(v)}</text>')
        ticks = self._y_ticks
        if ticks is None:
            ticks = [(v, tick_text(v)) for v in nice_ticks(self.y0, self.y1, max((self.bottom - self.top) // 36, 2))]
        for v, text in ticks:
            y = self._py(v)
            parts.append(f'<line class="grid" x1="{self.left}" x2="{self.right}" y1="{y:.1f}" y2="{y:.1f}"/>')
            parts.append(f'<text x="{self.left - 6}" y="{y + 4:.1f}" text-anchor="end">{escape(text)}</text>')
        if self._x_label:
            middle = (self.left + self.right) / 2
            parts.append(f'<text x="{middle:.0f}" y="{self.bottom + 30}" text-anchor="middle">{escape(self._x_label)}</text>')
        if self._y_label:
            y = (self.top + self.bottom) / 2
            parts.append(
                f'<text transform="rotate(-90 12 {y:.0f})" x="12" y="{y:.0f}" text-anchor="middle">{escape(self._y_label)}</text>'
            )
        return "".join(parts)

    def _legend_text(self) -> tuple[str, int]:
        x, y, parts = self.left, self.height + 8, []
        for style, label in self._legend:
            need = 26 + LETTER_PX * len(label) + 14
            if x + need > self.right and x > self.left:
                x, y = self.left, y + 18
            parts.append(f'<rect class="key {style}" x="{x}" y="{y - 5}" width="18" height="8"/>')
            parts.append(f'<text x="{x + 23}" y="{y + 3}">{escape(label)}</text>')
            x += round(need)
        return "".join(parts), (y + 12 - self.height if parts else 0)

    def _named(self, style: str, label: str) -> None:
        if label and (style, label) not in self._legend:
            self._legend.append((style, label))

    def _dot(self, x: float, y: float, style: str, radius: float) -> None:
        if self.x0 <= x <= self.x1:
            self._body.append(f'<circle class="{style}" cx="{self._px(x):.1f}" cy="{self._py(y):.1f}" r="{radius}"/>')

    def _px(self, x: float) -> float:
        return self.left + (x - self.x0) / (self.x1 - self.x0) * (self.right - self.left)

    def _py(self, y: float) -> float:
        # What lies outside is drawn on the edge, so that it is seen to be there.
        y = min(max(y, self.y0), self.y1)
        return self.bottom - (y - self.y0) / (self.y1 - self.y0) * (self.bottom - self.top)


def _runs(ok: NDArray[np.bool_]) -> list[slice]:
    """Slices of the uninterrupted True parts."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ok.astype(np.int8), [0]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
