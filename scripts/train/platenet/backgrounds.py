"""What lies behind the plates: photos, in-car frames, drawn car rears, and things that look like plates but are none."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from faces import ALNUM, Fonts, blend, code, colour

Rng = np.random.Generator
Image8 = NDArray[np.uint8]
ImageF = NDArray[np.float32]


def load_photos(patterns: list[str], max_side_px: int = 1400, limit: int = 1000) -> list[Image8]:
    """Every photo that the glob patterns (absolute) name and OpenCV reads, at most max_side_px wide or high."""
    out = []
    for pattern in patterns:
        for f in sorted(Path("/").glob(pattern.lstrip("/")))[:limit]:
            img = cv2.imread(str(f), cv2.IMREAD_COLOR)
            if img is None or min(img.shape[:2]) < 200:
                continue
            k = max_side_px / max(img.shape[:2])
            out.append(cv2.resize(img, None, fx=k, fy=k, interpolation=cv2.INTER_AREA) if k < 1 else img)
    return out


def load_cliparts(folder: str, limit: int = 1500, side_px: int = 220, seed: int = 0) -> list[tuple[ImageF, ImageF]]:
    """(picture, alpha) of drawings with transparency."""
    files = sorted(Path(folder).rglob("*.png")) if Path(folder).exists() else []
    rng = np.random.default_rng(seed)
    rng.shuffle(files)  # type: ignore[arg-type]
    out = []
    for f in files[:limit]:
        if any(w in f.name.lower() for w in ("plate", "licen")):
            continue
        img = cv2.imread(str(f), cv2.IMREAD_UNCHANGED)
        if img is None or img.ndim != 3 or img.shape[2] != 4 or min(img.shape[:2]) < 24:
            continue
        k = side_px / max(img.shape[:2])
        img = cv2.resize(img, None, fx=k, fy=k, interpolation=cv2.INTER_AREA if k < 1 else cv2.INTER_LINEAR)
        out.append((img[..., :3], img[..., 3]))
    return out


def texture(rng: Rng, h: int, w: int) -> ImageF:
    """A drawn surface: plain, gradient, bricks, shutters, planks, blotches."""
    base = colour(rng, 25, 220)
    img = np.empty((h, w, 3), np.float32)
    img[:] = base
    k = rng.integers(0, 6)
    other = np.clip(base * rng.uniform(0.4, 1.5) + rng.normal(0, 15, 3), 0, 255).astype(np.float32)
    if k == 1:
        t = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
        img += t * (other - base)
    elif k == 2:
        bw, bh = int(rng.uniform(12, 70)), int(rng.uniform(6, 28))
        for j, y in enumerate(range(0, h, bh)):
            cv2.line(img, (0, y), (w, y), other.tolist(), 1 + bh // 10)
            for x in range((j % 2) * bw // 2, w, bw):
                cv2.line(img, (x, y), (x, y + bh), other.tolist(), 1 + bh // 10)
    elif k == 3:
        step = int(rng.uniform(4, 30))
        for y in range(0, h, step):
            cv2.line(img, (0, y), (w, y), other.tolist(), max(1, step // 4), cv2.LINE_AA)
    elif k == 4:
        step = int(rng.uniform(6, 60))
        for x in range(0, w, step):
            cv2.line(img, (x, 0), (x, h), other.tolist(), max(1, step // 5), cv2.LINE_AA)
    elif k == 5:
        for _ in range(int(rng.integers(5, 40))):
            c, s = colour(rng, 10, 240).tolist(), rng.uniform(0.03, 0.4, 2) * w
            x, y = rng.uniform(0, w), rng.uniform(0, h)
            if rng.random() < 0.6:
                cv2.rectangle(img, (int(x), int(y)), (int(x + s[0]), int(y + s[1])), c, -1 if rng.random() < 0.7 else 2)
            else:
                cv2.ellipse(img, (int(x), int(y)), (int(s[0] / 2) + 1, int(s[1] / 2) + 1), rng.uniform(0, 180), 0, 360, c, -1, cv2.LINE_AA)
    n = int(rng.integers(3, 24))
    rough = cv2.resize(rng.normal(0, 1, (n, n)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
    img += rough[..., None] * rng.uniform(2, 18)
    return img


def draw_rear(rng: Rng, img: ImageF, fonts: Fonts, cx: float, cy: float, pw: float, ph: float) -> None:
    """Draws the rear (or front) of a car round a plate of pw x ph px centred at cx, cy: body, recess, bumper, lamps, seams, badge, glass."""
    h, w = img.shape[:2]
    u = pw * rng.uniform(0.85, 1.25)
    half = u * rng.uniform(1.4, 2.3)
    top, bottom = cy - u * rng.uniform(0.7, 1.5), cy + u * rng.uniform(0.35, 1.3)
    body = colour(rng, 15, 245) if rng.random() < 0.45 else np.full(3, rng.choice((20, 45, 90, 140, 185, 235)), np.float32) + rng.normal(0, 6, 3).astype(np.float32)
    body = np.clip(body, 5, 250)

    def box(x0: float, y0: float, x1: float, y1: float, col: NDArray[np.float32], k: float = 0.0) -> None:
        """A box with rounded look and a vertical shading of relative strength k."""
        a, b, c, d = max(int(x0), 0), max(int(y0), 0), min(int(x1) + 1, w), min(int(y1) + 1, h)
        if a < c and b < d:
            t = ((np.arange(b, d, dtype=np.float32) - y0) / max(y1 - y0, 1) - 0.5)[:, None, None]
            img[b:d, a:c] = np.clip(col * (1 - k * t), 0, 255)

    def poly(pts: list[tuple[float, float]], col: NDArray[np.float32]) -> None:
        cv2.fillPoly(img, [np.array(pts, np.float32).round().astype(np.int32)], col.tolist(), cv2.LINE_AA)

    def seam(x0: float, y0: float, x1: float, y1: float, dark: float) -> None:
        cv2.line(img, (int(x0), int(y0)), (int(x1), int(y1)), (body * dark).tolist(), max(1, int(u * rng.uniform(0.006, 0.02))), cv2.LINE_AA)

    taper = u * rng.uniform(0, 0.3)
    poly([(cx - half + taper, top), (cx + half - taper, top), (cx + half, cy), (cx + half, bottom), (cx - half, bottom), (cx - half, cy)], body)
    for y0, y1 in ((top, cy - 0.3 * u), (cy - 0.3 * u, cy + 0.3 * u), (cy + 0.3 * u, bottom)):
        box(cx - half + taper, y0, cx + half - taper, y1, body * rng.uniform(0.75, 1.1), rng.uniform(-0.5, 0.7))
    glass = top - u * rng.uniform(0.3, 0.9)
    poly([(cx - half * 0.75, glass), (cx + half * 0.75, glass), (cx + half * 0.93, top), (cx - half * 0.93, top)], colour(rng, 15, 110))
    if rng.random() < 0.6:
        poly([(cx - half * rng.uniform(0, 0.7), glass), (cx + half * 0.3, glass), (cx + half * 0.1, top), (cx - half * 0.8, top)], colour(rng, 60, 190))
    if rng.random() < 0.7:  # lower bumper or shadow
        y = cy + u * rng.uniform(0.2, 0.7)
        box(cx - half, y, cx + half, bottom, np.full(3, rng.uniform(15, 80), np.float32) if rng.random() < 0.6 else body * 0.9, rng.uniform(-0.4, 0.6))
    box(cx - half, bottom, cx + half, bottom + u * 0.2, np.full(3, rng.uniform(5, 40), np.float32))
    red = np.array((rng.uniform(0, 50), rng.uniform(0, 50), rng.uniform(90, 255)), np.float32) if rng.random() < 0.8 else colour(rng, 150, 250)
    ly, lh, lw = cy + u * rng.uniform(-0.6, 0.0), u * rng.uniform(0.12, 0.6), u * rng.uniform(0.15, 0.8)
    for s in (-1, 1):
        x = cx + s * half * 0.98
        poly([(x, ly), (x - s * lw, ly + lh * rng.uniform(0, 0.3)), (x - s * lw * rng.uniform(0.6, 1), ly + lh), (x, ly + lh)], red)
        if rng.random() < 0.5:
            poly([(x, ly + lh * 0.4), (x - s * lw * 0.7, ly + lh * 0.4), (x - s * lw * 0.6, ly + lh * 0.6), (x, ly + lh * 0.6)], colour(rng, 120, 250))
        if rng.random() < 0.4:
            ex, ey = int(cx + s * half * 0.7), int(bottom - u * 0.05)
            cv2.ellipse(img, (ex, ey), (max(1, int(u * 0.12)), max(1, int(u * 0.06))), 0, 0, 360, (130, 130, 135), -1, cv2.LINE_AA)
            cv2.ellipse(img, (ex, ey), (max(1, int(u * 0.09)), max(1, int(u * 0.04))), 0, 0, 360, (15, 15, 15), -1, cv2.LINE_AA)
        if rng.random() < 0.3:
            rx = cx + s * half * 0.8
            box(rx - u * 0.13, cy + u * 0.4, rx + u * 0.13, cy + u * 0.48, red * 0.9)
    for _ in range(int(rng.integers(1, 4))):
        y = cy + u * rng.uniform(-0.8, 0.9)
        seam(cx - half, y + u * rng.uniform(-0.1, 0.1), cx + half, y, rng.uniform(0.3, 0.7))
    if rng.random() < 0.5:
        seam(cx - half * 0.7, top, cx - half * 0.62, cy + 0.3 * u, 0.4)
        seam(cx + half * 0.7, top, cx + half * 0.62, cy + 0.3 * u, 0.4)
    if rng.random() < 0.75:  # recess round the plate
        mx, my0, my1 = u * rng.uniform(0.03, 0.3), ph * rng.uniform(0.05, 0.6), ph * rng.uniform(0.05, 0.5)
        shade = rng.uniform(0.25, 1.12)
        box(cx - pw / 2 - mx, cy - ph / 2 - my0, cx + pw / 2 + mx, cy + ph / 2 + my1, body * shade, rng.uniform(-0.9, 0.5))
    if rng.random() < 0.5:  # strip or handle above the plate
        y = cy - ph / 2 - u * rng.uniform(0.04, 0.2)
        lum = rng.uniform(20, 250)
        box(cx - u * rng.uniform(0.3, 0.9), y - u * rng.uniform(0.02, 0.1), cx + u * rng.uniform(0.3, 0.9), y, np.full(3, lum, np.float32), rng.uniform(-1, 1))
    if rng.random() < 0.35:  # grille below or above
        y0 = cy + u * rng.uniform(0.2, 0.4) if rng.random() < 0.5 else top + u * 0.05
        y1, n = y0 + u * rng.uniform(0.15, 0.4), int(rng.integers(3, 9))
        box(cx - half * 0.7, y0, cx + half * 0.7, y1, np.full(3, 18, np.float32))
        for y in np.linspace(y0, y1, n):
            cv2.line(img, (int(cx - half * 0.7), int(y)), (int(cx + half * 0.7), int(y)), (rng.uniform(40, 210),) * 3, max(1, int(u * 0.015)), cv2.LINE_AA)
    for _ in range(int(rng.integers(0, 4))):  # badges, model names and stickers
        tw, th = u * rng.uniform(0.15, 0.8), u * rng.uniform(0.04, 0.13)
        x, y = cx + half * rng.uniform(-0.85, 0.5), cy - u * rng.uniform(0.3, 0.85) if rng.random() < 0.7 else cy + ph / 2 + u * rng.uniform(0.1, 0.4)
        if y + th > cy - ph / 2 - 1 and y < cy + ph / 2 + 1:
            continue
        text = code(rng, int(rng.integers(2, 7))) if rng.random() < 0.6 else "".join(rng.choice(list(ALNUM), int(rng.integers(4, 10)))).title()
        if rng.random() < 0.3:
            box(x - th * 0.5, y - th * 0.5, x + tw + th * 0.5, y + th * 1.5, colour(rng, 30, 250))
        blend(img, fonts.ink(fonts.pick(rng), text, max(3, int(tw)), max(2, int(th))), int(x), int(y), colour(rng, 10, 250))
    if rng.random() < 0.5:
        cv2.ellipse(img, (int(cx), int(cy - ph / 2 - u * rng.uniform(0.15, 0.5))), (max(1, int(u * rng.uniform(0.05, 0.13))),) * 2, 0, 0, 360, colour(rng, 60, 240).tolist(), -1 if rng.random() < 0.5 else max(1, int(u * 0.02)), cv2.LINE_AA)


def false_card(rng: Rng, fonts: Fonts) -> Image8:
    """Something flat that is no plate: sign, poster, lettering, grille, lamp, vent, empty holder, keypad, barcode, window, clock."""
    w = 256
    h = max(16, int(w / rng.uniform(0.7, 6)))
    bg = colour(rng, 10, 245)
    fg = colour(rng, 150, 255) if bg.mean() < 120 else colour(rng, 0, 110)
    img = np.empty((h, w, 3), np.float32)
    img[:] = bg
    k = rng.integers(0, 12)
    font = fonts.pick(rng)
    if k <= 2:  # many lines of small text
        n = int(rng.integers(2, 9))
        for i in range(n):
            tw = rng.uniform(0.3, 0.92) * w
            text = "".join(rng.choice(list("abcdefghiklmnoprstuvwy" if rng.random() < 0.7 else ALNUM), int(rng.integers(8, 28))))
            blend(img, fonts.ink(font, text, int(tw), max(3, int(h / n * rng.uniform(0.4, 0.75)))), int(0.04 * w), int((i + 0.2) * h / n), fg)
    elif k == 3:  # one long word in lower case
        text = "".join(rng.choice(list("abcdefghiklmnoprstuvwy"), int(rng.integers(4, 14))))
        blend(img, fonts.ink(font, text.title() if rng.random() < 0.5 else text, int(w * 0.9), int(h * 0.6)), int(0.05 * w), int(0.2 * h), fg)
    elif k == 4:  # bars: grille, vent, shutter, radiator
        n = int(rng.integers(4, 30))
        for i in range(n):
            if h < w and rng.random() < 0.97:
                y = int((i + 0.5) * h / n)
                cv2.line(img, (0, y), (w, y), fg.tolist(), max(1, int(h / n * 0.4)))
    elif k == 5:  # upright bars: fence, barcode, heat sink
        x = 0.0
        while x < w:
            t = rng.uniform(2, 12)
            cv2.rectangle(img, (int(x), 0), (int(x + t), h), fg.tolist(), -1)
            x += t + rng.uniform(2, 12)
    elif k == 6:  # an empty holder or frame
        cv2.rectangle(img, (0, 0), (w - 1, h - 1), fg.tolist(), int(rng.uniform(3, 22)))
    elif k == 7:  # keypad, windows, tiles
        nx, ny = int(rng.integers(2, 9)), int(rng.integers(2, 6))
        for i in range(nx):
            for j in range(ny):
                cv2.rectangle(img, (int((i + 0.15) * w / nx), int((j + 0.15) * h / ny)), (int((i + 0.85) * w / nx), int((j + 0.85) * h / ny)), (fg * rng.uniform(0.7, 1)).tolist(), -1)
                if nx * ny < 24 and rng.random() < 0.3:
                    blend(img, fonts.ink(font, code(rng, 1), max(2, int(0.2 * w / nx)), max(2, int(0.4 * h / ny))), int((i + 0.4) * w / nx), int((j + 0.3) * h / ny), bg)
    elif k == 8:  # arrow and border: road sign
        cv2.rectangle(img, (4, 4), (w - 5, h - 5), fg.tolist(), 3, cv2.LINE_AA)
        cv2.arrowedLine(img, (int(w * 0.8), int(h * 0.8)), (int(w * rng.uniform(0.7, 0.9)), int(h * 0.2)), fg.tolist(), max(2, h // 16), cv2.LINE_AA)
        for y in (0.15, 0.55):
            text = "".join(rng.choice(list("abcdefghiklmnoprstuvwy"), int(rng.integers(4, 11)))).title()
            blend(img, fonts.ink(font, text, int(w * rng.uniform(0.3, 0.6)), max(3, int(h * 0.28))), int(0.08 * w), int(y * h), fg)
    elif k == 9:  # glossy lamp or blank panel
        t = np.linspace(-1, 1, w, dtype=np.float32)[None, :, None]
        img *= 1 - 0.6 * np.abs(t) ** rng.uniform(0.5, 3)
    elif k == 10:  # clock, dial
        cv2.circle(img, (w // 2, h // 2), int(min(w, h) * 0.42), fg.tolist(), max(2, h // 24), cv2.LINE_AA)
        for a in rng.uniform(0, 6.28, 3):
            cv2.line(img, (w // 2, h // 2), (int(w / 2 + h * 0.3 * np.cos(a)), int(h / 2 + h * 0.3 * np.sin(a))), fg.tolist(), 3, cv2.LINE_AA)
    else:  # chequered and hazard stripes
        s = int(rng.uniform(8, 50))
        for x in range(-h, w, 2 * s):
            cv2.fillPoly(img, [np.array([(x, h), (x + s, h), (x + s + h, 0), (x + h, 0)], np.int32)], fg.tolist(), cv2.LINE_AA)
    return np.clip(img, 0, 255).astype(np.uint8)
