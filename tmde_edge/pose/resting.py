"""The camera's resting pitch and yaw, learnt while driving straight, as openpilot's calibrationd learns its own.

Samples come only at speed and while hardly turning. A block is the mean of many samples, so that bumps and the car's place
in its lane average out; the estimate is the mean of the newest blocks, its spread how much they disagree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

BLOCK_SAMPLES = 50  # 5 s at 10 Hz
BLOCKS_NEEDED = 5
BLOCKS_KEPT = 30
MAX_SPREAD_RAD = 0.02  # between the blocks: more, and the camera was moved or the roads were no good
MAX_OFFSET_RAD = 0.20  # from the optical axis: nobody mounts a camera so; it is a wrong vanishing point


@dataclass(frozen=True, slots=True, kw_only=True)
class RestingPose:
    """The state: plain numbers, to be kept over restarts. Blocks are (pitch, yaw) means, oldest first."""

    blocks_rad: tuple[tuple[float, float], ...] = ()
    pitch_sum_rad: float = 0.0
    yaw_sum_rad: float = 0.0
    samples: int = 0

    @property
    def percent(self) -> int:
        """How much of what is needed has been seen, 0..100."""
        seen = len(self.blocks_rad) * BLOCK_SAMPLES + self.samples
        return min(100, 100 * seen // (BLOCKS_NEEDED * BLOCK_SAMPLES))

    @property
    def spread_rad(self) -> float:
        """The larger of the blocks' standard deviations of pitch and yaw; infinite below two blocks."""
        n = len(self.blocks_rad)
        if n < 2:
            return math.inf
        return max(_deviation([b[i] for b in self.blocks_rad]) for i in (0, 1))

    @property
    def valid(self) -> bool:
        """True once enough blocks agree."""
        return len(self.blocks_rad) >= BLOCKS_NEEDED and self.spread_rad <= MAX_SPREAD_RAD

    @property
    def pitch_rad(self) -> float:
        """Mean of the blocks; 0 before the first."""
        return _mean([b[0] for b in self.blocks_rad]) if self.blocks_rad else 0.0

    @property
    def yaw_rad(self) -> float:
        """Mean of the blocks; 0 before the first."""
        return _mean([b[1] for b in self.blocks_rad]) if self.blocks_rad else 0.0

    @property
    def sigma_rad(self) -> float:
        """Of the mean, one sigma; never below 0.5 mrad, since roads share a crown and a grade."""
        return max(self.spread_rad / math.sqrt(len(self.blocks_rad)), 0.0005) if self.blocks_rad else math.inf

    def with_sample(self, pitch_rad: float, yaw_rad: float) -> RestingPose:
        """The state after one more sample taken while driving straight."""
        if not (abs(pitch_rad) <= MAX_OFFSET_RAD and abs(yaw_rad) <= MAX_OFFSET_RAD):
            return self
        state = replace(
            self, pitch_sum_rad=self.pitch_sum_rad + pitch_rad, yaw_sum_rad=self.yaw_sum_rad + yaw_rad,
            samples=self.samples + 1,
        )  # fmt: skip
        if state.samples < BLOCK_SAMPLES:
            return state
        block = state.pitch_sum_rad / state.samples, state.yaw_sum_rad / state.samples
        return RestingPose(blocks_rad=_without_old_mounting((*self.blocks_rad, block)[-BLOCKS_KEPT:]))


def _without_old_mounting(blocks: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """When the three newest blocks agree with each other and not with the older ones, the camera was moved: forget those."""
    new, old = blocks[-3:], blocks[:-3]
    if len(old) < 3:
        return blocks
    apart_rad = math.hypot(*(_mean([b[i] for b in new]) - _mean([b[i] for b in old]) for i in (0, 1)))
    scatter_rad = max(_deviation([b[i] for b in new]) for i in (0, 1))
    return new if apart_rad > MAX_SPREAD_RAD and scatter_rad < 0.3 * MAX_SPREAD_RAD else blocks


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _deviation(values: list[float]) -> float:
    mean = _mean(values)
    return math.sqrt(sum((v - mean) ** 2 for v in values) / (len(values) - 1))
