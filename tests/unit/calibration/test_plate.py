"""f from plates at stated distances: exact sightings give the exact f, and every bad capture is named for what it is."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tmde_edge.app.calibrate_plate import PlateJob, Seen, Shot, edge_blur_px, shot_of, solve
from tmde_edge.calibration.plate import PlateCalibration, measured_plate
from tmde_edge.calibration.quality import check_sighting, fatal
from tmde_edge.geometry.pinhole import Camera, view_from_vehicle
from tmde_edge.messages import PlateSighting
from tmde_edge.plates.standard import load_standards

sys.path.insert(0, str(Path(__file__).parents[1] / "ranging"))
from plate_scenes import sighting

F = 1400.0
CAMERA = Camera(width_px=1920, height_px=1080, fx_px=F, fy_px=F, cx_px=959.5, cy_px=539.5)
PLATE = measured_plate(load_standards()["de-mittel"], 520, 110, 75)
JOB = PlateJob(standard=PLATE)


def shot(distance_m: float, stated_m: float | None = None, camera: Camera = CAMERA, *, seed: int = 0, noise: float = 0.0,
         change: object = None, blur_px: float = 0.8, **scene: float) -> Shot:  # fmt: skip
    rng = np.random.default_rng(seed)
    plate = sighting(PLATE, camera, distance_m=distance_m, rng=rng, corner_sigma=noise, glyph_sigma=noise / 3, **scene)
    if callable(change):
        plate = change(plate)
    seen = Seen(found=plate, plate=plate, blur_px=blur_px)
    name = f"at {distance_m:g}"
    return shot_of(name, stated_m or distance_m, (camera.width_px, camera.height_px), [seen])


def solved(shots: list[Shot], job: PlateJob = JOB) -> PlateCalibration:
    outcome = solve(shots, job)
    assert outcome.calibration is not None, outcome.refused
    return outcome.calibration


def test_exact_captures_give_the_exact_focal_length() -> None:
    c = solved([shot(2.0), shot(5.0), shot(10.0)])
    assert c.f_px == pytest.approx(F, rel=2e-3)
    assert c.residuals == pytest.approx([0, 0, 0], abs=3e-3)
    assert 0.001 < c.sigma < 0.008
    first = c.captures[0]
    assert first.by_height_px == pytest.approx(F, rel=0.01)
    assert first.by_width_px == pytest.approx(F, rel=0.01)


def test_a_turned_plate_is_not_taken_for_a_far_one() -> None:
    c = solved([shot(2.0, yaw=0.17, lean=0.1), shot(3.0, yaw=-0.15), shot(5.0, lean=-0.1)])
    assert c.f_px == pytest.approx(F, rel=5e-3)


def test_sigma_covers_the_error_of_noisy_captures() -> None:
    z = []
    for seed in range(12):
        rng = np.random.default_rng(1000 + seed)
        shots = [shot(d, d + float(rng.normal(0, 0.01)), seed=9 * seed + i, noise=0.3, yaw=float(rng.uniform(-0.1, 0.1)))
                 for i, d in enumerate((2.0, 5.0, 10.0))]  # fmt: skip
        c = solved(shots)
        z.append((c.f_px / F - 1) / c.sigma)
    assert np.mean(np.abs(z) < 1) >= 0.5
    assert np.max(np.abs(z)) < 3


def test_what_captures_share_is_the_plates_size_alone() -> None:
    """Pixels and the plate's pose are drawn anew in every capture: more captures average them out."""
    three = solved([shot(d) for d in (2.0, 5.0, 10.0)])
    near, far = three.captures[0], three.captures[-1]
    assert far.common_sigma < 1.15 * near.common_sigma
    assert far.own_sigma > 3 * near.own_sigma
    nine = solved([shot(d, seed=i, noise=0.1) for i, d in enumerate((2.0, 5.0, 10.0) * 3)])
    assert nine.sigma < 0.85 * three.sigma
    assert nine.sigma > min(c.common_sigma for c in nine.captures)


def test_a_wrong_reference_point_is_seen_and_can_be_solved_for() -> None:
    shots = [shot(d + 0.15, d) for d in (2.0, 5.0, 10.0)]
    outcome = solve(shots, JOB)
    assert [p.kind for p in fatal(outcome.problems)] == ["trend"]
    assert "15 cm in front of" in outcome.problems[0].text
    c = solved(shots, replace(JOB, fit_offset=True))
    assert c.offset_m == pytest.approx(0.15, abs=0.02)
    assert c.f_px == pytest.approx(F, rel=5e-3)


def test_straight_distances_are_lens_to_plate() -> None:
    shots = [shot(d, d * math.hypot(1, 0.3), v=0.3) for d in (2.0, 5.0, 10.0)]
    assert solved(shots, replace(JOB, straight=True)).f_px == pytest.approx(F, rel=5e-3)


def test_pose_while_calibrating() -> None:
    pitch, roll = 0.05, 0.02
    view = view_from_vehicle(pitch, roll)
    c = solved([shot(d, view_from_vehicle=view, v=0.6 / d) for d in (2.0, 3.0, 5.0, 10.0)])
    assert c.pose.pitch_rad == pytest.approx(pitch, abs=0.004)
    assert c.pose.roll_rad == pytest.approx(roll, abs=0.004)
    assert c.f_px == pytest.approx(F, rel=5e-3)


def moved(plate: PlateSighting, dy: tuple[float, float, float, float]) -> PlateSighting:
    tl, tr, br, bl = ((x, y + d) for (x, y), d in zip(plate.corners_px, dy, strict=True))
    return replace(plate, corners_px=(tl, tr, br, bl))


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda p: replace(p, cut=True), "cut"),
        (lambda p: moved(p, (-20.0, 0.0, 0.0, 20.0)), "tilt"),
        (lambda p: moved(p, (9.0, 9.0, -9.0, -9.0)), "shape"),
    ],
)
def test_bad_captures_are_named(change: object, kind: str) -> None:
    outcome = solve([shot(d, change=change if d == 5.0 else None) for d in (2.0, 3.0, 5.0, 10.0)], JOB)
    assert [(name, p.kind) for name, p in outcome.refused] == [("at 5", kind)]
    assert outcome.usable


def test_too_small_and_too_few_are_named() -> None:
    outcome = solve([shot(2.0), shot(5.0), shot(25.0)], JOB)
    assert [p.kind for _, p in outcome.refused] == ["too_small"]
    assert [p.kind for p in fatal(outcome.problems)] == ["too_few"]
    assert not outcome.usable


def test_a_wrong_distance_among_good_ones_is_refused() -> None:
    outcome = solve([shot(2.0), shot(4.0), shot(6.0), shot(8.0), shot(10.0, 5.0)], JOB)
    assert [(n, p.kind) for n, p in outcome.refused] == [("at 10", "outlier")]
    assert outcome.calibration is not None
    assert outcome.calibration.f_px == pytest.approx(F, rel=5e-3)


def test_focal_lengths_out_of_range_and_the_tele_lens_with_its_prior() -> None:
    tele = replace(CAMERA, fx_px=8000.0, fy_px=8000.0)
    shots = [shot(d, camera=tele) for d in (5.0, 10.0, 20.0)]
    assert [p.kind for p in solve(shots, JOB).problems] == ["focal_range"]
    assert solve(shots, replace(JOB, prior_px=8200.0)).usable
    assert [p.kind for p in solve(shots, replace(JOB, prior_px=1400.0)).problems] == ["prior"]


def test_check_sighting_passes_a_good_one() -> None:
    assert check_sighting(shot(5.0).seen[0].found, 0.9) is None


def test_a_blurred_capture_is_named() -> None:
    outcome = solve([shot(2.0), shot(3.0), shot(5.0), shot(10.0, blur_px=2.4)], JOB)
    assert [(name, p.kind) for name, p in outcome.refused] == [("at 10", "blur")]
    assert outcome.usable


def test_edge_blur_is_measured_in_the_picture() -> None:
    plate = shot(5.0).seen[0].found
    flat = np.full((1080, 1920), 255, np.uint8)
    (left, top), (right, low) = plate.corners_px[0], plate.corners_px[2]
    flat[int(top) + 5 : int(low) - 5, int(left) + 20 : int(right) - 20 : 16] = 0
    for k in range(1, 8):
        flat[int(top) + 5 : int(low) - 5, int(left) + 20 + k : int(right) - 20 : 16] = 0
    for sigma in (1.0, 2.0):
        assert edge_blur_px(cv2.GaussianBlur(flat, (0, 0), sigma), plate) == pytest.approx(sigma, rel=0.35)
