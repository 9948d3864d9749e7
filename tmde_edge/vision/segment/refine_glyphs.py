"""Second look at each character: an upright patch round its box, in which a tiny network places the ink's four edges."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.segment.glyph_decode import Glyph, GlyphReading

Array = NDArray[np.float64]
PATCH_W_PX, PATCH_H_PX = 40, 48
GLYPH_H_PX = 30.0  # the box's height on the patch; the rest is margin
_LAPLACE_SD = float(np.sqrt(2.0))
_MIN_HEIGHT_PX = 1.5  # source


def patch_frame(glyph: Glyph) -> Array | None:
    """Affine map (2, 3), source from patch pixels: the box upright, centred, equal scale both ways; None if too small."""
    down = (glyph.bottom_px - glyph.top_px) / GLYPH_H_PX
    scale = float(np.hypot(*down))
    along = glyph.right_px - glyph.left_px
    length = float(np.hypot(*along))
    if scale * GLYPH_H_PX < _MIN_HEIGHT_PX or length < 1e-3:
        return None
    right = along / length * scale
    if abs(right[0] * down[1] - right[1] * down[0]) < 0.2 * scale * scale:
        return None
    centre = (glyph.left_px + glyph.right_px + glyph.top_px + glyph.bottom_px) / 4
    linear = np.column_stack([right, down])
    middle = np.array([(PATCH_W_PX - 1) / 2, (PATCH_H_PX - 1) / 2])
    return np.column_stack([linear, centre - linear @ middle])


def cut_patch(grey: NDArray[np.uint8], source_from_patch: Array) -> NDArray[np.uint8]:
    """The patch (PATCH_H_PX, PATCH_W_PX); averaged over areas first where the source is finer than the patch."""
    edge = np.array([[-2.0, -2.0], [PATCH_W_PX + 1, -2.0], [PATCH_W_PX + 1, PATCH_H_PX + 1], [-2.0, PATCH_H_PX + 1]])
    seen = edge @ source_from_patch[:, :2].T + source_from_patch[:, 2]
    height, width = grey.shape[:2]
    low = np.clip(np.floor(seen.min(axis=0)).astype(int), 0, [width - 1, height - 1])
    high = np.clip(np.ceil(seen.max(axis=0)).astype(int) + 1, low + 1, [width, height])
    part: NDArray[np.uint8] = grey[low[1] : high[1], low[0] : high[0]]
    step = float(np.hypot(*source_from_patch[:, 1]))
    scale = np.ones(2)
    if step > 1.2:
        size = np.maximum(np.rint((high - low) / step).astype(int), 1)
        scale = size / (high - low)
        part = cv2.resize(part, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    # source s lies at (s - low + 0.5) * scale - 0.5 in the part
    part_from_patch = (source_from_patch - np.column_stack([np.zeros((2, 2)), low - 0.5 + 0.5 / scale])) * scale[:, None]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(part, part_from_patch, (PATCH_W_PX, PATCH_H_PX), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return patch.astype(np.uint8, copy=False)


def normalise_patches(patches: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Network input (n, 1, H, W) float32: mean 0, spread 1 each."""
    x = patches.astype(np.float32)
    mean = x.mean(axis=(1, 2), keepdims=True)
    out: NDArray[np.float32] = (x - mean) / (x.std(axis=(1, 2), keepdims=True) + 4.0)
    return out[:, None]


def scale_input(frames: list[Array]) -> NDArray[np.float32]:
    """Network input (n, 1): logarithm of source pixels per patch pixel."""
    return np.array([[np.log(np.hypot(*frame[:, 1]))] for frame in frames], np.float32)


def move_edges(glyph: Glyph, frame: Array, offsets: NDArray[np.float32], log_sigma: NDArray[np.float32]) -> Glyph:
    """The glyph with its edges where the network saw them: offsets (4,) left, right, top, bottom in patch px from the box.

    Raises ValueError where an output is not finite.
    """
    if not (np.isfinite(offsets).all() and np.isfinite(log_sigma).all()):
        raise ValueError("the network's output is not finite")
    inverse = np.linalg.inv(frame[:, :2])
    left, right = (inverse @ (p - frame[:, 2]) for p in (glyph.left_px, glyph.right_px))
    top, bottom = (inverse @ (p - frame[:, 2]) for p in (glyph.top_px, glyph.bottom_px))
    x0, x1 = left[0] + float(offsets[0]), right[0] + float(offsets[1])
    y0, y1 = top[1] + float(offsets[2]), bottom[1] + float(offsets[3])
    xm, ym = (x0 + x1) / 2, (y0 + y1) / 2
    points = np.array([[x0, ym], [x1, ym], [xm, y0], [xm, y1]]) @ frame[:, :2].T + frame[:, 2]
    sigma = _LAPLACE_SD * np.exp(np.clip(log_sigma.astype(np.float64), -6.0, 4.0)) * float(np.hypot(*frame[:, 1]))
    return replace(
        glyph, left_px=points[0], right_px=points[1], top_px=points[2], bottom_px=points[3],
        sigma_lr_px=float(np.sqrt(np.mean(sigma[:2] ** 2))), sigma_tb_px=float(np.sqrt(np.mean(sigma[2:] ** 2))),
    )  # fmt: skip


def with_glyphs(reading: GlyphReading, glyphs: tuple[Glyph, ...]) -> GlyphReading:
    """The same reading with other glyphs."""
    return replace(reading, glyphs=glyphs)
