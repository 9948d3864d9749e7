"""Focal length from plates at stated distances: f = P D / H per capture, by the plate's height, its width and the joint fit.

Each capture is ranged with a guessed f until its joint fit answers the stated distance; the captures are then averaged,
or solved together with the offset between the lens and the point that the tape began at.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from tmde_edge.errors import UsageError
from tmde_edge.geometry.pinhole import Camera, view_from_vehicle
from tmde_edge.messages import PlateSighting, RangeMeasurement
from tmde_edge.plates.standard import PlateStandard, Size
from tmde_edge.ranging.model import expectation
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.scale_memory import TrackScale
from tmde_edge.ranging.settings import RangingSettings

Floats = NDArray[np.float64]

TAPE_SIGMA_M = 0.01  # of a stated distance: tape, knots, where exactly the lens is
RULER_MM = 1.0  # limits of what a ruler gives
_PRIOR_DOF = 2.0  # few captures tell little about their own scatter
_PLATE_HEIGHT_SIGMA_M = 0.02  # how level the ground is and the plate is held
_MAX_PITCH_RAD = 0.35
_STEPS = 25
_CLOSE = 1e-7  # relative change of f at which the iteration stops


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """One stated distance and what was seen there: one plate, once or in several frames of the same size."""

    name: str
    distance_m: float  # lens to plate centre along the vehicle's forward axis; along the line of sight where straight
    width_px: int
    height_px: int
    sightings: tuple[PlateSighting, ...]
    straight: bool = False
    edges_differ: float = 0.0  # relative, of opposite edges as first found,
    aspect: float | None = None  # and height over width


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureFocal:
    """What one capture says: f by each way, sigmas relative.

    `common` is what the plate's true sizes may be off, the same in all captures; `own` all the rest: noise, pixels, pose.
    """

    capture: Capture
    f_px: float  # by the joint fit
    own_sigma: float
    common_sigma: float
    by_height_px: float | None  # f = P D / H, the plate taken as facing us
    by_height_sigma: float | None
    by_width_px: float | None
    by_width_sigma: float | None
    yaw_rad: float
    lean_rad: float
    roll_rad: float
    down: float  # of the plate's centre: m down a m ahead, in the axes the capture was ranged in
    straight_over_forward: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatePose:
    """Attitude of the camera while calibrating, from plates on level ground at several distances; None: cannot be told."""

    pitch_rad: float | None
    pitch_sigma_rad: float | None
    roll_rad: float
    roll_sigma_rad: float
    lens_above_plate_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateCalibration:
    """The focal length of an image of width_px x height_px and how far it can be trusted."""

    width_px: int
    height_px: int
    f_px: float
    sigma: float  # relative, one sigma
    captures: tuple[CaptureFocal, ...]
    residuals: tuple[float, ...]  # (measured - stated) / stated distance of each capture
    offset_m: float | None  # from the lens back to where the tape began, where it was an unknown: true = stated + offset
    offset_sigma_m: float | None
    trend_m: float  # the offset that the residuals suggest, and its sigma, whether it was an unknown or not
    trend_sigma_m: float
    pose: PlatePose


def capture_focal(
    capture: Capture, standard: PlateStandard, settings: RangingSettings, *, pitch_rad: float = 0.0, roll_rad: float = 0.0,
    lens: Camera | None = None,
) -> CaptureFocal | str:
    """f of one capture, or why it has none. `lens`: principal point and distortion where they are known already."""
    view = view_from_vehicle(pitch_rad, roll_rad)
    ranger = Ranger(settings, [standard])
    found: list[tuple[float, RangeMeasurement, TrackScale]] = []
    seen: list[PlateSighting] = []
    reason = "no plate"
    for sighting in capture.sightings:
        one = _solve(capture, sighting, ranger, view, standard, lens)
        if isinstance(one, str):
            reason = one
        else:
            found.append(one)
            seen.append(sighting)
    if not found:
        return reason
    logs = np.log([f for f, _, _ in found])
    f = float(np.exp(np.median(logs)))
    noise = float(np.median([m.noise_m / m.distance_m for _, m, _ in found]))
    if len(found) > 1:
        noise = max(noise, float(logs.std(ddof=1))) / len(found) ** 0.5
    typical = int(np.argsort(logs)[len(logs) // 2])
    assumed = float(np.median([m.scale_sigma for _, m, _ in found]))
    common = _size_sigma(capture, seen[typical], found[typical][0], standard, settings, view, lens, assumed)
    cues = {name: [(f_ * m.distance_m / c.distance_m, c.sigma_m / c.distance_m) for f_, m, _ in found for c in m.cues
                   if c.cue == name] for name in ("plate_height", "plate_width")}  # fmt: skip
    height, width = (_typical(cues[name]) for name in ("plate_height", "plate_width"))
    _, middle, scale = found[typical]
    u, v = middle.lateral_m / middle.distance_m, middle.down_m / middle.distance_m
    return CaptureFocal(
        capture=capture, f_px=f, own_sigma=math.sqrt(noise**2 + assumed**2 - common**2), common_sigma=common,
        by_height_px=height[0], by_height_sigma=height[1], by_width_px=width[0], by_width_sigma=width[1],
        yaw_rad=scale.yaw_rad, lean_rad=scale.lean_rad, roll_rad=scale.roll_rad, down=v,
        straight_over_forward=math.sqrt(1 + u * u + v * v),
    )


def _solve(capture: Capture, sighting: PlateSighting, ranger: Ranger, view: Floats, standard: PlateStandard,
           lens: Camera | None) -> tuple[float, RangeMeasurement, TrackScale] | str:
    """f at which the joint fit of one sighting gives the stated distance."""
    f = _first_focal(capture, sighting, standard)
    if f is None:
        return "neither the plate's outline nor its characters were measured"
    for _ in range(_STEPS):
        measured, scale, reason = ranger.measure(sighting, _camera(capture, f, lens), view, 0, None)
        if measured is None:
            return reason or "not ranged"
        given = measured.distance_m
        if capture.straight:
            given = math.hypot(measured.distance_m, measured.lateral_m, measured.down_m)
        step = capture.distance_m / given
        f *= step
        if abs(step - 1) < _CLOSE:
            return f, measured, scale
    return "no focal length puts this plate at the stated distance"


def _size_sigma(capture: Capture, sighting: PlateSighting, f_px: float, standard: PlateStandard, settings: RangingSettings,
                view: Floats, lens: Camera | None, assumed: float) -> float:
    """How far f moves with the plate's true sizes one sigma off, relative; at most `assumed`.

    The range's own scale sigma holds more than that: pose priors and pixel errors, which the next capture draws anew.
    """
    expected = expectation(standard, settings)
    sigma = np.sqrt(expected.sizes.covariance.diagonal())
    k = expected.classes
    moved = []
    for i, key in enumerate((*expected.keys, "plate_width", "plate_height")):
        grown = _grown(standard, key if i < k else "", float(1 + sigma[i]), key if i >= k else "")
        one = _solve(capture, sighting, Ranger(settings, [grown]), view, grown, lens) if grown is not None else None
        if one is not None and not isinstance(one, str):
            moved.append(math.log(one[0] / f_px))
    return min(math.hypot(*moved), assumed) if moved else assumed


def _grown(standard: PlateStandard, glyph: str, factor: float, side: str) -> PlateStandard | None:
    """The standard with one class of characters or one side of the plate larger; None where it states no such size."""
    def scaled(size: Size) -> Size:
        values = {name: None if v is None else v * factor for name, v in (("mm", size.mm), ("min", size.min), ("max", size.max))}
        return msgspec.structs.replace(size, **values)

    if glyph:
        height = standard.glyphs[glyph].height
        if height is None:
            return None
        changed = msgspec.structs.replace(standard.glyphs[glyph], height=scaled(height))
        return msgspec.structs.replace(standard, glyphs={**standard.glyphs, glyph: changed})
    size = getattr(standard, side)
    return None if size is None else msgspec.structs.replace(standard, **{side: scaled(size)})


def _first_focal(capture: Capture, sighting: PlateSighting, standard: PlateStandard) -> float | None:
    outline = standard.outline_belief()
    c = np.array(sighting.corners_px)
    if outline is not None and np.isfinite(c).all():
        return capture.distance_m * float(np.hypot(*(c[1] - c[0]))) * 1000 / outline[0][0]
    height = standard.main_class.height
    if height is not None and sighting.char_height_px:
        return capture.distance_m * sighting.char_height_px * 1000 / height.belief("glyph_height")[0]
    return None


def _camera(capture: Capture, f_px: float, lens: Camera | None) -> Camera:
    w, h = capture.width_px, capture.height_px
    if lens is not None:
        lens = lens.scaled_to(w, h)
    return Camera(
        width_px=w, height_px=h, fx_px=f_px, fy_px=f_px if lens is None else f_px * lens.fy_px / lens.fx_px,
        cx_px=(w - 1) / 2 if lens is None else lens.cx_px, cy_px=(h - 1) / 2 if lens is None else lens.cy_px,
        distortion=() if lens is None else lens.distortion, focal_sigma=0.0,
    )


def _typical(pairs: list[tuple[float, float]]) -> tuple[float | None, float | None]:
    if not pairs:
        return None, None
    return float(np.median([p[0] for p in pairs])), float(np.median([p[1] for p in pairs]))


def combine(
    found: Sequence[CaptureFocal], *, tape_sigma_m: float = TAPE_SIGMA_M, with_offset: bool = False,
    known_pose: tuple[float, float] = (0.0, 0.0),
) -> PlateCalibration:
    """Weighted mean of the captures, or with the offset of the tape as a second unknown. Raises ValueError for none.

    With s = D / f of each capture (its distance for f = 1), D + offset = f s is linear in f and offset. Errors: noise and
    the part of the plate's size error that differs between captures, the tape; the rest is common to all of them.
    `known_pose`: pitch and roll that the captures were ranged with.
    """
    if not found:
        raise ValueError("no capture to calibrate from")
    if with_offset and len(found) < 3:
        raise ValueError("the offset as a second unknown needs at least three captures")
    stated = np.array([c.capture.distance_m for c in found])
    logs = np.log([c.f_px for c in found])
    s = stated / np.exp(logs)
    common = min(c.common_sigma for c in found)
    own = np.array([math.sqrt(c.own_sigma**2 + c.common_sigma**2 - common**2) for c in found])
    sigma = np.hypot(own, tape_sigma_m / stated)
    weight = sigma**-2
    mean = float((weight @ logs) / weight.sum())
    trend_m, trend_sigma_m, both = _trend(stated, logs, sigma)
    if with_offset and both is not None:
        f, variance = float(np.exp(both[0])), both[1]
        offset: float | None = trend_m
        chi2 = float(np.sum(((logs - both[0] + np.log1p(trend_m / stated)) / sigma) ** 2))
        free = len(found) - 2
    else:
        f, variance, offset = float(np.exp(mean)), 1.0 / float(weight.sum()), None
        chi2, free = float(np.sum(((logs - mean) / sigma) ** 2)), len(found) - 1
    excess = max(1.0, (chi2 + _PRIOR_DOF) / (free + _PRIOR_DOF))
    first = found[0].capture
    return PlateCalibration(
        width_px=first.width_px, height_px=first.height_px, f_px=f, sigma=math.sqrt(variance * excess + common**2),
        captures=tuple(found), residuals=tuple(((f * s - (offset or 0.0)) / stated - 1.0).tolist()), offset_m=offset,
        offset_sigma_m=None if offset is None else trend_sigma_m * excess**0.5, trend_m=trend_m,
        trend_sigma_m=trend_sigma_m, pose=_pose(found, known_pose),
    )


def _trend(stated_m: Floats, logs: Floats, sigma: Floats) -> tuple[float, float, tuple[float, float] | None]:
    """Offset in m, its sigma, and (log f, its variance) beside it: Gauss-Newton on log f_i = log f - log(1 + offset / D_i).

    An infinite sigma where all distances are the same.
    """
    offset_m, inverse, log_f = 0.0, np.zeros((2, 2)), 0.0
    for _ in range(4):
        rows = np.column_stack([np.ones_like(stated_m), -1.0 / (stated_m + offset_m)]) / sigma[:, None]
        normal = rows.T @ rows
        if np.linalg.cond(normal) > 1e12:
            return 0.0, math.inf, None
        inverse = np.linalg.inv(normal)
        target = logs + np.log1p(offset_m / stated_m) - offset_m / (stated_m + offset_m)
        log_f, offset_m = (float(v) for v in inverse @ rows.T @ (target / sigma))
        offset_m = float(np.clip(offset_m, -0.5 * stated_m.min(), 5.0))
    return offset_m, float(inverse[1, 1] ** 0.5), (log_f, float(inverse[0, 0]))


def _pose(found: Sequence[CaptureFocal], known: tuple[float, float]) -> PlatePose:
    """Roll: plates are mounted level. Pitch: on level ground the plate's centre lies at tan = h / D - pitch below the axis."""
    roll = np.array([c.roll_rad for c in found])
    roll_sigma = float(np.hypot(roll.std(ddof=1), 0.003)) / len(roll) ** 0.5 if len(roll) > 1 else 0.02
    base = {"roll_rad": known[1] - float(np.median(roll)), "roll_sigma_rad": roll_sigma}
    stated = np.array([c.capture.distance_m for c in found])
    if stated.max() < 1.5 * stated.min():
        return PlatePose(pitch_rad=None, pitch_sigma_rad=None, lens_above_plate_m=None, **base)
    down = np.array([c.down for c in found])
    weight = stated / _PLATE_HEIGHT_SIGMA_M  # an error in height counts 1 / D
    rows = np.column_stack([1 / stated, -np.ones_like(stated)]) * weight[:, None]
    inverse = np.linalg.inv(rows.T @ rows)
    x = inverse @ rows.T @ (down * weight)
    left = down * weight - rows @ x
    free = max(len(stated) - 2, 0)
    excess = max(1.0, (float(left @ left) + _PRIOR_DOF) / (free + _PRIOR_DOF))
    pitch = known[0] + math.atan(float(x[1]))
    sigma = math.sqrt(float(inverse[1, 1]) * excess)
    if abs(pitch) > _MAX_PITCH_RAD:
        return PlatePose(pitch_rad=None, pitch_sigma_rad=None, lens_above_plate_m=None, **base)
    return PlatePose(pitch_rad=pitch, pitch_sigma_rad=sigma, lens_above_plate_m=float(x[0]), **base)


def parse_mm(text: str) -> tuple[float, float]:
    """"520x110" as (520.0, 110.0). Raises UsageError."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)[xX,](\d+(?:\.\d+)?)", text.strip())
    if match is None or not all(20 <= float(v) <= 2000 for v in match.groups()):
        raise UsageError(f"--plate-mm {text}: give width x height in millimetres, for example 520x110")
    return float(match[1]), float(match[2])


def measured_plate(
    standard: PlateStandard, width_mm: float, height_mm: float, char_mm: float | None = None
) -> PlateStandard:
    """The standard with the sizes that a ruler gave for this one plate (to about half a millimetre)."""
    def ruled(mm: float) -> Size:
        return Size(mm=mm, min=mm - RULER_MM, max=mm + RULER_MM, verified=True, source="measured by the user")

    main, glyphs = standard.main_key, dict(standard.glyphs)
    if char_mm is not None:
        glyphs[main] = msgspec.structs.replace(glyphs[main], height=ruled(char_mm))
    return msgspec.structs.replace(
        standard, plate_width=ruled(width_mm), plate_height=ruled(height_mm), width_floats=False, glyphs=glyphs
    )
