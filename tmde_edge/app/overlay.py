"""Draws what was decided over the picture it was decided on: for --video-out, the report and the live page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.geometry.pinhole import Camera, view_from_vehicle
from tmde_edge.messages import FrameResult, GlyphSighting, LeadEstimate, PlateResult, Pose

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]  # BGR

WHITE: Colour = (255, 255, 255)
BLACK: Colour = (0, 0, 0)
GREY: Colour = (190, 190, 190)
CYAN: Colour = (220, 200, 60)
MAGENTA: Colour = (220, 60, 220)
ALERT_COLOURS: dict[str, Colour] = {"none": (90, 200, 90), "caution": (0, 190, 255), "warning": (50, 50, 240)}
FONT = cv2.FONT_HERSHEY_SIMPLEX
MIN_HEIGHT_PX = 540  # smaller pictures are enlarged, or the text would cover them


def draw(
    image: Image, result: FrameResult | None, camera: Camera | None = None, error: str | None = None, *,
    width_px: int | None = None,
) -> Image:  # fmt: skip
    """A new BGR picture with everything drawn in; pictures lower than 540 px come back enlarged by a whole factor.

    `camera` is the calibration (any size of the same aspect); without it no horizon is drawn. `result` None: only
    the error line. `width_px`: the picture comes back this wide, text and lines drawn after scaling.
    """
    factor: float = max(1, math.ceil(MIN_HEIGHT_PX / image.shape[0])) if width_px is None else width_px / image.shape[1]
    size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
    if factor < 1:
        image_shown = shrunk(image, size)
    else:
        image_shown = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8) if factor > 1 else image.copy()
    canvas = cv2.cvtColor(image_shown, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image_shown
    pen = _Pen(np.ascontiguousarray(canvas, dtype=np.uint8), factor)
    if result is not None:
        if camera is not None and result.pose.source != "none":
            _horizon(pen, result.pose, camera.scaled_to(image.shape[1], image.shape[0]))
        for plate in sorted(result.plates, key=lambda p: p.lead):  # the lead's on top
            _plate(pen, plate, result)
        _banner(pen, result)
        _lead_panel(pen, result)
        _ego_panel(pen, result)
    if error is not None:
        pen.box([error], (0.5, 0.5), WHITE, 0.8)
    return pen.canvas


def shrunk(image: Image, size: tuple[int, int]) -> Image:
    """Scaled down to (width, height): by a whole factor first, which is ten times as fast as any other area mean."""
    whole = max(1, min(image.shape[1] // size[0], image.shape[0] // size[1]))
    small = image
    if whole > 1:
        halved = (image.shape[1] // whole, image.shape[0] // whole)
        small = np.asarray(cv2.resize(image, halved, interpolation=cv2.INTER_AREA), np.uint8)
    return small if small.shape[1::-1] == size else np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR), np.uint8)


class _Pen:
    """Draws in source pixels on an enlarged canvas; text sizes follow the canvas, 1 being right for 720 rows."""

    def __init__(self, canvas: Image, factor: float) -> None:
        self.canvas = canvas
        self.factor = factor
        self.height_px, self.width_px = canvas.shape[:2]
        self.unit = max(min(self.height_px / 720, self.width_px / 1000), 0.4)

    def point(self, xy: Sequence[float]) -> tuple[int, int]:
        """Source pixel to canvas, in sixteenths."""
        half = (self.factor - 1) / 2  # pixel centres at integers on both
        return round((xy[0] * self.factor + half) * 16), round((xy[1] * self.factor + half) * 16)

    def outline(self, points: Sequence[Sequence[float]], colour: Colour, width: float) -> None:
        """Closed polygon, sub-pixel."""
        line = np.array([self.point(p) for p in points], np.int32)
        cv2.polylines(self.canvas, [line], True, colour, max(1, round(width * self.unit)), cv2.LINE_AA, 4)

    def text_size(self, text: str, size: float) -> tuple[int, int]:
        """Width and height of a line of text on the canvas."""
        (width, height), _ = cv2.getTextSize(text.replace("±", "+"), FONT, size * self.unit, self._stroke(size))
        return int(width), int(height)

    def text(self, text: str, left_base: tuple[int, int], colour: Colour, size: float) -> None:
        """One line with its base line at left_base (canvas pixels); ± is drawn, for the fonts of OpenCV 4 lack it."""
        x, y = left_base
        stroke = self._stroke(size)
        cv2.putText(self.canvas, text.replace("±", "+"), (x, y), FONT, size * self.unit, colour, stroke, cv2.LINE_AA)
        before = text.find("±")
        if before >= 0:
            x0 = x + self.text_size(text[:before], size)[0]
            x1 = x + self.text_size(text[: before + 1], size)[0]
            inset = max(1, (x1 - x0) // 6)
            cv2.line(self.canvas, (x0 + inset, y), (x1 - inset, y), colour, stroke, cv2.LINE_AA)

    def box(
        self, lines: Sequence[str], at: tuple[float, float], colour: Colour, size: float, background: Colour = BLACK,
    ) -> None:  # fmt: skip
        """Lines on a dark ground, the first of several larger; `at`: (0, 0) is top left of the canvas, (1, 1) bottom right."""
        margin = round(12 * self.unit)
        sizes = [self.text_size(line, size * (1.5 if i == 0 and len(lines) > 1 else 1)) for i, line in enumerate(lines)]
        width = max(w for w, _ in sizes) + 2 * margin
        height = sum(h + margin for _, h in sizes) + margin
        x0, y0 = round((self.width_px - width) * at[0]), round((self.height_px - height) * at[1])
        self.shade(x0, y0, x0 + width, y0 + height, background)
        y = y0
        for i, (line, (_, h)) in enumerate(zip(lines, sizes, strict=True)):
            y += h + margin
            headline = i == 0 and len(lines) > 1
            self.text(line, (x0 + margin, y), colour if i == 0 else WHITE, size * (1.5 if headline else 1))

    def shade(self, x0: int, y0: int, x1: int, y1: int, colour: Colour, opacity: float = 0.62) -> None:
        """Covers a rectangle of the canvas in part."""
        part = self.canvas[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)]
        if part.size:
            cover = np.full(part.shape, colour, np.uint8)
            cv2.addWeighted(part, 1 - opacity, cover, opacity, 0.0, dst=part)

    def _stroke(self, size: float) -> int:
        return max(1, int(1.8 * size * self.unit + 0.5))


def _horizon(pen: _Pen, pose: Pose, camera: Camera) -> None:
    """The line where a level road would meet the sky, from the pose in force."""
    view = view_from_vehicle(pose.pitch_rad, pose.roll_rad, pose.yaw_rad)
    half = 0.9 * math.atan(camera.width_px / (2 * camera.fx_px))
    directions = [view @ np.array([math.tan(half * k / 10), 0.0, 1.0]) for k in range(-10, 11)]
    points = [pen.point(p) for p in camera.project(np.array(directions)) if np.isfinite(p).all()]
    for a, b in zip(points[::2], points[1::2], strict=False):  # dashed
        cv2.line(pen.canvas, a, b, CYAN, max(1, round(1.5 * pen.unit)), cv2.LINE_AA, 4)


def _plate(pen: _Pen, plate: PlateResult, result: FrameResult) -> None:
    seen = plate.sighting
    colour = ALERT_COLOURS[result.alert.level] if plate.lead else GREY
    pen.outline(seen.corners_px, colour, 2 if plate.lead else 1)
    for glyph in seen.glyphs:
        pen.outline(_glyph_corners(glyph), MAGENTA if glyph.main else CYAN, 1)
    for bolts in seen.bolts:
        cv2.line(pen.canvas, pen.point(bolts.left_px), pen.point(bolts.right_px), CYAN, 1, cv2.LINE_AA, 4)
    if plate.range is not None:
        label = f"{plate.range.distance_m:.2f} ± {plate.range.sigma_m:.2f} m"
        label += f"  {plate.range.standard}" if plate.range.standard else ""
    else:
        label = plate.not_ranged or "not ranged"
    size = 0.6
    width, height = pen.text_size(label, size)
    corners = [pen.point(c) for c in seen.corners_px]
    left, top = min(c[0] for c in corners) // 16, min(c[1] for c in corners) // 16
    bottom = max(c[1] for c in corners) // 16
    gap = round(8 * pen.unit)
    y = top - gap if top - gap - height > round(60 * pen.unit) else bottom + gap + height
    x = min(max(left, gap), pen.width_px - width - gap)
    pen.shade(x - gap // 2, y - height - gap // 2, x + width + gap // 2, y + gap, BLACK, 0.5)
    pen.text(label, (x, y), WHITE, size)


def _glyph_corners(glyph: GlyphSighting) -> list[tuple[float, float]]:
    """The parallelogram through the four edge middles."""
    edges = (glyph.left_px, glyph.right_px, glyph.top_px, glyph.bottom_px)
    cx, cy = sum(p[0] for p in edges) / 4, sum(p[1] for p in edges) / 4
    (lx, ly), (rx, ry), (tx, ty), (bx, by) = edges
    pairs = ((lx + tx, ly + ty), (rx + tx, ry + ty), (rx + bx, ry + by), (lx + bx, ly + by))
    return [(x - cx, y - cy) for x, y in pairs]


def _banner(pen: _Pen, result: FrameResult) -> None:
    """The alert across the top; a fault never hides it."""
    alert = result.alert
    height = round(44 * pen.unit)
    loud = alert.level != "none"
    pen.shade(0, 0, pen.width_px, height, ALERT_COLOURS[alert.level] if loud else BLACK, 0.85 if loud else 0.55)
    text = {"none": "no alert", "caution": "CAUTION", "warning": "WARNING"}[alert.level]
    text += f"  {alert.reason}" if alert.reason not in ("", "ttc") else ""
    text += f"  TTC {alert.ttc_s:.1f} s" if alert.ttc_s is not None else ""
    ink = BLACK if alert.level == "caution" else WHITE
    base = round(31 * pen.unit)
    pen.text(text, (round(14 * pen.unit), base), ink, 0.9)
    right = f"frame {result.frame_index}  {result.t_ns * 1e-9:.2f} s  {result.mode}"
    pen.text(right, (pen.width_px - pen.text_size(right, 0.65)[0] - round(14 * pen.unit), base), ink, 0.65)
    if result.faults:
        line = "faults: " + ", ".join(result.faults)
        width, text_height = pen.text_size(line, 0.65)
        pen.shade(0, height, width + round(28 * pen.unit), height + text_height + round(16 * pen.unit), (40, 0, 90), 0.7)
        pen.text(line, (round(14 * pen.unit), height + text_height + round(7 * pen.unit)), WHITE, 0.65)


def _lead_panel(pen: _Pen, result: FrameResult) -> None:
    lead = result.lead
    if lead is None:
        pen.box(["no lead vehicle"], (0.0, 1.0), GREY, 0.7)
        return
    pen.box(lead_lines(lead), (0.0, 1.0), ALERT_COLOURS[result.alert.level], 0.75)


def lead_lines(lead: LeadEstimate) -> list[str]:
    """The lead in words: distance, range rate, TTC, headway, and where it comes from."""
    lines = []
    if lead.distance_m is not None and lead.sigma_m is not None:
        lines.append(f"{lead.distance_m:.2f} ± {lead.sigma_m:.2f} m")
    else:
        lines.append("distance: not calibrated")
    if lead.range_rate_mps is not None and lead.range_rate_sigma_mps is not None:
        lines.append(f"range rate {lead.range_rate_mps:+.1f} ± {lead.range_rate_sigma_mps:.1f} m/s")
    sigma = f" ± {max(lead.ttc_sigma_s, 0.1):.1f}" if lead.ttc_sigma_s is not None else ""
    lines.append(f"TTC {lead.ttc_s:.1f}{sigma} s" if lead.ttc_s is not None else "TTC -  (not closing)")
    if lead.headway_s is not None:
        lines.append(f"headway {lead.headway_s:.1f} s")
    coasting = f", unseen for {lead.coasting_s:.1f} s" if lead.coasting_s > 0.05 else ""
    lines.append(f"by {lead.source}{coasting}")
    return lines


def _ego_panel(pen: _Pen, result: FrameResult) -> None:
    ego, pose, depth = result.ego, result.pose, result.depth
    lines = [f"{ego.speed_mps * 3.6:.0f} km/h" if ego is not None else "no speed"]
    if ego is not None and ego.yaw_rate_radps is not None:
        lines.append(f"yaw {math.degrees(ego.yaw_rate_radps):+.1f} deg/s")
    if pose.source != "none":
        lines.append(f"pitch {math.degrees(pose.pitch_rad):+.1f} roll {math.degrees(pose.roll_rad):+.1f} deg ({pose.source})")
    if depth is not None:
        lines.append(f"depth {depth.distance_m:.1f} ± {depth.sigma_m:.1f} m")
    pen.box(lines, (1.0, 1.0), WHITE, 0.6)
