#!/usr/bin/env python3
"""Splits dashcam_ro into training, guard and held-out images by contiguous stretches of each ride.

Image names end in `_t_<seconds of the ride>.jpg`. A ride is cut where no image exists for more than GUARD_S, so that no two parts share
a scene; of these stretches about a fifth of each ride's images is held out, evenly spread over the ride. Images closer than GUARD_S to a
held-out one (there are none when cuts are gaps) are given to neither part.

usage: dashcam_split.py FOLDER [--write LIST]     prints the counts; LIST: one held-out image name a line
"""
from __future__ import annotations

import argparse
import re
from pathlib import Path

GUARD_S = 10.0
HELD_OUT = 0.2
NAME = re.compile(r"(?P<ride>.+)_t_(?P<t>[0-9.]+)\.(jpg|jpeg|png)$")
HERE = Path(__file__).resolve().parent
LIST = HERE / "dashcam_ro_holdout.txt"


def ride_and_time_s(name: str) -> tuple[str, float]:
    """The ride's name and the second in it at which the image was taken. Raises: ValueError for another kind of name."""
    m = NAME.match(name)
    if m is None:
        raise ValueError(f"{name}: not of the form RIDE_t_SECONDS.jpg")
    return m["ride"], float(m["t"])


def stretches(names: list[str]) -> dict[str, list[list[str]]]:
    """Ride -> its images in time order, cut wherever GUARD_S or more pass without one."""
    rides: dict[str, list[list[str]]] = {}
    last_s = 0.0
    for ride, t_s, name in sorted((*ride_and_time_s(n), n) for n in names):
        parts = rides.setdefault(ride, [])
        if not parts or t_s - last_s > GUARD_S:
            parts.append([])
        parts[-1].append(name)
        last_s = t_s
    return rides


def choose_held_out(names: list[str]) -> list[str]:
    """About HELD_OUT of every ride: a stretch is taken whenever the part held out so far is behind its share (Bresenham's rule)."""
    held: list[str] = []
    for parts in stretches(names).values():
        total = sum(map(len, parts))
        seen = taken = 0
        for part in parts:
            seen += len(part)
            if taken + len(part) / 2 <= HELD_OUT * seen and taken + len(part) <= 1.4 * HELD_OUT * total:
                held += part
                taken += len(part)
    return sorted(held)


def training_names(names: list[str], held: list[str]) -> list[str]:
    """The images that are neither held out nor within GUARD_S of a held-out one of the same ride."""
    gone = set(held)
    times: dict[str, list[float]] = {}
    for n in held:
        ride, t_s = ride_and_time_s(n)
        times.setdefault(ride, []).append(t_s)
    out = []
    for n in names:
        ride, t_s = ride_and_time_s(n)
        if n not in gone and all(abs(t_s - h) > GUARD_S for h in times.get(ride, [])):
            out.append(n)
    return out


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", type=Path)
    p.add_argument("--write", type=Path, help=f"write the list (the committed one is {LIST.name})")
    a = p.parse_args()
    names = sorted(f.name for f in a.folder.iterdir() if f.suffix.lower() in {".jpg", ".jpeg", ".png"})
    held = choose_held_out(names)
    train = training_names(names, held)
    for ride, parts in stretches(names).items():
        n_held = sum(n in set(held) for part in parts for n in part)
        print(f"{ride}: {sum(map(len, parts))} images in {len(parts)} stretches, {n_held} held out")
    print(f"training {len(train)}, held out {len(held)}, guard {len(names) - len(train) - len(held)}")
    if a.write:
        a.write.write_text("".join(n + "\n" for n in held))


if __name__ == "__main__":
    main()
