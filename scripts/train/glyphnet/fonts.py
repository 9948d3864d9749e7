"""Fonts for training: cached ink masks of font files (Pillow) and of our own stroke font, stretched to any ink box."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from tmde_edge.simulation.stroke_font import StrokeFont

MASK_H_PX = 64
_FAMILIES = (
    "roadgeek|opendin|osifont|bebas|f500|yanone|dejavu|liberation|roboto|open-sans|lato|cantarell|oxygen|inter|hack|"
    "firacode|jetbrains|league|play|dosis|b612|cabin|karla|clear-sans|ocr-|freefont|ubuntu-title|adf|urw-base35|"
    "routed|jura|tuffy|paratype|manrope|millimetre|national-park|noto/NotoSans-|noto/NotoSansMono|quicksand|mononoki|inconsolata"
)
_REFUSED = (
    "italic|oblique|thin|hairline|extralight|symbol|dingbat|emoji|icon|math|braille|chancery|script|standardsym|"
    "light|f500|OCRBE|PTF|PTS56|PTS76|UbuntuTitle|wide-extrabold|tamil|cabinsketch|z003|d050|serif|roman|bookman|schola|accanthis|baskervald|oldania|romande|irianis|mekanus|verana|tribun"
)
HELD_OUT = "osifont|Inter-|RobotoCondensed|LiberationMono|NationalPark|FreeSansBold"  # never in training


def font_files(held_out: bool) -> list[Path]:
    """Installed upright sans and mono font files, for training or (held_out) for judging."""
    out = []
    for file in sorted(Path("/usr/share/fonts").rglob("*")):
        name = str(file)
        if file.suffix.lower() not in {".ttf", ".otf"} or not re.search(_FAMILIES, name) or re.search(_REFUSED, name, re.I):
            continue
        if bool(re.search(HELD_OUT, name)) == held_out:
            out.append(file)
    return out


def sign_fonts() -> list[Path]:
    """Any installed Latin font file, for lettering on signs: serifs, italics and fat ones too."""
    files = [f for f in sorted(Path("/usr/share/fonts").rglob("*")) if f.suffix.lower() in {".ttf", ".otf"}]
    refused = "symbol|dingbat|emoji|icon|math|braille|standardsym|d050|nanum|wqy|ipa|noto/NotoSans[A-Z]|noto/NotoSerif[A-Z]|thin|hairline"
    return [f for f in files if not re.search(refused, str(f), re.I)]


@lru_cache(maxsize=60000)
def _file_mask(file: str, char: str) -> NDArray[np.uint8] | None:
    font = _open(file)
    box = font.getbbox(char)
    if box is None or box[2] <= box[0] or box[3] <= box[1]:
        return None
    image = Image.new("L", (box[2] - box[0] + 8, box[3] - box[1] + 8), 0)
    ImageDraw.Draw(image).text((4 - box[0], 4 - box[1]), char, fill=255, font=font)
    mask = np.asarray(image)
    rows, cols = np.flatnonzero(mask.max(axis=1) > 127), np.flatnonzero(mask.max(axis=0) > 127)
    if len(rows) == 0:
        return None
    return np.ascontiguousarray(mask[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1])


@lru_cache(maxsize=2000)
def _open(file: str) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(file, 130)


@lru_cache(maxsize=60000)
def _stroke_mask(char: str, roundness: float, aspect: float, stroke_share: float) -> NDArray[np.uint8]:
    width = max(3.0, MASK_H_PX * aspect)
    cols = round(width)
    cover = StrokeFont(roundness=roundness).coverage(
        char, width_mm=float(cols), height_mm=float(MASK_H_PX), stroke_mm=stroke_share * MASK_H_PX,
        x_mm=np.arange(cols) + 0.5, y_mm=np.arange(MASK_H_PX) + 0.5, px_per_mm=1.0,
    )
    return np.rint(cover * 255).astype(np.uint8)


class MaskFont:
    """A GlyphFont for training; file None: our stroke font of the given roundness."""

    def __init__(self, file: Path | None, roundness: float = 0.8) -> None:
        self.file = str(file) if file else None
        self.roundness = round(roundness, 1)

    def supports(self, char: str) -> bool:
        """All: what the file lacks, the stroke font draws."""
        return True

    def coverage(
        self, char: str, *, width_mm: float, height_mm: float, stroke_mm: float, x_mm: NDArray[np.float64],
        y_mm: NDArray[np.float64], px_per_mm: float,
    ) -> NDArray[np.float32]:
        """Ink coverage at pixel centres; the ink box is filled exactly."""
        mask = None
        if self.file and char.isascii() and char not in "I|-.":
            mask = _file_mask(self.file, char)
        if mask is None:
            aspect = round(16 * width_mm / height_mm) / 16
            mask = _stroke_mask(char, self.roundness, max(aspect, 1 / 16), round(max(32 * stroke_mm / height_mm, 2)) / 32)
        shape = (len(y_mm), len(x_mm))
        if min(shape) == 0:
            return np.zeros(shape, np.float32)
        rows, cols = mask.shape
        target_w, target_h = width_mm * px_per_mm, height_mm * px_per_mm
        fx, fy = max(1.0, cols / max(target_w, 0.5)), max(1.0, rows / max(target_h, 0.5))
        if fx > 1.5 or fy > 1.5:  # average over areas before shrinking
            small = (max(1, round(cols / fx)), max(1, round(rows / fy)))
            mask = cv2.resize(mask, small, interpolation=cv2.INTER_AREA)
            rows, cols = mask.shape
        padded = cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
        sx, sy = target_w / cols, target_h / rows  # output pixels per mask pixel
        tx, ty = -x_mm[0] * px_per_mm, -y_mm[0] * px_per_mm  # output pixel coordinates of the ink box's corner
        matrix = np.array([[sx, 0, tx - 0.5 * sx], [0, sy, ty - 0.5 * sy]])
        out = cv2.warpAffine(padded, matrix, (shape[1], shape[0]), flags=cv2.INTER_LINEAR)
        return out.astype(np.float32) / 255.0


def random_font(rng: np.random.Generator, files: list[Path]) -> MaskFont:
    """A font file mostly, our stroke font in a third of all plates."""
    if rng.random() < 0.35 or not files:
        return MaskFont(None, float(rng.choice([0.3, 0.7, 1.0])))
    return MaskFont(files[int(rng.integers(len(files)))], float(rng.choice([0.3, 0.7])))
