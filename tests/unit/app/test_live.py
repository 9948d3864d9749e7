"""The live loop: order, silence, overload, signs of life, and an end within a second."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tmde_edge.adapters.cameras.disabled import DisabledCamera
from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.adapters.cameras.played_file import PlayedFile
from tmde_edge.app import background_log, live
from tmde_edge.app.background_log import BackgroundLog
from tmde_edge.app.board import BoardState
from tmde_edge.app.live import LiveLoop
from tmde_edge.app.sdnotify import Notifier
from tmde_edge.app.service_status import Reporter
from tmde_edge.app.shedding import Shedder
from tmde_edge.app.teller import Teller
from tmde_edge.app.wiring import build_estimation
from tmde_edge.config import load
from tmde_edge.errors import ConfigError
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Alert, CanFrame, Event, Frame, FrameResult, Output, Pose, RangeReference, Sighting, Tick

FRAMES = 12
RATE_HZ = 40.0


class Bus:
    """A CAN port that keeps what is sent."""

    faults: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.sent: list[CanFrame] = []
        self.started = self.closed = False

    def start(self) -> None:
        self.started = True

    def send(self, frame: CanFrame) -> None:
        self.sent.append(frame)

    def close(self) -> None:
        self.closed = True


class Echo:
    """An estimation that notes its events and answers each sighting with one CAN frame."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def step(self, event: Event) -> tuple[Output, ...]:
        self.events.append(event)
        if isinstance(event, Sighting):
            return (CanFrame(t_ns=event.t_ns, can_id=0x700, data=bytes([event.frame_index])),)
        return ()

    def of(self, kind: type[Any]) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]


def see(frame: Frame) -> Sighting:
    return Sighting(t_ns=frame.t_ns, frame_index=frame.index, width_px=8, height_px=8, status="no_plate")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in range(FRAMES):
        cv2.imwrite(str(folder / f"{i:02d}.png"), np.full((8, 8), 10 * i, np.uint8))
    return folder


def play(folder: Path, *, loop: bool = False) -> PlayedFile:
    return PlayedFile(str(folder), fps=RATE_HZ, loop=loop)


def test_a_recording_is_decided_frame_by_frame_and_the_service_ends_with_it(recording: Path) -> None:
    estimation, bus = Echo(), Bus()
    start_ns = time.monotonic_ns()
    LiveLoop(play(recording), see, estimation).run(bus)
    sightings = estimation.of(Sighting)
    assert sightings[-1].t_ns - start_ns == pytest.approx((FRAMES - 1) / RATE_HZ * 1e9, abs=0.2e9)
    assert [s.frame_index for s in sightings] == list(range(len(sightings)))
    assert [frame.data[0] for frame in bus.sent] == [s.frame_index for s in sightings]
    assert bus.started
    assert bus.closed


def test_slow_eyes_get_the_newest_frame_and_the_rest_is_counted(recording: Path) -> None:
    ages_ns: list[int] = []

    def slow(frame: Frame) -> Sighting:
        ages_ns.append(time.monotonic_ns() - frame.t_ns)
        time.sleep(0.08)
        return see(frame)

    loop = LiveLoop(play(recording), slow, Echo())
    loop.run(Bus())
    assert loop.counters.skipped + loop.counters.sightings + loop.camera.counters.lost == FRAMES  # lost: a busy machine
    assert loop.counters.skipped + loop.camera.counters.lost >= 4
    assert np.median(ages_ns) < 0.25e9  # one after the other they would wait for 0.35 s


def stopped_after(loop: LiveLoop, seconds: float, bus: Bus | None = None) -> float:
    """Runs a loop, stops it after a while; returns how long the stop took."""
    stopped_at: list[float] = []

    def stop() -> None:
        stopped_at.append(time.monotonic())
        loop.stop()

    timer = threading.Timer(seconds, stop)
    timer.start()
    try:
        loop.run(bus or Bus())
    finally:
        timer.cancel()
    return time.monotonic() - stopped_at[0]


def test_without_a_camera_time_still_passes_and_the_stop_is_quick() -> None:
    estimation = Echo()
    took_s = stopped_after(LiveLoop(DisabledCamera(), see, estimation, tick_hz=20), 0.6)
    ticks = estimation.of(Tick)
    assert took_s < 1.0
    assert 4 <= len(ticks) <= 14
    assert {tick.faults for tick in ticks} == {("camera_lost",)}
    assert all(b.t_ns > a.t_ns for a, b in itertools.pairwise(ticks))


def test_can_frames_and_sightings_are_decided_on_one_thread_in_order(recording: Path) -> None:
    threads: set[int] = set()

    class Watching(Echo):
        def step(self, event: Event) -> tuple[Output, ...]:
            threads.add(threading.get_ident())
            return super().step(event)

    estimation = Watching()
    loop = LiveLoop(play(recording), see, estimation)
    stop = threading.Event()

    def receive() -> None:
        number = 0
        while not stop.wait(0.005):
            loop.on_can(CanFrame(t_ns=time.monotonic_ns(), can_id=1, data=number.to_bytes(2, "big")))
            number += 1

    receiver = threading.Thread(target=receive)
    receiver.start()
    try:
        loop.run(Bus())
    finally:
        stop.set()
        receiver.join()
    numbers = [int.from_bytes(frame.data, "big") for frame in estimation.of(CanFrame)]
    assert len(numbers) > 10
    assert numbers == list(range(len(numbers)))
    assert threads == {threading.get_ident()}


def test_an_unknown_error_of_a_thread_stops_the_service(recording: Path) -> None:
    def broken(frame: Frame) -> Sighting:
        raise ZeroDivisionError("in the eyes")

    bus = Bus()
    with pytest.raises(ZeroDivisionError, match="in the eyes"):
        LiveLoop(play(recording, loop=True), broken, Echo()).run(bus)
    assert bus.closed


def test_a_flood_is_bounded_and_told(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "INBOX_EVENTS", 50)
    estimation = Echo()
    loop = LiveLoop(play(recording), see, estimation)
    for number in range(200):
        loop.on_can(CanFrame(t_ns=number, can_id=1, data=b""))
    loop.run(Bus())
    assert loop.counters.inbox_dropped >= 150
    assert any("overload" in tick.faults for tick in estimation.of(Tick))
    assert estimation.of(Sighting)


def test_faults_of_the_bus_reach_the_estimation(recording: Path) -> None:
    bus, estimation = Bus(), Echo()
    bus.faults = ("can_tx",)
    LiveLoop(play(recording), see, estimation).run(bus)
    assert estimation.of(Tick)[-1].faults == ("can_tx",)


class Systemd:
    """The other end of the notification socket, with a watchdog of 0.2 s."""

    def __init__(self, folder: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(folder / "notify"))
        self.lines: list[str] = []
        self.notifier = Notifier({"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "200000"})
        threading.Thread(target=self._receive, daemon=True).start()

    def _receive(self) -> None:  # the kernel keeps only some ten datagrams
        while True:
            self.lines.append(self._socket.recv(1000).decode())

    def until(self, line: str) -> list[str]:
        """What was heard up to that line."""
        deadline = time.monotonic() + 5
        while line not in self.lines and time.monotonic() < deadline:
            time.sleep(0.01)
        return self.lines[: self.lines.index(line) + 1]


def test_systemd_hears_ready_signs_of_life_status_and_the_end(recording: Path, tmp_path: Path) -> None:
    systemd = Systemd(tmp_path)
    LiveLoop(play(recording), see, Echo(), notifier=systemd.notifier).run(Bus())
    lines = systemd.until("STOPPING=1")
    assert lines[:2] == ["STATUS=running; waiting for the camera", "READY=1"]
    assert 1 <= lines.count("WATCHDOG=1") <= 8  # 0.3 s of frames, fed each 0.05 s at most


def test_the_watchdog_is_fed_while_the_camera_is_known_to_be_dead(tmp_path: Path) -> None:
    systemd = Systemd(tmp_path)
    stopped_after(LiveLoop(DisabledCamera(), see, Echo(), notifier=systemd.notifier), 0.5)
    assert systemd.until("STOPPING=1").count("WATCHDOG=1") >= 3


def test_the_watchdog_starves_when_the_eyes_hang_although_ticks_go_on(recording: Path, tmp_path: Path) -> None:
    systemd = Systemd(tmp_path)
    hang = threading.Event()

    def hanging(frame: Frame) -> Sighting:
        if frame.index >= 3:
            hang.wait(5)
        return see(frame)

    estimation = Echo()
    loop = LiveLoop(play(recording, loop=True), hanging, estimation, notifier=systemd.notifier)
    threading.Timer(0.5, systemd.lines.clear).start()  # what came before is not of interest
    threading.Timer(1.1, hang.set).start()
    threading.Timer(1.0, loop.stop).start()
    loop.run(Bus())
    assert "WATCHDOG=1" not in systemd.until("STOPPING=1")
    assert len(estimation.of(Tick)) > 6


def test_frames_that_cannot_be_decoded_never_reach_the_eyes() -> None:
    class Garbled:
        name = "garbled"
        ended = False
        count = 0

        def open(self) -> None:
            pass

        def read(self, timeout_s: float) -> Captured:
            time.sleep(0.01)
            self.count += 1
            good = self.count % 2 == 0
            return Captured(
                t_ns=time.monotonic_ns(), index=self.count, decode=lambda: np.zeros((2, 2), np.uint8) if good else None
            )

        def close(self) -> None:
            pass

    estimation = Echo()
    loop = LiveLoop(Garbled(), see, estimation)
    stopped_after(loop, 0.4)
    assert loop.camera.counters.garbled >= 3
    assert len(estimation.of(Sighting)) >= 3
    assert loop.camera.fault is None


CALIBRATION = Camera(width_px=16, height_px=9, fx_px=12.0, fy_px=12.0, cx_px=7.5, cy_px=4.0)


def test_pictures_that_do_not_fit_the_calibration_are_a_wrong_configuration(
    recording: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(ConfigError, match="image 8x8 does not fit the calibration 16x9"):
        LiveLoop(play(recording), see, Echo(), calibration=CALIBRATION).run(Bus())
    assert "Traceback" not in caplog.text


def test_a_single_picture_of_another_size_is_a_broken_one(recording: Path) -> None:
    cv2.imwrite(str(recording / "05.png"), np.zeros((9, 16), np.uint8))
    fits = replace(CALIBRATION, width_px=8, height_px=8)
    loop = LiveLoop(play(recording), see, Echo(), calibration=fits)
    loop.run(Bus())
    assert loop.camera.counters.garbled == 1
    assert loop.counters.sightings > FRAMES / 2


class Sink:
    """A recorder that keeps, blocks or fails."""

    problem: str | None = None

    def __init__(self, act: Callable[[], object] = lambda: None) -> None:
        self.steps: list[tuple[Event, tuple[Output, ...], Frame | None]] = []
        self.act = act
        self.holes = 0
        self.closed = False

    def write(self, event: Event, outputs: tuple[Output, ...], frame: Frame | None = None) -> None:
        self.act()
        self.steps.append((event, outputs, frame))

    def reference(self, reference: RangeReference) -> None:
        pass

    def lost(self) -> None:
        self.holes += 1

    def idle(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("keep_frames", [False, True])
def test_every_step_is_recorded_in_order(recording: Path, keep_frames: bool) -> None:
    estimation, sink = Echo(), Sink()
    LiveLoop(play(recording), see, estimation, log=BackgroundLog(sink, keep_frames=keep_frames)).run(Bus())
    assert [event for event, _, _ in sink.steps] == estimation.events
    assert any(frame is not None for _, _, frame in sink.steps) == keep_frames
    assert sink.closed


def test_a_disk_that_fails_is_a_fault_and_nothing_else(recording: Path) -> None:
    estimation, sink = Echo(), Sink()
    sink.problem = "No space left on device"
    loop = LiveLoop(play(recording), see, estimation, log=BackgroundLog(sink))
    loop.run(Bus())
    assert loop.counters.sightings >= FRAMES // 2  # the machine may be busy
    assert "disk" in estimation.of(Tick)[-1].faults


def test_a_recorder_that_crashes_stops_nobody(recording: Path) -> None:
    def crash() -> None:
        raise ZeroDivisionError

    estimation = Echo()
    log = BackgroundLog(Sink(crash))
    LiveLoop(play(recording), see, estimation, log=log).run(Bus())
    assert "disk" in estimation.of(Tick)[-1].faults
    assert log.problem == "the recorder has crashed"


def test_a_disk_that_hangs_delays_no_decision_and_leaves_one_known_hole(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background_log, "_STEPS", 5)
    release = threading.Event()
    sink = Sink(lambda: release.wait(5))
    log = BackgroundLog(sink)
    start = time.monotonic()
    threading.Timer(0.25, release.set).start()
    estimation = Echo()
    loop = LiveLoop(play(recording), see, estimation, log=log)
    loop.run(Bus())
    assert loop.counters.sightings >= FRAMES // 2  # the machine may be busy
    assert any("disk" in tick.faults for tick in estimation.of(Tick))
    assert log.dropped > 0
    assert sink.holes == 1  # a hole that nobody knows of would spoil a replay
    assert log.problem is None
    assert time.monotonic() - start < 3


def test_a_hot_board_is_told_with_its_temperature_and_less_is_done(recording: Path) -> None:
    estimation = Echo()
    state = BoardState(temperature_c=85.0)
    shedder = Shedder()
    loop = LiveLoop(play(recording), see, estimation, board=lambda: state, hot_c=80.0, shedder=shedder)
    loop._status_ns = time.monotonic_ns() - 10**9  # the pulse is taken with the first decision
    loop.run(Bus())
    last = estimation.of(Tick)[-1]
    assert last.temperature_c == 85.0
    assert {"hot", "overload"} <= set(last.faults)
    assert shedder.level == 1


def test_shed_frames_are_counted_apart(recording: Path) -> None:
    shedder = Shedder()
    shedder.level = 3
    loop = LiveLoop(play(recording), see, Echo(), shedder=shedder)
    loop.run(Bus())
    c = loop.counters
    assert 4 <= c.shed + c.sightings + c.skipped <= FRAMES  # a late player skips frames of its own
    assert abs(c.shed - c.sightings) <= 1


def test_every_thread_is_announced(recording: Path) -> None:
    names: dict[str, int] = {}
    LiveLoop(play(recording), see, Echo(), on_thread=lambda n: names.setdefault(n, threading.get_ident()) and None).run(Bus())
    assert set(names) == {"decision", "capture", "perception"}
    assert len(set(names.values())) == 3
    assert names["decision"] == threading.get_ident()


class Deciding(Echo):
    """An estimation that gives a result for each sighting: a warning from frame 4 on."""

    def step(self, event: Event) -> tuple[Output, ...]:
        out = super().step(event)
        if not isinstance(event, Sighting):
            return out
        alert = Alert(level="warning", reason="ttc", ttc_s=2.0) if event.frame_index >= 4 else Alert()
        result = FrameResult(
            t_ns=event.t_ns, frame_index=event.frame_index, plates=(), lead=None, ego=None,
            pose=Pose(pitch_rad=0.0, roll_rad=0.0),
            depth=None, alert=alert, faults=(), mode="strict",
        )  # fmt: skip
        return (result, *out)


class Outlet:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.frames: list[int] = []
        self.blind = 0
        self.services: list[dict[str, Any]] = []

    def frame(self, result: FrameResult, sighting: Sighting | None) -> None:
        assert sighting is None or result.t_ns == sighting.t_ns
        self.blind += sighting is None
        self.frames.append(result.frame_index)

    def service(self, values: dict[str, Any]) -> None:
        self.services.append(values)


def test_every_result_is_published_and_every_alert_told(recording: Path) -> None:
    outlet, alerts = Outlet(), []
    loop = LiveLoop(play(recording), see, Deciding(), outlets=[outlet], on_alert=alerts.append)
    loop.run(Bus())
    assert outlet.frames == list(range(loop.counters.sightings))
    assert [a.level for a in alerts[:5]] == ["none"] * 4 + ["warning"]
    assert outlet.services
    assert {"sightings", "skipped", "status", "faults"} <= outlet.services[0].keys()


def test_that_no_frames_come_any_more_is_published(recording: Path) -> None:
    class Gone(PlayedFile):
        reads = 0

        def read(self, timeout_s: float) -> Captured | None:
            if self.reads == 3:
                time.sleep(timeout_s)
                return None
            self.reads += 1
            return super().read(timeout_s)

    outlet = Outlet()
    estimation = build_estimation(load(None, ["can.enabled=false"]), recording)
    stopped_after(LiveLoop(Gone(str(recording), fps=RATE_HZ), see, estimation, outlets=[outlet]), 1.2)
    assert outlet.blind >= 4


def test_a_camera_that_never_came_is_a_fault_after_a_while() -> None:
    now_ns = [0]
    loop = LiveLoop(DisabledCamera(), see, Echo(), monotonic_ns=lambda: now_ns[0])
    reporter = Reporter(load(None, []), loop, Teller(), board=BoardState, monotonic_ns=lambda: now_ns[0])
    assert reporter.status()["state"] == "init"
    now_ns[0] = 6_000_000_000
    told = reporter.status()
    assert (told["state"], told["faults"]) == ("fault", ["camera_lost", "blind"])


def test_status_in_words(recording: Path) -> None:
    loop = LiveLoop(play(recording), see, Echo())
    loop.run(Bus())
    text = loop.status_text(time.monotonic_ns())
    rate = float(text.split(" frames/s")[0])
    assert RATE_HZ / 2 < rate < RATE_HZ * 1.3
    assert text.endswith("no faults")
