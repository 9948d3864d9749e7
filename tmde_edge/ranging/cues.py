"""The paper's cues: each a length in the image and its true size, D = f H / h, with its own sigma.

"Typography-Based Monocular Distance Estimation Framework for Vehicle Safety Systems" (arXiv 2603.22781): the pinhole
size equation D = f H / h, its error propagation sigma_D = (D / h) sigma_h, and the inverse-variance sum of the cues.
We add the true size's own tolerance to sigma_D; a cue whose true size the standard does not give is absent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tmde_edge.messages import CueRange
from tmde_edge.plates.standard import PlateStandard
from tmde_edge.ranging.features import Features
from tmde_edge.ranging.settings import RangingSettings

# How well a stroke, a border line or a spacing is located, px (one sigma of the length).
STROKE_SIGMA_PX = 0.25
BORDER_SIGMA_PX = 0.4
PAPER_CUES = ("char_height", "stroke_width", "char_spacing", "border")


@dataclass(frozen=True, slots=True)
class Cue:
    """One measured length (normalised image units = px / focal) and its true size in metres, each with one sigma."""

    name: str
    length: float
    length_sigma: float
    size_m: float
    size_sigma_m: float

    @property
    def distance_m(self) -> float:
        """D = f H / h."""
        return self.size_m / self.length

    @property
    def noise_m(self) -> float:
        """sigma_D = (D / h) sigma_h: the image's part."""
        return self.distance_m / self.length * self.length_sigma

    @property
    def sigma_m(self) -> float:
        """The image's part and the true size's tolerance."""
        return float(np.hypot(self.noise_m, self.distance_m * self.size_sigma_m / self.size_m))

    def as_range(self, used: bool) -> CueRange:
        return CueRange(cue=self.name, distance_m=self.distance_m, sigma_m=self.sigma_m, used=used)


def char_height(features: Features, standard: PlateStandard, tall: np.ndarray, settings: RangingSettings) -> Cue | None:
    """Mean height of the tallest class; `tall` marks its glyphs (n,) bool."""
    height = standard.main_class.height
    if height is None:
        return None
    size, size_sigma = height.belief("glyph_height")
    heights = features.heights[tall]
    bias = features.glyph_bias(settings.glyph_bias_px, settings.glyph_resolved_px)
    if len(heights):
        length = float(heights.mean())
        each = 2 * features.sigma_tb[tall] ** 2 + (settings.glyph_jitter * heights) ** 2
        spread = float(heights.std(ddof=1)) / len(heights) ** 0.5 if len(heights) > 2 else 0.0
        noise = max(float(np.sqrt(each.sum())) / len(heights), spread)
    elif features.char_height is not None:
        length, noise = features.char_height, 0.5 / features.focal_px
    else:
        return None
    return Cue("char_height", length, float(np.hypot(noise, bias)), size / 1000, size_sigma / 1000)


def stroke_width(features: Features, standard: PlateStandard) -> Cue | None:
    """Mean stroke of the characters."""
    stroke = standard.main_class.stroke
    if stroke is None or features.stroke is None:
        return None
    size, sigma = stroke.belief("stroke")
    return Cue("stroke_width", features.stroke, STROKE_SIGMA_PX / features.focal_px, size / 1000, sigma / 1000)


def char_spacing(features: Features, standard: PlateStandard, settings: RangingSettings) -> Cue | None:
    """Centre-to-centre spacing of neighbours, where the standard makes it one number."""
    belief = standard.pitch_belief()
    if belief is None:
        return None
    steps: list[float] = []
    for run in features.runs:
        centres = (features.left[run] + features.right[run]) / 2
        steps += np.sqrt(np.sum(np.diff(centres, axis=0) ** 2, axis=1)).tolist()
    length = float(np.mean(steps)) if steps else features.spacing
    if length is None or length <= 0:  # glyphs one on the other have no spacing
        return None
    places = max(len(steps), 1)
    jitter = settings.pitch_jitter_mm / belief[0] * length
    edge = float(features.sigma_lr.mean()) if len(features.sigma_lr) else 0.5 / features.focal_px
    return Cue("char_spacing", length, float(np.hypot(edge, jitter)) * 2**0.5 / places, belief[0] / 1000, belief[1] / 1000)


def border(features: Features, standard: PlateStandard) -> Cue | None:
    """Thickness of the printed border."""
    if standard.border is None or features.border is None:
        return None
    size, sigma = standard.border.belief("border")
    return Cue("border", features.border, BORDER_SIGMA_PX / features.focal_px, size / 1000, sigma / 1000)


def bolt_spacing(features: Features, standard: PlateStandard, settings: RangingSettings) -> Cue | None:
    """Distance between the bolts that hold the plate, mean of the rows in which a pair is seen (a cue of arXiv 2607.00319)."""
    if standard.hole_spacing is None or not len(features.bolts):
        return None
    size, sigma = standard.hole_spacing.belief("hole")
    apart = features.bolts[:, 1] - features.bolts[:, 0]
    rows = len(apart)
    noise = float(np.sqrt(2 * np.sum(features.bolts_sigma**2))) / rows
    play = 2 * (settings.bolt_sigma_mm**2 + settings.bolt_jitter_mm**2 / rows)
    length = float(np.hypot(apart[:, 0], apart[:, 1]).mean())
    return Cue("bolt_spacing", length, noise, size / 1000, float(np.hypot(sigma, play**0.5)) / 1000)


def plate_width(features: Features, standard: PlateStandard, settings: RangingSettings) -> Cue | None:
    """The baseline every plate ranger uses: the plate's width."""
    outline = standard.outline_belief()
    rough = 0.0 if features.refined else settings.unrefined_width_sigma
    seen = (settings.outline_sigma_mm, settings.outline_bias_px, rough)
    return _side("plate_width", features.width_sigma, features, features.width, outline[0] if outline else None, seen)


def plate_height(features: Features, standard: PlateStandard, settings: RangingSettings) -> Cue | None:
    """The plate's height."""
    outline = standard.outline_belief()
    rough = 0.0 if features.refined else settings.unrefined_height_sigma
    seen = (settings.outline_sigma_tb_mm, settings.outline_bias_px, rough)
    return _side("plate_height", features.height_sigma, features, features.height, outline[1] if outline else None, seen)


def _side(name: str, sigma: float, features: Features, length: float | None, belief: tuple[float, float] | None,
          seen: tuple[float, float, float]) -> Cue | None:
    """seen: where an edge is seen, mm and px (one sigma each), and the relative sigma of the length besides."""
    if length is None or belief is None or length <= 0:
        return None
    edge_mm, edge_px, rough = seen
    noise = float(np.hypot(sigma, 2**0.5 * edge_px / features.focal_px))
    size_sigma = float(np.sqrt(belief[1] ** 2 + 2 * edge_mm**2 + (rough * belief[0]) ** 2))
    return Cue(name, length, noise, belief[0] / 1000, size_sigma / 1000)


def all_cues(features: Features, standard: PlateStandard, tall: np.ndarray, settings: RangingSettings) -> tuple[Cue, ...]:
    """Every cue that is measured and whose true size the standard gives."""
    found = (
        char_height(features, standard, tall, settings), stroke_width(features, standard),
        char_spacing(features, standard, settings), border(features, standard),
        bolt_spacing(features, standard, settings), plate_width(features, standard, settings),
        plate_height(features, standard, settings),
    )
    return tuple(c for c in found if c is not None)
