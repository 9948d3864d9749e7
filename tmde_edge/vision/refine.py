"""Sub-pixel plate outline in the source image: edge profiles across the four sides, robust line fits, an honest sigma."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import hypot, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.bands import with_bands
from tmde_edge.vision.edge_model import EdgeFit, fit_edges
from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import bounds, is_convex, size_px, to_grey

Array = NDArray[np.float64]
STEP_PX = 0.25  # between samples of a fine profile
COARSE_STEPS = 28  # samples on either side of the given outline when the side's direction is looked for
SMOOTH_PX = 0.6  # one sigma of the derivative of Gaussian
ENDS = 0.08  # of a side left out at either end: rounded corners
REACH_OF_HEIGHT = 0.13  # how far from the given outline an edge is looked for, in plate heights
MIN_REACH_PX = 2.5
TILT_OF_HEIGHT = 0.12  # how much the two ends of a side may move against each other
MIN_STEP_GREY = 8.0  # contrast over the edge, grey levels
STEP_SHARE = 0.14  # of the profile's whole contrast: smaller steps are noise
BORDER_OF_HEIGHT = 0.08  # border line and margin, in plate heights
GIVEN_OF_HEIGHT = 0.06  # one sigma of the given outline, in plate heights
PIECES = 10  # a side is measured in this many pieces
SAME_STEP_PX = 0.5
HOPELESS = 0.1  # of the most credible step's weight
SAMPLES = 32  # of a profile on either side of the given outline
GOOD_MISFIT = 1.5
NARROW_GROUND_PX = 2.5  # between lettering and edge: narrower, blur keeps it from its level
MISFIT_COST, LEAST_MISFIT = 6.0, 0.2  # of one step against another: so much for each factor e of the misfit
BAND_LINE_COST = 3.0  # of a border line beyond a blue band: few have one
VALLEY_REACH = 0.06  # of the plate's height: a step with a rise behind that may still be the plate's edge
LEFT_OUT_COST = 6.0  # of a step that explains only what lies before the next rise
LOW_SIGMA_PX, LOW_HEIGHT_PX = 0.2, 10.0  # of a low plate's edges, which blur joins to lettering and border
MOVED_SIGMAS = 4.0  # a side further than this from the given outline is another edge
LEAST_SIDES = 3
FLOOR_PX = 0.05  # of one side's sigma: sampling and lens, which no residual shows


@dataclass(frozen=True, slots=True, kw_only=True)
class OutlineFit:
    """Corners (4, 2) TL, TR, BR, BL with the sigma of one coordinate; blur_px is the edges' own spread (one sigma)."""

    corners_px: Array
    sigma_px: float
    refined: bool
    blur_px: float | None
    side_sigma_px: tuple[float, ...] = ()  # of the top, right, bottom and left line; empty where nothing was refined


@dataclass(frozen=True, slots=True, kw_only=True)
class _Side:
    """A line as offsets along the outward normal at the side's two ends."""

    at_start_px: float
    at_end_px: float
    sigma_px: float
    blur_px: float


@dataclass(frozen=True, slots=True)
class _Look:
    """A side's direction, as the difference of the outward offset between its ends, and the offsets of the steps there."""

    tilt_px: float
    offsets_px: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    """A step of side i that may be the plate's edge: its line, mean profile, place, where its ground begins and its body ends."""

    i: int
    side: _Side
    profile: Array
    start_px: float
    inner_px: float
    outer_px: float
    text_px: float  # where lettering next to it ends; NaN without
    valley_px: float | None  # up to where it falls, where the profile rises again behind
    band: bool = False  # beside a blue band
    to_valley: bool = False  # what lies beyond the valley is left out: only a plain step is credible


def refine_outline(
    image: Image, corners_px: Array, given_sigma_px: float | None = None, light_on_dark: bool | None = None
) -> OutlineFit:
    """The outline near the given corners that the image itself shows; given_sigma_px: how well those are believed.

    light_on_dark: the plate's polarity where it is known.

    A side that shows no edge or leaves the image stays where it was, with the given sigma (a quarter of the search reach where
    none is given), and so does one whose edge is less sure than that or far away. `refined` is False when a side stayed; of a
    given sigma, when two did. A blue band that was left out is taken in (bands.py).
    """
    if not is_convex(corners_px):
        return OutlineFit(corners_px=corners_px, sigma_px=MIN_REACH_PX, refined=False, blur_px=None)
    height_px = size_px(corners_px)[1]
    reach, tilt_px = REACH_OF_HEIGHT * height_px, TILT_OF_HEIGHT * height_px
    if given_sigma_px is not None:  # a good outline needs only its border's width, and its own doubt
        reach = min(reach, BORDER_OF_HEIGHT * height_px + 4 * given_sigma_px)
        tilt_px = min(tilt_px, max(1.0, 4 * given_sigma_px))
    reach = max(MIN_REACH_PX, reach)
    banded = with_bands(image, corners_px, max(1.0, 2 * (given_sigma_px or 0.0))) if not light_on_dark else None
    if banded is not None:
        corners_px = banded.corners_px
    margin = 1.5 * reach + 4
    patch, shift = _patch(image, corners_px, margin)
    dark = _dark_ground(patch, corners_px - shift) if light_on_dark is None else light_on_dark
    patches = [255.0 - patch if dark else patch] * 4
    if banded is not None and not dark and (banded.right or banded.left):  # in blue a band is nearly as bright as the ground
        blue = _patch(image[..., 0], corners_px, margin)[0]
        patches = [patch, blue if banded.right else patch, patch, blue if banded.left else patch]
    sides = _fit_sides(patches, corners_px - shift, reach, tilt_px, height_px, given_sigma_px or GIVEN_OF_HEIGHT * height_px)
    unmoved = reach / 4
    if given_sigma_px is not None:
        unmoved = given_sigma_px
        sides = [s if s is not None and _believed(s, given_sigma_px) else None for s in sides]
    lines = []
    for i, side in enumerate(sides):
        a, b = corners_px[i], corners_px[(i + 1) % 4]
        n = _outward(a, b)
        lines.append((a, b) if side is None else (a + side.at_start_px * n, b + side.at_end_px * n))
    found = [s for s in sides if s is not None]
    corners = np.array([_intersection(lines[i - 1], lines[i]) for i in range(4)])
    if not found or not is_convex(corners) or np.abs(corners - corners_px).max() > 3 * reach:
        return OutlineFit(corners_px=corners_px, sigma_px=unmoved, refined=False, blur_px=None)
    variances = [unmoved**2 if s is None else s.sigma_px**2 for s in sides]
    return OutlineFit(
        corners_px=corners,
        sigma_px=float(np.sqrt(np.mean(variances))),
        refined=len(found) >= (4 if given_sigma_px is None else LEAST_SIDES),
        blur_px=float(np.median([s.blur_px for s in found])),
        side_sigma_px=tuple(float(v**0.5) for v in variances),
    )


def _believed(side: _Side, given_sigma_px: float) -> bool:
    """Whether a side's edge is surer than what was given, and not another thing far away from it."""
    moved = max(abs(side.at_start_px), abs(side.at_end_px))
    return side.sigma_px <= given_sigma_px and moved <= MOVED_SIGMAS * given_sigma_px


def _dark_ground(patch: NDArray[np.float32], corners_px: Array) -> bool:
    """Whether the plate's ground is its dark part: most of the inside is ground."""
    middle = corners_px.mean(axis=0)
    grid = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 33), np.linspace(-0.7, 0.7, 15)), axis=-1)
    along, down = (corners_px[1] - corners_px[0]) / 2, (corners_px[3] - corners_px[0]) / 2
    at = (middle + grid[..., :1] * along + grid[..., 1:] * down).astype(np.float32)
    inside = cv2.remap(patch, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    grey = inside[np.isfinite(inside)]
    if len(grey) == 0:
        return False
    low, high = np.percentile(grey, (4, 96))
    return bool(np.median(grey) < (low + high) / 2)


def _outward(a: Array, b: Array) -> Array:
    """Unit normal of a side that points out of a quadrilateral in order TL, TR, BR, BL (y down)."""
    dx, dy = (b - a).tolist()
    length = hypot(dx, dy)
    return np.array([dy / length, -dx / length])


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


def _profiles(
    patch: NDArray[np.float32], a: Array, b: Array, rows: int, across_px: Array, line_px: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array]:
    """Positions along a side (n,), -0.5..0.5, and grey levels (n, m) at offsets across_px outward of a line near it.

    line_px: that line's outward offset at the side's middle, and its difference between the ends. Rows that leave the
    image are left out.
    """
    along = np.linspace(-0.5 + ENDS, 0.5 - ENDS, rows, dtype=np.float64)
    outward = line_px[0] + along * line_px[1]
    (mx, my), (dx, dy), (nx, ny) = ((a + b) / 2).tolist(), (b - a).tolist(), _outward(a, b).tolist()
    at_x = ((mx + along * dx + outward * nx)[:, None] + across_px * nx).astype(np.float32)
    at_y = ((my + along * dy + outward * ny)[:, None] + across_px * ny).astype(np.float32)
    grey = cv2.remap(patch, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    # the image is convex: a row whose ends lie in it lies in it
    whole = np.isfinite(grey[:, 0]) & np.isfinite(grey[:, -1])
    if whole.all():
        return along, np.asarray(grey, dtype=np.float64)
    return along[whole], np.asarray(grey[whole], dtype=np.float64)


def _derivative(grey: Array, step_px: float, smooth_px: float) -> Array:
    """Derivative along the last axis, grey levels a pixel, by a Gaussian; repeated ends, same length."""
    if grey.size == 0:  # no profile lies inside the image
        return np.zeros(grey.shape)
    flat = np.atleast_2d(grey)
    out = cv2.filter2D(flat, cv2.CV_64F, _kernel(step_px, smooth_px), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.float64).reshape(grey.shape)


@lru_cache(maxsize=64)
def _kernel(step_px: float, smooth_px: float) -> Array:
    """(1, n) derivative of a Gaussian, a pixel."""
    half = int(np.ceil(3 * smooth_px / step_px))
    x = np.arange(-half, half + 1) * step_px
    gauss = np.exp(-0.5 * (x / smooth_px) ** 2)
    return np.asarray((x / smooth_px**2 * gauss / gauss.sum())[None, :], dtype=np.float64)


def _fit_sides(
    patches: list[NDArray[np.float32]], corners_px: Array, reach: float, tilt_px: float, height_px: float,
    given_sigma_px: float,
) -> list[_Side | None]:
    """The plate's edge near each side: direction, a step's pieces, then the edge model; None where none shows.

    patches: the picture for each side. Where the step next to the given outline is not explained well (lettering near the
    edge, a band, a recess), the other steps are fitted too.
    """
    step = max(STEP_PX, reach / SAMPLES)
    across = np.asarray(np.arange(np.floor(-1.3 * reach / step), np.ceil(1.3 * reach / step) + 1) * step, np.float64)
    levels = {id(p): _levels(p, corners_px) for p in patches}
    inks, grounds = np.array([levels[id(p)] for p in patches]).T
    grounds = np.where([p is patches[0] for p in patches], grounds, np.nan)  # a band's level is its own
    looks = [
        _look(patches[i], corners_px[i], corners_px[(i + 1) % 4], reach, tilt_px, across, given_sigma_px) for i in range(4)
    ]
    here: list[list[tuple[_Tried, EdgeFit]]] = [[] for _ in range(4)]
    for more in (False, True):
        tried: list[_Tried] = []
        for i, look in enumerate(looks):
            if look is None or (more and any(_good(f, given_sigma_px) for _, f in here[i])):
                continue
            offsets = look.offsets_px[1:] if more else look.offsets_px[:1]
            before = [t for t, _ in here[i]]
            tried += _steps(patches[i], i, corners_px[i], corners_px[(i + 1) % 4], look, offsets, across, height_px, before,
                           bool(np.isnan(grounds[i])))
            if more:
                tried += [_to_valley(t, across) for t in dict.fromkeys(before) if t.valley_px is not None]
        if not tried:
            continue
        which = [t.i for t in tried]
        fits = fit_edges(
            np.array([t.profile for t in tried]), across, np.array([t.start_px for t in tried]), height_px, inks[which],
            given_sigma_px, np.array([(t.inner_px, t.outer_px) for t in tried]), grounds[which],
            np.array([t.text_px for t in tried]),
        )
        for t, both in zip(tried, fits, strict=True):
            here[t.i] += [(t, fit) for fit in (both[:1] if t.to_valley else both)]
    low_px = LOW_SIGMA_PX * (LOW_HEIGHT_PX / height_px) ** 2
    return [_chosen(found, given_sigma_px, low_px) if found else None for found in here]


def _good(fit: EdgeFit, given_sigma_px: float) -> bool:
    """Whether an edge is explained so well that no other one needs a look."""
    return fit.misfit < GOOD_MISFIT and abs(fit.line_off) < 1.5 and abs(fit.x_px) < 2 * given_sigma_px


def _chosen(tried: list[tuple[_Tried, EdgeFit]], given_sigma_px: float, low_px: float) -> _Side:
    """The most credible of a side's fits; what the others say about the place is part of its sigma."""
    misfit = np.array([MISFIT_COST * np.log(max(f.misfit, LEAST_MISFIT)) for _, f in tried])
    blind = np.array([LEFT_OUT_COST * t.to_valley for t, _ in tried])
    line = np.array([0.5 * f.line_off**2 + (BAND_LINE_COST if t.band and f.thickness_px > 0.1 else 0.0) for t, f in tried])
    cost = misfit + blind + line + np.array([(f.x_px / given_sigma_px) ** 2 for _, f in tried])
    k = int(cost.argmin())
    weight = np.exp(-0.5 * np.minimum(cost - cost[k], 60.0))
    weight /= weight.sum()
    place = np.array([f.x_px for _, f in tried])
    doubt = float(np.sqrt(weight @ (place - place[k]) ** 2))
    t, best = tried[k]
    shift = best.x_px - t.start_px
    return replace(
        t.side, at_start_px=t.side.at_start_px + shift, at_end_px=t.side.at_end_px + shift, blur_px=best.spread_px,
        sigma_px=float(np.sqrt(t.side.sigma_px**2 + best.sigma_px**2 + doubt**2 + low_px**2)),
    )


def _look(
    patch: NDArray[np.float32], a: Array, b: Array, reach: float, tilt_px: float, across: Array, given_sigma_px: float
) -> _Look | None:
    """A side's direction and the steps down across it, the most credible one first; None where there is none."""
    guess = _direction(patch, a, b, reach, tilt_px, max(0.7, 2 * given_sigma_px))
    if guess is None:
        return None
    _, grey = _profiles(patch, a, b, _rows(a, b), across, (0.0, guess[1]))
    if not len(grey):  # the turned side leaves the image
        return None
    profile = _middle(grey)
    offsets = near_steps(profile, across, given_sigma_px)
    first = first_step(profile, across)
    if first is not None and all(abs(first - o) >= SAME_STEP_PX for o in offsets):
        offsets.append(first)
    return _Look(guess[1], tuple(offsets)) if offsets else None


def _rows(a: Array, b: Array) -> int:
    return int(np.clip(np.hypot(*(b - a)), 24, 72))


def _steps(
    patch: NDArray[np.float32], i: int, a: Array, b: Array, look: _Look, offsets_px: tuple[float, ...], across: Array,
    height_px: float, before: list[_Tried], band: bool,
) -> list[_Tried]:
    """Steps of one side as lines with their mean profiles; those that turn out to be one already tried are left out."""
    found: list[_Tried] = []
    fine = np.asarray(np.arange(-16, 17) * STEP_PX, np.float64)
    for offset in offsets_px:
        line = (offset, look.tilt_px)
        along, grey = _profiles(patch, a, b, int(np.clip(np.hypot(*(b - a)), 4 * PIECES, 120)), fine, line)
        side = _measure(along, fine, _derivative(grey, STEP_PX, SMOOTH_PX), line)
        if side is None:
            continue
        start = (side.at_start_px + side.at_end_px) / 2
        if any(abs(start - t.start_px) < SAME_STEP_PX for t in before + found):
            continue
        _, grey = _profiles(patch, a, b, _rows(a, b), across, (0.0, side.at_end_px - side.at_start_px))
        if len(grey):
            profile = _middle(grey)
            inner, outer, text = _extent(profile, across, start, height_px)
            valley = _valley(profile, across, start)
            near = abs(start) < VALLEY_REACH * height_px  # farther away it is lettering
            known = valley if valley is not None and valley < outer and near else None
            found.append(_Tried(i, side, profile, start, inner, outer, text, known, band))
            if before:
                found += [_to_valley(found[-1], across)] if known is not None else []
    return found


def _to_valley(tried: _Tried, across: Array) -> _Tried:
    return replace(tried, outer_px=float(across[-1]) if tried.valley_px is None else tried.valley_px, to_valley=True)


def _extent(profile: Array, across: Array, start_px: float, height_px: float) -> tuple[float, float, float]:
    """From where to where a profile belongs to one step, and where lettering just inside of it ends (NaN: there is none).

    Inside: as far as the ground is even, or over the end of lettering that leaves no even ground. Outside: up to what
    follows without a rise and is another step down.
    """
    at = min(int(np.searchsorted(across, start_px)), len(profile) - 1)
    top = at
    while top > 0 and profile[top - 1] >= profile[top]:
        top -= 1
    limit = profile[top] - 0.2 * (profile[top] - float(profile[at : at + 8].min(initial=profile[top])))
    begin = top
    while begin > 0 and profile[begin - 1] > limit:
        begin -= 1
    inner, text = float(across[begin]), float("nan")
    if begin > 0 and start_px - inner < NARROW_GROUND_PX:
        low = begin
        while low > 0 and profile[low - 1] < profile[low]:
            low -= 1
        half = (profile[low] + profile[top]) / 2
        text = float(across[low + int(np.argmax(profile[low : top + 1] >= half))])
        inner = max(float(across[low]), text - 1.0)
    step = float(across[1] - across[0])
    fall = -_derivative(profile, step, max(SMOOTH_PX, step))
    k = at
    while k + 1 < len(fall) and 0 < fall[k + 1] <= fall[k]:
        k += 1
    turn = k
    while k + 1 < len(fall) and fall[k + 1] >= fall[k] >= 0:
        k += 1
    # a shoulder nearer than that is the plate's own border line, blurred
    other = k > turn and across[k] - start_px > BORDER_OF_HEIGHT * height_px + 1.0
    return inner, float(across[turn]) if other else float(across[-1]), text


def _valley(profile: Array, across: Array, start_px: float) -> float | None:
    """Offset up to which the profile falls beyond a step, where it rises again behind: a border line, or a narrow recess."""
    k = min(int(np.searchsorted(across, start_px)), len(profile) - 1)
    while k + 1 < len(profile) and profile[k + 1] <= profile[k]:
        k += 1
    rises = k + 1 < len(profile) and float(profile[k:].max()) - float(profile[k]) >= MIN_STEP_GREY
    return float(across[k]) if rises else None


def near_steps(profile: Array, offsets_px: Array, given_sigma_px: float) -> list[float]:
    """Offsets of the one or two steps down of a profile that are strong and near the given outline."""
    step = float(offsets_px[1] - offsets_px[0])
    fall = -_derivative(profile, step, max(SMOOTH_PX, step))
    k = np.flatnonzero((fall[1:-1] >= fall[:-2]) & (fall[1:-1] > fall[2:])) + 1
    least = max(MIN_STEP_GREY, STEP_SHARE * float(np.ptp(profile))) / (np.sqrt(2 * np.pi) * 2 * max(SMOOTH_PX, step))
    k = k[fall[k] >= least]
    near = np.sqrt(fall[k]) * np.exp(-0.5 * (offsets_px[k] / (2 * given_sigma_px)) ** 2)
    order = np.argsort(-near)[:2]
    return [float(offsets_px[k[i]]) for i in order if near[i] > HOPELESS * near[order[0]]]


def _middle(rows: Array) -> Array:
    """(m,) mean of the middle half of each column's values: a median with less noise, and quicker."""
    n = len(rows)
    ranked = np.sort(rows, axis=0)
    return np.asarray(ranked[n // 4 : max(n // 4 + 1, n - n // 4)].mean(axis=0))


def _levels(patch: NDArray[np.float32], corners_px: Array) -> tuple[float, float]:
    """Grey levels of the lettering and of the ground: the darkest and the brighter part of the plate's middle."""
    x0, y0, x1, y1 = bounds(corners_px)
    dx, dy = 0.12 * (x1 - x0), 0.25 * (y1 - y0)
    middle = patch[max(0, int(y0 + dy)) : int(y1 - dy) + 1, max(0, int(x0 + dx)) : int(x1 - dx) + 1]
    sparse = middle[:: 1 + middle.shape[0] // 24, :: 1 + middle.shape[1] // 96]
    seen = np.sort(sparse[np.isfinite(sparse)])
    return (float(seen[len(seen) // 25]), float(seen[len(seen) - 1 - len(seen) // 8])) if len(seen) else (0.0, np.nan)


def _direction(
    patch: NDArray[np.float32], a: Array, b: Array, reach: float, tilt_px: float, tilt_sigma_px: float
) -> tuple[float, float] | None:
    """Offset at the middle and difference between the ends of the line with the most coherent edge.

    For every tilt the rows are shifted and averaged: lettering and clutter cancel, an edge along the whole side stays.
    """
    step = max(0.5, reach / COARSE_STEPS)
    across = np.asarray(np.arange(-np.ceil(reach / step) - 2, np.ceil(reach / step) + 3) * step)
    rows = 32
    along, grey = _profiles(patch, a, b, rows, across)
    if len(along) < 0.6 * rows:
        return None
    slope = np.clip(_derivative(grey, step, max(SMOOTH_PX, step)), -60.0, 60.0)  # a lamp must not outvote the side
    prior = np.exp(-0.5 * (across / (0.7 * reach)) ** 2)
    columns, n = slope.shape[1], max(1, round(tilt_px / (2 * step)))
    tilts = 2 * step * np.arange(-n, n + 1)
    shift = np.rint(along * tilts[:, None] / step).astype(np.int64)
    index = np.maximum(np.minimum(np.arange(columns) + shift[:, :, None], columns - 1), 0)
    taken = slope.ravel()[index + columns * np.arange(len(along))[:, None]]
    strength = np.abs(taken.mean(axis=1)) * prior * np.exp(-0.5 * (tilts / tilt_sigma_px) ** 2)[:, None]
    k, top = divmod(int(strength.argmax()), columns)
    best, best_value = (float(across[top]), float(tilts[k])), float(strength[k, top])
    # a step of c grey levels has the slope c / (sqrt(2 pi) spread), spread at least the smoothing
    if best_value < MIN_STEP_GREY / (np.sqrt(2 * np.pi) * 2 * max(SMOOTH_PX, step)):
        return None
    return best


def first_step(profile: Array, offsets_px: Array) -> float | None:
    """Offset of the first step down of a light-ground profile, outward from its ground; None where it has no step."""
    turns = _turning_points(profile, max(MIN_STEP_GREY, STEP_SHARE * float(np.ptp(profile))))
    if len(turns) < 2:
        return None
    inner = [t for t in turns[:-1] if offsets_px[t] < 0.3 * abs(float(offsets_px[0]))] or turns[:1]
    ground_at = max(inner, key=lambda t: float(profile[t]))
    return _steepest(profile, offsets_px, ground_at, turns[turns.index(ground_at) + 1])


def _turning_points(profile: Array, least: float) -> list[int]:
    """Indices of ends and extrema between which the profile rises or falls by at least `least`."""
    values = profile.tolist()  # scalars of lists are quicker than those of arrays
    turns, low, high, rising = [0], 0, 0, 0
    for i, value in enumerate(values):
        if value < values[low]:
            low = i
        if value > values[high]:
            high = i
        if rising >= 0 and values[high] - value >= least:
            if high != turns[-1]:
                turns.append(high)
            rising, low = -1, i
        elif rising <= 0 and value - values[low] >= least:
            if low != turns[-1]:
                turns.append(low)
            rising, high = 1, i
    last = high if rising > 0 else low
    if rising and last != turns[-1]:
        turns.append(last)
    return turns


def _steepest(profile: Array, offsets_px: Array, i: int, j: int) -> float:
    """Offset of the steepest place between two indices."""
    slope = np.abs(np.diff(profile[i : j + 1]))
    # several equal slopes: their middle
    k = np.flatnonzero(slope >= 0.98 * slope.max()).mean()
    step = float(offsets_px[1] - offsets_px[0])
    return float(offsets_px[i] + (k + 0.5) * step)


def _measure(along: Array, offsets: Array, slope: Array, line_px: tuple[float, float]) -> _Side | None:
    """Sub-pixel offsets of the pieces of a line by the parabola through the slope's peak, then a Tukey line fit."""
    if len(along) < 2 * PIECES:
        return None
    middle = len(offsets) // 2
    sign = 1.0 if slope[:, middle - 2 : middle + 3].mean() >= 0 else -1.0
    rows = len(along) // PIECES * PIECES  # a few rows at the end are left out
    window = sign * slope[:rows, middle - 6 : middle + 7]
    pieces = window.reshape(PIECES, -1, window.shape[1]).mean(axis=1)
    k = pieces.argmax(axis=1)
    piece = np.arange(PIECES)
    top = pieces[piece, k]
    good = (k > 0) & (k < pieces.shape[1] - 1) & (top >= MIN_STEP_GREY / 8)
    if good.sum() < max(4, PIECES // 2):
        return None
    piece, k, top = piece[good], k[good], top[good]
    before, after = pieces[piece, k - 1], pieces[piece, k + 1]
    x = along[:rows].reshape(PIECES, -1).mean(axis=1)[piece]
    peak = offsets[middle - 6 + k] + 0.5 * (before - after) / (before - 2 * top + after) * STEP_PX
    y = line_px[0] + x * line_px[1] + peak
    fit = _tukey_line(x, y, np.sqrt(top))
    if fit is None:
        return None
    at, tilt, sigma = fit
    peak_slope = window.mean(axis=0)
    spread = float(np.clip(peak_slope, 0, None).sum() * STEP_PX / (np.sqrt(2 * np.pi) * max(peak_slope.max(), 1e-6)))
    return _Side(
        at_start_px=at - 0.5 * tilt,
        at_end_px=at + 0.5 * tilt,
        sigma_px=float(np.hypot(sigma, FLOOR_PX)),
        blur_px=float(np.sqrt(max(spread**2 - SMOOTH_PX**2, 0.0))),
    )


def _tukey_line(x: Array, y: Array, weight: Array) -> tuple[float, float, float] | None:
    """Robust line y = at + tilt x: (at, tilt, sigma of the line at its ends); None where fewer than 4 points agree."""
    points = list(zip(x.tolist(), y.tolist(), weight.tolist(), strict=True))  # ten numbers: quicker by themselves than as arrays
    n = len(points)
    at, tilt, robust = 0.0, 0.0, [1.0] * n
    for _ in range(5):
        w = [p[2] * r for p, r in zip(points, robust, strict=True)]
        total = sum(w)
        mx = sum(v * p[0] for v, p in zip(w, points, strict=True)) / total
        my = sum(v * p[1] for v, p in zip(w, points, strict=True)) / total
        sxx = sum(v * (p[0] - mx) ** 2 for v, p in zip(w, points, strict=True))
        sxy = sum(v * (p[0] - mx) * (p[1] - my) for v, p in zip(w, points, strict=True))
        tilt = sxy / sxx if sxx > 1e-12 else 0.0
        at = my - tilt * mx
        residual = [abs(p[1] - at - tilt * p[0]) for p in points]
        reach = 4.685 * max(1.4826 * sorted(residual)[n // 2], 0.03)
        robust = [max(1 - (r / reach) ** 2, 0.0) ** 2 for r in residual]
        if sum(r > 0.2 for r in robust) < 4:
            return None
    used = [(p[0], p[1] - at - tilt * p[0]) for p, r in zip(points, robust, strict=True) if r > 0.2]
    middle = sum(u for u, _ in used) / len(used)
    rms = sqrt(sum(r * r for _, r in used) / (len(used) - 2))
    leverage = 1 / len(used) + 0.25 / max(sum((u - middle) ** 2 for u, _ in used), 1e-6)
    return at, tilt, rms * sqrt(leverage * n / len(used))


def _intersection(p: tuple[Array, Array], q: tuple[Array, Array]) -> Array:
    """Where two lines, each through two points, meet; the end they share when they are parallel."""
    (a, b), (c, d) = p, q
    r, s = b - a, d - c
    cross = r[0] * s[1] - r[1] * s[0]
    if abs(cross) < 1e-9:
        return b
    t = ((c[0] - a[0]) * s[1] - (c[1] - a[1]) * s[0]) / cross
    return np.asarray(a + t * r)
