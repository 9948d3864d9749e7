"""The verb `calibrate`: a plate, a chessboard or a known camera in, the `[camera]` table of a configuration out."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

import msgspec

from tmde_edge.adapters.cameras.sources import open_source, read_image
from tmde_edge.adapters.cameras.video_file import SourceError
from tmde_edge.app.calibrate_files import camera_table, export_camera, file_size_px, read_camera, table_text, write_config
from tmde_edge.app.calibrate_plate import PlateJob, PlateOutcome, Shot, pose_is_sure, solve
from tmde_edge.app.calibrate_sources import Ask, Tell, live_shots, shots_of_stills, shots_of_video
from tmde_edge.app.measure import expand, measure_sighting
from tmde_edge.app.wiring import build_camera, build_eyes, threads
from tmde_edge.calibration.board import Board, BoardCalibration, View, calibrate_board, find_view
from tmde_edge.calibration.plate import PlateCalibration, measured_plate
from tmde_edge.calibration.priors import PRIOR_SIGMA, camera_prior, camera_priors
from tmde_edge.calibration.quality import FATAL
from tmde_edge.config import CalibrationRecord, Config
from tmde_edge.errors import CheckFailedError, ConfigError, InputDataError, UsageError
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Pose, Sighting
from tmde_edge.plates.standard import PlateStandard, select
from tmde_edge.ranging.ranger import Ranger

DISTANCES_M = (2.0, 5.0, 10.0)
CHECK_TOLERANCE = 0.03
_BOARD_FRAMES = 40  # at most, of a video
_IMPORT_SIGMA = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrateOptions:
    """The options of `tmde-edge calibrate`."""

    config_file: Path | None = None
    images: tuple[str, ...] = ()
    video: str | None = None
    at_s: tuple[float, ...] = ()
    distances_m: tuple[float, ...] = ()
    standard: str | None = None
    plate_mm: tuple[float, float] | None = None
    char_mm: float | None = None
    straight: bool = False
    fit_offset: bool = False
    tape_sigma_m: float = 0.01
    camera: str | None = None
    lens_mm: float | None = None
    live: bool = False
    board: Board | None = None
    import_file: Path | None = None
    export_file: Path | None = None
    export_kind: Literal["ros", "opencv"] = "ros"
    check: bool = False
    tolerance: float = CHECK_TOLERANCE
    camera_id: str = ""


def calibrate(config: Config, base_dir: Path, o: CalibrateOptions, ask: Ask, tell: Tell, show: Tell) -> int:
    """Runs the verb; `tell` takes lines for people, `show` what was asked for (a table, a verdict). Returns 0.

    Raises UsageError, ConfigError, InputDataError, InputMissingError, DeviceError; CheckFailedError for captures that
    are not good enough, or a check that fails.
    """
    if o.camera == "list":
        for name, prior in camera_priors().items():
            lens = f"{prior.lens_mm:g} mm" if prior.lens_mm else "fixed lens" if prior.fx_px else "needs --lens-mm"
            show(f"{name:12} {prior.columns}x{prior.rows}  {lens:16} {prior.name}. {prior.note}")
        return 0
    if o.export_file is not None:
        return _export(config, o, tell)
    if o.import_file is not None:
        return _import(o, tell, show)
    if o.camera is not None and not (o.images or o.video or o.live or o.check):
        return _prior(config, o, tell, show)
    if o.board is not None:
        return _board(config, o, tell, show)
    if o.check:
        return _check(config, base_dir, o, ask, tell, show)
    return _plate(config, base_dir, o, ask, tell, show)


# -- a plate ---------------------------------------------------------------------------------------------------------------


def _plate(config: Config, base_dir: Path, o: CalibrateOptions, ask: Ask, tell: Tell, show: Tell) -> int:
    standard = _standard(config, o)
    shots = _shots(config, base_dir, o, ask, tell)
    if not shots:
        raise CheckFailedError("no capture was taken: nothing is changed")
    size = next(((s.width_px, s.height_px) for s in shots if s.width_px), (config.camera.width_px, config.camera.height_px))
    prior_px = camera_prior(o.camera).focal_px(*size, o.lens_mm) if o.camera is not None else None
    job = PlateJob(
        standard=standard, tape_sigma_m=o.tape_sigma_m, straight=o.straight, fit_offset=o.fit_offset, prior_px=prior_px,
        lens=_lens(config, size), pitch_rad=config.camera.pitch_rad, roll_rad=config.camera.roll_rad,
    )
    outcome = solve(shots, job)
    if not o.fit_offset and any(p.kind == "trend" for p in outcome.problems) and not (o.images or o.video):
        trend = next(p for p in outcome.problems if p.kind == "trend")
        tell(trend.text)
        if (ask("make the offset the second unknown? [y/N] ") or "").strip().lower().startswith("y"):
            outcome = solve(shots, replace(job, fit_offset=True))
    for line in plate_lines(outcome):
        tell(line)
    calibration = outcome.calibration
    if calibration is None or not outcome.usable:
        reasons = [p.text for p in outcome.problems if p.kind in FATAL] or ["no good capture"]
        raise CheckFailedError("not calibrated, nothing is changed: " + "; ".join(reasons))
    camera = _camera_of(calibration, job.lens)
    pose: dict[str, float] = {}
    if calibration.pose.pitch_rad is not None and pose_is_sure(calibration):
        pose = {"pitch_rad": calibration.pose.pitch_rad, "roll_rad": calibration.pose.roll_rad}
    record = CalibrationRecord(
        method="plate", date=_now().isoformat(timespec="seconds"), camera_id=o.camera_id or config.camera.device,
        width_px=camera.width_px, height_px=camera.height_px, sigma=round(calibration.sigma, 5),
        distances_m=[c.capture.distance_m for c in calibration.captures],
        residuals=[round(r, 5) for r in calibration.residuals],
        offset_m=None if calibration.offset_m is None else round(calibration.offset_m, 4),
        note="; ".join([f"plate {standard.id}", *(p.text for p in outcome.problems)]),
    )
    _write(o, camera, record, pose, tell, show)
    return 0


def _shots(config: Config, base_dir: Path, o: CalibrateOptions, ask: Ask, tell: Tell) -> list[Shot]:
    eyes = build_eyes(config, time.perf_counter_ns)
    if o.images:
        return list(shots_of_stills(eyes, expand(o.images), o.distances_m or DISTANCES_M))
    if o.video is not None:
        return shots_of_video(eyes, o.video, o.distances_m or DISTANCES_M, o.at_s, threads(config))
    return live_shots(eyes, build_camera(config, base_dir), o.distances_m or DISTANCES_M, ask, tell)


def _standard(config: Config, o: CalibrateOptions) -> PlateStandard:
    names = [o.standard] if o.standard is not None else config.plates.expect
    found = select(names)
    if len(found) > 1:
        shown = ", ".join(s.id for s in found[:6]) + (", ..." if len(found) > 6 else "")
        raise UsageError(f"which plate is it? {', '.join(names)} means {shown}; name one: --standard {found[0].id}")
    standard = found[0]
    if o.plate_mm is not None:
        standard = measured_plate(standard, *o.plate_mm, o.char_mm)
    elif o.char_mm is not None:
        raise UsageError("--char-mm needs --plate-mm too: measure the plate's width and height with a ruler")
    return standard


def _lens(config: Config, size: tuple[int, int]) -> Camera | None:
    """Principal point and distortion of an earlier calibration with a board; None where there is none for this aspect."""
    c = config.camera
    if c.fx_px is None or not (c.distortion or c.cx_px is not None):
        return None
    camera = c.camera()
    try:
        return camera.scaled_to(*size) if camera is not None else None
    except ValueError:
        return None


def _camera_of(calibration: PlateCalibration, lens: Camera | None) -> Camera:
    w, h, f = calibration.width_px, calibration.height_px, calibration.f_px
    return Camera(
        width_px=w, height_px=h, fx_px=f, fy_px=f if lens is None else f * lens.fy_px / lens.fx_px,
        cx_px=(w - 1) / 2 if lens is None else lens.cx_px, cy_px=(h - 1) / 2 if lens is None else lens.cy_px,
        distortion=() if lens is None else lens.distortion, focal_sigma=calibration.sigma,
    )


def plate_lines(outcome: PlateOutcome) -> list[str]:
    """The outcome for people: each capture by height, width and joint fit with its residual, refused ones, the result."""
    lines = []
    c = outcome.calibration
    if c is not None:
        lines.append(f"{'capture':24} {'distance':>9} {'by height':>16} {'by width':>16} {'f, joint fit':>18} {'residual':>9}")
        for one, residual in zip(c.captures, c.residuals, strict=True):
            lines.append(
                f"{one.capture.name[-24:]:24} {one.capture.distance_m:7.2f} m {_f(one.by_height_px, one.by_height_sigma):>16} "
                f"{_f(one.by_width_px, one.by_width_sigma):>16} "
                f"{_f(one.f_px, math.hypot(one.own_sigma, one.common_sigma)):>18} {100 * residual:+7.2f} %"
            )
    lines += [f"refused: {name}: {problem.text}" for name, problem in outcome.refused]
    if c is not None:
        lines.append(f"f = {c.f_px:.1f} px +- {100 * c.sigma:.2f} % for {c.width_px}x{c.height_px}, {len(c.captures)} captures")
        if c.offset_m is not None and c.offset_sigma_m is not None:
            lines.append(f"the tape began {100 * c.offset_m:+.1f} cm +- {100 * c.offset_sigma_m:.1f} cm in front of the lens")
        p = c.pose
        pitch = ("cannot be told" if p.pitch_rad is None or p.pitch_sigma_rad is None
                 else f"{math.degrees(p.pitch_rad):+.2f} deg +- {math.degrees(p.pitch_sigma_rad):.2f}")  # fmt: skip
        lines.append(f"camera: pitch {pitch} (nose down positive), roll {math.degrees(p.roll_rad):+.2f} deg +- "
                     f"{math.degrees(p.roll_sigma_rad):.2f}")  # fmt: skip
    lines += [f"{'problem' if p.kind in FATAL else 'note'}: {p.text}" for p in outcome.problems]
    return lines


def _f(value: float | None, sigma: float | None) -> str:
    return "-" if value is None or sigma is None else f"{value:.1f} +- {100 * sigma:.1f} %"


def _check(config: Config, base_dir: Path, o: CalibrateOptions, ask: Ask, tell: Tell, show: Tell) -> int:
    """A plate at one known distance: one line, passed or CheckFailedError."""
    camera = config.camera.camera()
    if camera is None:
        raise ConfigError("camera.fx_px is not set: there is no calibration to check; run `tmde-edge calibrate`")
    standard = _standard(config, o)
    if len(o.distances_m) != 1:
        raise UsageError("--check needs one distance, for example --distances 5")
    shots = _shots(config, base_dir, o, ask, tell)
    if len(shots) != 1:
        raise UsageError(f"--check takes one capture, got {len(shots)}")
    shot = shots[0]
    if shot.problem is not None:
        raise CheckFailedError(f"check failed at {shot.distance_m:g} m: {shot.problem.text}")
    job = PlateJob(standard=standard)
    pose = Pose(pitch_rad=config.camera.pitch_rad, roll_rad=config.camera.roll_rad, yaw_rad=config.camera.yaw_rad)
    sighting = Sighting(t_ns=0, frame_index=0, width_px=shot.width_px, height_px=shot.height_px, status="ok",
                        plates=tuple(s.plate for s in shot.seen))  # fmt: skip
    try:
        results = measure_sighting(sighting, camera, Ranger(job.settings, [standard]), pose, config.tracker.path_half_width_m)
    except ValueError as e:
        raise InputDataError(f"{shot.name}: {e}") from None
    ranges = sorted((r.range for r in results if r.range is not None), key=lambda r: r.distance_m)
    if not ranges:
        raise CheckFailedError(f"check failed at {shot.distance_m:g} m: the plate could not be ranged ({results[0].not_ranged})")
    middle = ranges[len(ranges) // 2]
    distance_m = math.hypot(middle.distance_m, middle.lateral_m, middle.down_m) if o.straight else middle.distance_m
    error = distance_m / shot.distance_m - 1
    own = math.hypot(middle.sigma_m / middle.distance_m, o.tape_sigma_m / shot.distance_m)
    text = (f"measured {distance_m:.3f} m at {shot.distance_m:g} m: {100 * error:+.2f} % (one sigma {100 * own:.1f} %, "
            f"allowed {100 * o.tolerance:.1f} %)")  # fmt: skip
    if abs(error) > o.tolerance:
        raise CheckFailedError(f"calibration check FAILED: {text}; calibrate again, or look whether focus or mode changed")
    show(f"calibration check passed: {text}")
    return 0


# -- boards, priors, other programs' files ---------------------------------------------------------------------------------


def _board(config: Config, o: CalibrateOptions, tell: Tell, show: Tell) -> int:
    board = o.board
    if board is None:
        raise UsageError("no board is named")
    threads(config)
    found: list[View] = []
    refused: list[tuple[str, str]] = []
    for name, image in _board_images(o):
        view = find_view(name, image, board) if not isinstance(image, str) else image
        if isinstance(view, View):
            found.append(view)
        else:
            refused.append((name, view))
    result = calibrate_board(found, refused)
    if isinstance(result, str):
        raise CheckFailedError(f"not calibrated, nothing is changed: {result}")
    for line in board_lines(result):
        tell(line)
    camera = Camera(
        width_px=result.width_px, height_px=result.height_px, fx_px=result.fx_px, fy_px=result.fy_px, cx_px=result.cx_px,
        cy_px=result.cy_px, distortion=result.distortion, focal_sigma=result.sigma,
    )
    record = CalibrationRecord(
        method="charuco" if board.kind == "charuco" else "chessboard", date=_now().isoformat(timespec="seconds"),
        camera_id=o.camera_id, width_px=result.width_px, height_px=result.height_px, sigma=round(result.sigma, 5),
        residuals=[round(e, 3) for _, e in result.views],
        note=f"rms {result.rms_px:.3f} px of {len(result.views)} views, {len(result.refused)} refused",
    )
    _write(o, camera, record, {}, tell, show)
    return 0


def _board_images(o: CalibrateOptions) -> list[tuple[str, Any]]:
    if o.images:
        return [(p.name, read_image(p)) for p in expand(o.images)]
    if o.video is None:
        raise UsageError("a board needs --images FILES or --video FILE with views of it from all sides")
    source = open_source(o.video)
    step = max(1, (source.frame_count or 300) // _BOARD_FRAMES)
    frames = (f for f in source if not isinstance(f, SourceError) and f.index % step == 0)
    return [(f"frame {f.index}", f.image) for f in frames][:_BOARD_FRAMES]


def board_lines(result: BoardCalibration) -> list[str]:
    """Per-view errors, refused views by name, and the camera."""
    lines = [f"{name:28} rms {rms:.3f} px" for name, rms in result.views]
    lines += [f"refused: {name}: {reason}" for name, reason in result.refused]
    k = ", ".join(f"{v:.4f}" for v in result.distortion)
    lines.append(
        f"fx = {result.fx_px:.1f} px, fy = {result.fy_px:.1f} px (+- {100 * result.sigma:.2f} %), centre ({result.cx_px:.1f}, "
        f"{result.cy_px:.1f}), distortion [{k}]: rms {result.rms_px:.3f} px of {len(result.views)} views"
    )
    return lines


def _prior(config: Config, o: CalibrateOptions, tell: Tell, show: Tell) -> int:
    if o.camera is None:
        raise UsageError("no camera is named")
    if config.camera.fx_px is not None:
        raise UsageError(
            f"this configuration is calibrated already (camera.fx_px = {config.camera.fx_px:g}); a prior would not be used: "
            "take fx_px out first"
        )
    c = config.camera
    f = camera_prior(o.camera).focal_px(c.width_px, c.height_px, o.lens_mm)
    record = CalibrationRecord(
        method="prior", date=_now().isoformat(timespec="seconds"), camera_id=o.camera_id or o.camera, width_px=c.width_px,
        height_px=c.height_px, sigma=PRIOR_SIGMA, note=f"about f = {f:.0f} px by its data sheet; not measured",
    )
    table: dict[str, Any] = {"prior": o.camera, "width_px": c.width_px, "height_px": c.height_px}
    if o.lens_mm is not None:
        table["lens_mm"] = o.lens_mm
    table["calibration"] = {k: v for k, v in msgspec.to_builtins(record).items() if v not in (None, "", [])}
    tell(f"{o.camera}: about f = {f:.0f} px at {c.width_px}x{c.height_px}, +- {100 * PRIOR_SIGMA:.0f} % in every distance until "
         f"calibrated. {camera_prior(o.camera).note}")  # fmt: skip
    _put(o, table, tell, show, drop=("lens_mm",) if o.lens_mm is None else ())
    return 0


def _import(o: CalibrateOptions, tell: Tell, show: Tell) -> int:
    if o.import_file is None:
        raise UsageError("no file to import")
    camera, name = read_camera(o.import_file, _IMPORT_SIGMA)
    record = CalibrationRecord(
        method="import", date=_now().isoformat(timespec="seconds"), camera_id=o.camera_id or name, width_px=camera.width_px,
        height_px=camera.height_px, sigma=_IMPORT_SIGMA, note=f"from {o.import_file.name}",
    )
    tell(f"fx = {camera.fx_px:.1f} px, fy = {camera.fy_px:.1f} px for {camera.width_px}x{camera.height_px}")
    _write(o, camera, record, {}, tell, show)
    return 0


def _export(config: Config, o: CalibrateOptions, tell: Tell) -> int:
    camera = config.camera.camera()
    if camera is None or o.export_file is None:
        raise ConfigError("camera.fx_px is not set: there is no calibration to export; name the configuration with -c")
    name = config.camera.calibration.camera_id if config.camera.calibration is not None else ""
    export_camera(o.export_file, camera, name, o.export_kind)
    tell(f"{o.export_file}: {camera.width_px}x{camera.height_px}, fx = {camera.fx_px:.1f} px")
    return 0


# -- writing ---------------------------------------------------------------------------------------------------------------


def _write(
    o: CalibrateOptions, camera: Camera, record: CalibrationRecord, pose: dict[str, float], tell: Tell, show: Tell
) -> None:
    """Into the configuration, at the size that it states where it states one (the mode that the camera will run in)."""
    stated = file_size_px(o.config_file) if o.config_file is not None else None
    if stated is not None and stated != (camera.width_px, camera.height_px):
        try:
            camera = camera.scaled_to(*stated)
        except ValueError as e:
            raise CheckFailedError(f"not written: {o.config_file} runs the camera at {stated[0]}x{stated[1]}, but {e}") from None
        tell(f"scaled to the {stated[0]}x{stated[1]} of {o.config_file}: right if that mode sees the same field of view")
    drop = ["prior", "lens_mm"] + ([] if camera.distortion else ["distortion"])
    _put(o, camera_table(camera, record, pose), tell, show, drop=tuple(drop))


def _put(o: CalibrateOptions, table: dict[str, Any], tell: Tell, show: Tell, drop: Sequence[str]) -> None:
    if o.config_file is None:
        tell("no configuration is named with -c FILE: copy this into yours")
        show(table_text(table).rstrip())
        return
    kept = write_config(o.config_file, table, _now(), drop=tuple(drop))
    tell(f"written to {o.config_file}" + (f"; the old one is {kept.name}" if kept is not None else ""))


def _now() -> datetime:
    return datetime.now(timezone.utc)

