"""What a camera can measure of a plate at which distance: expected one-sigma per cue, before anything is bought.

Bolts are left out: not every plate shows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.geometry.planar import rectangle_mm
from tmde_edge.messages import CueRange, GlyphSighting, PlateSighting, Point
from tmde_edge.plates.standard import PlateStandard
from tmde_edge.ranging.model import UNKNOWN_OUTLINE_MM, UNKNOWN_PITCH_OF_GLYPH
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.settings import RangingSettings

DISTANCES_M = (1.0, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0)
CORNER_SIGMA_PX = 0.35  # what a good detector reaches on a clean plate
GLYPH_SIGMA_PX = 0.20
_GLYPH_ASPECT = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetRow:
    """One distance: sizes in the image, the expected sigma of the whole measurement and of every cue by itself.

    sigma_m is None beyond the reach; `reason` then says why.
    """

    distance_m: float
    plate_width_px: float
    char_height_px: float
    sigma_m: float | None
    cues: tuple[CueRange, ...]
    reason: str | None


def ideal_sighting(standard: PlateStandard, camera: Camera, distance_m: float, *, corner_sigma_px: float = CORNER_SIGMA_PX,
                   glyph_sigma_px: float = GLYPH_SIGMA_PX) -> PlateSighting:
    """The plate facing the camera on its optical axis, without errors; sigmas as stated."""
    outline = standard.outline_belief()
    width_mm, height_mm = (outline[0][0], outline[1][0]) if outline else UNKNOWN_OUTLINE_MM
    main = standard.main_class.height
    tallest_mm = main.belief("glyph_height")[0] if main is not None else 0.6 * height_mm / len(standard.rows)
    pitch = standard.pitch_belief()
    pitch_mm = pitch[0] if pitch else UNKNOWN_PITCH_OF_GLYPH * tallest_mm

    def project(points_mm: Sequence[tuple[float, float]]) -> list[Point]:
        flat = np.column_stack([np.asarray(points_mm, dtype=np.float64) / 1000, np.full(len(points_mm), distance_m)])
        return [(float(x), float(y)) for x, y in camera.project(flat)]

    glyphs = []
    for row, text in enumerate(standard.rows):
        y = height_mm * ((row + 0.5) / len(standard.rows) - 0.5)
        for place, key in enumerate(text):
            if key == " ":
                continue
            size = standard.glyphs[key].height
            h = size.belief("glyph_height")[0] if size is not None else tallest_mm
            x, w = (place - (len(text) - 1) / 2) * pitch_mm, _GLYPH_ASPECT * h
            left, right, top, bottom = project([(x - w / 2, y), (x + w / 2, y), (x, y - h / 2), (x, y + h / 2)])
            glyphs.append(GlyphSighting(left_px=left, right_px=right, top_px=top, bottom_px=bottom, row=row,
                                        sigma_tb_px=glyph_sigma_px, sigma_lr_px=glyph_sigma_px))
    corners = project([(float(x), float(y)) for x, y in rectangle_mm(width_mm, height_mm)])
    px_per_mm = camera.focal_px / (1000 * distance_m)
    stroke = standard.main_class.stroke
    return PlateSighting(
        track_id=0, corners_px=(corners[0], corners[1], corners[2], corners[3]), corners_sigma_px=corner_sigma_px, score=1.0,
        glyphs=tuple(glyphs), char_height_px=tallest_mm * px_per_mm, light_on_dark=standard.light_on_dark,
        stroke_px=stroke.belief("stroke")[0] * px_per_mm if stroke is not None else None,
        border_px=standard.border.belief("border")[0] * px_per_mm if standard.border is not None else None,
    )


def range_budget(camera: Camera, standards: Sequence[PlateStandard], settings: RangingSettings | None = None, *,
                 distances_m: Sequence[float] = DISTANCES_M, corner_sigma_px: float = CORNER_SIGMA_PX,
                 glyph_sigma_px: float = GLYPH_SIGMA_PX) -> list[BudgetRow]:
    """Rows for the first of `standards` as the plate seen, all of them as what is expected (unsure costs sigma)."""
    ranger = Ranger(settings or RangingSettings(), standards)
    return [_row(ranger, standards[0], camera, d, corner_sigma_px, glyph_sigma_px) for d in distances_m]


def reach_m(camera: Camera, standards: Sequence[PlateStandard], settings: RangingSettings | None = None, *,
            longest_m: float = 200.0) -> float:
    """The distance beyond which no metric answer is given, to 0.1 m; 0 where there is none at all."""
    ranger = Ranger(settings or RangingSettings(), standards)

    def answers(distance_m: float) -> bool:
        row = _row(ranger, standards[0], camera, distance_m, CORNER_SIGMA_PX, GLYPH_SIGMA_PX)
        return row.sigma_m is not None

    grid = [d for d in np.geomspace(0.5, longest_m, 25).tolist() if answers(d)]
    if not grid:
        return 0.0
    near, far = grid[-1], min(grid[-1] * 1.3, longest_m)
    while far - near > 0.05:
        middle = (near + far) / 2
        near, far = (middle, far) if answers(middle) else (near, middle)
    return round(float(near), 1)


def one_line(camera: Camera, standards: Sequence[PlateStandard], settings: RangingSettings | None = None) -> str:
    """The service's start-up line: sigma at three distances and the reach."""
    rows = range_budget(camera, standards, settings, distances_m=(5.0, 10.0, 20.0, 30.0))
    parts = [f"{100 * r.sigma_m / r.distance_m:.1f} % at {r.distance_m:g} m" for r in rows if r.sigma_m is not None]
    parts.append(f"no range beyond {reach_m(camera, standards, settings):g} m")
    return f"range budget for {standards[0].id}: " + ", ".join(parts)


def _row(ranger: Ranger, standard: PlateStandard, camera: Camera, distance_m: float, corner_sigma_px: float,
         glyph_sigma_px: float) -> BudgetRow:
    plate = ideal_sighting(standard, camera, distance_m, corner_sigma_px=corner_sigma_px, glyph_sigma_px=glyph_sigma_px)
    measured, _, reason = ranger.measure(plate, camera, np.eye(3), 0)
    (left, _), (right, _) = plate.corners_px[0], plate.corners_px[1]
    return BudgetRow(
        distance_m=distance_m, plate_width_px=right - left, char_height_px=plate.char_height_px or 0.0,
        sigma_m=measured.sigma_m if measured is not None else None, cues=measured.cues if measured is not None else (),
        reason=reason,
    )
