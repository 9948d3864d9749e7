"""How the lane goes on ahead: its painted lines followed from the bonnet to where they are lost. Pixels only.

With n pixels below the vanishing point's row, places on a flat road are X ~ (u - u0) / n and Z ~ 1 / n, whatever focal length and
camera height. A lane's lines are X = a_i + b Z + c Z^2 + d Z^3: each its own a, one heading b and one bend c, d for all
(a clothoid's first terms). A recursive least squares runs over the rows from near to far and takes, in each, the ridge next to
where it expects the line.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import CoursePoint, Point

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_STEP = 0.93  # of n from row to row: each row sees 7 % further
_LEAST_N_PX = 14.0
_LINE_SHARE = 0.09  # width of a line over n: 12 cm over a camera 1.3 m up
_FINE = 3  # pixels or groups of them that half a line's width has at least
_CONTRAST = 9.0  # grey levels that a line stands out at least
_NEAR_SHARE = 0.4  # of the rows' n: in front of this the lane is taken for straight
_LANE = (0.35, 2.6)  # |X| of the lines beside us, in camera heights
_BIN = 0.06
_GATE = 0.13  # least search width, share of n: 17 cm
_MISSES = 8  # rows without any line that end it: they span 1.8-fold distance
_LEAST_HITS = 9
_BEND = 1 / 40  # 1/m: sigma a priori for c; and of its growth over 30 m for d
_HEIGHT_M = 1.3  # for these priors only


def find_course(image: Image, vanishing_px: Point, focal_px: float) -> tuple[CoursePoint, ...]:
    """Points (x, y, sigma of x) of our own way if we follow the lane, near to far, source pixels; empty where no line is seen."""
    height = image.shape[0]
    u0, v0 = vanishing_px
    highest = height - 2.0 - v0
    if highest < 4 * _LEAST_N_PX:
        return ()
    count = int(np.log(_LEAST_N_PX / highest) / np.log(_STEP))
    rows = highest * _STEP ** np.arange(count + 1)
    top = max(0, int(v0))  # all rows lie below the vanishing point
    below = image[top:]
    sums = np.asarray(cv2.integral(below if below.ndim == 2 else cv2.cvtColor(below, cv2.COLOR_BGR2GRAY)), dtype=np.int32)
    ridges = [_ridges(sums, v0 + n - top, n, u0) for n in rows.tolist()]
    lines = _near_lines(rows, ridges, highest)
    if not lines:
        return ()
    fit = _Fit(lines, focal_px)
    missed = hits = 0
    reach = rows[0]
    for n, found in zip(rows, ridges, strict=True):
        taken = fit.take(n, found)
        hits += taken
        missed = 0 if taken else missed + 1
        if taken:
            reach = n
        if missed >= _MISSES:
            break
    if hits < _LEAST_HITS or reach > 0.5 * highest:
        return ()
    kept = rows[rows >= reach]
    return (*(fit.point(float(n), u0, v0) for n in kept[:-1 : max(1, len(kept) // 12)]), fit.point(float(reach), u0, v0))


def _ridges(sums: NDArray[np.int32], row: float, n: float, u0: float) -> Array:
    """X of the light lines that cross an image row; sums: the image's integral (h + 1, w + 1)."""
    at = round(row)
    thick = max(0, int(0.01 * n))
    first, last = max(at - thick, 0), min(at + thick + 1, len(sums) - 1)
    if first >= last:
        return np.zeros(0)
    half = max(1, round(0.5 * _LINE_SHARE * n))
    step = max(1, half // _FINE)  # wide lines need no look at every pixel
    total = sums[last, ::step] - sums[first, ::step]
    half //= step
    size = 2 * half + 1
    if len(total) - size <= 4 * half + 2:
        return np.zeros(0)
    mean = (total[size:] - total[:-size]) / (size * step * (last - first))  # centred at index + half
    gap = 2 * half + 1
    response = np.zeros(len(mean))
    response[gap:-gap] = mean[gap:-gap] - np.maximum(mean[: -2 * gap], mean[2 * gap :])
    high = np.flatnonzero(response > _CONTRAST)  # none at the ends, which are zero
    peaks = high[(response[high] >= response[high - 1]) & (response[high] > response[high + 1])]
    if not len(peaks):
        return np.zeros(0)
    peaks = peaks[np.argsort(-response[peaks])[:10]]
    left, middle, right = response[peaks - 1], response[peaks], response[peaks + 1]
    bow = left - 2 * middle + right
    shift = np.where(bow < -1e-6, 0.5 * (left - right) / np.minimum(bow, -1e-6), 0.0)
    places = peaks + half + np.minimum(np.maximum(shift, -0.5), 0.5)
    return np.asarray(((places + 0.5) * step - 0.5 - u0) / n, np.float64)


def _near_lines(rows: Array, ridges: list[Array], highest: float) -> list[float]:
    """X of the nearest line on each side, from the rows in front of us."""
    near = [x for n, x in zip(rows, ridges, strict=True) if n > _NEAR_SHARE * highest]
    if not near:
        return []
    out = []
    for sign in (-1.0, 1.0):
        places = np.concatenate([x[(sign * x > _LANE[0]) & (sign * x < _LANE[1])] for x in near])
        if len(places) == 0:
            continue
        support = (np.abs(places[:, None] - places[None, :]) < _BIN).sum(axis=1)
        good = support >= max(3, 0.3 * len(near))
        if good.any():
            nearest = places[good][np.argmin(np.abs(places[good]))]
            out.append(float(np.median(places[np.abs(places - nearest) < _BIN])))
    return out


class _Fit:
    """Recursive least squares over (a_1 .. a_k, b, c, d); Z = focal / n, so that it is in camera heights like X."""

    def __init__(self, lines: list[float], focal_px: float) -> None:
        self._k = len(lines)
        self._focal = focal_px
        self._x = np.array([*lines, 0.0, 0.0, 0.0])
        bend = _BEND * _HEIGHT_M / 2
        self._p = np.diag([0.05**2] * self._k + [0.02**2, bend**2, (bend * _HEIGHT_M / 30 / 3 * 2) ** 2])

    def _row(self, line: int, n: float) -> Array:
        z = self._focal / n
        out = np.zeros(self._k + 3)
        if line >= 0:
            out[line] = 1.0
        out[self._k :] = z, z**2, z**3
        return out

    def take(self, n: float, found: Array) -> int:
        """Uses the ridges of a row; how many lines were found on it."""
        taken = 0
        seen = found.tolist()
        for line in range(self._k if seen else 0):
            h = self._row(line, n)
            expected = float(h @ self._x)
            seen_by = self._p @ h
            spread = float(h @ seen_by)
            off = min((x - expected for x in seen), key=abs)
            if abs(off) > min(max(_GATE, 2.5 * spread**0.5), 0.4):
                continue
            gain = seen_by / (spread + (0.03 + 0.8 / n) ** 2)
            self._x += gain * off
            self._p -= gain[:, None] * seen_by
            taken += 1
        return taken

    def point(self, n: float, u0: float, v0: float) -> CoursePoint:
        """Our own way at a row: it starts where we are."""
        h = self._row(-1, n)
        sigma = max(float(h @ self._p @ h), 0.0) ** 0.5
        return float(u0 + n * (h @ self._x)), float(v0 + n), float(n * (sigma + 0.05))
