"""Plate outlines as four ordered corners, and the plate's picture seen from the front.

Pixel (0, 0) of a rectified picture of w x h pixels is centred at (0, 0); the plate's corners lie at (-0.5, -0.5) and
(w - 0.5, h - 0.5), so that the picture holds the plate exactly.
"""

from __future__ import annotations

from math import hypot

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.vision.protocols import Image

Array = NDArray[np.float64]
KEYSTONE = 0.02  # one sigma of how far perspective moves a corner off the parallelogram, in half heights
SHEAR = 0.05  # one sigma of a plate's shear: tangent of the angle that is missing to a right one


def to_grey(image: Image) -> Image:
    """(h, w) of a grey, BGR or BGRA image; a grey image is passed on as it is."""
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    code = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


def order_corners(points_px: Array) -> Array:
    """(4, 2) in any order to TL, TR, BR, BL: clockwise on the screen, the top side being the upper of the two long ones.

    Raises ValueError when the four points do not make a convex quadrilateral.
    """
    centre = points_px.mean(axis=0)
    angles = np.arctan2(points_px[:, 1] - centre[1], points_px[:, 0] - centre[0])
    ring = points_px[np.argsort(angles)]  # clockwise on the screen, because y points down
    if not is_convex(ring):
        raise ValueError(f"not a convex quadrilateral: {points_px.tolist()}")
    sides = np.hypot(*(np.roll(ring, -1, axis=0) - ring).T)
    # the two opposite sides that are longer together are top and bottom
    first = 0 if sides[0] + sides[2] >= sides[1] + sides[3] else 1
    a, b = ring[[first, (first + 1) % 4]].mean(axis=0), ring[[(first + 2) % 4, (first + 3) % 4]].mean(axis=0)
    start = first if a[1] <= b[1] else (first + 2) % 4
    return np.asarray(np.roll(ring, -start, axis=0))


def is_convex(corners_px: Array) -> bool:
    """Whether four corners in order make a convex quadrilateral of some area, turning clockwise on the screen."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners_px.tolist()  # scalars of lists are quicker than those of arrays
    px, py, qx, qy, rx, ry, sx, sy = bx - ax, by - ay, cx - bx, cy - by, dx - cx, dy - cy, ax - dx, ay - dy
    turns = px * qy - py * qx, qx * ry - qy * rx, rx * sy - ry * sx, sx * py - sy * px
    return all(turn > 1e-9 for turn in turns)


def size_px(corners_px: Array) -> tuple[float, float]:
    """Mean width and height of a quadrilateral, pixels."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners_px.tolist()
    return (hypot(bx - ax, by - ay) + hypot(cx - dx, cy - dy)) / 2, (hypot(dx - ax, dy - ay) + hypot(cx - bx, cy - by)) / 2


def steadied(corners_px: Array, sigma_px: float) -> Array:
    """Corners drawn towards what a plate can look like, as far as their own sigma allows.

    Seen from afar a plate is a parallelogram (perspective makes opposite sides differ by a few per cent) with nearly a
    right angle (yaw and pitch together shear it little). Both are shrunk as Gaussian priors; large plates do not move.
    """
    tl, tr, br, bl = corners_px
    centre, u, v, d = corners_px.mean(axis=0), (tr + br - tl - bl) / 4, (bl + br - tl - tr) / 4, (tl - tr + br - bl) / 4
    width, height = hypot(*u.tolist()), hypot(*v.tolist())
    if width < 1e-6 or height < 1e-6:
        return corners_px
    noise = (sigma_px / 2) ** 2  # of each component of u, v, d: a mean of four corners
    d = d * (KEYSTONE * height) ** 2 / ((KEYSTONE * height) ** 2 + noise)
    along = u / width
    shear = float(along @ v)
    v = v - along * shear * noise / ((SHEAR * height) ** 2 + noise)
    signs = np.array([[-1, -1, 1], [1, -1, -1], [1, 1, 1], [-1, 1, -1]], np.float64)
    return np.asarray(centre + signs @ np.stack([u, v, d]))


def bounds(corners_px: Array) -> tuple[float, float, float, float]:
    """x0, y0, x1, y1 of the upright box round a quadrilateral."""
    xs, ys = corners_px.T.tolist()
    return min(xs), min(ys), max(xs), max(ys)


def homography_source_from_rectified(corners_px: Array, width_px: int, height_px: int) -> Array:
    """(3, 3): source pixel of a rectified pixel. Raises ValueError for corners that span no area."""
    if not is_convex(corners_px):
        raise ValueError(f"corners do not make a convex quadrilateral: {corners_px.tolist()}")
    x, y = width_px - 0.5, height_px - 0.5
    flat = np.array([[-0.5, -0.5], [x, -0.5], [x, y], [-0.5, y]], np.float32)
    return np.asarray(cv2.getPerspectiveTransform(flat, corners_px.astype(np.float32)), dtype=np.float64)


def rectify(image: Image, corners_px: Array, width_px: int, height_px: int) -> tuple[Image, Array]:
    """The plate from the front, (height, width[, 3]) by bicubic interpolation, and the homography source <- rectified.

    Beyond the image its border pixels are repeated. Raises ValueError for corners that span no area.
    """
    if width_px < 1 or height_px < 1:
        raise ValueError(f"rectified size {width_px} x {height_px} px")
    source_from_rectified = homography_source_from_rectified(corners_px, width_px, height_px)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    flat = cv2.warpPerspective(
        image, source_from_rectified, (width_px, height_px), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(flat, dtype=np.uint8), source_from_rectified


def rectify_grey(image: Image, corners_px: Array, width_px: int, height_px: int) -> tuple[Image, Array]:
    """`rectify` of a grey, BGR or BGRA image to grey; only the part round the plate is converted and read."""
    h, w = image.shape[:2]
    x0, y0, x1, y1 = bounds(corners_px)
    left, top = int(min(max(x0 - 4, 0), w - 1)), int(min(max(y0 - 4, 0), h - 1))
    right, bottom = int(min(max(x1 + 5, left + 1), w)), int(min(max(y1 + 5, top + 1), h))
    flat, crop_from_flat = rectify(to_grey(image[top:bottom, left:right]), corners_px - (left, top), width_px, height_px)
    source_from_crop = np.array([[1.0, 0.0, left], [0.0, 1.0, top], [0.0, 0.0, 1.0]])
    return flat, np.asarray(source_from_crop @ crop_from_flat)


def apply_homography(homography: Array, points: Array) -> Array:
    """(n, 2) points through a (3, 3) homography."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
