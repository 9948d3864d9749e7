"""Upright things beside the road: trees, houses, posts and signs, each a painted card with its size in metres."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from tmde_edge.simulation.compose import Image, Texture, texture


@lru_cache(maxsize=64)
def card(kind: str, variant: int = 0, text: str = "") -> tuple[Texture, float, float]:
    """Picture, width and height in metres; it stands on the ground at the middle of its lower edge."""
    rng = np.random.default_rng((variant, len(kind), len(text)))
    if kind == "tree":
        return _tree(rng)
    if kind == "house":
        return _house(rng)
    if kind == "sign":
        return _sign(rng, variant, text)
    if kind == "board":
        return _board(rng, text)
    if kind == "lamp":
        return _post(0.16, 7.5, (120, 122, 124), arm=True)
    return _post(0.12, 1.0, (225, 228, 230), arm=False)


def _finish(bgr: Image, alpha: Image, width_m: float, height_m: float) -> tuple[Texture, float, float]:
    return texture(bgr, np.asarray(alpha / 255, np.float32)), width_m, height_m


def _tree(rng: np.random.Generator) -> tuple[Texture, float, float]:
    w, h = 320, 440
    bgr, alpha = np.zeros((h, w, 3), np.uint8), np.zeros((h, w), np.uint8)
    cv2.line(bgr, (w // 2, h), (w // 2 + 6, h // 2), (40, 52, 62), 16)
    cv2.line(alpha, (w // 2, h), (w // 2 + 6, h // 2), 255, 16)
    tone = np.array([38, 78, 62]) * rng.uniform(0.75, 1.2)
    for _ in range(420):
        a, r = rng.uniform(0, 2 * np.pi), np.sqrt(rng.random())
        x, y = w / 2 + 128 * r * np.cos(a), 160 + 140 * r * np.sin(a)
        size = int(rng.integers(9, 26))
        light = 0.65 + 0.55 * (1 - (y / 320)) + rng.normal(0, 0.10)
        cv2.circle(bgr, (int(x), int(y)), size, [float(c) for c in np.clip(tone * light, 0, 255)], -1)
        cv2.circle(alpha, (int(x), int(y)), size, 255.0, -1)
    size_m = rng.uniform(6.0, 10.0)
    return _finish(bgr, alpha, size_m * w / h, size_m)


def _house(rng: np.random.Generator) -> tuple[Texture, float, float]:
    w, h = 640, 480
    tone = np.array([150, 170, 185]) * rng.uniform(0.6, 1.15)
    bgr, alpha = np.zeros((h, w, 3), np.uint8), np.full((h, w), 255, np.uint8)
    bgr[:] = np.clip(tone, 0, 255)
    bgr[:70] = np.clip(np.array([60, 70, 110]) * rng.uniform(0.6, 1.1), 0, 255)
    for y in range(110, h - 110, 110):
        for x in range(40, w - 70, 95):
            cv2.rectangle(bgr, (x - 4, y - 4), (x + 54, y + 74), [float(c) for c in tone * 1.2], -1)
            cv2.rectangle(bgr, (x, y), (x + 50, y + 70), (70.0, 62.0, 56.0), -1)
            cv2.rectangle(bgr, (x, y), (x + 50, y + 30), (120.0, 112.0, 104.0), -1)
    cv2.rectangle(bgr, (280, h - 95), (350, h), (52.0, 60.0, 80.0), -1)
    size_m = rng.uniform(9.0, 14.0)
    return _finish(bgr, alpha, size_m * w / h, size_m)


def _sign(rng: np.random.Generator, variant: int, text: str) -> tuple[Texture, float, float]:
    w, h = 200, 800
    bgr, alpha = np.zeros((h, w, 3), np.uint8), np.zeros((h, w), np.uint8)
    cv2.rectangle(bgr, (95, 180), (105, h), (130.0, 132.0, 134.0), -1)
    cv2.rectangle(alpha, (95, 180), (105, h), 255.0, -1)
    if variant % 3 == 0:
        for r, c in ((98, (40, 40, 200)), (74, (238, 238, 238))):
            cv2.circle(bgr, (100, 100), r, c, -1, cv2.LINE_AA)
            cv2.circle(alpha, (100, 100), r, 255.0, -1, cv2.LINE_AA)
        cv2.putText(bgr, text or "50", (40, 128), cv2.FONT_HERSHEY_DUPLEX, 2.6, (20.0, 20.0, 20.0), 8, cv2.LINE_AA)
    elif variant % 3 == 1:
        points = np.array([[100, 6], [194, 176], [6, 176]])
        cv2.fillPoly(bgr, [points], (40.0, 40.0, 205.0))
        cv2.fillPoly(alpha, [points], 255.0)
        cv2.fillPoly(bgr, [np.array([[100, 48], [158, 156], [42, 156]])], (236.0, 238.0, 238.0))
        cv2.putText(bgr, "!", (86, 148), cv2.FONT_HERSHEY_DUPLEX, 2.6, (20.0, 20.0, 20.0), 8)
    else:
        cv2.rectangle(bgr, (4, 20), (196, 150), (160.0, 80.0, 20.0), -1)
        cv2.rectangle(alpha, (4, 20), (196, 150), 255.0, -1)
        cv2.putText(bgr, text or "P 200", (16, 105), cv2.FONT_HERSHEY_DUPLEX, 1.7, (240.0, 240.0, 240.0), 5, cv2.LINE_AA)
    return _finish(bgr, alpha, 0.7, 2.8)


def _board(rng: np.random.Generator, text: str) -> tuple[Texture, float, float]:
    """A large direction or shop board with lettering, on two posts."""
    w, h = 800, 700
    bgr, alpha = np.zeros((h, w, 3), np.uint8), np.zeros((h, w), np.uint8)
    for x in (120, 670):
        cv2.rectangle(bgr, (x, 200), (x + 14, h), (120.0, 122.0, 124.0), -1)
        cv2.rectangle(alpha, (x, 200), (x + 14, h), 255.0, -1)
    white = bool(rng.random() < 0.5)
    face, ink = ((235.0, 238.0, 238.0), (30.0, 30.0, 30.0)) if white else ((150.0, 70.0, 20.0), (240.0, 240.0, 240.0))
    cv2.rectangle(bgr, (0, 0), (w, 330), ink, -1)
    cv2.rectangle(bgr, (10, 10), (w - 10, 320), face, -1)
    cv2.rectangle(alpha, (0, 0), (w, 330), 255.0, -1)
    for k, line in enumerate((text or "AB 1234 KM|CENTRUM 3").split("|")[:2]):
        cv2.putText(bgr, line, (40, 135 + 140 * k), cv2.FONT_HERSHEY_DUPLEX, 3.0, ink, 9, cv2.LINE_AA)
    return _finish(bgr, alpha, 3.2, 2.8)


def _post(width_m: float, height_m: float, tone: tuple[int, int, int], arm: bool) -> tuple[Texture, float, float]:
    if not arm:
        bgr, alpha = np.full((100, 12, 3), tone, np.uint8), np.full((100, 12), 255, np.uint8)
        bgr[12:30] = (30, 30, 30)
        bgr[16:26, 3:9] = (60, 120, 250)
        return _finish(bgr, alpha, width_m, height_m)
    h, w = 600, 200
    bgr, alpha = np.full((h, w, 3), tone, np.uint8), np.zeros((h, w), np.uint8)
    cv2.rectangle(alpha, (96, 20), (104, h), 255.0, -1)
    cv2.line(alpha, (100, 22), (20, 8), 255.0, 6)
    cv2.rectangle(alpha, (4, 4), (40, 14), 255.0, -1)
    return _finish(bgr, alpha, height_m * w / h, height_m)
