"""The point that straight edges of the road aim at: ours and the paper's way. Working pixels."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.pose.edges import MAX_LINES, FloatArray, Image, Lines, edges_towards, measured, painted

_MODEL_RAD = 0.004  # lines of a real road are not straight and parallel to better than this
_RIVAL = 0.75  # of the best score: what comes so near could have been it
_LEAST_PX = 75.0  # of agreeing edges together
_SPREAD_MIN_RAD = 0.35  # the lines must differ in direction by this much, or their meeting point is a guess


def robust(grey: Image, prior: FloatArray, reach_px: float) -> tuple[FloatArray, FloatArray, Lines] | None:
    """Straight edges that point at the prior, measured to sub-pixel, and their weighted robust meeting point."""
    raw = edges_towards(grey, prior, reach_px)
    if raw is None:
        return None
    lines = measured(grey, raw)
    if lines is None:
        return None
    lines = replace(lines, trust=1.0 + 3.0 * painted(grey, lines, float(prior[1])))
    return _meeting_point(lines, prior, reach_px)


def _meeting_point(
    lines: Lines, prior: FloatArray, reach_px: float
) -> tuple[FloatArray, FloatArray, Lines] | None:
    """The point most lines aim at: every pair proposes, all judge, the winners are solved by weighted least squares."""
    if len(lines.length_px) < 2:
        return None
    a, b = np.triu_indices(len(lines.length_px), 1)
    places = _crossings(lines, a, b)
    off = (places - prior) / np.array([2.0 * reach_px, reach_px])
    good = np.isfinite(places).all(axis=1) & (np.abs(off) <= 1.0).all(axis=1)
    if not good.any():
        return None
    places, off = places[good], off[good]
    sigma = np.hypot(lines.sigma_rad, _MODEL_RAD)
    miss = _aim_error(lines, places) / (3.0 * sigma)
    worth = lines.trust * np.sqrt(lines.length_px)
    score = (np.clip(1.0 - miss**2, 0.0, None) * worth).sum(axis=1) - 0.25 * worth.sum() * (off**2).sum(axis=1)
    best = float(score.max())
    if best <= 0.0:
        return None
    point = places[int(np.argmax(score))]
    rivals = _rivalry(places, score / best)

    for _ in range(6):
        error, jacobian = _aim_jacobian(lines, point)
        ratio = error / (3.5 * sigma)
        weight = np.clip(1.0 - ratio**2, 0.0, None) ** 2 * lines.trust / sigma**2
        normal_matrix = (jacobian * weight[:, None]).T @ jacobian
        if np.linalg.det(normal_matrix) <= 1e-18:
            return None
        step = np.linalg.solve(normal_matrix, (jacobian * weight[:, None]).T @ error)
        point = point - step
        if float(np.abs(step).max()) < 0.01:
            break
    error, jacobian = _aim_jacobian(lines, point)
    inlier = np.abs(error) < 3.0 * sigma
    winners = lines.chosen(inlier)
    if not _spread_enough(winners) or (np.abs(point - prior) > np.array([2.4, 1.2]) * reach_px).any():
        return None
    # Enough of all the straight edges that aim near here must agree, or this is texture.
    agreeing = (winners.trust * winners.length_px).sum() / (lines.trust * lines.length_px).sum()
    if agreeing < 0.25 or winners.length_px.sum() < _LEAST_PX:
        return None
    weight = 1.0 / sigma[inlier] ** 2
    information = (jacobian[inlier] * weight[:, None]).T @ jacobian[inlier]
    freedom = max(int(inlier.sum()) - 2, 1)
    chi2 = float((weight * error[inlier] ** 2).sum()) / freedom
    # Few lines cannot show their spread: with two it is zero. The prior of one keeps small sets honest.
    inflation = (chi2 * freedom + 4.0) / (freedom + 4.0) if freedom else 1.0
    covariance = np.linalg.inv(information) * max(inflation, 1.0) + np.diag(rivals**2 + 0.04)
    return point, covariance, winners


def _rivalry(places: FloatArray, score: FloatArray) -> FloatArray:
    """(2,): how far apart the points lie that are nearly as good as the best (score 1): large where clutter may have won."""
    weight = np.clip(score - _RIVAL, 0.0, None)
    middle = (weight[:, None] * places).sum(axis=0) / weight.sum()
    spread: FloatArray = np.sqrt((weight[:, None] * (places - middle) ** 2).sum(axis=0) / weight.sum())
    return spread


def _crossings(lines: Lines, a: NDArray[np.int64], b: NDArray[np.int64]) -> FloatArray:
    """Intersections (m, 2) of the lines a and b; NaN where they are parallel."""
    da, db = lines.direction[a], lines.direction[b]
    step = lines.middle_px[b] - lines.middle_px[a]
    cross = da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(np.abs(cross) > 0.02, (step[:, 0] * db[:, 1] - step[:, 1] * db[:, 0]) / cross, np.nan)
    places: FloatArray = lines.middle_px[a] + t[:, None] * da
    return places


def _aim_error(lines: Lines, places: FloatArray) -> FloatArray:
    """(m, n): by how much (rad) line n misses place m, seen from the line's middle."""
    to = places[:, None, :] - lines.middle_px[None, :, :]
    cross = to[:, :, 0] * lines.direction[None, :, 1] - to[:, :, 1] * lines.direction[None, :, 0]
    error: FloatArray = cross / np.maximum(np.hypot(to[:, :, 0], to[:, :, 1]), 1.0)
    return error


def _aim_jacobian(lines: Lines, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Aim errors (n,) at the point and their derivatives (n, 2) by its place."""
    error = _aim_error(lines, point[None, :])[0]
    far = np.maximum(np.hypot(*(point - lines.middle_px).T), 1.0)
    across = np.stack([lines.direction[:, 1], -lines.direction[:, 0]], axis=1)
    return error, across / far[:, None]


def _spread_enough(lines: Lines) -> bool:
    if len(lines.length_px) < 3:
        return False
    angle = np.mod(np.arctan2(lines.direction[:, 1], lines.direction[:, 0]), math.pi)
    order = np.sort(angle)
    gaps = np.diff(np.append(order, order[0] + math.pi))
    return float(math.pi - gaps.max()) >= _SPREAD_MIN_RAD


def paper(grey: Image, prior: FloatArray, reach_px: float) -> tuple[FloatArray, FloatArray, Lines] | None:
    """The paper's method: Canny, probabilistic Hough, |angle| < 45 deg, median of all pairwise intersections.

    It uses no prior, as printed.
    """
    edges = cv2.Canny(grey, 50, 150)
    found = cv2.HoughLinesP(edges, 1.0, math.pi / 180.0, 50, None, 50.0, 10.0)
    if found is None:
        return None
    pieces = np.asarray(found, dtype=np.float64).reshape(-1, 4)
    step = pieces[:, 2:] - pieces[:, :2]
    length = np.hypot(step[:, 0], step[:, 1])
    flat = np.abs(step[:, 1]) < np.abs(step[:, 0])
    order = np.argsort(-length, kind="stable")
    order = order[flat[order]][: 2 * MAX_LINES]
    if len(order) < 2:
        return None
    lines = Lines(
        middle_px=0.5 * (pieces[order, :2] + pieces[order, 2:]),
        direction=step[order] / length[order, None],
        length_px=length[order],
        sigma_rad=np.full(len(order), _MODEL_RAD),
        trust=np.ones(len(order)),
    )
    a, b = np.triu_indices(len(order), 1)
    places = _crossings(lines, a, b)
    places = places[np.isfinite(places).all(axis=1)]
    if len(places) == 0:
        return None
    point = np.median(places, axis=0)
    spread = 1.4826 * np.median(np.abs(places - point), axis=0) / math.sqrt(len(order))
    return point, np.diag(np.maximum(spread, 0.3) ** 2), lines
