"""What is no plate: lettering, facades, grilles, lamps, radios, boards, and what tempts PlateNet in photos and in-car frames."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from fonts import random_font
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scenes import Image8, ImageF, Rng, Sample, World, body, camera, colour, make_sample, misplaced, plate_samples, plate_width, put_text, words, wrong_corners

from tmde_edge.vision.segment.glyph_crop import apply_affine


def antique(rng: Rng, grey: Image8) -> Image8:
    """At times an old print or a poor scan: little contrast, grain, soft."""
    if rng.random() < 0.8:
        return grey
    x = grey.astype(np.float32)
    x = rng.uniform(40, 170) + (x - x.mean()) * rng.uniform(0.4, 1.0)
    if rng.random() < 0.6:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.6, 2.0))
    x += cv2.GaussianBlur(rng.normal(0, 1, x.shape).astype(np.float32), (0, 0), 0.7) * rng.uniform(1, 12)
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)


def random_quad(rng: Rng, image: Image8) -> NDArray[np.float64]:
    """A plate-shaped quad anywhere in a picture."""
    h, w = image.shape[:2]
    width = float(np.exp(rng.uniform(np.log(18), np.log(min(350, w * 0.5)))))
    height = width / rng.uniform(1.4, 5.5)
    c = rng.uniform((width / 2, height / 2), (max(w - width / 2, width / 2 + 1), max(h - height / 2, height / 2 + 1)))
    angle = rng.normal(0, 0.08)
    u, v = np.array([np.cos(angle), np.sin(angle)]) * width / 2, np.array([-np.sin(angle), np.cos(angle)]) * height / 2
    return np.array([c - u - v, c + u - v, c + u + v, c - u + v]) + rng.normal(0, 0.02 * width, (4, 2))


def near_boxes(quad: NDArray[np.float64], boxes: NDArray[np.float64]) -> bool:
    """Whether a quad's upright box touches one of some boxes (n, 4) x, y, w, h."""
    (x0, y0), (x1, y1) = quad.min(axis=0), quad.max(axis=0)
    return any(x0 < b[0] + b[2] and b[0] < x1 and y0 < b[1] + b[3] and b[1] < y1 for b in boxes)


def photo_negative(rng: Rng, world: World) -> Sample | None:
    """A cut of a photo or in-car frame away from any plate, known or guessed; busy places are preferred."""
    boxes = np.zeros((0, 4))
    if world.frames and (rng.random() < 0.6 or not world.photos):
        frame = world.frames[int(rng.integers(len(world.frames)))]
        image, boxes = frame.image, np.concatenate([frame.boxes, frame.unsure])
    elif world.photos:
        image = world.photos[int(rng.integers(len(world.photos)))]
    else:
        return None
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    best, best_score = None, -1.0
    for _ in range(int(rng.integers(1, 7))):
        quad = random_quad(rng, image)
        if near_boxes(quad, boxes):
            continue
        (x0, y0), (x1, y1) = quad.min(axis=0), quad.max(axis=0)
        part = grey[max(0, int(y0)) : int(y1) + 1, max(0, int(x0)) : int(x1) + 1]
        score = float(part.std()) if part.size else 0.0
        if score > best_score:
            best, best_score = quad, score
    return None if best is None else make_sample(antique(rng, grey), best, "photo", 0)


def _seen(rng: Rng, image: Image8, quad: NDArray[np.float64], wide_px: float, kind: str) -> Sample | None:
    """What lies round a quad of a picture, brought to a width, tilted, and seen by a camera."""
    (x0, y0), (x1, y1) = quad.min(axis=0), quad.max(axis=0)
    w, h = x1 - x0, y1 - y0
    x0, x1, y0, y1 = x0 - 0.5 * w, x1 + 0.5 * w, y0 - 0.4 * w, y1 + 0.4 * w
    ss = 2 if wide_px < 90 else 1
    scale = wide_px * ss / w
    shear, turn = rng.normal(0, 0.08), rng.normal(0, 0.03)
    matrix = np.array([[scale, turn * scale, 0.0], [shear * scale, scale, 0.0]])
    size = (max(16, round((x1 - x0) * scale)), max(16, round((y1 - y0) * scale)))
    matrix[:, 2] = np.array(size) / 2 - matrix[:, :2] @ quad.mean(axis=0)
    if scale < 0.7:  # average before shrinking
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        fx, fy = small.shape[1] / image.shape[1], small.shape[0] / image.shape[0]
        back = np.array([[1 / fx, 0, 0.5 / fx - 0.5], [0, 1 / fy, 0.5 / fy - 0.5], [0, 0, 1]])
        seen = cv2.warpAffine(small, matrix @ back, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    else:
        seen = cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    grey = camera(rng, seen.astype(np.float32), ss)
    at = (apply_affine(matrix, quad) + 0.5) / ss - 0.5
    return make_sample(antique(rng, grey), wrong_corners(rng, at), kind, 0)


def tempting_negative(rng: Rng, world: World) -> Sample | None:
    """A place that PlateNet takes for a plate though none is there."""
    if not world.tempting:
        return None
    pool, index, quad = world.tempting[int(rng.integers(len(world.tempting)))]
    image = world.picture(pool, index)
    if rng.random() < 0.35 or pool == "frames":
        jitter = wrong_corners(rng, quad)
        return make_sample(antique(rng, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)), jitter, "tempting", 0)
    wide = float(np.ptp(quad[:, 0]))
    return _seen(rng, image, quad, min(plate_width(rng), 1.3 * wide), "tempting")


def facade_negative(rng: Rng, world: World) -> Sample | None:
    """A part of a wall, a board, a rail."""
    if not world.facades:
        return None
    image = world.facades[int(rng.integers(len(world.facades)))]
    quad = random_quad(rng, image)
    return _seen(rng, image, quad, min(plate_width(rng), 1.5 * float(np.ptp(quad[:, 0]))), "facade")


@lru_cache(maxsize=400)
def _sign_font(file: str) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(file, 72)


def line_of_text(text: str, file: str) -> NDArray[np.uint8] | None:
    """Ink (h, w) of a text set as its font wants it, cut to the ink."""
    font = _sign_font(file)
    box = font.getbbox(text)
    if box[2] - box[0] < 4 or box[3] - box[1] < 4 or box[2] - box[0] > 6000:
        return None
    image = Image.new("L", (box[2] - box[0] + 4, box[3] - box[1] + 4), 0)
    ImageDraw.Draw(image).text((2 - box[0], 2 - box[1]), text, fill=255, font=font)
    return np.asarray(image)


def _lay(image: ImageF, ink: NDArray[np.uint8], x: float, y: float, w: float, h: float, col: NDArray[np.float32]) -> None:
    """Blend an ink mask into the box x, y, w, h of a picture; parts outside are cut."""
    wide, high = max(2, round(w)), max(2, round(h))
    mask = cv2.resize(ink, (wide, high), interpolation=cv2.INTER_AREA if high < ink.shape[0] else cv2.INTER_LINEAR)
    x0, y0 = round(x), round(y)
    a, b, c, d = max(0, x0), max(0, y0), min(image.shape[1], x0 + wide), min(image.shape[0], y0 + high)
    if a >= c or b >= d:
        return
    cover = mask[b - y0 : d - y0, a - x0 : c - x0, None].astype(np.float32) / 255
    image[b:d, a:c] += cover * (col - image[b:d, a:c])


def lettering_negative(rng: Rng, world: World) -> Sample | None:
    """Lettering as signs, shop fronts, vans and boats have it: no plate's edge round it, or a board far larger, or far smaller letters."""
    width = plate_width(rng)
    ss = 2 if width < 90 else 1
    w = width * ss
    h = w / rng.uniform(1.6, 6.5)
    W, H = int(w * 2.0) + 8, int(h + w * 0.8) + 8
    image = np.ascontiguousarray(world.patch(rng, H, W)) if rng.random() < 0.6 else body(rng, H, W)
    x, y = (W - w) / 2, (H - h) / 2
    ink, ground = colour(rng), colour(rng)
    if abs(float(ink.mean() - ground.mean())) < 60:
        ink = np.full(3, 235, np.float32) if ground.mean() < 128 else np.full(3, 20, np.float32)
    board = rng.random()
    if board < 0.45:  # a fascia or a board that goes on
        left, right = (x - rng.uniform(0.1, 1.0) * w, x + w + rng.uniform(0.1, 1.0) * w)
        top, bottom = y - rng.uniform(-0.1, 0.5) * h, y + h + rng.uniform(-0.1, 0.5) * h
        cv2.rectangle(image, (round(left), round(top)), (round(right), round(bottom)), ground.tolist(), -1, cv2.LINE_AA)
        if rng.random() < 0.3:
            cv2.rectangle(image, (round(left + 2), round(top + 2)), (round(right - 2), round(bottom - 2)), ink.tolist(), max(1, int(0.04 * h)), cv2.LINE_AA)
    elif abs(float(ink.mean() - image.mean())) < 50:
        ink = np.full(3, 235, np.float32) if image.mean() < 128 else np.full(3, 20, np.float32)
    file = str(world.sign_fonts[int(rng.integers(len(world.sign_fonts)))])
    count = int(rng.integers(1, 4))
    text = words(rng, count)
    mask = line_of_text(text, file)
    if mask is None:
        return None
    tall = h * rng.uniform(0.35, 0.95)
    wide = tall * mask.shape[1] / mask.shape[0] * rng.uniform(0.8, 1.3)
    if rng.random() < 0.5:  # the cut fits the text
        wide = w * rng.uniform(0.75, 1.05)
        tall = min(tall, 1.6 * wide * mask.shape[0] / mask.shape[1])
    start = x + (w - wide) / 2 if wide < 1.1 * w else x - rng.uniform(0, 1) * (wide - w)
    if rng.random() < 0.25:  # a shadow or an outline of the letters
        off = max(1.0, 0.06 * tall)
        _lay(image, mask, start + off, y + (h - tall) / 2 + off, wide, tall, colour(rng))
    _lay(image, mask, start, y + (h - tall) / 2, wide, tall, ink)
    for side in (-1, 1):
        if rng.random() < 0.35:
            more = line_of_text(words(rng, int(rng.integers(1, 5))), str(world.sign_fonts[int(rng.integers(len(world.sign_fonts)))]))
            if more is not None:
                size = tall * rng.uniform(0.2, 0.8)
                at = y + (h - tall) / 2 + (tall * 1.15 if side > 0 else -size * 1.25)
                _lay(image, more, x + rng.uniform(-0.1, 0.3) * w, at, size * more.shape[1] / more.shape[0], size, ink)
    quad = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
    lean, tilt = rng.normal(0, 0.1), rng.normal(0, 0.08) + (rng.uniform(-0.4, 0.4) if rng.random() < 0.15 else 0)
    matrix = np.array([[1, lean, -lean * H / 2], [tilt, 1, -tilt * W / 2]])
    image = cv2.warpAffine(image, matrix, (W, H), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    quad = (apply_affine(matrix, quad) + 0.5) / ss - 0.5
    return make_sample(antique(rng, camera(rng, image, ss)), wrong_corners(rng, quad), "lettering", 0)


def _window(rng: Rng, image: ImageF, x: float, y: float, w: float, h: float, glass: NDArray[np.float32], frame: NDArray[np.float32], look: tuple[int, int, float, bool]) -> None:
    """One window: frame, panes, now and then a sill, a blind, a reflection."""
    across, down, bar, sill = look
    cv2.rectangle(image, (round(x), round(y)), (round(x + w), round(y + h)), frame.tolist(), -1, cv2.LINE_AA)
    b = max(0.5, bar * min(w, h))
    for i in range(across):
        for j in range(down):
            px, py = x + b + i * (w - b) / across, y + b + j * (h - b) / down
            pane = np.clip(glass * rng.uniform(0.6, 1.5), 0, 255)
            cv2.rectangle(image, (round(px), round(py)), (round(px + (w - b) / across - b), round(py + (h - b) / down - b)), pane.tolist(), -1, cv2.LINE_AA)
    if rng.random() < 0.2:
        cv2.rectangle(image, (round(x + b), round(y + b)), (round(x + w - b), round(y + h * rng.uniform(0.2, 0.7))), np.clip(glass * 2 + 60, 0, 255).tolist(), -1)
    if sill:
        cv2.rectangle(image, (round(x - 0.1 * w), round(y + h)), (round(x + 1.1 * w), round(y + h + max(1.0, 0.08 * h))), np.clip(frame * 1.1, 0, 255).tolist(), -1)


def things_negative(rng: Rng, world: World) -> Sample | None:
    """Rows of things: windows of a facade, bottles, books, knobs, lamps in the dark, teeth of a grille, tiles."""
    width = plate_width(rng)
    ss = 2 if width < 90 else 1
    w = width * ss
    h = w / rng.uniform(1.3, 6)
    W, H = int(w * 2.0) + 8, int(h + w * 0.8) + 8
    x, y = (W - w) / 2, (H - h) / 2
    image = np.ascontiguousarray(world.patch(rng, H, W)) if rng.random() < 0.4 else body(rng, H, W)
    kind = int(rng.integers(0, 6))
    if kind <= 1:  # a facade: it goes on beyond the cut
        wall = colour(rng)
        image[:] = 0.25 * image + 0.75 * wall
        if rng.random() < 0.4:
            step = max(2, int(h * rng.uniform(0.03, 0.12)))
            for k in range(0, H, step):
                cv2.line(image, (0, k), (W, k), np.clip(wall * 0.8, 0, 255).tolist(), 1)
        rows, pitch = int(rng.integers(1, 4)), w / rng.uniform(2.5, 11)
        ww, wh = pitch * rng.uniform(0.35, 0.85), h / rows * rng.uniform(0.45, 0.85)
        glass = np.clip(wall * rng.uniform(0.15, 0.6) if rng.random() < 0.75 else wall * 1.6 + 40, 0, 255).astype(np.float32)
        frame = np.clip(wall * rng.uniform(0.7, 1.5) + rng.uniform(-20, 60), 0, 255).astype(np.float32)
        look = (int(rng.integers(1, 4)), int(rng.integers(1, 4)), rng.uniform(0.02, 0.12), bool(rng.random() < 0.4))
        skip = rng.random() < 0.3
        first = x - pitch * np.ceil(x / pitch) + rng.uniform(0, pitch)
        ends = rng.random() < 0.3
        for j in range(-1, rows + 1):
            for i in range(int(W / pitch) + 2):
                wx, wy = first + i * pitch, y + h * (j + 0.5) / rows - wh / 2
                if (skip and (i * 7 + j) % 4 == 0) or (ends and not x < wx < x + w - ww) or (ends and not 0 <= j < rows):
                    continue
                _window(rng, image, wx, wy, ww, wh, glass, frame, look)
    elif kind == 2:  # bottles, books, jars on a board
        at = x
        ground = colour(rng)
        cv2.rectangle(image, (0, round(y)), (W, round(y + h)), ground.tolist(), -1)
        while at < x + w:
            t, tall = w * rng.uniform(0.03, 0.14), h * rng.uniform(0.4, 0.95)
            col = colour(rng)
            cv2.rectangle(image, (round(at), round(y + h - tall)), (round(at + t * 0.85), round(y + h)), col.tolist(), -1, cv2.LINE_AA)
            if rng.random() < 0.5:
                cv2.rectangle(image, (round(at + 0.3 * t), round(y + h - tall * 1.2)), (round(at + 0.6 * t), round(y + h - tall)), col.tolist(), -1, cv2.LINE_AA)
            at += t * rng.uniform(1, 1.6)
    elif kind == 3:  # radio, panel: knobs, keys, a display
        ground, mark = colour(rng), colour(rng)
        cv2.rectangle(image, (round(x), round(y)), (round(x + w), round(y + h)), ground.tolist(), -1, cv2.LINE_AA)
        for k in (0.1, 0.9):
            r = h * rng.uniform(0.12, 0.4)
            cv2.circle(image, (round(x + k * w), round(y + h * rng.uniform(0.3, 0.7))), max(2, round(r)), colour(rng).tolist(), -1, cv2.LINE_AA)
            cv2.circle(image, (round(x + k * w), round(y + h / 2)), max(1, round(r * 0.6)), colour(rng).tolist(), max(1, round(r * 0.15)), cv2.LINE_AA)
        n = int(rng.integers(2, 9))
        for k in range(n):
            kx = x + w * (0.2 + 0.6 * (k + 0.2) / n)
            y0, y1 = sorted(rng.uniform(0.1, 0.95, 2)) if rng.random() < 0.2 else (0.3, 0.7)
            cv2.rectangle(image, (round(kx), round(y + h * y0)), (round(kx + 0.36 * w / n), round(y + h * y1)), mark.tolist(), -1 if rng.random() < 0.7 else 1, cv2.LINE_AA)
    elif kind == 4:  # lamps in the dark, reflections, glare: blobs without edges
        image *= rng.uniform(0.05, 0.4)
        glow = np.zeros((H, W), np.float32)
        for _ in range(int(rng.integers(1, 7))):
            c = (round(x + rng.uniform(0, 1) * w), round(y + rng.uniform(0.2, 0.8) * h))
            cv2.ellipse(glow, c, (max(1, round(w * rng.uniform(0.02, 0.35))), max(1, round(h * rng.uniform(0.1, 0.45)))), 0, 0, 360, float(rng.uniform(60, 350)), -1)
        image = np.ascontiguousarray(image + cv2.GaussianBlur(glow, (0, 0), max(0.8, h * rng.uniform(0.02, 0.25)))[..., None])
    else:  # a plain or blotched patch with an edge, a step, a kerb, a lid
        col = colour(rng)
        cv2.rectangle(image, (round(x), round(y)), (round(x + w), round(y + h)), col.tolist(), -1, cv2.LINE_AA)
        n = int(rng.integers(2, 30))
        rough = cv2.resize(rng.normal(0, 1, (max(2, n // 3), n)).astype(np.float32), (W, H), interpolation=cv2.INTER_CUBIC)
        image = np.ascontiguousarray(image + rough[..., None] * rng.uniform(3, 40))
        for _ in range(int(rng.integers(0, 8))):
            a, b = rng.uniform(0, 1, 2)
            cv2.rectangle(image, (round(x + a * w), round(y + b * h * 0.7)), (round(x + (a + rng.uniform(0.01, 0.2)) * w), round(y + h * (b * 0.7 + 0.3))), colour(rng).tolist(), -1)
    quad = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
    lean, tilt = rng.normal(0, 0.1), rng.normal(0, 0.1)
    matrix = np.array([[1, lean, -lean * H / 2], [tilt, 1, -tilt * W / 2]])
    image = cv2.warpAffine(np.clip(image, 0, 255), matrix, (W, H), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    quad = (apply_affine(matrix, quad) + 0.5) / ss - 0.5
    return make_sample(antique(rng, camera(rng, image, ss)), wrong_corners(rng, quad), "things", 0)


def drawn_negative(rng: Rng, world: World) -> Sample | None:
    """Lettering, signs, grilles, lamps, wheels, empty holders, tables: drawn, then seen by the camera."""
    width = plate_width(rng)
    ss = 3 if width < 90 else 2 if width < 220 else 1
    aspect = rng.uniform(1.4, 5.5)
    w, h = width * ss, width * ss / aspect
    W, H = int(w * 1.9) + 8, int(h + w * 0.7) + 8
    image = np.ascontiguousarray(world.patch(rng, H, W))
    font = random_font(rng, world.fonts)
    x, y = (W - w) / 2, (H - h) / 2
    ink, ground = colour(rng), colour(rng)
    if abs(float(ink.mean() - ground.mean())) < 50:
        ink = 255 - ground if rng.random() < 0.7 else ink
    kind = int(rng.integers(0, 12))

    def rect(x0: float, y0: float, x1: float, y1: float, col: NDArray[np.float32], fill: int = -1) -> None:
        cv2.rectangle(image, (round(x0), round(y0)), (round(x1), round(y1)), np.clip(col, 0, 255).tolist(), fill, cv2.LINE_AA)

    if kind <= 3:  # a board or bare lettering with words
        if kind != 0:
            rect(x, y, x + w, y + h, ground)
            if rng.random() < 0.5:
                e = 0.03 * h
                rect(x + e, y + e, x + w - e, y + h - e, ink, max(1, int(0.03 * h)))
        lines = int(rng.integers(1, 4)) if aspect < 3 else 1 + int(rng.random() < 0.2)
        for k in range(lines):
            text = words(rng, int(rng.integers(1, 4 if lines > 1 else 3)))[: int(rng.integers(3, 22))]
            lh = h * rng.uniform(0.4, 0.8) / lines
            lw = min(w * 0.92, lh * len(text) * rng.uniform(0.5, 0.9))
            put_text(rng, image, text, font, (x + (w - lw) * rng.uniform(0.2, 0.8), y + h * (k + 0.5) / lines - lh / 2, lw, lh), ink, rng.uniform(0.7, 0.95))
    elif kind == 4:  # grille, vent, shutters
        rect(x, y, x + w, y + h, ground)
        n = int(rng.integers(3, 24))
        for k in range(n):
            if rng.random() < 0.97 and aspect > 0:
                if kind == 4 and n % 2:
                    rect(x, y + h * k / n, x + w, y + h * (k + rng.uniform(0.3, 0.6)) / n, ink)
                else:
                    rect(x + w * k / n, y + 0.1 * h, x + w * (k + rng.uniform(0.3, 0.6)) / n, y + 0.9 * h, ink)
    elif kind == 5:  # lamp
        red = np.array([rng.uniform(10, 90), rng.uniform(10, 90), rng.uniform(120, 255)], np.float32) if rng.random() < 0.7 else colour(rng)
        rect(x, y, x + w, y + h, red)
        for _ in range(int(rng.integers(1, 6))):
            a, b = sorted(rng.uniform(0, 1, 2))
            rect(x + a * w, y + h * rng.uniform(0, 0.4), x + b * w, y + h * rng.uniform(0.5, 1), np.clip(red * rng.uniform(0.4, 2.5), 0, 255))
    elif kind == 6:  # wheel, badge, round sign
        c = (round(x + w / 2), round(y + h / 2))
        r = round(rng.uniform(0.4, 0.9) * h)
        cv2.circle(image, c, r, ground.tolist(), -1, cv2.LINE_AA)
        cv2.circle(image, c, round(r * rng.uniform(0.6, 0.9)), ink.tolist(), max(1, round(r * rng.uniform(0.05, 0.3))), cv2.LINE_AA)
        for k in range(int(rng.integers(0, 10))):
            a = k * 2 * np.pi / 9
            cv2.line(image, c, (round(c[0] + r * 0.8 * np.cos(a)), round(c[1] + r * 0.8 * np.sin(a))), ink.tolist(), max(1, r // 8), cv2.LINE_AA)
        if rng.random() < 0.5:
            put_text(rng, image, str(rng.choice(["30", "50", "70", "STOP", "P", "8"])), font, (c[0] - r * 0.5, c[1] - r * 0.35, r, r * 0.7), ink)
    elif kind == 7:  # an empty plate, or a plate-shaped label with a sentence
        rect(x, y, x + w, y + h, np.full(3, rng.uniform(130, 245), np.float32))
        if rng.random() < 0.5:
            rect(x, y, x + w, y + h, np.full(3, 25, np.float32), max(1, int(0.05 * h)))
        if rng.random() < 0.5:
            put_text(rng, image, words(rng, 2)[:24], font, (x + 0.1 * w, y + 0.75 * h, 0.8 * w, 0.16 * h), ink)
        if rng.random() < 0.3:
            rect(x, y, x + 0.08 * w, y + h, np.array([150, 60, 10], np.float32))
    elif kind == 8:  # windows, bricks, a fence
        n, m = int(rng.integers(2, 9)), int(rng.integers(1, 4))
        rect(x, y, x + w, y + h, ground)
        for i in range(n):
            for j in range(m):
                rect(x + w * (i + 0.15) / n, y + h * (j + 0.15) / m, x + w * (i + 0.85) / n, y + h * (j + 0.85) / m, np.clip(ink * rng.uniform(0.6, 1.3), 0, 255))
    elif kind == 9:  # a page of small print
        rect(x, y, x + w, y + h, ground)
        n = int(rng.integers(3, 8))
        for k in range(n):
            put_text(rng, image, words(rng, 6)[: int(rng.integers(10, 36))], font, (x + 0.05 * w, y + h * (k + 0.2) / n, 0.9 * w * rng.uniform(0.5, 1), h * 0.6 / n), ink)
    elif kind == 10:  # a big word of which the cut shows a part
        put_text(rng, image, words(rng, 2), font, (x - rng.uniform(0, 2) * w, y - 0.2 * h, w * rng.uniform(2, 4), h * 1.4), ink)
    else:  # a road sign with an arrow
        rect(x, y, x + w, y + h, [np.array([150, 80, 10]), np.array([60, 110, 20]), np.array([240, 240, 240])][int(rng.integers(3))].astype(np.float32))
        put_text(rng, image, words(rng, 1), font, (x + 0.1 * w, y + 0.3 * h, 0.55 * w, 0.4 * h), ink)
        cv2.arrowedLine(image, (round(x + 0.8 * w), round(y + 0.8 * h)), (round(x + 0.85 * w), round(y + 0.2 * h)), ink.tolist(), max(1, int(0.08 * h)), cv2.LINE_AA)
    quad = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
    shear = rng.normal(0, 0.05)
    matrix = np.array([[1, 0, 0], [shear, 1, -shear * W / 2]])
    image = cv2.warpAffine(image, matrix, (W, H), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    quad = apply_affine(matrix, quad)
    grey = camera(rng, image, ss)
    quad = (quad + 0.5) / ss - 0.5
    return make_sample(antique(rng, grey), wrong_corners(rng, quad), "drawn", 0)


def real_plate(rng: Rng, world: World) -> Sample | None:
    """A labelled plate of an in-car frame: only that it is one is known (its label is an upright box)."""
    if not world.frames:
        return None
    frame = world.frames[int(rng.integers(len(world.frames)))]
    if len(frame.boxes) == 0:
        return None
    x, y, w, h = frame.boxes[int(rng.integers(len(frame.boxes)))]
    box = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]], np.float64)
    grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
    if rng.random() < 0.3:
        return make_sample(grey, misplaced(rng, box), "real part", 0)
    return make_sample(grey, wrong_corners(rng, box), "real", 1)


def samples(rng: Rng, world: World) -> list[Sample]:
    """One draw of the training mixture: two views of a plate, or two others."""
    if rng.random() < 0.56:
        return plate_samples(rng, world)
    out: list[Sample | None] = []
    for _ in range(2):
        k = rng.random()
        if k < 0.08:
            out.append(real_plate(rng, world))
        elif k < 0.22:
            out.append(photo_negative(rng, world))
        elif k < 0.42:
            out.append(tempting_negative(rng, world))
        elif k < 0.50:
            out.append(facade_negative(rng, world))
        elif k < 0.74:
            out.append(lettering_negative(rng, world))
        elif k < 0.88:
            out.append(things_negative(rng, world))
        else:
            out.append(drawn_negative(rng, world))
    return [s for s in out if s is not None]
