"""Stills: every image by itself, plates found and their distances, no memory between them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tmde_edge.adapters.cameras.sources import image_files, read_image
from tmde_edge.app.dry_run import size_error
from tmde_edge.app.eyes import Eyes
from tmde_edge.app.records import Record, plate_record
from tmde_edge.errors import InputMissingError
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Frame, PlateResult, Pose, Sighting
from tmde_edge.pose.compensate import view_from_vehicle
from tmde_edge.ranging.ranger import Ranger


def expand(paths: Sequence[str]) -> list[Path]:
    """Files as named, folders as their images in name order. Raises InputMissingError for what is not there."""
    found: list[Path] = []
    for name in paths:
        path = Path(name)
        if path.is_dir():
            inside = image_files(path)
            if not inside:
                raise InputMissingError(f"{name}: no images in this folder")
            found += inside
        elif path.exists():
            found.append(path)
        else:
            raise InputMissingError(f"{name}: no such file or folder")
    return found


def measure_sighting(
    sighting: Sighting, camera: Camera | None, ranger: Ranger, pose: Pose, path_half_width_m: float
) -> tuple[PlateResult, ...]:
    """Ranges every plate of a still by itself; the lead is the nearest in front."""
    fitted = camera.scaled_to(sighting.width_px, sighting.height_px) if camera is not None else None
    view = view_from_vehicle(pose)
    results: list[PlateResult] = []
    for plate in sighting.plates:
        if fitted is None:
            results.append(PlateResult(sighting=plate, range=None, not_ranged="uncalibrated"))
            continue
        found, _, reason = ranger.measure(plate, fitted, view, sighting.t_ns, None)
        in_path = found is not None and abs(found.lateral_m) <= path_half_width_m
        results.append(PlateResult(sighting=plate, range=found, not_ranged=reason, in_path=in_path))
    inside = [(r.range.distance_m, i) for i, r in enumerate(results) if r.in_path and r.range is not None]
    if inside:
        i = min(inside)[1]
        old = results[i]
        results[i] = PlateResult(sighting=old.sighting, range=old.range, not_ranged=old.not_ranged, in_path=True, lead=True)
    return tuple(results)


def measure_images(
    paths: Sequence[Path],
    eyes: Eyes,
    camera: Camera | None,
    ranger: Ranger,
    pose: Pose,
    path_half_width_m: float,
) -> Iterator[tuple[Record, np.ndarray | None, tuple[PlateResult, ...]]]:
    """One record an image, in order, with the image itself and its results for who draws them."""
    for index, path in enumerate(paths):
        image = read_image(path)
        if isinstance(image, str):
            yield {"image": str(path), "error": image}, None, ()
            continue
        height_px, width_px = image.shape[:2]
        misfit = size_error(camera, width_px, height_px)
        if misfit is not None:
            yield {"image": str(path), "error": misfit}, image, ()
            continue
        start_ns = time.perf_counter_ns()
        sighting = eyes.see_still(Frame(t_ns=0, index=index, image=image))
        seen_ns = time.perf_counter_ns()
        results = measure_sighting(sighting, camera, ranger, pose, path_half_width_m)
        end_ns = time.perf_counter_ns()
        timing = dict(sighting.timing_ms)
        timing["range"] = (end_ns - seen_ns) * 1e-6
        timing["total"] = (end_ns - start_ns) * 1e-6
        record: Record = {
            "image": str(path),
            "width": width_px,
            "height": height_px,
            "plates": [plate_record(r) for r in results],
            "status": sighting.status,
            "timing_ms": {k: round(v, 3) for k, v in timing.items()},
        }
        yield record, image, results
