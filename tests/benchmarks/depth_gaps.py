"""What depth is worth while the plate is hidden: the gap scenarios with simulated depth, with and without it.

python tests/benchmarks/depth_gaps.py FOLDER [--seeds 0,1,2] [--scenarios gap-steady,...]

Renders each scenario once (kept in FOLDER), looks at it once, and decides the same sightings under every setting. The
error at the end of the gap is the lead's last distance before the plate is seen again, against the truth. `worst` is the
largest growth of the error anywhere, in sigmas that the lead had without depth. Markdown on stdout.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tmde_edge.app.desk import Desk, DeskOptions
from tmde_edge.app.drive_log import DriveLogReader
from tmde_edge.app.simulate import simulate
from tmde_edge.app.wiring import build_estimation
from tmde_edge.config import load
from tmde_edge.messages import CanFrame, Event, FrameResult

GAPS = ("gap-steady", "gap-braking", "gap-away", "gap-closing", "gap-curve")
VARIANTS = {  # name -> (settings, with depth)
    "neither": (["tracker.vehicle_scale=false"], False),
    "depth": (["tracker.vehicle_scale=false"], True),
    "vehicle": (["tracker.vehicle_scale=true"], False),
    "both": (["tracker.vehicle_scale=true"], True),
}


def recorded(folder: Path, name: str, seed: int) -> tuple[Path, list[Event]]:
    """The drive's folder and what perception, bus and depth gave; made where it is missing."""
    home = folder / f"{name}-{seed}"
    log = home / "drive.mcap"
    if not log.is_file():
        if not (home / "config.toml").is_file():  # written last
            simulate(name, home, seed=seed)
        config = load(home / "config.toml", ['depth.kind="recorded"', "runtime.threads=1"])
        part = home / "part.mcap"
        options = DeskOptions(source=str(home / "video.mp4"), can_log=home / "can.log", record=part)
        with contextlib.redirect_stderr(io.StringIO()), Desk(config, home, options) as desk:
            for _ in desk:
                pass
        part.replace(log)
    return home, [entry.event for entry in DriveLogReader(log).entries()]


def decided(home: Path, events: list[Event], settings: list[str], depth: bool) -> list[FrameResult]:
    """The results of the frames under these settings."""
    kind = "recorded" if depth else "none"
    estimation = build_estimation(load(home / "config.toml", [f'depth.kind="{kind}"', *settings]), home)
    results: dict[int, FrameResult] = {}
    for event in events:
        for output in estimation.step(event):
            if not isinstance(output, CanFrame):
                results[output.frame_index] = output
    return [results[k] for k in sorted(results)]


def errors(results: list[FrameResult], truth: list[dict[str, str]]) -> tuple[np.ndarray, np.ndarray]:
    """|error| and sigma of the lead's distance of every frame (m); NaN where there is no lead."""
    error, sigma = np.full(len(truth), np.nan), np.full(len(truth), np.nan)
    for r in results:
        lead, true_m = r.lead, truth[r.frame_index]["distance_m"]
        if lead is not None and lead.distance_m is not None and lead.sigma_m is not None and true_m:
            error[r.frame_index] = abs(lead.distance_m - float(true_m))
            sigma[r.frame_index] = lead.sigma_m
    return error, sigma


def judged(home: Path, events: list[Event]) -> dict[str, Any]:
    """Errors at the end of the gap for every variant, and the worst growth by depth in sigmas."""
    with (home / "truth.csv").open(newline="") as file:
        truth = list(csv.DictReader(file))
    hidden = np.array([float(t["plate_visible"] or 0.0) < 0.05 for t in truth])
    last = int(np.flatnonzero(hidden).max())
    found = {name: errors(decided(home, events, *variant), truth) for name, variant in VARIANTS.items()}
    row: dict[str, Any] = {"d": float(truth[last]["distance_m"])}
    for name, (error, sigma) in found.items():
        row[name] = float(error[last])
        row[f"{name} in gap"] = float(np.nanmean(error[hidden]))
        with np.errstate(invalid="ignore"):
            row[f"{name} inside"] = float(np.nanmean(error[hidden] < sigma[hidden]))
            row[f"{name} inside 2"] = float(np.nanmean(error[hidden] < 2 * sigma[hidden]))
    for with_depth, without in (("depth", "neither"), ("both", "vehicle")):
        grown = (found[with_depth][0] - found[without][0]) / found[without][1]
        row[f"worst {with_depth}"] = float(np.nanmax(grown))
        row[f"lost {with_depth}"] = int((np.isnan(found[with_depth][0]) & ~np.isnan(found[without][0])).sum())
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--scenarios", default=",".join(GAPS))
    a = parser.parse_args()
    cv2.setNumThreads(1)
    print("| scenario, seed | distance | error at the end, m: neither | depth | ratio | vehicle scale | both "
          "| worst growth, sigma: depth | both | in 1 / 2 sigma in the gap, depth |\n|" + 10 * "---|")  # fmt: skip
    rows = []
    for seed in map(int, a.seeds.split(",")):
        for name in a.scenarios.split(","):
            r = judged(*recorded(a.folder, name, seed))
            rows.append(r)
            ratio = r["depth"] / max(r["neither"], 1e-6)
            print(f"| {name}, {seed} | {r['d']:.1f} m | {r['neither']:.2f} | {r['depth']:.2f} | {ratio:.2f} "
                  f"| {r['vehicle']:.2f} | {r['both']:.2f} | {r['worst depth']:.2f} | {r['worst both']:.2f} "
                  f"| {r['depth inside']:.2f} / {r['depth inside 2']:.2f} |", flush=True)  # fmt: skip
    kept = [r for r in rows if math.isfinite(r["neither"])]  # elsewhere the lead is lost without depth (nan)
    mean = {k: math.fsum(r[k] for r in kept) / max(len(kept), 1) for k in ("neither", "depth", "vehicle", "both")}
    print(f"| mean | | {mean['neither']:.2f} | {mean['depth']:.2f} | {mean['depth'] / mean['neither']:.2f} "
          f"| {mean['vehicle']:.2f} | {mean['both']:.2f} | | | |")  # fmt: skip


if __name__ == "__main__":
    main()
