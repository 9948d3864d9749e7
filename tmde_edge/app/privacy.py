"""Pictures that may be kept: characters of plates become unreadable, the edges that were measured stay.

Every row of a plate is replaced by its own mean along the plate. The tops and bottoms of the characters and of the plate, which
give the distance, keep their place; what the characters say is gone and no filter brings it back. Frames wait a moment before
they are kept, so that a plate found later is also covered in the frames before.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import Corners, Frame, PlateSighting, Sighting

Image = NDArray[np.uint8]
HOLD_NS = 400_000_000  # a frame waits this long for plates that are found later
NEAR_NS = 500_000_000  # a plate seen this near in time is covered where it was
GROWTH = 0.4  # of a plate that was not seen in this very frame
SURE_INSET, UNSURE_GROWTH = 0.02, 0.06  # of the width: refined outlines, others
ROWS_GROWTH = 0.12  # of the height, above and below
_MIN_SIDE_PX = 3.0
_MOST_COLUMNS, _MOST_ROWS = 400, 800


def cover_plate(image: Image, corners_px: Corners, along: float, across: float = ROWS_GROWTH) -> None:
    """Replaces the rows of a plate by their means, in place.

    Corners TL, TR, BR, BL in pixels of the image; the area covered is larger than the plate by `along` of its width on either
    side (negative: smaller) and by `across` of its height.
    """
    tl, tr, br, bl = (np.array(c, np.float64) for c in corners_px)
    width, height = max(np.hypot(*(tr - tl)), np.hypot(*(br - bl))), max(np.hypot(*(bl - tl)), np.hypot(*(br - tr)))
    if not (np.isfinite(width) and np.isfinite(height)) or min(width, height) < _MIN_SIDE_PX:
        return
    if max(width, height) > 4 * max(image.shape):  # a wild outline
        return
    # The area in fractions of the plate, and the plate's own plane in pixels of about the image's size.
    u, v = np.array([-along, 1 + along]), np.array([-across, 1 + across])
    columns = int(np.clip(np.ceil(width * (u[1] - u[0])), 2, _MOST_COLUMNS))  # only their mean is used
    rows = int(np.clip(np.ceil(height * (v[1] - v[0])), 2, _MOST_ROWS))
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    image_from_unit = cv2.getPerspectiveTransform(unit, np.array([tl, tr, br, bl], np.float32))
    scale = np.array([[(u[1] - u[0]) / (columns - 1), 0, u[0]], [0, (v[1] - v[0]) / (rows - 1), v[0]], [0, 0, 1]])
    image_from_flat = image_from_unit @ scale
    flat = cv2.warpPerspective(
        image, image_from_flat, (columns, rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    smeared = np.ascontiguousarray(np.broadcast_to(flat.mean(axis=1, keepdims=True).round().astype(np.uint8), flat.shape))
    outline = cv2.perspectiveTransform(
        np.array([[[0, 0], [columns - 1, 0], [columns - 1, rows - 1], [0, rows - 1]]], np.float64), image_from_flat
    )[0]
    x0, y0 = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 1, 0)
    x1, y1 = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 2, image.shape[1::-1])
    if x1 <= x0 or y1 <= y0:
        return
    shift = np.array([[1, 0, -x0], [0, 1, -y0], [0, 0, 1]], np.float64)
    size = (int(x1 - x0), int(y1 - y0))
    patch = cv2.warpPerspective(
        smeared, shift @ image_from_flat, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    mask = np.zeros(size[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.round(outline - (x0, y0)).astype(np.int32), 1)
    part = image[y0:y1, x0:x1]
    part[mask > 0] = patch[mask > 0]


def cover_all(image: Image, plates: Sequence[PlateSighting], near: Sequence[PlateSighting] = ()) -> Image:
    """A copy in which every plate is unreadable; `near`: plates seen shortly before or after, not in this frame."""
    out = np.array(image, dtype=np.uint8)
    for plate in plates:
        cover_plate(out, plate.corners_px, -SURE_INSET if plate.refined and plate.source == "detector" else UNSURE_GROWTH)
    for plate in near:
        cover_plate(out, plate.corners_px, GROWTH, GROWTH)
    return out


class FrameKeeper:
    """Takes every sighting with its frame, gives back JPEG files of the frames to keep, a moment later."""

    def __init__(self, *, rate_hz: float, quality: int, blur: bool) -> None:
        self._period_ns = round(0.9e9 / rate_hz)  # frame times jitter
        self._quality, self._blur = quality, blur
        self._taken_ns: int | None = None
        self._waiting: deque[tuple[Frame, tuple[PlateSighting, ...]]] = deque()
        self._seen: deque[tuple[int, tuple[PlateSighting, ...]]] = deque()

    def wants(self, t_ns: int) -> bool:
        """Whether the frame of this time is one to keep."""
        return self._taken_ns is None or not 0 <= t_ns - self._taken_ns < self._period_ns

    def take(self, sighting: Sighting, frame: Frame | None) -> list[tuple[int, bytes]]:
        """Frames that are ready now, as (t_ns, JPEG)."""
        if sighting.plates:
            self._seen.append((sighting.t_ns, sighting.plates))
        while self._seen and sighting.t_ns - self._seen[0][0] > HOLD_NS + NEAR_NS:
            self._seen.popleft()
        if frame is not None and self.wants(frame.t_ns):
            self._taken_ns = frame.t_ns
            self._waiting.append((frame, sighting.plates))
        return self._ready(sighting.t_ns)

    def rest(self) -> list[tuple[int, bytes]]:
        """The frames that still wait, at the end."""
        return self._ready(None)

    def _ready(self, now_ns: int | None) -> list[tuple[int, bytes]]:
        out = []
        hold_ns = HOLD_NS if self._blur else 0
        while self._waiting and (now_ns is None or abs(now_ns - self._waiting[0][0].t_ns) >= hold_ns):
            frame, plates = self._waiting.popleft()
            image = frame.image
            if self._blur:
                image = cover_all(image, plates, self._near(frame.t_ns, plates))
            ok, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
            if ok:
                out.append((frame.t_ns, jpeg.tobytes()))
        return out

    def _near(self, t_ns: int, plates: tuple[PlateSighting, ...]) -> list[PlateSighting]:
        """Tracks seen within half a second but not in this frame, each where it was seen nearest in time."""
        here = {p.track_id for p in plates}
        nearest: dict[int, tuple[int, PlateSighting]] = {}
        for seen_ns, others in self._seen:
            apart_ns = abs(seen_ns - t_ns)
            for plate in others:
                if apart_ns <= NEAR_NS and plate.track_id not in here:
                    known = nearest.get(plate.track_id)
                    if known is None or apart_ns < known[0]:
                        nearest[plate.track_id] = (apart_ns, plate)
        return [plate for _, plate in nearest.values()]
