"""Trains GlyphEdges on patches. usage: train_edges.py TRAIN.npz... --val VAL.npz --out FOLDER [--steps 4000] [--onnx FILE]"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from tmde_edge.vision.segment.refine_glyphs import PATCH_H_PX, PATCH_W_PX, normalise_patches


class GlyphEdges(nn.Module):
    """forward(patch (n, 1, 48, 40), log scale (n, 1)) -> offsets (n, 4) left, right, top, bottom in patch px, log sigmas (n, 4)."""

    def __init__(self, c1: int = 12, c2: int = 24, c3: int = 24, hidden: int = 32) -> None:
        super().__init__()

        def layer(cin: int, cout: int, k: int, stride: int, groups: int = 1) -> list[nn.Module]:
            return [nn.Conv2d(cin, cout, k, stride, k // 2, groups=groups, bias=False), nn.BatchNorm2d(cout), nn.ReLU(inplace=True)]

        self.body = nn.Sequential(
            *layer(1, c1, 5, 2), *layer(c1, c2, 3, 2), *layer(c2, c2, 3, 1, c2), *layer(c2, c2, 1, 1), *layer(c2, c2, 3, 1, c2), *layer(c2, c3, 1, 1),
            nn.Conv2d(c3, 12, 1),
        )
        self.head = nn.Sequential(nn.Linear(12 * (PATCH_H_PX // 4) * (PATCH_W_PX // 4) + 1, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, 8))

    def forward(self, x: Tensor, log_scale: Tensor) -> tuple[Tensor, Tensor]:
        f = torch.relu(self.body(x)).flatten(1)
        out = self.head(torch.cat([f, log_scale], dim=1))
        return 2.0 * out[:, :4], out[:, 4:]


def load(files: list[Path]) -> dict[str, np.ndarray]:
    """All files' arrays."""
    parts = [dict(np.load(f)) for f in files]
    return {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}


def export(net: GlyphEdges, out: Path) -> None:
    """ONNX with two inputs, dynamic batch."""
    net.eval()
    torch.onnx.export(
        net, (torch.zeros(2, 1, PATCH_H_PX, PATCH_W_PX), torch.zeros(2, 1)), str(out), opset_version=17, dynamo=False,
        input_names=["patch", "log_scale"], output_names=["offsets", "log_sigma"],
        dynamic_axes={k: {0: "n"} for k in ("patch", "log_scale", "offsets", "log_sigma")},
    )


def judge(file: Path, val: dict[str, np.ndarray]) -> None:
    """Table of errors in source px by plate width."""
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    got = [session.run(None, {"patch": normalise_patches(val["patch"][i : i + 256]), "log_scale": val["log_scale"][i : i + 256]}) for i in range(0, len(val["patch"]), 256)]
    offsets, log_sigma = (np.concatenate([g[k] for g in got]) for k in (0, 1))
    per = np.exp(val["log_scale"])
    error = (offsets - val["offsets"]) * per
    sigma = np.sqrt(2) * np.exp(log_sigma) * per
    before = val["offsets"] * per
    z = np.abs(error) / sigma
    for low, high in ((0, 30), (30, 60), (60, 100), (100, 180), (180, 500)):
        k = (val["plate_w_px"] >= low) & (val["plate_w_px"] < high)
        e = np.abs(error[k])
        height = np.abs(error[k, 3] - error[k, 2])
        print(f"{low:4d}-{high:4d} n={k.sum():6d} lr {np.median(e[:, :2]):.3f}/{np.quantile(e[:, :2], 0.9):.3f} tb {np.median(e[:, 2:]):.3f}/{np.quantile(e[:, 2:], 0.9):.3f}"
              f" (before {np.median(np.abs(before[k])):.3f}) bias {np.median(error[k], axis=0).round(3).tolist()} height {np.median(height):.3f}"
              f" z>1 {np.mean(z[k] > 1):.2f} z>2 {np.mean(z[k] > 2):.3f}")


def main() -> None:
    """One run."""
    p = argparse.ArgumentParser()
    p.add_argument("train", type=Path, nargs="+")
    p.add_argument("--val", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--steps", type=int, default=4000)
    p.add_argument("--batch", type=int, default=256)
    p.add_argument("--rate", type=float, default=3e-3)
    p.add_argument("--seed", type=int, default=1)
    a = p.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(a.seed)
    rng = np.random.default_rng(a.seed)
    data, val = load(a.train), load([a.val])
    net = GlyphEdges().to(memory_format=torch.channels_last)
    ema = {k: v.clone() for k, v in net.state_dict().items()}
    opt = torch.optim.AdamW(net.parameters(), lr=a.rate, weight_decay=1e-3)
    a.out.mkdir(parents=True, exist_ok=True)
    total = 0.0
    for step in range(a.steps):
        net.train()
        for group in opt.param_groups:
            group["lr"] = a.rate * min(1.0, (step + 1) / 100) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / a.steps)))
        index = rng.integers(0, len(data["patch"]), a.batch)
        x = data["patch"][index].astype(np.float32)
        x = x * rng.uniform(0.7, 1.3, (a.batch, 1, 1)) + rng.normal(0, 1, x.shape) * np.abs(rng.normal(0, 1.5, (a.batch, 1, 1)))
        target = torch.from_numpy(data["offsets"][index])
        offsets, log_sigma = net(torch.from_numpy(normalise_patches(np.clip(x, 0, 255).astype(np.uint8))).to(memory_format=torch.channels_last), torch.from_numpy(data["log_scale"][index]))
        error = (offsets - target).abs()
        s = log_sigma.clamp(-5, 4)
        # plain L1 places the edges; the Laplace likelihood, weights detached, gives the sigmas and favours sharp patches
        loss = (error * torch.exp(-s) + s).mean() + 0.5 * error.mean()
        opt.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        opt.step()
        total += float(error.detach().mean())
        decay = min(0.995, step / (step + 50)) if step else 0.0
        with torch.no_grad():
            for k, v in net.state_dict().items():
                ema[k].lerp_(v, 1 - decay) if v.dtype.is_floating_point else ema[k].copy_(v)
        if (step + 1) % 500 == 0:
            print(step + 1, "mean error, patch px", round(total / 500, 4), flush=True)
            total = 0.0
    torch.save(ema, a.out / "edges.pt")
    final = GlyphEdges()
    final.load_state_dict(ema)
    export(final, a.out / "glyphedges.onnx")
    judge(a.out / "glyphedges.onnx", val)


if __name__ == "__main__":
    main()
