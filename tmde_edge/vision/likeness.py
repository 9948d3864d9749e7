"""What a plate looks like in small: like itself (a covered one does not, whatever a reader makes of it), or eaten by glare?"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image
from tmde_edge.vision.rectify import Array, is_convex, rectify_grey, size_px

Floats = NDArray[np.float64]
WIDTH_PX, HEIGHT_PX = 48, 14  # of the look that is taken
SMALLEST_PX = 20.0  # narrower plates show too little to compare
CONTRAST_GREY = 4.0  # what noise may look like: less contrast than this counts as none
SURE = 5  # looks after which a plate is known
SHARE = 0.2  # of a new look in what is known
CLIPPED_GREY, PALE_GREY = 250, 220  # the sensor's white is reached; a character this pale has lost most of its contrast
INK_SHARE = 15  # per cent of a plate that its characters and borders usually cover at least
DARK_SHARE, DARK_GREY = 3, 140  # so little is enough to tell that the ink is dark where a plate has few characters
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


def small_look(image: Image, corners_px: Array) -> Image | None:
    """(14, 48) grey of the plate from the front; None for corners that span no area."""
    if not is_convex(corners_px):
        return None
    return rectify_grey(image, corners_px, WIDTH_PX, HEIGHT_PX)[0]


def view_of(look: Image | None, corners_px: Array) -> Floats | None:
    """(n,) of a small look's inside, without mean, of norm 1 (less where there is hardly contrast).

    None for plates too small to compare.
    """
    if look is None or size_px(corners_px)[0] < SMALLEST_PX:
        return None
    inside = cv2.GaussianBlur(look, (5, 5), 1.0)[2:-2, 3:-3].astype(np.float64)
    inside -= inside.mean()
    return np.asarray((inside / np.hypot(inside.std(), CONTRAST_GREY)).ravel() / inside.size**0.5)


def is_washed_out(look: Image | None) -> bool:
    """Whether a plate's paper is clipped and its ink nearly so: the white has eaten the edges, nothing is to be measured.

    A clipped plate with dark ink is not: its edges are moved by a fraction of the blur.
    """
    if look is None:
        return False
    grey = np.sort(look, axis=None)
    paper, ink, darkest = (float(grey[grey.size * share // 100]) for share in (50, INK_SHARE, DARK_SHARE))
    return paper >= CLIPPED_GREY and ink >= PALE_GREY and darkest >= DARK_GREY
