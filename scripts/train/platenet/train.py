#!/usr/bin/env python3
"""Trains PlateNet on the shards of make_cache.py; resumable (--out holds last.pt), the rate follows the time (--minutes) or the steps (--steps).

usage: train.py --cache FOLDER... --out FOLDER (--minutes M | --steps N) [--init FILE.pt] [--peak 2e-3]
"""
from __future__ import annotations

import argparse
import copy
import json
import math
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent))
from net import STRIDES, UNITS_PX, PlateNet  # noqa: E402
from targets import batch_maps  # noqa: E402

BATCH = {256: 16, 384: 7}
SELF_IGNORE = 0.7  # unlabelled street cells scored above this neither punish nor reward: some second cars have no label


class Shards:
    """Batches of one side length from a pool of open shards; the folders are drawn from equally, new shards are found as they appear."""

    def __init__(self, folders: list[Path], side_px: int, rng: np.random.Generator, pool: int = 8) -> None:
        self.folders, self.side, self.rng, self.pool_size = folders, side_px, rng, pool
        self.queues: dict[Path, list[Path]] = {d: [] for d in folders}
        self.pool: list[tuple[NDArray[np.uint8], list, list[int]]] = []  # type: ignore[type-arg]

    def _refill(self) -> None:
        while len(self.pool) < self.pool_size:
            queue = self.queues[self.folders[int(self.rng.integers(len(self.folders)))]]
            if not queue:
                for d in self.folders:
                    if self.queues[d] is queue:
                        queue += sorted(d.glob(f"s*_{self.side}.npy"))
                self.rng.shuffle(queue)  # type: ignore[arg-type]
                if not queue:
                    raise FileNotFoundError(f"no shards of side {self.side} in one of {self.folders}")
            f = queue.pop()
            try:
                images, meta = np.load(f), json.loads(f.with_suffix(".json").read_text())
            except FileNotFoundError:
                continue
            self.pool.append((images, meta, list(self.rng.permutation(len(meta)))))

    def batch(self) -> tuple[NDArray[np.uint8], list[list], NDArray[np.bool_]]:  # type: ignore[type-arg]
        """(N,H,W,3) BGR, labels, street flags."""
        images, metas, street = [], [], []
        while len(images) < BATCH[self.side]:
            self._refill()
            k = int(self.rng.integers(len(self.pool)))
            pics, meta, order = self.pool[k]
            i = order.pop()
            if not order:
                self.pool.pop(k)
            images.append(pics[i])
            metas.append(meta[i][0])
            street.append(meta[i][1])
        return np.stack(images), metas, np.array(street)


def vary(images: NDArray[np.uint8], metas: list[list], side_px: int, rng: np.random.Generator) -> tuple[NDArray[np.uint8], list[list], int]:  # type: ignore[type-arg]
    """Another size for the whole batch, and half of the patches mirrored, so that a shard can be used several times."""
    new = int(rng.choice(np.arange(side_px * 3 // 4, side_px * 9 // 8 + 1, 32)))
    k = new / side_px
    out, labels = np.empty((len(images), new, new, 3), np.uint8), []
    for i, (image, meta) in enumerate(zip(images, metas, strict=True)):
        if k != 1:
            image = cv2.resize(image, (new, new), interpolation=cv2.INTER_AREA if k < 1 else cv2.INTER_LINEAR)
        mirror = rng.random() < 0.5
        out[i] = image[:, ::-1] if mirror else image
        lab = []
        for corners, weight, kind in meta:
            q = (np.asarray(corners) + 0.5) * k - 0.5
            if mirror:
                q[:, 0] = new - 1 - q[:, 0]
                q = q[[1, 0, 3, 2]]
            lab.append((q, weight, kind if np.ptp(q[:, 0]) >= 6.5 else 1))
        labels.append(lab)
    return out, labels, new


def head_loss(out: Tensor, maps: list[NDArray[np.float32]], unit_px: float, street: Tensor, trust: bool) -> tuple[Tensor, Tensor, float]:
    """Penalty-reduced focal loss (CenterNet, eq. 1) and size-normalised smooth L1 of the corners; sums, and the number of plates."""
    heat, keep, offsets, weight, size = (torch.from_numpy(m) for m in maps)
    out = out.float()
    logit = out[:, 0]
    p = torch.sigmoid(logit)
    pos = (heat >= 0.999).float() * keep
    neg_weight = keep * (1 - heat) ** 4
    unsure = street[:, None, None] & (heat < 0.05)
    if trust:
        neg_weight = neg_weight * (1 - (unsure & (p.detach() > SELF_IGNORE)).float())
    else:
        neg_weight = neg_weight * (1 - 0.7 * unsure.float())
    focal = -(pos * (1 - p) ** 2 * F.logsigmoid(logit)).sum() - (neg_weight * (1 - pos) * p**2 * F.logsigmoid(-logit)).sum()
    scale = (unit_px / size).repeat(1, 4, 1, 1)
    err = F.smooth_l1_loss(out[:, 1:] * scale, offsets * scale, reduction="none", beta=0.05).clamp(max=3.0)
    corner = (err.mean(1) * weight).sum() / weight.sum().clamp(min=1.0)
    return focal, corner, float(pos.sum())


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--cache", type=Path, nargs="+", required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--minutes", type=float)
    p.add_argument("--steps", type=int)
    p.add_argument("--init", type=Path)
    p.add_argument("--peak", type=float, default=2e-3)
    p.add_argument("--corner", type=float, default=9.0, help="weight of the corners' loss")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--threads", type=int, default=1)
    a = p.parse_args()
    if (a.minutes is None) == (a.steps is None):
        p.error("give --minutes or --steps")
    torch.set_num_threads(a.threads)
    cv2.setNumThreads(1)
    torch.manual_seed(a.seed)
    a.out.mkdir(parents=True, exist_ok=True)
    net = PlateNet()
    if a.init:
        net.load_state_dict(torch.load(a.init, weights_only=True)["ema"])
    net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    decay = [w for w in net.parameters() if w.ndim > 1]
    rest = [w for w in net.parameters() if w.ndim <= 1]
    opt = torch.optim.AdamW([{"params": decay, "weight_decay": 0.02}, {"params": rest, "weight_decay": 0.0}], lr=a.peak)
    ema = copy.deepcopy(net).eval()
    step, spent_s = 0, 0.0
    last = a.out / "last.pt"
    if last.exists():
        saved = torch.load(last, weights_only=True)
        net.load_state_dict(saved["net"])
        ema.load_state_dict(saved["ema"])
        opt.load_state_dict(saved["opt"])
        step, spent_s = saved["step"], saved["spent_s"]
        print(f"going on at step {step}, {spent_s / 60:.1f} min", flush=True)
    rng = np.random.default_rng((a.seed, step))
    data = {side: Shards(a.cache, side, rng) for side in BATCH}
    sums, since, t_mark = np.zeros(5), 0, time.perf_counter()

    def save() -> None:
        torch.save({"net": net.state_dict(), "ema": ema.state_dict(), "opt": opt.state_dict(), "step": step, "spent_s": spent_s}, last.with_suffix(".tmp"))
        last.with_suffix(".tmp").replace(last)

    net.train()
    while True:
        t0 = time.perf_counter()
        done = step / a.steps if a.steps else spent_s / 60 / a.minutes
        if done >= 1:
            break
        rate = a.peak * (0.5 * (1 + math.cos(math.pi * done)) * 0.99 + 0.01) * min(1.0, (step + 1) / 200)
        for g in opt.param_groups:
            g["lr"] = rate
        side = 384 if rng.random() < 0.2 else 256
        images, metas, street = data[side].batch()
        images, metas, side = vary(images, metas, side, rng)
        gain = rng.uniform(0.75, 1.25, (len(images), 1, 1, 1)) * rng.uniform(0.93, 1.07, (len(images), 1, 1, 3))
        x = torch.from_numpy(images).float() * torch.from_numpy(gain / 255).float()
        x = x.clamp_(0, 1).permute(0, 3, 1, 2)  # channels last in memory
        with torch.autocast("cpu", dtype=torch.bfloat16):
            outs = net(x)
        loss = torch.zeros(())
        for head, out in enumerate(outs):
            focal, corner, n = head_loss(out, batch_maps(metas, side, head), UNITS_PX[head], torch.from_numpy(street), step > 1500 or a.init is not None)
            n = max(n, len(images) / len(STRIDES) / 2)
            loss = loss + focal / n + a.corner * corner
            sums[head] += focal.item() / n
            sums[2 + head] += corner.item()
        opt.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), 10.0)
        if not math.isfinite(float(norm)):
            print(f"step {step}: gradient {norm}, left out", flush=True)
            continue
        opt.step()
        step += 1
        since += 1
        keep = min(0.999, (step + 1) / (step + 20))
        with torch.no_grad():
            for e, w in zip(ema.state_dict().values(), net.state_dict().values(), strict=True):
                if e.dtype.is_floating_point:
                    e.lerp_(w, 1 - keep)
                else:
                    e.copy_(w)
        spent_s += time.perf_counter() - t0
        if step % 100 == 0:
            s = sums / since
            print(f"{step} {spent_s / 60:.1f} min {since / (time.perf_counter() - t_mark):.2f} steps/s  score {s[0]:.3f} {s[1]:.3f}  corners {s[2]:.4f} {s[3]:.4f}  rate {rate:.1e}", flush=True)
            sums[:], since, t_mark = 0, 0, time.perf_counter()
        if step % 500 == 0:
            save()
    save()
    print("done", flush=True)


if __name__ == "__main__":
    main()
