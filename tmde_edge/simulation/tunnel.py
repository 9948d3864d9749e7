"""The inside of a tunnel round the view of its portal."""

from __future__ import annotations

import cv2
import numpy as np

from tmde_edge.simulation.camera import Array, View
from tmde_edge.simulation.compose import Image

LEFT_M, RIGHT_M, HEIGHT_M = -6.2, 4.0, 5.2
INSIDE_GAIN = 0.30
_WALL = (46.0, 48.0, 50.0)
_CEILING = (30.0, 31.0, 32.0)


def paint_tunnel(image: Image, view: View, down_m: float, portal_z_m: float, s_m: float) -> None:
    """Darken the road in the tunnel and draw walls, ceiling and lamps up to the portal; lamps stand still in s."""
    if portal_z_m <= 1.0:
        return
    near = 1.0
    top = down_m - HEIGHT_M

    def flat(points: list[tuple[float, float, float]], colour: tuple[float, float, float]) -> None:
        px = view.project(np.array(points))
        cv2.fillPoly(image, [np.rint(np.clip(px, -20000, 20000) * 16).astype(np.int32)], list(colour), cv2.LINE_AA, 4)

    portal: Array = view.project(np.array([[LEFT_M, top, portal_z_m], [RIGHT_M, down_m, portal_z_m]]))
    row = int(np.clip(np.ceil(portal[1, 1]), 0, image.shape[0]))
    if row < image.shape[0]:  # else the road's dark part lies below the picture
        image[row:] = cv2.convertScaleAbs(image[row:], alpha=INSIDE_GAIN)
    for x in (LEFT_M, RIGHT_M):
        flat([(x, down_m, near), (x, top, near), (x, top, portal_z_m), (x, down_m, portal_z_m)], _WALL)
        flat([(x, down_m, near), (x, down_m - 1.1, near), (x, down_m - 1.1, portal_z_m), (x, down_m, portal_z_m)], (64, 66, 68))
    flat([(LEFT_M, top, near), (RIGHT_M, top, near), (RIGHT_M, top, portal_z_m), (LEFT_M, top, portal_z_m)], _CEILING)
    first = 12.0 - s_m % 12.0
    for z in np.arange(first, portal_z_m - 1.6, 12.0):
        if z < 2.0:
            continue
        for x in (LEFT_M + 1.2, RIGHT_M - 1.2):
            flat([(x - 0.15, top, z), (x + 0.15, top, z), (x + 0.15, top, z + 1.5), (x - 0.15, top, z + 1.5)], (190, 215, 230))
