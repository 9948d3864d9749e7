"""The verb `simulate`: a scenario's video, CAN log, truth and configuration into a folder."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tmde_edge.adapters.depth.recorded import write_track
from tmde_edge.adapters.video_out import VideoWriter
from tmde_edge.errors import UsageError, writing
from tmde_edge.simulation.depth import MODEL, DepthTrack
from tmde_edge.simulation.drive import FrameTruth, VehicleTruth, frame_truth, picture
from tmde_edge.simulation.scenario import Scenario
from tmde_edge.simulation.scenarios import build, names

CAN_EPOCH_S = 1_700_000_000.0  # CAN stamps are wall clock; a fixed one, so that two runs are the same
CAN_RATE_HZ = 50.0
SPEED_ID, YAW_ID = 0x0B4, 0x0B6
SPEED_SCALE_KPH, YAW_SCALE_DPS = 0.01, 0.01
_CRF = 20

Progress = Callable[[int, int], None]

LEAD_COLUMNS = (
    "frame", "t_s", "distance_m", "range_rate_mps", "gap_m", "ttc_s", "ttc_braking_s", "lateral_m", "ego_speed_mps",
    "yaw_rate_radps", "pitch_rad", "roll_rad", "horizon_px", "tl_x_px", "tl_y_px", "tr_x_px", "tr_y_px", "br_x_px",
    "br_y_px", "bl_x_px", "bl_y_px", "char_height_px", "glyph_count", "plate_visible", "in_path", "vehicle", "alert_due",
)
VEHICLE_COLUMNS = (
    "frame", "t_s", "vehicle", "distance_m", "range_rate_mps", "gap_m", "ttc_s", "ttc_braking_s", "lateral_m",
    "path_offset_m", "in_path", "speed_mps", "tl_x_px", "tl_y_px", "tr_x_px", "tr_y_px", "br_x_px", "br_y_px", "bl_x_px",
    "bl_y_px", "char_height_px", "glyph_count", "plate_visible",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """What `simulate` left in the folder."""

    scenario: Scenario
    folder: Path
    frame_count: int
    truth: tuple[FrameTruth, ...]

    @property
    def video(self) -> Path:
        """H.264 video."""
        return self.folder / "video.mp4"

    @property
    def can_log(self) -> Path:
        """candump -L log of ego speed and yaw rate."""
        return self.folder / "can.log"

    @property
    def truth_csv(self) -> Path:
        """One row a frame."""
        return self.folder / "truth.csv"

    @property
    def depth_track(self) -> Path:
        """Simulated relative inverse depth for `depth.kind = "recorded"`."""
        return self.folder / "depth.npz"

    @property
    def config(self) -> Path:
        """Configuration with the camera's calibration and the CAN signals."""
        return self.folder / "config.toml"


def list_scenarios() -> list[tuple[str, str]]:
    """(name, one line) of every scenario."""
    return names()


def simulate(
    name: str, out: Path, *, seed: int = 0, plate: str | None = None, progress: Progress | None = None,
    max_frames: int | None = None,
) -> Made:
    """Renders a scenario into a folder, which is made where it is missing. Raises UsageError."""
    scenario = build(name, seed=seed, plate=plate)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{out}: cannot be made a folder ({error.strerror or error}); name another --out") from None
    count = scenario.frame_count if max_frames is None else min(max_frames, scenario.frame_count)
    truth: list[FrameTruth] = []
    depth = DepthTrack(scenario)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with VideoWriter(out / "video.mp4", scenario.rate_hz, crf=_CRF) as video:
            for frame in range(count):
                video.write(picture(scenario, frame), round(frame / scenario.rate_hz * 1e9))
                truth.append(frame_truth(scenario, frame))
                depth.add(frame)
                if progress is not None:
                    progress(frame + 1, count)
    finally:
        cv2.setNumThreads(threads)
    size_px = scenario.camera.width_px, scenario.camera.height_px
    with writing(out):
        (out / "can.log").write_text("".join(can_lines(scenario)), encoding="ascii")
        write_truth(out, scenario, truth)
        write_track(out / "depth.npz", depth.t_ns, np.array(depth.grids), size_px, MODEL)
        (out / "config.toml").write_text(config_text(scenario), encoding="utf-8")
    return Made(scenario=scenario, folder=out, frame_count=len(truth), truth=tuple(truth))


def can_lines(scenario: Scenario) -> Iterator[str]:
    """candump -L lines; the first at the first frame's time."""
    for t_s, can_id, data in can_frames(scenario):
        yield f"({CAN_EPOCH_S + t_s:.6f}) can0 {can_id:03X}#{data.hex().upper()}\n"


def can_frames(scenario: Scenario) -> Iterator[tuple[float, int, bytes]]:
    """(t_s, id, data) of speed and yaw rate with their sensors' noise."""
    rng = np.random.default_rng((scenario.seed, 5))
    for k in range(math.ceil(scenario.duration_s * CAN_RATE_HZ)):
        t_s = k / CAN_RATE_HZ
        speed_kph = max(scenario.ego.state(t_s)[1] * 3.6 + float(rng.normal(0, 0.02)), 0.0)
        yaw_dps = math.degrees(measured_yaw_radps(scenario, t_s)) + float(rng.normal(0, 0.03))
        raw = min(round(speed_kph / SPEED_SCALE_KPH), 0xFFFE)
        yield t_s, SPEED_ID, raw.to_bytes(2, "big") + bytes([k % 256, 0, 0, 0, 0])
        turn = max(min(round(yaw_dps / YAW_SCALE_DPS), 32766), -32767)
        yield t_s + 0.0004, YAW_ID, turn.to_bytes(2, "big", signed=True) + bytes([k % 256, 0, 0, 0, 0])


def measured_yaw_radps(scenario: Scenario, t_s: float) -> float:
    """What the yaw rate sensor gives, left positive: the truth and its zero offset, or the recorded signal."""
    if scenario.measured_yaw is not None:
        return float(np.interp(t_s, *scenario.measured_yaw))
    return scenario.yaw_rate_radps(t_s) + scenario.yaw_offset_radps


def config_text(scenario: Scenario) -> str:
    """The configuration that fits the simulated camera and CAN bus."""
    c = scenario.camera
    lines = [
        f"# made by: tmde-edge simulate {scenario.name} --seed {scenario.seed}", "[camera]", f"width_px = {c.width_px}",
        f"height_px = {c.height_px}", f"rate_hz = {scenario.rate_hz:.1f}", f"fx_px = {c.fx_px:.6f}", f"fy_px = {c.fy_px:.6f}",
        f"cx_px = {c.cx_px:.3f}", f"cy_px = {c.cy_px:.3f}", f"height_m = {c.height_m:.4f}", f"pitch_rad = {c.pitch_rad:.6f}",
        f"roll_rad = {c.roll_rad:.6f}", f"yaw_rad = {c.yaw_rad:.6f}", f"to_bumper_m = {c.to_bumper_m:.4f}", "", "[plates]",
        "expect = [" + ", ".join(f'"{name}"' for name in scenario.expect) + "]", "", "[depth]",
        '# simulated relative depth: kind = "recorded" plays it', 'path = "depth.npz"', "", "[can.vehicle]",
        f'speed = {{ id = 0x{SPEED_ID:03X}, start_bit = 7, length = 16, byte_order = "big", signed = false, '
        f'scale = {SPEED_SCALE_KPH}, offset = 0.0, unit = "km/h" }}',
        f'yaw_rate = {{ id = 0x{YAW_ID:03X}, start_bit = 7, length = 16, byte_order = "big", signed = true, '
        f'scale = {YAW_SCALE_DPS}, offset = 0.0, unit = "deg/s" }}', "",
    ]
    return "\n".join(lines)


def alert_due(scenario: Scenario, lead: VehicleTruth | None) -> str:
    """"must" once the expected warning is overdue, "may" where one is allowed, else "no"."""
    wanted = scenario.expectation
    if lead is None or lead.ttc_braking_s is None or wanted.no_warning:
        return "no"
    if wanted.warn_ttc_min_s is not None and lead.ttc_braking_s <= wanted.warn_ttc_min_s:
        return "must"
    return "may" if lead.ttc_braking_s <= wanted.warn_ttc_max_s else "no"


def write_truth(out: Path, scenario: Scenario, truth: list[FrameTruth]) -> None:
    """truth.csv (one row a frame, of the lead) and vehicles.csv (one row a vehicle and frame)."""
    with (out / "truth.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(LEAD_COLUMNS)
        for now in truth:
            lead = now.lead
            rows.writerow([
                now.frame, _text(now.t_s), *_cells(lead, "distance_m", "range_rate_mps", "gap_m", "ttc_s", "ttc_braking_s",
                                                   "lateral_m"),
                _text(now.ego_speed_mps), _text(now.yaw_rate_radps), _text(now.pitch_rad), _text(now.roll_rad),
                _text(now.horizon_px), *_corners(lead), *_cells(lead, "char_height_px", "glyph_count", "plate_visible"),
                int(lead is not None), lead.name if lead else "", alert_due(scenario, lead),
            ])
    with (out / "vehicles.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(VEHICLE_COLUMNS)
        for now in truth:
            for v in now.vehicles:
                rows.writerow([
                    v.frame, _text(v.t_s), v.name,
                    *_cells(v, "distance_m", "range_rate_mps", "gap_m", "ttc_s", "ttc_braking_s", "lateral_m", "path_offset_m"),
                    int(v.in_path), _text(v.speed_mps), *_corners(v),
                    *_cells(v, "char_height_px", "glyph_count", "plate_visible"),
                ])


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"


def _cells(vehicle: VehicleTruth | None, *fields: str) -> list[str]:
    values = [None if vehicle is None else getattr(vehicle, field) for field in fields]
    return [str(v) if isinstance(v, int) else _text(v) for v in values]


def _corners(vehicle: VehicleTruth | None) -> list[str]:
    if vehicle is None or vehicle.plate_corners_px is None:
        return [""] * 8
    return [_text(v) for v in vehicle.plate_corners_px]
