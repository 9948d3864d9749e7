"""Training crops: a rendered plate in rendered surroundings, seen by a camera, cut round wrong corners; and non-plates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from fonts import MaskFont, random_font
from numpy.typing import NDArray

from tmde_edge.simulation.plate_face import FaceSpec, face_alpha, render_face
from tmde_edge.simulation.plate_styles import random_spec
from tmde_edge.vision.segment.glyph_crop import apply_affine, canvas_from_source, cut_canvas

Rng = np.random.Generator
Image8 = NDArray[np.uint8]
ImageF = NDArray[np.float32]
MAX_GLYPHS = 14
LOW_HEIGHT_PX = 13.0  # on lower plates the place that is given is made much wronger
LOW_END_PX = 0.8  # one sigma of their ends


@dataclass
class Sample:
    """One crop. corners: (4, 2) canvas px (NaN where unknown); glyphs: (n, 6) canvas cx, cy, left, right, top, bottom px; small (n,)."""

    canvas: Image8
    plate: int  # 1, 0, or -1: do not judge
    corners: NDArray[np.float32] = field(default_factory=lambda: np.full((4, 2), np.nan, np.float32))
    glyphs: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 6), np.float32))
    small: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    light_on_dark: int = -1
    px_per_canvas: float = 1.0  # source pixels per canvas pixel, horizontally
    plate_w_px: float = 0.0  # in the source
    kind: str = ""
    canvas_from_source: NDArray[np.float32] = field(default_factory=lambda: np.zeros((2, 3), np.float32))


@dataclass
class Frame:
    """An in-car frame: boxes (n, 4) x, y, w, h of plates; unsure: boxes of what may be one."""

    image: Image8
    boxes: NDArray[np.float64]
    unsure: NDArray[np.float64]


class World:
    """What samples are made of: photos, in-car frames with boxes, fonts."""

    def __init__(
        self, photos: list[Image8], frames: list[Frame], fonts: list[Path], facades: list[Image8], sign_fonts: list[Path],
        tempting: list[tuple[str, int, NDArray[np.float64]]],
    ) -> None:
        """facades: pictures of walls and boards without vehicles. tempting: (pool, number, corners) that PlateNet takes for plates and are none."""
        self.photos, self.frames, self.fonts = photos, frames, fonts
        self.facades, self.sign_fonts, self.tempting = facades, sign_fonts, tempting

    def picture(self, pool: str, index: int) -> Image8:
        """One picture of a pool: photos, frames or facades."""
        return self.frames[index].image if pool == "frames" else getattr(self, pool)[index]

    def patch(self, rng: Rng, h: int, w: int) -> ImageF:
        """A patch of a photo, of a frame (no plate in its middle is promised), or a drawn texture; BGR float."""
        if rng.random() < 0.45 and (self.photos or self.frames):
            pool = self.photos if (rng.random() < 0.5 or not self.frames) and self.photos else [f.image for f in self.frames]
            image = pool[int(rng.integers(len(pool)))]
            scale = np.exp(rng.uniform(np.log(0.4), np.log(2.5)))
            ph, pw = min(max(2, int(h * scale)), image.shape[0]), min(max(2, int(w * scale)), image.shape[1])
            y, x = int(rng.integers(image.shape[0] - ph + 1)), int(rng.integers(image.shape[1] - pw + 1))
            return cv2.resize(image[y : y + ph, x : x + pw], (w, h), interpolation=cv2.INTER_AREA).astype(np.float32)
        return body(rng, h, w)


def colour(rng: Rng) -> NDArray[np.float32]:
    """A body colour, mostly grey, white or black."""
    if rng.random() < 0.6:
        return np.clip(np.full(3, rng.choice([15, 30, 60, 110, 160, 200, 235])) + rng.normal(0, 8, 3), 0, 255).astype(np.float32)
    return rng.uniform(10, 230, 3).astype(np.float32)


def body(rng: Rng, h: int, w: int) -> ImageF:
    """Painted metal or plastic: gradients, creases, panel gaps, grille bars, reflections."""
    out = np.empty((h, w, 3), np.float32)
    out[:] = colour(rng)
    t = np.linspace(-0.5, 0.5, h, dtype=np.float32)[:, None, None]
    out *= 1 + rng.uniform(-0.9, 0.9) * t
    if rng.random() < 0.5:
        out *= 1 + rng.uniform(-0.5, 0.5) * np.linspace(-0.5, 0.5, w, dtype=np.float32)[None, :, None]
    for _ in range(int(rng.integers(0, 4))):  # panel changes and gaps
        y = int(rng.integers(0, h))
        if rng.random() < 0.5:
            out[y:] = out[y:] * rng.uniform(0.5, 1.6)
        if rng.random() < 0.6:
            out[y : y + max(1, int(h * rng.uniform(0.005, 0.04)))] *= rng.uniform(0.2, 0.8)
    if rng.random() < 0.2:  # grille or vent
        step, bar = max(2, int(h * rng.uniform(0.04, 0.15))), rng.uniform(20, 220)
        if rng.random() < 0.7:
            for y in range(int(rng.integers(step)), h, step):
                out[y : y + max(1, step // 3)] = bar
        else:
            for x in range(int(rng.integers(step)), w, step):
                out[:, x : x + max(1, step // 3)] = bar
    if rng.random() < 0.3:
        image = np.clip(out, 0, 255)
        for _ in range(int(rng.integers(1, 5))):
            p0, p1 = rng.uniform(-0.2, 1.2, 2) * (w, h), rng.uniform(-0.2, 1.2, 2) * (w, h)
            cv2.line(image, p0.astype(int).tolist(), p1.astype(int).tolist(), colour(rng).tolist(),
                     max(1, int(h * rng.uniform(0.005, 0.1))), cv2.LINE_AA)
        out = image
    return np.clip(out, 0, 255)


def put_text(rng: Rng, image: ImageF, text: str, font: MaskFont, box: tuple[float, float, float, float], ink: NDArray[np.float32],
             fill: float = 0.82) -> None:
    """Draw letters of equal cells into a pixel box (x, y, w, h)."""
    x, y, w, h = box
    cell = w / max(len(text), 1)
    for i, c in enumerate(text):
        if c == " ":
            continue
        cw = cell * (0.3 if c in "Iil1" else fill)
        ch = h * (0.74 if c.islower() and c not in "bdfhklt" else 1.0)
        left, top = x + i * cell + (cell - cw) / 2, y + h - ch
        x0, x1, y0, y1 = max(0, int(left) - 1), min(image.shape[1], int(left + cw) + 2), max(0, int(top) - 1), min(image.shape[0], int(top + ch) + 2)
        if x0 >= x1 or y0 >= y1:
            continue
        cover = font.coverage(c, width_mm=cw, height_mm=ch, stroke_mm=max(0.12 * ch, 0.5), x_mm=np.arange(x0, x1) + 0.5 - left,
                              y_mm=np.arange(y0, y1) + 0.5 - top, px_per_mm=1.0)
        image[y0:y1, x0:x1] += cover[..., None] * (ink - image[y0:y1, x0:x1])


_WORDS = ("AUTOHAUS", "TOYOTA", "HONDA", "SUBARU", "FORD", "SERVICE", "DIESEL", "TURBO", "4x4", "QUATTRO", "TDI", "Motors", "www.cars.com",
          "Sales Service", "CHEVROLET", "LIMITED", "POLICE", "TAXI", "SCHOOL BUS", "AMBULANCE", "OPEN", "STOP", "EXIT", "P", "MARKET", "Cafe",
          "Coffee", "HOTEL", "PIZZA", "Bakery", "BANK", "Delivery", "TRANSPORT", "LOGISTICS", "call 0800", "Main St", "Broadway", "NO PARKING",
          "ONE WAY", "Volkswagen", "Mercedes", "DACIA", "RENAULT", "SKODA", "OPEL", "Nissan", "HYUNDAI", "SUPER", "Sale", "24h", "A4", "E60",
          "Farmacia", "Restaurant", "Kfz", "Shop", "BAR", "PUB", "TESCO", "LIDL", "Express", "PARKING", "BUS", "50", "30", "km", "LOANS", "CASH")


_HEADS = ("B", "C", "D", "F", "G", "H", "L", "M", "N", "P", "R", "S", "T", "V", "W", "BR", "CH", "ST", "TR", "SH", "FL", "PL", "GR", "")
_CORES = ("A", "E", "I", "O", "U", "AI", "EE", "OO", "IA", "OU")
_TAILS = ("", "", "N", "R", "S", "T", "L", "ND", "NG", "CK", "M", "RT", "NT")


def invented_word(rng: Rng) -> str:
    """A word of one to four syllables in capitals, capitalised or small."""
    text = "".join(str(rng.choice(_HEADS)) + str(rng.choice(_CORES)) + str(rng.choice(_TAILS)) for _ in range(int(rng.integers(1, 5))))
    k = rng.random()
    return text if k < 0.6 else text.title() if k < 0.85 else text.lower()


def number_words(rng: Rng) -> str:
    """House, phone, price, year, time, registration-like numbers that stand on no plate."""
    k, digits = int(rng.integers(7)), [str(int(d)) for d in rng.integers(0, 10, 11)]
    if k == 0:
        return "".join(digits[:3]) + "-" + "".join(digits[3:6]) + "-" + "".join(digits[6:10])
    if k == 1:
        return "1-800-" + "".join(digits[:3]) + "-" + "".join(digits[3:7])
    if k == 2:
        return "".join(digits[: int(rng.integers(1, 6))])
    if k == 3:
        return digits[0] + "." + digits[1] + digits[2]
    if k == 4:
        return "".join(digits[:2]) + ":" + "".join(digits[2:4])
    letters = "".join(chr(65 + int(v)) for v in rng.integers(0, 26, 3))
    return letters[: int(rng.integers(1, 4))] + "".join(digits[: int(rng.integers(2, 5))]) + (letters[:2] if k == 6 else "")


def words(rng: Rng, count: int) -> str:
    """Some words that are no registration."""
    return " ".join(str(rng.choice(_WORDS)) if rng.random() < 0.3 else number_words(rng) if rng.random() < 0.15 else invented_word(rng) for _ in range(count))


def pose(rng: Rng, spec: FaceSpec, width_px: float) -> NDArray[np.float64]:
    """Homography, source px (plate centre at 0, 0) from plate-frame mm, for a plate about width_px wide before foreshortening."""
    yaw = np.clip(rng.normal(0, 0.32), -1.1, 1.1)
    pitch, roll = np.clip(rng.normal(0, 0.15), -0.6, 0.6), rng.normal(0, 0.05)
    if rng.random() < 0.1:
        roll = rng.uniform(-0.35, 0.35)
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    rot = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]) @ np.array(
        [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    depth = spec.width_mm * np.exp(rng.uniform(np.log(4), np.log(80)))
    f = width_px * depth / spec.width_mm
    h = np.diag([f, f, 1.0]) @ np.column_stack([rot[:, 0], rot[:, 1], [0, 0, depth]])
    return h / h[2, 2]


def project(h: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (..., 2) through a homography."""
    q = points @ h[:, :2].T + h[:, 2]
    return q[..., :2] / q[..., 2:]


def weather(rng: Rng, face: ImageF) -> ImageF:
    """Dirt, shadow edges, wear, embossing, glare on a flat face."""
    h, w = face.shape[:2]
    if rng.random() < 0.35:
        n = int(rng.integers(2, 12))
        rough = cv2.resize(rng.normal(0, 1, (n, 3 * n)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
        dirt = np.clip(rough * rng.uniform(0.05, 0.3) + rng.uniform(-0.2, 0.25), 0, 0.75)[..., None]
        face = face + dirt * (np.array(rng.uniform((30, 40, 50), (120, 140, 160)), np.float32) - face)
    if rng.random() < 0.3:  # a shadow's edge
        a, b = rng.normal(0, 1, 2)
        yy, xx = np.mgrid[0:h, 0:w].astype(np.float32)
        side = a * (xx / w - rng.random()) + b * (yy / h - rng.random())
        soft = rng.choice([0.005, 0.05, 0.3])
        face = face * (1 - rng.uniform(0.2, 0.75) / (1 + np.exp(-np.clip(side / soft, -30, 30))))[..., None]
    if rng.random() < 0.3:
        face = face * (1 + rng.uniform(-0.6, 0.6) * np.linspace(-0.5, 0.5, h, dtype=np.float32)[:, None, None])
    if rng.random() < 0.25:  # embossing: light from above on the slopes of the ink
        grey = face.mean(axis=2)
        shifted = np.roll(grey, max(1, int(h * 0.01)), axis=0)
        face = face + (np.clip(grey - shifted, -60, 60) * rng.uniform(-0.5, 0.5))[..., None]
    if rng.random() < 0.15:  # splashes
        for _ in range(int(rng.integers(1, 15))):
            c = (int(rng.integers(w)), int(rng.integers(h)))
            face = np.ascontiguousarray(face)
            cv2.circle(face, c, max(1, int(h * rng.uniform(0.005, 0.08))), rng.uniform(20, 160, 3).tolist(), -1, cv2.LINE_AA)
    if rng.random() < 0.2:  # low contrast: faded ink, retroreflection
        level = rng.uniform(60, 230)
        face = level + (face - level) * rng.uniform(0.3, 0.8)
    return face.astype(np.float32)


def scenic(rng: Rng, world: World, spec: FaceSpec, ppm: float, font: MaskFont, face: ImageF) -> ImageF:
    """A printed picture behind the characters, as on many American plates."""
    pool = world.photos or [f.image for f in world.frames]
    image = pool[int(rng.integers(len(pool)))]
    h, w = face.shape[:2]
    scale = rng.uniform(0.3, 1.0)
    ch = max(8, int(image.shape[0] * scale))
    cw = min(image.shape[1], int(ch * w / h))
    y, x = int(rng.integers(image.shape[0] - ch + 1)), int(rng.integers(image.shape[1] - cw + 1))
    print_ = cv2.resize(image[y : y + ch, x : x + cw], (w, h), interpolation=cv2.INTER_AREA).astype(np.float32)
    print_ = (print_ - print_.mean(axis=(0, 1))) * rng.uniform(0.1, 0.6)
    bare = replace(spec, background_bgr=(255.0, 255.0, 255.0), ink_bgr=(0.0, 0.0, 0.0), marks=(), border_mm=0)
    ink = 1 - render_face(bare, ppm, font)[..., :1].astype(np.float32) / 255
    room = np.abs(np.mean(spec.ink_bgr) - np.mean(spec.background_bgr))
    print_ = np.clip(print_, -0.55 * room, 0.55 * room)  # the law wants the characters legible
    return np.clip(face + print_ * (1 - ink), 0, 255)


def surroundings(rng: Rng, image: ImageF, quad: NDArray[np.float64], font: MaskFont, ss: float) -> None:
    """Recess, holder, lamp, lettering round the plate; quad in image pixels; drawn before the plate."""
    centre = quad.mean(axis=0)
    u, v = (quad[1] + quad[2] - quad[0] - quad[3]) / 4, (quad[2] + quad[3] - quad[0] - quad[1]) / 4

    def poly(x0: float, y0: float, x1: float, y1: float, col: NDArray[np.float32]) -> None:
        p = np.array([centre + x * u + y * v for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])
        cv2.fillConvexPoly(image, (p * 16).round().astype(np.int32), np.clip(col, 0, 255).tolist(), cv2.LINE_AA, 4)

    base = image[::8, ::8].reshape(-1, 3).mean(axis=0)
    if rng.random() < 0.5:
        mx, t, b = rng.uniform(0.02, 0.5), rng.uniform(0.05, 0.9), rng.uniform(0.05, 0.9)
        poly(-1 - mx, -1 - t, 1 + mx, 1 + b, base * rng.uniform(0.2, 1.4))
    if rng.random() < 0.2:
        y = -1 - rng.uniform(0.1, 0.5)
        poly(-rng.uniform(0.3, 1.3), y - rng.uniform(0.1, 0.4), rng.uniform(0.3, 1.3), y, colour(rng))
    if rng.random() < 0.12:
        for s in (-1, 1):
            poly(s * rng.uniform(1.1, 1.2), -rng.uniform(0.3, 1.2), s * 1.6, rng.uniform(0.3, 1.2), np.array([30, 30, rng.uniform(90, 240)], np.float32))
    if rng.random() < 0.12:  # lettering of the vehicle above or below
        hgt = float(np.hypot(*v)) * rng.uniform(0.25, 0.6)
        wid = float(np.hypot(*u)) * rng.uniform(0.5, 2)
        y = centre[1] + (float(np.hypot(*v)) * rng.uniform(1.2, 1.7)) * (1 if rng.random() < 0.5 else -1) - hgt / 2
        put_text(rng, image, words(rng, 1), font, (centre[0] - wid / 2, y, wid, hgt), colour(rng))
    if rng.random() < 0.3:  # a soft shadow of the plate
        poly(-1.01, -0.98, 1.01, 1.0 + rng.uniform(0.04, 0.2), base * 0.4)


def holder(rng: Rng, image: ImageF, quad: NDArray[np.float64], font: MaskFont, spec: FaceSpec) -> None:
    """A dealer's frame round the plate, covering a little of it; drawn after the plate."""
    width_mm, height_mm = spec.width_mm, spec.height_mm
    h = cv2.getPerspectiveTransform(
        np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32) * np.array([width_mm / 2, height_mm / 2], np.float32), quad.astype(np.float32))
    out = [rng.uniform(2, 22) for _ in range(2)] + [rng.uniform(2, 26), rng.uniform(2, 30)]  # left right top bottom
    over = [rng.uniform(0, 6) for _ in range(2)] + [rng.uniform(0, 8), rng.uniform(0, 8)]
    if rng.random() < 0.5:
        out[1], out[2], out[3], over[1], over[2], over[3] = out[0], out[0], out[0], over[0], over[0], over[0]
    W, H = width_mm / 2, height_mm / 2
    if rng.random() < 0.35:  # wide ones hide names and stickers, never the characters
        free = (min(g.top_mm for g in spec.glyphs) + H, H - max(g.top_mm + g.height_mm for g in spec.glyphs))
        for k, room in enumerate(free, start=2):
            if rng.random() < 0.7 and room > 8:
                over[k] = rng.uniform(2, min(room - 2, 26))
                out[k] = rng.uniform(4, 26)
    outer = np.array([[-W - out[0], -H - out[2]], [W + out[1], -H - out[2]], [W + out[1], H + out[3]], [-W - out[0], H + out[3]]])
    inner = np.array([[-W + over[0], -H + over[2]], [W - over[1], -H + over[2]], [W - over[1], H - over[3]], [-W + over[0], H - over[3]]])
    col = np.full(3, rng.choice([12, 25, 50, 120, 190, 230]), np.float32) + rng.normal(0, 6, 3).astype(np.float32)
    mask = np.zeros(image.shape[:2], np.uint8)
    rings = [(project(h, p) * 16).round().astype(np.int32) for p in (outer, inner)]
    cv2.fillPoly(mask, rings, 255, cv2.LINE_AA, 4)
    image += (mask.astype(np.float32) / 255)[..., None] * (np.clip(col, 0, 255) - image)
    for top, room in ((True, out[2] + over[2]), (False, out[3] + over[3])):
        if room > 14 and rng.random() < 0.7:
            y = -H - out[2] + room * 0.2 if top else H + out[3] - room * 0.8
            left, right, low = project(h, np.array([[-W * 0.8, y], [W * 0.8, y], [0, y + room * 0.6]]))
            if abs(right[1] - left[1]) > 0.12 * abs(right[0] - left[0]):
                continue  # lettering is drawn upright only
            wid = (right[0] - left[0]) * rng.uniform(0.4, 1.0)
            x, top_px, tall = (left[0] + right[0] - wid) / 2, (left[1] + right[1]) / 2, low[1] - (left[1] + right[1]) / 2
            ink = np.full(3, 235 if col.mean() < 110 else 20, np.float32)
            put_text(rng, image, words(rng, int(rng.integers(1, 3)))[:20], font, (x, top_px, wid, tall), ink)


def camera(rng: Rng, image: ImageF, ss: int) -> Image8:
    """Supersampled BGR -> grey uint8 at source resolution: exposure, defocus, motion, noise, sharpening, JPEG."""
    grey = cv2.cvtColor(np.clip(image, 0, 255), cv2.COLOR_BGR2GRAY)
    if rng.random() < 0.12:
        grey = image[..., int(rng.integers(3))].astype(np.float32)  # infrared and coloured lamps shift tones
    mood = rng.random()
    if mood < 0.16:
        grey = grey * rng.uniform(0.18, 0.6)
    elif mood < 0.32:
        grey = grey * rng.uniform(1.1, 1.7) + rng.uniform(0, 30)
    elif mood < 0.6:
        grey = 128 + (grey - 128) * rng.uniform(0.3, 1.0) + rng.uniform(-40, 40)
    grey = np.clip(grey, 0, 255)
    grey = 255 * (grey / 255) ** np.exp(rng.normal(0, 0.25))
    sigma = np.clip(np.exp(rng.normal(np.log(0.55), 0.45)), 0.25, 1.9) * ss
    grey = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), sigma)
    if rng.random() < 0.2:
        length, angle = rng.uniform(1, 4.5) * ss, rng.normal(0, 0.5) if rng.random() < 0.7 else rng.uniform(0, np.pi)
        n = max(3, 2 * int(length) + 1)
        kernel = np.zeros((n, n), np.float32)
        d = np.array([np.cos(angle), np.sin(angle)]) * length / 2
        cv2.line(kernel, *[tuple((((n - 1) / 2 + s * d) * 16).round().astype(int).tolist()) for s in (-1, 1)], 1.0, 1, cv2.LINE_AA, 4)
        grey = cv2.filter2D(grey, -1, kernel / max(kernel.sum(), 1e-6), borderType=cv2.BORDER_REPLICATE)
    if rng.random() < 0.07:  # a lamp's bloom
        glow = np.zeros_like(grey)
        cv2.circle(glow, (int(rng.integers(grey.shape[1])), int(rng.integers(grey.shape[0]))), int(rng.uniform(2, 12) * ss), float(rng.uniform(100, 500)), -1)
        grey = grey + cv2.GaussianBlur(glow, (0, 0), rng.uniform(3, 15) * ss)
    h, w = grey.shape[0] // ss, grey.shape[1] // ss
    grey = cv2.resize(grey[: h * ss, : w * ss], (w, h), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.3:
        grey = grey + rng.uniform(0.3, 1.5) * (grey - cv2.GaussianBlur(grey, (0, 0), rng.uniform(0.7, 1.6)))
    noise = np.exp(rng.uniform(np.log(0.4), np.log(9)))
    speckle = rng.normal(0, noise, grey.shape).astype(np.float32)
    if rng.random() < 0.4:
        speckle = cv2.GaussianBlur(speckle, (0, 0), 0.8) * 1.8
    out = np.clip(np.rint(grey + speckle * np.sqrt(np.clip(grey, 5, 255) / 128)), 0, 255).astype(np.uint8)
    if rng.random() < 0.7:
        quality = int(rng.uniform(25, 96))
        out = cv2.imdecode(cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)
    return out


def wrong_corners(rng: Rng, quad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners as a detector gives them: mostly a few per cent of the width off, together and each; at times an upright box."""
    u, v = (quad[1] + quad[2] - quad[0] - quad[3]) / 2, (quad[2] + quad[3] - quad[0] - quad[1]) / 2
    width, height = float(np.hypot(*u)), float(np.hypot(*v))
    centre = quad.mean(axis=0)
    size = np.exp(rng.uniform(np.log(0.004), np.log(0.055)))
    reach = min(size, 0.2 * height / width + 0.3 * size)  # vertical error is bounded by the height as well
    out = centre + (quad - centre) * (1 + np.clip(rng.normal(0, 1.0), -2, 2) * size * 1.5)
    out = out + np.clip(rng.normal(0, 1, 2), -2, 2) * (size, reach) * width
    out = out + np.clip(rng.normal(0, 1, (4, 2)), -2, 2) * (size * 0.7, reach * 0.7) * width
    stretch = 1 + np.clip(rng.normal(0, 0.5), -1, 1) * min(2.0 * size * width / height, 0.3)
    axis = v / height
    along = (out - centre) @ axis
    out = out + np.outer(along * (stretch - 1), axis)
    # Of a low plate little is to be seen: were the place it is given near the truth, the network would repeat that place.
    low = float(np.clip((LOW_HEIGHT_PX - height) / 5, 0.0, 1.0))
    up, down = np.exp(rng.normal(0, 0.2)) - 1, np.exp(rng.normal(0, 0.2)) - 1
    left, right = rng.normal(0, LOW_END_PX, 2) / width
    out[[0, 1]] -= 0.5 * low * up * v
    out[[2, 3]] += 0.5 * low * down * v
    out[[0, 3]] -= low * left * u
    out[[1, 2]] += low * right * u
    if rng.random() < 0.06:  # a finder's worse moments
        out = centre + (out - centre) * rng.uniform(0.85, 1.4)
    if rng.random() < 0.12:
        (x0, y0), (x1, y1) = out.min(axis=0), out.max(axis=0)
        out = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return out


def plate_width(rng: Rng) -> float:
    """Source widths 18..420 px, most 36..160, a third small ones."""
    share = rng.random()
    low, high = (36, 160) if share < 0.45 else (18, 48) if share < 0.8 else (20, 420)
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def view(rng: Rng, world: World, spec: FaceSpec, font: MaskFont, width_px: float, shots: int) -> tuple[list[Image8], NDArray[np.float64], NDArray[np.float64]]:
    """Grey source crops round a posed plate, each by another camera; its corners (4, 2); the homography source px from mm."""
    h_mm = pose(rng, spec, width_px)
    half = np.array([spec.width_mm / 2, spec.height_mm / 2])
    corners_mm = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    quad = project(h_mm, corners_mm)
    low, high = quad.min(axis=0), quad.max(axis=0)
    margin = 0.45 * (high - low)[0] * np.array([1.0, 0.75]) + 4
    shift = np.floor(-(low - margin)) + rng.random(2)  # a random sub-pixel phase
    size = np.ceil(high - low + 2 * margin).astype(int) + 1
    h_mm = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]]) @ h_mm
    quad = quad + shift
    ss = 3 if width_px < 90 else 2 if width_px < 220 else 1
    # the supersampled pixel s shows the source at (s + 0.5) / ss - 0.5
    up = np.array([[ss, 0, (ss - 1) / 2], [0, ss, (ss - 1) / 2], [0, 0, 1.0]])
    big = world.patch(rng, int(size[1]) * ss, int(size[0]) * ss)
    big = np.ascontiguousarray(big)
    surroundings(rng, big, project(up, quad), font, ss)
    ppm = max(1.25 * ss * width_px / spec.width_mm, 0.12)
    face = render_face(spec, ppm, font).astype(np.float32)
    if rng.random() < (0.3 if spec.width_mm < 2.6 * spec.height_mm else 0.03):
        face = scenic(rng, world, spec, ppm, font, face)
    face = weather(rng, face)
    alpha = face_alpha(spec, ppm)
    face4 = np.dstack([face * alpha[..., None], alpha * 255])
    mm_from_face = np.array([[1 / ppm, 0, -spec.width_mm / 2 + 0.5 / ppm], [0, 1 / ppm, -spec.height_mm / 2 + 0.5 / ppm], [0, 0, 1]])
    warped = cv2.warpPerspective(face4, up @ h_mm @ mm_from_face, (big.shape[1], big.shape[0]), flags=cv2.INTER_LINEAR)
    big = big * (1 - warped[..., 3:] / 255) + warped[..., :3]
    if rng.random() < 0.35:
        holder(rng, big, project(up, quad), font, spec)
    if rng.random() < 0.03:  # a tow ball, a hand, a cable in front
        c = project(up, quad.mean(axis=0) + rng.normal(0, 0.3, 2) * (high - low))
        cv2.circle(big, (int(c[0]), int(c[1])), max(2, int(rng.uniform(0.03, 0.1) * width_px * ss)), colour(rng).tolist(), -1, cv2.LINE_AA)
    return [camera(rng, big, ss) for _ in range(shots)], quad, h_mm


def make_sample(grey: Image8, corners: NDArray[np.float64], kind: str, plate: int) -> Sample | None:
    try:
        m = canvas_from_source(corners)
    except ValueError:
        return None
    s = Sample(cut_canvas(grey, m), plate, kind=kind)
    s.px_per_canvas = 1.0 / max(float(np.hypot(*m[:, 0])), 1e-6)
    s.canvas_from_source = m.astype(np.float32)
    return s


def plate_samples(rng: Rng, world: World, shots: int = 2, spec: FaceSpec | None = None, width_px: float | None = None, style: str | None = None) -> list[Sample]:
    """A plate seen by some cameras; now and then a cut that holds only a part of it, or far too much round it: not a plate candidate to keep."""
    spec = spec or random_spec(rng, style)
    width_px = width_px or plate_width(rng)
    font = random_font(rng, world.fonts)
    greys, quad, h_mm = view(rng, world, spec, font, width_px, shots)
    out = []
    for grey in greys:
        if rng.random() < 0.07:
            s = make_sample(grey, misplaced(rng, quad), "part", 0)
            out += [s] if s is not None else []
            continue
        corners = wrong_corners(rng, quad)
        s = make_sample(grey, corners, "plate", 1)
        if s is None:
            continue
        m = canvas_from_source(corners)
        s.corners = apply_affine(m, quad).astype(np.float32)
        counted = [g for g in spec.glyphs if g.counted][:MAX_GLYPHS]
        tallest = max(g.height_mm for g in counted)
        rows = []
        for g in counted:
            x0, x1, y0, y1 = g.left_mm, g.left_mm + g.width_mm, g.top_mm, g.top_mm + g.height_mm
            xm, ym = (x0 + x1) / 2, (y0 + y1) / 2
            p = apply_affine(m, project(h_mm, np.array([[xm, ym], [x0, ym], [x1, ym], [xm, y0], [xm, y1]])))
            rows.append([p[0, 0], p[0, 1], p[1, 0], p[2, 0], p[3, 1], p[4, 1]])
        s.glyphs = np.array(rows, np.float32)
        s.small = np.array([g.height_mm < 0.87 * tallest for g in counted], np.uint8)
        s.light_on_dark = int(np.mean(spec.ink_bgr) > np.mean(spec.background_bgr))
        s.plate_w_px = float(np.hypot(*(quad[1] - quad[0])) + np.hypot(*(quad[2] - quad[3]))) / 2
        out.append(s)
    return out


def misplaced(rng: Rng, quad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners that overlap the plate by well under half."""
    centre = quad.mean(axis=0)
    u, v = (quad[1] + quad[2] - quad[0] - quad[3]) / 2, (quad[2] + quad[3] - quad[0] - quad[1]) / 2
    kind = rng.random()
    if kind < 0.3:
        return centre + (quad - centre) * rng.uniform(0.25, 0.5) + u * rng.uniform(-0.35, 0.35) + v * rng.uniform(-0.2, 0.2)
    if kind < 0.5:
        return quad + u * rng.uniform(0.55, 0.9) * rng.choice([-1, 1]) + v * rng.uniform(-0.2, 0.2)
    if kind < 0.65:
        return quad + v * rng.uniform(0.65, 1.1) * rng.choice([-1, 1]) + u * rng.uniform(-0.2, 0.2)
    if kind < 0.85:
        return centre + (quad - centre) * rng.uniform(1.8, 3.0) + u * rng.uniform(-0.3, 0.3) + v * rng.uniform(-0.3, 0.3)
    return centre + np.array([a * u * s + b * v * t for (a, b), s, t in zip(((-1, -1), (1, -1), (1, 1), (-1, 1)), [rng.uniform(0.15, 0.25)] * 4,
                                                                            [rng.uniform(0.4, 0.6)] * 4, strict=True)])
