"""Calibrations in files: the `[camera]` table of a configuration, ROS `camera_info` YAML, OpenCV YAML."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import tomlkit
import tomlkit.exceptions
import yaml

from tmde_edge.config import CalibrationRecord, from_tree
from tmde_edge.errors import ConfigError, InputDataError, InputMissingError, UsageError, writing
from tmde_edge.geometry.pinhole import Camera

_ROS_MODELS = {"plumb_bob": 5, "rational_polynomial": 8}
_NAMES = {
    "matrix": ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "intrinsic_matrix"),
    "distortion": ("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "dist_coeffs", "D", "dist_coeff"),
    "width": ("image_width", "image_Width", "width"),
    "height": ("image_height", "image_Height", "height"),
}


def camera_table(camera: Camera, record: CalibrationRecord, pose: Mapping[str, float]) -> dict[str, Any]:
    """Keys of `[camera]` for a calibration; values rounded to what they mean."""
    table: dict[str, Any] = {
        "width_px": camera.width_px, "height_px": camera.height_px, "fx_px": round(camera.fx_px, 3),
        "fy_px": round(camera.fy_px, 3), "cx_px": round(camera.cx_px, 3), "cy_px": round(camera.cy_px, 3),
        "focal_sigma": round(camera.focal_sigma, 5),
    }  # fmt: skip
    if camera.distortion:
        table["distortion"] = [float(f"{v:.8g}") for v in camera.distortion]
    table |= {k: round(v, 5) for k, v in pose.items()}
    table["calibration"] = _record(record)
    return table


def _record(record: CalibrationRecord) -> dict[str, Any]:
    plain: dict[str, Any] = msgspec.to_builtins(record)
    return {k: v for k, v in plain.items() if v not in (None, "", [])}


def table_text(table: Mapping[str, Any]) -> str:
    """The `[camera]` table as TOML."""
    text: str = tomlkit.dumps({"camera": dict(table)})
    return text


def write_config(path: Path, table: Mapping[str, Any], now: datetime, *, drop: tuple[str, ...] = ()) -> Path | None:
    """Sets keys of `[camera]` in a configuration file, all else untouched; atomic; returns where the old file is kept.

    The file is made where there is none. Raises ConfigError, UsageError.
    """
    path = path.resolve()  # a link stays a link
    old = _read(path)
    try:
        document = tomlkit.parse(old or "")
        camera = document.setdefault("camera", tomlkit.table())
        for key in drop:
            camera.pop(key, None)
        for key, value in table.items():
            if isinstance(value, Mapping):
                camera.pop(key, None)
                sub = tomlkit.table()
                for k, v in value.items():
                    sub.add(k, v)
                sub.add(tomlkit.nl())
                camera.add(key, sub)
            else:
                camera[key] = value
        text = tomlkit.dumps(document)
    except (tomlkit.exceptions.TOMLKitError, ValueError, AttributeError, TypeError) as e:
        raise ConfigError(f"{path}: [camera] cannot be set ({e}); mend the file first") from None
    from_tree(tomlkit.parse(text).unwrap(), str(path))  # what is written can be read
    kept: Path | None = None
    with writing(path):
        if old is not None:
            kept = path.with_name(f"{path.name}.bak-{now:%Y%m%d-%H%M%S}")
            _replace(kept, old, path)
        _replace(path, text, path)
    return kept


def file_size_px(path: Path) -> tuple[int, int] | None:
    """width_px and height_px that a configuration file states itself; None where it does not."""
    text = _read(path.resolve())
    try:
        camera = tomlkit.parse(text or "").unwrap().get("camera", {})
    except tomlkit.exceptions.TOMLKitError as e:
        raise ConfigError(f"configuration {path}: not TOML: {e}") from None
    width, height = camera.get("width_px"), camera.get("height_px")
    return (width, height) if isinstance(width, int) and isinstance(height, int) else None


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"configuration {path}: cannot be read ({e})") from None


def _replace(path: Path, text: str, like: Path) -> None:
    """Writes beside the file and renames: after a power cut there is the old file or the new one, nothing between."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as f:
            f.write(text)
            f.flush()
            os.fsync(f.fileno())
        os.chmod(name, like.stat().st_mode & 0o777 if like.exists() else 0o644)
        os.replace(name, path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


# -- other programs' files -------------------------------------------------------------------------------------------------


def read_camera(path: Path, focal_sigma: float) -> tuple[Camera, str]:
    """A ROS camera_info or OpenCV YAML (or XML) file as a camera and its name in the file.

    Raises InputMissingError, InputDataError (not readable, no matrix, a lens model that is not known here).
    """
    if not path.is_file():
        raise InputMissingError(f"{path}: no such calibration file")
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as e:
        raise InputDataError(f"{path}: cannot be read ({e.strerror or e})") from None
    opencv = text.startswith("%YAML:1.0") or "opencv-matrix" in text or text.lstrip().startswith("<?xml")
    values = _opencv_values(path) if opencv else _ros_values(path, text)
    matrix, lens = np.asarray(values["matrix"], np.float64), np.asarray(values["distortion"], np.float64).ravel()
    if matrix.size != 9 or not np.isfinite(matrix).all() or not np.isfinite(lens).all():
        raise InputDataError(f"{path}: the camera matrix is not nine finite numbers, or the distortion is not finite")
    matrix = matrix.reshape(3, 3)
    lens = lens if np.any(lens) else lens[:0]
    if len(lens) > 8 and not np.any(lens[8:]):
        lens = lens[:8]
    if len(lens) not in (0, 4, 5, 8):
        raise InputDataError(f"{path}: {len(lens)} distortion coefficients; 4, 5 or 8 (OpenCV's order) are known here")
    try:
        camera = Camera(
            width_px=int(values["width"]), height_px=int(values["height"]), fx_px=float(matrix[0, 0]),
            fy_px=float(matrix[1, 1]), cx_px=float(matrix[0, 2]), cy_px=float(matrix[1, 2]),
            distortion=tuple(float(v) for v in lens), focal_sigma=focal_sigma,
        )  # fmt: skip
    except (ValueError, TypeError) as e:
        raise InputDataError(f"{path}: {e}") from None
    return camera, str(values.get("name", ""))


def _ros_values(path: Path, text: str) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as e:
        raise InputDataError(f"{path}: not YAML ({' '.join(str(e).split())})") from None
    if not isinstance(tree, dict):
        raise InputDataError(f"{path}: not a camera_info file: it holds no keys")
    model = str(tree.get("distortion_model", "plumb_bob"))
    if model not in _ROS_MODELS:
        raise InputDataError(f"{path}: distortion model {model!r} is not known here; known: {', '.join(_ROS_MODELS)}")
    out: dict[str, Any] = {"name": tree.get("camera_name", ""), "distortion": []}
    for key, names in _NAMES.items():
        value = next((tree[n] for n in names if n in tree), None)
        if isinstance(value, dict):
            value = value.get("data")
        if value is not None:
            out[key] = value
        elif key != "distortion":
            raise InputDataError(f"{path}: no {names[0]} in this file")
    try:
        np.asarray(out["matrix"], np.float64), np.asarray(out["distortion"], np.float64)
    except (ValueError, TypeError):
        raise InputDataError(f"{path}: camera_matrix or distortion_coefficients are no lists of numbers") from None
    return out


def _opencv_values(path: Path) -> dict[str, Any]:
    try:
        store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as e:  # OpenCV's constructor wraps its own error
        raise InputDataError(f"{path}: OpenCV cannot read it ({' '.join(str(e.__cause__ or e).split())})") from None
    try:
        out: dict[str, Any] = {"distortion": np.zeros(0)}
        for key, names in _NAMES.items():
            node = next((n for name in names if not (n := store.getNode(name)).empty()), None)
            if node is not None:
                out[key] = node.mat() if key in ("matrix", "distortion") else node.real()
            elif key != "distortion":
                raise InputDataError(f"{path}: no {names[0]} in this file")
        if out["matrix"] is None or out["distortion"] is None:
            raise InputDataError(f"{path}: the camera matrix is not an OpenCV matrix")
        return out
    except cv2.error as e:
        raise InputDataError(f"{path}: OpenCV cannot read it ({' '.join(str(e.err or e).split())})") from None
    finally:
        store.release()


def export_camera(path: Path, camera: Camera, name: str, kind: str) -> None:
    """Writes "ros" (camera_info YAML) or "opencv" (YAML). Raises UsageError."""
    k = [camera.fx_px, 0.0, camera.cx_px, 0.0, camera.fy_px, camera.cy_px, 0.0, 0.0, 1.0]
    lens = [float(v) for v in camera.distortion] or [0.0] * 5
    lens += [0.0] * ((5 if len(lens) <= 5 else 8) - len(lens))
    if not all(math.isfinite(v) for v in [*k, *lens]):
        raise UsageError("the calibration is not finite")
    with writing(path):
        if kind == "ros":
            p = [camera.fx_px, 0.0, camera.cx_px, 0.0, 0.0, camera.fy_px, camera.cy_px, 0.0, 0.0, 0.0, 1.0, 0.0]
            tree = {
                "image_width": camera.width_px, "image_height": camera.height_px, "camera_name": name or "tmde_edge",
                "camera_matrix": {"rows": 3, "cols": 3, "data": k},
                "distortion_model": "plumb_bob" if len(lens) == 5 else "rational_polynomial",
                "distortion_coefficients": {"rows": 1, "cols": len(lens), "data": lens},
                "rectification_matrix": {"rows": 3, "cols": 3, "data": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]},
                "projection_matrix": {"rows": 3, "cols": 4, "data": p},
            }
            path.write_text(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None), encoding="utf-8")
            return
        with path.open("w", encoding="utf-8"):
            pass  # OpenCV does not say why it cannot write
        store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
        store.write("image_width", camera.width_px)
        store.write("image_height", camera.height_px)
        store.write("camera_matrix", np.array(k).reshape(3, 3))
        store.write("distortion_coefficients", np.array([lens]))
        store.release()
