"""The annotated picture: readable at any size, drawn where the plate is, coloured as the alert."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tmde_edge.app.overlay import ALERT_COLOURS, draw, lead_lines
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import (
    Alert,
    AlertLevel,
    EgoState,
    FrameResult,
    GlyphSighting,
    LeadEstimate,
    PlateResult,
    PlateSighting,
    Pose,
    RangeMeasurement,
)

CAMERA = Camera(width_px=1280, height_px=720, fx_px=1200, fy_px=1200, cx_px=639.5, cy_px=359.5)
GLYPH = GlyphSighting(
    left_px=(620.0, 400.0), right_px=(630.0, 400.0), top_px=(625.0, 392.0), bottom_px=(625.0, 408.0), sigma_tb_px=0.1,
    sigma_lr_px=0.1,
)  # fmt: skip
PLATE = PlateSighting(
    track_id=1, corners_px=((600.0, 390.0), (700.0, 390.0), (700.0, 410.0), (600.0, 410.0)), corners_sigma_px=0.1,
    score=0.9, glyphs=(GLYPH,),
)  # fmt: skip
RANGE = RangeMeasurement(
    track_id=1, t_ns=0, distance_m=6.2, sigma_m=0.1, noise_m=0.1, scale_sigma=0.0, lateral_m=0.0, lateral_sigma_m=0.1,
    down_m=0.3, standard="de-1line",
)  # fmt: skip
LEAD = LeadEstimate(
    track_id=1, distance_m=6.2, sigma_m=0.1, range_rate_mps=-2.0, range_rate_sigma_mps=0.2, ttc_s=3.1, ttc_sigma_s=0.3,
    headway_s=0.6, coasting_s=0.0, source="plate",
)  # fmt: skip


def result(level: AlertLevel = "none") -> FrameResult:
    return FrameResult(
        t_ns=0, frame_index=0, plates=(PlateResult(sighting=PLATE, range=RANGE, lead=True),), lead=LEAD,
        ego=EgoState(t_ns=0, speed_mps=10.0, yaw_rate_radps=0.0), pose=Pose(pitch_rad=0.02, roll_rad=0.0, source="lanes"),
        depth=None, alert=Alert(level=level, reason="ttc", ttc_s=3.1), faults=("can_lost",), mode="strict",
    )  # fmt: skip


@pytest.mark.parametrize("level", ["none", "caution", "warning"])
def test_the_lead_plate_and_the_banner_have_the_colour_of_the_alert(level: AlertLevel) -> None:
    source = np.full((720, 1280, 3), 128, np.uint8)
    picture = draw(source, result(level), CAMERA)
    assert (source == 128).all()
    for x in (640, 660, 680):
        assert np.abs(picture[410, x].astype(int) - ALERT_COLOURS[level]).max() < 40
    expected = ALERT_COLOURS[level] if level != "none" else (58, 58, 58)
    assert np.abs(picture[4, 640].astype(int) - expected).max() < 45


def test_the_horizon_lies_where_the_pose_says() -> None:
    source = np.zeros((720, 1280, 3), np.uint8)
    with_pose = draw(source, result(), CAMERA)
    changed = np.argwhere(with_pose[200:500, 300:560].max(axis=2) > 60)
    row = 359.5 - 1200 * np.tan(0.02)  # nose down: the horizon rises
    assert np.abs(changed[:, 0] + 200 - row).max() < 3
    none = dataclasses.replace(result(), pose=Pose(pitch_rad=0.0, roll_rad=0.0, source="none"))
    assert not draw(source, none, CAMERA)[200:380, 300:560].any()


def test_a_small_grey_picture_is_enlarged_so_that_the_text_stays_readable() -> None:
    small = dataclasses.replace(result(), plates=())
    picture = draw(np.full((240, 320), 90, np.uint8), small, None)
    assert picture.shape == (720, 960, 3)


def test_drawing_on_an_enlarged_picture_keeps_pixel_centres() -> None:
    corners = ((10.0, 60.0), (40.0, 60.0), (40.0, 70.0), (10.0, 70.0))
    plate = dataclasses.replace(PLATE, corners_px=corners, glyphs=())
    one = dataclasses.replace(result("warning"), plates=(PlateResult(sighting=plate, range=None, lead=True, not_ranged="cut"),))
    picture = draw(np.zeros((200, 300, 3), np.uint8), one, None)  # factor 3: source row 70 is centred on 211
    rows = np.flatnonzero((picture[:300, 60] == ALERT_COLOURS["warning"]).all(axis=1))
    assert rows.mean() == pytest.approx((60 + 70) / 2 * 3 + 1, abs=1)


def test_nothing_known_is_drawn_without_numbers() -> None:
    empty = dataclasses.replace(result(), plates=(), lead=None, ego=None, faults=(), alert=Alert())
    assert draw(np.zeros((720, 1280, 3), np.uint8), empty, None).any()
    assert draw(np.zeros((720, 1280, 3), np.uint8), None, None, "damaged frame").any()


def test_the_lead_in_words() -> None:
    assert lead_lines(LEAD) == ["6.20 ± 0.10 m", "range rate -2.0 ± 0.2 m/s", "TTC 3.1 ± 0.3 s", "headway 0.6 s", "by plate"]
    coasting = dataclasses.replace(LEAD, distance_m=None, ttc_s=None, ttc_sigma_s=None, headway_s=None, coasting_s=0.4)
    assert lead_lines(coasting)[0] == "distance: not calibrated"
    assert lead_lines(coasting)[2:] == ["TTC -  (not closing)", "by plate, unseen for 0.4 s"]
