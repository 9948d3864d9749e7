"""The interfaces between the finders, the character readers and perception. Pixels only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import PlateColours

Image = NDArray[np.uint8]  # (h, w) grey or (h, w, 3) BGR


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateCandidate:
    """A place that may be a plate: corners (4, 2) float64 TL, TR, BR, BL in source pixels, and a score 0..1."""

    corners_px: NDArray[np.float64]
    score: float
    hurried: bool = False  # one of many quick frames: the reader may leave out what takes long and changes little


@dataclass(frozen=True, slots=True, kw_only=True)
class CharacterBox:
    """One character in source pixels: middle points of its edges, (2,) float64 each."""

    left_px: NDArray[np.float64]
    right_px: NDArray[np.float64]
    top_px: NDArray[np.float64]
    bottom_px: NDArray[np.float64]
    score: float = 1.0
    main: bool = True
    row: int = 0
    sigma_tb_px: float = 0.5
    sigma_lr_px: float = 0.5
    stroke_px: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class BoltPair:
    """Two bolts (or holes for them) of one row in source pixels: (2,) float64 each, and one sigma of either's place."""

    left_px: NDArray[np.float64]
    right_px: NDArray[np.float64]
    sigma_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateReading:
    """What a character reader makes of one candidate.

    `platehood` 0..1 is its own opinion whether this is a plate; None where it has none.
    """

    corners_px: NDArray[np.float64]  # (4, 2), refined where the reader can
    corners_sigma_px: float
    refined: bool
    characters: tuple[CharacterBox, ...]
    platehood: float | None = None
    light_on_dark: bool = False
    stroke_px: float | None = None
    border_px: float | None = None
    blur_px: float | None = None
    side_sigma_px: tuple[float, ...] = ()  # of the top, right, bottom and left line, where they are known one by one
    bolts: tuple[BoltPair, ...] = ()
    colours: PlateColours | None = None


class PlateFinder(Protocol):
    """Finds plates in a full frame or in a region of it. Raises on failure; an empty list means: no plate."""

    def find(self, image: Image, *, region_px: tuple[int, int, int, int] | None = None) -> list[PlateCandidate]:
        """Candidates in source pixels; region_px is (x0, y0, x1, y1), half open, inside the image."""
        ...


class PlateReader(Protocol):
    """Reads outline and characters of candidates (segmentation and refinement), in source pixels."""

    def read(self, image: Image, candidates: list[PlateCandidate]) -> list[PlateReading]:
        """One reading per candidate, in order."""
        ...
