"""Where captures come from: stills, a video (its sharp frames), a live camera with prompts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from tmde_edge.adapters.cameras.live_camera import LiveCamera
from tmde_edge.adapters.cameras.sources import FrameSource, open_source, read_image
from tmde_edge.adapters.cameras.video_file import SourceError
from tmde_edge.app.calibrate_plate import Image, Seen, Shot, see_plate, shot_of
from tmde_edge.app.eyes import Eyes
from tmde_edge.calibration.quality import Problem
from tmde_edge.errors import CheckFailedError, DeviceError, InputDataError, UsageError
from tmde_edge.messages import Frame

Ask = Callable[[str], str | None]  # the answer to a prompt; None: no more input
Tell = Callable[[str], None]

_EVERY_S = 0.2  # of a video that is looked at
_STILL = 0.012  # the plate's width varies by less while it is held at one distance
_STILL_S = 1.0
_AROUND_S = 0.5  # of a stated time
_LIVE_S = 2.0  # of frames that one live capture looks at
_LIVE_FRAMES = 10
_FIRST_FRAME_S = 8.0


def distances_of(texts: Sequence[float], count: int) -> list[float]:
    """One distance a capture. Raises UsageError."""
    if len(texts) != count:
        raise UsageError(f"{count} captures but {len(texts)} --distances: give one in metres for each, in the same order")
    for d in texts:
        if not (math.isfinite(d) and 0.1 <= d <= 200):
            raise UsageError(f"--distances {d:g}: give metres, 0.1 to 200")
    return list(texts)


def shots_of_stills(eyes: Eyes, paths: Sequence[Path], distances_m: Sequence[float]) -> Iterator[Shot]:
    """One shot an image. Raises InputDataError for an image that cannot be read."""
    for path, distance_m in zip(paths, distances_of(distances_m, len(paths)), strict=True):
        image = read_image(path)
        if isinstance(image, str):
            raise InputDataError(image)
        yield shot_of(path.name, distance_m, _size(image), [see_plate(eyes, image)])


def shots_of_video(eyes: Eyes, path: str, distances_m: Sequence[float], at_s: Sequence[float], threads: int = 1) -> list[Shot]:
    """One shot a distance: the sharp frames round the stated times, else of the stretches in which the plate stands still.

    Raises UsageError, InputDataError; CheckFailedError where the stretches do not match the distances.
    """
    source = open_source(path, threads=threads)
    if at_s:
        distances = distances_of(distances_m, len(at_s))
        near: list[list[Seen | Problem]] = [[] for _ in at_s]
        size = (0, 0)
        for frame in _frames(source):
            t_s = frame.t_ns * 1e-9
            for i, at in enumerate(at_s):
                if abs(t_s - at) <= _AROUND_S:
                    size = _size(frame.image)
                    near[i].append(see_plate(eyes, frame.image))
        return [shot_of(f"{t:g} s", d, size, seen) for t, d, seen in zip(at_s, distances, near, strict=True)]
    times: list[float] = []
    found: list[Seen] = []
    size, next_s = (0, 0), 0.0
    for frame in _frames(source):
        t_s = frame.t_ns * 1e-9
        if t_s + 1e-6 < next_s:
            continue
        next_s = t_s + _EVERY_S
        seen = see_plate(eyes, frame.image)
        if isinstance(seen, Seen):
            size = _size(frame.image)
            times.append(t_s)
            found.append(seen)
    stretches = still_stretches(np.array(times), np.log([_width(s) for s in found]))
    if len(stretches) != len(distances_m):
        where = ", ".join(f"{times[a]:.1f}-{times[b - 1]:.1f} s" for a, b in stretches) or "none"
        raise CheckFailedError(
            f"{path}: {len(stretches)} stretches in which a plate stands still ({where}), but {len(distances_m)} distances; "
            "hold the plate still for two seconds at each, or name the times: --at SECONDS ..."
        )
    distances = distances_of(distances_m, len(stretches))
    return [
        shot_of(f"{times[a]:.1f}-{times[b - 1]:.1f} s", d, size, found[a:b])
        for (a, b), d in zip(stretches, distances, strict=True)
    ]


def still_stretches(times_s: np.ndarray, log_width: np.ndarray) -> list[tuple[int, int]]:
    """Index ranges [a, b) in which the width keeps within 1.2 % of its median for a second or more without a gap."""
    out: list[tuple[int, int]] = []
    a = 0
    for b in range(1, len(times_s) + 1):
        inside = b < len(times_s) and times_s[b] - times_s[b - 1] < 3 * _EVERY_S
        if inside and abs(log_width[b] - np.median(log_width[a:b])) < _STILL:
            continue
        if times_s[b - 1] - times_s[a] >= _STILL_S - 1e-6:
            out.append((a, b))
            a = b
        else:
            a = b if not inside else a + 1
            while a < b and abs(log_width[b] - np.median(log_width[a:b])) >= _STILL:
                a += 1
    merged: list[tuple[int, int]] = []
    for a, b in out:  # a hand's tremble does not make two captures of one
        if merged and abs(np.median(log_width[slice(*merged[-1])]) - np.median(log_width[a:b])) < 2 * _STILL:
            merged[-1] = (merged[-1][0], b)
        else:
            merged.append((a, b))
    return merged


def live_shots(eyes: Eyes, camera: LiveCamera, distances_m: Sequence[float], ask: Ask, tell: Tell) -> list[Shot]:
    """Asks for a plate at each distance, then for more until the user is done. Raises DeviceError, UsageError."""
    camera.open()
    shots: list[Shot] = []
    wanted = list(distances_m)
    try:
        while True:
            answer = ask(
                f"plate at {wanted[0]:g} m: Enter takes it, a number is another distance in m, s skips, d is done: " if wanted
                else "one more? its distance in m, or Enter when done: "
            )  # fmt: skip
            text = (answer or "").strip().lower()
            if answer is None or text in ("d", "done", "q", "quit") or (not wanted and not text):
                return shots
            if text in ("s", "skip"):
                wanted = wanted[1:]
                continue
            if text:
                try:
                    distance_m = distances_of([float(text.removesuffix("m"))], 1)[0]
                except (ValueError, UsageError):
                    tell(f"{text!r} is no distance in metres; for example 5")
                    continue
            else:
                distance_m = wanted[0]
            shot = _live_shot(eyes, camera, distance_m)
            if shot.problem is not None:
                tell(f"not taken: {shot.problem.text}")
                continue
            best = shot.seen[0]
            tell(f"taken at {distance_m:g} m: {len(shot.seen)} frames, the plate is {_width(best):.0f} px wide, "
                 f"{len(best.found.glyphs)} characters")  # fmt: skip
            shots.append(shot)
            wanted = wanted[1:]
    finally:
        camera.close()


def _live_shot(eyes: Eyes, camera: LiveCamera, distance_m: float) -> Shot:
    """Frames of the next two seconds; whatever waited in the driver's queue is let go. Raises DeviceError."""
    seen: list[Seen | Problem] = []
    size = (0, 0)
    camera.read(0.05)
    start_s = time.monotonic()
    while len(seen) < _LIVE_FRAMES and time.monotonic() - start_s < (_LIVE_S if seen else _FIRST_FRAME_S):
        captured = camera.read(1.0)
        image = captured.decode() if captured is not None else None
        if image is None:
            if camera.ended:
                break
            continue
        size = _size(image)
        seen.append(see_plate(eyes, image))
    if not seen:
        raise DeviceError(f"{camera.name}: no frame came for {_FIRST_FRAME_S:g} s; is it the right camera.device?")
    return shot_of(f"capture at {distance_m:g} m", distance_m, size, seen)


def _frames(source: FrameSource) -> Iterator[Frame]:
    for item in source:
        if not isinstance(item, SourceError):
            yield item


def _width(seen: Seen) -> float:
    c = np.array(seen.found.corners_px)
    return float((np.hypot(*(c[1] - c[0])) + np.hypot(*(c[2] - c[3]))) / 2)


def _size(image: Image) -> tuple[int, int]:
    return image.shape[1], image.shape[0]
