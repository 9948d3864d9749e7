"""GlyphNet: a crop in, plate-ness, corners and characters out. About 24 million multiplications, 210,000 weights."""

from __future__ import annotations

import torch
from torch import Tensor, nn

H, W, STRIDE_Y, STRIDE_X = 64, 192, 4, 2
ROWS, COLS = H // STRIDE_Y, W // STRIDE_X  # of the glyph map
CORNER_COLS = W // 4
GLYPH_CHANNELS = 6  # heat, small, left, right, top, bottom
SCALE_PX = 8.0  # of the box channels


def cbr(cin: int, cout: int, k: int, stride: int = 1, groups: int = 1, act: bool = True) -> nn.Sequential:
    """Convolution, batch norm, ReLU."""
    layers: list[nn.Module] = [nn.Conv2d(cin, cout, k, stride, k // 2, groups=groups, bias=False), nn.BatchNorm2d(cout)]
    if act:
        layers.append(nn.ReLU(inplace=True))
    return nn.Sequential(*layers)


class Block(nn.Module):
    """Inverted residual: widen, depthwise k x k, narrow."""

    def __init__(self, c: int, k: int = 3, expand: float = 1.5) -> None:
        super().__init__()
        m = int(c * expand)
        self.body = nn.Sequential(cbr(c, m, 1), cbr(m, m, k, groups=m), cbr(m, c, 1, act=False))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


class GlyphNet(nn.Module):
    """forward(x (n, 1, 64, 192)) -> glyph map (n, 6, 16, 96), corners (n, 4, 2) canvas px, (n, 6): 4 log sigmas, plate, light-on-dark."""

    def __init__(self, c4: int = 28, c8: int = 48, c16: int = 96, c2: int = 12) -> None:
        super().__init__()
        self.stem = cbr(1, c2, 5, 2)
        self.down4 = cbr(c2, c4, 3, 2)
        self.s4 = Block(c4)
        self.down8 = nn.Sequential(cbr(c4, c4, 3, 2, groups=c4), cbr(c4, c8, 1))
        self.s8 = nn.Sequential(Block(c8, 5), Block(c8))
        self.down16 = nn.Sequential(cbr(c8, c8, 3, 2, groups=c8), cbr(c8, c16, 1))
        self.s16 = nn.Sequential(Block(c16, 5), Block(c16), Block(c16, 5))
        self.up8 = cbr(c16, c8, 1, act=False)
        self.m8 = Block(c8)
        self.wide8 = Block(c8, 5)  # neighbours along the row: a seal between characters is none
        self.up4 = cbr(c8, c4, 1, act=False)
        self.m4 = Block(c4, 5, 2.0)
        self.glyph = nn.Sequential(cbr(c4, 32, 1), nn.Conv2d(32, GLYPH_CHANNELS * 2, 1))
        self.corner = nn.Sequential(cbr(c4, c4, 3, groups=c4), nn.Conv2d(c4, 4, 1))
        self.judge = nn.Sequential(nn.Linear(c16 + c4, 48), nn.ReLU(), nn.Linear(48, 6))
        self.look = nn.Sequential(Block(c16, 5), Block(c16))  # for plate-ness alone
        self.verdict = nn.Sequential(nn.Linear(2 * c16 + c4, 64), nn.ReLU(), nn.Linear(64, 1))
        self.upsample = nn.Upsample(scale_factor=2, mode="nearest")
        xs = (torch.arange(CORNER_COLS, dtype=torch.float32) + 0.5) * 4 - 0.5
        ys = (torch.arange(ROWS, dtype=torch.float32) + 0.5) * 4 - 0.5
        # the soft-argmax reaches a little beyond the canvas
        xs, ys = (xs - 95.5) * 1.06 + 95.5, (ys - 31.5) * 1.15 + 31.5
        self.register_buffer("grid", torch.stack([xs.repeat(ROWS), ys.repeat_interleave(CORNER_COLS)], dim=1))
        nn.init.constant_(self.glyph[1].bias[:2], -3.0)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        n = x.shape[0]
        f4 = self.s4(self.down4(self.stem(x)))
        f8 = self.s8(self.down8(f4))
        f16 = self.s16(self.down16(f8))
        m8 = self.wide8(self.m8(torch.relu(f8 + self.upsample(self.up8(f16)))))
        m4 = self.m4(torch.relu(f4 + self.upsample(self.up4(m8))))
        g = self.glyph(m4)  # (n, 6 * 2, 16, 48): channel pairs are the even and odd columns
        g = g.reshape(n, GLYPH_CHANNELS, 2, ROWS, W // 4).permute(0, 1, 3, 4, 2).reshape(n, GLYPH_CHANNELS, ROWS, COLS)
        p = torch.softmax(self.corner(m4).float().reshape(n, 4, ROWS * CORNER_COLS), dim=2)
        corners = torch.stack([(p * self.grid[:, 0]).sum(dim=2), (p * self.grid[:, 1]).sum(dim=2)], dim=2)
        pooled = torch.cat([f16.mean(dim=(2, 3)), m4.mean(dim=(2, 3))], dim=1)
        judged = self.judge(pooled)
        seen = self.look(f16)
        plate = self.verdict(torch.cat([seen.mean(dim=(2, 3)), seen.amax(dim=(2, 3)), pooled[:, -m4.shape[1] :]], dim=1))
        return g, corners, torch.cat([judged[:, :4], judged[:, 4:5] + plate, judged[:, 5:]], dim=1)


def start_from(net: GlyphNet, weights: dict[str, Tensor]) -> None:
    """Weights of an earlier, smaller network; what is new begins as no change at all."""
    for block in (net.s16[2], net.wide8, net.look[0], net.look[1]):
        nn.init.zeros_(block.body[2][1].weight)
    nn.init.zeros_(net.verdict[2].weight)
    nn.init.zeros_(net.verdict[2].bias)
    lacking = net.load_state_dict(weights, strict=False)
    if lacking.unexpected_keys:
        raise ValueError(f"weights of another network: {lacking.unexpected_keys[:3]}")
