"""Composes training patches with exact corner truth: background, cars, plates in perspective, look-alikes, weather and camera."""
from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from backgrounds import Image8, ImageF, draw_rear, false_card, texture
from faces import Fonts, blend, code, colour
from streets import tempting_scene

Rng = np.random.Generator
Quad = NDArray[np.float64]
PLATE, IGNORE = 0, 1


@dataclass
class Label:
    """corners_px (4,2), TL TR BR BL, pixel centres at integers; weight of the corners' loss; PLATE or IGNORE."""

    corners_px: Quad
    corner_weight: float = 1.0
    kind: int = PLATE


@dataclass
class Frame:
    """An in-car frame, the labelled boxes in it, plates that we found in it beside the labels, and places that may be plates."""

    image: Image8
    boxes: list[tuple[float, float, float, float]] = field(default_factory=list)
    found: list[tuple[float, float, float, float]] = field(default_factory=list)
    unsure: list[tuple[float, float, float, float]] = field(default_factory=list)


@dataclass
class Banks:
    """Everything that patches are made of."""

    faces: list[Image8]
    cards: list[Image8]
    photos: list[Image8]
    frames: list[Frame]
    cliparts: list[tuple[Image8, Image8]]
    fonts: Fonts
    tempting: float = 0.0  # share of patches on facades, shop fronts and places of `mined`
    mined: list[Image8] = field(default_factory=list)  # pictures (mine.py) round places that an earlier PlateNet took for plates


def extra_of(extra: dict[str, list[tuple[float, float, float, float]]]) -> dict[str, list[tuple[float, float, float, float]]]:
    """The entry of dashcam_ro_extra.json as Frame's fields."""
    return {"found": extra.get("plates", []), "unsure": extra.get("unsure", [])}


def load_frames(folder: Path, names: set[str], extra: dict[str, dict[str, list[tuple[float, float, float, float]]]]) -> list[Frame]:
    """The named images of a folder with labels.csv (columns image, x, y, w, h)."""
    boxes: dict[str, list[tuple[float, float, float, float]]] = {}
    with open(folder / "labels.csv", newline="") as f:
        for r in csv.DictReader(f):
            x, y = float(r["x"]), float(r["y"])
            boxes.setdefault(r["image"], []).append((x, y, x + float(r["w"]), y + float(r["h"])))
    out = []
    for name in sorted(names):
        img = cv2.imread(str(folder / name), cv2.IMREAD_COLOR)
        if img is None:
            raise FileNotFoundError(folder / name)
        out.append(Frame(np.asarray(img, np.uint8), boxes.get(name, []), **extra_of(extra.get(name, {}))))
    return out


def perspective_quad(rng: Rng, cx: float, cy: float, w: float, h: float, yaw: float, pitch: float, roll: float) -> Quad:
    """Corners of a w x h rectangle turned by yaw, pitch, roll (rad) and seen by a pinhole; its projected width stays about w cos(yaw)."""
    depth = w * rng.uniform(3.0, 15.0)
    pts = np.array([(-w / 2, -h / 2, 0), (w / 2, -h / 2, 0), (w / 2, h / 2, 0), (-w / 2, h / 2, 0)])
    cyaw, syaw, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    m = np.array([(cr, -sr, 0), (sr, cr, 0), (0, 0, 1)]) @ np.array([(1, 0, 0), (0, cp, -sp), (0, sp, cp)]) @ np.array([(cyaw, 0, syaw), (0, 1, 0), (-syaw, 0, cyaw)])
    p = pts @ m.T
    quad: Quad = p[:, :2] * (depth / (depth + p[:, 2:3])) + (cx, cy)
    return quad


def quad_in(quad: Quad, w: int, h: int) -> float:
    """How much of the quad's bounding box lies in the picture, 0..1."""
    x0, y0, x1, y1 = *quad.min(0), *quad.max(0)
    inside = max(0.0, min(x1, w - 0.5) - max(x0, -0.5)) * max(0.0, min(y1, h - 0.5) - max(y0, -0.5))
    return float(inside / max((x1 - x0) * (y1 - y0), 1e-9))


def paste(img: ImageF, card: ImageF, alpha: ImageF, from_px: Quad, quad: Quad) -> None:
    """Warps the card so that the points from_px of it come to quad, and blends it with its alpha."""
    h, w = img.shape[:2]
    outer = np.array([(-0.5, -0.5), (card.shape[1] - 0.5, -0.5), (card.shape[1] - 0.5, card.shape[0] - 0.5), (-0.5, card.shape[0] - 0.5)])
    m = cv2.getPerspectiveTransform(from_px.astype(np.float32), quad.astype(np.float32))
    hom = np.c_[outer, np.ones(4)] @ m.T
    if (hom[:, 2] <= 1e-6).any():
        return
    pts = hom[:, :2] / hom[:, 2:]
    x0, y0 = max(int(np.floor(pts[:, 0].min())) - 1, 0), max(int(np.floor(pts[:, 1].min())) - 1, 0)
    x1, y1 = min(int(np.ceil(pts[:, 0].max())) + 2, w), min(int(np.ceil(pts[:, 1].max())) + 2, h)
    if x1 - x0 < 2 or y1 - y0 < 2:
        return
    shift = np.array([(1, 0, -x0), (0, 1, -y0), (0, 0, 1)], np.float64)
    both = np.dstack([card, alpha])
    warped = cv2.warpPerspective(both, shift @ m, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    cover = np.zeros((y1 - y0, x1 - x0), np.uint8)  # exact outline, antialiased by drawing at 1/16 px
    cv2.fillConvexPoly(cover, np.round((pts - (x0, y0)) * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
    a = warped[..., 3:] * (cover[..., None].astype(np.float32) / 255)
    part = img[y0:y1, x0:x1]
    part += a * (warped[..., :3] - part)


def dress(rng: Rng, face: Image8, width_px: float, fonts: Fonts) -> tuple[ImageF, ImageF, Quad]:
    """Ages a face, lights it and puts it into a holder; returns picture, alpha and the face's corners in it."""
    fw = int(np.clip(width_px * rng.uniform(1.0, 1.4), 14, 400))
    fh = max(5, round(fw * face.shape[0] / face.shape[1]))
    img = cv2.resize(face, (fw, fh), interpolation=cv2.INTER_AREA).astype(np.float32)
    if rng.random() < 0.3:  # faded
        mean = img.mean((0, 1))
        img = mean + (img - mean) * rng.uniform(0.45, 1)
    if rng.random() < 0.45:  # dirt
        n = int(rng.integers(2, 14))
        d = np.clip(cv2.resize(rng.normal(0, 1, (n, 2 * n)).astype(np.float32), (fw, fh), interpolation=cv2.INTER_CUBIC) + rng.uniform(-1.2, 0.4), 0, 1.2) * rng.uniform(0.1, 0.7)
        d = np.minimum(d, 0.9)[..., None]
        img = img * (1 - d) + colour(rng, 30, 130) * d
    if rng.random() < 0.35:  # shadow with a soft edge
        a, off = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4)
        gx, gy = np.linspace(-0.5, 0.5, fw, dtype=np.float32)[None, :], np.linspace(-0.5, 0.5, fh, dtype=np.float32)[:, None] * (fh / fw)
        t = np.clip((gx * np.cos(a) + gy * np.sin(a) - off * 0.5) * rng.uniform(4, 80), 0, 1)
        img *= (1 - t * rng.uniform(0.2, 0.75))[..., None]
    if rng.random() < 0.4:  # uneven light
        img *= np.linspace(rng.uniform(0.6, 1.2), rng.uniform(0.6, 1.2), fh, dtype=np.float32)[:, None, None]
    if rng.random() < 0.08:  # a bent or scratched place, a sticker
        x, y = int(rng.uniform(0, fw * 0.8)), int(rng.uniform(0, fh * 0.6))
        cv2.rectangle(img, (x, y), (x + max(1, fw // 9), y + max(1, fh // 4)), colour(rng, 20, 240).tolist(), -1)
    left = right = top = bottom = 0
    over = np.zeros(4)
    holder = rng.random() < 0.55
    if holder:
        t = rng.uniform(0.006, 0.05) * fw
        left = right = max(1, round(t * rng.uniform(0.5, 1.2)))
        top, bottom = max(1, round(t)), max(1, round(t * rng.choice((1.0, 1.0, 2.0, 3.0))))
        if rng.random() < 0.3:
            top, bottom = bottom, top
        over = np.array((left, top, right, bottom)) * rng.uniform(0, 0.6, 4) * (rng.random() < 0.5)
    out = np.empty((fh + top + bottom, fw + left + right, 3), np.float32)
    alpha = np.ones(out.shape[:2], np.float32)
    if holder:
        k = rng.random()
        col = np.full(3, rng.uniform(5, 45), np.float32) if k < 0.55 else np.full(3, rng.uniform(130, 245), np.float32) if k < 0.85 else colour(rng, 20, 200)
        out[:] = col
        if k > 0.55 and k < 0.85:
            out *= np.linspace(rng.uniform(0.5, 1.2), rng.uniform(0.5, 1.2), out.shape[0], dtype=np.float32)[:, None, None]
        for y, t in ((0, top), (top + fh, bottom)):
            if t >= 4 and rng.random() < 0.6:
                text = code(rng, int(rng.integers(5, 14)))
                tw = int(rng.uniform(0.3, 0.8) * fw)
                blend(out, fonts.ink(fonts.pick(rng), text, tw, max(2, int(t * 0.6))), (out.shape[1] - tw) // 2, y + int(t * 0.2), np.full(3, 235 if col.mean() < 120 else 20, np.float32))
    lo, to, ro, bo = (int(v) for v in over)
    out[top + to:top + fh - bo, left + lo:left + fw - ro] = img[to:fh - bo, lo:fw - ro]
    if not holder:
        if rng.random() < 0.7:  # rounded corners
            r = max(1, int(fh * rng.uniform(0.03, 0.12)))
            alpha[:] = 0
            cv2.rectangle(alpha, (r, 0), (fw - 1 - r, fh - 1), 1.0, -1)
            cv2.rectangle(alpha, (0, r), (fw - 1, fh - 1 - r), 1.0, -1)
            for cx, cy in ((r, r), (fw - 1 - r, r), (r, fh - 1 - r), (fw - 1 - r, fh - 1 - r)):
                cv2.circle(alpha, (cx, cy), r, 1.0, -1, cv2.LINE_AA)
    corners = np.array([(left, top), (left + fw, top), (left + fw, top + fh), (left, top + fh)], np.float64) - 0.5
    return out, alpha, corners


def light(rng: Rng, card: ImageF, around: float) -> ImageF:
    """Matches a card to the light at its place (around: mean level there), or lets it glare like a lit reflective plate."""
    k = rng.random()
    if k < 0.55:
        gain = np.clip(around / 110, 0.12, 1.15) * rng.uniform(0.6, 1.5)
    elif k < 0.7:
        gain = rng.uniform(0.15, 0.6)
    elif k < 0.8:
        gain = rng.uniform(1.2, 2.2)
    else:
        gain = rng.uniform(0.6, 1.1)
    out: ImageF = card * np.float32(gain)
    if rng.random() < 0.5:
        out *= np.clip(rng.normal(1, 0.12, 3), 0.6, 1.4).astype(np.float32)
    if rng.random() < 0.3:
        out += np.float32(rng.uniform(0, 40))
    return np.minimum(out, 255)


class Composer:
    """Makes patches from the banks; all randomness from the generator given."""

    def __init__(self, banks: Banks) -> None:
        self.b = banks

    def patch(self, rng: Rng, side_px: int, real: bool | None = None) -> tuple[Image8, list[Label], bool]:
        """A side x side patch, its labels, and whether it shows real streets with possibly unlabelled plates."""
        labels: list[Label] = []
        tempting = self.b.tempting > 0 and rng.random() < self.b.tempting
        k = 0.99 if tempting else rng.random() if real is None else (0.0 if real else 0.99)
        busy: list[tuple[float, float, float, float]] = []
        street = k < 0.42 and bool(self.b.frames)
        if street:
            img = self._street(rng, side_px, labels)
            busy = [(*lab.corners_px.min(0), *lab.corners_px.max(0)) for lab in labels]
        elif k < 0.75 and self.b.photos:
            img = self._photo(rng, side_px)
        elif tempting and self.b.mined and rng.random() < 0.4:
            img = self._mined(rng, side_px)
        elif tempting:
            img = tempting_scene(rng, self.b.fonts, side_px, self._photo(rng, side_px) if self.b.photos and rng.random() < 0.7 else None)
        else:
            img = texture(rng, side_px, side_px)
        for _ in range(int(rng.integers(0, 3 if street or tempting else 5))):
            self._lookalike(rng, img, busy)
        n = int(rng.choice((0, 1, 2, 3), p=(0.72, 0.2, 0.06, 0.02) if street else (0.55, 0.35, 0.08, 0.02) if tempting else (0.14, 0.54, 0.22, 0.1)))
        for i in range(n):
            self._plate(rng, img, labels, busy, car=rng.random() < (0.3 if street else 0.92 if tempting else 0.72) and i < 2)
        out = self._camera(rng, img)
        keep = []
        for lab in labels:
            inside = quad_in(lab.corners_px, side_px, side_px)
            w = np.ptp(lab.corners_px[:, 0])
            c = lab.corners_px.mean(0)
            if inside <= 0.02:
                continue
            x0, y0 = np.clip(lab.corners_px.min(0), 0, side_px - 2).astype(int)
            x1, y1 = np.clip(np.ceil(lab.corners_px.max(0)), 1, side_px - 1).astype(int)
            seen = out[y0:y1 + 1, x0:x1 + 1].astype(np.float32).mean(2)
            invisible = seen.size > 0 and float(seen.std()) < 5.0  # black night, white glare: nobody could tell
            if invisible or inside < 0.6 or w < 6.5 or not (0 <= c[0] <= side_px - 1 and 0 <= c[1] <= side_px - 1):
                lab.kind = IGNORE
            keep.append(lab)
        return out, keep, street

    def _street(self, rng: Rng, side: int, labels: list[Label]) -> ImageF:
        f = self.b.frames[int(rng.integers(len(self.b.frames)))]
        h, w = f.image.shape[:2]
        places = f.boxes + f.found
        box = places[int(rng.integers(len(places)))] if places and rng.random() < 0.72 else None
        big = side > 300
        if box is not None:
            want = np.exp(rng.uniform(np.log(60 if big else 9), np.log(330 if big else 130)))
            scale = float(np.clip(want / (box[2] - box[0]), 0.12, 2.0))
            cx, cy = (box[0] + box[2]) / 2 + rng.uniform(-0.42, 0.42) * side / scale, (box[1] + box[3]) / 2 + rng.uniform(-0.42, 0.42) * side / scale
        else:
            scale = float(np.exp(rng.uniform(np.log(0.3), np.log(1.2))))
            cx, cy = rng.uniform(0, w), rng.uniform(0.2, 1) * h
        x0, y0 = cx - side / scale / 2, cy - side / scale / 2
        if rng.random() < 0.85:  # stay inside the frame where it is big enough
            x0 = float(np.clip(x0, 0, w - side / scale)) if w > side / scale else x0
            y0 = float(np.clip(y0, 0, h - side / scale)) if h > side / scale else y0
        xa, ya, xb, yb = max(int(x0), 0), max(int(y0), 0), min(int(x0 + side / scale) + 1, w), min(int(y0 + side / scale) + 1, h)
        src = f.image[ya:yb, xa:xb]
        if scale < 0.7:
            k = max(scale, 0.12)
            src = cv2.resize(src, (max(2, round(src.shape[1] * k)), max(2, round(src.shape[0] * k))), interpolation=cv2.INTER_AREA)
        kx, ky = src.shape[1] / (xb - xa), src.shape[0] / (yb - ya)
        # patch pixel = (source pixel + 0.5 - x0) * scale - 0.5
        m = np.array([(scale / kx, 0, (xa - x0) * scale + 0.5 * scale / kx - 0.5), (0, scale / ky, (ya - y0) * scale + 0.5 * scale / ky - 0.5)])
        border = cv2.BORDER_CONSTANT if rng.random() < 0.6 else cv2.BORDER_REPLICATE
        img = cv2.warpAffine(src, m, (side, side), flags=cv2.INTER_LINEAR, borderMode=border).astype(np.float32)

        def to_patch(b: tuple[float, float, float, float]) -> Quad:
            q = np.array([(b[0], b[1]), (b[2], b[1]), (b[2], b[3]), (b[0], b[3])], np.float64)
            return (q - (x0, y0)) * scale - 0.5

        balance = rng.random()
        if balance < 0.6:  # against the red dusk of these rides: part of the way to grey
            mean = img.mean((0, 1)) + 2
            img *= ((mean.mean() / mean) ** rng.uniform(0.3, 1.1)).astype(np.float32)
        if rng.random() < 0.65 and img.mean() < 90:
            img = 255 * (np.clip(img, 0, 255) / 255) ** np.float32(rng.uniform(0.35, 0.9))
        for b in f.boxes:
            q = to_patch(b)
            if rng.random() < 0.4 and quad_in(q, side, side) > 0.3:  # another plate over the real one
                c, (pw, ph) = q.mean(0), q[2] - q[0]
                face = self._face(rng)
                fit = face.shape[0] / face.shape[1]
                pw2 = pw * rng.uniform(1.02, 1.2)
                ph2 = max(ph * rng.uniform(1.02, 1.25), pw2 * min(fit, 0.62) * rng.uniform(0.8, 1.1))
                yaw, pitch, roll = rng.normal(0, 0.25), rng.normal(0, 0.12), rng.normal(0, 0.05)
                quad = perspective_quad(rng, c[0], c[1], pw2 / np.cos(yaw), ph2, yaw, pitch, roll)
                if quad[:, 0].min() <= q[0, 0] + 0.1 * pw and quad[:, 0].max() >= q[1, 0] - 0.1 * pw:
                    self._paste_plate(rng, img, face, quad)
                    labels.append(Label(quad))
                    continue
            labels.append(Label(q, 0.5))
        for b in f.found:
            labels.append(Label(to_patch(b), 0.1))
        for b in f.unsure:
            labels.append(Label(to_patch(b), 0.0, IGNORE))
        return np.clip(img, 0, 255)

    def _photo(self, rng: Rng, side: int) -> ImageF:
        p = self.b.photos[int(rng.integers(len(self.b.photos)))]
        h, w = p.shape[:2]
        s = int(np.clip(side * np.exp(rng.uniform(np.log(0.6), np.log(4.0))), 40, min(h, w)))
        x, y = int(rng.integers(0, w - s + 1)), int(rng.integers(0, h - s + 1))
        crop = p[y:y + s, x:x + s]
        if rng.random() < 0.5:
            crop = crop[:, ::-1]
        return cv2.resize(crop, (side, side), interpolation=cv2.INTER_AREA if s > side else cv2.INTER_LINEAR).astype(np.float32)

    def _mined(self, rng: Rng, side: int) -> ImageF:
        """A mined picture, its middle (the tempting place) anywhere, at 0.75 to 1.3 times the scale that it tempted at."""
        p = self.b.mined[int(rng.integers(len(self.b.mined)))]
        h, w = p.shape[:2]
        scale = float(np.exp(rng.uniform(np.log(0.75), np.log(1.3))))
        at = rng.uniform(0.3, 0.7, 2) * side
        m = np.array([(scale, 0, at[0] - scale * w / 2), (0, scale, at[1] - scale * h / 2)])
        if rng.random() < 0.5:
            p = p[:, ::-1]
        return cv2.warpAffine(p, m, (side, side), flags=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101).astype(np.float32)

    def _face(self, rng: Rng) -> Image8:
        return self.b.faces[int(rng.integers(len(self.b.faces)))]

    def _paste_plate(self, rng: Rng, img: ImageF, face: Image8, quad: Quad) -> None:
        h, w = img.shape[:2]
        card, alpha, corners = dress(rng, face, float(np.ptp(quad[:, 0])), self.b.fonts)
        x0, y0, x1, y1 = *np.maximum(quad.min(0).astype(int) - 4, 0), *np.maximum(quad.max(0).astype(int) + 5, 1)
        area = img[y0:min(y1, h), x0:min(x1, w)]
        paste(img, light(rng, card, float(area.mean()) if area.size else 100.0), alpha, corners, quad)
        if rng.random() < 0.06:  # something in front of a part: tow bar, rail, hand
            cx = rng.uniform(quad[:, 0].min(), quad[:, 0].max())
            t = np.ptp(quad[:, 0]) * rng.uniform(0.02, 0.1)
            cv2.line(img, (int(cx), int(quad[:, 1].min() - t)), (int(cx + rng.normal(0, t)), int(quad[:, 1].max() + 3 * t)), colour(rng, 5, 150).tolist(), max(1, int(t)), cv2.LINE_AA)

    def _plate(self, rng: Rng, img: ImageF, labels: list[Label], busy: list[tuple[float, float, float, float]], car: bool) -> None:
        side = img.shape[0]
        big = side > 300
        face = self._face(rng)
        lo, hi = (50, 335) if big else (7.5, 150)
        w = float(np.exp(rng.uniform(np.log(lo), np.log(hi))))
        h = w * face.shape[0] / face.shape[1] * rng.uniform(0.93, 1.07)
        if h > 0.7 * side:
            w, h = w * 0.7 * side / h, 0.7 * side
        cx, cy = rng.uniform(0, side, 2) if rng.random() < 0.15 else rng.uniform(0.12, 0.88, 2) * side
        k = rng.random()
        spread = (0.12, 0.06, 0.04) if k < 0.5 else (0.4, 0.15, 0.1) if k < 0.9 else (0.6, 0.3, 0.16)
        yaw, pitch, roll = np.clip(rng.normal(0, spread), (-0.87, -0.6, -0.3), (0.87, 0.6, 0.3))
        quad = perspective_quad(rng, cx, cy, w, h, yaw, pitch, roll)
        x0, y0, x1, y1 = *(quad.min(0) - 3), *(quad.max(0) + 3)
        if any(x0 < b[2] and x1 > b[0] and y0 < b[3] and y1 > b[1] for b in busy):
            return
        if car:
            m = 2.4 * w
            if any(cx - m < b[2] and cx + m > b[0] and cy - 1.6 * w < b[3] and cy + 1.3 * w > b[1] for b in busy):
                if rng.random() < 0.8:
                    return
            elif abs(roll) < 0.12:
                before = img.copy()
                draw_rear(rng, img, self.b.fonts, cx, cy, w * np.cos(yaw), h)
                np.clip(img, 0, 255, out=img)
                if rng.random() < 0.6 and self.b.photos:  # the surroundings mirrored in paint and glass, and less than razor-sharp drawing
                    drawn = (np.abs(img - before).max(2, keepdims=True) > 0).astype(np.float32)
                    mirror = cv2.GaussianBlur(self._photo(rng, side), (0, 0), float(rng.uniform(0.8, 5)))
                    img += drawn * np.float32(rng.uniform(0.08, 0.4)) * (mirror - img)
                if rng.random() < 0.5:
                    img[:] = cv2.GaussianBlur(img, (0, 0), float(rng.uniform(0.4, 0.4 + w / 80)))
        self._paste_plate(rng, img, face, quad)
        busy.append((x0, y0, x1, y1))
        labels.append(Label(quad))

    def _lookalike(self, rng: Rng, img: ImageF, busy: list[tuple[float, float, float, float]]) -> None:
        side = img.shape[0]
        w = float(np.exp(rng.uniform(np.log(10), np.log(0.8 * side))))
        cx, cy = rng.uniform(0, side, 2)
        if rng.random() < 0.4 and self.b.cliparts:
            card, alpha = self.b.cliparts[int(rng.integers(len(self.b.cliparts)))]
        else:
            card = self.b.cards[int(rng.integers(len(self.b.cards)))]
            alpha = np.full(card.shape[:2], 255, np.uint8)
        k = max(0.02, min(1.0, 1.3 * w / card.shape[1]))
        card2 = cv2.resize(card, None, fx=k, fy=k, interpolation=cv2.INTER_AREA).astype(np.float32)
        alpha2 = cv2.resize(alpha, (card2.shape[1], card2.shape[0]), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        h = w * card.shape[0] / card.shape[1]
        quad = perspective_quad(rng, cx, cy, w, h, *rng.normal(0, (0.35, 0.12, 0.07)))
        x0, y0, x1, y1 = *(quad.min(0) - 2), *(quad.max(0) + 2)
        if any(x0 < b[2] and x1 > b[0] and y0 < b[3] and y1 > b[1] for b in busy):
            return
        corners = np.array([(0, 0), (card2.shape[1], 0), (card2.shape[1], card2.shape[0]), (0, card2.shape[0])], np.float64) - 0.5
        a = img[max(int(y0), 0):max(int(y1), 1), max(int(x0), 0):max(int(x1), 1)]
        paste(img, light(rng, card2, float(a.mean()) if a.size else 100.0), alpha2, corners, quad)

    def _camera(self, rng: Rng, img: ImageF) -> Image8:
        """Light, blur, rain, noise, colour, compression of the whole patch."""
        side = img.shape[0]
        if rng.random() < 0.12:  # head lamp or sun glare
            glow = np.zeros((side // 4, side // 4), np.float32)
            cv2.circle(glow, tuple(int(v) for v in rng.uniform(0, side // 4, 2)), int(rng.uniform(1, 8)), 1.0, -1)
            glow = cv2.GaussianBlur(glow, (0, 0), rng.uniform(1, 10))
            glow = cv2.resize(glow / max(float(glow.max()), 1e-3), (side, side))
            img = img + glow[..., None] * colour(rng, 80, 250) * rng.uniform(0.4, 1.2)
        k = rng.random()
        if k < 0.28:
            img = cv2.GaussianBlur(img, (0, 0), rng.uniform(0.4, 1.6))
        elif k < 0.42:
            n = int(rng.integers(2, 8))
            kernel = np.zeros((n, n), np.float32)
            a = rng.uniform(0, np.pi)
            c = (n - 1) / 2
            cv2.line(kernel, (round(c - c * np.cos(a)), round(c - c * np.sin(a))), (round(c + c * np.cos(a)), round(c + c * np.sin(a))), 1.0, 1)
            img = cv2.filter2D(img, -1, kernel / kernel.sum())
        elif k < 0.58:
            f = rng.uniform(0.45, 0.9)
            small = cv2.resize(img, (round(side * f), round(side * f)), interpolation=cv2.INTER_AREA)
            img = cv2.resize(small, (side, side), interpolation=cv2.INTER_LINEAR if rng.random() < 0.5 else cv2.INTER_CUBIC)
        if rng.random() < 0.06:  # drops on the glass
            for _ in range(int(rng.integers(2, 12))):
                x, y, r = int(rng.uniform(0, side)), int(rng.uniform(0, side)), int(rng.uniform(2, 12))
                part = img[max(y - r, 0):y + r, max(x - r, 0):x + r]
                if min(part.shape[:2]) > 2:
                    part[:] = 0.4 * part + 0.6 * cv2.blur(part, (7, 7)) + rng.uniform(-20, 30)
        k = rng.random()
        if k < 0.5:
            np.clip(img, 0, 255, out=img)
            g = np.exp(rng.normal(0, 0.35))
            img = 255 * (img / 255) ** np.float32(g)
        if rng.random() < 0.5:
            img = img * np.float32(np.exp(rng.normal(-0.1, 0.3))) + np.float32(rng.normal(0, 14))
        if rng.random() < 0.06:
            img = img * np.float32(rng.uniform(0.2, 0.5))
        if rng.random() < 0.2:
            img = np.repeat(img.mean(2, keepdims=True), 3, 2)
        elif rng.random() < 0.3:
            img = img * np.clip(rng.normal(1, 0.15, 3), 0.5, 1.6).astype(np.float32)
        if rng.random() < 0.45:
            s = abs(rng.normal(0, 7)) + 0.5
            noise = cv2.randn(np.empty(img.shape[:2] + (3 if rng.random() < 0.5 else 1,), np.float32), 0, s)
            img = img + (noise if noise.ndim == 3 else noise[..., None])
        out: Image8 = np.clip(np.rint(img), 0, 255).astype(np.uint8)
        if rng.random() < 0.35:
            ok, buf = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(22, 92))])
            if ok:
                out = np.asarray(cv2.imdecode(buf, cv2.IMREAD_COLOR), np.uint8)
        return out
