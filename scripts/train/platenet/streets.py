"""Backgrounds that tempt a plate network and hold no plate: facades, shop fronts, lit signs, rows of lamps, captions burnt into a picture."""
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ImageFont

from faces import WORDS, Fonts, blend, code, colour

Rng = np.random.Generator
ImageF = NDArray[np.float32]
SIGNS = ("ATM BANK TAXI CAFE BAR HOTEL PIZZA OPEN SALE EXIT METRO POLICE PHARMACY PARKING BAKERY SHOP MARKET CINEMA THEATRE SCHOOL LIBRARY MUSEUM GARAGE TYRES "
         "FUEL DIESEL KEBAB SUSHI BOOKS OPTIK APOTHEKE FRISEUR MODE BUS TRAM GATE LIFT STOP PUSH PULL FIRE SALON NAILS RADIO PHOTO KIOSK POST INN PUB WC 24H").split()
PLACES = "Street Road Avenue House Centre Square Market Garden Station Lane Court Hall Park Works Studio Office Company Brothers Sons and the of for".split()


def words(rng: Rng, most: int = 3) -> str:
    """What a sign says: short words, names, numbers."""
    k = rng.random()
    if k < 0.45:
        text = str(rng.choice(SIGNS))
    elif k < 0.75:
        pool = SIGNS + list(WORDS) + PLACES
        text = " ".join(rng.choice(pool, int(rng.integers(1, most + 1))))
    elif k < 0.9:
        n = int(rng.integers(3, 10))
        text = "".join(rng.choice(list("abcdefghiklmnoprstuvwyaeioaeio"), n))
    else:
        text = str(rng.choice((code(rng, int(rng.integers(2, 5))), f"{rng.integers(0, 24)}:{rng.integers(0, 60):02d}", str(rng.integers(1, 3000)))))
    style = rng.random()
    return text.upper() if style < 0.55 else text.title() if style < 0.85 else text.lower()


def natural_ratio(fonts: Fonts, path: str, text: str) -> float:
    """Width / height of a text as its font sets it."""
    key = (path, 64)
    if key not in fonts.open:
        fonts.open[key] = ImageFont.truetype(path, 64)
    x0, y0, x1, y1 = fonts.open[key].getbbox(text)
    return max(0.2, (x1 - x0) / max(1, y1 - y0))


def lay_text(rng: Rng, img: ImageF, fonts: Fonts, text: str, cx: float, cy: float, tall: float, col: NDArray[np.float32], most_wide: float) -> float:
    """Lettering of natural proportions about a point, never wider than most_wide; returns its width."""
    path = fonts.paths[int(rng.integers(len(fonts.paths)))]
    wide = tall * natural_ratio(fonts, path, text) * rng.uniform(0.85, 1.25)
    if wide > most_wide:
        tall, wide = tall * most_wide / wide, most_wide
    cover = fonts.ink(path, text, max(2, round(wide)), max(2, round(tall)), max(0.0, rng.normal(0.0, 0.03)))
    if rng.random() < 0.2:  # shadow or depth of the letters
        off = max(1.0, 0.07 * tall)
        blend(img, cover * np.float32(0.8), round(cx - wide / 2 + off), round(cy - tall / 2 + off), colour(rng, 5, 120))
    blend(img, cover, round(cx - wide / 2), round(cy - tall / 2), col)
    return wide


def _rect(img: ImageF, x0: float, y0: float, x1: float, y1: float, col: NDArray[np.float32], thick: int = -1) -> None:
    cv2.rectangle(img, (round(x0), round(y0)), (round(x1), round(y1)), np.clip(col, 0, 255).tolist(), thick, cv2.LINE_AA if thick > 0 else cv2.LINE_8)


class _Window:
    """One kind of window, repeated over a facade."""

    def __init__(self, rng: Rng, wall: NDArray[np.float32], night: bool) -> None:
        self.rng, self.night = rng, night
        self.wall = wall
        self.lit = rng.uniform(0.1, 1.0) if night else 0.0
        self.glass = np.clip(wall * rng.uniform(0.1, 0.6), 0, 255) if rng.random() < 0.75 else np.clip(wall * rng.uniform(1.2, 1.7) + 35, 0, 255)
        self.frame = np.clip(wall * rng.uniform(0.6, 1.5) + rng.uniform(-30, 70), 0, 255).astype(np.float32)
        self.across, self.down = int(rng.integers(1, 4)), int(rng.integers(1, 4))
        self.bar = rng.uniform(0.02, 0.12)
        self.sill, self.arch, self.rim = rng.random() < 0.35, rng.random() < 0.15, rng.random() < 0.65
        self.unlike = rng.uniform(0.0, 0.5)
        self.blinds = rng.uniform(0, 0.4)

    def draw(self, img: ImageF, x: float, y: float, w: float, h: float) -> None:
        """Frame, panes, sill, blind."""
        rng = self.rng
        glass = np.array((rng.uniform(60, 200), rng.uniform(150, 235), rng.uniform(190, 255)), np.float32) * rng.uniform(0.5, 1.1) if rng.random() < self.lit else self.glass
        if self.arch and w >= 4:
            cv2.ellipse(img, (round(x + w / 2), round(y)), (max(1, round(w / 2)), max(1, round(w / 2))), 0, 180, 360, self.glass.tolist(), -1, cv2.LINE_AA)
        if self.rim:
            b = max(0.6, self.bar * min(w, h))
            _rect(img, x, y, x + w, y + h, self.frame)
        else:
            b = 0.0
        for i in range(self.across):
            for j in range(self.down):
                px, py = x + b + i * (w - b) / self.across, y + b + j * (h - b) / self.down
                _rect(img, px, py, px + (w - b) / self.across - max(b, 0.5), py + (h - b) / self.down - max(b, 0.5), glass * (1 + self.unlike * rng.uniform(-1, 1.2)))
        if rng.random() < self.blinds:
            _rect(img, x + b, y + b, x + w - b, y + h * rng.uniform(0.2, 0.8), np.clip(glass * 1.6 + 60, 0, 255))
        if self.sill:
            _rect(img, x - 0.1 * w, y + h, x + 1.1 * w, y + h + max(1.0, 0.08 * h), self.frame * 1.1)


def facade(rng: Rng, h: int, w: int) -> ImageF:
    """Walls with rows of windows, in groups or not, bands between the storeys, balconies, pillars."""
    night = rng.random() < 0.2
    wall = np.full(3, rng.uniform(25, 235), np.float32) * rng.uniform(0.92, 1.08, 3).astype(np.float32) if rng.random() < 0.65 else colour(rng, 40, 220)
    if night:
        wall = wall * np.float32(rng.uniform(0.08, 0.35))
    img = np.empty((h, w, 3), np.float32)
    img[:] = wall
    storey = float(np.exp(rng.uniform(np.log(9), np.log(130))))
    window = _Window(rng, wall, night)
    high = storey * rng.uniform(0.35, 0.85)
    wide = high * np.exp(rng.uniform(np.log(0.2), np.log(1.6)))
    pitch = wide * rng.uniform(1.08, 2.2)
    group = int(rng.integers(2, 10)) if rng.random() < 0.5 else 10_000
    gap = pitch * rng.uniform(0.5, 3.0)
    if rng.random() < 0.4:  # courses of bricks or slabs
        step = max(2, round(storey * rng.uniform(0.04, 0.25)))
        for y in range(0, h, step):
            cv2.line(img, (0, y), (w, y), (wall * rng.uniform(0.75, 0.95)).tolist(), 1)
    bands, band = rng.random() < 0.35, np.clip(wall * rng.uniform(0.5, 1.6) + rng.uniform(-20, 40), 0, 255)
    ribbon = rng.random() < 0.25  # a board of another tone round every group
    tone = np.clip(wall * rng.uniform(0.4, 1.7) + rng.uniform(-30, 60), 0, 255)
    pillars = rng.random() < 0.25
    x_first, y = -rng.uniform(0, pitch), -rng.uniform(0, storey)
    rows = 0
    while y < h:
        rows += 1
        top = y + (storey - high) / 2
        if bands:
            _rect(img, 0, y - 0.05 * storey, w, y + 0.06 * storey, band)
        x, i = x_first, 0
        start = x
        skip = rng.random() < 0.08
        while x < w and not skip:
            if i % group == 0:
                start = x
                if ribbon and group < 100:
                    m = 0.25 * (storey - high)
                    _rect(img, x - m, top - m, x + (group - 1) * pitch + wide + m, top + high + m, tone)
                if pillars and i:
                    _rect(img, x - gap * 0.7, 0, x - gap * 0.3, h, band)
            if rng.random() < 0.97:
                window.draw(img, x, top, wide, high)
            i += 1
            x = start + (i % group) * pitch if i % group else x + pitch + gap
        if rng.random() < 0.15:  # a balcony's rail
            for bx in np.arange(0, w, max(2.0, wide * 0.15)):
                cv2.line(img, (round(bx), round(top + 0.6 * high)), (round(bx), round(top + high)), band.tolist(), 1)
        y += storey
    return img


def _turned(rng: Rng, img: ImageF, h: int, w: int) -> ImageF:
    """The wall seen obliquely or from below, cut to h x w."""
    H, W = img.shape[:2]
    yaw, tilt, roll = rng.normal(0, 0.28), rng.normal(0, 0.2), rng.normal(0, 0.04)
    a = 0.25 * np.tanh(yaw)
    b = 0.25 * np.tanh(tilt)
    src = np.array([(0, 0), (W, 0), (W, H), (0, H)], np.float32)
    inner = np.array([(-w * 0.1, -h * 0.1), (w * 1.1, -h * 0.1), (w * 1.1, h * 1.1), (-w * 0.1, h * 1.1)])
    spread = np.array([(-max(b, 0), -max(a, 0)), (max(b, 0), -max(-a, 0)), (max(-b, 0), max(-a, 0)), (-max(-b, 0), max(a, 0))]) * (2 * w, 2 * h)
    centre = np.array((w / 2, h / 2))
    turn = np.array([(np.cos(roll), -np.sin(roll)), (np.sin(roll), np.cos(roll))])
    dst = ((inner + spread - centre) @ turn.T + centre).astype(np.float32)
    return cv2.warpPerspective(img, cv2.getPerspectiveTransform(src, dst), (w, h), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def sign(rng: Rng, img: ImageF, fonts: Fonts, night: bool = False) -> None:
    """One sign or lettering: a fascia that goes on beyond its words, a lit box, bare letters on the wall, a caption."""
    h, w = img.shape[:2]
    tall = float(np.exp(rng.uniform(np.log(5), np.log(70))))
    cx, cy = rng.uniform(0, w), rng.uniform(0, h)
    text = words(rng)
    ink, ground = colour(rng, 5, 250), colour(rng, 5, 250)
    if abs(float(ink.mean() - ground.mean())) < 70:
        ink = np.full(3, 240.0 if ground.mean() < 128 else 12.0, np.float32)
    k = rng.random()
    if k < 0.35:  # a fascia
        left, right = cx - rng.uniform(1.5, 9) * tall, cx + rng.uniform(1.5, 9) * tall
        up, down = cy - tall * rng.uniform(0.6, 1.4), cy + tall * rng.uniform(0.6, 1.4)
        _rect(img, left, up, right, down, ground)
        if rng.random() < 0.3:
            _rect(img, left, up, right, down, ink, max(1, round(0.06 * tall)))
        x = left + rng.uniform(0.2, 2.0) * tall
        while x < right - tall:
            wide = lay_text(rng, img, fonts, text, x + 0.0, cy, tall, ink, right - left) if rng.random() < 0.2 else 0.0
            if not wide:
                path = fonts.paths[int(rng.integers(len(fonts.paths)))]
                wide = min(tall * natural_ratio(fonts, path, text), right - x)
                blend(img, fonts.ink(path, text, max(2, round(wide)), max(2, round(tall))), round(x), round(cy - tall / 2), ink)
            x += wide + rng.uniform(0.5, 6) * tall
            if rng.random() < 0.5:
                break
            text = words(rng)
    elif k < 0.6:  # a lit or painted box of its own, taller or longer than any plate, or with a rim, a picture, a second line
        ratio = rng.uniform(0.5, 1.3) if rng.random() < 0.5 else rng.uniform(1.3, 9)
        high = tall * rng.uniform(1.2, 2.6)
        wide = high * ratio
        if rng.random() < (0.7 if night else 0.3):
            ground = np.clip(rng.uniform(0, 1, 3) * 120 + 135, 0, 255).astype(np.float32)
            ink = colour(rng, 5, 110)
            halo = np.zeros(img.shape[:2], np.float32)
            _rect(halo[..., None], cx - wide / 2, cy - high / 2, cx + wide / 2, cy + high / 2, np.ones(1, np.float32))
            img += cv2.GaussianBlur(halo, (0, 0), 0.4 * high + 1)[..., None] * ground * np.float32(rng.uniform(0.1, 0.5))
        elif rng.random() < 0.5:
            ground, ink = np.array(((0, 0, 200), (160, 60, 10), (30, 130, 20), (0, 200, 250), (20, 20, 20))[int(rng.integers(5))], np.float32) + 15, np.full(3, 240, np.float32)
        _rect(img, cx - wide / 2, cy - high / 2, cx + wide / 2, cy + high / 2, ground)
        lines = int(rng.integers(1, 4)) if ratio < 2 else 1 + int(rng.random() < 0.3)
        for i in range(lines):
            size = high / lines * rng.uniform(0.35, 0.75)
            lay_text(rng, img, fonts, words(rng, 2), cx + rng.uniform(-0.15, 0.15) * wide, cy + high * ((i + 0.5) / lines - 0.5), size, ink, 0.95 * wide)
        if rng.random() < 0.3:
            r = high * rng.uniform(0.15, 0.4)
            cv2.circle(img, (round(cx - wide / 2 + 1.2 * r), round(cy)), max(1, round(r)), colour(rng, 20, 250).tolist(), -1 if rng.random() < 0.6 else 2, cv2.LINE_AA)
    elif k < 0.85:  # bare letters on the wall, a van, a window
        area = img[max(0, int(cy - tall)):int(cy + tall) + 1, max(0, int(cx - 2 * tall)):int(cx + 2 * tall) + 1]
        if area.size and abs(float(area.mean() - ink.mean())) < 60:
            ink = np.full(3, 240.0 if area.mean() < 128 else 12.0, np.float32)
        lay_text(rng, img, fonts, text, cx, cy, tall, ink, 1.5 * w)
        if rng.random() < 0.4:
            lay_text(rng, img, fonts, words(rng, 4), cx + rng.uniform(-2, 2) * tall, cy + tall * rng.uniform(0.8, 1.3), tall * rng.uniform(0.25, 0.7), ink, 1.5 * w)
    else:  # a caption or a time stamp burnt in
        size = rng.uniform(6, 24)
        y = rng.choice((0.05, 0.95)) * h
        stamp = "".join(rng.choice(list("0123456789"), 14))
        text = f"{stamp[:4]}-{stamp[4:6]}-{stamp[6:8]} {stamp[8:10]}:{stamp[10:12]}:{stamp[12:]}" if rng.random() < 0.5 else " ".join((words(rng), code(rng, 3), words(rng, 2)))
        if rng.random() < 0.5:
            _rect(img, 0, y - size, w * rng.uniform(0.3, 1.0), y + size, ground)
        else:
            ink = np.full(3, rng.choice((0, 250)), np.float32)
        lay_text(rng, img, fonts, text, rng.uniform(0.2, 0.8) * w, y, size, ink, w)


def lamps(rng: Rng, img: ImageF) -> None:
    """A row of lamps, lit windows or their mirror images in the dark, or head lamps in pairs."""
    h, w = img.shape[:2]
    x, y = rng.uniform(-0.2, 0.8) * w, rng.uniform(0.05, 0.95) * h
    size = float(np.exp(rng.uniform(np.log(1.5), np.log(14))))
    pitch, slope = size * rng.uniform(1.3, 5), rng.normal(0, 0.1)
    col = np.array((rng.uniform(80, 255), rng.uniform(160, 255), rng.uniform(200, 255)), np.float32)
    glow = np.zeros_like(img)
    for i in range(int(rng.integers(2, 14))):
        a, b = x + i * pitch, y + slope * i * pitch
        c = col * rng.uniform(0.5, 1.1)
        if rng.random() < 0.5:
            cv2.circle(glow, (round(a), round(b)), max(1, round(size / 2)), c.tolist(), -1, cv2.LINE_AA)
        else:
            _rect(glow, a - size / 2, b - size * rng.uniform(0.3, 1.2), a + size / 2, b + size * rng.uniform(0.3, 1.2), c)
    img += glow + cv2.GaussianBlur(glow, (0, 0), size) * np.float32(rng.uniform(0.0, 0.7))


def tempting_scene(rng: Rng, fonts: Fonts, side_px: int, photo: ImageF | None) -> ImageF:
    """side x side px without any plate; photo: a background that may show through."""
    big = int(side_px * 1.4)
    k = rng.random()
    night = rng.random() < 0.2
    if k < 0.62:
        img = _turned(rng, facade(rng, big, big), side_px, side_px)
        if photo is not None and rng.random() < 0.35:  # the street before it, or sky above
            cut = round(side_px * rng.uniform(0.2, 0.8))
            part = slice(cut, side_px) if rng.random() < 0.7 else slice(0, side_px - cut)
            img[part] = photo[part]
    elif photo is not None:
        img = photo * np.float32(rng.uniform(0.15, 0.5) if night else 1.0)
    else:
        img = np.empty((side_px, side_px, 3), np.float32)
        img[:] = colour(rng, 10, 200) * (0.3 if night else 1.0)
    signs = int(rng.integers(0, 2)) if k < 0.45 else int(rng.integers(1, 5))
    for _ in range(signs):
        sign(rng, img, fonts, night)
    if night or rng.random() < 0.08:
        lamps(rng, img)
    if rng.random() < 0.5:  # drawn edges are sharper than any lens, drawn colours louder than any street
        img = cv2.GaussianBlur(img, (0, 0), float(rng.uniform(0.4, 1.1)))
    if rng.random() < 0.5:
        grey = img.mean(2, keepdims=True)
        img = grey + (img - grey) * np.float32(rng.uniform(0, 0.5))
    return np.clip(img, 0, 255).astype(np.float32)

