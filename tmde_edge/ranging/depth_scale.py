"""From relative inverse depth to metres: the paper's smoothed scale, and a robust recursive fit of scale and shift.

A network such as MiDaS gives m = bigger is nearer, related to the distance D along the optical axis by 1/D = a m + b with a
and b unknown and drifting. Plates with a measured range give pairs (m, 1/D); so does the free road in front of the lead, where
the camera's height and pitch give D. The alignment is state, fed in time order; nothing here reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from tmde_edge.geometry.pinhole import Camera, view_from_vehicle
from tmde_edge.messages import DepthEstimate, DepthReading, Pose, Sighting

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
FloatArray = NDArray[np.float64]
Box = tuple[float, float, float, float]  # x0, y0, x1, y1 in source pixels

RANGE_SIGMA = 0.03  # relative, of a plate's filtered range
LEAST_REGION_SIGMA, MOST_REGION_SIGMA = 0.02, 0.10  # relative, of one region's m: as large as the plates say within these
GROUND_NEAR_M, GROUND_FAR_M, GROUND_HALF_WIDTH_M = 4.0, 40.0, 1.2
GROUND_WORTH = 6.0  # all road cells of a frame together count as so many independent points: they share the pitch
SAME_FRAME_NS = 60_000_000  # a reading is matched to a sighting no further off than this
BOX_MEMORY_S = 3.0  # how long the place of a hidden lead is still looked at
DOUBTS_TO_RESET = 2
FORGOTTEN_S = 12.0  # an older fit says nothing
LEAST_SCALE = 0.01  # 1/m: a flat fit walks as far as one of this slope, or it would stay flat
RESIDUAL_GAIN = 0.25  # of a newest plate error in the residual: four seconds outweigh the first guess
MISFIT = 0.25  # relative: a fit that plates contradict by so much, lastingly, is none
CUT_CORRELATION = 0.3  # successive readings less alike than this are another scene


class DepthSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[depth]` table."""

    kind: Literal["none", "onnx", "recorded"] = "none"  # where relative depth comes from; none: depth is off
    model: str = "midas-v21-small"  # kind onnx: a name of `tmde-edge models list`, or a path to an .onnx file
    folder: str = ""  # kind onnx: where the models lie; "": the state folder
    path: str = ""  # kind recorded: the depth track
    providers: list[str] = []  # of ONNX Runtime, best first; []: the best this board has
    alignment: Literal["affine", "paper"] = "affine"  # 1/D = a m + b by robust recursive fit, or the paper's scale
    rate_hz: Positive = 4.0  # how often the network runs, on the newest frame
    latency_s: NotNegative = 0.15  # --dry-run: a reading is ready this long after its frame
    threads: Annotated[int, Meta(ge=1)] = 1  # of the network; bounded so that depth never starves the main loop
    grid_columns: Annotated[int, Meta(ge=8, le=256)] = 64  # the network's output is kept at this size
    grid_rows: Annotated[int, Meta(ge=6, le=256)] = 48  # and its rows
    scale_drift: Positive = 0.04  # how far the network's scale walks in a second, relative, one sigma
    shift_drift_per_m: Positive = 0.0015  # how far its shift walks in a second, 1/m, one sigma
    ground_points: bool = True  # the road below the horizon also aligns (needs camera.height_m and a known pose)
    min_sigma: Positive = 0.03  # relative, of any distance by depth
    max_age_s: Positive = 1.0  # an older reading says nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """1/D = (scale m/unit + shift): information form of both, as of `t_ns`. Plain state."""

    t_ns: int
    unit: float  # m is divided by this, so that networks of any range are alike
    information: FloatArray  # (2, 2)
    pull: FloatArray  # (2,)
    residual_variance: float = 0.01  # relative, of plates against the fit made before them; starts at 10 %
    plates: int = 0  # plate points since the last reset

    @property
    def solution(self) -> FloatArray:
        """(scale, shift)."""
        return np.asarray(np.linalg.solve(self.information, self.pull), dtype=np.float64)

    @property
    def region_sigma(self) -> float:
        """Relative error of one region's m, as plates have shown it."""
        return min(max(math.sqrt(self.residual_variance), LEAST_REGION_SIGMA), MOST_REGION_SIGMA)

    def inverse_m(self, m: float) -> tuple[float, float]:
        """1/D (1/m) at this m, and its sigma from scale and shift alone."""
        row = np.array([m / self.unit, 1.0])
        variance = float(row @ np.linalg.solve(self.information, row))
        return float(row @ self.solution), math.sqrt(max(variance, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """Pairs for the fit: m, 1/D (1/m), the sigma of 1/D, and how many independent points each is worth."""

    m: FloatArray
    inverse_m: FloatArray
    sigma: FloatArray
    worth: FloatArray


@dataclass(slots=True, kw_only=True)
class _Seen:
    """What estimation knew at one frame."""

    t_ns: int
    camera: Camera
    pose: Pose
    boxes: dict[int, Box]  # where each vehicle is; a hidden one where it was last
    ranges_m: dict[int, float]  # of plates measured in this very frame
    lead: int | None
    lead_m: float | None


@dataclass(slots=True, kw_only=True)
class _Newest:
    """The last reading that was used, and each vehicle's distance by it."""

    t_ns: int
    found: dict[int, tuple[float, float]] = field(default_factory=dict)


class DepthAligner:
    """Keeps the alignment and says how far the lead is by depth. Feed readings and frames in the order they become known."""

    def __init__(self, settings: DepthSettings, camera_height_m: float | None) -> None:
        self._settings = settings
        self._height_m = camera_height_m
        self._alignment: Alignment | None = None
        self._paper_scale: float | None = None
        self._paper_variance = 0.01
        self._grid: FloatArray | None = None
        self._history: list[_Seen] = []
        self._last_box: dict[int, tuple[int, Box]] = {}
        self._doubts = 0
        self._pending: DepthReading | None = None
        self._newest: _Newest | None = None

    @property
    def alignment(self) -> Alignment | None:
        """The state of the affine fit; None before the first reading with a known distance."""
        return self._alignment

    @property
    def reading_t_ns(self) -> int | None:
        """Time of the reading behind the estimates; a filter takes each reading once, when this changes."""
        return self._newest.t_ns if self._newest is not None else None

    def add_reading(self, reading: DepthReading) -> None:
        """Takes a reading; it is used at once, or with its frame's sighting if that is not known yet."""
        self._pending = reading
        self._use_pending(last_chance=False)

    def update(
        self, sighting: Sighting, camera: Camera, pose: Pose, ranges_m: Mapping[int, float], lead: int | None
    ) -> DepthEstimate | None:
        """Remembers what this frame knows and returns the lead's distance by the newest reading, as of that reading.

        `ranges_m` are the tracks' filtered distances: only those with a plate in this sighting align.
        """
        self._remember(sighting, camera, pose, ranges_m, lead)
        self._use_pending(last_chance=True)
        newest = self._newest
        if newest is None or lead is None or lead not in newest.found:
            return None
        age_s = (sighting.t_ns - newest.t_ns) * 1e-9
        if not 0.0 <= age_s <= self._settings.max_age_s:
            return None
        distance_m, sigma_m = newest.found[lead]
        return DepthEstimate(distance_m=distance_m, sigma_m=sigma_m, age_s=age_s)

    def _remember(
        self, s: Sighting, camera: Camera, pose: Pose, ranges_m: Mapping[int, float], lead: int | None
    ) -> None:
        for plate in s.plates:
            self._last_box[plate.track_id] = s.t_ns, rear_box(plate.corners_px)
        for vehicle in s.vehicles:
            self._last_box[vehicle.track_id] = s.t_ns, _inner(
                (vehicle.left_px, vehicle.top_px, vehicle.right_px, vehicle.bottom_px)
            )
        self._last_box = {k: v for k, v in self._last_box.items() if (s.t_ns - v[0]) * 1e-9 <= BOX_MEMORY_S}
        measured = {p.track_id for p in s.plates if p.refined and not p.cut}
        fresh_m = {k: d for k, d in ranges_m.items() if k in measured and math.isfinite(d) and d > 0.5}
        self._history.append(
            _Seen(
                t_ns=s.t_ns,
                camera=camera,
                pose=pose,
                boxes={k: v[1] for k, v in self._last_box.items()},
                ranges_m=fresh_m,
                lead=lead,
                lead_m=ranges_m.get(lead) if lead is not None else None,
            )
        )
        horizon_ns = s.t_ns - round((self._settings.max_age_s + self._settings.latency_s + 0.5) * 1e9)
        self._history = [h for h in self._history if h.t_ns >= horizon_ns]

    def _use_pending(self, *, last_chance: bool) -> None:
        reading = self._pending
        if reading is None or not self._history:
            return
        seen = min(self._history, key=lambda h: abs(h.t_ns - reading.t_ns))
        off_ns = abs(seen.t_ns - reading.t_ns)
        if off_ns > 0 and not (last_chance and self._history[-1].t_ns >= reading.t_ns):
            return  # its own frame may still come
        self._pending = None
        if off_ns <= SAME_FRAME_NS and (self._newest is None or reading.t_ns > self._newest.t_ns):
            self._use(reading, seen)

    def _use(self, reading: DepthReading, seen: _Seen) -> None:
        grid = np.asarray(reading.inverse_depth, dtype=np.float64).reshape(reading.grid_rows, reading.grid_columns)
        if not np.isfinite(grid).all() or float(np.ptp(grid)) <= 0.0:
            self._newest = None  # a dead reading is no distance
            return
        size_px = reading.width_px, reading.height_px
        values = {k: region_m(grid, size_px, box) for k, box in seen.boxes.items()}
        pairs = [(values[k], d) for k, d in sorted(seen.ranges_m.items()) if k in values]
        old = self._alignment
        if old is not None:
            age_s = (reading.t_ns - old.t_ns) * 1e-9
            drift = self._settings.scale_drift, self._settings.shift_drift_per_m
            self._alignment = old = walked(old, reading.t_ns, drift) if age_s <= FORGOTTEN_S else None
        points = self._points(pairs, grid, seen, old)
        odd = self._grid is not None and _is_cut(self._grid, grid)
        if odd or (old is not None and points is not None and _contradicts(old, points)):
            self._doubts += 1
            if self._doubts < DOUBTS_TO_RESET:  # a wrong picture is over with the next one, another scene is not
                self._newest = None
                return
            self._alignment, self._paper_scale = None, None
        self._grid, self._doubts = grid, 0
        newest = _Newest(t_ns=reading.t_ns)
        if self._settings.alignment == "paper":
            self._use_paper(pairs, values, newest)
        else:
            self._align(points, len(pairs), float(np.median(np.abs(grid))), reading.t_ns)
            self._judge(values, newest)
        self._newest = newest

    def _points(
        self, pairs: list[tuple[float, float]], grid: FloatArray, seen: _Seen, fit: Alignment | None
    ) -> Points | None:
        """Plates first, then the road; None where nothing is known."""
        region = MOST_REGION_SIGMA if fit is None else fit.region_sigma
        plates = Points(
            m=np.array([m for m, _ in pairs]),
            inverse_m=np.array([1.0 / d for _, d in pairs]),
            sigma=np.array([math.hypot(RANGE_SIGMA, region) / d for _, d in pairs]),
            worth=np.ones(len(pairs)),
        )
        ground = None
        if self._settings.ground_points and self._height_m is not None:
            lead_m = seen.ranges_m.get(seen.lead, seen.lead_m) if seen.lead is not None else None
            ground = ground_points(grid, seen.camera, seen.pose, self._height_m, lead_m, region)
        points = plates if ground is None else _joined(plates, ground)
        return points if len(points.m) else None

    def _use_paper(self, pairs: list[tuple[float, float]], values: dict[int, float], newest: _Newest) -> None:
        """s_t = 0.9 s_{t-1} + 0.1 D_geo/d_plate with relative depth d = 1/m, and D = s d."""
        for m, distance_m in pairs:
            if m <= 0.0:
                continue
            if self._paper_scale is None:
                self._paper_scale = distance_m * m
            error = self._paper_scale / m / distance_m - 1.0
            self._paper_variance += 0.1 * (min(error**2, 1.0) - self._paper_variance)
            self._paper_scale = 0.9 * self._paper_scale + 0.1 * distance_m * m
        if self._paper_scale is None:
            return
        relative = math.sqrt(self._paper_variance + self._settings.min_sigma**2)
        for key, m in values.items():
            if m > 0.0:
                newest.found[key] = self._paper_scale / m, relative * self._paper_scale / m

    def _align(self, points: Points | None, plates: int, unit: float, t_ns: int) -> None:
        old = self._alignment
        if points is None:
            return
        if old is None:
            if plates == 0 and len(points.m) < 8:
                self._alignment = None
                return
            old = _start(points, unit, t_ns)
        new = advanced(old, points, plates)
        misfit = new.residual_variance > MISFIT**2 or _contradicts(new, points, limit=3.0)
        self._alignment = None if misfit else new

    def _judge(self, values: dict[int, float], newest: _Newest) -> None:
        fit = self._alignment
        if fit is None:
            return
        for key, m in values.items():
            inverse, sigma = fit.inverse_m(m)
            if inverse <= 1.0 / 300.0:
                continue
            relative = math.hypot(sigma / inverse, math.sqrt(fit.residual_variance), self._settings.min_sigma)
            if math.isfinite(relative) and relative < 0.5:
                newest.found[key] = 1.0 / inverse, relative / inverse


def walked(old: Alignment, t_ns: int, drift: tuple[float, float]) -> Alignment:
    """The fit at a later time: scale (relative) and shift (1/m) have walked by their drift of one second, one sigma."""
    theta = old.solution
    added = np.diag(np.square([drift[0] * max(abs(float(theta[0])), LEAST_SCALE), drift[1]])) * max(t_ns - old.t_ns, 0) * 1e-9
    information = np.asarray(np.linalg.inv(np.linalg.inv(old.information) + added), dtype=np.float64)
    return replace(old, t_ns=t_ns, information=information, pull=information @ theta)


def advanced(old: Alignment, points: Points, plates: int) -> Alignment:
    """One recursive step at the same time: robustly weighted points are added (three rounds of Tukey weights).

    The first `plates` points are plates; their errors against the old fit are what the residual is made of.
    """
    rows = np.stack([points.m / old.unit, np.ones(len(points.m))], axis=1)
    theta: FloatArray = old.solution
    residual_variance = old.residual_variance
    if plates and old.plates:
        error = (rows[:plates] @ theta) / points.inverse_m[:plates] - 1.0
        residual_variance += RESIDUAL_GAIN * (float(np.median(np.minimum(error**2, 0.25))) - residual_variance)
    information, pull = old.information, old.pull
    for _ in range(3):
        error = (rows @ theta - points.inverse_m) / points.sigma
        weight = points.worth * np.clip(1.0 - (error / 4.0) ** 2, 0.0, None) ** 2 / points.sigma**2
        information = old.information + (rows * weight[:, None]).T @ rows
        pull = old.pull + (rows * weight[:, None]).T @ points.inverse_m
        theta = np.asarray(np.linalg.solve(information, pull), dtype=np.float64)
    return replace(
        old, information=information, pull=pull, residual_variance=residual_variance, plates=old.plates + plates
    )


def _start(points: Points, unit: float, t_ns: int) -> Alignment:
    """The least-median line through pairs of points (or through one point with no shift), held weakly."""
    unit = unit if unit > 0.0 else 1.0
    x, y = points.m / unit, points.inverse_m
    best, scale, shift = math.inf, 0.0, float(np.median(y))
    through_zero = float(np.median(y / np.where(np.abs(x) > 1e-6, x, 1e-6)))
    candidates = [(through_zero, 0.0)] if through_zero > 0.0 else []
    step = max(1, len(x) // 24)
    for i in range(0, len(x), step):
        for j in range(i + step, len(x), step):
            if abs(x[i] - x[j]) > 0.02:
                slope = float((y[i] - y[j]) / (x[i] - x[j]))
                if slope > 0.0:  # bigger m is nearer
                    candidates.append((slope, float(y[i] - slope * x[i])))
    for slope, offset in candidates:
        worth = float(np.median(np.abs(slope * x + offset - y) / points.sigma))
        if worth < 0.98 * best:
            best, scale, shift = worth, slope, offset
    # Weak: a shift of 0.02/m (D off by 40 % at 20 m) and half of the scale are one sigma.
    information = np.diag([1.0 / max(0.5 * abs(scale), 1e-4) ** 2, 1.0 / 0.02**2])
    return Alignment(t_ns=t_ns, unit=unit, information=information, pull=information @ np.array([scale, shift]))


def _contradicts(fit: Alignment, points: Points, limit: float = 6.0) -> bool:
    """True where most of what is known now lies far off the old fit: another scene, another network state."""
    rows = np.stack([points.m / fit.unit, np.ones(len(points.m))], axis=1)
    spread = np.sqrt(np.einsum("ij,jk,ik->i", rows, np.linalg.inv(fit.information), rows))
    error = np.abs(rows @ fit.solution - points.inverse_m) / np.hypot(points.sigma, spread)
    order = np.argsort(error)
    worth = np.cumsum(points.worth[order])
    return float(error[order][int(np.searchsorted(worth, 0.5 * worth[-1]))]) > limit


def _joined(a: Points, b: Points) -> Points:
    return Points(
        m=np.concatenate([a.m, b.m]),
        inverse_m=np.concatenate([a.inverse_m, b.inverse_m]),
        sigma=np.concatenate([a.sigma, b.sigma]),
        worth=np.concatenate([a.worth, b.worth]),
    )


def ground_points(
    grid: FloatArray, camera: Camera, pose: Pose, camera_height_m: float, lead_m: float | None,
    region_sigma: float = MOST_REGION_SIGMA,
) -> Points | None:
    """The road cells of the own path that nothing can hide: nearer than three quarters of the lead's distance."""
    rows, columns = grid.shape
    x_px = (np.arange(columns) + 0.5) * camera.width_px / columns - 0.5
    y_px = (np.arange(rows) + 0.5) * camera.height_px / rows - 0.5
    r, c = np.meshgrid(np.arange(rows // 3, rows), np.arange(columns), indexing="ij")
    view = camera.rays(np.stack([x_px[c.ravel()], y_px[r.ravel()]], axis=1))
    x, y, z = (view @ view_from_vehicle(pose.pitch_rad, pose.roll_rad, pose.yaw_rad)).T
    far_m = GROUND_FAR_M if lead_m is None else min(GROUND_FAR_M, 0.75 * lead_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance_m = camera_height_m * z / y
        lateral_m = camera_height_m * x / y
    good = (y > 1e-3) & (distance_m > GROUND_NEAR_M) & (distance_m < far_m) & (np.abs(lateral_m) < GROUND_HALF_WIDTH_M)
    if int(good.sum()) < 6:
        return None
    inverse = 1.0 / distance_m[good]
    sigma = np.hypot(region_sigma * inverse, max(pose.pitch_sigma_rad, 0.001) / camera_height_m)
    worth = np.full(len(inverse), min(1.0, GROUND_WORTH / len(inverse)))
    return Points(m=grid[r.ravel()[good], c.ravel()[good]], inverse_m=inverse, sigma=sigma, worth=worth)


def rear_box(corners_px: tuple[tuple[float, float], ...]) -> Box:
    """The flat part of the vehicle round its plate: two plate widths wide, a little above and below."""
    xs, ys = [p[0] for p in corners_px], [p[1] for p in corners_px]
    width, x, y = max(xs) - min(xs), 0.5 * (max(xs) + min(xs)), 0.5 * (max(ys) + min(ys))
    return x - width, y - 0.7 * width, x + width, y + 0.4 * width


def region_m(grid: FloatArray, size_px: tuple[int, int], box: Box) -> float:
    """Median of the cells whose centre lies in the box; the nearest cell where the box is smaller than one."""
    rows, columns = grid.shape
    x0, y0, x1, y1 = box
    kx, ky = columns / size_px[0], rows / size_px[1]
    c0, c1 = math.ceil((x0 + 0.5) * kx - 0.5), math.floor((x1 + 0.5) * kx - 0.5)
    r0, r1 = math.ceil((y0 + 0.5) * ky - 0.5), math.floor((y1 + 0.5) * ky - 0.5)
    if c1 < c0:
        c0 = c1 = round((0.5 * (x0 + x1) + 0.5) * kx - 0.5)
    if r1 < r0:
        r0 = r1 = round((0.5 * (y0 + y1) + 0.5) * ky - 0.5)
    c0, c1 = min(max(c0, 0), columns - 1), min(max(c1, 0), columns - 1)
    r0, r1 = min(max(r0, 0), rows - 1), min(max(r1, 0), rows - 1)
    return float(np.median(grid[r0 : r1 + 1, c0 : c1 + 1]))


def _inner(box: Box) -> Box:
    """The middle of a vehicle's box, free of road and background at its rim."""
    x0, y0, x1, y1 = box
    w, h = x1 - x0, y1 - y0
    return x0 + 0.2 * w, y0 + 0.35 * h, x1 - 0.2 * w, y1 - 0.25 * h


def _is_cut(before: FloatArray, now: FloatArray) -> bool:
    if before.shape != now.shape:
        return True
    return float(np.corrcoef(before.ravel(), now.ravel())[0, 1]) < CUT_CORRELATION
