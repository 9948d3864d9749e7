"""Pitch errors of lanes, of the horizon network alone, and of both with the picture's movement, on rendered drives.

python tests/benchmarks/horizon_drives.py [--scenarios pitching,crest] [--seeds 0] [--rate 30] [--seconds 8] [--bare]

--bare: the same drives without road markings. Frames are rendered at --rate (no motion blur). Markdown on stdout.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import cv2
import numpy as np

from tmde_edge.adapters.detectors.horizonnet import HorizonNet
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import LaneSighting, Pose
from tmde_edge.pose.attitude import AttitudeEstimator
from tmde_edge.pose.compensate import ground_range, vanishing_point_px, view_from_vehicle
from tmde_edge.pose.lanes import LaneFinder
from tmde_edge.pose.settings import PoseSettings
from tmde_edge.pose.tilt import TiltMeter
from tmde_edge.simulation.drive import picture
from tmde_edge.simulation.scenario import Scenario
from tmde_edge.simulation.scenarios import build


def drive(scenario: Scenario, rate_hz: float, seconds: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pitch error and sigma (deg) of every frame; NaN where a method says nothing."""
    c = scenario.camera
    camera = Camera(width_px=c.width_px, height_px=c.height_px, fx_px=c.fx_px, fy_px=c.fy_px, cx_px=c.cx_px, cy_px=c.cy_px)
    pose, net = PoseSettings(), HorizonNet()
    finder, meter = LaneFinder(pose), TiltMeter()
    filters = {
        name: AttitudeEstimator(pose, camera, pitch_rad=c.pitch_rad)
        for name in ("lanes, filtered", "network, filtered", "as configured")
    }
    out: dict[str, list[tuple[float, float]]] = {k: [] for k in ("lanes", "network", *filters)}
    ground: dict[str, list[tuple[float, float]]] = {"ground range at 30 m, %": [], "the same uncompensated, %": []}
    step, due_s = round(scenario.rate_hz / rate_hz), 0.0
    for k in range(0, min(scenario.frame_count, round(seconds * scenario.rate_hz)), step):
        t_s = k / scenario.rate_hz
        t_ns = round(t_s * 1e9)
        true_rad = c.pitch_rad + scenario.pitch_rad(t_s)
        image = picture(scenario, k)
        expected = vanishing_point_px(filters["lanes, filtered"].rest, c)
        lanes, network = finder.see(image, t_ns, expected), net.see(image, c.fx_px, expected)
        tilt = meter.see(image, t_ns, expected)
        for name, seen in (("lanes", lanes), ("network", network)):
            out[name].append(_raw(seen, c.cy_px, c.fy_px, true_rad))
        if t_s >= due_s:  # at their own rate, as in the service
            due_s, looked, asked = t_s + 0.99 / pose.rate_hz, lanes, network
        else:
            looked = asked = None
        for name, seen in (("lanes, filtered", looked), ("network, filtered", asked), ("as configured", looked or asked)):
            found = filters[name].update(seen, t_ns, None, (c.width_px, c.height_px), tilt)
            out[name].append((math.degrees(found.pitch_rad - true_rad), math.degrees(found.pitch_sigma_rad)))
        # a vehicle's contact point 30 m ahead, as the pose takes it to metres, and as the calibrated pose would
        turn = view_from_vehicle(Pose(pitch_rad=true_rad, roll_rad=0.0))
        spot = camera.project(np.array([[0.0, c.height_m, 30.0]]) @ turn.T)[0]
        for name, pitch_rad in (("ground range at 30 m, %", found.pitch_rad), ("the same uncompensated, %", c.pitch_rad)):
            at = ground_range((float(spot[0]), float(spot[1])), camera, Pose(pitch_rad=pitch_rad, roll_rad=0.0), c.height_m)
            ground[name].append((100.0 * (at[0] / 30.0 - 1.0) if at is not None else 100.0, math.inf))
    out.update(ground)
    return {k: (np.array([a for a, _ in v]), np.array([b for _, b in v])) for k, v in out.items()}


def _raw(seen: LaneSighting | None, cy_px: float, fy_px: float, true_rad: float) -> tuple[float, float]:
    if seen is None:
        return math.nan, math.nan
    pitch_rad = math.atan((cy_px - seen.vanishing_px[1]) / fy_px)
    return math.degrees(pitch_rad - true_rad), math.degrees(seen.sigma_y_px / fy_px)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default="pitching")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--bare", action="store_true")
    a = parser.parse_args()
    cv2.setNumThreads(1)
    print("| scenario, seed | method | frames | rms error, deg or % | inside 1 / 2 sigma |\n|---|---|---|---|---|")
    for name in a.scenarios.split(","):
        for seed in map(int, a.seeds.split(",")):
            scenario = replace(build(name, seed=seed), subframes=1)
            if a.bare:
                scenario = replace(scenario, style=replace(scenario.style, markings=()))
            for method, (error, sigma) in drive(scenario, a.rate, a.seconds).items():
                ok = np.isfinite(error)
                e = np.abs(error[ok])
                rms = float(np.sqrt(np.mean(e**2))) if ok.any() else math.nan
                inside = [float(np.mean(e < n * sigma[ok])) if ok.any() else math.nan for n in (1, 2)]
                print(f"| {name}{', bare' if a.bare else ''}, {seed} | {method} | {ok.mean():.2f} | {rms:.2f} "
                      f"| {inside[0]:.2f} / {inside[1]:.2f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
