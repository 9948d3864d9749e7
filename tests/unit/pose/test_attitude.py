from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from road import CAMERA, picture

from tmde_edge.messages import EgoState, LaneSighting, Pose, TiltChange
from tmde_edge.pose.attitude import AttitudeEstimator
from tmde_edge.pose.compensate import vanishing_point_px
from tmde_edge.pose.lanes import LaneFinder
from tmde_edge.pose.pitch_filter import oscillator
from tmde_edge.pose.resting import BLOCK_SAMPLES, BLOCKS_NEEDED, RestingPose
from tmde_edge.pose.settings import PoseSettings
from tmde_edge.pose.tilt import TiltMeter

SECOND_NS = 1_000_000_000


def lanes_of(pose: Pose, sigma_px: float = 1.0, dx: float = 0.0, dy: float = 0.0) -> LaneSighting:
    x_px, y_px = vanishing_point_px(pose, CAMERA)
    return LaneSighting(vanishing_px=(x_px + dx, y_px + dy), sigma_x_px=1.5 * sigma_px, sigma_y_px=sigma_px)


def ego(t_ns: int, speed_mps: float = 15.0, yaw_rate_radps: float | None = 0.0) -> EgoState:
    return EgoState(t_ns=t_ns, speed_mps=speed_mps, yaw_rate_radps=yaw_rate_radps)


@given(pitch=st.floats(-0.1, 0.1), roll=st.floats(-0.1, 0.1), yaw=st.floats(-0.1, 0.1))
def test_repeated_sightings_of_a_still_pose_give_it_back(pitch: float, roll: float, yaw: float) -> None:
    estimator = AttitudeEstimator(PoseSettings(), CAMERA, pitch_rad=pitch - 0.005, roll_rad=roll, yaw_rad=yaw)
    true = Pose(pitch_rad=pitch, roll_rad=roll, yaw_rad=yaw)
    for k in range(30):
        got = estimator.update(lanes_of(true, 0.3), k * SECOND_NS // 30, None)
    assert got.source == "lanes"
    assert got.pitch_rad == pytest.approx(pitch, abs=4e-4)
    assert got.roll_rad == pytest.approx(roll)


def test_sign_nose_down_is_positive() -> None:
    estimator = AttitudeEstimator(PoseSettings(), CAMERA)
    above = LaneSighting(vanishing_px=(CAMERA.cx_px, CAMERA.cy_px - 17.5), sigma_x_px=0.5, sigma_y_px=0.2)
    assert estimator.update(above, 0, None).pitch_rad == pytest.approx(math.atan(17.5 / CAMERA.fy_px), rel=0.05)


def test_pitching_of_two_degrees_is_followed_through_pictures() -> None:
    """Lanes every third of 30 frames a second, 0.8 Hz pitching of +-2 deg, as drawn and found."""
    estimator, finder = AttitudeEstimator(PoseSettings(), CAMERA), LaneFinder(PoseSettings())
    errors, sigmas = [], []
    for k in range(60):
        t_s = k / 30
        true = Pose(pitch_rad=math.radians(2.0) * math.sin(2 * math.pi * 0.8 * t_s), roll_rad=0.0)
        seen = finder.see(picture(true, seed=k), 0, vanishing_point_px(estimator.rest, CAMERA)) if k % 3 == 0 else None
        got = estimator.update(seen, round(t_s * 1e9), None)
        errors.append(got.pitch_rad - true.pitch_rad)
        sigmas.append(got.pitch_sigma_rad)
    rmse_deg = math.degrees(float(np.sqrt(np.mean(np.square(errors)))))
    assert rmse_deg <= 0.25
    assert np.mean(np.abs(errors) < 2.0 * np.array(sigmas)) > 0.9


def test_without_lanes_it_returns_to_rest_and_says_so() -> None:
    estimator = AttitudeEstimator(PoseSettings(), CAMERA, pitch_rad=0.02)
    estimator.update(lanes_of(Pose(pitch_rad=0.03, roll_rad=0.0)), 0, None)
    soon = estimator.update(None, SECOND_NS // 10, None)
    late = estimator.update(None, 5 * SECOND_NS, None)
    assert soon.source == "lanes"
    assert soon.pitch_sigma_rad < late.pitch_sigma_rad
    assert late.source == "none"
    assert late.pitch_rad == pytest.approx(0.02, abs=1e-3)
    assert late.pitch_sigma_rad == pytest.approx(math.hypot(0.015, 0.006), rel=0.02)


def test_one_wild_point_changes_nothing_but_a_lasting_one_is_believed() -> None:
    estimator = AttitudeEstimator(PoseSettings(), CAMERA)
    level = Pose(pitch_rad=0.0, roll_rad=0.0)
    for k in range(30):
        before = estimator.update(lanes_of(level, 0.5), k * SECOND_NS // 30, None)
    wild = estimator.update(lanes_of(level, 0.5, dy=40.0), SECOND_NS, None)
    assert abs(wild.pitch_rad - before.pitch_rad) < 1e-3
    for k in range(1, 30):
        wild = estimator.update(lanes_of(level, 0.5, dy=25.0), SECOND_NS + k * SECOND_NS // 30, None)
    assert wild.pitch_rad == pytest.approx(-25.0 / CAMERA.fy_px, abs=2e-3)


@pytest.mark.parametrize("method", ["none", "robust"])
def test_no_camera_or_method_none_is_honest(method: str) -> None:
    settings = PoseSettings(method="none") if method == "none" else PoseSettings()
    estimator = AttitudeEstimator(settings, CAMERA if method == "none" else None, pitch_rad=0.01, roll_rad=0.02)
    got = estimator.update(lanes_of(Pose(pitch_rad=0.05, roll_rad=0.0)), 0, None)
    assert (got.source, got.pitch_rad, got.roll_rad) == ("none", 0.01, 0.02)


def test_another_image_size() -> None:
    estimator = AttitudeEstimator(PoseSettings(), CAMERA)
    half = CAMERA.scaled_to(640, 360)
    x_px, y_px = vanishing_point_px(Pose(pitch_rad=0.02, roll_rad=0.0), half)
    seen = LaneSighting(vanishing_px=(x_px, y_px), sigma_x_px=0.3, sigma_y_px=0.1)
    assert estimator.update(seen, 0, None, (640, 360)).pitch_rad == pytest.approx(0.02, rel=0.05)


def test_resting_pose_is_learnt_only_while_driving_straight() -> None:
    true = Pose(pitch_rad=0.035, roll_rad=0.0, yaw_rad=-0.02)
    rng = np.random.default_rng(1)
    needed = BLOCK_SAMPLES * BLOCKS_NEEDED

    def drive(speed_mps: float, yaw_rate_radps: float | None) -> AttitudeEstimator:
        estimator = AttitudeEstimator(PoseSettings(), CAMERA)
        for k in range(needed * 5 // 4):  # an outlier now and then teaches nothing
            seen = lanes_of(true, 2.0, *rng.normal(0.0, 2.0, 2))
            estimator.update(seen, k * SECOND_NS // 10, ego(k, speed_mps, yaw_rate_radps))
        return estimator

    learnt = drive(15.0, 0.0)
    assert learnt.resting.valid
    assert learnt.resting.percent == 100
    assert learnt.rest.pitch_rad == pytest.approx(0.035, abs=5e-4)
    assert learnt.rest.yaw_rad == pytest.approx(-0.02, abs=5e-4)
    for speed_mps, yaw_rate in ((3.0, 0.0), (15.0, 0.1), (15.0, None)):
        other = drive(speed_mps, yaw_rate)
        assert other.resting == RestingPose()
        assert other.rest.yaw_rad == 0.0


def test_learnt_rest_carries_over_and_the_pitch_does_not_jump() -> None:
    state = RestingPose()
    for _ in range(BLOCK_SAMPLES * BLOCKS_NEEDED - 1):
        state = state.with_sample(0.03, 0.01)
    assert not state.valid
    estimator = AttitudeEstimator(PoseSettings(), CAMERA, resting=state)
    pitches = [
        estimator.update(lanes_of(Pose(pitch_rad=0.03, roll_rad=0.0, yaw_rad=0.01)), k * SECOND_NS // 10, ego(k)).pitch_rad
        for k in range(5)
    ]
    assert estimator.resting.valid
    assert np.abs(np.diff(pitches[1:])).max() < 2e-3
    again = AttitudeEstimator(PoseSettings(), CAMERA, resting=estimator.resting)
    assert again.rest.pitch_rad == pytest.approx(0.03)


def test_a_moved_camera_is_learnt_anew() -> None:
    state = RestingPose()
    for _ in range(10 * BLOCK_SAMPLES):
        state = state.with_sample(0.0, 0.0)
    for _ in range(3 * BLOCK_SAMPLES):
        state = state.with_sample(0.06, 0.0)
    assert not state.valid
    assert state.pitch_rad == pytest.approx(0.06)
    for _ in range(2 * BLOCK_SAMPLES):
        state = state.with_sample(0.06, 0.0)
    assert state.valid


def test_absurd_samples_teach_nothing() -> None:
    assert RestingPose().with_sample(0.5, 0.0) == RestingPose()
    assert RestingPose().with_sample(float("nan"), 0.0) == RestingPose()


@given(a=st.floats(0.0, 2.0), b=st.floats(0.0, 2.0))
def test_two_steps_are_one(a: float, b: float) -> None:
    both = oscillator(b, 7.5, 0.5) @ oscillator(a, 7.5, 0.5)
    assert np.allclose(both, oscillator(a + b, 7.5, 0.5), atol=1e-9)


def test_pitching_without_lanes_is_followed_by_the_pictures_own_movement() -> None:
    """Lanes at the start only; then 2 s of +-2 deg at 0.8 Hz with nothing but a skyline."""
    estimator, meter = AttitudeEstimator(PoseSettings(), CAMERA), TiltMeter()
    errors, sigmas = [], []
    for k in range(70):
        t_ns = round(k / 30 * 1e9)
        true = Pose(pitch_rad=math.radians(2.0) * math.sin(2 * math.pi * 0.8 * max(k - 10, 0) / 30), roll_rad=0.0)
        image = picture(true, seed=k, stripes_m=(), skyline=True)
        tilt = meter.see(image, t_ns, vanishing_point_px(estimator.rest, CAMERA))
        assert (tilt is None) == (k == 0)
        got = estimator.update(lanes_of(true) if k < 10 else None, t_ns, None, None, tilt)
        errors.append(got.pitch_rad - true.pitch_rad)
        sigmas.append(got.pitch_sigma_rad)
    assert math.degrees(float(np.sqrt(np.mean(np.square(errors))))) <= 0.5
    assert np.mean(np.abs(errors) < 2.0 * np.array(sigmas)) > 0.9


def test_clutter_that_repeats_does_not_overrule_what_was_not_seen_to_move() -> None:
    estimator = AttitudeEstimator(PoseSettings(), CAMERA)
    level = Pose(pitch_rad=0.0, roll_rad=0.0)
    for k in range(60):
        t_ns = k * SECOND_NS // 30
        tilt = TiltChange(t_from_ns=(k - 1) * SECOND_NS // 30, down_px=0.0, sigma_px=0.3) if k else None
        wild = 30 <= k < 42 and k % 3 == 0  # four wrong sightings that agree with each other
        got = estimator.update(lanes_of(level, 1.0, dy=40.0 if wild else 0.0) if k % 3 == 0 else None, t_ns, None, None, tilt)
        assert abs(got.pitch_rad) < 3e-3


def test_still_picture_does_not_tilt_and_gaps_or_sky_say_nothing() -> None:
    image = picture(Pose(pitch_rad=0.0, roll_rad=0.0), skyline=True, noise=0.0)
    meter = TiltMeter()
    assert meter.see(image, 0, None) is None
    still = meter.see(image, 30_000_000, None)
    assert still is not None
    assert abs(still.down_px) < 0.01
    assert still.t_from_ns == 0
    moved = meter.see(np.roll(image, 3, axis=0), 60_000_000, None)
    assert moved is not None
    assert moved.down_px == pytest.approx(3.0, abs=0.5)
    assert meter.see(image, 5 * SECOND_NS, None) is None
    sky = np.full((720, 1280), 200, np.uint8)
    assert meter.see(sky, 5 * SECOND_NS + 1, None) is None
    assert meter.see(sky, 5 * SECOND_NS + 2, None) is None
    assert meter.see(np.zeros((20, 20), np.uint8), 6 * SECOND_NS, None) is None
