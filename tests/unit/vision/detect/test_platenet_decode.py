"""Truth written into maps the way the network is trained must come back out of the decoder."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tmde_edge.vision.detect.platenet_decode import CHANNELS, STRIDES_PX, UNITS_PX, decode

HEIGHT_PX, WIDTH_PX = 192, 320


def maps_of(quads: list[NDArray[np.float64]], head: int, logit: float = 3.0) -> tuple[NDArray[np.float32], ...]:
    """Maps of both heads in which each quad's centre cell peaks and the cells around it carry its corners."""
    maps = [np.zeros((CHANNELS, HEIGHT_PX // s, WIDTH_PX // s), np.float32) for s in STRIDES_PX]
    for m in maps:
        m[0] = -8.0
    stride, unit, m = STRIDES_PX[head], UNITS_PX[head], maps[head]
    for q in quads:
        centre = q.mean(0)
        i, j = round((centre[1] + 0.5) / stride - 0.5), round((centre[0] + 0.5) / stride - 0.5)
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                r, c = i + di, j + dj
                if 0 <= r < m.shape[1] and 0 <= c < m.shape[2]:
                    m[0, r, c] = logit - 1.5 * (abs(di) + abs(dj))
                    cell = np.array([(c + 0.5) * stride - 0.5, (r + 0.5) * stride - 0.5])
                    m[1:, r, c] = ((q - cell) / unit).ravel()
    return tuple(maps)


def rectangle(cx: float, cy: float, w: float, h: float, turn_rad: float = 0.0) -> NDArray[np.float64]:
    corners = np.array([(-w / 2, -h / 2), (w / 2, -h / 2), (w / 2, h / 2), (-w / 2, h / 2)])
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.asarray(corners @ np.array([(c, s), (-s, c)]) + (cx, cy))


@settings(max_examples=150, deadline=None)
@given(
    cx=st.floats(0, WIDTH_PX - 1), cy=st.floats(0, HEIGHT_PX - 1), w=st.floats(8, 300), aspect=st.floats(1.2, 5),
    turn=st.floats(-0.4, 0.4), head=st.sampled_from([0, 1]), scale=st.floats(0.25, 2),
    ox=st.integers(0, 2000), oy=st.integers(0, 1000),
)
def test_truth_comes_back_in_source_pixels(
    cx: float, cy: float, w: float, aspect: float, turn: float, head: int, scale: float, ox: int, oy: int
) -> None:
    quad = rectangle(cx, cy, w, w / aspect, turn)
    found = decode(maps_of([quad], head), score_min=0.3, scale_xy=(scale, scale), origin_px=(ox, oy))
    assert len(found) == 1
    truth = (quad + 0.5) / scale - 0.5 + (ox, oy)
    np.testing.assert_allclose(found[0].corners_px, truth, atol=1e-3 / min(scale, 1.0))
    assert found[0].score == pytest.approx(1 / (1 + np.exp(-3.0)), abs=1e-6)


def test_both_heads_report_one_plate_once_and_neighbours_stay() -> None:
    plate, other = rectangle(100, 60, 80, 18), rectangle(230, 60, 70, 16)
    small, big = maps_of([plate, other], 0), maps_of([plate], 1, logit=2.0)
    found = decode((small[0], big[1]), score_min=0.3)
    assert len(found) == 2
    assert sorted(round(float(c.corners_px[:, 0].mean())) for c in found) == [100, 230]


def test_a_quad_inside_another_is_kept_once_the_better_one() -> None:
    outer, inner = rectangle(160, 96, 200, 60), rectangle(160, 96, 120, 30)
    whole, part = maps_of([outer], 1, logit=4.0), maps_of([inner], 0, logit=1.0)
    found = decode((part[0], whole[1]), score_min=0.3)
    assert len(found) == 1
    assert np.ptp(found[0].corners_px[:, 0]) == pytest.approx(200, abs=1e-2)


def test_a_plate_on_a_sign_that_scores_higher_stays() -> None:
    sign, plate = rectangle(160, 96, 250, 120), rectangle(160, 96, 90, 20)
    whole, part = maps_of([sign], 1, logit=4.0), maps_of([plate], 0, logit=1.0)
    found = decode((part[0], whole[1]), score_min=0.3)
    assert [round(float(np.ptp(c.corners_px[:, 0]))) for c in found] == [250, 90]


def test_low_scores_and_flat_quads_give_nothing() -> None:
    assert decode(maps_of([rectangle(100, 60, 80, 18)], 0, logit=-2.0), score_min=0.3) == []
    flat = maps_of([rectangle(100, 60, 80, 0.0)], 0)
    assert decode(flat, score_min=0.3) == []


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("head", [0, 1])
def test_what_is_not_finite_is_no_empty_road(head: int, bad: float) -> None:
    scores, corners = (maps_of([rectangle(160, 96, 80, 18)], head) for _ in range(2))
    scores[head][0, 0, 0] = bad
    with pytest.raises(ValueError, match="scores are not finite"):
        decode(scores, score_min=0.3)
    corners[head][1:] = bad
    with pytest.raises(ValueError, match="corners are not finite"):
        decode(corners, score_min=0.3)


def test_at_most_the_best_are_kept() -> None:
    quads = [rectangle(30 + 60 * i, 40 + 50 * j, 30, 8) for i in range(5) for j in range(3)]
    assert len(decode(maps_of(quads, 0), score_min=0.3)) == 15
    assert len(decode(maps_of(quads, 0), score_min=0.3, max_candidates=4)) == 4


def test_wrong_use_is_an_error() -> None:
    maps = maps_of([], 0)
    with pytest.raises(ValueError, match="score_min"):
        decode(maps, score_min=1.0)
    with pytest.raises(ValueError, match="9 channels"):
        decode((maps[0], maps[1][:5]), score_min=0.3)
