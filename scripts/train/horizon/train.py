#!/usr/bin/env python3
"""Trains HorizonNet on the shards of generate.py; resumable (OUT/last.pt), the rate follows the time. New shards are picked up as they appear.

Every picture is cropped anew each time: scale, shift, turn, mirror, light, blur, noise, covered parts, a bonnet.

usage: train.py CACHE --out FOLDER --minutes M [--real 0.2]
"""
from __future__ import annotations

import argparse
import copy
import math
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))
from net import HEIGHT, OFFSETS_PX, SLOPES, WIDTH, HorizonNet  # noqa: E402

BATCH = 48
Image = NDArray[np.uint8]


class Cache:
    """All pictures of a folder; `real` ones are drawn with their own share."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.known: set[str] = set()
        self.made: list[tuple[Image, NDArray[np.float32], float]] = []
        self.real: list[tuple[Image, NDArray[np.float32], float]] = []
        self.refresh()

    def refresh(self) -> None:
        for f in sorted(self.folder.glob("*.npz")):
            if f.name in self.known or f.name.startswith("part-"):
                continue
            with np.load(f) as data:
                images, lines, sigmas = data["images"], data["line"], data["sigma"]
            self.known.add(f.name)
            (self.real if f.name.startswith("real") else self.made).extend(zip(images, lines, map(float, sigmas), strict=True))


def crop(image: Image, line: NDArray[np.float32], sigma: float, rng: np.random.Generator) -> tuple[Image, float, float, float]:
    """A random crop of WIDTH x HEIGHT: picture, offset of its horizon below the middle row, slope, sigma of the offset (net pixels)."""
    h, w = image.shape
    zoom = float(np.exp(rng.uniform(np.log(0.5), np.log(1.15))))  # net pixels per picture pixel
    turn = float(rng.normal(0, 0.02))
    c, s = zoom * math.cos(turn), zoom * math.sin(turn)
    offset = float(np.clip(rng.normal(0, 9.0), -28, 28)) if rng.random() < 0.7 else float(rng.uniform(-28, 28))
    x0 = (w - 1) / 2 + float(rng.normal(0, 0.12)) * w
    row, slope = float(line[0]) + float(line[1]) * (x0 - (w - 1) / 2), float(line[1])
    # the horizon's point (x0, row) comes to (middle, middle + offset)
    a = np.array([[c, -s, 0.0], [s, c, 0.0]])
    a[:, 2] = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2 + offset]) - a[:, :2] @ np.array([x0, row])
    if zoom < 0.7:
        image = cv2.GaussianBlur(image, (0, 0), 0.45 / zoom)
    out = cv2.warpAffine(image, a, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    direction = a[:, :2] @ np.array([1.0, slope])
    slope = float(direction[1] / direction[0])
    if rng.random() < 0.5:
        out, slope = out[:, ::-1], -slope
    return out, offset, slope, sigma * zoom


def spoil(image: Image, rng: np.random.Generator) -> NDArray[np.float32]:
    """Light, contrast, blur, noise, covered parts and a bonnet."""
    x = image.astype(np.float32) / 255.0
    x = np.clip(x, 0, 1) ** np.float32(np.exp(rng.normal(0, 0.35)))
    x = (x - 0.5) * np.float32(rng.uniform(0.55, 1.35)) + 0.5 + np.float32(rng.normal(0, 0.1))
    if rng.random() < 0.3:  # light from one side, or a band of glare
        ramp = np.linspace(-0.5, 0.5, WIDTH, dtype=np.float32) * np.float32(rng.normal(0, 0.4))
        x = x + ramp[None, :]
    if rng.random() < 0.3:
        x = x + np.linspace(-0.5, 0.5, HEIGHT, dtype=np.float32)[:, None] * np.float32(rng.normal(0, 0.4))
    for _ in range(int(rng.integers(0, 4)) if rng.random() < 0.6 else 0):  # vehicles, walls, poles: whatever hides a part
        bw, bh = int(rng.integers(6, 60)), int(rng.integers(6, 50))
        bx, by = int(rng.integers(-10, WIDTH - 5)), int(rng.integers(-10, HEIGHT - 5))
        tone = rng.uniform(0, 1)
        x[max(by, 0) : by + bh, max(bx, 0) : bx + bw] = tone + rng.normal(0, 0.08, x[max(by, 0) : by + bh, max(bx, 0) : bx + bw].shape)
    if rng.random() < 0.2:
        depth = rng.uniform(4, 18)
        edge = HEIGHT - depth * (1 - ((np.arange(WIDTH) - WIDTH / 2 + rng.normal(0, 10)) / (0.7 * WIDTH)) ** 2)
        x[np.arange(HEIGHT)[:, None] > edge[None, :]] = rng.uniform(0, 0.6)
    if rng.random() < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.4, 1.4)))
    x = x + rng.normal(0, rng.uniform(0.0, 0.05), x.shape)
    return np.clip(x, 0, 1).astype(np.float32)


def soft(values: torch.Tensor, centres: torch.Tensor, sigma: torch.Tensor) -> torch.Tensor:
    """A normal distribution over the bins."""
    p = torch.exp(-0.5 * ((values[:, None] - centres[None]) / sigma[:, None]) ** 2)
    return p / p.sum(1, keepdim=True).clamp(min=1e-9)


def decoded(logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Offset and slope, each with its sigma: mean and standard deviation of their distributions."""
    out = []
    for part, centres in ((logits[:, : len(OFFSETS_PX)], OFFSETS_PX), (logits[:, len(OFFSETS_PX) :], SLOPES)):
        p = part.float().softmax(1)
        mean = (p * centres).sum(1)
        out += [mean, (p * (centres[None] - mean[:, None]) ** 2).sum(1).sqrt()]
    return out[0], out[1], out[2], out[3]


def batch(cache: Cache, rng: np.random.Generator, count: int, real: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    images, offsets, slopes, sigmas = [], [], [], []
    for _ in range(count):
        pool = cache.real if cache.real and rng.random() < real else cache.made
        image, line, sigma = pool[int(rng.integers(len(pool)))]
        out, offset, slope, spread = crop(image, line, sigma, rng)
        images.append(spoil(out, rng))
        offsets.append(offset)
        slopes.append(slope)
        sigmas.append(max(spread, 0.6))
    return torch.from_numpy(np.stack(images))[:, None], torch.tensor(offsets), torch.tensor(slopes), torch.tensor(sigmas)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("cache", type=Path)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--minutes", type=float, required=True)
    p.add_argument("--real", type=float, default=0.2)
    p.add_argument("--peak", type=float, default=2e-3)
    p.add_argument("--seed", type=int, default=0)
    a = p.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.manual_seed(a.seed)
    a.out.mkdir(parents=True, exist_ok=True)
    net = HorizonNet().to(memory_format=torch.channels_last)
    ema = copy.deepcopy(net).eval()
    opt = torch.optim.AdamW(net.parameters(), lr=a.peak, weight_decay=0.02)
    step, spent_s, last = 0, 0.0, a.out / "last.pt"
    if last.exists():
        saved = torch.load(last, weights_only=True)
        net.load_state_dict(saved["net"])
        ema.load_state_dict(saved["ema"])
        opt.load_state_dict(saved["opt"])
        step, spent_s = saved["step"], saved["spent_s"]
    rng = np.random.default_rng((a.seed, step))
    cache = Cache(a.cache)
    net.train()
    sums = np.zeros(4)
    while spent_s < a.minutes * 60:
        start = time.process_time()
        done = spent_s / 60 / a.minutes
        for g in opt.param_groups:
            g["lr"] = a.peak * (0.5 * (1 + math.cos(math.pi * done)) * 0.99 + 0.01) * min(1.0, (step + 1) / 200)
        images, offsets, slopes, sigmas = batch(cache, rng, BATCH, a.real)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            logits = net(images.contiguous(memory_format=torch.channels_last)).float()
        n = len(OFFSETS_PX)
        loss = -(soft(offsets, OFFSETS_PX, sigmas) * F.log_softmax(logits[:, :n], 1)).sum(1).mean()
        loss = loss - 0.5 * (soft(slopes, SLOPES, torch.full_like(slopes, 0.012)) * F.log_softmax(logits[:, n:], 1)).sum(1).mean()
        opt.zero_grad(set_to_none=True)
        loss.backward()
        if math.isfinite(float(torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0))):
            opt.step()
        step += 1
        keep = min(0.998, (step + 1) / (step + 20))
        with torch.no_grad():
            for e, w in zip(ema.state_dict().values(), net.state_dict().values(), strict=True):
                e.lerp_(w, 1 - keep) if e.dtype.is_floating_point else e.copy_(w)
            mean, _, slope, _ = decoded(logits)
            sums += [float(loss), float((mean - offsets).abs().median()), float((slope - slopes).abs().median()), 1]
        spent_s += time.process_time() - start
        if step % 100 == 0:
            s = sums / sums[3]
            print(f"{step} {spent_s / 60:.1f} min  loss {s[0]:.3f}  offset {s[1]:.2f} px  slope {s[2]:.4f}  {len(cache.made)} + {len(cache.real)} pictures", flush=True)
            sums[:] = 0
            cache.refresh()
        if step % 500 == 0:
            torch.save({"net": net.state_dict(), "ema": ema.state_dict(), "opt": opt.state_dict(), "step": step, "spent_s": spent_s}, last)
    torch.save({"net": net.state_dict(), "ema": ema.state_dict(), "opt": opt.state_dict(), "step": step, "spent_s": spent_s}, last)


if __name__ == "__main__":
    main()
