#!/usr/bin/env python3
"""Lists places in the training frames that an earlier PlateNet takes for plates though no label says so.

A person looked at each and sorted them: ../dashcam_ro_extra.json holds plates (learnt, their corners hardly) and unsure ones (ignored); the rest were none.

usage: find_unsure.py --model FILE.onnx --dashcam FOLDER --out unsure.json [--score 0.3] [--sheet OUT.png]
"""
from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[2])]
from dashcam_split import training_names  # noqa: E402
from evaluate import _tile, box, iou, multi_scale  # noqa: E402
from scenes import load_frames  # noqa: E402

from tmde_edge.adapters.detectors.platenet import PlateNet  # noqa: E402


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--model", type=Path, required=True)
    p.add_argument("--dashcam", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--score", type=float, default=0.3)
    p.add_argument("--sheet", type=Path)
    a = p.parse_args()
    cv2.setNumThreads(1)
    net = PlateNet(1, a.model)
    held = (HERE.parent / "dashcam_ro_holdout.txt").read_text().split()
    names = training_names(sorted(f.name for f in a.dashcam.glob("*.jpg")), held)
    unsure, tiles = {}, []
    for name in names:
        frame = load_frames(a.dashcam, {name}, {})[0]
        got = multi_scale(net, frame.image, [0.5, 1.0], a.score)
        places = [c for c in got if all(iou(box(c.corners_px), b) < 0.1 for b in frame.boxes)]
        if places:
            unsure[name] = [[round(v, 1) for v in box(c.corners_px)] for c in places]
            tiles += [_tile(frame.image, box(c.corners_px), got, (255, 200, 0), f"{c.score:.2f}") for c in places]
    a.out.write_text(json.dumps(unsure, indent=0))
    print(f"{sum(map(len, unsure.values()))} places in {len(unsure)} of {len(names)} frames")
    if a.sheet:
        tiles = tiles[:: max(1, len(tiles) // 60)][:60]
        tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 6)
        cv2.imwrite(str(a.sheet), np.vstack([np.hstack(tiles[i:i + 6]) for i in range(0, len(tiles), 6)]))


if __name__ == "__main__":
    main()
