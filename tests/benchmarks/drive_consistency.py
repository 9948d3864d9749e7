"""Are the sigmas of a whole drive honest? Ranging, growth and filter over the kinematics of the scenarios, without pictures.

python tests/benchmarks/drive_consistency.py [SCENARIO ...] [--seeds N]

Every frame's plate is projected exactly, with sizes drawn within the law, and seen with noise as stated: corners 0.35 px,
character edges 0.2 px, growth of the rear 0.1 %, own speed 0.05 m/s; the plate is not seen while the scenario covers it.
Prints the share of frames whose NEES of distance and range rate lies within chi-square's 90 % (it should be 0.90 or more),
the share of innovations within 90 % (NIS), the range rate's rmse at 8 to 12 m, and TTC against the truth below 4 s.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import EgoState, GlyphSighting, PlateSighting, Point, ScaleChange
from tmde_edge.plates.standard import load_standards
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.scale_memory import TrackScale
from tmde_edge.ranging.settings import RangingSettings
from tmde_edge.simulation.drive import frame_truth
from tmde_edge.simulation.scenarios import build
from tmde_edge.simulation.standard_face import StandardFace, standard_face
from tmde_edge.tracking.lead import LeadTracker
from tmde_edge.tracking.settings import TrackerSettings
from tmde_edge.tracking.ttc import plain_ttc_s

SCENARIOS = (
    "approach", "follow", "ccrb", "nhtsa-slower", "nhtsa-decelerating", "stopped", "gap-braking", "gap-closing", "gap-away",
)  # fmt: skip
STANDARDS = ("de-mittel", "us-mi", "ru-1", "gb-2001")
CORNER_PX, EDGE_PX, GROWTH, SPEED_MPS, GROWTH_EVERY = 0.35, 0.2, 1e-3, 0.05, 6
NEES_90, NIS_90 = 4.605, 1.645  # chi-square of two; one Gaussian residual in sigmas
HEAD = (
    "| scenario | frames | NEES inside 90 % | mean (2) | NIS inside 90 % | 1 / 2 sigma | hidden: 1 / 2 sigma |"
    " range rate rmse at 8-12 m | TTC < 4 s within 10 % |"
)
FAR_M, SMALL_PX = 80.0, 12.0  # nothing is seen beyond


def seen(face: StandardFace, camera: Camera, centre_m: np.ndarray, rng: np.random.Generator) -> PlateSighting:
    """The plate facing the camera at centre_m, with noise as stated."""

    def project(x_mm: float, y_mm: float, sigma_px: float) -> Point:
        p = camera.project((centre_m + np.array([x_mm, y_mm, 0.0]) / 1000)[None])[0] + rng.normal(0, sigma_px, 2)
        return float(p[0]), float(p[1])

    w, h = face.spec.width_mm / 2, face.spec.height_mm / 2
    glyphs = []
    for g in (g for g in face.spec.glyphs if g.counted):
        x, y = g.left_mm + g.width_mm / 2, g.top_mm + g.height_mm / 2
        edges = ((x, g.top_mm), (x, g.top_mm + g.height_mm), (g.left_mm, y), (g.left_mm + g.width_mm, y))
        top, bottom, left, right = (project(a, b, EDGE_PX) for a, b in edges)
        glyphs.append(GlyphSighting(left_px=left, right_px=right, top_px=top, bottom_px=bottom, sigma_tb_px=EDGE_PX,
                                    sigma_lr_px=EDGE_PX))  # fmt: skip
    corners = tuple(project(x, y, CORNER_PX) for x, y in ((-w, -h), (w, -h), (w, h), (-w, h)))
    return PlateSighting(
        track_id=1, corners_px=(corners[0], corners[1], corners[2], corners[3]), corners_sigma_px=CORNER_PX, score=1.0,
        glyphs=tuple(glyphs), light_on_dark=load_standards()[face.standard].light_on_dark,
    )  # fmt: skip


def drive(name: str, seed: int) -> dict[str, Any]:
    scenario = build(name, seed=seed)
    standard = STANDARDS[seed % len(STANDARDS)]
    face = standard_face(standard, seed=seed)
    sim = scenario.camera
    camera = Camera(
        width_px=sim.width_px, height_px=sim.height_px, fx_px=sim.fx_px, fy_px=sim.fy_px, cx_px=sim.cx_px, cy_px=sim.cy_px
    )
    ranger, tracker = Ranger(RangingSettings(), (load_standards()[standard],)), LeadTracker(TrackerSettings())
    rng = np.random.default_rng((seed, *name.encode()))
    # the lens is what the calibration says but for its own sigma, the same for the whole drive
    wrong = 1 + rng.normal(0, camera.focal_sigma)
    true_camera = replace(camera, fx_px=camera.fx_px * wrong, fy_px=camera.fy_px * wrong)
    memory: TrackScale | None = None
    anchor: tuple[int, float] | None = None
    out: dict[str, list[float]] = {k: [] for k in ("nees", "nis", "rate10", "ttc", "z", "hidden_z")}
    for i in range(scenario.frame_count):
        truth = frame_truth(scenario, i)
        t_ns = round(truth.t_s * 1e9)
        speed = truth.ego_speed_mps + rng.normal(0, SPEED_MPS)
        tracker.set_ego(EgoState(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=0.0, speed_sigma_mps=SPEED_MPS))
        tracker.predict(t_ns)
        lead = truth.lead
        if lead is None or lead.plate_corners_px is None or lead.distance_m > FAR_M:
            continue
        width_px = face.spec.width_mm / 1000 * camera.fx_px / lead.distance_m
        visible = lead.plate_visible > 0.9 and width_px > SMALL_PX
        if visible:
            centre = np.array([lead.lateral_m, 0.5, lead.distance_m])
            found, memory, _ = ranger.measure(seen(face, true_camera, centre, rng), camera, np.eye(3), t_ns, memory)
            if found is not None:
                before = tracker.tracks.get(1)
                tracker.update(found, "plate")
                if before is not None and before.innovations:
                    out["nis"].append(before.innovations[-1][0] / before.innovations[-1][1])
        if i % GROWTH_EVERY == 0:
            if anchor is not None:
                ratio = anchor[1] / lead.distance_m + rng.normal(0, GROWTH)
                change = ScaleChange(track_id=1, t_from_ns=anchor[0], ratio=ratio, sigma=GROWTH)
                tracker.grow(change, t_ns)
            anchor = (t_ns, lead.distance_m)
        track = tracker.tracks.get(1)
        if track is None or track.hits < 5:
            continue
        f, s = track.filter, track.scale_sigma
        state = np.array([f.distance_m, f.range_rate_mps])
        cov = f.covariance[:2, :2] + s**2 * np.outer(state, state) + np.diag([0.0, SPEED_MPS**2])
        error = state - (lead.distance_m, lead.range_rate_mps)
        out["nees"].append(float(error @ np.linalg.solve(cov, error)))
        z = error[0] / cov[0, 0] ** 0.5
        out["z" if visible else "hidden_z"].append(z)
        if 8.0 <= lead.distance_m <= 12.0:
            out["rate10"].append(error[1])
        ttc = plain_ttc_s(f.distance_m - sim.to_bumper_m, f.range_rate_mps)
        if lead.ttc_s is not None and lead.ttc_s < 4.0:
            out["ttc"].append(abs((ttc if ttc is not None else 99.0) / lead.ttc_s - 1) if lead.ttc_s > 0.2 else 0.0)
    return out


def _row(name: str, runs: list[dict[str, Any]]) -> str:
    def column(key: str) -> np.ndarray:
        return np.array([v for r in runs for v in r[key]])

    def share(values: np.ndarray, below: float) -> str:
        return f"{np.mean(np.abs(values) < below):.2f}" if len(values) else "-"

    z, hidden, rate = column("z"), column("hidden_z"), column("rate10")
    nees = column("nees")
    cells = (
        name, len(nees), share(nees, NEES_90), f"{np.mean(nees):.2f}" if len(nees) else "-", share(column("nis"), NIS_90),
        f"{share(z, 1)} / {share(z, 2)}", f"{share(hidden, 1)} / {share(hidden, 2)} of {len(hidden)}",
        f"{np.sqrt(np.mean(rate**2)):.3f} m/s" if len(rate) else "-", f"{share(column('ttc'), 0.1)} of {len(column('ttc'))}",
    )  # fmt: skip
    return "| " + " | ".join(str(c) for c in cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenarios", nargs="*", default=list(SCENARIOS))
    parser.add_argument("--seeds", type=int, default=4)
    args = parser.parse_args()
    print(HEAD + "\n" + "|---" * 9 + "|")
    every: list[dict[str, Any]] = []
    for name in args.scenarios:
        runs = [drive(name, seed) for seed in range(args.seeds)]
        every += runs
        print(_row(name, runs), flush=True)
    print(_row("all", every))


if __name__ == "__main__":
    main()
