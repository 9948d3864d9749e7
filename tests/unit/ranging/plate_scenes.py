"""Sightings of plates by exact projection, for tests of the ranging."""

from __future__ import annotations

import numpy as np

from tmde_edge.geometry.pinhole import Camera, turn_clockwise, turn_down, turn_right
from tmde_edge.messages import GlyphSighting, PlateSighting
from tmde_edge.plates.standard import PlateStandard

CAMERA = Camera(width_px=1920, height_px=1080, fx_px=1400, fy_px=1400, cx_px=959.5, cy_px=539.5)
AHEAD = np.eye(3)


def sighting(
    standard: PlateStandard,
    camera: Camera = CAMERA,
    *,
    distance_m: float = 10.0,
    yaw: float = 0.0,
    lean: float = 0.0,
    roll: float = 0.0,
    u: float = 0.0,
    v: float = 0.05,
    rng: np.random.Generator | None = None,
    corner_sigma: float = 0.0,
    glyph_sigma: float = 0.0,
    width_mm: float | None = None,
    height_mm: float | None = None,
    glyph_mm: float | None = None,
    pitch_mm: float | None = None,
    view_from_vehicle: np.ndarray = AHEAD,
    track_id: int = 1,
    glyphs: bool = True,
    cut: bool = False,
) -> PlateSighting:
    """The plate's centre at distance_m (1, u, v) in the vehicle's axes; sigmas in px are drawn and stated."""
    outline = standard.outline_belief() or ((520.0, 1.0), (111.0, 1.0))
    w, h = width_mm or outline[0][0], height_mm or outline[1][0]
    rotation = turn_right(yaw) @ turn_down(lean) @ turn_clockwise(roll)
    where = np.array([u, v, 1.0]) * distance_m
    rng = rng or np.random.default_rng(0)

    def project(points_mm: object) -> np.ndarray:
        return camera.project((np.asarray(points_mm, float) / 1000 @ rotation[:, :2].T + where) @ view_from_vehicle.T)

    rows = len(standard.rows)
    heights = {k: (g.height.belief("glyph_height")[0] if g.height else 0.62 * h / rows) for k, g in standard.glyphs.items()}
    if glyph_mm:
        heights = {k: v * glyph_mm / heights[standard.main_key] for k, v in heights.items()}
    belief = standard.pitch_belief()
    pitch = pitch_mm or (belief[0] if belief else 0.7 * heights[standard.main_key])
    found = []
    for r, text in enumerate(standard.rows):
        y = h * ((r + 0.5) / rows - 0.5)
        for i, key in enumerate(text):
            if key == " ":
                continue
            g, x = heights[key], (i - (len(text) - 1) / 2) * pitch
            q = project([(x - 0.3 * g, y), (x + 0.3 * g, y), (x, y - g / 2), (x, y + g / 2)])
            q[:2, 0] += rng.normal(0, glyph_sigma, 2)
            q[2:, 1] += rng.normal(0, glyph_sigma, 2)
            left, right, top, bottom = (tuple(p) for p in q.tolist())
            found.append(
                GlyphSighting(
                    left_px=left,
                    right_px=right,
                    top_px=top,
                    bottom_px=bottom,
                    row=r,
                    sigma_tb_px=max(glyph_sigma, 0.02),
                    sigma_lr_px=max(glyph_sigma, 0.02),
                )
            )
    corners = project(np.array([[-w, -h], [w, -h], [w, h], [-w, h]]) / 2) + rng.normal(0, corner_sigma, (4, 2))
    tl, tr, br, bl = (tuple(p) for p in corners.tolist())
    return PlateSighting(
        track_id=track_id,
        corners_px=(tl, tr, br, bl),
        corners_sigma_px=max(corner_sigma, 0.02),
        score=1.0,
        glyphs=tuple(found) if glyphs else (),
        light_on_dark=standard.light_on_dark,
        cut=cut,
    )
