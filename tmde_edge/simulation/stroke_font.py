"""Our own plate font: letters as stroked polylines whose ink fills a given box exactly. No foreign font is needed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

# Skeletons in the unit box (u right, v down). "~" rounds that corner, "|" makes a butt end, "z" closes the path.
# Paths of one letter are separated by ";". Ends on the box's border run out to it and are cut off flat there.
_SKELETONS = {
    "A": "0,1 .5,0;.5,0 1,1;.16,.68 .84,.68",
    "B": "0,0 0,1;0,0 .92,0~ .92,.47~ 0,.47;0,.47 1,.47~ 1,1~ 0,1",
    "C": "1,.3 1,0~ 0,0~ 0,1~ 1,1~ 1,.7",
    "D": "0,0 0,1;0,0 1,0~ 1,1~ 0,1",
    "E": "0,0 0,1;0,0 1,0;0,.48 .85,.48|;0,1 1,1",
    "F": "0,0 0,1;0,0 1,0;0,.5 .85,.5|",
    "G": "1,.28 1,0~ 0,0~ 0,1~ 1,1~ 1,.52 .55,.52|",
    "H": "0,0 0,1;1,0 1,1;0,.5 1,.5",
    "J": "1,0 1,1~ 0,1~ 0,.7",
    "K": "0,0 0,1;1,0 0,.62;.35,.4 1,1",
    "L": "0,0 0,1;0,1 1,1",
    "M": "0,0 0,1;1,0 1,1;0,0 .5,.65 1,0",
    "N": "0,0 0,1;1,0 1,1;0,0 1,1",
    "O": "0,0~ 1,0~ 1,1~ 0,1~ z",
    "P": "0,0 0,1;0,0 1,0~ 1,.55~ 0,.55",
    "Q": "0,0~ 1,0~ 1,1~ 0,1~ z;.55,.68 1,1",
    "R": "0,0 0,1;0,0 1,0~ 1,.53~ 0,.53;.45,.53 1,1",
    "S": "1,.25 1,0~ 0,0~ 0,.48~ 1,.48~ 1,1~ 0,1~ 0,.75",
    "T": "0,0 1,0;.5,0 .5,1",
    "U": "0,0 0,1~ 1,1~ 1,0",
    "V": "0,0 .5,1;.5,1 1,0",
    "W": "0,0 .25,1;.25,1 .5,.2;.5,.2 .75,1;.75,1 1,0",
    "X": "0,0 1,1;1,0 0,1",
    "Y": "0,0 .5,.5;1,0 .5,.5;.5,.5 .5,1",
    "Z": "0,0 1,0;1,0 0,1;0,1 1,1",
    "0": "0,0~ 1,0~ 1,1~ 0,1~ z",
    "1": "1,0 1,1;0,.24 1,0",
    "2": "0,.28 0,0~ 1,0~ 1,.42~ 0,1;0,1 1,1",
    "3": "0,.25 0,0~ 1,0~ 1,.47~ .35,.47|;.35,.47| 1,.47~ 1,1~ 0,1~ 0,.75",
    "4": ".65,0 0,.7;0,.7 1,.7;.74,.35| .74,1",
    "5": "0,0 1,0;0,0 0,.45;0,.42 1,.42~ 1,1~ 0,1~ 0,.77",
    "6": "1,.24 1,0~ 0,0~ 0,1~ 1,1~ 1,.45~ 0,.45",
    "7": "0,0 1,0;1,0 .3,1",
    "8": "0,0~ 1,0~ 1,.47~ 0,.47~ z;0,.47~ 1,.47~ 1,1~ 0,1~ z",
    "9": "0,.76 0,1~ 1,1~ 1,0~ 0,0~ 0,.55~ 1,.55",
    "Ö": "0,.25~ 1,.25~ 1,1~ 0,1~ z;.2,0 .3,0;.7,0 .8,0",
    "/": "0,1 1,0",
    "&": "1,1 .1,.25~ .3,0~ .8,0~ .7,.35~ 0,.65~ 0,1~ .8,1~ 1,.55",
}
_SERIF_I = "0,0 1,0;.5,0 .5,1;0,1 1,1"
_FILLED = frozenset("-–I|")  # the whole box is ink
_ARC_STEPS = 8


@dataclass(frozen=True, slots=True)
class _Stroke:
    """One flattened path in the skeleton box's millimetres: points (n, 2), and which ends are cut flat, not round."""

    points_mm: NDArray[np.float64]
    flat_start: bool
    flat_end: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class StrokeFont:
    """The parametric stroke font; roundness 0..1 sets the corner radius of bowls (1: half the width)."""

    roundness: float = 0.8
    serif_one: bool = False

    def supports(self, char: str) -> bool:
        """Every character can be drawn: an unknown one becomes an invented, ideograph-like sign of its own."""
        return len(char) == 1

    def coverage(
        self, char: str, *, width_mm: float, height_mm: float, stroke_mm: float, x_mm: NDArray[np.float64],
        y_mm: NDArray[np.float64], px_per_mm: float,
    ) -> NDArray[np.float32]:
        """Ink coverage (len(y), len(x)) in 0..1 at pixel centres given in mm from the ink box's top left corner."""
        x = np.asarray(x_mm, np.float32)[None, :]
        y = np.asarray(y_mm, np.float32)[:, None]
        box = np.minimum.reduce([x + 0.0 * y, width_mm - x + 0.0 * y, y + 0.0 * x, height_mm - y + 0.0 * x])
        stroke = min(stroke_mm, width_mm, height_mm)
        if char in _FILLED and not (char == "I" and width_mm > 1.9 * stroke):
            full: NDArray[np.float32] = np.clip(0.5 + box * px_per_mm, 0.0, 1.0)
            return full
        if char in ".·:":
            rx, ry = width_mm / 2, height_mm / 2
            coverage: NDArray[np.float32] = np.clip(0.5 + ellipse_depth(x - rx, y - ry, rx, ry) * px_per_mm, 0.0, 1.0)
            return coverage
        inside = np.full(box.shape, -np.inf, np.float32)
        for path in _paths(char, width_mm - stroke, height_mm - stroke, stroke, self.roundness, self.serif_one):
            _draw(inside, path, x - stroke / 2, y - stroke / 2, stroke / 2)
        return np.clip(0.5 + np.minimum(inside, box) * px_per_mm, 0.0, 1.0).astype(np.float32)


def ellipse_depth(
    x: NDArray[np.float32], y: NDArray[np.float32], rx: float, ry: float
) -> NDArray[np.float32]:
    """Signed depth in an ellipse about the origin, first order: exact at its edge."""
    radius = np.sqrt((x / rx) ** 2 + (y / ry) ** 2)
    slope = np.sqrt((x / rx**2) ** 2 + (y / ry**2) ** 2) / np.maximum(radius, 1e-6)
    depth: NDArray[np.float32] = ((1.0 - radius) / np.maximum(slope, 1e-6)).astype(np.float32)
    return depth


def _draw(
    inside_mm: NDArray[np.float32], path: _Stroke, x: NDArray[np.float32], y: NDArray[np.float32], half_mm: float
) -> None:
    """Raise inside_mm to the signed depth in mm inside this stroke (positive inside)."""
    last = len(path.points_mm) - 2
    for i in range(last + 1):
        ax, ay = path.points_mm[i]
        bx, by = path.points_mm[i + 1]
        length = math.hypot(bx - ax, by - ay)
        if length < 1e-9:
            continue
        ux, uy = (bx - ax) / length, (by - ay) / length
        along = (x - ax) * ux + (y - ay) * uy
        across = np.abs((x - ax) * uy - (y - ay) * ux)
        before = -along
        after = along - length
        over = np.maximum(np.maximum(before, after), 0.0)
        depth = half_mm - np.sqrt(across * across + over * over)
        if i == 0 and path.flat_start:
            depth = np.minimum(np.where(before > after, half_mm - across, depth), along)
        if i == last and path.flat_end:
            depth = np.minimum(np.where(after > before, half_mm - across, depth), -after)
        np.maximum(inside_mm, depth, out=inside_mm)


@lru_cache(maxsize=4096)
def _paths(
    char: str, width_mm: float, height_mm: float, stroke_mm: float, roundness: float, serif_one: bool
) -> tuple[_Stroke, ...]:
    """The skeleton of a character scaled to a box in mm, corners rounded, ends run out to the border."""
    if char == "I":
        text = _SERIF_I
    elif char == "1" and serif_one and width_mm > stroke_mm:
        text = ".5,0 .5,1;0,.24 .5,0;0,1 1,1"
    else:
        text = _SKELETONS.get(char) or _invented(char)
    return tuple(_stroke(part, width_mm, height_mm, stroke_mm, roundness) for part in text.split(";"))


def _invented(char: str) -> str:
    """An ideograph-like skeleton made of straight strokes, always the same for the same character."""
    rng = np.random.default_rng(ord(char))
    parts = ["0,.08 1,.08" if rng.random() < 0.5 else "0,.3 1,.3", ".5,0 .5,1" if rng.random() < 0.6 else ".25,0 .25,1"]
    feet = ("0,1 1,1", "0,.5 0,1;0,1 1,1;1,.5 1,1", ".5,.45 0,1;.5,.45 1,1", "0,.62 1,.62;1,.62 1,1;0,1 .2,1")
    parts.append(feet[int(rng.integers(len(feet)))])
    if rng.random() < 0.5:
        parts.append(".2,.5 .8,.5")
    return ";".join(parts)


def _stroke(text: str, width_mm: float, height_mm: float, stroke_mm: float, roundness: float) -> _Stroke:
    words = text.split()
    closed = words[-1] == "z"
    if closed:
        words = words[:-1]
    corners: list[NDArray[np.float64]] = []
    rounded: list[bool] = []
    butt: list[bool] = []
    on_border: list[bool] = []
    for word in words:
        u, v = (float(part) for part in word.rstrip("~|").split(","))
        corners.append(np.array([u * width_mm, v * height_mm]))
        rounded.append(word.endswith("~"))
        butt.append(word.endswith("|"))
        on_border.append(u in (0.0, 1.0) or v in (0.0, 1.0))
    radius_mm = roundness * (width_mm + stroke_mm) / 2
    points: list[NDArray[np.float64]] = []
    for i, corner in enumerate(corners):
        is_end = not closed and i in (0, len(corners) - 1)
        if is_end or not rounded[i]:
            points.append(corner)
            continue
        before, after = corners[i - 1], corners[(i + 1) % len(corners)]
        points.extend(_fillet(before, corner, after, radius_mm))
    if closed:
        points.append(points[0])
        return _Stroke(np.array(points), False, False)
    points[0] = _run_out(points[0], points[1], stroke_mm, on_border[0] and not butt[0])
    points[-1] = _run_out(points[-1], points[-2], stroke_mm, on_border[-1] and not butt[-1])
    return _Stroke(np.array(points), butt[0] or on_border[0], butt[-1] or on_border[-1])


def _run_out(
    end: NDArray[np.float64], neighbour: NDArray[np.float64], stroke_mm: float, wanted: bool
) -> NDArray[np.float64]:
    """Move an end outwards: half a stroke along an axis (a square end), further on a diagonal (cut by the box)."""
    step = end - neighbour
    length = float(np.hypot(*step))
    if not wanted or length < 1e-9:
        return end
    diagonal = min(abs(float(step[0])), abs(float(step[1]))) > 1e-6 * length
    moved: NDArray[np.float64] = end + step / length * (2.0 * stroke_mm if diagonal else 0.5 * stroke_mm)
    return moved


def _fillet(
    before: NDArray[np.float64], corner: NDArray[np.float64], after: NDArray[np.float64], radius_mm: float
) -> list[NDArray[np.float64]]:
    """Points of the arc that rounds a corner, tangent to both legs; the radius gives way to short legs."""
    to_before, to_after = before - corner, after - corner
    leg_before, leg_after = float(np.hypot(*to_before)), float(np.hypot(*to_after))
    if min(leg_before, leg_after) < 1e-9:
        return [corner]
    a, b = to_before / leg_before, to_after / leg_after
    half_angle = math.acos(max(-1.0, min(1.0, float(a @ b)))) / 2
    if not 1e-6 < half_angle < math.pi / 2 - 1e-6:  # the path turns back or goes straight on
        return [corner]
    tangent = min(radius_mm / math.tan(half_angle), leg_before / 2, leg_after / 2)
    radius = tangent * math.tan(half_angle)
    bisector = (a + b) / float(np.hypot(*(a + b)))
    centre = corner + bisector * (radius / math.sin(half_angle))
    start, end = corner + a * tangent - centre, corner + b * tangent - centre
    first = math.atan2(start[1], start[0])
    turn = (math.atan2(end[1], end[0]) - first + math.pi) % (2 * math.pi) - math.pi
    angles = first + turn * np.linspace(0.0, 1.0, _ARC_STEPS + 1)
    return [centre + radius * np.array([math.cos(t), math.sin(t)]) for t in angles]
