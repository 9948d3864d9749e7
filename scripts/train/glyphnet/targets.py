"""Targets and losses of GlyphNet, and light changes of grey values made anew in every pass over the data."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from net import COLS, ROWS, SCALE_PX, STRIDE_X, STRIDE_Y
from torch import Tensor


def cell_centres() -> tuple[Tensor, Tensor]:
    """Canvas px of the glyph map's cells: x (COLS,), y (ROWS,). The two columns of a pair share a stride-4 cell."""
    return (torch.arange(COLS) + 0.5) * STRIDE_X - 0.5, (torch.arange(ROWS) + 0.5) * STRIDE_Y - 0.5


CX, CY = cell_centres()


def glyph_targets(glyphs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """glyphs (n, m, 7) canvas px with NaN rows -> heat (n, R, C), boxes (n, 5, R, C): small, l, r, t, b; weight (n, R, C)."""
    g = glyphs[:, :, None, None, :]
    valid = ~torch.isnan(g[..., 0])
    g = torch.nan_to_num(g, nan=-1e4)
    x, y = CX[None, None, None, :], CY[None, None, :, None]
    half_w, half_h = ((g[..., 3] - g[..., 2]) / 2).clamp(min=1.0), ((g[..., 5] - g[..., 4]) / 2).clamp(min=2.0)
    sx, sy = (0.30 * half_w).clamp(1.1, 2.6), (0.28 * half_h).clamp(1.6, 3.2)
    d = torch.exp(-0.5 * (((x - g[..., 0]) / sx) ** 2 + ((y - g[..., 1]) / sy) ** 2)) * valid  # (n, m, R, C)
    heat, owner = d.max(dim=1)
    # the cell nearest to each centre is exactly 1
    col = ((g[..., 0] + 0.5) / STRIDE_X - 0.5).round().clamp(0, COLS - 1)
    row = ((g[..., 1] + 0.5) / STRIDE_Y - 0.5).round().clamp(0, ROWS - 1)
    peak = (torch.arange(COLS)[None, None, None, :] == col) & (torch.arange(ROWS)[None, None, :, None] == row) & valid
    heat = torch.where(peak.any(dim=1), torch.ones_like(heat), heat)

    def take(values: Tensor) -> Tensor:
        full = values.expand(-1, -1, ROWS, COLS)
        return full.gather(1, owner[:, None])[:, 0]

    left, right, top, bottom, small = (take(g[..., k]) for k in (2, 3, 4, 5, 6))
    boxes = torch.stack([small, (CX - left) / SCALE_PX, (right - CX) / SCALE_PX, (CY[:, None] - top) / SCALE_PX, (bottom - CY[:, None]) / SCALE_PX], dim=1)
    weight = torch.where(heat > 0.25, heat, torch.zeros_like(heat))
    return heat, boxes, weight


def losses(out: tuple[Tensor, Tensor, Tensor], batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weighted parts of the loss; sum them."""
    glyph, corners, judge = out
    known = ~torch.isnan(batch["corners"][:, 0, 0])  # rendered plates
    plate = batch["plate"].float()
    heat, boxes, weight = glyph_targets(batch["glyphs"])
    logit = glyph[:, 0]
    p = torch.sigmoid(logit).clamp(1e-5, 1 - 1e-5)
    positive = heat > 0.999
    focal = torch.where(positive, -((1 - p) ** 2) * torch.log(p), -((1 - heat) ** 4) * p**2 * torch.log(1 - p))
    # on real plates the characters are there but unlabelled; on non-plates lettering may be there: weak push to nothing
    share = known.float() + 0.1 * (plate == 0).float()
    count = positive.sum().clamp(min=1)
    wsum = (weight * known[:, None, None]).sum().clamp(min=1)
    w = weight * known[:, None, None]
    box = (F.smooth_l1_loss(glyph[:, 2:], boxes[:, 1:], reduction="none", beta=0.05).sum(dim=1) * w).sum() / wsum
    small = (F.binary_cross_entropy_with_logits(glyph[:, 1], boxes[:, 0].clamp(0, 1), reduction="none") * w).sum() / wsum
    target = torch.nan_to_num(batch["corners"], nan=0.0)
    error = (corners - target).abs().sum(dim=2)  # (n, 4) canvas px
    log_sigma = judge[:, :4].clamp(-3, 4)
    nll = error.detach() * torch.exp(-log_sigma) + 2 * log_sigma
    k = known.float()[:, None]
    corner = (F.smooth_l1_loss(corners, target, reduction="none", beta=0.5).sum(dim=2) * k).sum() / (4 * k.sum()).clamp(min=1)
    sigma = (nll * k).sum() / (4 * k.sum()).clamp(min=1)
    light_known = (batch["light"] >= 0).float()
    light = (F.binary_cross_entropy_with_logits(judge[:, 5], batch["light"].clamp(min=0).float(), reduction="none") * light_known).sum() / light_known.sum().clamp(min=1)
    truth = F.binary_cross_entropy_with_logits(judge[:, 4], plate)
    return {
        "heat": (focal * share[:, None, None]).sum() / count, "box": 1.5 * box, "small": 0.3 * small, "corner": 0.25 * corner,
        "sigma": 0.05 * sigma, "light": 0.2 * light, "plate": 1.0 * truth,
    }


def jitter(canvas: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Grey changes that move nothing: contrast, tone curve, noise, inverted tones never."""
    x = canvas.astype(np.float32)
    n = len(x)
    gain, bias = rng.uniform(0.75, 1.25, (n, 1, 1)), rng.uniform(-15, 15, (n, 1, 1))
    x = 255 * (np.clip(x, 0, 255) / 255) ** np.exp(rng.normal(0, 0.15, (n, 1, 1))).astype(np.float32)
    x = x * gain + bias + rng.normal(0, 1, x.shape) * np.abs(rng.normal(0, 2.0, (n, 1, 1)))
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)
