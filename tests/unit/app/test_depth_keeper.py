"""The depth network is loaded beside the start, and again after it failed; the log tells alerts and faults once."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from tmde_edge.adapters.can_ports.retry import BackOff
from tmde_edge.app import depth_keeper
from tmde_edge.app.depth_keeper import DepthKeeper
from tmde_edge.app.teller import Teller
from tmde_edge.errors import ModelError
from tmde_edge.messages import Alert, AlertLevel, DepthReading, Frame, FrameResult, Pose

S = 1_000_000_000
IMAGE = np.zeros((6, 8, 3), np.uint8)


class Network:
    providers = ("CPUExecutionProvider",)

    def __init__(self) -> None:
        self.act = lambda: None

    def infer(self, frame: Frame, ready_t_ns: int | None = None) -> DepthReading:
        self.act()
        return DepthReading(t_ns=frame.t_ns, ready_t_ns=frame.t_ns, width_px=8, height_px=6, grid_columns=1, grid_rows=1,
                            inverse_depth=(1.0,))  # fmt: skip


def fail() -> None:
    raise RuntimeError("on purpose")


def feed(keeper: DepthKeeper, true: object, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not true():  # type: ignore[operator]
        assert time.monotonic() < end
        keeper.submit(Frame(t_ns=time.monotonic_ns(), index=0, image=IMAGE))
        time.sleep(0.005)


def test_a_crash_is_a_fault_until_readings_come_again() -> None:
    network, got = Network(), []
    keeper = DepthKeeper(lambda: network, rate_hz=100, on_reading=got.append, back_off=BackOff(0.05, 0.1))
    keeper.start()
    try:
        feed(keeper, lambda: got)
        record = keeper.record()
        assert (record["state"], record["providers"], record["restarts"]) == ("works", ["CPUExecutionProvider"], 0)
        network.act = fail
        feed(keeper, lambda: keeper.faults == ("depth_lost",))
        network.act = lambda: None
        feed(keeper, lambda: not keeper.faults)
        assert keeper.restarts >= 1
    finally:
        keeper.stop()


def test_a_network_that_is_not_there_is_tried_again() -> None:
    tries: list[int] = []

    def make() -> Network:
        tries.append(1)
        if len(tries) < 3:
            raise ModelError("not there")
        return Network()

    keeper = DepthKeeper(make, rate_hz=100, on_reading=lambda reading: None, back_off=BackOff(0.02, 0.05))
    keeper.start()
    try:
        feed(keeper, lambda: keeper.readings)
        assert not keeper.faults
    finally:
        keeper.stop()


def test_a_network_that_hangs_is_lost_too() -> None:
    network, release, now = Network(), threading.Event(), [0]
    keeper = DepthKeeper(lambda: network, rate_hz=100, on_reading=lambda reading: None, clock_ns=lambda: now[0])
    network.act = lambda: release.wait(10) and None
    keeper.start()
    try:
        feed(keeper, lambda: keeper._waits_since_ns is not None)
        assert keeper.faults == ()
        now[0] = 11_000_000_000
        assert keeper.faults == ("depth_lost",)
    finally:
        release.set()
        keeper.stop()


def test_a_network_that_hangs_is_loaded_again_but_not_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_keeper, "_LOOK_S", 0.01)
    monkeypatch.setattr(depth_keeper, "_STOP_S", 0.01)
    hangs, release = threading.Event(), threading.Event()
    made: list[Network] = []
    got: list[DepthReading] = []
    now = [0]

    def make() -> Network:
        network = Network()
        network.act = lambda: release.wait(20) and None if hangs.is_set() else None
        made.append(network)
        return network

    keeper = DepthKeeper(make, rate_hz=5, on_reading=got.append, clock_ns=lambda: now[0], back_off=BackOff(0.01, 0.02))

    def drive(until: Callable[[], object]) -> float:
        start_ns, end_s = now[0], time.monotonic() + 20
        while not until():
            assert time.monotonic() < end_s
            now[0] += S
            keeper.submit(Frame(t_ns=now[0], index=0, image=IMAGE))
            time.sleep(0.005)
        return (now[0] - start_ns) / S

    keeper.start()
    try:
        drive(lambda: got)
        hangs.set()
        assert drive(lambda: len(made) == 2) > 10
        assert keeper.faults == ("depth_lost",)
        assert drive(lambda: len(made) == 3) > 120  # it has not answered yet
        drive(lambda: len(keeper._hanging) == 3)
        drive(lambda: now[0] % (300 * S) == 0)
        assert len(made) == 3
        hangs.clear()
        release.set()
        drive(lambda: not keeper.faults)
        assert all(b.t_ns > a.t_ns for a, b in itertools.pairwise(got))  # what the old ones say in the end is not heard
    finally:
        release.set()
        keeper.stop()


def test_a_camera_that_is_away_does_not_make_a_healthy_network_lost() -> None:
    now, got = [0], []
    keeper = DepthKeeper(Network, rate_hz=5, on_reading=got.append, clock_ns=lambda: now[0])
    keeper.start()
    try:
        end_s = time.monotonic() + 10
        while not got:
            assert time.monotonic() < end_s
            keeper.submit(Frame(t_ns=0, index=0, image=IMAGE))
            time.sleep(0.002)
        keeper.submit(Frame(t_ns=33_000_000, index=1, image=IMAGE))  # the last one, and none was due
        now[0] = 11 * S
        assert keeper.faults == ()
    finally:
        keeper.stop()


def test_shed_load_means_fewer_frames() -> None:
    factor = [1]
    network, got = Network(), []
    keeper = DepthKeeper(lambda: network, rate_hz=10, on_reading=got.append, factor=lambda: factor[0])
    keeper.start()
    try:
        feed(keeper, lambda: got)
        counts = []
        for f in (1, 4):
            factor[0] = f
            start = len(got)
            base = time.monotonic_ns()
            for i in range(40):  # four seconds of source time
                keeper.submit(Frame(t_ns=base + i * 100_000_000, index=i, image=IMAGE))
                time.sleep(0.01)
            counts.append(len(got) - start)
        assert counts[0] > 30
        assert 8 <= counts[1] <= 16
    finally:
        keeper.stop()


def result(t_s: float, level: AlertLevel = "none", *faults: str) -> FrameResult:
    loud = level != "none"
    return FrameResult(
        t_ns=round(t_s * 1e9), frame_index=0, plates=(), lead=None, ego=None, pose=Pose(pitch_rad=0.0, roll_rad=0.0), depth=None,
        alert=Alert(level=level, reason="ttc" if loud else "", ttc_s=2.04 if loud else None), faults=faults, mode="strict",
    )  # fmt: skip


def test_changes_are_told_once_with_their_fields(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    teller = Teller(wall_s=lambda: 0.0)
    for i in range(100):  # a fault that flutters, a warning of a second
        teller.take(result(i / 20, "warning" if 20 <= i < 40 else "none", *(("blind",) if i % 10 < 8 else ())))
    for i in range(100, 250):
        teller.take(result(i / 20))
    events = [(r.fields["TMDE_EVENT"], r.getMessage()) for r in caplog.records]  # type: ignore[attr-defined]
    assert events == [
        ("fault", "fault: blind"),
        ("alert", "alert warning, ttc, TTC 2.0 s"),
        ("alert", "alert none"),
        ("fault_over", "no longer: blind"),
    ]
    assert teller.last_alerts == [{"time": "1970-01-01T00:00:00Z", "level": "warning", "reason": "ttc", "ttc_s": 2.04,
                                   "distance_m": None}]  # fmt: skip


def test_a_camera_that_never_came_is_told(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    teller = Teller()
    for t_s in range(10):  # the service speaks, and nothing is ever decided
        teller.service({"t": t_s, "faults": ["camera_lost", *(["blind"] if t_s > 5 else [])]})
    for i in range(150):
        teller.frame(result(10 + i / 20), None)
        teller.service({"t": 10 + i / 20, "faults": ["blind"]})  # by now the results tell
    told = [r.getMessage() for r in caplog.records]
    assert told == ["fault: camera_lost", "fault: blind", "no longer: camera_lost", "no longer: blind"]


def test_the_first_moments_without_a_picture_are_no_fault(caplog: pytest.LogCaptureFixture) -> None:
    teller = Teller()
    teller.take(result(0.0, "none", "camera_lost"))
    teller.take(result(0.1, "none", "camera_lost"))
    teller.take(result(0.2))
    assert not caplog.records
