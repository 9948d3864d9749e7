"""Which steps down across a side may be the plate's edge: its direction, the steps nearby, what belongs to each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.edge_line import PIECES, Side, measured_side
from tmde_edge.vision.edge_profiles import MIN_STEP_GREY, SMOOTH_PX, STEP_PX, Array, derivative, middle_mean, profiles

BORDER_OF_HEIGHT = 0.08  # border line and margin, in plate heights
COARSE_STEPS = 28  # samples on either side of the given outline when the side's direction is looked for
HOPELESS = 0.1  # of the most credible step's weight
NARROW_GROUND_PX = 2.5  # between lettering and edge: narrower, blur keeps it from its level
SAME_STEP_PX = 0.5
STEP_SHARE = 0.14  # of the profile's whole contrast: smaller steps are noise
VALLEY_REACH = 0.06  # of the plate's height: a step with a rise behind that may still be the plate's edge


@dataclass(frozen=True, slots=True)
class Look:
    """A side's direction, as the difference of the outward offset between its ends, and the offsets of the steps there."""

    tilt_px: float
    offsets_px: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A step of side i that may be the plate's edge: its line, mean profile, place, where its ground begins and its body ends."""

    i: int
    side: Side
    profile: Array
    start_px: float
    inner_px: float
    outer_px: float
    text_px: float  # where lettering next to it ends; NaN without
    valley_px: float | None  # up to where it falls, where the profile rises again behind
    band: bool = False  # beside a blue band
    to_valley: bool = False  # what lies beyond the valley is left out: only a plain step is credible


def look_across(
    patch: NDArray[np.float32], a: Array, b: Array, reach: float, tilt_px: float, across: Array, given_sigma_px: float
) -> Look | None:
    """A side's direction and the steps down across it, the most credible one first; None where there is none."""
    guess = _direction(patch, a, b, reach, tilt_px, max(0.7, 2 * given_sigma_px))
    if guess is None:
        return None
    _, grey = profiles(patch, a, b, _rows(a, b), across, (0.0, guess[1]))
    if not len(grey):  # the turned side leaves the image
        return None
    profile = middle_mean(grey)
    offsets = near_steps(profile, across, given_sigma_px)
    first = first_step(profile, across)
    if first is not None and all(abs(first - o) >= SAME_STEP_PX for o in offsets):
        offsets.append(first)
    return Look(guess[1], tuple(offsets)) if offsets else None


def _rows(a: Array, b: Array) -> int:
    return int(np.clip(np.hypot(*(b - a)), 24, 72))


def steps_of(
    patch: NDArray[np.float32], i: int, a: Array, b: Array, look: Look, offsets_px: tuple[float, ...], across: Array,
    height_px: float, before: list[Tried], band: bool,
) -> list[Tried]:
    """Steps of one side as lines with their mean profiles; those that turn out to be one already tried are left out."""
    found: list[Tried] = []
    fine = np.asarray(np.arange(-16, 17) * STEP_PX, np.float64)
    for offset in offsets_px:
        line = (offset, look.tilt_px)
        along, grey = profiles(patch, a, b, int(np.clip(np.hypot(*(b - a)), 4 * PIECES, 120)), fine, line)
        side = measured_side(along, fine, derivative(grey, STEP_PX, SMOOTH_PX), line)
        if side is None:
            continue
        start = (side.at_start_px + side.at_end_px) / 2
        if any(abs(start - t.start_px) < SAME_STEP_PX for t in before + found):
            continue
        _, grey = profiles(patch, a, b, _rows(a, b), across, (0.0, side.at_end_px - side.at_start_px))
        if len(grey):
            profile = middle_mean(grey)
            inner, outer, text = _extent(profile, across, start, height_px)
            valley = _valley(profile, across, start)
            near = abs(start) < VALLEY_REACH * height_px  # farther away it is lettering
            known = valley if valley is not None and valley < outer and near else None
            found.append(Tried(i, side, profile, start, inner, outer, text, known, band))
            if before:
                found += [up_to_valley(found[-1], across)] if known is not None else []
    return found


def up_to_valley(tried: Tried, across: Array) -> Tried:
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
    fall = -derivative(profile, step, max(SMOOTH_PX, step))
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
    fall = -derivative(profile, step, max(SMOOTH_PX, step))
    k = np.flatnonzero((fall[1:-1] >= fall[:-2]) & (fall[1:-1] > fall[2:])) + 1
    least = max(MIN_STEP_GREY, STEP_SHARE * float(np.ptp(profile))) / (np.sqrt(2 * np.pi) * 2 * max(SMOOTH_PX, step))
    k = k[fall[k] >= least]
    near = np.sqrt(fall[k]) * np.exp(-0.5 * (offsets_px[k] / (2 * given_sigma_px)) ** 2)
    order = np.argsort(-near)[:2]
    return [float(offsets_px[k[i]]) for i in order if near[i] > HOPELESS * near[order[0]]]


def _direction(
    patch: NDArray[np.float32], a: Array, b: Array, reach: float, tilt_px: float, tilt_sigma_px: float
) -> tuple[float, float] | None:
    """Offset at the middle and difference between the ends of the line with the most coherent edge.

    For every tilt the rows are shifted and averaged: lettering and clutter cancel, an edge along the whole side stays.
    """
    step = max(0.5, reach / COARSE_STEPS)
    across = np.asarray(np.arange(-np.ceil(reach / step) - 2, np.ceil(reach / step) + 3) * step)
    rows = 32
    along, grey = profiles(patch, a, b, rows, across)
    if len(along) < 0.6 * rows:
        return None
    slope = np.clip(derivative(grey, step, max(SMOOTH_PX, step)), -60.0, 60.0)  # a lamp must not outvote the side
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
