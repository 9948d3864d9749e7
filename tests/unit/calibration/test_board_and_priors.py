"""Boards by OpenCV, and priors of known cameras."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from tmde_edge.calibration.board import Board, View, calibrate_board, charuco_pattern, find_view
from tmde_edge.calibration.priors import camera_prior, camera_priors
from tmde_edge.config import from_tree
from tmde_edge.errors import ConfigError, UsageError

BOARD = Board(kind="chessboard", columns=7, rows=5)
K = np.array([[900.0, 0, 319.5], [0, 900.0, 239.5], [0, 0, 1]])


def picture(board: Board, turn: tuple[float, float, float], shift: tuple[float, float]) -> np.ndarray:
    """The board as a camera with matrix K sees it, 640x480."""
    cell = 40
    if board.kind == "charuco":
        flat = charuco_pattern(board).generateImage((board.columns * cell, board.rows * cell))
        columns, rows = board.columns, board.rows
    else:
        columns, rows = board.columns + 1, board.rows + 1
        odd = np.add.outer(np.arange(rows), np.arange(columns)) % 2
        flat = np.kron(np.where(odd, 255, 0), np.ones((cell, cell))).astype(np.uint8)
    flat = cv2.copyMakeBorder(flat, cell, cell, cell, cell, cv2.BORDER_CONSTANT, value=255)
    r, _ = cv2.Rodrigues(np.array(turn))
    t = np.array([-columns / 2 + shift[0], -rows / 2 + shift[1], 14.0])
    plane = K @ np.column_stack([r[:, 0], r[:, 1], t])  # squares to pixels
    flat_from_squares = np.array([[cell, 0, cell - 0.5], [0, cell, cell - 0.5], [0, 0, 1]])
    view = cv2.warpPerspective(flat, plane @ np.linalg.inv(flat_from_squares), (640, 480), borderValue=255)
    return cv2.GaussianBlur(view, (0, 0), 0.7)


TURNS = [(0.3, 0, 0), (-0.3, 0.1, 0), (0, 0.35, 0.1), (0.1, -0.35, 0), (0.25, 0.25, -0.1), (-0.2, -0.3, 0.05)]


@pytest.mark.parametrize("board", [BOARD, Board(kind="charuco", columns=7, rows=5)])
def test_known_camera_comes_out(board: Board) -> None:
    views = [find_view(f"v{i}", picture(board, t, (0.3 * i - 1, 0.2 * i - 0.5)), board) for i, t in enumerate(TURNS)]
    good = [v for v in views if isinstance(v, View)]
    assert len(good) == len(TURNS)
    found = calibrate_board(good)
    assert not isinstance(found, str)
    assert found.fx_px == pytest.approx(900, rel=0.01)
    assert abs(found.fx_px / 900 - 1) < 3 * found.sigma
    assert found.rms_px < 0.3
    assert all(rms < 0.5 for _, rms in found.views)


def test_bad_views_are_refused_by_name() -> None:
    good = [find_view(f"v{i}", picture(BOARD, t, (0, 0)), BOARD) for i, t in enumerate(TURNS)]
    views = [v for v in good if isinstance(v, View)]
    rng = np.random.default_rng(0)
    bent = views[0].pixels + rng.normal(0, 4, views[0].pixels.shape).astype(np.float32)
    views.append(View(name="bent", width_px=640, height_px=480, board=views[0].board, pixels=bent))
    views.append(View(name="other size", width_px=641, height_px=480, board=views[0].board, pixels=views[0].pixels))
    found = calibrate_board(views, [("empty", "no board")])
    assert not isinstance(found, str)
    assert {name for name, _ in found.refused} == {"bent", "other size", "empty"}
    assert isinstance(find_view("grey", np.full((480, 640), 128, np.uint8), BOARD), str)


def test_too_few_views_and_views_that_say_nothing() -> None:
    v = find_view("v", picture(BOARD, TURNS[0], (0, 0)), BOARD)
    assert isinstance(v, View)
    assert "too few" in str(calibrate_board([v, v]))
    with pytest.raises(UsageError, match="unknown"):
        find_view("v", np.zeros((10, 10), np.uint8), Board(kind="charuco", columns=5, rows=4, dictionary="DICT_NONE"))


@pytest.mark.real
def test_real_chessboard_photos() -> None:
    folder = Path(os.environ.get("TMDE_SHARED", "../shared")) / "data/roads/camera_cal"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    board = Board(kind="chessboard", columns=9, rows=6)
    seen = [(p.name, find_view(p.name, cv2.imread(str(p)), board)) for p in sorted(folder.glob("*.jpg"))]
    found = calibrate_board([v for _, v in seen if isinstance(v, View)], [(n, v) for n, v in seen if isinstance(v, str)])
    assert not isinstance(found, str)
    assert found.fx_px == pytest.approx(1159, rel=0.01)
    assert found.rms_px < 1.0
    assert len(found.views) + len(found.refused) == 20


def test_priors() -> None:
    assert set(camera_priors()) == {"pi-v2", "pi-v3", "pi-v3-wide", "hq", "c920", "ov9281", "imx296"}
    v3 = camera_prior("pi-v3")
    assert v3.focal_px(4608, 2592) == pytest.approx(3386, abs=1)
    assert v3.focal_px(1280, 720) == pytest.approx(940.5, abs=1)
    assert v3.focal_px(1536, 864) == pytest.approx(1693, abs=1)  # read from the sensor's middle
    assert camera_prior("hq").focal_px(4056, 3040, 16.0) == pytest.approx(10323, abs=1)
    with pytest.raises(ConfigError, match="no lens of its own"):
        camera_prior("imx296").focal_px(1456, 1088)
    with pytest.raises(ConfigError, match="did you mean 'pi-v3'"):
        camera_prior("pi_v3")


def test_a_prior_stands_in_until_calibrated_with_its_own_sigma() -> None:
    camera = from_tree({"camera": {"prior": "pi-v3"}}, "x").camera.camera()
    assert camera is not None
    assert camera.fx_px == pytest.approx(940.5, abs=1)
    assert camera.focal_sigma == 0.05
    done = from_tree({"camera": {"prior": "pi-v3", "fx_px": 1000.0}}, "x").camera.camera()
    assert done is not None
    assert (done.fx_px, done.focal_sigma) == (1000.0, 0.005)
    with pytest.raises(ConfigError, match=r"camera\.prior.*lens"):
        from_tree({"camera": {"prior": "hq"}}, "x")


def test_files_in_config_are_the_ones_in_use() -> None:
    root = Path(__file__).parents[3]
    shipped = {p.name: p.read_text() for p in (root / "config/cameras").glob("*.toml")}
    assert shipped == {p.name: p.read_text() for p in (root / "tmde_edge/calibration/data").glob("*.toml")}
    assert shipped
