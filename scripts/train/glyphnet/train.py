"""Trains GlyphNet on shards. usage: train.py SHARDS --out FOLDER [--steps 4000] [--seed 1]; goes on where it stopped."""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from net import GlyphNet, start_from
from targets import jitter, losses

from tmde_edge.vision.segment.glyph_crop import normalise


def load(files: list[Path]) -> dict[str, np.ndarray]:
    """Some shards' arrays together."""
    parts: dict[str, list[np.ndarray]] = {k: [] for k in ("canvas", "plate", "corners", "glyphs", "light")}
    for file in files:
        with np.load(file) as z:
            for k, values in parts.items():
                values.append(z[k])
    return {k: np.concatenate(v) for k, v in parts.items()}


def mirror_parts(data: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Tensors of everything but the canvas."""
    return {k: torch.from_numpy(v) for k, v in data.items() if k != "canvas"}


def main() -> None:
    """Constant rate, then down to nothing over the last 40 % of the steps; a checkpoint every few shards."""
    p = argparse.ArgumentParser()
    p.add_argument("shards", type=Path)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--steps", type=int, default=4000)
    p.add_argument("--minutes", type=float, default=1e9, help="of training; the rate falls to nothing by then where that comes before --steps")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--batch", type=int, default=64)
    p.add_argument("--rate", type=float, default=3e-3)
    p.add_argument("--recent", type=float, default=40, help="shards: how quickly the attention to older ones falls")
    p.add_argument("--start", type=Path, help="weights to start from")
    a = p.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(a.seed)
    a.out.mkdir(parents=True, exist_ok=True)
    net = GlyphNet().to(memory_format=torch.channels_last)
    if a.start:
        start_from(net, torch.load(a.start)["ema"])
    ema = {k: v.clone() for k, v in net.state_dict().items()}
    opt = torch.optim.AdamW(net.parameters(), lr=a.rate, weight_decay=1e-4)
    state = {"step": 0, "seconds": 0.0, "pass": 0}
    last = a.out / "last.pt"
    if last.exists():
        saved = torch.load(last)
        net.load_state_dict(saved["net"])
        opt.load_state_dict(saved["opt"])
        ema, state = saved["ema"], saved["state"]
    while max(state["step"] / a.steps, state["seconds"] / 60 / a.minutes) < 1:
        files = sorted((f for f in a.shards.glob("shard_*.npz") if ".tmp" not in f.name), key=lambda f: f.stat().st_mtime)
        if not files:
            time.sleep(5)
            continue
        rng = np.random.default_rng([a.seed, state["pass"]])
        state["pass"] += 1
        # new shards may arrive while training: the newest are seen most
        age = np.arange(len(files))[::-1]
        share = 0.3 / len(files) + 0.7 * np.exp(-age / a.recent) / np.exp(-age / a.recent).sum()
        data = load([files[int(k)] for k in rng.choice(len(files), min(4, len(files)), replace=False, p=share / share.sum())])
        began = time.monotonic()
        net.train()
        sums: dict[str, float] = {}
        order = rng.permutation(len(data["plate"]))
        rest = mirror_parts(data)
        steps = len(order) // a.batch
        for k in range(steps):
            minutes = (state["seconds"] + time.monotonic() - began) / 60
            cool = min(1.0, max(0.0, (max(state["step"] / a.steps, minutes / a.minutes) - 0.6) / 0.4))
            rate = a.rate * min(1.0, (state["step"] + 1) / 200) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * cool)))
            for group in opt.param_groups:
                group["lr"] = rate
            index = order[k * a.batch : (k + 1) * a.batch]
            x = torch.from_numpy(normalise(jitter(data["canvas"][index], rng))).to(memory_format=torch.channels_last)
            batch = {key: value[torch.from_numpy(index)] for key, value in rest.items()}
            with torch.autocast("cpu", dtype=torch.bfloat16):
                glyph, corners, judge = net(x)
            parts = losses((glyph.float(), corners.float(), judge.float()), batch)
            loss = sum(parts.values())
            opt.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
            opt.step()
            state["step"] += 1
            decay = min(0.998, state["step"] / (state["step"] + 50))
            with torch.no_grad():
                for key, value in net.state_dict().items():
                    if value.dtype.is_floating_point:
                        ema[key].lerp_(value, 1 - decay)
                    else:
                        ema[key].copy_(value)
            for key, value in parts.items():
                sums[key] = sums.get(key, 0.0) + float(value.detach())
        state["seconds"] += time.monotonic() - began
        torch.save({"net": net.state_dict(), "opt": opt.state_dict(), "ema": ema, "state": state}, last)
        print(json.dumps({"pass": state["pass"], "min": round(state["seconds"] / 60, 2), "sps": round(steps * a.batch / (time.monotonic() - began)), "shards": len(files),
                          "rate": round(rate, 5), **{k: round(v / steps, 4) for k, v in sums.items()}}), flush=True)
    torch.save({"ema": ema, "state": state}, a.out / "final.pt")


if __name__ == "__main__":
    main()
