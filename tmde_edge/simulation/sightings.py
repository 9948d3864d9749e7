"""Sightings straight from a scenario's truth, with noise: judges tracking and warnings over many drives without pictures.

What is here is how a good perception errs (edges with noise of their own and with a part that lasts, missed frames, nothing
below a width), not how ours does: that takes `simulate --check`, which renders.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from tmde_edge.messages import (
    Corners,
    CoursePoint,
    GlyphSighting,
    LaneSighting,
    PlateSighting,
    ScaleChange,
    Sighting,
    TiltChange,
)
from tmde_edge.simulation.camera import Array
from tmde_edge.simulation.drive import Instant, instant, visible_share
from tmde_edge.simulation.scenario import Scenario
from tmde_edge.simulation.scene import plate_corners_px, plate_pose
from tmde_edge.simulation.stills import glyph_corners_px


@dataclass(frozen=True, slots=True, kw_only=True)
class Eyesight:
    """How well it sees; sigmas in pixels, times in seconds."""

    corner_px: float = 0.25  # of a corner, new in every frame
    corner_lasting_px: float = 0.3  # of a corner, shared by frames within `lasting_s`
    edge_px: float = 0.2  # of a character's edge, new in every frame
    edge_lasting_px: float = 0.1  # of all characters' upper (lower) edges together
    lasting_s: float = 0.4
    least_width_px: float = 18.0  # of a plate
    least_glyph_px: float = 5.0  # of a character
    found: float = 0.97  # share of the frames
    lost_s: float = 0.6  # a track unseen so long begins anew
    growth_s: float = 0.1  # base of the rear's growth
    growth_px: float = 0.06  # error of the rear's size in it
    lane_rate_hz: float = 5.0
    lane_px: float = 3.0  # of the vanishing point
    course_m_at_30: float = 0.15  # of the lane's place 30 m ahead
    course_reach_m: float = 45.0
    tilt_px: float = 0.3  # of the far view's movement in one frame


@dataclass(slots=True)
class _Seen:
    """One plate as followed."""

    track_id: int
    last_ns: int
    errors: Array  # lasting ones: four corners' x and y, upper and lower character edge
    anchor: tuple[int, float] | None = None  # time and inverse distance where the growth starts
    glyph_rng: np.random.Generator = field(default_factory=np.random.default_rng)


def sightings(scenario: Scenario, eyesight: Eyesight | None = None) -> Iterator[Sighting]:
    """One a frame, drawn from the scenario's seed."""
    e = eyesight or Eyesight()
    rng = np.random.default_rng((scenario.seed, 17))
    seen: dict[str, _Seen] = {}
    next_id = 1
    before: Instant | None = None
    lanes_ns = -(10**9)
    for frame in range(scenario.frame_count):
        t_s = frame / scenario.rate_hz
        t_ns = round(t_s * 1e9)
        now = instant(scenario, t_s, scenery=False)
        plates: list[PlateSighting] = []
        changes: list[ScaleChange] = []
        for index, actor in enumerate(now.actors):
            corners = plate_corners_px(now.view, now.vehicles[index])
            if not _legible(now, index, corners, e) or rng.random() > e.found:
                continue
            one = seen.get(actor.name)
            if one is None or t_ns - one.last_ns > e.lost_s * 1e9:
                one = seen[actor.name] = _Seen(next_id, t_ns, rng.normal(0, 1, 10))
                next_id += 1
            keep = math.exp(-(t_ns - one.last_ns) * 1e-9 / e.lasting_s)
            one.errors = keep * one.errors + math.sqrt(1 - keep**2) * rng.normal(0, 1, 10)
            one.last_ns = t_ns
            plates.append(_plate(now, index, corners, one, e, rng))
            changes += _growth(now, index, corners, one, t_ns, e, rng)
        tilt = None
        if before is not None:
            down_px = scenario.camera.fy_px * (math.tan(before.pitch_rad) - math.tan(now.pitch_rad))
            tilt = TiltChange(
                t_from_ns=round((frame - 1) / scenario.rate_hz * 1e9), down_px=down_px + float(rng.normal(0, e.tilt_px)),
                sigma_px=e.tilt_px,
            )  # fmt: skip
        lanes = None
        if t_ns - lanes_ns >= 1e9 / e.lane_rate_hz - 1e6 and scenario.style.markings:
            lanes_ns = t_ns
            lanes = _lanes(scenario, now, e, rng)
        before = now
        yield Sighting(
            t_ns=t_ns, frame_index=frame, width_px=scenario.camera.width_px, height_px=scenario.camera.height_px,
            status="ok" if plates else "no_plate", plates=tuple(plates), scale_changes=tuple(changes), lanes=lanes, tilt=tilt,
        )  # fmt: skip


def _legible(now: Instant, index: int, corners: Array, e: Eyesight) -> bool:
    if not np.isfinite(corners).all() or now.vehicles[index].z_m < 0.3:
        return False
    return bool(np.hypot(*(corners[1] - corners[0])) >= e.least_width_px and visible_share(now, index) > 0.97)


def _plate(now: Instant, index: int, corners: Array, one: _Seen, e: Eyesight, rng: np.random.Generator) -> PlateSighting:
    vehicle = now.vehicles[index]
    face = vehicle.face
    moved = corners + e.corner_px * rng.normal(0, 1, (4, 2)) + e.corner_lasting_px * one.errors[:8].reshape(4, 2)
    glyphs: list[GlyphSighting] = []
    boxes = glyph_corners_px(now.view, vehicle, face) if face is not None else np.zeros((0, 4, 2))
    if face is not None and len(boxes):
        heights = np.hypot(*((boxes[:, 0] + boxes[:, 1] - boxes[:, 2] - boxes[:, 3]) / 2).T)
        tallest = float(max(g.height_mm for g in face.glyphs))
        for spec, box, height in zip(face.glyphs, boxes, heights, strict=True):
            if spec.counted and height >= e.least_glyph_px:
                glyphs.append(_glyph(box, spec.height_mm > 0.95 * tallest, spec.row, one, e, rng))
    mains = [g.height_px for g in glyphs if g.main]
    return PlateSighting(
        track_id=one.track_id, corners_px=_as_corners(moved), corners_sigma_px=math.hypot(e.corner_px, e.corner_lasting_px),
        score=0.95, glyphs=tuple(glyphs), char_height_px=float(np.mean(mains)) if len(mains) > 1 else None,
    )  # fmt: skip


def _glyph(box: Array, main: bool, row: int, one: _Seen, e: Eyesight, rng: np.random.Generator) -> GlyphSighting:
    upper, lower, left, right = (
        (box[i] + box[j]) / 2 for i, j in ((0, 1), (3, 2), (0, 3), (1, 2))
    )  # fmt: skip
    down = (lower - upper) / max(float(np.hypot(*(lower - upper))), 1e-9)
    across = (right - left) / max(float(np.hypot(*(right - left))), 1e-9)
    u, d, le, ri = e.edge_px * rng.normal(0, 1, 4)
    upper = upper + (u + e.edge_lasting_px * one.errors[8]) * down
    lower = lower + (d + e.edge_lasting_px * one.errors[9]) * down
    sigma = math.hypot(e.edge_px, e.edge_lasting_px)
    left, right = left + le * across, right + ri * across
    return GlyphSighting(
        left_px=(float(left[0]), float(left[1])), right_px=(float(right[0]), float(right[1])),
        top_px=(float(upper[0]), float(upper[1])), bottom_px=(float(lower[0]), float(lower[1])),
        sigma_tb_px=sigma, sigma_lr_px=sigma, main=main, row=row,
    )  # fmt: skip


def _as_corners(c: Array) -> Corners:
    a, b, d, f = ((float(x), float(y)) for x, y in c)
    return a, b, d, f


def _growth(
    now: Instant, index: int, corners: Array, one: _Seen, t_ns: int, e: Eyesight, rng: np.random.Generator
) -> list[ScaleChange]:
    """Of the rear round the plate, some three plates wide, since its anchor."""
    nearness = 1.0 / float(plate_pose(now.vehicles[index])[0][2])
    out: list[ScaleChange] = []
    if one.anchor is not None and t_ns - one.anchor[0] > 5 * e.growth_s * 1e9:
        one.anchor = None
    if one.anchor is not None and t_ns - one.anchor[0] >= e.growth_s * 1e9 - 1e6:
        sigma = e.growth_px / (2.0 * float(np.hypot(*(corners[1] - corners[0]))))
        ratio = nearness / one.anchor[1] + float(rng.normal(0, sigma))
        out.append(ScaleChange(track_id=one.track_id, t_from_ns=one.anchor[0], ratio=ratio, sigma=sigma))
        one.anchor = None
    if one.anchor is None:
        one.anchor = (t_ns, nearness)
    return out


def _lanes(scenario: Scenario, now: Instant, e: Eyesight, rng: np.random.Generator) -> LaneSighting | None:
    """Where the road some 30 m ahead points to, and how our lane goes on."""
    at = int(np.searchsorted(now.ahead.z_m, 30.0))
    if at < 1 or at >= len(now.ahead.z_m):
        return None
    dx = now.ahead.x_m[at] - now.ahead.x_m[at - 1]
    ahead = now.view.project(np.array([[1e6 * dx / (now.ahead.z_m[at] - now.ahead.z_m[at - 1]), 0.0, 1e6]]))[0]
    x, y = ahead + e.lane_px * rng.normal(0, 1, 2)
    course: list[CoursePoint] = []
    start = float(np.interp(0.5, now.ahead.z_m, now.ahead.x_m))
    lasting = float(rng.normal(0, e.course_m_at_30)) / 30.0**2
    for z in np.geomspace(6.0, e.course_reach_m, 12):
        place = np.array([[np.interp(z, now.ahead.z_m, now.ahead.x_m) - start + lasting * z**2,
                           np.interp(z, now.ahead.z_m, now.ahead.down_m), z]])
        u, v = now.view.project(place)[0]
        course.append((float(u), float(v), scenario.camera.fx_px * (e.course_m_at_30 * (z / 30.0) ** 2 + 0.05) / z))
    return LaneSighting(
        vanishing_px=(float(x), float(y)), sigma_x_px=e.lane_px, sigma_y_px=e.lane_px, course_px=tuple(course)
    )
