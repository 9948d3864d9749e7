"""Straight edges of an image that aim at the expected vanishing point, measured to sub-pixel. Working pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

MAX_LINES = 48
_SAMPLES = 24  # along a line, when it is measured
_REACH = 3  # pixels to each side of it
_POINT_PX = 0.25  # error of one edge point in the working image, shared by neighbours


@dataclass(frozen=True, slots=True, kw_only=True)
class Lines:
    """Straight edges in working pixels: middle points (n, 2), unit directions (n, 2); lengths, angle sigmas, trust (n,)."""

    middle_px: FloatArray
    direction: FloatArray
    length_px: FloatArray
    sigma_rad: FloatArray
    trust: FloatArray  # 1: any edge; up to 4: the edge of a painted stripe

    def chosen(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Lines:
        return Lines(
            middle_px=self.middle_px[keep],
            direction=self.direction[keep],
            length_px=self.length_px[keep],
            sigma_rad=self.sigma_rad[keep],
            trust=self.trust[keep],
        )


def edges_towards(grey: Image, prior: FloatArray, reach_px: float) -> FloatArray | None:
    """Line pieces (n, 4) from edges whose direction could pass within reach of the prior."""
    dx, dy = (np.asarray(d, dtype=np.int16) for d in cv2.spatialGradient(grey))
    strong = float(np.clip(_strength(dx[::2, ::2], dy[::2, ::2], 0.93), 24.0, 240.0))
    edges = cv2.Canny(dx, dy, 0.5 * strong, strong)
    first = min(max(0, math.ceil(prior[1] + 0.02 * grey.shape[1])), grey.shape[0])  # the road lies below the horizon
    places: Any = cv2.findNonZero(edges[first:]) if first < grey.shape[0] else None  # None without any, whatever its stubs say
    if places is None:
        return None
    # The line through (x, y) across its gradient misses the prior by |g . (p - prior)| / |g|; twice the reach sideways.
    xs, ys = np.asarray(places).reshape(-1, 2).T.astype(np.int64)
    ys += first
    at = ys * grey.shape[1] + xs
    gx, gy = dx.ravel()[at].astype(np.float32), dy.ravel()[at].astype(np.float32)
    px, py = (xs - prior[0]).astype(np.float32), (ys - prior[1]).astype(np.float32)
    allowed = reach_px * (np.abs(gy) + 2.0 * np.abs(gx)) + 0.12 * np.sqrt((gx * gx + gy * gy) * (px * px + py * py))
    right = np.abs(gx * px + gy * py) <= allowed
    ys, xs, rising = ys[right], xs[right], gx[right] > 0.0
    pieces = [_chains(grey.shape, ys[side], xs[side]) for side in (rising, ~rising)]
    found = np.concatenate(pieces)
    if len(found) == 0:
        return None
    length = np.hypot(found[:, 2] - found[:, 0], found[:, 3] - found[:, 1])
    return found[np.argsort(-length, kind="stable")[: 2 * MAX_LINES]]


def _strength(dx: NDArray[np.int16], dy: NDArray[np.int16], share: float) -> int:
    """The strength |dx| + |dy| that this share of the pixels does not exceed."""
    counts = np.bincount((np.abs(dx) + np.abs(dy)).ravel())
    return int(np.searchsorted(np.cumsum(counts), share * dx.size))


def _chains(shape: tuple[int, ...], ys: NDArray[np.int64], xs: NDArray[np.int64]) -> FloatArray:
    """Straight pieces (n, 4) among edge pixels that hang together: one side of a stripe at a time, so that sides stay apart."""
    mask = np.zeros(shape, dtype=np.uint8)
    mask[ys, xs] = 255
    mask = np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8)), dtype=np.uint8)  # over gaps of two pixels
    count, labels = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_16U)
    label = labels[ys, xs]
    n = np.maximum(np.bincount(label, minlength=count), 1).astype(np.float64)
    mx, my = np.bincount(label, xs, count) / n, np.bincount(label, ys, count) / n
    dx, dy = xs - mx[label], ys - my[label]
    xx, xy, yy = (np.bincount(label, v, count) / n for v in (dx * dx, dx * dy, dy * dy))
    half = np.hypot(0.5 * (xx - yy), xy)
    major, minor = 0.5 * (xx + yy) + half, 0.5 * (xx + yy) - half
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    ux, uy = np.cos(angle), np.sin(angle)
    reach = np.sqrt(3.0 * np.maximum(major, 0.0))  # half the length of an even line
    least = max(14, shape[1] // 32)
    straight = (2.0 * reach >= least) & (minor < 1.0 + 0.0004 * reach**2)
    ux, uy, mx, my, reach = ux[straight], uy[straight], mx[straight], my[straight], reach[straight]
    return np.stack([mx - reach * ux, my - reach * uy, mx + reach * ux, my + reach * uy], axis=1)


def measured(grey: Image, pieces: FloatArray) -> Lines | None:
    """Each piece moved onto its edge: grey profiles across it, the steepest place of each, a line through those."""
    start, end = pieces[:, :2], pieces[:, 2:]
    length = np.hypot(*(end - start).T)
    direction = (end - start) / length[:, None]
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    along = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    across = np.arange(-_REACH - 1, _REACH + 2, dtype=np.float64)
    middle = 0.5 * (start + end)
    centre = middle[:, None, :] + along[None, :, None] * (length[:, None] * direction)[:, None, :]
    place = centre[:, :, None, :] + across[None, None, :, None] * normal[:, None, None, :]
    profile = _sampled(grey, place[..., 0], place[..., 1])
    slope = 0.5 * (profile[:, :, 2:] - profile[:, :, :-2])
    sign = np.sign(slope[:, :, _REACH - 1 : _REACH + 2].sum(axis=(1, 2)))
    weight = np.clip(slope * np.where(sign == 0.0, 1.0, sign)[:, None, None], 0.0, None)
    offset = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    weight *= np.exp(-0.5 * (offset / 1.5) ** 2)  # the edge that Hough found, not its neighbour
    mass = weight.sum(axis=2)
    at = (weight * offset).sum(axis=2) / np.maximum(mass, 1e-9)

    u = along[None, :] * length[:, None]
    w = np.sqrt(mass)
    for _ in range(3):
        sw = np.maximum(w.sum(axis=1), 1e-9)
        mean_u, mean_at = (w * u).sum(axis=1) / sw, (w * at).sum(axis=1) / sw
        spread = (w * (u - mean_u[:, None]) ** 2).sum(axis=1)
        tilt = (w * (u - mean_u[:, None]) * (at - mean_at[:, None])).sum(axis=1) / np.maximum(spread, 1e-9)
        rest = at - mean_at[:, None] - tilt[:, None] * (u - mean_u[:, None])
        scatter = np.maximum(np.sqrt((w * rest**2).sum(axis=1) / sw), 0.05)
        w = np.sqrt(mass) / (1.0 + (rest / (2.0 * scatter[:, None])) ** 2)
    bent = (u**2) - ((w * u**2).sum(axis=1) / sw)[:, None]
    bend = np.abs((w * rest * bent).sum(axis=1)) / np.maximum((w * bent**2).sum(axis=1), 1e-9)
    centre_at = mean_at - tilt * mean_u
    turned = direction + tilt[:, None] * normal
    turned /= np.linalg.norm(turned, axis=1)[:, None]
    # Neighbouring samples share pixels and paint defects: about one independent point in 6 px.
    independent = np.clip(length / 6.0, 2.0, _SAMPLES)
    sigma = np.hypot(scatter, _POINT_PX) * math.sqrt(12.0) / (length * np.sqrt(independent))
    sigma = np.hypot(sigma, bend * length)  # the edge of a curve turns by that much from its middle to its ends
    kept = (scatter < 1.0) & (mass.mean(axis=1) > 2.0) & (np.abs(tilt) < 0.2)
    if not kept.any():
        return None
    lines = Lines(
        middle_px=middle + centre_at[:, None] * normal, direction=turned, length_px=length, sigma_rad=sigma,
        trust=np.ones(len(length)),
    ).chosen(kept)
    return _without_twins(lines)


def painted(grey: Image, lines: Lines, horizon_row: float) -> FloatArray:
    """0..1 (n,): is this the edge of a light stripe as wide as road paint?

    A stripe of width w on the road is w (row - horizon row) / camera height wide in its row, whatever the lens: grey is
    sampled across in units of the depth below the horizon, which lays all rows of a stripe over each other.
    """
    u = (np.arange(10) + 0.5) / 10 - 0.5
    place = lines.middle_px[:, None, :] + u[None, :, None] * (lines.length_px[:, None] * lines.direction)[:, None, :]
    depth = np.maximum(place[:, :, 1] - horizon_row, 8.0)
    across = np.arange(-14, 15) * 0.02
    x = place[:, :, None, 0] + across * depth[:, :, None]
    y = np.broadcast_to(place[:, :, None, 1], x.shape)
    profile = _sampled(grey, x, y).mean(axis=1)
    total = np.concatenate([np.zeros((len(profile), 1)), np.cumsum(profile, axis=1)], axis=1)

    def mean(first: int, last: int) -> FloatArray:
        part: FloatArray = (total[:, last + 1] - total[:, first]) / (last - first + 1)
        return part

    best = np.zeros(len(profile))
    for steps in (3, 4, 6, 8, 10):  # width 0.06 .. 0.2 of the camera's height: 8 .. 26 cm at 1.3 m
        for inside, left, right in (
            (mean(15, 13 + steps), mean(10, 13), mean(15 + steps, min(18 + steps, 28))),
            (mean(15 - steps, 13), mean(max(10 - steps, 0), 13 - steps), mean(15, 18)),
        ):
            contrast = inside - np.maximum(left, right)
            best = np.maximum(best, contrast / np.maximum(0.5 * (left + right), 20.0))
    clear: FloatArray = np.clip((best - 0.08) / 0.25, 0.0, 1.0)
    return clear


def _without_twins(lines: Lines) -> Lines:
    """The longest of each group that measures the same stretch of the same edge."""
    order = np.argsort(-lines.length_px, kind="stable")
    lines = lines.chosen(order)
    step = lines.middle_px[None, :, :] - lines.middle_px[:, None, :]
    along = np.abs(np.einsum("ijk,ik->ij", step, lines.direction))
    across = np.abs(step[:, :, 0] * -lines.direction[:, None, 1] + step[:, :, 1] * lines.direction[:, None, 0])
    turn = np.abs(lines.direction @ np.array([[0.0, 1.0], [-1.0, 0.0]]) @ lines.direction.T)
    overlap = along < 0.4 * (lines.length_px[:, None] + lines.length_px[None, :])
    twin = (across < 1.0) & (turn < 0.05) & overlap
    keep = np.ones(len(order), dtype=bool)
    for i in range(len(order)):
        if keep[i]:
            later = twin[i].copy()
            later[: i + 1] = False
            keep[later] = False
    return lines.chosen(np.flatnonzero(keep)[:MAX_LINES])


def _sampled(grey: Image, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Grey values between pixels at places of any shape."""
    flat = (-1, x_px.shape[-1])
    x, y = x_px.reshape(flat).astype(np.float32), y_px.reshape(flat).astype(np.float32)
    values = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).reshape(x_px.shape)
