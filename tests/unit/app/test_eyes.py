"""Where the eyes look: the fovea follows the calibrated driving path, not the picture's middle."""

from __future__ import annotations

import numpy as np

from tmde_edge.app.eyes import Eyes, calibrated_prior
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Frame, Sighting
from tmde_edge.pose.settings import PoseSettings

CAMERA = Camera(width_px=1280, height_px=720, fx_px=1100.0, fy_px=1100.0, cx_px=639.5, cy_px=359.5)


class Perception:
    """Remembers where the far road was said to be when it was asked to look."""

    def __init__(self) -> None:
        self.far_point_px: tuple[float, float] | None = None
        self.asked: list[tuple[float, float] | None] = []

    def see(self, frame: Frame) -> Sighting:
        self.asked.append(self.far_point_px)
        return Sighting(t_ns=frame.t_ns, frame_index=frame.index, width_px=1280, height_px=720, status="no_plate")


def looked(camera: Camera | None, pitch_rad: float) -> tuple[float, float] | None:
    perception = Perception()
    eyes = Eyes(perception, PoseSettings(method="none"), calibrated_prior(camera, pitch_rad, 0.0, 0.0), lambda: 0)  # type: ignore[arg-type]
    eyes.see(Frame(t_ns=1, index=0, image=np.zeros((720, 1280, 3), np.uint8)))
    return perception.asked[0]


def test_the_fovea_looks_where_a_tilted_camera_sees_the_far_road() -> None:
    level, down = looked(CAMERA, 0.0), looked(CAMERA, 0.12)
    assert level is not None
    assert down is not None
    assert abs(level[1] - 359.5) < 0.6
    assert abs(abs(down[1] - level[1]) - 1100 * np.tan(0.12)) < 1.0


def test_without_a_calibration_it_looks_at_the_middle() -> None:
    assert looked(None, 0.0) is None
