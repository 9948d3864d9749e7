"""Lucas-Kanade features inside a plate and in the vehicle's rear round it: predicted corners and growth of the image.

Everything happens in a small window round the plate; large plates are tracked at reduced scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import hypot, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.align import Alignment, align, layers
from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import bounds, size_px, to_grey
from tmde_edge.vision.settings import FlowSettings

Array = NDArray[np.float64]
WIDEST_PX = 384  # of the window in tracking pixels
MOTION_MARGIN_PX = 24  # of the window round the ring, in tracking pixels
GROWTH_FLOOR = 2e-4  # of a ratio's sigma: lens, rolling shutter, a rear that is not flat
PARTED_PX, PARTED = 1.0, 0.02  # plate and rear move apart by more than this, in pixels and plate widths: not one body
# What compression and sampling do to a whole patch: tracking pixels at its rms radius; larger ones hold more blocks to average.
DENSE_FLOOR_PX, DENSE_FLOOR_RADIUS_PX = 0.05, 20.0
SETTLED = 1e-5  # change of the similarity from which a fit is the same: a thousandth of a pixel over a plate
LK_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
POINT_FLOOR_PX = 0.03  # error of one feature that residuals do not show, tracking pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class Template:
    """A plate as it looked: a grey window, reduced by a whole factor; source place of its pixel (0, 0); features."""

    grey: Image
    origin_px: Array
    reduce: int
    corners_px: Array
    plate_points_px: Array  # (n, 2) source pixels
    ring_points_px: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """Image size now / then, with its sigma, from how many features or pixels."""

    ratio: float
    sigma: float
    points: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowStep:
    """Where a template went: corners (4, 2) in source pixels with the sigma of a coordinate, and the growth of the rear."""

    corners_px: Array
    sigma_px: float
    rear: Growth | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarity:
    """q = m p + shift with complex m about given centres; see `fit_similarity`."""

    matrix: Array  # (2, 3)
    ratio: float
    ratio_sigma: float
    residual_px: float  # one coordinate
    inliers: int


def make_template(image: Image, corners_px: Array, settings: FlowSettings) -> Template | None:
    """Features of the plate and of the ring round it; None where the plate lies outside the image."""
    h, w = image.shape[:2]
    height = size_px(corners_px)[1]
    ring = settings.ring * height
    x0, y0, x1, y1 = bounds(corners_px)
    reduce = max(1, int(np.ceil((x1 - x0 + 2 * ring) / WIDEST_PX)))
    scale = 1.0 / reduce
    margin = ring + MOTION_MARGIN_PX * reduce
    left, top = max(0, int(x0 - margin)), max(0, int(y0 - margin))
    right, bottom = min(w, int(x1 + margin) + 2), min(h, int(y1 + margin) + 2)
    cols, rows = (right - left) // reduce, (bottom - top) // reduce
    if cols < 16 or rows < 12:
        return None
    grey, origin = _window(image, left, top, cols, rows, reduce)
    flat = (corners_px - origin) * scale
    inside, outer = _masks(grey.shape, flat, ring * scale)
    plate_points = _features(grey, inside, settings, spacing_px=max(2.0, 0.12 * height * scale))
    ring_points = _features(grey, outer, settings, spacing_px=max(3.0, 0.25 * height * scale))
    return Template(
        grey=grey, origin_px=origin, reduce=reduce, corners_px=corners_px,
        plate_points_px=plate_points / scale + origin, ring_points_px=ring_points / scale + origin,
    )  # fmt: skip


def follow(template: Template, image: Image, guess_px: Array, settings: FlowSettings) -> FlowStep | None:
    """Where the template is in a later image; guess_px: corners (4, 2) to start from. None where too little agrees."""
    move = _between(template.corners_px, guess_px)
    start = guess_px.mean(axis=0) - template.corners_px.mean(axis=0)
    rows, cols = template.grey.shape
    at = np.rint(template.origin_px + start)
    grey, origin = _window(image, int(at[0]), int(at[1]), cols, rows, template.reduce)
    plate, rear = _track(template, grey, origin, move, settings)
    best = plate or rear
    if best is None:
        return None
    if plate is not None and rear is not None:
        # What sweeps across a plate takes its features along; the rear round it stays with the vehicle.
        middle = np.append(template.corners_px.mean(axis=0), 1.0)
        apart = float(np.hypot(*(plate.matrix @ middle - rear.matrix @ middle)))
        if apart > PARTED_PX + PARTED * size_px(template.corners_px)[0]:
            best = rear
    corners = template.corners_px @ best.matrix[:, :2].T + best.matrix[:, 2]
    half = hypot(*size_px(template.corners_px)) / 2
    shift_sigma = best.residual_px / sqrt(best.inliers)
    return FlowStep(
        corners_px=corners,
        sigma_px=hypot(shift_sigma, best.ratio_sigma * half),
        rear=None if rear is None else Growth(ratio=rear.ratio, sigma=rear.ratio_sigma, points=rear.inliers),
    )


def grow(template: Template, image: Image, now_px: Array, settings: FlowSettings) -> Growth | None:
    """Growth of the vehicle's rear round the plate since the template, by all its pixels; None where these do not settle.

    The plate's own growth is in its ranges already. now_px: its corners (4, 2) in the later image, right to a pixel or two.
    """
    grey, _, start = _start(template, image, now_px)
    ring = _ring(template, settings)
    fit = align(layers(template.grey), layers(grey), ring > 0, start)
    return None if fit is None else _dense_growth(fit, ring)


def follow_rear(template: Template, image: Image, guess_px: Array, settings: FlowSettings) -> FlowStep | None:
    """`follow` by all pixels of the rear alone: for a plate that is covered and a rear without features; None without texture.

    guess_px: corners (4, 2) to start from, right to a few pixels.
    """
    grey, origin, start = _start(template, image, guess_px)
    ring = _ring(template, settings)
    fit = align(layers(template.grey), layers(grey), ring > 0, start)
    if fit is None:
        return None
    flat = (template.corners_px - template.origin_px) / template.reduce
    corners = origin + template.reduce * (flat @ fit.matrix[:, :2].T + fit.matrix[:, 2])
    rear = _dense_growth(fit, ring)
    half = hypot(*size_px(template.corners_px)) / 2
    return FlowStep(corners_px=corners, sigma_px=hypot(POINT_FLOOR_PX * template.reduce, rear.sigma * half), rear=rear)


def _start(template: Template, image: Image, now_px: Array) -> tuple[Image, Array, Array]:
    """A window of the later image where the corners now_px are expected, the place of its pixel (0, 0), and the map there."""
    rows, cols = template.grey.shape
    at = np.rint(template.origin_px + now_px.mean(axis=0) - template.corners_px.mean(axis=0))
    grey, origin = _window(image, int(at[0]), int(at[1]), cols, rows, template.reduce)
    move = _between(template.corners_px, now_px)
    # from template pixels to window pixels: source = origin + reduce * pixel in both
    linear = move[:, :2]
    shift = (linear @ template.origin_px + move[:, 2] - origin) / template.reduce
    return grey, origin, np.column_stack([linear, shift])


def _ring(template: Template, settings: FlowSettings) -> Image:
    flat = (template.corners_px - template.origin_px) / template.reduce
    return _masks(template.grey.shape, flat, settings.ring * size_px(flat)[1])[1]


def _dense_growth(fit: Alignment, mask: Image) -> Growth:
    _, _, width, height = cv2.boundingRect(mask)
    radius = float(np.hypot(width, height) / 12**0.5)
    spread = DENSE_FLOOR_PX / radius * min(1.0, (DENSE_FLOOR_RADIUS_PX / radius) ** 0.5)
    sigma = float(np.sqrt(fit.ratio_sigma**2 + GROWTH_FLOOR**2 + spread**2))
    return Growth(ratio=fit.ratio, sigma=sigma, points=int((mask > 0).sum()))


def _masks(shape: tuple[int, ...], corners: Array, ring: float) -> tuple[Image, Image]:
    """The plate, and the ring of the vehicle's rear round it, as masks in tracking pixels."""
    inside = np.zeros(shape[:2], np.uint8)
    cv2.fillConvexPoly(inside, np.rint(corners).astype(np.int32), 255)
    outer = np.zeros(shape[:2], np.uint8)
    x0, y0, x1, y1 = bounds(corners)
    cv2.rectangle(outer, (int(x0 - ring), int(y0 - ring)), (int(x1 + ring), int(y1 + ring)), 255, -1)
    outer[cv2.dilate(inside, np.ones((3, 3), np.uint8)) > 0] = 0
    return inside, outer


def fit_similarity(p: Array, q: Array, floor_px: float) -> Similarity | None:
    """Similarity q = s R p + t by iteratively reweighted least squares (Tukey) from the median pairwise ratio.

    Deterministic: no random samples. None for fewer than 3 points or when fewer than half agree.
    """
    n = len(p)
    if n < 3:
        return None
    middle_p, middle_q = p.mean(axis=0), q.mean(axis=0)
    zp, zq = _complex(p - middle_p), _complex(q - middle_q)
    i, j = _pairs(n)
    step = zp[i] - zp[j]
    apart = np.abs(step)
    wide = apart >= max(_median(apart), 1e-6)
    if not wide.any():
        return None
    ratios = (zq[i] - zq[j])[wide] / step[wide]
    m = complex(_median(ratios.real), _median(ratios.imag))
    moved = zq - m * zp
    t = complex(_median(moved.real), _median(moved.imag))
    weights = np.ones(n)
    terms = np.stack([np.ones(n), zp, zq, zq * zp.conj(), np.abs(zp) ** 2])  # their weighted sums hold all that a fit needs
    for _ in range(10):
        distance = np.abs(zq - m * zp - t)
        scale = max(1.4826 * _median(distance) / 1.177, floor_px)  # median of a Rayleigh distance is 1.177 sigma
        weights = np.maximum(1 - (distance / (4.685 * scale)) ** 2, 0) ** 2
        total, sum_p, sum_q, sum_qp, sum_pp = (terms @ weights).tolist()
        if total.real < 2:
            return None
        cp, cq = sum_p / total, sum_q / total
        spread = (sum_pp - cp.conjugate() * sum_p).real
        if spread < 1e-9:
            return None
        before, m = m, (sum_qp - cq * sum_p.conjugate()) / spread
        t = cq - m * cp
        if abs(m - before) < SETTLED:
            break
    used = weights > 0.1
    count = int(np.count_nonzero(used))
    if count < 3 or count < 0.5 * n:
        return None
    rms = float(np.sqrt((np.abs(zq - m * zp - t)[used] ** 2).sum() / max(2 * count - 4, 1)))
    rms = hypot(rms, floor_px)
    centred = float((np.abs(zp[used] - zp[used].mean()) ** 2).sum())
    linear = np.array([[m.real, -m.imag], [m.imag, m.real]])
    shift = middle_q + np.array([t.real, t.imag]) - linear @ middle_p
    return Similarity(
        matrix=np.column_stack([linear, shift]), ratio=abs(m), ratio_sigma=rms / sqrt(centred), residual_px=rms,
        inliers=count,
    )


def _complex(points: Array) -> NDArray[np.complex128]:
    return np.ascontiguousarray(points).view(np.complex128)[:, 0]


@lru_cache(maxsize=128)
def _pairs(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    i, j = np.triu_indices(n, 1)
    return i, j


def _median(values: Array) -> float:
    """The upper median; numpy's own spends longer on checks than on sorting."""
    k = len(values) // 2
    return float(np.partition(values, k)[k])


def _window(image: Image, left: int, top: int, cols: int, rows: int, reduce: int) -> tuple[Image, Array]:
    """A grey window of rows x cols pixels, each of reduce^2 source pixels, and the source place of its pixel (0, 0).

    Outside the image its border pixels are repeated.
    """
    h, w = image.shape[:2]
    width, height = cols * reduce, rows * reduce
    l_in, t_in = min(max(left, 0), w - 1), min(max(top, 0), h - 1)
    r_in, b_in = min(max(left + width, l_in + 1), w), min(max(top + height, t_in + 1), h)
    grey = to_grey(image[t_in:b_in, l_in:r_in])
    pads = (max(0, t_in - top), max(0, top + height - b_in), max(0, l_in - left), max(0, left + width - r_in))
    if any(pads):
        grey = np.asarray(cv2.copyMakeBorder(grey, *pads, cv2.BORDER_REPLICATE), dtype=np.uint8)[:height, :width]
    origin = np.array([left, top], np.float64) + (reduce - 1) / 2
    if reduce == 1:
        return grey.copy(), origin
    return np.asarray(cv2.resize(grey, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8), origin


def _features(grey: Image, mask: Image, settings: FlowSettings, spacing_px: float) -> Array:
    found = cv2.goodFeaturesToTrack(grey, settings.max_points, 0.02, spacing_px, mask=mask, blockSize=3)
    return np.zeros((0, 2)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _between(a_px: Array, b_px: Array) -> Array:
    """(2, 3) similarity without rotation that takes quadrilateral a to b: centre and mean size."""
    s = float(np.prod([y / max(x, 1e-6) for x, y in zip(size_px(a_px), size_px(b_px), strict=True)]) ** 0.5)
    t = b_px.mean(axis=0) - s * a_px.mean(axis=0)
    return np.array([[s, 0, t[0]], [0, s, t[1]]])


def _track(
    template: Template, grey: Image, origin: Array, move: Array, settings: FlowSettings
) -> tuple[Similarity | None, Similarity | None]:
    """Features of plate and ring forward and back, all at once, then a fit of each, in source pixels."""
    parts = [p if len(p) >= settings.min_points else p[:0] for p in (template.plate_points_px, template.ring_points_px)]
    points_px = np.concatenate(parts)
    if not len(points_px):
        return None, None
    scale = 1.0 / template.reduce
    start = ((points_px - template.origin_px) * scale).astype(np.float32)
    expected = points_px @ move[:, :2].T + move[:, 2]
    guess = ((expected - origin) * scale).astype(np.float32)
    there, ok = _lucas_kanade(template.grey, grey, start, guess, settings)
    back, ok_back = _lucas_kanade(grey, template.grey, there, start, settings)
    off = back.astype(np.float64) - start
    good = ok & ok_back
    good &= np.hypot(off[:, 0], off[:, 1]) < settings.forward_backward_px
    good &= np.isfinite(there).all(axis=1)
    now_px = there.astype(np.float64) / scale + origin
    n = len(parts[0])
    return (
        _moved_part(points_px[:n], now_px[:n], good[:n], scale, settings),
        _moved_part(points_px[n:], now_px[n:], good[n:], scale, settings),
    )


def _lucas_kanade(
    then: Image, now: Image, start: NDArray[np.float32], guess: NDArray[np.float32], settings: FlowSettings
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (n, 2), and whether each was found."""
    window = (settings.window_px, settings.window_px)
    there, ok, _ = cv2.calcOpticalFlowPyrLK(
        then, now, start, guess.copy(), winSize=window, maxLevel=settings.levels, criteria=LK_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(there, dtype=np.float32), np.asarray(ok).ravel() == 1


def _moved_part(
    then_px: Array, now_px: Array, good: NDArray[np.bool_], scale: float, settings: FlowSettings
) -> Similarity | None:
    """The fit of one part's features that came back; None where too few agree."""
    if np.count_nonzero(good) < settings.min_points:
        return None
    fit = fit_similarity(then_px[good], now_px[good], POINT_FLOOR_PX / scale)
    if fit is None or fit.inliers < settings.min_points or fit.residual_px > settings.residual_max_px / scale:
        return None
    return fit
