"""Plate faces for training: invented ones of every layout in free fonts (below), and the product's own styles drawn in the same fonts."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Rng = np.random.Generator
Face = NDArray[np.uint8]
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
ALNUM = LETTERS + "0123456789"
WORDS = ("ARIZONA CALIFORNIA GARDEN STATE TEXAS FLORIDA OHIO OREGON NEVADA MAINE VIRGINIA GREAT LAKES SUNSHINE STATE VACATIONLAND EMPIRE STATE LIVE FREE "
         "FIRST IN FLIGHT LAND OF LINCOLN WILD WONDERFUL EVERGREEN PURE DEALER MOTORS AUTO HAUS CENTER VICTORIA QUEENSLAND ONTARIO YOURS TO DISCOVER").split()
PREFERRED = ("Narrow", "Condensed", "DIN", "Bold", "Mono", "Gothic", "Spartan", "Yanone", "Bebas", "Roboto", "Liberation", "DejaVuSans", "FreeSans", "Nimbus", "Overpass", "Cabin", "Dosis", "Oxygen")


def latin_fonts(folder: Path = Path("/usr/share/fonts")) -> list[str]:
    """Font files below the folder that have every letter and digit, likely plate fonts first."""
    from fontTools.ttLib import TTFont

    found = []
    for f in sorted(folder.rglob("*.[to]tf")):
        if any(w in f.name for w in ("Emoji", "Symbol", "Italic", "Oblique", "Math", "DSEG", "Sketch")):
            continue
        try:
            cmap = TTFont(str(f), lazy=True).getBestCmap()
        except (OSError, ValueError, KeyError, AssertionError):
            continue
        if cmap and all(ord(c) in cmap for c in ALNUM + "abcxyz"):
            found.append(str(f))
    return sorted(found, key=lambda n: -sum(w in n for w in PREFERRED))


class Fonts:
    """Draws a text to fill a box; keeps opened fonts."""

    def __init__(self, paths: list[str]) -> None:
        self.paths = paths
        self.open: dict[tuple[str, int], ImageFont.FreeTypeFont] = {}

    def pick(self, rng: Rng) -> str:
        """A font file, those that look like plates' more often."""
        n = len(self.paths)
        return self.paths[int(n * rng.random() ** 2)]

    def ink(self, path: str, text: str, width_px: int, height_px: int, bold: float = 0.0) -> NDArray[np.float32]:
        """Coverage (height_px, width_px) of the text's ink stretched to the box."""
        key = (path, 64)
        if key not in self.open:
            self.open[key] = ImageFont.truetype(path, 64)
        font = self.open[key]
        stroke = round(bold * 64)
        x0, y0, x1, y1 = font.getbbox(text, stroke_width=stroke)
        mask = Image.new("L", (max(int(x1 - x0), 1), max(int(y1 - y0), 1)))
        ImageDraw.Draw(mask).text((-x0, -y0), text, fill=255, font=font, stroke_width=stroke)
        arr = np.asarray(mask)
        rows, cols = np.flatnonzero(arr.any(1)), np.flatnonzero(arr.any(0))
        if len(rows) == 0:
            return np.zeros((height_px, width_px), np.float32)
        arr = arr[rows[0]:rows[-1] + 1, cols[0]:cols[-1] + 1]
        shrink = arr.shape[0] * arr.shape[1] > width_px * height_px
        return cv2.resize(arr, (max(width_px, 1), max(height_px, 1)), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR).astype(np.float32) / 255


def colour(rng: Rng, lo: float, hi: float) -> NDArray[np.float32]:
    """A random colour with mean level between lo and hi."""
    c = rng.random(3) * rng.uniform(0, 1) + 0.15
    return np.clip(c / c.mean() * rng.uniform(lo, hi), 0, 255).astype(np.float32)


def blend(img: NDArray[np.float32], cov: NDArray[np.float32], x: int, y: int, col: NDArray[np.float32]) -> None:
    """Lays a colour over the picture with a coverage map whose top left corner is at x, y; what lies outside is cut."""
    h, w = img.shape[:2]
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + cov.shape[1], w), min(y + cov.shape[0], h)
    if x0 < x1 and y0 < y1:
        part = img[y0:y1, x0:x1]
        part += cov[y0 - y:y1 - y, x0 - x:x1 - x, None] * (col - part)


def code(rng: Rng, n: int) -> str:
    """A registration-like text of n characters."""
    k = rng.integers(0, 4)
    if k == 0:
        return "".join(rng.choice(list(ALNUM), n))
    if k == 1:
        return "".join(rng.choice(list("0123456789"), n))
    a = int(rng.integers(1, max(n, 2)))
    left = "".join(rng.choice(list(LETTERS), a))
    right = "".join(rng.choice(list("0123456789"), max(n - a, 0)))
    return left + right if k == 2 else right + left


def picture(rng: Rng, w: int, h: int, base: NDArray[np.float32]) -> NDArray[np.float32]:
    """State graphics: gradients, hills, suns, stripes behind the serial."""
    img = np.empty((h, w, 3), np.float32)
    other = np.clip(base + rng.normal(0, 60, 3), 40, 255).astype(np.float32)
    t = np.linspace(0, 1, h, dtype=np.float32)[:, None, None] if rng.random() < 0.7 else np.linspace(0, 1, w, dtype=np.float32)[None, :, None]
    if rng.random() < 0.5:
        t = np.abs(2 * t - 1)
    img[:] = base + t ** rng.uniform(0.5, 3) * (other - base)
    for _ in range(int(rng.integers(0, 4))):
        col = np.clip(base + rng.normal(0, 55, 3), 30, 255).astype(np.float32)
        layer = np.zeros((h, w), np.float32)
        k = rng.integers(0, 3)
        if k == 0:
            pts = [(0, h)] + [(int(x), int(h * rng.uniform(0.3, 1))) for x in np.linspace(0, w, int(rng.integers(3, 8)))] + [(w, h)]
            cv2.fillPoly(layer, [np.array(pts, np.int32)], 1.0, cv2.LINE_AA)
        elif k == 1:
            cv2.circle(layer, (int(rng.uniform(0, w)), int(rng.uniform(0, h))), int(h * rng.uniform(0.1, 0.4)), 1.0, -1, cv2.LINE_AA)
        else:
            y = int(rng.uniform(0, h))
            cv2.rectangle(layer, (0, y), (w, y + int(h * rng.uniform(0.03, 0.25))), 1.0, -1)
        img += (layer * rng.uniform(0.3, 1))[..., None] * (col - img)
    return img


ASPECTS = {"eu": (4.3, 5.0), "us": (1.9, 2.1), "two": (1.25, 1.75), "mid": (2.2, 4.2)}


def wild_face(rng: Rng, fonts: Fonts, kind: str, width_px: int = 400) -> Face:
    """An invented plate face; kind one of ASPECTS."""
    aspect = rng.uniform(*ASPECTS[kind])
    w, h = width_px, max(20, round(width_px / aspect))
    dark = rng.random() < 0.14
    if dark:
        bg, ink_c = colour(rng, 10, 90), colour(rng, 170, 250)
    else:
        bg = np.array((255, 255, 255), np.float32) * rng.uniform(0.75, 1.0) if rng.random() < 0.62 else colour(rng, 140, 230)
        if rng.random() < 0.12:
            bg = np.array((rng.uniform(0, 70), rng.uniform(170, 220), rng.uniform(220, 255)), np.float32)
        ink_c = np.full(3, rng.uniform(0, 40), np.float32) if rng.random() < 0.6 else colour(rng, 10, 95)
    if kind == "us" and rng.random() < 0.55 or rng.random() < 0.06:
        img = picture(rng, w, h, bg)
    else:
        img = np.empty((h, w, 3), np.float32)
        img[:] = bg
    left, right = 0.03 * w, 0.97 * w
    if kind in ("eu", "mid") and rng.random() < 0.65:
        band = rng.uniform(0.07, 0.11) * w
        col = np.array((rng.uniform(120, 200), rng.uniform(30, 80), rng.uniform(0, 50)), np.float32) if rng.random() < 0.85 else colour(rng, 30, 140)
        img[:, : int(band)] = col
        if rng.random() < 0.8:
            cv2.circle(img, (int(band / 2), int(h * 0.3)), int(band * 0.32), (40, 210, 240), max(1, int(band * 0.1)), cv2.LINE_AA)
            blend(img, fonts.ink(fonts.pick(rng), code(rng, 1) if rng.random() < 0.5 else "RO", int(band * 0.5), int(h * 0.22)), int(band * 0.25), int(h * 0.65), np.full(3, 235, np.float32))
        left = band + 0.02 * w
        if rng.random() < 0.15:
            img[:, int(w - band):] = col
            right = w - band
    path, bold = fonts.pick(rng), max(0.0, rng.normal(0.02, 0.03))
    if rng.random() < 0.7 * (kind != "two") + 0.2:
        path = fonts.paths[int(len(fonts.paths) * 0.35 * rng.random())]
    second = np.clip(ink_c + rng.normal(0, 60, 3), 0, 255).astype(np.float32) if rng.random() < 0.3 else ink_c

    def words() -> str:
        return " ".join(rng.choice(WORDS, int(rng.integers(1, 3))))

    def row(y0: float, y1: float, n: int, x0: float, x1: float) -> None:
        height = (y1 - y0) * h
        text = code(rng, n)
        ratio = rng.uniform(0.4, 0.75) if kind != "two" else rng.uniform(0.45, 0.9)
        char_w = min(height * ratio, (x1 - x0) / (n * 1.12))
        gap = char_w * rng.uniform(0.1, 0.28)
        groups = int(rng.integers(0, 3)) if n >= 5 else 0
        breaks = sorted(rng.choice(np.arange(1, n), groups, replace=False)) if groups else []
        space = char_w * rng.uniform(0.3, 1.0)
        total = n * char_w + (n - 1) * gap + groups * space
        squeeze = min(1.0, (x1 - x0) / total)
        char_w, gap, space = char_w * squeeze, gap * squeeze, space * squeeze
        x = x0 + (x1 - x0 - total * squeeze) * (rng.random() if rng.random() < 0.3 else 0.5)
        for i, c in enumerate(text):
            if i in breaks:
                k = rng.integers(0, 4)
                mid = x + space / 2 - gap / 2
                if k == 0:
                    cv2.line(img, (int(mid - space * 0.2), int((y0 + y1) / 2 * h)), (int(mid + space * 0.2), int((y0 + y1) / 2 * h)), ink_c.tolist(), max(2, int(height * 0.09)), cv2.LINE_AA)
                elif k == 1:
                    cv2.circle(img, (int(mid), int((y0 + rng.uniform(0.25, 0.75) * (y1 - y0)) * h)), max(2, int(space * 0.33)), colour(rng, 60, 220).tolist(), -1, cv2.LINE_AA)
                x += space
            cw = char_w * (0.35 if c in "1I" and rng.random() < 0.5 else 1.0)
            blend(img, fonts.ink(path, c, max(2, round(cw)), max(2, round(height)), bold), round(x + (char_w - cw) / 2), round(y0 * h), ink_c)
            x += char_w + gap

    if kind == "us" or kind == "mid" and rng.random() < 0.35:
        top, bottom = rng.uniform(0.2, 0.3), rng.uniform(0.72, 0.84)
        row(top, bottom, int(rng.integers(5, 9)), left + 0.02 * w, right - 0.02 * w)
        small = fonts.pick(rng)
        if rng.random() < 0.9:
            tw = rng.uniform(0.25, 0.7) * w
            blend(img, fonts.ink(small, words(), int(tw), int((top - 0.09) * h)), int((w - tw) / 2), int(0.045 * h), second)
        if rng.random() < 0.7:
            tw = rng.uniform(0.25, 0.7) * w
            blend(img, fonts.ink(small, words() if rng.random() < 0.7 else words().title(), int(tw), int((0.93 - bottom) * h * rng.uniform(0.6, 1))), int((w - tw) / 2), int((bottom + 0.045) * h), second)
        for cx in (0.07, 0.93):
            if rng.random() < 0.45:
                x, y = int((cx - 0.05) * w), int(rng.choice((0.03, 0.8)) * h)
                cv2.rectangle(img, (x, y), (x + int(0.1 * w), y + int(0.15 * h)), colour(rng, 40, 240).tolist(), -1)
                blend(img, fonts.ink(small, code(rng, 2), int(0.07 * w), int(0.09 * h)), x + int(0.015 * w), y + int(0.03 * h), colour(rng, 0, 255))
    elif kind == "two":
        split = rng.uniform(0.36, 0.52)
        pad = rng.uniform(0.06, 0.1)
        n1, n2 = int(rng.integers(2, 5)), int(rng.integers(3, 6))
        row(pad, split - pad / 3, n1, left + 0.04 * w + rng.uniform(0, 0.12) * w, right - 0.04 * w - rng.uniform(0, 0.12) * w)
        row(split + pad / 3, 1 - pad, n2, left + 0.03 * w, right - 0.03 * w)
    else:
        pad = rng.uniform(0.1, 0.22)
        row(pad, 1 - pad, int(rng.integers(4, 9)), left + 0.01 * w, right - 0.01 * w)
    if rng.random() < 0.5:
        inset, thick = int(rng.uniform(0, 0.015) * w), max(1, int(rng.uniform(0.004, 0.014) * w))
        cv2.rectangle(img, (inset, inset), (w - 1 - inset, h - 1 - inset), second.tolist(), thick, cv2.LINE_AA)
    if rng.random() < 0.6:
        y = rng.choice((0.08, 0.5, 0.9)) if kind != "us" else rng.choice((0.07, 0.92))
        x = rng.uniform(0.06, 0.3) if kind == "us" else rng.uniform(0.02, 0.3)
        col = float(rng.uniform(20, 230))
        for xx in (x, 1 - x):
            for yy in {y, 1 - y} if rng.random() < 0.3 else {y}:
                cv2.circle(img, (int(xx * w), int(yy * h)), max(2, int(w * rng.uniform(0.008, 0.02))), (col, col, col), -1, cv2.LINE_AA)
    return np.clip(img, 0, 255).astype(np.uint8)


class TtfFont:
    """A font file as a GlyphFont of tmde_edge.simulation.plate_face."""

    def __init__(self, fonts: Fonts, path: str) -> None:
        self.fonts, self.path = fonts, path

    def supports(self, char: str) -> bool:
        """Latin letters and digits."""
        return char in ALNUM

    def coverage(self, char: str, *, width_mm: float, height_mm: float, stroke_mm: float, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64], px_per_mm: float) -> NDArray[np.float32]:
        """Ink coverage (len(y_mm), len(x_mm))."""
        ink = self.fonts.ink(self.path, char, max(2, round(width_mm * px_per_mm)), max(2, round(height_mm * px_per_mm)))
        mx = (x_mm * px_per_mm - 0.5).astype(np.float32)
        my = (y_mm * px_per_mm - 0.5).astype(np.float32)
        gx, gy = np.meshgrid(mx, my)
        out: NDArray[np.float32] = cv2.remap(ink, gx, gy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return out


def styled_face(rng: Rng, fonts: Fonts, width_px: int = 400) -> Face:
    """A face from the product's own table of plate styles, in its own letters or in a free font."""
    from tmde_edge.simulation.plate_face import render_face
    from tmde_edge.simulation.plate_styles import random_spec

    spec = random_spec(rng)
    font = TtfFont(fonts, fonts.paths[int(len(fonts.paths) * 0.4 * rng.random())]) if rng.random() < 0.6 else None
    return np.asarray(render_face(spec, width_px / spec.width_mm, font))
