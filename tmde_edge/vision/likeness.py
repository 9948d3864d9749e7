"""Does a followed plate still look like itself? A covered one does not, whatever a reader makes of its cover."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import Array, rectify_grey, size_px

Floats = NDArray[np.float64]
WIDTH_PX, HEIGHT_PX = 48, 14  # of the view that is compared
SMALLEST_PX = 20.0  # narrower plates show too little to compare
CONTRAST_GREY = 4.0  # what noise may look like: less contrast than this counts as none
SURE = 5  # looks after which a plate is known
SHARE = 0.2  # of a new look in what is known
LEAST = 0.3  # correlation; one pixel of misplacement and blur leave 0.5 and more, a cover about 0


@dataclass(slots=True)
class Looks:
    """What is known of one plate's looks: the running mean of normalised views."""

    mean: Floats | None = None
    count: int = 0

    def learn(self, view: Floats | None) -> None:
        """Takes a view of the plate itself."""
        if view is None:
            return
        self.mean = view if self.mean is None else (1 - SHARE) * self.mean + SHARE * view
        self.count += 1

    def contradicted(self, view: Floats | None) -> bool:
        """Whether a view shows something else; False while too little is known."""
        if view is None or self.mean is None or self.count < SURE:
            return False
        return float(view @ self.mean) < LEAST * float(np.linalg.norm(self.mean))


def view_of(image: Image, corners_px: Array) -> Floats | None:
    """(n,) grey of the plate's inside from the front, without mean, of norm 1 (less where there is hardly contrast).

    None for plates too small to compare.
    """
    if size_px(corners_px)[0] < SMALLEST_PX:
        return None
    try:
        flat = rectify_grey(image, corners_px, WIDTH_PX, HEIGHT_PX)[0]
    except ValueError:
        return None
    inside = cv2.GaussianBlur(flat, (5, 5), 1.0)[2:-2, 3:-3].astype(np.float64)
    inside -= inside.mean()
    return np.asarray((inside / np.hypot(inside.std(), CONTRAST_GREY)).ravel() / inside.size**0.5)
