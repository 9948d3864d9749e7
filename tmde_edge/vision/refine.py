"""Sub-pixel plate outline in the source image: edge profiles across the four sides, robust line fits, an honest sigma."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.bands import Banded, with_bands
from tmde_edge.vision.edge_line import Side
from tmde_edge.vision.edge_model import EdgeFit, fit_edges
from tmde_edge.vision.edge_profiles import STEP_PX, Array, grey_patch, outward_normal
from tmde_edge.vision.edge_steps import BORDER_OF_HEIGHT, SAME_STEP_PX, Tried, look_across, steps_of, up_to_valley
from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import bounds, is_convex, size_px

AGREE_ROUNDS = 3
# Of a blue band's outer end (rendered stills: 0.1 px too far out, scatter 0.15); an edge so far inside or outside is another.
BAND_SIGMA_PX, OFF_BAND_PX = 0.35, (0.6, 1.0)
BAND_LINE_COST = 3.0  # of a border line beyond a blue band on a plate that has none else
GIVEN_OF_HEIGHT = 0.06  # one sigma of the given outline, in plate heights
GOOD_MISFIT = 1.5
MISFIT_COST, LEAST_MISFIT = 6.0, 0.2  # of one step against another: so much for each factor e of the misfit
LEAST_SHARE = 0.01  # of belief in a border line, or in none: a standard's maker may err
LEAST_SIDES = 3
LEFT_OUT_COST = 6.0  # of a step that explains only what lies before the next rise
LOW_SIGMA_PX, LOW_HEIGHT_PX = 0.2, 10.0  # of a low plate's edges, which blur joins to lettering and border
MIN_REACH_PX = 2.5
MOVED_SIGMAS = 4.0  # a side further than this from the given outline is another edge
NO_LINE_PX = 0.1  # thinner is none
ODD_SIDE = 0.2  # chance that a side shows no border line though the plate has one, or something like one though it has none
# The given outline's error in its own sigmas: what all sides share (three quarters of it on rendered stills); each one's rest.
OFF_TOGETHER, OFF_EACH = 1.5, 1.2
# What is blue and ends farther inside the outline is a picture, not a band: in sigmas of a given side and of a band's end.
PRINT_SIGMAS = 2.5
REACH_OF_HEIGHT = 0.13  # how far from the given outline an edge is looked for, in plate heights
SAMPLES = 32  # of a profile on either side of the given outline
TILT_OF_HEIGHT = 0.12  # how much the two ends of a side may move against each other
UNEXPECTED = 0.2  # chance of a border line, or of none, below which a side that seems to show it is looked at again


@dataclass(frozen=True, slots=True, kw_only=True)
class OutlineFit:
    """Corners (4, 2) TL, TR, BR, BL with the sigma of one coordinate; blur_px is the edges' own spread (one sigma)."""

    corners_px: Array
    sigma_px: float
    refined: bool
    blur_px: float | None
    side_sigma_px: tuple[float, ...] = ()  # of the top, right, bottom and left line; empty where nothing was refined


def refine_outline(
    image: Image, corners_px: Array, given_sigma_px: float | None = None, light_on_dark: bool | None = None,
    line_share: float = 0.5, colour: Image | None = None,
) -> OutlineFit:
    """The outline near the given corners that the image itself shows; given_sigma_px: how well those are believed.

    light_on_dark: the plate's polarity where it is known. line_share: chance that a printed line runs round it, 0 to 1; where
    line and margin are narrower than a pixel, nothing else tells on which side of them the plate ends. colour: the same image in
    colour, where `image` is a grey one made for this plate.

    A side that shows no edge or leaves the image stays where it was, with the given sigma (a quarter of the search reach where
    none is given), and so does one whose edge is less sure than that or far away. `refined` is False when a side stayed; of a
    given sigma, when two did. A blue band that was left out is taken in (bands.py); where a side's band ends no edge farther
    inside is the plate's, and without any edge the side lies there, if that is surer than what was given.
    """
    if not is_convex(corners_px):
        return OutlineFit(corners_px=corners_px, sigma_px=MIN_REACH_PX, refined=False, blur_px=None)
    height_px = size_px(corners_px)[1]
    reach, tilt_px = REACH_OF_HEIGHT * height_px, TILT_OF_HEIGHT * height_px
    if given_sigma_px is not None:  # a good outline needs only its border's width, and its own doubt
        reach = min(reach, BORDER_OF_HEIGHT * height_px + 4 * given_sigma_px)
        tilt_px = min(tilt_px, max(1.0, 4 * given_sigma_px))
    reach = max(MIN_REACH_PX, reach)
    colour = image if colour is None else colour
    banded = with_bands(colour, corners_px, max(1.0, 2 * (given_sigma_px or 0.0))) if not light_on_dark else None
    if banded is not None:
        corners_px = banded.corners_px
    margin = 1.5 * reach + 4
    patch, shift = grey_patch(image, corners_px, margin)
    dark = _dark_ground(patch, corners_px - shift) if light_on_dark is None else light_on_dark
    patches = [255.0 - patch if dark else patch] * 4
    given_px = given_sigma_px or GIVEN_OF_HEIGHT * height_px
    ends_px = [None] * 4 if banded is None or dark else _band_ends(banded, given_px)
    if any(end is not None for end in ends_px):  # in blue a band is nearly as bright as the ground
        blue = grey_patch(colour[..., 0], corners_px, margin)[0]
        patches = [patch if end is None else blue for end in ends_px]
    sides = _fit_sides(patches, ends_px, corners_px - shift, reach, tilt_px, height_px, given_px, line_share)
    unmoved = reach / 4
    if given_sigma_px is not None:
        unmoved = given_sigma_px
        sides = [s if s is not None and _believed(s, given_sigma_px) else None for s in sides]
    sides = [_at_band(end, unmoved) if side is None else side for side, end in zip(sides, ends_px, strict=True)]
    lines = []
    for i, side in enumerate(sides):
        a, b = corners_px[i], corners_px[(i + 1) % 4]
        n = outward_normal(a, b)
        lines.append((a, b) if side is None else (a + side.at_start_px * n, b + side.at_end_px * n))
    found = [s for s in sides if s is not None]
    corners = np.array([_intersection(lines[i - 1], lines[i]) for i in range(4)])
    if not found or not is_convex(corners) or np.abs(corners - corners_px).max() > 3 * reach:
        return OutlineFit(corners_px=corners_px, sigma_px=unmoved, refined=False, blur_px=None)
    blurs = [s.blur_px for s in found if s.blur_px is not None]
    variances = [unmoved**2 if s is None else s.sigma_px**2 for s in sides]
    return OutlineFit(
        corners_px=corners,
        sigma_px=float(np.sqrt(np.mean(variances))),
        refined=len(found) >= (4 if given_sigma_px is None else LEAST_SIDES),
        blur_px=float(np.median(blurs)) if blurs else None,
        side_sigma_px=tuple(float(v**0.5) for v in variances),
    )


def _believed(side: Side, given_sigma_px: float) -> bool:
    """Whether a side's edge is surer than what was given, and not another thing far away from it."""
    moved = max(abs(side.at_start_px), abs(side.at_end_px))
    return side.sigma_px <= given_sigma_px and moved <= MOVED_SIGMAS * given_sigma_px


def _band_ends(banded: Banded, given_sigma_px: float) -> list[float | None]:
    """Outward offsets of the bands' ends for the top, right, bottom and left side; what ends well inside the plate is print."""
    inside = PRINT_SIGMAS * max(np.hypot(OFF_TOGETHER, OFF_EACH) * given_sigma_px, BAND_SIGMA_PX)
    right, left = (end if end is not None and end > -inside else None for end in (banded.right_px, banded.left_px))
    return [None, right, None, left]


def _at_band(end_px: float | None, given_sigma_px: float) -> Side | None:
    """The side where its band ends, for want of an edge; None where that says no more than what was given."""
    if end_px is None or (given_sigma_px <= BAND_SIGMA_PX and abs(end_px) <= given_sigma_px):
        return None
    return Side(at_start_px=end_px, at_end_px=end_px, sigma_px=BAND_SIGMA_PX, blur_px=None)


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


def _fit_sides(
    patches: list[NDArray[np.float32]], ends_px: Sequence[float | None], corners_px: Array, reach: float, tilt_px: float,
    height_px: float, given_sigma_px: float, line_share: float,
) -> list[Side | None]:
    """The plate's edge near each side: direction, a step's pieces, then the edge model; None where none shows.

    patches: the picture for each side. ends_px: where the side's band ends; no edge inside of it is the plate's. Where the step
    next to the given outline is not explained well (lettering near the edge, a band, a recess), the other steps are fitted too.
    """
    step = max(STEP_PX, reach / SAMPLES)
    across = np.asarray(np.arange(np.floor(-1.3 * reach / step), np.ceil(1.3 * reach / step) + 1) * step, np.float64)
    levels = {id(p): _levels(p, corners_px) for p in patches}
    inks, grounds = np.array([levels[id(p)] for p in patches]).T
    grounds = np.where([p is patches[0] for p in patches], grounds, np.nan)  # a band's level is its own
    looks = [
        look_across(patches[i], corners_px[i], corners_px[(i + 1) % 4], reach, tilt_px, across, given_sigma_px) for i in range(4)
    ]
    here: list[list[tuple[Tried, EdgeFit]]] = [[] for _ in range(4)]
    for more in (False, True):
        tried: list[Tried] = []
        for i, look in enumerate(looks):
            if look is None or (more and any(_good(f, given_sigma_px, line_share) for _, f in here[i])):
                continue
            offsets = look.offsets_px[1:] if more else look.offsets_px[:1]
            before = [t for t, _ in here[i]]
            tried += steps_of(patches[i], i, corners_px[i], corners_px[(i + 1) % 4], look, offsets, across, height_px, before,
                           bool(np.isnan(grounds[i])))
            if more:
                tried += [up_to_valley(t, across) for t in dict.fromkeys(before) if t.valley_px is not None]
        if not tried:
            continue
        which = [t.i for t in tried]
        fits = fit_edges(
            np.array([t.profile for t in tried]), across, np.array([t.start_px for t in tried]), height_px, inks[which],
            given_sigma_px, np.array([(t.inner_px, t.outer_px) for t in tried]), grounds[which],
            np.array([t.text_px for t in tried]),
        )
        for t, both in zip(tried, fits, strict=True):
            here[t.i] += [(t, fit) for fit in (both[:1] if t.to_valley else both) if _at_its_band(fit, ends_px[t.i], height_px)]
    low_px = LOW_SIGMA_PX * (LOW_HEIGHT_PX / height_px) ** 2
    seen = [found for found in here if found]
    costs = iter(_costs(seen, given_sigma_px, line_share))
    return [_chosen(found, next(costs), low_px) if found else None for found in here]


def _at_its_band(fit: EdgeFit, end_px: float | None, height_px: float) -> bool:
    """Whether an edge may be that of a side whose band ends there: not the band's inner end, nor a recess."""
    if end_px is None:
        return True
    inside, outside = OFF_BAND_PX
    return -inside < fit.x_px - end_px < outside + BORDER_OF_HEIGHT * height_px  # a border line may run round the band


def _good(fit: EdgeFit, given_sigma_px: float, line_share: float) -> bool:
    """Whether an edge is explained so well, and as it is expected, that no other one needs a look."""
    expected = line_share if fit.thickness_px > NO_LINE_PX else 1 - line_share
    well = fit.misfit < GOOD_MISFIT and abs(fit.line_off) < 1.5 and abs(fit.x_px) < 2 * given_sigma_px
    return well and expected > UNEXPECTED


def _costs(sides: list[list[tuple[Tried, EdgeFit]]], given_sigma_px: float, line_share: float) -> list[Array]:
    """-2 log credibility (n,) of each side's fits, by themselves and by what the other sides show.

    A plate has a border line all round or none, of which a frame may hide some; and a given outline is too large or too small
    as a whole more than it is skew: with each of both, line or none, the sides' most credible fits agree on that.
    """
    if not sides:
        return []
    own = [_own_costs(tried) for tried in sides]
    places = [np.array([f.x_px for _, f in tried]) for tried in sides]
    lined = [(_lined(tried), tried[0][0].band) for tried in sides]
    with_line, without = (
        _about_common_offset([o + _oddness(*fits, has_line) for o, fits in zip(own, lined, strict=True)], places, given_sigma_px)
        for has_line in (True, False)
    )
    share = min(max(line_share, LEAST_SHARE), 1 - LEAST_SHARE)
    odds = float(np.log(share / (1 - share)))
    return [-2 * np.logaddexp(odds - 0.5 * a, -0.5 * b) for a, b in zip(with_line, without, strict=True)]


def _own_costs(tried: list[tuple[Tried, EdgeFit]]) -> Array:
    """-2 log credibility (n,) of a side's fits by how they explain what is seen there."""
    misfit = np.array([MISFIT_COST * np.log(max(f.misfit, LEAST_MISFIT)) for _, f in tried])
    blind = np.array([LEFT_OUT_COST * t.to_valley for t, _ in tried])
    line = np.array([0.5 * f.line_off**2 for _, f in tried])
    return np.asarray(misfit + blind + line, np.float64)


def _about_common_offset(costs: list[Array], places: list[Array], given_sigma_px: float) -> list[Array]:
    """Costs of all sides' fits, each with the other sides' best, where the given outline is off by one offset and a rest.

    places: offsets of the fits, one array a side.
    """
    rest, common = (OFF_EACH * given_sigma_px) ** -2, (OFF_TOGETHER * given_sigma_px) ** -2

    def about(offset: float) -> list[Array]:
        return [c + rest * (x - offset) ** 2 for c, x in zip(costs, places, strict=True)]

    offset = 0.0
    for _ in range(AGREE_ROUNDS):
        best = [float(x[int(h.argmin())]) for h, x in zip(about(offset), places, strict=True)]
        offset = rest * sum(best) / (rest * len(best) + common)
    here = about(offset)
    total = sum(float(h.min()) for h in here) + common * offset**2
    return [h + (total - float(h.min())) for h in here]


def _lined(tried: list[tuple[Tried, EdgeFit]]) -> NDArray[np.bool_]:
    """Which fits (n,) are of a plate with a border line: the line's own, and a step where such a one from farther in ends."""
    ends = [(t, f.x_px) for t, f in tried if f.thickness_px > NO_LINE_PX]
    return np.array([
        f.thickness_px > NO_LINE_PX or any(t is not other and abs(f.x_px - x) < SAME_STEP_PX for other, x in ends)
        for t, f in tried
    ], np.bool_)  # fmt: skip


def _oddness(lined: NDArray[np.bool_], band: bool, has_line: bool) -> Array:
    """-2 log of the chance (n,) that a side of a plate with a line, or without one, looks like each of its fits.

    A blue band is printed over the line, or inside it: only a plate without any has none there for sure.
    """
    if band:
        return np.where(lined, 0.0 if has_line else BAND_LINE_COST, 0.0)
    return np.asarray(-2 * np.log(np.where(lined == has_line, 1 - ODD_SIDE, ODD_SIDE)), np.float64)


def _chosen(tried: list[tuple[Tried, EdgeFit]], cost: Array, low_px: float) -> Side:
    """The most credible of a side's fits; what the others say about the place is part of its sigma."""
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


def _levels(patch: NDArray[np.float32], corners_px: Array) -> tuple[float, float]:
    """Grey levels of the lettering and of the ground: the darkest and the brighter part of the plate's middle."""
    x0, y0, x1, y1 = bounds(corners_px)
    dx, dy = 0.12 * (x1 - x0), 0.25 * (y1 - y0)
    middle = patch[max(0, int(y0 + dy)) : int(y1 - dy) + 1, max(0, int(x0 + dx)) : int(x1 - dx) + 1]
    sparse = middle[:: 1 + middle.shape[0] // 24, :: 1 + middle.shape[1] // 96]
    seen = np.sort(sparse[np.isfinite(sparse)])
    return (float(seen[len(seen) // 25]), float(seen[len(seen) - 1 - len(seen) // 8])) if len(seen) else (0.0, np.nan)


def _intersection(p: tuple[Array, Array], q: tuple[Array, Array]) -> Array:
    """Where two lines, each through two points, meet; the end they share when they are parallel."""
    (a, b), (c, d) = p, q
    r, s = b - a, d - c
    cross = r[0] * s[1] - r[1] * s[0]
    if abs(cross) < 1e-9:
        return b
    t = ((c[0] - a[0]) * s[1] - (c[1] - a[1]) * s[0]) / cross
    return np.asarray(a + t * r)
