"""`tmde-edge simulate --stills N`: rendered photos of one plate each, with labels.csv, as `tmde-edge evaluate` reads them."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.errors import UsageError
from tmde_edge.plates.standard import load_standards
from tmde_edge.simulation.camera import SimCamera, hd_camera
from tmde_edge.simulation.stills import render_still

WIDTHS_PX = (20.0, 300.0)  # of the plate, log uniform
TURNED_RAD, LEANS_RAD, ROLLED_RAD = 0.15, 0.06, 0.02  # one sigma
NIGHT_SHARE = 0.2
LENS_HEIGHT_M = 0.9  # about as high as plates are: the nearest stay in the picture
JPEG_QUALITY = 95
COLUMNS = (
    "image", "tl_x_px", "tl_y_px", "tr_x_px", "tr_y_px", "br_x_px", "br_y_px", "bl_x_px", "bl_y_px", "characters",
    "char_height_px", "distance_m",
)


def simulate_stills(
    count: int, out: Path, *, standard: str, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> None:
    """`count` images of plates of `standard`, labels.csv and config.toml into a folder. Raises UsageError."""
    if count < 1:
        raise UsageError(f"--stills {count}: at least 1")
    if standard not in load_standards():
        raise UsageError(f"--plate {standard}: no such plate standard; `tmde-edge plates list` names them")
    try:
        out.mkdir(parents=True, exist_ok=True)
        camera = hd_camera(height_m=LENS_HEIGHT_M)
        with (out / "labels.csv").open("w", newline="", encoding="utf-8") as f:
            rows = csv.writer(f)
            rows.writerow(COLUMNS)
            for k in range(count):
                name = f"{k:04}.jpg"
                image, row = _still(standard, (seed, k), camera)
                if not cv2.imwrite(str(out / name), image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]):
                    raise UsageError(f"{out / name}: cannot be written; is the disk full, or the folder not yours?")
                rows.writerow([name, *row])
                if progress is not None:
                    progress(k + 1, count)
        (out / "config.toml").write_text(_config_text(camera, standard, count, seed), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{out}: cannot be written ({error.strerror or error}); name another --out") from None


def _still(standard: str, seed: tuple[int, int], camera: SimCamera) -> tuple[NDArray[np.uint8], list[float]]:
    rng = np.random.default_rng(seed)
    width_px = float(np.exp(rng.uniform(*np.log(WIDTHS_PX))))
    yaw, tilt, roll = (float(v) for v in rng.normal(0, (TURNED_RAD, LEANS_RAD, ROLLED_RAD)))
    night = bool(rng.random() < NIGHT_SHARE)
    still = render_still(
        standard, width_px=width_px, yaw_rad=yaw, tilt_rad=tilt, roll_rad=roll, camera=camera, night=night,
        seed=int(rng.integers(2**31)), true_sizes=True,
    )  # fmt: skip
    corners = [round(float(v), 3) for v in still.corners_px.ravel()]
    return still.image, [*corners, len(still.glyph_boxes_px), round(still.char_height_px, 3), round(still.distance_m, 4)]


def _config_text(camera: SimCamera, standard: str, count: int, seed: int) -> str:
    lines = [
        f"# made by: tmde-edge simulate --stills {count} --plate {standard} --seed {seed}", "[camera]",
        f"width_px = {camera.width_px}", f"height_px = {camera.height_px}", f"fx_px = {camera.fx_px:.6f}",
        f"fy_px = {camera.fy_px:.6f}", f"cx_px = {camera.cx_px:.3f}", f"cy_px = {camera.cy_px:.3f}",
        f"height_m = {camera.height_m:.4f}", f"pitch_rad = {camera.pitch_rad:.6f}", f"roll_rad = {camera.roll_rad:.6f}", "",
        "[plates]", f'expect = ["{standard}"]', "",
    ]  # fmt: skip
    return "\n".join(lines)
