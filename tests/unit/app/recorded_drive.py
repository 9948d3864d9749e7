"""A drive made of results, twenty a second, given to the recorder; speed and alert as functions of time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from msgspec.structs import replace

from tmde_edge.app.recorder import Recorder
from tmde_edge.app.wiring import log_config
from tmde_edge.config import RecordConfig, load
from tmde_edge.messages import Alert, AlertLevel, CanFrame, EgoState, Frame, FrameResult, LeadEstimate, Pose, Sighting

S = 1_000_000_000
RATE_HZ = 20
IMAGE = np.tile(np.arange(64, dtype=np.uint8) * 3, (48, 1))


class Drive:
    """Twenty results a second; speed and alert as functions of time."""

    def __init__(self, folder: Path, *, transmits: bool = False, **changes: object) -> None:
        self.now_ns = 100 * S
        record = replace(RecordConfig(folder=str(folder), min_free_mb=0), **changes)
        config = load(None, ["camera.fx_px=800"])
        self.recorder = Recorder(
            record, log_config(replace(config, record=record), Path()), transmits=transmits,
            monotonic_ns=lambda: self.now_ns, wall_ns=lambda: 1_700_000_000 * S + self.now_ns,
        )  # fmt: skip
        self.index = 0

    def step(self, level: AlertLevel = "none", speed_mps: float | None = 10.0) -> None:
        self.now_ns += S // RATE_HZ
        self.index += 1
        t_ns = self.now_ns
        seen = Sighting(t_ns=t_ns, frame_index=self.index, width_px=64, height_px=48, status="ok")
        ego = EgoState(t_ns=t_ns, speed_mps=speed_mps, yaw_rate_radps=0.0) if speed_mps is not None else None
        lead = LeadEstimate(
            track_id=1, distance_m=12.0, sigma_m=0.2, range_rate_mps=-4.0, range_rate_sigma_mps=0.1, ttc_s=3.0, ttc_sigma_s=0.1,
            headway_s=1.0, coasting_s=0.0, source="plate",
        )  # fmt: skip
        alert = Alert(level=level, reason="ttc" if level != "none" else "", ttc_s=2.0 if level != "none" else None)
        result = FrameResult(
            t_ns=t_ns, frame_index=self.index, plates=(), lead=lead, ego=ego, pose=Pose(pitch_rad=0.0, roll_rad=0.0), depth=None,
            alert=alert, faults=(), mode="strict",
        )  # fmt: skip
        self.recorder.write(CanFrame(t_ns=t_ns - 1, can_id=0xB4, data=b"\x01\x02"), ())
        self.recorder.write(seen, (result,), Frame(t_ns=t_ns, index=self.index, image=IMAGE))

    def run(self, seconds: float, level: AlertLevel = "none", speed_mps: float | None = 10.0, slope: float = 0.0) -> None:
        for i in range(round(seconds * RATE_HZ)):
            self.step(level, None if speed_mps is None else max(speed_mps + slope * i / RATE_HZ, 0.0))
