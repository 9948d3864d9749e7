"""The road as the camera sees it: sky, skyline, asphalt, verges and lane markings, row by row with exact coverage."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.simulation.camera import SimCamera
from tmde_edge.simulation.compose import Image

Array = NDArray[np.float64]

_BANDS = ((14.0, 0.02, 0.02), (45.0, 0.05, 0.10), (150.0, 0.15, 0.50), (1e9, 0.4, 2.0))  # up to Z, m per column, per row
_DIM = {"day": 1.0, "overcast": 0.85, "dusk": 0.45, "night": 0.10}
_PERIOD_M = (19.2, 102.4, 512.0, 2048.0)
_EDGE_M = (12.0, 20.0, 30.0, 60.0)  # how far each reaches to both sides


@dataclass(frozen=True, slots=True, kw_only=True)
class Marking:
    """One painted line along the road: lateral place of its middle (right positive), width, dash and gap (0: solid)."""

    lateral_m: float
    width_m: float = 0.12
    dash_m: float = 0.0
    gap_m: float = 0.0
    colour_bgr: tuple[float, float, float] = (205.0, 208.0, 210.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadStyle:
    """What the ground looks like; lateral numbers in the road's own frame (0: middle of the ego lane)."""

    markings: tuple[Marking, ...]
    left_m: float = -5.6  # asphalt's edges
    right_m: float = 3.4
    asphalt: float = 92.0
    verge_bgr: tuple[float, float, float] = (52.0, 92.0, 78.0)
    kerb: bool = False
    skyline: str = "trees"  # trees, town, hills, none
    sky: str = "day"  # day, overcast, night, dusk
    seed: int = 0


@dataclass(frozen=True, slots=True)
class RoadAhead:
    """The road in the level frame of the ego, sampled forward: lateral place and depth below the lens of its middle."""

    z_m: Array  # increasing
    x_m: Array
    down_m: Array
    s_m: Array  # arc length, absolute
    horizon_x_m: float = 0.0  # azimuth of the far view as tan, for the skyline's shift


@dataclass(frozen=True, slots=True)
class Rows:
    """What every image row below the horizon sees (NaN-free; `first` is the first such row)."""

    first: int
    z_m: Array
    t: Array  # length along the ray with unit z in the camera: x_level = (u - cx)/fx t
    x_m: Array  # of the road's middle
    stretch: Array  # of lateral places along the row: 1 / cos of the road's heading
    s_near_m: Array  # arc length at the row's lower and upper edge
    s_far_m: Array


def rows_of(camera: SimCamera, pitch_rad: float, ahead: RoadAhead) -> Rows:
    """Intersects each row's plane of sight with the (hilly) road. Roll and yaw are none of this function's business."""
    v = np.arange(camera.height_px + 1) - 0.5  # the rows' edges
    yn = (v - camera.cy_px) / camera.fy_px
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    level_z = c - yn * s
    slope = (yn * c + s) / level_z
    seen = np.minimum.accumulate(ahead.down_m / ahead.z_m)
    order = seen[::-1]
    # the inverse distance is linear in the slope of sight on level ground: interpolating it is exact there
    nearness = np.interp(slope, order, 1.0 / ahead.z_m[::-1], left=np.nan)
    visible = np.isfinite(nearness)
    z_edge = np.where(visible, 1.0 / np.where(visible, nearness, 1.0), ahead.z_m[-1])
    first_edge = int(np.argmax(visible)) if visible.any() else camera.height_px
    first = min(first_edge, camera.height_px)
    mid = np.arange(first, camera.height_px)
    yn_mid = (mid - camera.cy_px) / camera.fy_px
    z_mid = 1.0 / np.interp((yn_mid * c + s) / (c - yn_mid * s), order, 1.0 / ahead.z_m[::-1])
    far, near = z_edge[first:-1], z_edge[first + 1 :]
    return Rows(
        first=first, z_m=z_mid, t=z_mid / (c - yn_mid * s), x_m=np.interp(z_mid, ahead.z_m, ahead.x_m),
        stretch=np.interp(z_mid, ahead.z_m, np.hypot(1.0, np.gradient(ahead.x_m, ahead.z_m))),
        s_near_m=np.interp(near, ahead.z_m, ahead.s_m), s_far_m=np.interp(far, ahead.z_m, ahead.s_m),
    )


def horizon_row(camera: SimCamera, pitch_rad: float) -> float:
    """Image row of the level directions straight ahead, at the principal column."""
    return float(camera.cy_px - camera.fy_px * np.tan(pitch_rad))


def paint_ground(image: Image, camera: SimCamera, pitch_rad: float, ahead: RoadAhead, style: RoadStyle,
                 slope: float = 0.0) -> Rows:
    """Sky, skyline and ground into the whole image; slope: of the road under us, up positive."""
    rows = rows_of(camera, pitch_rad, ahead)
    # the sky is level, the road under us need not be
    _paint_sky(image, camera, pitch_rad - float(np.arctan(slope)), ahead, style, rows)
    textures = _ground_textures(style)
    start = rows.first
    columns = ((np.arange(camera.width_px) - camera.cx_px) / camera.fx_px).astype(np.float32)
    for (limit, per_col, per_row), period, edge, picture in zip(_BANDS, _PERIOD_M, _EDGE_M, textures, strict=True):
        inside = np.flatnonzero((rows.z_m < limit) & (np.arange(len(rows.z_m)) + rows.first < image.shape[0]))
        inside = inside[rows.z_m[inside] >= _lower_limit(limit)]
        if len(inside) == 0:
            continue
        a, b = int(inside[0]), int(inside[-1]) + 1
        lateral = columns[None, :] * rows.t[a:b, None].astype(np.float32) - rows.x_m[a:b, None].astype(np.float32)
        lateral /= rows.stretch[a:b, None].astype(np.float32)
        map_x = (lateral + np.float32(edge)) * np.float32(1 / per_col) - np.float32(0.5)
        middle = 0.5 * (rows.s_near_m[a:b] + rows.s_far_m[a:b])
        row_at = np.mod(middle, period) / per_row
        map_y = np.repeat(row_at.astype(np.float32)[:, None], camera.width_px, axis=1)
        # a picture is wider than remap's 16-bit limit only if it were 32767 px: it is not
        image[start + a : start + b] = cv2.remap(
            picture, np.clip(map_x, 0, picture.shape[1] - 1), map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    for marking in style.markings:
        _paint_marking(image, camera, rows, marking)
    return rows


def _lower_limit(limit: float) -> float:
    limits = [0.0, *[band[0] for band in _BANDS]]
    return limits[limits.index(limit) - 1]


def _paint_marking(image: Image, camera: SimCamera, rows: Rows, marking: Marking) -> None:
    """Blend one line with its exact share of every pixel: along the row from its edges, along the road from its dashes."""
    if len(rows.z_m) == 0:
        return
    share = np.ones(len(rows.z_m))
    if marking.dash_m > 0 and marking.gap_m > 0:
        period = marking.dash_m + marking.gap_m
        length = rows.s_far_m - rows.s_near_m
        painted = _painted(rows.s_far_m, marking.dash_m, period) - _painted(rows.s_near_m, marking.dash_m, period)
        share = np.where(length > 1e-6, painted / np.maximum(length, 1e-6), 0.0)
    share = share * np.clip(1.2 - rows.z_m / 250.0, 0.0, 0.92)  # worn, and grey in the distance
    half = marking.width_m / 2
    scale = camera.fx_px / rows.t
    left = camera.cx_px + (rows.x_m + (marking.lateral_m - half) * rows.stretch) * scale
    right = camera.cx_px + (rows.x_m + (marking.lateral_m + half) * rows.stretch) * scale
    use = (share > 0.01) & (right > -0.5) & (left < camera.width_px - 0.5)
    colour = np.asarray(marking.colour_bgr, np.float32)
    # rows in two lots, so that the narrow far ones do not pay for the wide near ones
    wide = right - left
    for lot in (use & (wide < 8), use & (wide >= 8)):
        index = np.flatnonzero(lot)
        if len(index) == 0:
            continue
        span = int(np.ceil(wide[index].max())) + 3
        base = np.floor(left[index]).astype(np.int64) - 1
        cols = base[:, None] + np.arange(span)[None, :]
        cover = np.minimum(right[index, None], cols + 0.5) - np.maximum(left[index, None], cols - 0.5)
        cover = np.clip(cover, 0.0, 1.0) * share[index, None]
        ok = (cover > 0) & (cols >= 0) & (cols < camera.width_px)
        r = np.broadcast_to((rows.first + index)[:, None], cols.shape)[ok]
        c = cols[ok]
        pixels = image[r, c].astype(np.float32)
        pixels += cover[ok].astype(np.float32)[:, None] * (colour - pixels)
        image[r, c] = (pixels + 0.5).astype(np.uint8)


def _painted(s_m: Array, dash_m: float, period_m: float) -> Array:
    """Painted length from 0 to s."""
    whole = np.floor(s_m / period_m)
    out: Array = whole * dash_m + np.minimum(s_m - whole * period_m, dash_m)
    return out


@lru_cache(maxsize=8)
def _ground_textures(style: RoadStyle) -> tuple[Image, ...]:
    """One BGR picture a distance band: lateral profile of verge, edge and asphalt with patches, tracks and grain."""
    out: list[Image] = []
    for k, ((_, per_col, per_row), period) in enumerate(zip(_BANDS, _PERIOD_M, strict=True)):
        edge = _EDGE_M[k]
        rng = np.random.default_rng((style.seed, 7, k))
        cols, rows = round(2 * edge / per_col), round(period / per_row)
        x = (-edge + (np.arange(cols) + 0.5) * per_col).astype(np.float32)
        fine = rng.standard_normal((rows, cols), np.float32)
        coarse = _smooth_noise(rng, rows, cols, max(1.0, 0.8 / per_row), max(1.0, 0.5 / per_col))
        grain = {0: 7.0, 1: 4.0, 2: 1.5, 3: 0.5}[k]
        tracks = -4.0 * np.exp(-(((np.abs(x) - 0.75) / 0.28) ** 2)) + 3.0 * np.exp(-((x / 0.35) ** 2))
        asphalt = style.asphalt + tracks[None, :] + grain * fine + 3.5 * coarse
        road = np.stack([asphalt * 1.0, asphalt * 0.985, asphalt * 0.97], axis=2)
        tuft = _smooth_noise(rng, rows, cols, max(1.0, 0.25 / per_row), max(1.0, 0.15 / per_col))
        green = np.asarray(style.verge_bgr, np.float32) * (1.0 + 0.18 * tuft + (0.10 if k < 2 else 0.04) * fine)[..., None]
        beyond = np.maximum(x - style.right_m, style.left_m - x)  # metres off the asphalt
        gravel = np.array([108.0, 116.0, 122.0], np.float32) * (1.0 + 0.10 * fine)[..., None]
        soft = np.clip(beyond / 0.08, 0, 1)[None, :, None]
        shoulder = np.clip((beyond - 0.45 + 0.12 * coarse) / 0.25, 0, 1)[..., None]
        picture = road * (1 - soft) + (gravel * (1 - shoulder) + green * shoulder) * soft
        if style.kerb:
            on = ((beyond > 0.0) & (beyond < 0.18))[None, :, None]
            picture = np.where(on, np.array([150.0, 152.0, 154.0]) * (1 + 0.04 * fine)[..., None], picture)
            pavement = (beyond >= 0.18)[None, :, None]
            slab = 128.0 * (1 + 0.05 * fine + 0.03 * coarse)[..., None] * np.ones(3)
            picture = np.where(pavement & (beyond < 2.6)[None, :, None], slab, picture)
        pixels = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        out.append(np.vstack([pixels, pixels[:1], pixels[:1]]))  # the seam: rows wrap
    return tuple(out)


def _smooth_noise(
    rng: np.random.Generator, rows: int, cols: int, row_px: float, col_px: float
) -> NDArray[np.float32]:
    small = rng.standard_normal((max(2, round(rows / row_px)), max(2, round(cols / col_px))), np.float32)
    return np.asarray(cv2.resize(small, (cols, rows), interpolation=cv2.INTER_CUBIC), np.float32)


def _paint_sky(
    image: Image, camera: SimCamera, pitch_rad: float, ahead: RoadAhead, style: RoadStyle, rows: Rows
) -> None:
    """The far view: a picture at infinity, moved by pitch and heading."""
    picture, horizon = _far_view(style, camera.fx_px, camera.width_px, camera.height_px)
    shift_y = horizon_row(camera, pitch_rad) - horizon
    shift_x = -camera.fx_px * ahead.horizon_x_m
    middle = (picture.shape[1] - 1) / 2
    matrix = np.array([[1.0, 0.0, camera.cx_px - middle + shift_x], [0.0, 1.0, shift_y]])
    last = min(rows.first + 2, image.shape[0])
    if last > 0:
        image[:last] = cv2.warpAffine(
            picture, matrix, (image.shape[1], last), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
    if last < image.shape[0]:
        image[last:] = image[last - 1 : last] if last > 0 else 128


@lru_cache(maxsize=8)
def _far_view(style: RoadStyle, f_px: float, width_px: int, height_px: int) -> tuple[Image, float]:
    """Sky and skyline (BGR) at the camera's own scale, and the row of its horizon."""
    rng = np.random.default_rng((style.seed, 11))
    cols, above, below = 3 * width_px, round(1.5 * height_px), round(0.6 * height_px)
    rows = above + below
    tones = {
        "day": ((205.0, 160.0, 118.0), (238.0, 226.0, 212.0)), "overcast": ((188.0, 184.0, 180.0), (222.0, 220.0, 216.0)),
        "dusk": ((110.0, 80.0, 66.0), (150.0, 160.0, 206.0)), "night": ((20.0, 15.0, 13.0), (36.0, 30.0, 28.0)),
    }
    high, low = (np.array(t, np.float32) for t in tones[style.sky])
    small = (rows // 4, cols // 4)  # a sky has no fine detail
    t = (np.clip((above - 4.0 * np.arange(small[0])) / (0.55 * above), 0, 1)[:, None, None] ** 0.8).astype(np.float32)
    cloud = sum(
        w * _smooth_noise(rng, *small, a, b) for w, a, b in ((1.0, 22.0, 65.0), (0.6, 10.0, 27.0), (0.3, 4.0, 11.0))
    )
    amount = {"day": 0.55, "overcast": 0.18, "dusk": 0.3, "night": 0.05}[style.sky]
    veil = (np.clip(np.asarray(cloud) - 0.35, 0, 1.6)[..., None] * amount / 1.6).astype(np.float32)
    sky = (low * (1 - t) + high * t) * (1 - veil) + (low * 1.02) * veil
    coarse = np.clip(sky, 0, 255).astype(np.uint8)
    picture = np.asarray(cv2.resize(coarse, (cols, rows), interpolation=cv2.INTER_LINEAR), np.uint8)
    _skyline(picture, above, style, f_px, rng)
    picture[above:] = np.clip(np.asarray(style.verge_bgr) * 1.05 * _DIM[style.sky], 0, 255).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), np.uint8), float(above)


def _skyline(picture: Image, horizon: int, style: RoadStyle, f_px: float, rng: np.random.Generator) -> None:
    """Hills, a belt of trees and houses along the horizon; sizes in angle (f_px pixels a radian)."""
    cols = picture.shape[1]
    x = np.arange(cols)
    dim = _DIM[style.sky]
    if style.skyline == "none":
        return
    hill = _smooth_noise(rng, 2, cols, 1.0, 0.35 * f_px)[0]
    top = horizon - np.clip(0.018 * f_px * (1.0 + 0.8 * hill), 2, None)
    _fill_above(picture, x, top, horizon, np.array([148.0, 138.0, 118.0]) * dim)
    if style.skyline == "town":
        at = 0.0
        while at < cols:
            w, h = f_px * rng.uniform(0.03, 0.09), f_px * rng.uniform(0.02, 0.085)
            tone = np.array([150.0, 158.0, 168.0]) * rng.uniform(0.6, 1.1) * dim
            a, b = int(at), int(min(at + w, cols))
            y = int(horizon - h)
            cv2.rectangle(picture, (a, y), (b, horizon), [float(c) for c in tone], -1)
            step = max(4, round(0.011 * f_px))
            for wy in range(y + 4, horizon - 4, step):
                for wx in range(a + 3, b - step // 2, step):
                    lit = rng.random() < 0.25 and style.sky in ("night", "dusk")
                    pane = (90.0, 190.0, 230.0) if lit else tuple(float(c) for c in tone * 0.62)
                    cv2.rectangle(picture, (wx, wy), (wx + step // 2 - 1, wy + step // 2), pane, -1)
            at += w * rng.uniform(0.9, 1.5)
    if style.skyline in ("trees", "hills", "town"):
        size = {"trees": 0.020, "hills": 0.008, "town": 0.007}[style.skyline] * f_px
        belt = size * (1.2 + 0.5 * _smooth_noise(rng, 2, cols, 1.0, 0.04 * f_px)[0]
                       + 0.25 * _smooth_noise(rng, 2, cols, 1.0, 0.006 * f_px)[0])
        _fill_above(picture, x, horizon - np.clip(belt, 1, None), horizon, np.array([58.0, 74.0, 62.0]) * dim)
        for row in range(max(0, int(horizon - 2.6 * size)), horizon):
            dark = picture[row].max(axis=1) < 85 * dim
            picture[row][dark] = np.clip(
                picture[row][dark] * (1 + 0.16 * rng.normal(0, 1, (int(dark.sum()), 1))), 0, 255).astype(np.uint8)


def _fill_above(picture: Image, x: NDArray[np.int64], top: Array, horizon: int, colour: Array) -> None:
    points = np.concatenate([np.stack([x, top], 1), [[x[-1], horizon], [x[0], horizon]]])
    cv2.fillPoly(picture, [np.rint(points * 16).astype(np.int32)], [float(c) for c in colour], cv2.LINE_AA, 4)
