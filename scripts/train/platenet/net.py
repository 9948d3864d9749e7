"""PlateNet: a plain 3x3 ReLU pyramid, heads at stride 4 (plates 8..96 px wide) and stride 16 (64..340 px); everything folds into int8 convolutions."""
from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

STRIDES = (4, 16)
UNITS_PX = (16.0, 64.0)  # corner offsets are in these units, relative to the cell's centre
MAPS = 9  # score logit, then x,y of TL, TR, BR, BL


class ConvBn(nn.Sequential):
    """3x3 (or 1x1) convolution, batch norm, ReLU."""

    def __init__(self, c_in: int, c_out: int, k: int = 3, stride: int = 1, relu: bool = True) -> None:
        super().__init__(nn.Conv2d(c_in, c_out, k, stride, k // 2, bias=False), nn.BatchNorm2d(c_out), *([nn.ReLU(inplace=True)] if relu else []))


class Residual(nn.Module):
    """Two 3x3 convolutions and a skip."""

    def __init__(self, c: int) -> None:
        super().__init__()
        self.a = ConvBn(c, c)
        self.b = ConvBn(c, c, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.b(self.a(x)))


class PlateNet(nn.Module):
    """x: float [N,3,H,W], BGR/255, H and W multiples of 32 -> [N,9,H/4,W/4], [N,9,H/16,W/16]."""

    def __init__(self, c2: int = 16, c4: int = 32, c8: int = 48, c16: int = 80, c32: int = 112, n8: int = 1, n16: int = 2, n32: int = 1) -> None:
        super().__init__()
        self.s2 = ConvBn(3, c2, stride=2)
        self.s4 = nn.Sequential(ConvBn(c2, c4, stride=2), ConvBn(c4, c4))
        self.s8 = nn.Sequential(ConvBn(c4, c8, stride=2), *[Residual(c8) for _ in range(n8)])
        self.s16 = nn.Sequential(ConvBn(c8, c16, stride=2), *[Residual(c16) for _ in range(n16)])
        self.s32 = nn.Sequential(ConvBn(c16, c32, stride=2), *[Residual(c32) for _ in range(n32)])
        self.l32 = ConvBn(c32, c16, 1, relu=False)
        self.f16 = ConvBn(c16, c16)
        self.l16 = ConvBn(c16, c8, 1, relu=False)
        self.f8 = ConvBn(c8, c8)
        self.l8 = ConvBn(c8, c4, 1, relu=False)
        self.f4 = ConvBn(c4, c4)
        self.head16 = nn.Sequential(ConvBn(c16, c16), nn.Conv2d(c16, MAPS, 1))
        self.head4 = nn.Sequential(nn.Conv2d(c4, MAPS, 1))
        for head in (self.head4, self.head16):
            nn.init.normal_(head[-1].weight, std=0.01)
            nn.init.zeros_(head[-1].bias)
            head[-1].bias.data[0] = -4.0

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        x4 = self.s4(self.s2(x))
        x8 = self.s8(x4)
        x16 = self.s16(x8)
        x32 = self.s32(x16)
        p16 = self.f16(F.relu(x16 + F.interpolate(self.l32(x32), scale_factor=2.0, mode="nearest")))
        p8 = self.f8(F.relu(x8 + F.interpolate(self.l16(p16), scale_factor=2.0, mode="nearest")))
        p4 = self.f4(F.relu(x4 + F.interpolate(self.l8(p8), scale_factor=2.0, mode="nearest")))
        return self.head4(p4), self.head16(p16)
