"""Intrinsics and distortion from views of a chessboard or a ChArUco board (OpenCV), bad views refused by name.

Zhang, "A Flexible New Technique for Camera Calibration", PAMI 2000, as cv2.calibrateCameraExtended has it.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.errors import UsageError

Image = NDArray[np.uint8]

MIN_VIEWS = 4
MIN_CHARUCO_CORNERS = 8
BAD_VIEW_PX = 1.0  # rms of a view, and
BAD_VIEW_RATIO = 2.0  # times the median view: such a view is wrong (bent board, motion), not merely noisy
MAX_SIGMA = 0.02  # of fx: views that all face the board do not tell the focal length
LEAST_SIGMA = 0.001  # OpenCV's own sigma knows nothing of a board that is not flat
_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A chessboard (columns, rows: inner corners) or a ChArUco board (columns, rows: squares)."""

    kind: str  # "chessboard", "charuco"
    columns: int
    rows: int
    dictionary: str = "DICT_4X4_50"
    marker_share: float = 0.75  # side of a marker over that of a square
    legacy: bool = False  # ChArUco pattern of OpenCV before 4.6


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """Board points (n, 3) in squares and their pixels (n, 2)."""

    name: str
    width_px: int
    height_px: int
    board: NDArray[np.float32]
    pixels: NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardCalibration:
    """Intrinsics with relative sigma; rms_px of all used views and of each; refused views with the reason."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...]
    sigma: float
    rms_px: float
    views: tuple[tuple[str, float], ...]
    refused: tuple[tuple[str, str], ...]


def parse_size(text: str, what: str) -> tuple[int, int]:
    """"9x6" as (9, 6). Raises UsageError."""
    match = re.fullmatch(r"(\d{1,3})[xX,](\d{1,3})", text.strip())
    if match is None or min(int(match[1]), int(match[2])) < 2:
        raise UsageError(f"{what} {text}: give columns x rows, for example 9x6")
    return int(match[1]), int(match[2])


def find_view(name: str, image: Image, board: Board) -> View | str:
    """The board's corners in one image, to sub-pixels, or why there are none. Raises UsageError (unknown dictionary)."""
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    found = _chessboard(grey, board) if board.kind == "chessboard" else _charuco(grey, board)
    if isinstance(found, str):
        return found
    points, pixels = found
    return View(name=name, width_px=grey.shape[1], height_px=grey.shape[0], board=points, pixels=pixels)


def _chessboard(grey: Image, board: Board) -> tuple[NDArray[np.float32], NDArray[np.float32]] | str:
    size = (board.columns, board.rows)
    ok, corners = cv2.findChessboardCorners(grey, size, flags=_FLAGS)
    if not ok:
        return f"no whole chessboard of {board.columns}x{board.rows} inner corners is seen"
    points = np.asarray(corners, dtype=np.float32).reshape(-1, 2)
    grid = points.reshape(board.rows, board.columns, 2)
    steps = np.concatenate([np.hypot(*np.moveaxis(np.diff(grid, axis=a), -1, 0)).ravel() for a in (0, 1)])
    reach = int(np.clip(steps.min() / 3, 2, 11))  # the window must not reach the neighbouring corner
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    exact = cv2.cornerSubPix(grey, np.ascontiguousarray(points.reshape(-1, 1, 2)), (reach, reach), (-1, -1), criteria)
    plane = np.zeros((board.columns * board.rows, 3), np.float32)
    plane[:, :2] = np.array([(c, r) for r, c in itertools.product(range(board.rows), range(board.columns))], np.float32)
    return plane, np.asarray(exact, dtype=np.float32).reshape(-1, 2)


def _charuco(grey: Image, board: Board) -> tuple[NDArray[np.float32], NDArray[np.float32]] | str:
    pattern = charuco_pattern(board)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
    count = 0 if ids is None else len(ids)
    if count < MIN_CHARUCO_CORNERS or ids is None:
        return f"{count} corners of the ChArUco board are seen, at least {MIN_CHARUCO_CORNERS} are needed"
    numbers = np.asarray(ids).ravel()
    every = np.asarray(pattern.getChessboardCorners(), dtype=np.float32).reshape(-1, 3)
    if pattern.checkCharucoCornersCollinear(np.asarray(ids)):
        return "the corners seen lie on one line"
    return every[numbers], np.asarray(corners, dtype=np.float32).reshape(-1, 2)


def charuco_pattern(board: Board) -> cv2.aruco.CharucoBoard:
    """OpenCV's board with squares of side 1. Raises UsageError for an unknown dictionary."""
    number = getattr(cv2.aruco, board.dictionary, None)
    if not board.dictionary.startswith("DICT_") or not isinstance(number, int):
        known = ", ".join(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
        raise UsageError(f"--dictionary {board.dictionary}: unknown; known: {known}")
    pattern = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), 1.0, board.marker_share, cv2.aruco.getPredefinedDictionary(number)
    )
    if board.legacy:
        pattern.setLegacyPattern(True)
    return pattern


def calibrate_board(views: Sequence[View], refused: Sequence[tuple[str, str]] = ()) -> BoardCalibration | str:
    """Intrinsics of the most frequent image size; views far worse than the others are refused one by one, or why not."""
    out = list(refused)
    sizes = [(v.width_px, v.height_px) for v in views]
    if not sizes:
        return "no view shows the board"
    size = max(sizes, key=sizes.count)
    out += [(v.name, f"{s[0]}x{s[1]} px, the others {size[0]}x{size[1]} px")
            for v, s in zip(views, sizes, strict=True) if s != size]  # fmt: skip
    used = [v for v, s in zip(views, sizes, strict=True) if s == size]
    while True:
        if len(used) < MIN_VIEWS:
            return f"too few good views: {len(used)}, at least {MIN_VIEWS}; " + "; ".join(f"{n}: {r}" for n, r in out)
        try:
            rms, matrix, lens, _, _, sigmas, _, per_view = cv2.calibrateCameraExtended(
                [v.board for v in used], [v.pixels.reshape(-1, 1, 2) for v in used], size, np.eye(3), np.zeros(5)
            )
        except cv2.error as error:
            return f"OpenCV finds no camera for these views ({' '.join(str(error.err or error).split())})"
        errors = np.asarray(per_view, dtype=np.float64).ravel()
        worst, middle = int(errors.argmax()), float(np.median(errors))
        if errors[worst] > max(BAD_VIEW_PX, BAD_VIEW_RATIO * middle):
            out.append((used[worst].name, f"rms {errors[worst]:.2f} px where the median view has {middle:.2f} px: "
                                          "blurred, bent or wrongly seen"))  # fmt: skip
            del used[worst]
            continue
        break
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    spread = np.asarray(sigmas, dtype=np.float64).ravel()
    sigma = max(float(np.hypot(spread[0] / fx, spread[1] / fy) / 2**0.5), LEAST_SIGMA)
    values = np.array([fx, fy, matrix[0, 2], matrix[1, 2], sigma, *np.asarray(lens).ravel()])
    if not np.isfinite(values).all():
        return "OpenCV's answer is not finite: the views do not determine the camera"
    if sigma > MAX_SIGMA:
        return f"one sigma of the focal length is {100 * sigma:.1f} %: tilt the board more, and into the picture's corners"
    return BoardCalibration(
        width_px=size[0], height_px=size[1], fx_px=fx, fy_px=fy, cx_px=float(matrix[0, 2]), cy_px=float(matrix[1, 2]),
        distortion=tuple(float(v) for v in np.asarray(lens).ravel()[:5]), sigma=sigma, rms_px=float(rms),
        views=tuple((v.name, float(e)) for v, e in zip(used, errors, strict=True)), refused=tuple(out),
    )
