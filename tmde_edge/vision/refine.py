"""Sub-pixel plate outline in the source image: edge profiles across the four sides, robust line fits, an honest sigma."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import bounds, is_convex, size_px, to_grey

Array = NDArray[np.float64]
STEP_PX = 0.25  # between samples of a profile
SMOOTH_PX = 0.6  # one sigma of the derivative of Gaussian
ENDS = 0.07  # of a side left out at either end: rounded corners
REACH_OF_HEIGHT = 0.16  # how far from the given outline an edge is looked for, in plate heights
MIN_REACH_PX = 2.5
TILT_OF_HEIGHT = 0.10  # how much the two ends of a side may move against each other
MIN_STEP_GREY = 5.0  # mean contrast over the edge, grey levels
PIECES = 10  # a side is measured in this many pieces
FLOOR_PX = 0.05  # of one side's sigma: sampling and lens, which no residual shows


@dataclass(frozen=True, slots=True, kw_only=True)
class OutlineFit:
    """Corners (4, 2) TL, TR, BR, BL with the sigma of one coordinate; blur_px is the edges' own spread (one sigma)."""

    corners_px: Array
    sigma_px: float
    refined: bool
    blur_px: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Side:
    """A line as offsets along the outward normal at the side's two ends."""

    at_start_px: float
    at_end_px: float
    sigma_px: float
    blur_px: float


def refine_outline(image: Image, corners_px: Array) -> OutlineFit:
    """The outline near the given corners that the image itself shows.

    `refined` is False when a side shows no edge or leaves the image: that side then stays where it was, with a sigma of
    a quarter of the search reach.
    """
    if not is_convex(corners_px):
        return OutlineFit(corners_px=corners_px, sigma_px=MIN_REACH_PX, refined=False, blur_px=None)
    height_px = size_px(corners_px)[1]
    reach = max(MIN_REACH_PX, REACH_OF_HEIGHT * height_px)
    patch, shift = _patch(image, corners_px, reach + 4)
    sides: list[_Side | None] = []
    for i in range(4):
        a, b = corners_px[i] - shift, corners_px[(i + 1) % 4] - shift
        sides.append(_fit_side(patch, a, b, reach, TILT_OF_HEIGHT * height_px))
    lines = []
    for i, side in enumerate(sides):
        a, b = corners_px[i], corners_px[(i + 1) % 4]
        n = _outward(a, b)
        lines.append((a, b) if side is None else (a + side.at_start_px * n, b + side.at_end_px * n))
    found = [s for s in sides if s is not None]
    corners = np.array([_intersection(lines[i - 1], lines[i]) for i in range(4)])
    unmoved = reach / 4
    if not found or not is_convex(corners) or np.abs(corners - corners_px).max() > 3 * reach:
        return OutlineFit(corners_px=corners_px, sigma_px=unmoved, refined=False, blur_px=None)
    variances = [unmoved**2 if s is None else s.sigma_px**2 for s in sides]
    return OutlineFit(
        corners_px=corners,
        sigma_px=float(np.sqrt(np.mean(variances))),
        refined=len(found) == 4,
        blur_px=float(np.median([s.blur_px for s in found])),
    )


def _outward(a: Array, b: Array) -> Array:
    """Unit normal of a side that points out of a quadrilateral in order TL, TR, BR, BL (y down)."""
    d = (b - a) / np.hypot(*(b - a))
    return np.array([d[1], -d[0]])


def _patch(image: Image, corners_px: Array, margin_px: float) -> tuple[NDArray[np.float32], Array]:
    """Grey float crop round the corners, and its origin. Outside the image: NaN, which no edge can cross."""
    h, w = image.shape[:2]
    x0, y0, x1, y1 = bounds(corners_px)
    left, top = int(np.floor(x0 - margin_px)), int(np.floor(y0 - margin_px))
    right, bottom = int(np.ceil(x1 + margin_px)) + 1, int(np.ceil(y1 + margin_px)) + 1
    l_in, t_in, r_in, b_in = max(left, 0), max(top, 0), min(right, w), min(bottom, h)
    if l_in >= r_in or t_in >= b_in:
        return np.full((2, 2), np.nan, np.float32), np.array([left, top], np.float64)
    inner = to_grey(image[t_in:b_in, l_in:r_in]).astype(np.float32)
    pads = (t_in - top, bottom - b_in, l_in - left, right - r_in)
    patch = cv2.copyMakeBorder(inner, *pads, cv2.BORDER_CONSTANT, value=float("nan")) if any(pads) else inner
    return np.asarray(patch, dtype=np.float32), np.array([left, top], np.float64)


def _profiles(patch: NDArray[np.float32], a: Array, b: Array, reach: float) -> tuple[Array, Array, Array]:
    """Samples (n, m) across a side: positions along it (n,) 0..1, offsets outward (m,) px, grey levels."""
    length = float(np.hypot(*(b - a)))
    n = int(np.clip(round(length * (1 - 2 * ENDS)), 2 * PIECES, 96))
    along = np.linspace(ENDS, 1 - ENDS, n, dtype=np.float64)
    m = int(np.ceil((reach + 3 * SMOOTH_PX) / STEP_PX))
    across = np.asarray(np.arange(-m, m + 1) * STEP_PX, dtype=np.float64)
    normal = _outward(a, b)
    xy = a + along[:, None, None] * (b - a) + across[None, :, None] * normal
    maps = xy.astype(np.float32)
    grey = cv2.remap(
        patch, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")
    )
    return along, across, np.asarray(grey, dtype=np.float64)


def _derivative(grey: Array) -> Array:
    """Derivative across, grey levels a pixel, by a Gaussian of SMOOTH_PX."""
    half = int(np.ceil(3 * SMOOTH_PX / STEP_PX))
    x = np.arange(-half, half + 1) * STEP_PX
    gauss = np.exp(-0.5 * (x / SMOOTH_PX) ** 2)
    gauss /= gauss.sum()
    kernel = x / SMOOTH_PX**2 * gauss  # correlation with it differentiates
    windows = np.lib.stride_tricks.sliding_window_view(grey, 2 * half + 1, axis=1)
    return np.asarray(windows @ kernel)


def _fit_side(patch: NDArray[np.float32], a: Array, b: Array, reach: float, tilt_px: float) -> _Side | None:
    """The strongest straight edge near a side, nearer ones preferred; None where there is none."""
    along, across, grey = _profiles(patch, a, b, reach)
    whole = np.isfinite(grey).all(axis=1)
    if whole.mean() < 0.6:
        return None
    along, grey = along[whole], grey[whole]
    slope = _derivative(grey)
    cut = (len(across) - slope.shape[1]) // 2
    offsets = across[cut : len(across) - cut]
    guess = _strongest_line(along, offsets, slope, reach, tilt_px)
    if guess is None:
        return None
    return _measure(along, offsets, slope, *guess)


def _strongest_line(
    along: Array, offsets: Array, slope: Array, reach: float, tilt_px: float
) -> tuple[float, float] | None:
    """Offset at the middle and difference between the ends of the line with the most coherent edge.

    For every tilt the rows are shifted and averaged: lettering and clutter cancel, an edge along the whole side stays.
    """
    k_max = max(1, round(tilt_px / (2 * STEP_PX)))
    tilts = np.arange(-k_max, k_max + 1) * 2 * STEP_PX
    columns = np.arange(slope.shape[1])
    prior = np.exp(-0.5 * (offsets / (0.6 * reach)) ** 2)
    best, best_value = None, 0.0
    limited = np.clip(slope, -60.0, 60.0)  # a lamp beside the plate must not outvote the rest of the side
    for tilt in tilts:
        shift = np.rint((along - 0.5) * tilt / STEP_PX).astype(np.int64)
        index = columns[None, :] + shift[:, None]
        valid = (index >= 0) & (index < slope.shape[1])
        taken = np.take_along_axis(limited, np.clip(index, 0, slope.shape[1] - 1), axis=1) * valid
        strength = np.abs(taken.mean(axis=0)) * prior
        top = int(strength.argmax())
        if strength[top] > best_value:
            best_value, best = float(strength[top]), (float(offsets[top]), float(tilt))
    # a step of c grey levels has the derivative c / (sqrt(2 pi) spread), spread at least the smoothing
    if best is None or best_value < MIN_STEP_GREY / (np.sqrt(2 * np.pi) * 2 * SMOOTH_PX):
        return None
    return best


def _measure(along: Array, offsets: Array, slope: Array, middle_px: float, tilt_px: float) -> _Side | None:
    """Sub-pixel offsets of the line's pieces by the parabola through the derivative's peak, then a Tukey line fit."""
    line = middle_px + (along - 0.5) * tilt_px
    position = (line - offsets[0]) / STEP_PX
    half = round(1.5 / STEP_PX)
    index = np.rint(position).astype(np.int64)[:, None] + np.arange(-half, half + 1)
    inside = (index[:, 0] >= 0) & (index[:, -1] < slope.shape[1])
    if inside.sum() < 2 * PIECES // 2:
        return None
    rows = np.flatnonzero(inside)
    near = np.take_along_axis(slope[rows], index[rows], axis=1)
    quarter = half // 3
    sign = 1.0 if near[:, half - quarter : half + quarter + 1].mean() >= 0 else -1.0
    rounding = (np.rint(position[rows]) - position[rows]) * STEP_PX
    xs, ys, ws = [], [], []
    for part in np.array_split(np.arange(len(rows)), min(PIECES, len(rows))):
        mean = sign * near[part].mean(axis=0)
        k = int(mean.argmax())
        if k in (0, 2 * half) or mean[k] < MIN_STEP_GREY / 8:
            continue
        before, c, after = mean[k - 1 : k + 2]
        peak = (k - half) + 0.5 * (before - after) / (before - 2 * c + after)
        xs.append(float(along[rows[part]].mean() - 0.5))
        ys.append(float(line[rows[part]].mean() + rounding[part].mean() + peak * STEP_PX))
        ws.append(float(np.sqrt(c)))
    if len(xs) < max(4, PIECES // 2):
        return None
    fit = _tukey_line(np.array(xs), np.array(ys), np.array(ws))
    if fit is None:
        return None
    at, tilt, sigma = fit
    mean = sign * near.mean(axis=0)
    spread = max(float(mean.sum() * STEP_PX / (np.sqrt(2 * np.pi) * max(mean.max(), 1e-6))), SMOOTH_PX)
    return _Side(
        at_start_px=at - 0.5 * tilt,
        at_end_px=at + 0.5 * tilt,
        sigma_px=float(np.hypot(sigma, FLOOR_PX)),
        blur_px=float(np.sqrt(max(spread**2 - SMOOTH_PX**2, 0.0))),
    )


def _tukey_line(x: Array, y: Array, weight: Array) -> tuple[float, float, float] | None:
    """Robust line y = at + tilt x: (at, tilt, sigma of the line at its ends); None where fewer than 4 points agree."""
    robust = np.ones_like(x)
    at, tilt, scale = float(np.median(y)), 0.0, 1.0
    for _ in range(8):
        w = weight * robust
        total = w.sum()
        mx, my = (w * x).sum() / total, (w * y).sum() / total
        sxx = (w * (x - mx) ** 2).sum()
        tilt = float((w * (x - mx) * (y - my)).sum() / sxx) if sxx > 1e-12 else 0.0
        at = float(my - tilt * mx)
        residual = y - at - tilt * x
        scale = max(1.4826 * float(np.median(np.abs(residual))), 0.03)
        robust = np.clip(1 - (residual / (4.685 * scale)) ** 2, 0, None) ** 2
        if (robust > 0.2).sum() < 4:
            return None
    used = robust > 0.2
    n = int(used.sum())
    rms = float(np.sqrt(((y - at - tilt * x)[used] ** 2).sum() / (n - 2)))
    xs = x[used]
    leverage = 1 / n + 0.25 / max(float(((xs - xs.mean()) ** 2).sum()), 1e-6)
    return at, tilt, rms * float(np.sqrt(leverage)) * float(np.sqrt(len(x) / n))


def _intersection(p: tuple[Array, Array], q: tuple[Array, Array]) -> Array:
    """Where two lines, each through two points, meet; the end they share when they are parallel."""
    (a, b), (c, d) = p, q
    r, s = b - a, d - c
    cross = r[0] * s[1] - r[1] * s[0]
    if abs(cross) < 1e-9:
        return b
    t = ((c[0] - a[0]) * s[1] - (c[1] - a[1]) * s[0]) / cross
    return np.asarray(a + t * r)
