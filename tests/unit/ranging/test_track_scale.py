from dataclasses import replace

import numpy as np
import pytest
from plate_scenes import AHEAD, CAMERA, sighting

from tmde_edge.messages import RangeMeasurement
from tmde_edge.plates.standard import load_standards, select
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.scale_memory import Evidence, Sizes, TrackScale, learn, normalised
from tmde_edge.ranging.settings import RangingSettings

STANDARDS = load_standards()


def follow(
    ranger: Ranger, distances_m: np.ndarray, id_: str, *, seed: int = 0, state: TrackScale | None = None, **scene: object
) -> tuple[list[RangeMeasurement], TrackScale]:
    rng, found = np.random.default_rng(seed), []
    for i, d in enumerate(distances_m):
        plate = sighting(STANDARDS[id_], distance_m=float(d), rng=rng, corner_sigma=0.3, glyph_sigma=0.15, **scene)  # type: ignore[arg-type]
        measured, state, reason = ranger.measure(plate, CAMERA, AHEAD, i * 50_000_000, state)
        assert measured is not None, reason
        found.append(measured)
    assert state is not None
    return found, state


def test_a_near_frame_fixes_the_character_height_of_an_american_plate() -> None:
    ranger = Ranger(RangingSettings(), select(["us-aamva3"]))
    _, state = follow(ranger, np.linspace(5, 3, 25), "us-aamva3", glyph_mm=75.0)
    sizes = state.sizes["us-aamva3"]
    # nominal 69.85 mm, and the law leaves 5 %: learned from the plate's own 152.4 mm
    assert sizes.mean[0] == pytest.approx(np.log(75 / 69.85), abs=0.012)
    assert sizes.covariance[0, 0] ** 0.5 < 0.02


def test_what_was_learned_near_is_used_when_only_characters_are_left() -> None:
    ranger = Ranger(RangingSettings(), select(["us-aamva3"]))
    _, state = follow(ranger, np.linspace(5, 3, 25), "us-aamva3", glyph_mm=75.0)
    plate = sighting(STANDARDS["us-aamva3"], distance_m=8.0, glyph_mm=75.0, glyph_sigma=0.1)
    nan = (float("nan"), float("nan"))
    hidden = replace(plate, corners_px=(nan, nan, nan, nan))  # a bicycle rack: no outline
    fresh, _, _ = ranger.measure(hidden, CAMERA, AHEAD, 2_000_000_000)
    learned, _, _ = ranger.measure(hidden, CAMERA, AHEAD, 2_000_000_000, state)
    assert fresh is not None
    assert learned is not None
    assert abs(fresh.distance_m / 8 - 1) > 0.05
    assert abs(learned.distance_m / 8 - 1) < 0.02
    assert learned.sigma_m < 0.5 * fresh.sigma_m


def test_the_glyph_stays_the_anchor_where_the_width_floats() -> None:
    ranger = Ranger(RangingSettings(), select(["de-mittel"]))
    _, state = follow(ranger, np.linspace(6, 4, 20), "de-mittel", width_mm=460.0)
    sizes = state.sizes["de-mittel shorter"]
    assert state.evidence.log_belief()["de-mittel shorter"] > np.log(0.9)
    assert sizes.mean[1] == pytest.approx(np.log(460 / 520) + 0.06, abs=0.02)
    assert abs(sizes.mean[0]) < 0.006
    # ... and then the learned width carries the distance of a plate without readable characters
    far, _ = follow(ranger, np.array([18.0]), "de-mittel", width_mm=460.0, glyphs=False, state=state)
    assert abs(far[0].distance_m / 18 - 1) < 0.03


def test_a_far_plate_whose_width_floats_is_ranged_by_its_width_while_it_may_be_whole() -> None:
    ranger = Ranger(RangingSettings(), select(["de-mittel"]))
    tall = sighting(STANDARDS["de-mittel"], distance_m=25.0, glyph_mm=80.0, glyph_sigma=0.5, corner_sigma=0.3)
    measured, state, _ = ranger.measure(tall, CAMERA, AHEAD, 0)
    assert measured is not None
    assert measured.standard == "de-mittel"
    assert measured.belief == pytest.approx(1.0)  # of both kinds of width together
    assert abs(measured.distance_m / 25 - 1) < 0.025  # 5 % too near by the characters
    assert set(state.evidence.log_belief()) == {"de-mittel", "de-mittel shorter"}


def test_many_frames_at_one_size_are_one_look_and_another_size_is_another() -> None:
    prior = {"a": np.log(0.8), "b": np.log(0.2)}
    once = Evidence(prior, {}).with_frame(30.0, {"a": -1.0, "b": 0.0}, prior)
    many = once
    for _ in range(500):
        many = many.with_frame(30.0, {"a": -1.0, "b": 0.0}, prior)
    assert many.log_belief() == pytest.approx(once.log_belief())
    assert many.log_belief()["b"] == pytest.approx(np.log(0.2 / (0.2 + 0.8 * np.exp(-1.0))))
    nearer = many.with_frame(60.0, {"a": -1.0, "b": 0.0}, prior)
    assert nearer.log_belief()["b"] == pytest.approx(np.log(0.2 / (0.2 + 0.8 * np.exp(-2.0))))
    # a standard that was left out at first starts from its prior when it is looked at
    late = nearer.with_frame(60.0, {"c": 1.0}, {"c": np.log(0.1), "a": 9.0})
    assert late.log_belief()["c"] - late.log_belief()["a"] == pytest.approx(np.log(0.1) + 1.0 - np.log(0.8) + 2.0)


def test_memory_never_sharpens_the_scale_itself() -> None:
    """A thousand frames of one plate say nothing about which of two legal sizes it has."""
    ranger = Ranger(RangingSettings(), select(["de-mittel"]))
    found, _ = follow(ranger, np.full(60, 4.0), "de-mittel")
    assert found[-1].scale_sigma > 0.0070  # 0.94 % of glyph tolerance, shared with the plate's height, and 0.5 % of focal length
    assert found[-1].noise_m < 0.01 * 4


def test_another_identity_forgets_and_a_swapped_plate_under_the_same_identity_too() -> None:
    ranger = Ranger(RangingSettings(), select(["us-aamva3"]))
    _, state = follow(ranger, np.linspace(5, 3, 30), "us-aamva3", glyph_mm=76.0)
    other, fresh, _ = ranger.measure(sighting(STANDARDS["us-aamva3"], distance_m=5.0, track_id=2), CAMERA, AHEAD, 10**9, state)
    assert other is not None
    assert fresh.track_id == 2
    assert fresh.frames == 1
    found, after = follow(ranger, np.full(8, 4.0), "us-aamva3", state=state, glyph_mm=62.0)
    assert after.frames < 8
    assert after.sizes["us-aamva3"].mean[0] < -0.05
    assert abs(found[-1].distance_m / 4 - 1) < 0.02


def test_distance_moves_smoothly_while_belief_moves() -> None:
    ranger = Ranger(RangingSettings(), select(["auto"]))
    distances = np.full(40, 7.0)
    exact, state, beliefs = [], None, []
    rng = np.random.default_rng(3)
    for i, d in enumerate(distances):
        # The class is in doubt: a German plate behind a frame. Little noise, so that a jump would be the belief's.
        plate = sighting(
            STANDARDS["de-mittel"], distance_m=float(d), rng=rng, corner_sigma=0.02, glyph_sigma=0.02, width_mm=505.0
        )
        plate = replace(plate, corners_sigma_px=0.3, glyphs=tuple(replace(g, sigma_tb_px=0.15) for g in plate.glyphs))
        measured, state, _ = ranger.measure(plate, CAMERA, AHEAD, i * 50_000_000, state)
        assert measured is not None
        exact.append(measured.distance_m)
        beliefs.append(measured.belief)
    assert max(beliefs) - min(beliefs) > 0.05
    assert np.abs(np.diff(exact)).max() < 0.006 * 7
    assert abs(exact[-1] / 7 - 1) < 0.03


def test_the_track_decides_the_sign_of_the_heading() -> None:
    ranger = Ranger(RangingSettings(), select(["ru-1"]))
    found, state = follow(ranger, np.linspace(12, 4, 40), "ru-1", yaw=0.35)
    assert found[-1].yaw_rad == pytest.approx(0.35, abs=0.06)
    assert state.yaw_rad == pytest.approx(0.35, abs=0.06)
    assert state.yaw_sigma_rad < 0.1


def test_learning_everything_is_bayes_and_learning_nothing_keeps_the_prior() -> None:
    prior = Sizes(np.zeros(2), np.diag([0.05**2, 0.01**2]))
    bias = np.diag([0.002**2, 0.001**2])
    # One measurement of the difference of both sizes.
    h = np.array([[1.0, -1.0]])
    z, r = 0.04, 0.004
    blurred = prior.covariance + bias
    gain = blurred @ h.T / (h @ blurred @ h.T + r**2)
    mean, cov = (gain * z).ravel(), blurred - gain @ h @ blurred
    whole = learn(prior, bias, mean, cov, 1.0)
    cross = prior.covariance @ h.T / (h @ blurred @ h.T + r**2)
    assert np.allclose(whole.mean, (cross * z).ravel(), atol=1e-9)
    assert np.allclose(whole.covariance, prior.covariance - cross @ h @ prior.covariance, atol=1e-9)
    nothing = learn(prior, bias, mean, cov, 1e-9)
    assert np.allclose(nothing.mean, 0, atol=1e-6)
    assert np.allclose(nothing.covariance, prior.covariance, atol=1e-9)


def test_belief_sums_to_one_and_nothing_dies() -> None:
    belief = normalised({"a": 0.0, "b": -3.0, "c": -900.0})
    assert sum(np.exp(v) for v in belief.values()) == pytest.approx(1.0)
    assert belief["c"] > -13
