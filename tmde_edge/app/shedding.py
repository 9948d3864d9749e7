"""Doing less when the board is slow or hot, in a stated order, and more again when there is room. Pure: time comes in."""

from __future__ import annotations

from dataclasses import dataclass

LEVELS = ("none", "depth", "search", "frames")  # what is reduced at each level, with everything before it
DEPTH_FACTOR, SEARCH_FACTOR, FRAME_FACTOR = 4, 2, 2  # how much rarer
UP_S = 2.0  # overloaded for this long: one level more
HEAT_UP_S = 20.0  # the same for heat, which answers slowly
DOWN_S = 15.0  # room for this long: one level less
DOWN_LIMIT_S = 300.0  # the same after many vain tries
RETRY_S = 10.0  # overloaded again this soon after a step down: the step was vain
SKIPPED_MAX = 0.10  # of the frames
BUSY_ROOM = 0.6  # of perception's time: below this one level less will fit
LATE_S = 0.2  # shutter to decision, 90th percentile


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """How the last second went."""

    skipped: float = 0.0  # fraction of frames that a newer one replaced
    busy: float = 0.0  # fraction of the time perception worked
    late_s: float = 0.0  # 90th percentile, shutter to decision
    dropped: bool = False  # events were lost before they were decided on
    hot: bool = False


class Shedder:
    """`level` says what is reduced now: an index of LEVELS."""

    def __init__(self) -> None:
        self.level = 0
        self._bad_s: float | None = None  # since then
        self._good_s: float | None = None
        self._lowered_s: float | None = None
        self._down_s = DOWN_S

    @property
    def depth_factor(self) -> int:
        """The depth network runs this much rarer."""
        return DEPTH_FACTOR if self.level >= 1 else 1

    @property
    def search_factor(self) -> int:
        """Full searches run this much rarer."""
        return SEARCH_FACTOR if self.level >= 2 else 1

    @property
    def frame_factor(self) -> int:
        """Only each n-th frame is looked at."""
        return FRAME_FACTOR if self.level >= 3 else 1

    def step(self, now_s: float, load: Load) -> bool:
        """Takes one look at the load; true where the level changed."""
        if overloaded(load, self.level) or load.hot:
            self._good_s = None
            self._bad_s = now_s if self._bad_s is None else self._bad_s
            wait_s = UP_S if overloaded(load, self.level) else HEAT_UP_S if self.level else 0.0
            if self.level == len(LEVELS) - 1 or now_s - self._bad_s < wait_s:
                return False
            if self._lowered_s is not None and now_s - self._lowered_s < RETRY_S:
                self._down_s = min(2 * self._down_s, DOWN_LIMIT_S)
            self.level, self._bad_s, self._lowered_s = self.level + 1, now_s, None
            return True
        self._bad_s = None
        if self.level == 0:
            if self._lowered_s is not None and now_s - self._lowered_s > DOWN_LIMIT_S:
                self._down_s, self._lowered_s = DOWN_S, None
            return False
        if load.busy > BUSY_ROOM:
            self._good_s = None
            return False
        self._good_s = now_s if self._good_s is None else self._good_s
        if now_s - self._good_s < self._down_s:
            return False
        self.level, self._good_s, self._lowered_s = self.level - 1, now_s, now_s
        return True


def overloaded(load: Load, level: int) -> bool:
    """Slow. Fewer frames cannot help against skipped ones: the newest always wins; they help against lateness."""
    slow = load.late_s > LATE_S or load.dropped
    return slow or (load.skipped > SKIPPED_MAX and level < 2)
