"""What of a sighting can be measured: viewing rays in the vehicle's axes, validity at the frame's edge, height clusters."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import PlateSighting

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

EDGE_MARGIN_PX = 1.5  # closer to the frame's edge a feature may be cut
_LEAST_APART_PX = 5.0  # of two bolts
_LEAST_TURN_PX2 = 2.0  # of two edges at a corner
_UNTESTED = 1.3  # doubt where too few characters can be compared
_MOST_DOUBT = 6.0
_SHAPE_SCATTER = 0.01  # relative: letters of one class are not all exactly as tall
SAME_GROUP = 1.25  # neighbours farther apart than this times the usual spacing stand in different groups


@dataclass(frozen=True, slots=True)
class Features:
    """Normalised image points (x, y) with z = 1 along the vehicle's forward axis; sigmas in the same unit (px / focal).

    Corners TL, TR, BR, BL (4, 2); glyph edge mid points (n, 2); rows (n,) int. `runs` holds index arrays of glyphs that
    stand next to each other without a group gap, left to right.
    """

    focal_px: float
    corners: Floats
    corner_ok: Bools
    corner_sigma: float
    side_sigma: Floats  # (4,) of the top, right, bottom and left line
    by_side: bool  # each side was measured as a line of its own
    refined: bool
    centre: Floats  # (2,) of the plate
    top: Floats
    bottom: Floats
    left: Floats
    right: Floats
    sigma_tb: Floats
    sigma_lr: Floats
    row: NDArray[np.int64]
    runs: tuple[NDArray[np.int64], ...]
    doubt: float  # how many times their stated sigma the characters' heights scatter, 1 to 6
    stroke: float | None
    spacing: float | None
    border: float | None
    char_height: float | None
    bolts: Floats  # (m, 2, 2) left and right bolt of each row in which they are seen
    bolts_sigma: Floats  # (m,) of either's place
    one_band: bool  # a blue band is seen at one end only
    heights: Floats = field(init=False)  # (n,) top to bottom of every glyph, normalised
    width: float | None = field(init=False)  # mean length of upper and lower edge, normalised, of those with valid ends
    height: float | None = field(init=False)  # the same of the left and right edge

    def __post_init__(self) -> None:
        stems = self.bottom - self.top
        object.__setattr__(self, "heights", np.hypot(stems[:, 0], stems[:, 1]))
        object.__setattr__(self, "width", self.width_of(self.corners))
        object.__setattr__(self, "height", self.height_of(self.corners))

    @property
    def corners_sigma(self) -> Floats:
        """(4, 2) sigmas of x and y of TL, TR, BR, BL: each corner is where two sides meet."""
        top, right, bottom, left = self.side_sigma
        return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])

    @property
    def width_sigma(self) -> float:
        """One sigma of a side edge's place, from the left and the right line."""
        return float(np.hypot(self.side_sigma[1], self.side_sigma[3]) / 2**0.5)

    @property
    def height_sigma(self) -> float:
        """One sigma of the upper or lower edge's place."""
        return float(np.hypot(self.side_sigma[0], self.side_sigma[2]) / 2**0.5)

    def width_of(self, corners: Floats) -> float | None:
        """`width` of other corners (4, 2), over the same edges."""
        return self._mean_edge(corners, ((0, 1), (3, 2)))

    def height_of(self, corners: Floats) -> float | None:
        """`height` of other corners (4, 2), over the same edges."""
        return self._mean_edge(corners, ((0, 3), (1, 2)))

    def glyph_bias(self, bias_px: float, resolved_px: float, typical: float | None = None) -> float:
        """One sigma of the error that all heights share (normalised): both edges outward or inward together.

        Grows with `doubt`, and with the square of `resolved_px` over the height, where letters melt into their row.
        """
        if typical is None and len(self.heights):
            typical = float(np.median(self.heights))
        typical_px = resolved_px if typical is None else typical * self.focal_px
        blend = 1.0 + (resolved_px / max(typical_px, 1.0)) ** 2
        return 2 * bias_px * self.doubt * blend / self.focal_px

    def _mean_edge(self, corners: Floats, pairs: tuple[tuple[int, int], ...]) -> float | None:
        lengths = [math.dist(corners[a], corners[b]) for a, b in pairs if self.corner_ok[a] and self.corner_ok[b]]
        return sum(lengths) / len(lengths) if lengths else None


def gather(plate: PlateSighting, camera: Camera, view_from_vehicle: Floats) -> Features:
    """Features of one plate; glyphs that are cut by the frame, empty or not finite are left out."""
    glyphs = [g for g in plate.glyphs if _whole((g.left_px, g.right_px, g.top_px, g.bottom_px), camera) and g.height_px > 0.5]
    n = len(glyphs)
    points = [*plate.corners_px]
    for g in glyphs:
        points += [g.top_px, g.bottom_px, g.left_px, g.right_px]
    bolts = [b for b in plate.bolts if _whole((b.left_px, b.right_px), camera) and b.right_px[0] - b.left_px[0] > _LEAST_APART_PX]
    for b in bolts:
        points += [b.left_px, b.right_px]
    pixels = np.array(points, dtype=np.float64)
    corner_ok = np.isfinite(pixels[:4]).all(axis=1)
    inside = (
        (pixels[:4, 0] >= EDGE_MARGIN_PX) & (pixels[:4, 0] <= camera.width_px - 1 - EDGE_MARGIN_PX)
        & (pixels[:4, 1] >= EDGE_MARGIN_PX) & (pixels[:4, 1] <= camera.height_px - 1 - EDGE_MARGIN_PX)
    )
    corner_ok &= inside & _is_plate(pixels[:4])
    rays = _rays(camera, view_from_vehicle, np.where(np.isfinite(pixels), pixels, 0.0))
    focal = camera.focal_px
    edges = rays[4 : 4 + 4 * n].reshape(n, 4, 2)
    rows = np.array([g.row for g in glyphs], dtype=np.int64)
    corners = rays[:4]
    centre = _crossing(corners) if corner_ok.all() else _middle(corners[corner_ok], edges)
    sigma_tb = np.array([max(g.sigma_tb_px, 0.02) / focal for g in glyphs])
    doubt = _doubt(edges, sigma_tb)
    sides = plate.side_sigma_px if len(plate.side_sigma_px) == 4 else (plate.corners_sigma_px,) * 4
    return Features(
        focal_px=focal, side_sigma=np.maximum(sides, 0.02) / focal,
        corners=corners, corner_ok=corner_ok, corner_sigma=max(plate.corners_sigma_px, 0.02) / focal,
        by_side=len(plate.side_sigma_px) == 4, refined=plate.refined, centre=centre,
        top=edges[:, 0], bottom=edges[:, 1], left=edges[:, 2], right=edges[:, 3],
        sigma_tb=sigma_tb * doubt, doubt=doubt,
        sigma_lr=np.array([max(g.sigma_lr_px, 0.02) / focal for g in glyphs]),
        row=rows, runs=_runs((edges[:, 2] + edges[:, 3]) / 2, rows), stroke=_norm(plate.stroke_px, focal),
        spacing=_norm(plate.spacing_px, focal), border=_norm(plate.border_px, focal),
        char_height=_norm(plate.char_height_px, focal),
        bolts=rays[4 + 4 * n :].reshape(-1, 2, 2), bolts_sigma=np.array([max(b.sigma_px, 0.02) / focal for b in bolts]),
        one_band=plate.colours is not None and {plate.colours.left_band, plate.colours.right_band} == {True, False},
    )


def clusters(log_heights: Floats, gap: float = 0.11) -> list[NDArray[np.int64]]:
    """Groups of indices of equal height, tallest first: sorted logarithms are cut where they jump by more than `gap`."""
    order = np.argsort(-log_heights)
    cuts = np.flatnonzero(-np.diff(log_heights[order]) > gap) + 1
    return [part.astype(np.int64) for part in np.split(order, cuts) if len(part)]


def _doubt(edges: Floats, sigma_tb: Floats) -> float:
    """Scatter of the heights about a straight line along each cluster, over what the stated sigmas let expect.

    Characters of one height on one plate are a measurement of the edges' own quality: where they scatter more than
    stated (blur, small characters), the errors that they share are larger too.
    """
    if len(edges) < 4:
        return _UNTESTED
    stems = edges[:, 1] - edges[:, 0]
    heights = np.sqrt(np.sum(stems**2, axis=1))
    place = (edges[:, 2, 0] + edges[:, 3, 0]) / 2
    found: list[Floats] = []
    for member in clusters(np.log(heights)):
        if len(member) < 4:
            continue
        x, h = place[member] - place[member].mean(), heights[member]
        slope = float(x @ h) / max(float(x @ x), 1e-12)
        left = h - h.mean() - slope * x
        expected = np.sqrt(2 * sigma_tb[member] ** 2 + (_SHAPE_SCATTER * h) ** 2)
        found.append(left / expected * (len(member) / (len(member) - 2)) ** 0.5)
    if not found:
        return _UNTESTED
    scatter = float(np.sqrt(np.mean(np.minimum(np.concatenate(found) ** 2, _MOST_DOUBT**2))))
    return float(np.clip(scatter, 1.0, _MOST_DOUBT))


def _is_plate(corners_px: Floats) -> bool:
    """Whether the finite corners stand in order round a convex outline that has a size; else none of them is believed."""
    for a, b, c in ((0, 1, 2), (1, 2, 3), (2, 3, 0), (3, 0, 1)):
        first, second = corners_px[b] - corners_px[a], corners_px[c] - corners_px[b]
        turn = float(first[0] * second[1] - first[1] * second[0])
        if np.isfinite(turn) and turn < _LEAST_TURN_PX2:
            return False
    return True


def _rays(camera: Camera, view_from_vehicle: Floats, pixels: Floats) -> Floats:
    rays = camera.rays(pixels) @ view_from_vehicle  # row vectors: v_vehicle = view_from_vehicle^T v_view
    out: Floats = rays[:, :2] / rays[:, 2:]
    return out


def _whole(points: tuple[tuple[float, float], ...], camera: Camera) -> bool:
    right, low = camera.width_px - 1 - EDGE_MARGIN_PX, camera.height_px - 1 - EDGE_MARGIN_PX
    return all(EDGE_MARGIN_PX <= x <= right and EDGE_MARGIN_PX <= y <= low for x, y in points)


def _norm(value_px: float | None, focal_px: float) -> float | None:
    return value_px / focal_px if value_px is not None and np.isfinite(value_px) and value_px > 0 else None


def _crossing(corners: Floats) -> Floats:
    """Where the diagonals cross: the image of the rectangle's centre."""
    a, b, c, d = corners
    ac, bd, ab = c - a, d - b, b - a
    det = ac[0] * bd[1] - ac[1] * bd[0]
    if abs(det) < 1e-15:
        return np.asarray(corners.mean(axis=0), dtype=np.float64)
    s = (ab[0] * bd[1] - ab[1] * bd[0]) / det
    return np.asarray(a + s * ac, dtype=np.float64)


def _middle(corners: Floats, edges: Floats) -> Floats:
    """Centre of what is seen of a plate that is not seen whole."""
    points = np.concatenate([corners, edges.reshape(-1, 2)])
    if not len(points):
        return np.zeros(2)
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2, dtype=np.float64)


def _runs(centres: Floats, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    found: list[NDArray[np.int64]] = []
    for row in sorted(set(rows.tolist())):
        member = np.flatnonzero(rows == row)
        member = member[np.argsort(centres[member, 0])]
        if len(member) < 2:
            continue
        steps = np.sqrt(np.sum(np.diff(centres[member], axis=0) ** 2, axis=1))
        usual = float(np.quantile(steps, 0.3))
        cuts = np.flatnonzero(steps > SAME_GROUP * usual) + 1
        found += [part.astype(np.int64) for part in np.split(member, cuts) if len(part) >= 2]
    return tuple(found)
