"""HorizonNet: a grey crop of 160x96 -> how likely each row offset and each slope of the horizon is."""
from __future__ import annotations

import torch
from torch import Tensor, nn

WIDTH, HEIGHT = 160, 96
OFFSETS_PX = torch.arange(-31.5, 32.0, 1.0)  # of the horizon below the crop's middle row, at its middle column
SLOPES = torch.arange(-12, 13) * 0.015  # rows per column


def _conv(cin: int, cout: int, stride: int | tuple[int, int]) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(cin, cout, 3, stride, 1, bias=False), nn.BatchNorm2d(cout), nn.ReLU())


class HorizonNet(nn.Module):
    """x: float [N, 1, 96, 160] in 0..1 -> logits [N, 64 + 25]. Rows keep a finer step (4) than columns (16): rows are what is asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(
            _conv(1, 12, 2), _conv(12, 24, 2), _conv(24, 24, 1), _conv(24, 40, (1, 2)), _conv(40, 40, 1), _conv(40, 48, (1, 2)), _conv(48, 48, 1),
            nn.Conv2d(48, 16, 1, bias=False), nn.BatchNorm2d(16), nn.ReLU(),
        )  # fmt: skip
        self.head = nn.Sequential(nn.Flatten(), nn.Dropout(0.2), nn.Linear(16 * 24 * 10, 112), nn.ReLU())
        self.last = nn.Linear(112, len(OFFSETS_PX) + len(SLOPES))

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.last(self.head(self.body(x)))
        return out
