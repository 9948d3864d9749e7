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
        return sum(b[0] for b in self.blocks_rad) / len(self.blocks_rad) if self.blocks_rad else 0.0

    @property
    def yaw_rad(self) -> float:
        """Mean of the blocks; 0 before the first."""
        return sum(b[1] for b in self.blocks_rad) / len(self.blocks_rad) if self.blocks_rad else 0.0

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
        blocks = (*self.blocks_rad, block)[-BLOCKS_KEPT:]
        if len(blocks) > BLOCKS_NEEDED and self.valid and _far_from(self, block):
            blocks = _after_a_move(blocks)
        return RestingPose(blocks_rad=blocks)


def _far_from(state: RestingPose, block: tuple[float, float]) -> bool:
    return math.hypot(block[0] - state.pitch_rad, block[1] - state.yaw_rad) > MAX_SPREAD_RAD


def _after_a_move(blocks: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """When the newest blocks agree with each other and not with the older ones, the camera was moved: forget the old."""
    newest = blocks[-3:]
    apart = max(_deviation([b[i] for b in newest]) for i in (0, 1))
    return newest if apart < 0.3 * MAX_SPREAD_RAD else blocks


def _deviation(values: list[float]) -> float:
    mean = sum(values) / len(values)
    return math.sqrt(sum((v - mean) ** 2 for v in values) / (len(values) - 1))
