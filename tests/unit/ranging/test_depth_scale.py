from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import DepthEstimate, DepthReading, PlateSighting, Pose, Sighting
from tmde_edge.ranging.depth_scale import DepthAligner, DepthSettings, ground_points, region_m

CAMERA = Camera(width_px=1280, height_px=720, fx_px=1000.0, fy_px=1000.0, cx_px=639.5, cy_px=359.5)
HEIGHT_M = 1.3
LEVEL = Pose(pitch_rad=0.0, roll_rad=0.0, pitch_sigma_rad=0.003, roll_sigma_rad=0.003, source="lanes")
COLUMNS, ROWS = 64, 48
SECOND_NS = 1_000_000_000


def inverse_scene(lead_m: float) -> np.ndarray:
    """True 1/D on the grid: flat road, far background, a vehicle 1.8 m wide and 1.5 m high at lead_m."""
    x = (np.arange(COLUMNS) + 0.5) * 1280 / COLUMNS - 0.5
    y = (np.arange(ROWS) + 0.5) * 720 / ROWS - 0.5
    u, v = np.meshgrid((x - CAMERA.cx_px) / CAMERA.fx_px, (y - CAMERA.cy_px) / CAMERA.fy_px)
    grid = np.maximum(v / HEIGHT_M, 1 / 200.0)
    vehicle = (np.abs(u) * lead_m < 0.9) & (v * lead_m < HEIGHT_M) & (v * lead_m > HEIGHT_M - 1.5)
    grid[vehicle] = 1.0 / lead_m
    return grid


def reading(
    t_ns: int, grid: np.ndarray, scale: float, shift: float, rng: np.random.Generator, noise: float = 0.03
) -> DepthReading:
    """Relative depth with the inverse map of 1/D = scale m + shift, and noise of a few per cent."""
    m = (grid - shift) / scale
    m = m + rng.normal(0.0, noise, m.shape) * np.abs(m).mean()
    return DepthReading(
        t_ns=t_ns, ready_t_ns=t_ns + 150_000_000, width_px=1280, height_px=720, grid_columns=COLUMNS, grid_rows=ROWS,
        inverse_depth=tuple(float(v) for v in m.ravel()), model="test",
    )  # fmt: skip


def sighting(t_ns: int, lead_m: float, visible: bool = True) -> Sighting:
    """The lead's plate 0.52 x 0.11 m, 0.5 m above the road."""
    f, w, h, y = 1000.0, 0.26 / lead_m * 1000.0, 0.055 / lead_m * 1000.0, CAMERA.cy_px + (HEIGHT_M - 0.5) / lead_m * 1000.0
    assert f > 0
    x = CAMERA.cx_px
    plate = PlateSighting(
        track_id=7, corners_px=((x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)), corners_sigma_px=0.2, score=1.0
    )
    return Sighting(
        t_ns=t_ns, frame_index=0, width_px=1280, height_px=720, status="ok" if visible else "no_plate",
        plates=(plate,) if visible else (),
    )  # fmt: skip


def drive(
    settings: DepthSettings, *, gap_from_s: float = 6.0, seconds: float = 8.0, scale: float = 0.004, shift: float = -0.01,
    drift: float = 0.02, wrong_at_s: float | None = None, height_m: float | None = HEIGHT_M, seed: int = 0, noise: float = 0.03,
) -> list[tuple[float, float, DepthEstimate | None]]:  # fmt: skip
    """(t, true distance, estimate): closing from 35 m at 3 m/s; depth at 4 Hz, 0.15 s late; plate hidden after gap_from_s."""
    rng = np.random.default_rng(seed)
    aligner = DepthAligner(settings, height_m)
    waiting: list[DepthReading] = []
    out = []
    for k in range(round(seconds * 20)):
        t_s = k / 20
        t_ns = round(t_s * SECOND_NS)
        lead_m = 35.0 - 3.0 * t_s
        for r in [r for r in waiting if r.ready_t_ns <= t_ns]:
            aligner.add_reading(r)
            waiting.remove(r)
        visible = t_s < gap_from_s
        coasted_m = lead_m if visible else lead_m + 1.5 * (t_s - gap_from_s)  # the filter's own belief goes astray
        got = aligner.update(sighting(t_ns, lead_m, visible), CAMERA, LEVEL, {7: coasted_m}, 7)
        out.append((t_s, lead_m, got))
        if k % 5 == 0:
            grid = inverse_scene(lead_m)
            if wrong_at_s is not None and abs(t_s - wrong_at_s) < 0.3:
                grid = grid[:, ::-1] * rng.uniform(0.3, 3.0, grid.shape)
            a = scale * (1.0 + drift * math.sin(t_s))
            waiting.append(reading(t_ns, grid, a, shift + 0.001 * math.sin(0.7 * t_s), rng, noise))
    return out


def relative_errors(track: list[tuple[float, float, DepthEstimate | None]], after_s: float) -> np.ndarray:
    """Against the truth at the time of the reading."""
    return np.array(
        [d.distance_m / (true_m + 3.0 * d.age_s) - 1.0 for t, true_m, d in track if t >= after_s and d is not None]
    )


def test_lead_distance_by_depth_while_the_plate_is_hidden() -> None:
    track = drive(DepthSettings(kind="recorded"))
    errors = relative_errors(track, 6.2)
    assert len(errors) >= 30
    assert np.abs(errors).max() < 0.10
    assert np.median(np.abs(errors)) < 0.05
    newest = track[-1][2]
    assert newest is not None
    assert 0.14 < newest.age_s < 0.45


def test_sigma_is_honest_over_many_drives() -> None:
    ratios = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        scale, shift = float(rng.uniform(0.001, 0.01)), float(rng.uniform(-0.03, 0.01))
        for t, true_m, d in drive(DepthSettings(kind="recorded"), seed=seed, scale=scale, shift=shift):
            if d is not None and t > 1.0:
                ratios.append((d.distance_m - true_m - 3.0 * d.age_s) / d.sigma_m)
    z = np.abs(ratios)
    assert np.mean(z < 1.0) > 0.68
    assert np.mean(z < 2.0) > 0.95


def test_without_road_points_and_height_plates_alone_align() -> None:
    errors = relative_errors(drive(DepthSettings(kind="recorded"), height_m=None), 6.2)
    assert len(errors) >= 30
    assert np.median(np.abs(errors)) < 0.10


def test_a_few_wrong_readings_do_no_lasting_harm() -> None:
    errors = relative_errors(drive(DepthSettings(kind="recorded"), wrong_at_s=4.0), 6.4)
    assert np.median(np.abs(errors)) < 0.06


def test_papers_scale_is_literally_its_formula() -> None:
    aligner = DepthAligner(DepthSettings(kind="recorded", alignment="paper"), HEIGHT_M)
    flat = np.full((ROWS, COLUMNS), 50.0)
    flat[0, 0] = 49.0
    scale = None
    for k, distance_m in enumerate((20.0, 22.0, 18.0)):
        r = DepthReading(
            t_ns=k * SECOND_NS, ready_t_ns=k * SECOND_NS, width_px=1280, height_px=720, grid_columns=COLUMNS, grid_rows=ROWS,
            inverse_depth=tuple(float(v) for v in flat.ravel()),
        )  # fmt: skip
        aligner.add_reading(r)
        got = aligner.update(sighting(k * SECOND_NS, distance_m), CAMERA, LEVEL, {7: distance_m}, 7)
        d_plate = 1.0 / 50.0  # relative depth is the inverse of the network's output
        scale = distance_m / d_plate if scale is None else 0.9 * scale + 0.1 * distance_m / d_plate
        assert got is not None
        assert got.distance_m == pytest.approx(scale * d_plate)


def test_affine_beats_the_papers_scale_where_there_is_a_shift() -> None:
    ours = relative_errors(drive(DepthSettings(kind="recorded"), gap_from_s=5.0), 5.3)
    papers = relative_errors(drive(DepthSettings(kind="recorded", alignment="paper"), gap_from_s=5.0), 5.3)
    assert np.median(np.abs(ours)) < 0.7 * np.median(np.abs(papers))


def test_a_scene_cut_forgets() -> None:
    """Another recording with other scale and shift: right again with its second reading."""
    rng = np.random.default_rng(0)
    aligner = DepthAligner(DepthSettings(kind="recorded"), HEIGHT_M)
    for k in range(12):
        a, b, lead_m = (0.004, -0.01, 20.0) if k < 8 else (0.02, 0.004, 12.0)
        grid = inverse_scene(lead_m)
        if k < 8:
            grid = grid + 0.3 * np.linspace(1.0, 0.0, ROWS)[:, None]  # something big and near above: another picture
            grid[ROWS // 3 :] = inverse_scene(lead_m)[ROWS // 3 :]
        t_ns = k * SECOND_NS // 4
        aligner.add_reading(reading(t_ns, grid, a, b, rng))
        got = aligner.update(sighting(t_ns, lead_m), CAMERA, LEVEL, {7: lead_m}, 7)
        if k == 8:  # the first of the new scene may still be a wrong picture
            assert got is None
            continue
        assert got is not None
        assert got.distance_m == pytest.approx(lead_m, rel=0.12)


def test_old_dead_or_unmatched_readings_say_nothing() -> None:
    rng = np.random.default_rng(0)
    aligner = DepthAligner(DepthSettings(kind="recorded"), HEIGHT_M)
    good = reading(0, inverse_scene(20.0), 0.004, 0.0, rng)
    aligner.add_reading(good)
    assert aligner.reading_t_ns is None
    assert aligner.update(sighting(0, 20.0), CAMERA, LEVEL, {7: 20.0}, 7) is not None
    assert aligner.reading_t_ns == 0
    assert aligner.update(sighting(SECOND_NS // 2, 20.0), CAMERA, LEVEL, {7: 20.0}, None) is None
    assert aligner.update(sighting(SECOND_NS // 2, 20.0), CAMERA, LEVEL, {7: 20.0}, 99) is None
    assert aligner.update(sighting(2 * SECOND_NS, 20.0), CAMERA, LEVEL, {7: 20.0}, 7) is None
    for bad in (0.0, float("nan")):
        aligner.add_reading(replace(good, t_ns=2 * SECOND_NS, inverse_depth=(bad,) * (COLUMNS * ROWS)))
        assert aligner.update(sighting(2 * SECOND_NS, 20.0), CAMERA, LEVEL, {7: 20.0}, 7) is None


def test_nothing_known_gives_nothing() -> None:
    """No plate ever, no camera height: relative depth stays relative."""
    rng = np.random.default_rng(0)
    aligner = DepthAligner(DepthSettings(kind="recorded"), None)
    for k in range(5):
        aligner.add_reading(reading(k * SECOND_NS, inverse_scene(20.0), 0.004, 0.0, rng))
        assert aligner.update(sighting(k * SECOND_NS, 20.0, visible=False), CAMERA, LEVEL, {7: 20.0}, 7) is None


def test_ground_points_are_the_free_road_before_the_lead() -> None:
    grid = inverse_scene(20.0)
    points = ground_points(grid, CAMERA, LEVEL, HEIGHT_M, 20.0)
    assert points is not None
    assert points.inverse_m == pytest.approx(points.m, rel=1e-9)
    assert (1.0 / points.inverse_m).max() <= 15.0
    assert points.worth.sum() == pytest.approx(6.0)
    assert ground_points(grid, CAMERA, LEVEL, HEIGHT_M, 4.5) is None


def test_region_is_the_median_or_the_nearest_cell() -> None:
    grid = np.arange(12.0).reshape(3, 4)
    assert region_m(grid, (400, 300), (0.0, 0.0, 399.0, 299.0)) == 5.5
    assert region_m(grid, (400, 300), (260.0, 110.0, 270.0, 120.0)) == 6.0
    assert region_m(grid, (400, 300), (-50.0, -50.0, -40.0, -40.0)) == 0.0
