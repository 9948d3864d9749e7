"""Prints what the demo measured against the scenario's exact truth; exit 1 where it misses the stated bar."""

from __future__ import annotations

import csv
import json
import statistics
import sys
from pathlib import Path

BAR = 0.03  # median |error| where the plate is at least 60 px wide
MIN_PLATE_PX = 60.0


def main() -> int:
    out, wall_s = Path(sys.argv[1]), float(sys.argv[2])
    records = [json.loads(line) for line in (out / "approach.jsonl").read_text().splitlines()]
    with (out / "approach/truth.csv").open(newline="") as file:
        truth = {int(row["frame"]): row for row in csv.DictReader(file)}
    near: list[float] = []
    errors: list[float] = []
    for record in records:
        row = truth.get(record["frame"])
        if row is None or not row["distance_m"] or not record.get("lead"):
            continue
        error = abs(record["lead"]["distance_m"] / float(row["distance_m"]) - 1)
        errors.append(error)
        if row["tl_x_px"] and float(row["tr_x_px"]) - float(row["tl_x_px"]) >= MIN_PLATE_PX:
            near.append(error)
    if not errors:
        print("no distance was measured")
        return 1
    text = f"|error| median {statistics.median(errors):.2%}, max {max(errors):.2%}"
    print(f"distance, all {len(errors)} frames with a lead: {text}")
    if near:
        text = f"|error| median {statistics.median(near):.2%}, max {max(near):.2%}"
        print(f"distance, plate at least {MIN_PLATE_PX:.0f} px wide ({len(near)} frames): {text} (bar: median {BAR:.0%})")
    for level in ("caution", "warning"):
        first = next((r for r in records if r.get("alert", {}).get("level") == level), None)
        if first is None:
            print(f"{level}: never")
            continue
        row = truth[first["frame"]]
        true_ttc = f", true TTC {float(row['ttc_s']):.2f} s" if row["ttc_s"] else ""
        print(f"{level}: at {first['t']:.2f} s ({first['alert']['reason']}){true_ttc}")
    print(f"{len(records) / wall_s:.1f} frames per second in all (decoding, deciding, drawing and encoding the video)")
    print(f"annotated video: {(out / 'annotated.mp4').resolve()}")
    return 0 if near and statistics.median(near) <= BAR else 1


sys.exit(main())
