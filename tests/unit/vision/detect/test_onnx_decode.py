"""Output layouts of plugged-in detectors, each against boxes put there on purpose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.vision.detect.onnx_decode import (
    decode_detr,
    decode_ssd_corners,
    decode_yolo,
    decode_yolo_corners,
    ssd_priors,
)

BOX = np.array([100.0, 50.0, 180.0, 70.0])  # left, top, right, bottom, edges between pixels
CENTRE = np.array([140.0, 60.0, 80.0, 20.0])
CORNERS = np.array([[99.5, 49.5], [179.5, 49.5], [179.5, 69.5], [99.5, 69.5]])


def _only(found, score):
    assert len(found) == 1
    assert found[0].corners_px == pytest.approx(CORNERS, abs=1e-3)
    assert found[0].score == pytest.approx(score, abs=1e-4)


def test_yolo_v8_columns_of_centres_and_classes():
    out = np.zeros((1, 6, 8400), np.float32)
    out[0, :4, 77], out[0, 5, 77] = CENTRE, 0.9
    out[0, :4, 78], out[0, 5, 78] = CENTRE + 2, 0.7  # its double
    out[0, :4, 79], out[0, 4, 79] = CENTRE + 200, 0.99  # another class
    _only(decode_yolo(out, 1, 0.4), 0.9)


def test_yolo_v5_rows_with_objectness():
    out = np.zeros((1, 25200, 6), np.float32)
    out[0, 5, :4], out[0, 5, 4:] = CENTRE, (0.9, 0.8)
    _only(decode_yolo(out, 0, 0.4), 0.72)


def test_yolo_end_to_end_rows_of_corners_score_class():
    out = np.zeros((1, 300, 6), np.float32)
    out[0, 0] = [*BOX, 0.8, 0]
    out[0, 1] = [*(BOX + 300), 0.9, 2]
    _only(decode_yolo(out, 0, 0.4), 0.8)


@pytest.mark.parametrize("per_point", [2, 3])
def test_yolo_key_points_in_any_order(per_point):
    out = np.zeros((1, 5 + 4 * per_point, 5000), np.float32)
    points = np.ones((4, per_point), np.float32)
    points[:, :2] = CORNERS[[2, 0, 3, 1]] + 0.5
    out[0, 4, 9], out[0, 5:, 9] = 0.95, points.ravel()
    _only(decode_yolo_corners(out, 1, 0, 0.4), 0.95)
    with pytest.raises(ValueError, match="key point"):
        decode_yolo_corners(out, 2, 0, 0.4)


@pytest.mark.parametrize("size", [(30.0, 40.0), (36.0, 36.0), (80.0, 20.0)])
def test_a_box_taller_than_wide_is_not_turned(size):
    out = np.zeros((1, 5, 400), np.float32)
    out[0, :, 0] = 100, 60, *size, 0.9
    (found,) = decode_yolo(out, 0, 0.3)
    w, h = size
    corners = np.array([[-w, -h], [w, -h], [w, h], [-w, h]]) / 2 + (100, 60) - 0.5
    assert found.corners_px == pytest.approx(corners)


def _parallelogram(aspect, width, roll, shear):
    """A plate's corners TL, TR, BR, BL, its top and bottom sheared as by yaw."""
    u, v = np.array([width, width * shear]), np.array([0.0, width / aspect])
    c, s = np.cos(roll), np.sin(roll)
    return np.array([-u - v, u - v, u + v, v - u]) / 2 @ np.array([[c, s], [-s, c]]) + (400, 300)


def _key_points(corners):
    out = np.zeros((1, 13, 400), np.float32)
    out[0, 4, 9], out[0, 5:, 9] = 0.95, (corners + 0.5).ravel()
    (found,) = decode_yolo_corners(out, 1, 0, 0.4)
    return found.corners_px


@given(aspect=st.floats(0.3, 5.0), width=st.floats(8, 300), roll=st.floats(-0.5, 0.5), shear=st.floats(-0.2, 0.2))
def test_key_points_in_order_stay_in_order_whatever_the_shape(aspect, width, roll, shear):
    true = _parallelogram(aspect, width, roll, shear)
    assert _key_points(true) == pytest.approx(true, abs=1e-3)


@given(order=st.permutations([0, 1, 2, 3]), aspect=st.floats(1.5, 5.0), roll=st.floats(-0.5, 0.5), shear=st.floats(-0.2, 0.2))
def test_key_points_of_a_wide_plate_are_put_in_order(order, aspect, roll, shear):
    true = _parallelogram(aspect, 100, roll, shear)
    assert _key_points(true[list(order)]) == pytest.approx(true, abs=1e-3)


def test_a_class_beyond_the_last_is_no_class():
    """What follows the classes are key points (yolo-corners), or the class that means none (detr): neither is a score."""
    out = np.zeros((1, 13, 400), np.float32)
    out[0, :4, 0], out[0, 5:, 0] = CENTRE, CORNERS.ravel()
    with pytest.raises(ValueError, match="onnx_class"):
        decode_yolo_corners(out, 1, 1, 0.3)
    outputs = {"pred_boxes": np.full((1, 9, 4), 0.5, np.float32), "logits": np.zeros((1, 9, 2), np.float32)}
    with pytest.raises(ValueError, match="onnx_class"):
        decode_detr(outputs, 320, 160, 1, 0.4, no_object=True)


def test_ssd_corners_against_its_priors():
    sizes = ((24.0, 48.0), (96.0, 192.0), (384.0, 768.0))
    priors = ssd_priors(320, 160, sizes)
    assert len(priors) == 2 * (40 * 20 + 20 * 10 + 10 * 5)
    assert priors[0].tolist() == [4, 4, 24, 24]
    assert priors[3].tolist() == [12, 4, 48, 48]
    n, k = len(priors), 1700
    loc, conf, landms = (np.zeros((1, n, c), np.float32) for c in (4, 2, 8))
    conf[0, k] = 0.1, 0.9
    landms[0, k] = ((CORNERS + 0.5 - priors[k, :2]) / (0.1 * priors[k, 2:])).ravel()
    outputs = {"loc": loc, "conf": conf, "landms": landms}
    _only(decode_ssd_corners(outputs, 320, 160, sizes, 0.5), 0.9)
    with pytest.raises(ValueError, match="priors"):
        decode_ssd_corners(outputs, 640, 160, sizes, 0.5)
    with pytest.raises(ValueError, match="not boxes"):
        decode_ssd_corners({"loc": loc, "conf": conf}, 320, 160, sizes, 0.5)


def test_detr_with_sigmoids_and_with_a_no_object_class():
    boxes = np.full((1, 100, 4), 0.5, np.float32)
    boxes[0, 3] = CENTRE / [320, 160, 320, 160]
    sigmoid = np.full((1, 100, 2), -9.0, np.float32)
    sigmoid[0, 3, 1] = 2.0
    found = decode_detr({"pred_boxes": boxes, "logits": sigmoid}, 320, 160, 1, 0.4, no_object=False)
    _only(found, 1 / (1 + np.exp(-2)))
    softmax = np.zeros((1, 100, 2), np.float32)
    softmax[0, :, 1] = 9.0
    softmax[0, 3] = 3.0, 1.0
    found = decode_detr({"logits": softmax, "pred_boxes": boxes}, 320, 160, 0, 0.4, no_object=True)
    _only(found, np.exp(3) / (np.exp(3) + np.exp(1)))


@pytest.mark.parametrize("shape", [(1, 3, 20, 20), (2, 6, 8400), (1, 4, 8400)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(ValueError, match="no table of boxes"):
        decode_yolo(np.zeros(shape, np.float32), 0, 0.4)


def test_what_is_not_finite_is_refused():
    out = np.zeros((1, 5, 8400), np.float32)
    out[0, 4, 0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        decode_yolo(out, 0, 0.4)
    with pytest.raises(ValueError, match="onnx_class"):
        decode_yolo(np.zeros((1, 5, 8400), np.float32), 3, 0.4)
