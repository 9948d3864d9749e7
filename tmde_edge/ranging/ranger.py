"""From one sighting of a plate to its distance with an honest sigma: READ THIS FILE FIRST.

`Ranger.measure` looks at which standards are possible (classify), fits each of them jointly (model, fit), mixes their
answers by belief, and learns the track's proportions (scale_memory). `method = "paper"` fuses the paper's cues instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import CueRange, PlateSighting, RangeMeasurement
from tmde_edge.plates.standard import PlateStandard
from tmde_edge.ranging import cues, fuse
from tmde_edge.ranging.bolts import BoltsSay, Judged, believed, judge
from tmde_edge.ranging.classify import StandardClass, classes, layout_log_likelihood, said_by_print, shape_log_likelihood
from tmde_edge.ranging.contradiction import scale_factor
from tmde_edge.ranging.features import Features, clusters, gather
from tmde_edge.ranging.fit import LEAN, LOG_D, POSE, ROLL, YAW, Fit, Model, U, V, solve
from tmde_edge.ranging.model import assign_classes, build_model, first_distance_m, misplaced, size_bias, starts
from tmde_edge.ranging.scale_memory import Evidence, Sizes, TrackScale, learn
from tmde_edge.ranging.settings import RangingSettings

Floats = NDArray[np.float64]

_AMBIGUOUS_COST = 9.0  # a second pose within this cost of the best is kept in the mixture
_SAME_POSE = 0.01  # angles, rad, and log distance: optima nearer than this are one
_MISFIT_SIGMAS = 5.0  # a plate whose proportions differ this much from the learned ones is another plate
_MISFITS_TO_RESET = 3
_STRAIN = 1.3  # a fit under more strain asks for a second look from elsewhere
_SHAPE_SLACK = 3.0  # the cheap look may be wrong by so much in log likelihood
_UNASSIGNED_COST = 9.0  # of a glyph that fits no class of a standard
_OTHERS_EVERY = 4  # frames of a followed track: a class that is not the most believed is fitted no more often
_MISPLACED_COST = 3.0  # of a glyph of another height than the standard's layout has there


@dataclass(frozen=True, slots=True)
class _Answer:
    """One standard's answer: mean and variances of log distance, the fit behind it, and its evidence."""

    group: StandardClass
    log_d: float
    noise_var: float
    prior_var: float
    fit: Fit
    glyph_class: NDArray[np.int64]
    evidence: float
    yaw_sigma_rad: float
    known: Sizes
    bias: Floats
    bolts: BoltsSay
    judged: Judged | None  # of this frame's bolts, where there are any


@dataclass(frozen=True, slots=True)
class _Score:
    """Log belief before a fit, the part that the layout alone adds in every frame, and the part that print adds once."""

    belief: float
    layout: float
    printed: float


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """One class's share of the mixture; weights sum to one."""

    weight: float
    log_d: float
    noise_var: float
    prior_var: float


class Ranger:
    """Ranges plates of the given standards; holds no state between calls but its constant tables."""

    def __init__(self, settings: RangingSettings, standards: Sequence[PlateStandard]) -> None:
        """Raises ValueError for an empty list of standards."""
        if not standards:
            raise ValueError("a ranger needs at least one plate standard")
        self.settings = settings
        self._classes = {c.id: c for c in classes(standards, settings)}
        total = sum(c.weight for c in self._classes.values())
        self._log_prior = {k: float(np.log(c.weight / total)) for k, c in self._classes.items()}

    def measure(
        self, plate: PlateSighting, camera: Camera, view_from_vehicle: Floats, t_ns: int, state: TrackScale | None = None,
    ) -> tuple[RangeMeasurement | None, TrackScale, str | None]:
        """Distance of one plate, the track's memory after it, and where there is no distance the reason.

        `state` is what the last call returned for this track; None for a still or a new track. A memory of another
        track is ignored.
        """
        view = np.asarray(view_from_vehicle, dtype=np.float64)
        known = state if state is not None and state.track_id == plate.track_id else None
        coloured = self._coloured(plate, known)
        features = gather(coloured, camera, view)
        empty = known or TrackScale(track_id=plate.track_id, t_ns=t_ns)
        reason = self._too_little(features, plate)
        if reason:
            return None, empty, reason
        said = said_by_print(self._classes.values(), plate) if len(self._classes) > 1 else {}
        scores = self._scores(plate, features, known, said)
        answers = self._fit_all(features, known, t_ns, scores)
        if answers and known is not None and known.misfits + 1 >= _MISFITS_TO_RESET and self._misfit(answers):
            alone, anew = gather(plate, camera, view), self._scores(plate, features, None, said)
            fresh = self._fit_all(alone, None, t_ns, anew)
            if fresh and not self._misfit(fresh):  # else it is the outline that is wrong, not the memory
                coloured, features, known, scores, answers = plate, alone, None, anew, fresh
        if not answers:
            return None, empty, "no planar pose fits what was seen"
        first = known is None or not known.evidence.looks
        evidence = self._evidence(answers, known, scores, _size_px(features)).with_print(said, first=first)
        belief = evidence.log_belief()
        parts = _hypotheses(answers, belief, known)
        after = self._remember(answers, evidence, belief, parts, known, coloured, t_ns)
        range_, reason = self._result(plate, camera, features, answers, belief, parts, t_ns)
        return range_, after, reason

    def _coloured(self, plate: PlateSighting, known: TrackScale | None) -> PlateSighting:
        """With the colours that were last seen, where this frame had no time to look at them."""
        if plate.colours is not None or known is None or not self.settings.memory:
            return plate
        return replace(plate, colours=known.colours)

    def _too_little(self, features: Features, plate: PlateSighting) -> str | None:
        width = features.width
        glyph = float(features.heights.max()) if len(features.heights) else features.char_height
        s = self.settings
        small_width = width is None or width * features.focal_px < s.min_plate_width_px
        small_glyph = glyph is None or glyph * features.focal_px < s.min_char_height_px
        if small_width and small_glyph:
            if width is None and glyph is None:
                if features.height is not None and features.height * features.focal_px >= s.min_plate_width_px:
                    return None
                return "plate is cut by the frame and no whole character is left" if plate.cut else "nothing measurable"
            seen = f"{0.0 if width is None else width * features.focal_px:.1f} px wide"
            return f"too small: {seen}, below {s.min_plate_width_px:g} px, and its characters below {s.min_char_height_px:g} px"
        return None

    def _fit_all(self, features: Features, known: TrackScale | None, t_ns: int, scores: dict[str, _Score]) -> list[_Answer]:
        """Fits the classes worth it; on a followed track the most believed and one of the others in turn.

        The others stay in the mixture by their remembered ratio to the best, so a track costs two fits at most.
        """
        order = sorted(scores, key=lambda k: -scores[k].belief)
        floor = scores[order[0]].belief + float(np.log(self.settings.belief_floor)) - _SHAPE_SLACK
        worth = [k for k in order if scores[k].belief > floor]
        if known is None:
            chosen = worth[: self.settings.max_fits]
        else:
            turn = 1 + known.frames % max(len(worth) - 1, _OTHERS_EVERY)
            chosen = worth[:1] + worth[turn : turn + 1]
        answers = (self._fit(self._classes[k], features, known, t_ns, scores[k].layout) for k in chosen)
        return [a for a in answers if a is not None]

    def _scores(self, plate: PlateSighting, features: Features, known: TrackScale | None,
                said: dict[str, dict[str, float]]) -> dict[str, _Score]:
        """Belief before this frame's fits; a new plate's comes from a cheap look at its shape and its print."""
        layout = {k: layout_log_likelihood(c, plate, features) for k, c in self._classes.items()}
        believed = known.evidence.log_belief() if known is not None else {}
        if believed:
            return {k: _Score(v, layout[k], 0.0) for k, v in believed.items()}
        printed = {k: sum(values[k] for values in said.values()) for k in self._classes}
        return {
            k: _Score(self._log_prior[k] + layout[k] + printed[k] + shape_log_likelihood(c, features), layout[k], printed[k])
            for k, c in self._classes.items()
        }

    def _fit(self, group: StandardClass, features: Features, known: TrackScale | None, t_ns: int,
             layout: float) -> _Answer | None:
        expected = group.expected
        distance = first_distance_m(expected, features)
        if distance is None:
            return None
        glyph_class, _ = assign_classes(expected, features, distance)
        learned = known.sizes.get(group.id) if known is not None and self.settings.memory else None
        sizes = learned or expected.sizes
        bias = size_bias(expected, features, self.settings)
        model = build_model(expected, features, sizes, bias, glyph_class, distance, self.settings)
        fits = _solutions(features, model, starts(expected, features, model, known))
        if not fits:
            return None
        say = known.bolts.get(group.id, BoltsSay()) if known is not None and self.settings.memory else BoltsSay()
        judged = judge(features, expected.bolts, fits[0]) if expected.bolts is not None and len(features.bolts) else None
        if judged is not None:
            say = say.with_frame(judged.shift, judged.factor)
        first, torn = fits[0], scale_factor(features, model, fits[0])
        best = replace(first, noise=torn**2 * first.noise, prior=torn**2 * first.prior)  # agreeing frames weigh more in a track
        weights = [float(np.exp(-0.5 * (f.cost - best.cost))) for f in fits]
        log_d, spread = fuse.mixture(weights, [f.x[LOG_D] for f in fits], [0.0] * len(fits))
        _, yaw_sigma = fuse.mixture(weights, [f.x[YAW] for f in fits], [f.covariance[YAW, YAW] ** 0.5 for f in fits])
        lost = float(np.sum(glyph_class < 0)) * _UNASSIGNED_COST
        lost += _MISPLACED_COST * max(misplaced(expected, glyph_class) - 1.0, 0.0)  # one may be missed or misread
        layout += judged.evidence if judged is not None else 0.0
        return _Answer(
            group=group, log_d=log_d + say.shift, noise_var=float(best.noise[LOG_D, LOG_D]) + spread**2,
            prior_var=say.factor * float(best.prior[LOG_D, LOG_D]), fit=best, glyph_class=glyph_class,
            evidence=best.evidence - 0.5 * lost + layout, yaw_sigma_rad=yaw_sigma, known=sizes, bias=bias,
            bolts=say, judged=judged,
        )

    def _evidence(self, answers: list[_Answer], known: TrackScale | None, scores: dict[str, _Score], size_px: float) -> Evidence:
        """What speaks for which class; those that were not fitted keep their standing against those that were."""
        fitted = {a.group.id: a.evidence for a in answers}
        if known is None or not known.evidence.looks:
            # The cheap look and the fit measure the same thing but for a constant: take it from the best fit.
            total = {k: self._log_prior[k] + e + scores[k].printed for k, e in fitted.items()}
            best = max(total, key=lambda k: total[k])
            less = min(total[best] - scores[best].belief, 0.0)
            rest = {k: s.belief - s.printed + less for k, s in scores.items() if k not in fitted}
            gained = {k: e - fitted[best] for k, e in fitted.items()}
            before = Evidence({k: v - fitted[best] for k, v in rest.items()}, {})
        else:
            weights = [float(np.exp(scores[k].belief)) for k in fitted]
            usual = fuse.mixture(weights, list(fitted.values()), [0.0] * len(fitted))[0]
            gained, before = {k: e - usual for k, e in fitted.items()}, known.evidence
        return before.with_frame(size_px, gained, self._log_prior)

    def _misfit(self, answers: list[_Answer]) -> bool:
        """Whether even the best standard's learned proportions are far from what is seen."""
        return all(_contradicts(a) for a in answers)

    def _remember(self, answers: list[_Answer], evidence: Evidence, belief: dict[str, float], parts: dict[str, _Hypothesis],
                  known: TrackScale | None, plate: PlateSighting, t_ns: int) -> TrackScale:
        sizes = dict(known.sizes) if known is not None else {}
        share = self.settings.memory_share
        for a in answers:
            cov = a.fit.covariance[POSE:, POSE:]
            # Only a plate seen large tells its proportions: far away blur thickens characters and edges alike, every frame.
            heights_px = sorted(g.height_px for g in plate.glyphs)
            large = bool(heights_px) and heights_px[len(heights_px) // 2] >= self.settings.memory_char_height_px
            sizes[a.group.id] = learn(a.known, a.bias, a.fit.x[POSE:], cov, share) if large else a.known
        best = max(answers, key=lambda a: belief[a.group.id])
        mean, _ = _mixed(parts)
        offsets = {k: p.log_d - mean for k, p in parts.items()}
        misfits = known.misfits + 1 if known is not None and self._misfit(answers) else 0
        bolts = {**(known.bolts if known is not None else {}), **{a.group.id: a.bolts for a in answers if a.bolts.frames}}
        return TrackScale(
            track_id=plate.track_id, t_ns=t_ns, evidence=evidence, log_offsets=offsets, sizes=sizes,
            yaw_rad=float(best.fit.x[YAW]), yaw_sigma_rad=best.yaw_sigma_rad, lean_rad=float(best.fit.x[LEAN]),
            lean_sigma_rad=float(best.fit.covariance[LEAN, LEAN] ** 0.5), roll_rad=float(best.fit.x[ROLL]),
            frames=(known.frames if known is not None else 0) + 1, misfits=misfits, bolts=bolts,
            colours=plate.colours,
        )

    def _result(self, plate: PlateSighting, camera: Camera, features: Features, answers: list[_Answer],
                belief: dict[str, float], parts: dict[str, _Hypothesis], t_ns: int) -> tuple[RangeMeasurement | None, str | None]:
        s = self.settings
        best = max(answers, key=lambda a: belief[a.group.id])
        standard = best.group.expected.standard.id
        believed = sum(float(np.exp(v)) for k, v in belief.items() if self._classes[k].expected.standard.id == standard)
        x = best.fit.x
        measured = self._cues(features, best)
        if s.method == "paper":
            fused = _paper(measured, s.fusion)
            if fused is None:
                return None, "none of the paper's cues is measured"
            distance, noise, prior_var, used = fused
            noise_var = (noise / distance) ** 2
        else:
            mean, spread = _mixed(parts)
            noise_var = sum(p.weight * p.noise_var for p in parts.values())
            prior_var = sum(p.weight * p.prior_var for p in parts.values()) + spread**2
            distance = float(np.exp(mean))
            used = _used_by_fit(best)
        scale_sigma = float(np.hypot(prior_var**0.5, camera.focal_sigma))
        relative = float(np.hypot(scale_sigma, noise_var**0.5))
        if not np.isfinite(distance) or not np.isfinite(relative):
            return None, "the fit did not end at a finite distance"
        if relative > s.max_relative_sigma:
            return None, f"too uncertain: one sigma is {100 * relative:.0f} % of the distance"
        if not s.min_distance_m <= distance <= s.max_distance_m:
            return None, f"{distance:.2f} m lies outside {s.min_distance_m:g} to {s.max_distance_m:g} m"
        lateral_sigma = distance * float(np.hypot(best.fit.covariance[U, U] ** 0.5, x[U] * relative))
        return RangeMeasurement(
            track_id=plate.track_id, t_ns=t_ns, distance_m=distance, sigma_m=distance * relative,
            noise_m=distance * noise_var**0.5, scale_sigma=scale_sigma, lateral_m=distance * float(x[U]),
            lateral_sigma_m=lateral_sigma, down_m=distance * float(x[V]), yaw_rad=float(x[YAW]), standard=standard,
            belief=min(1.0, believed),
            cues=tuple(_with_focal(c.as_range(c.name in used), camera.focal_sigma) for c in measured),
        ), None

    def _cues(self, features: Features, answer: _Answer) -> tuple[cues.Cue, ...]:
        tall = answer.glyph_class == 0
        if not tall.any() and len(features.heights):
            tall = np.zeros(len(features.heights), dtype=bool)
            tall[clusters(np.log(features.heights))[0]] = answer.group.expected.classes == 1
        return cues.all_cues(believed(features, answer.judged), answer.group.expected.standard, tall, self.settings)


def _size_px(features: Features) -> float:
    """How large the plate is seen: its width, else its height, else its characters' height."""
    glyph = float(np.median(features.heights)) if len(features.heights) else None
    return next((v * features.focal_px for v in (features.width, features.height, glyph) if v), 1.0)


def _hypotheses(answers: list[_Answer], belief: dict[str, float], known: TrackScale | None) -> dict[str, _Hypothesis]:
    """What is mixed: the fitted classes, and those of a track that were not fitted now but stood by them before.

    Their remembered distance ratio keeps the mean from jumping when a class enters or leaves the fits.
    """
    best = max(answers, key=lambda a: belief[a.group.id])
    found = {a.group.id: (a.log_d, a.noise_var, a.prior_var) for a in answers}
    if known is not None and best.group.id in known.log_offsets:
        base = best.log_d - known.log_offsets[best.group.id]
        for k, offset in known.log_offsets.items():
            found.setdefault(k, (base + offset, best.noise_var, best.prior_var))
    weights = {k: float(np.exp(belief[k])) for k in found}
    total = sum(weights.values())
    return {k: _Hypothesis(weights[k] / total, *v) for k, v in found.items()}


def _mixed(parts: dict[str, _Hypothesis]) -> tuple[float, float]:
    """Mean log distance and the spread between hypotheses."""
    return fuse.mixture([p.weight for p in parts.values()], [p.log_d for p in parts.values()], [0.0] * len(parts))


def _solutions(features: Features, model: Model, from_: list[Floats]) -> list[Fit]:
    """The distinct optima that the image cannot exclude, best first: the mirrored pose, or a turn against a wrong outline."""
    found: list[Fit] = []
    for x in from_:
        # Where the heading is known no better than it is large, both solutions are one broad optimum; but a wild
        # corner may have been explained by a turn of the plate: then the other starts are worth their time.
        first = found[0] if found else None
        if first is not None and first.strain < _STRAIN and abs(first.x[YAW]) < 1.5 * first.covariance[YAW, YAW] ** 0.5:
            break
        fit = solve(features, model, x)
        if fit is not None:
            found.append(fit)
    distinct: list[Fit] = []
    for fit in sorted(found, key=lambda f: f.cost):
        if distinct and fit.cost > distinct[0].cost + _AMBIGUOUS_COST:
            break
        if all(np.abs(fit.x[:POSE] - other.x[:POSE]).max() >= _SAME_POSE for other in distinct):
            distinct.append(fit)
    return distinct


def _contradicts(answer: _Answer) -> bool:
    """Whether the plate is not the one whose sizes were learned: they were pulled far, or its characters called wild."""
    blurred = np.sqrt((answer.known.covariance + answer.bias).diagonal())
    pulled = float(np.max(np.abs(answer.fit.x[POSE:] - answer.known.mean) / blurred))
    return pulled > _MISFIT_SIGMAS or answer.fit.rejected > 0.5


def _used_by_fit(answer: _Answer) -> frozenset[str]:
    expected, fit = answer.group.expected, answer.fit
    used = set()
    if expected.has_glyph and fit.glyphs_used:
        used.add("char_height")
    if expected.has_outline and fit.corners_used >= 2:
        used |= {"plate_width", "plate_height"}
    if expected.has_pitch and fit.pitch_used:
        used.add("char_spacing")
    if answer.judged is not None and answer.judged.believed.any():
        used.add("bolt_spacing")
    return frozenset(used)


def _paper(measured: tuple[cues.Cue, ...], fusion: bool) -> tuple[float, float, float, frozenset[str]] | None:
    """Distance, its noise, relative variance from the true sizes, and the cues used, as the paper fuses them."""
    names = cues.PAPER_CUES if fusion else ("char_height",)
    chosen = [c for c in measured if c.name in names] or [c for c in measured if c.name == "plate_width"]
    if not chosen:
        return None
    distance, sigma = fuse.inverse_variance([c.distance_m for c in chosen], [c.sigma_m for c in chosen])
    weights = np.array([c.sigma_m**-2 for c in chosen])
    weights /= weights.sum()
    noise = float(np.sqrt(np.sum((weights * [c.noise_m for c in chosen]) ** 2)))
    return distance, noise, max(sigma**2 - noise**2, 0.0) / distance**2, frozenset(c.name for c in chosen)


def _with_focal(cue: CueRange, focal_sigma: float) -> CueRange:
    sigma = float(np.hypot(cue.sigma_m, focal_sigma * cue.distance_m))
    return CueRange(cue=cue.cue, distance_m=cue.distance_m, sigma_m=sigma, used=cue.used)
