"""From a standard and one sighting to what the joint fit expects: which glyph is of which height, priors on all sizes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmde_edge.geometry.planar import poses_of_rays, rectangle_mm
from tmde_edge.plates.standard import PlateStandard
from tmde_edge.ranging.bolts import BoltSize
from tmde_edge.ranging.features import Features, clusters
from tmde_edge.ranging.fit import AFTER_CLASSES, LEAN, LOG_D, POSE, ROLL, YAW, Model, U, V
from tmde_edge.ranging.scale_memory import Sizes, TrackScale
from tmde_edge.ranging.settings import RangingSettings

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# What is assumed where a standard says nothing: no information, but the track can learn it.
UNKNOWN_SIGMA = 0.25
UNKNOWN_GLYPH_OF_HEIGHT = (0.66, 0.36)  # of plates with one row, with two
UNKNOWN_PITCH_OF_GLYPH = 0.70  # of the standards that state both: mean 0.69, scatter 15 %
UNKNOWN_PITCH_SIGMA = 0.20
UNKNOWN_OUTLINE_MM = (520.0, 111.0)

_CLASS_SIGMA = 0.06  # a glyph's log height about its class, when classes are told apart
_NO_CLASS = 3.0  # sigmas at which a glyph belongs to no class
_SCALE_SIGMA = 0.10  # of the distance that the outline suggests
_YAW_C, _LEAN_C, _OUTLINE_C = 2.0, 4.0, 2.0  # Cauchy scales of the priors, in their sigmas
_GAUSSIAN = 1e3
_DISAGREE = 0.05  # log distance by the characters against that by the outline
# Of plates and characters about _LOW_PX high, relative, growing with the square: seen heights come out too large together with
# everything else, and melted characters are counted wrong, which makes their spacing wrong by any amount.
_LOW_PX, _LOW_HEIGHT_SIGMA, _MELTED_PITCH = 6.0, 0.12, 0.04
_LOW_TOGETHER = 0.8  # correlation of that error of the plate's height with the characters' (stills of 17 to 24 px: 0.64 to 0.80)
# Of the width of a plate that low between two blue bands: on a dark or blue body one is left out, or too much taken in.
_BANDS_SIGMA = 0.04
# Of a width with one band inside where the standard has two: the other was left out, for beside a blue body it does not show.
_BAND_LEFT_OUT = 0.08
_MOST_SIGMA = 0.5
_MISSED_PITCH = 0.15  # fewer characters than any plate of the standard has: the spacing spans some that were missed
_TALL_MISSING = 2.0  # cost of having seen small characters only


@dataclass(frozen=True, slots=True)
class Expectation:
    """A standard's sizes as means and one-sigma logs, in metres: classes first, then width, height, pitch."""

    id: str  # the standard's, or that of one kind of its plates
    standard: PlateStandard
    keys: tuple[str, ...]
    share: Floats  # (k,) of the characters that belong to each class
    size_m: Floats  # (k + 3,)
    sizes: Sizes  # prior about log(true or visible size / size_m)
    has_outline: bool
    has_glyph: bool
    has_pitch: bool
    bolts: BoltSize | None
    weight: float = 1.0  # how common this kind of width is

    @property
    def classes(self) -> int:
        return len(self.keys)


def expectations(standard: PlateStandard, settings: RangingSettings) -> tuple[Expectation, ...]:
    """One for each kind of width that the standard's plates have: where it floats, the whole and the shorter ones."""
    outline, kinds = standard.outline_belief(), standard.floating_widths()
    if outline is None or not kinds:
        return (expectation(standard, settings),)
    return tuple(
        replace(_expectation(standard, settings, ((width, sigma), outline[1])), id=standard.id + suffix, weight=share)
        for suffix, (share, width, sigma) in zip(("", " shorter"), kinds, strict=True)
    )


def expectation(standard: PlateStandard, settings: RangingSettings) -> Expectation:
    """Priors of one standard, all its widths together."""
    return _expectation(standard, settings, standard.outline_belief())


def _expectation(
    standard: PlateStandard, settings: RangingSettings, outline: tuple[tuple[float, float], tuple[float, float]] | None
) -> Expectation:
    """The outline's priors include where it is seen (frames, lips), the standard's tolerances all."""
    main = standard.main_key
    distinct: dict[str, tuple[float, float]] = {}
    counts: dict[str, int] = {}
    for key in sorted(standard.glyphs, key=lambda k: k != main):
        height = standard.glyphs[key].height
        if height is None:
            continue
        mean, sigma = height.belief("glyph_height")
        # Classes within a few per cent cannot be told apart: they share one height.
        near = next((k for k, (other, _) in distinct.items() if abs(np.log(mean / other)) < 0.05), None)
        if near is None:
            distinct[key], counts[key] = (mean, sigma), standard.class_counts()[key]
        else:
            counts[near] += standard.class_counts()[key]
    has_glyph = main in distinct
    if not has_glyph:
        share = UNKNOWN_GLYPH_OF_HEIGHT[min(len(standard.rows), 2) - 1]
        guess = share * (outline[1][0] if outline else UNKNOWN_OUTLINE_MM[1])
        distinct, counts = {main: (guess, UNKNOWN_SIGMA * guess)}, {main: 1}
    heights = list(distinct.values())
    if outline is None:
        w, h = UNKNOWN_OUTLINE_MM
        outline_sizes = [(w, UNKNOWN_SIGMA * w), (h, UNKNOWN_SIGMA * h)]
    else:
        seen = (2**0.5 * settings.outline_sigma_mm, 2**0.5 * settings.outline_sigma_tb_mm)
        outline_sizes = [(m, float(np.hypot(s, frame))) for (m, s), frame in zip(outline, seen, strict=True)]
    guess = UNKNOWN_PITCH_OF_GLYPH * heights[0][0]
    pitch = standard.pitch_belief() or (guess, UNKNOWN_PITCH_SIGMA * guess)
    bolts = None
    if standard.hole_spacing is not None:
        spacing, sigma = standard.hole_spacing.belief("hole")
        play = float(np.hypot(sigma, 2**0.5 * settings.bolt_sigma_mm))
        bolts = BoltSize(spacing / 1000, play / spacing, settings.bolt_jitter_mm / 1000)
    every = np.array([*heights, *outline_sizes, pitch])
    relative = every[:, 1] / every[:, 0]
    members = np.array([counts[k] for k in distinct], dtype=np.float64)
    return Expectation(
        id=standard.id, standard=standard, keys=tuple(distinct),
        share=members / max(float(members.sum()), 1.0), size_m=every[:, 0] / 1000,
        has_outline=outline is not None, has_glyph=has_glyph, has_pitch=standard.pitch_belief() is not None,
        bolts=bolts,
        sizes=Sizes(np.zeros(len(every)), np.diag(relative**2)),
    )


def size_bias(expected: Expectation, features: Features, settings: RangingSettings) -> Floats:
    """Covariance (m, m) of log sizes from errors common to one frame: edges that all lie a bit outside, in pixels.

    All classes of characters share theirs; where blur melts them into their row, the plate's height shares it too.
    """
    k = expected.classes
    own = np.zeros(k + AFTER_CLASSES)  # variances of what each size has for itself
    typical = float(np.median(features.heights)) if len(features.heights) else 0.05
    height = features.height
    if expected.has_outline and features.width is not None:
        # what blur makes taller seems to be seen better: the width tells how small it is
        per_m = features.width / float(expected.size_m[k])
        typical = min(typical, per_m * float(expected.size_m[0]))
        height = None if height is None else min(height, per_m * float(expected.size_m[k + 1]))
    shared = np.zeros(k + AFTER_CLASSES)  # one sigma of the common error
    shared[:k] = min(features.glyph_bias(settings.glyph_bias_px, settings.glyph_resolved_px, typical) / typical, _MOST_SIGMA)
    # Corners come from fitted edges: part of their error is common to both ends of an edge.
    rough = (0.0, 0.0) if features.refined else (settings.unrefined_width_sigma, settings.unrefined_height_sigma)
    outline = ((k, features.width, features.width_sigma, rough[0]), (k + 1, features.height, features.height_sigma, rough[1]))
    for place, side, sigma, more in outline:
        if side is not None:
            edge_px = float(np.hypot(settings.outline_bias_px, 0.5 * sigma * features.focal_px))
            own[place] = (2**0.5 * edge_px / (side * features.focal_px)) ** 2 + more**2
    if height is not None:
        lowness = (_LOW_PX / max(height * features.focal_px, 1.0)) ** 2
        if expected.standard.band == "both":
            own[k] += (_BAND_LEFT_OUT if features.one_band else _BANDS_SIGMA * min(lowness, 1.0)) ** 2
        low = min(_LOW_HEIGHT_SIGMA * lowness, _MOST_SIGMA)
        shared[k + 1] = _LOW_TOGETHER * low
        own[k + 1] += (1 - _LOW_TOGETHER**2) * low**2
    if len(features.heights):
        melted = _MELTED_PITCH * (_LOW_PX / max(typical * features.focal_px, 1.0)) ** 2
        missed = _MISSED_PITCH if len(features.heights) < min(expected.standard.char_counts) else 0.0
        own[k + 2] += melted**2 + missed**2
    return np.asarray(np.outer(shared, shared) + np.diag(np.minimum(own, _MOST_SIGMA**2)), dtype=np.float64)


def first_distance_m(expected: Expectation, features: Features) -> float | None:
    """A rough distance from the longest thing seen: plate width, else height, else the tallest characters."""
    k = expected.classes
    guesses = []
    if expected.has_outline:
        guesses = [expected.size_m[k + i] / side for i, side in enumerate((features.width, features.height)) if side]
    if guesses:
        return float(np.exp(np.mean(np.log(guesses))))
    if len(features.heights):
        tallest = clusters(np.log(features.heights))[0]
        return float(expected.size_m[0] / np.median(features.heights[tallest]))
    return None


def assign_classes(expected: Expectation, features: Features, distance_m: float) -> tuple[Ints, float]:
    """Class index per glyph (n,), -1 for none, and the cost of the best reading (chi-square like).

    Every pairing of a cluster of heights with a class fixes a common scale; the scale that explains most wins. So a
    wrong outline (a float width, a frame) does not turn 58 mm letters into 76 mm digits.
    """
    heights = features.heights
    if not len(heights):
        return np.zeros(0, dtype=np.int64), 0.0
    log_mm = np.log(heights * distance_m)
    classes = np.log(expected.size_m[: expected.classes])
    anchored = (expected.has_outline and bool(features.corner_ok.sum() >= 2)) and expected.has_glyph
    # A glyph that cannot be seen to a tenth of its height cannot be told by it either.
    sigma = np.hypot(_CLASS_SIGMA, 1.4 * features.sigma_tb / heights)
    best_cost, best = np.inf, np.zeros(len(heights), dtype=np.int64)
    for cluster, value in itertools.product(clusters(log_mm), classes):
        scale = float(value - np.median(log_mm[cluster]))
        distance = np.abs(log_mm[:, None] + scale - classes[None]) / sigma[:, None]
        choice = distance.argmin(axis=1)
        off = distance[np.arange(len(heights)), choice]
        cost = float(np.sum(np.minimum(off, _NO_CLASS) ** 2))
        if anchored:
            cost += (scale / _SCALE_SIGMA) ** 2
        chosen = np.where(off < _NO_CLASS, choice, -1)
        if not (chosen == 0).any():
            cost += _TALL_MISSING
        if cost < best_cost:
            best_cost, best = cost, chosen.astype(np.int64)
    return best, best_cost


def misplaced(expected: Expectation, glyph_class: Ints) -> float:
    """How many characters would have to change their height class to give the standard's usual shares."""
    seen = np.bincount(glyph_class[glyph_class >= 0], minlength=expected.classes)
    return float(np.abs(seen - seen.sum() * expected.share).sum() / 2)


def build_model(expected: Expectation, features: Features, known: Sizes, bias: Floats, glyph_class: Ints,
                distance_m: float, settings: RangingSettings) -> Model:
    """The fit's model with all priors: angles, position, sizes (learned where a track is followed)."""
    k = expected.classes
    p = POSE + k + AFTER_CLASSES
    mean, information = np.zeros(p), np.zeros((p, p))
    sigma_yaw, sigma_lean = settings.yaw_sigma_rad, settings.lean_sigma_rad
    # The heading is judged anew in every frame: what makes a far plate look turned (its blurred height) is the same in all
    # of them, and a memory would take it for knowledge. The track's last heading only says where to start (starts()).
    reach = expected.size_m[k] / distance_m
    mean[U], mean[V], mean[LOG_D] = features.centre[0], features.centre[1], np.log(distance_m)
    sigma = np.array([sigma_yaw, sigma_lean, settings.roll_sigma_rad, reach, reach, 5.0])
    information[np.arange(POSE), np.arange(POSE)] = sigma**-2
    blurred = known.covariance + bias
    information[POSE:, POSE:] = np.linalg.inv(blurred)
    tail_c = np.full(p, _GAUSSIAN)
    tail_c[YAW], tail_c[LEAN], tail_c[POSE + k : POSE + k + 2] = _YAW_C, _LEAN_C, _OUTLINE_C
    mean[POSE:] = known.mean
    return Model(
        class_height_m=expected.size_m[:k], width_m=float(expected.size_m[k]), height_m=float(expected.size_m[k + 1]),
        pitch_m=float(expected.size_m[k + 2]), glyph_class=glyph_class,
        glyph_jitter=settings.glyph_jitter, pitch_jitter_m=settings.pitch_jitter_mm / 1000,
        mean=mean, information=information, frame_bias=bias,
        tail_sigma=np.concatenate([sigma, np.sqrt(blurred.diagonal())]), tail_c=tail_c,
    )


def starts(expected: Expectation, features: Features, model: Model, state: TrackScale | None) -> list[Floats]:
    """Starting points (p,): the track's last pose; without one, both planar solutions, then the plate facing us."""
    facing = model.mean.copy()
    facing[ROLL] = _row_slope(features)
    if state is not None and state.yaw_sigma_rad < 0.15:
        facing[YAW], facing[LEAN] = state.yaw_rad, state.lean_rad
        return [facing]
    k = expected.classes
    found = []
    if features.corner_ok.all():
        rectangle = rectangle_mm(1000 * model.width_m, 1000 * model.height_m)
        for pose in poses_of_rays(rectangle, features.corners):
            x = facing.copy()
            r, t = pose.rotation, pose.translation_mm / 1000
            x[YAW], x[LEAN] = np.arctan2(r[0, 2], r[2, 2]), np.arcsin(np.clip(r[1, 2], -1, 1))
            x[ROLL] = np.arctan2(r[1, 0], r[1, 1])
            x[U], x[V], x[LOG_D] = t[0] / t[2], t[1] / t[2], np.log(t[2])
            x[LOG_D] += model.mean[POSE + k]
            if abs(x[YAW]) < 1.2 and abs(x[LEAN]) < 0.8:
                found.append(x)
    found.append(facing)
    by_glyph = facing.copy()
    used = model.glyph_class >= 0
    if used.any():
        each = model.class_height_m[model.glyph_class[used]] / features.heights[used]
        by_glyph[LOG_D] = np.log(np.median(each))
        if abs(by_glyph[LOG_D] - facing[LOG_D]) > _DISAGREE:  # an outline that is not the plate's
            for place, side, size_m in ((k, features.width, model.width_m), (k + 1, features.height, model.height_m)):
                if side:
                    by_glyph[POSE + place] = float(np.clip(np.log(side / size_m) + by_glyph[LOG_D], -1.0, 1.0))
            found.append(by_glyph)
    return found


def _row_slope(features: Features) -> float:
    ends = [(a, b) for a, b in ((0, 1), (3, 2)) if features.corner_ok[a] and features.corner_ok[b]]
    if not ends:
        return 0.0
    d = sum((features.corners[b] - features.corners[a] for a, b in ends), np.zeros(2))
    return float(np.clip(np.arctan2(d[1], d[0]), -0.5, 0.5))
