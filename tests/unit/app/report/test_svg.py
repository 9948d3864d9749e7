"""The plotter: ticks, thinning and gaps."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.app.report.svg import Plot, nice_ticks, padded, thinned

finite = st.floats(-1e6, 1e6)


def test_ticks_are_round() -> None:
    assert nice_ticks(0.0, 10.0, 5) == [0, 2, 4, 6, 8, 10]
    assert [round(t, 6) for t in nice_ticks(-0.07, 0.21, 3)] == [0.0, 0.1, 0.2]
    assert nice_ticks(3.0, 3.0, 5) == [3.0]


@given(finite, st.floats(1e-3, 1e6), st.integers(1, 12))
def test_ticks_lie_inside_and_are_not_too_many(low: float, span: float, wanted: int) -> None:
    ticks = nice_ticks(low, low + span, wanted)
    assert len(ticks) <= wanted + 1
    assert all(low - 1e-6 * span <= t <= low + span * (1 + 1e-6) for t in ticks)


def test_thinning_keeps_spikes_and_gaps() -> None:
    x = np.arange(100_000.0)
    y = np.sin(x / 1000)
    y[54_321] = 9.0
    y[20_000:21_000] = np.nan
    tx, ty = thinned(x, y, 500)
    assert len(tx) <= 1600
    assert np.nanmax(ty) == 9.0
    assert 54_321.0 in tx
    assert np.isnan(ty).any()


def test_nan_breaks_a_line_and_single_points_stay_visible() -> None:
    plot = Plot((0, 5), (0, 5), width=400)
    plot.line(np.arange(6.0), np.array([1.0, 2.0, np.nan, 3.0, np.nan, 4.0]), "line main")
    svg = plot.text("x")
    assert svg.count("<polyline") == 1
    assert svg.count("<circle") == 2


def test_a_point_lands_where_the_axes_say() -> None:
    plot = Plot((0, 10), (0, 2), width=400, height=220)
    plot.dots(np.array([5.0]), np.array([1.0]), "dot")
    match = re.search(r'cx="([\d.]+)" cy="([\d.]+)"', plot.text("x"))
    assert match is not None
    assert abs(float(match[1]) - (plot.left + plot.right) / 2) < 0.1
    assert abs(float(match[2]) - (plot.top + plot.bottom) / 2) < 0.1


@given(st.lists(st.one_of(finite, st.just(float("nan"))), min_size=1, max_size=40))
def test_any_data_gives_xml_without_nan(values: list[float]) -> None:
    y = np.array(values)
    x = np.arange(float(len(y)))
    plot = Plot((0.0, float(len(y) - 1)), padded([y], least=1.0), width=360, x_label="a & b", y_label="<c>")
    plot.band(x, y - 1, y + 1, "band1", "band <1>")
    plot.line(x, y, "line main", "line")
    plot.dots(x, y, "dot main")
    svg = plot.text('quoted "label" & more')
    ElementTree.fromstring(svg)
    assert "nan" not in svg
