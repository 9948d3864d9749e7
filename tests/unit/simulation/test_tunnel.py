"""A tunnel whose portal lies above or below the picture's lower edge."""

from __future__ import annotations

import numpy as np

from tmde_edge.simulation.camera import hd_camera, view_of
from tmde_edge.simulation.tunnel import paint_tunnel


def test_a_near_portal_leaves_no_road_to_darken() -> None:
    view = view_of(hd_camera())
    for portal_m in (0.5, 1.2, 2.5, 3.6, 6.0, 40.0):  # its foot is 1.3 m down: below the picture nearer than 5 m
        image = np.full((720, 1280, 3), 200, np.uint8)
        paint_tunnel(image, view, 1.3, portal_m, 7.0)
        assert (image[700, 640] < 100).all() == (portal_m > 5.2)
