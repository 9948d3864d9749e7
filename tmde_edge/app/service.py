"""`tmde-edge run`: builds the live loop from the configuration and runs it until SIGTERM."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from tmde_edge.adapters.cameras.live_camera import LiveCamera
from tmde_edge.adapters.can_ports.bus import CanPort
from tmde_edge.adapters.can_ports.dbc_files import load_vehicle_decoder
from tmde_edge.adapters.can_ports.disabled import DisabledCanPort
from tmde_edge.adapters.can_ports.nmea import NmeaPort
from tmde_edge.adapters.depth.paced import Network
from tmde_edge.adapters.range_port import RangePort
from tmde_edge.app import journal, status
from tmde_edge.app.alert_command import AlertCommand
from tmde_edge.app.background_log import BackgroundLog
from tmde_edge.app.board import BoardWatch, limit_processor, one_heap, raise_priority
from tmde_edge.app.depth_keeper import DepthKeeper
from tmde_edge.app.live import BusPort, LiveLoop
from tmde_edge.app.pose_state import PoseKeeper, load_resting, state_path
from tmde_edge.app.publish import Publisher, socket_path
from tmde_edge.app.recorder import make_recorder
from tmde_edge.app.sdnotify import Notifier
from tmde_edge.app.service_status import Reporter
from tmde_edge.app.shedding import Shedder
from tmde_edge.app.status import StatusServer
from tmde_edge.app.teller import Teller
from tmde_edge.app.wiring import build_camera, build_estimation, build_eyes, check_parts, depth_network, log_config
from tmde_edge.config import Config
from tmde_edge.errors import DeviceError
from tmde_edge.estimation import Estimation
from tmde_edge.messages import DepthReading, Frame, FrameResult, Sighting
from tmde_edge.plates.standard import select
from tmde_edge.ranging.budget import one_line

if TYPE_CHECKING:  # the page's library is loaded only where the page is on
    from tmde_edge.app.view.keeper import PageKeeper

_log = logging.getLogger(__name__)


def serve(
    config: Config,
    base_dir: Path,
    log_line: Callable[[str], None],
    *,
    camera: LiveCamera | None = None,
    depth_network_of: Callable[[Config], Network] = depth_network,
) -> int:
    """Runs the service; returns 0 after SIGTERM, SIGINT or the end of a played file.

    `camera` and `depth_network_of` take the place of the configured ones (tests/benchmarks/faults.py breaks them on purpose).
    """
    journal.set_up()
    one_heap()
    for note in check_parts(config, base_dir):
        log_line(note)
    calibrated = config.camera.camera()
    if calibrated is not None:
        log_line(one_line(calibrated, select(config.plates.expect), config.ranging))
    runtime = config.runtime
    if runtime.cpu_affinity and (failed := limit_processor(runtime.cpu_affinity)) is not None:
        _log.warning("%s", failed)
    eyes = build_eyes(config, time.perf_counter_ns)
    pose_file = state_path(config.pose.state_file, base_dir)
    resting = load_resting(pose_file, config) if pose_file is not None else None
    estimation = build_estimation(config, base_dir, resting)
    with ExitStack() as stack:
        if pose_file is not None:
            keeper = PoseKeeper(pose_file, config, lambda: estimation.resting)
            keeper.start()
            stack.callback(keeper.close)
        board = BoardWatch()
        board.start()
        stack.callback(board.close)
        shedder = Shedder() if runtime.shed else None
        depth = _depth(config, lambda reading: loop.on_depth(reading), shedder, depth_network_of)
        outlet = _outlet(config)
        if outlet is not None:
            stack.callback(outlet.close)
        page = _page(config)
        if page is not None:
            page.start()
            stack.callback(page.close)
        command = None
        if config.alerts.command:
            command = AlertCommand(config.alerts.command, config.alerts.command_timeout_s)
            stack.callback(command.close)
        recorder = make_recorder(config, log_config(config, base_dir, resting))
        log = BackgroundLog(recorder, keep_frames=recorder.keeps_frames) if recorder is not None else None
        teller = Teller()

        def see(frame: Frame) -> Sighting:
            if page is not None:
                page.hub.look(frame)
            eyes.thin_searches(shedder.search_factor if shedder is not None else 1)
            return eyes.see(frame)

        loop = LiveLoop(
            camera or build_camera(config, base_dir),
            see,
            estimation,
            calibration=calibrated,
            notifier=Notifier(),
            log=log,
            outlets=[o for o in (teller, outlet, page.hub if page is not None else None) if o is not None],
            on_alert=command.take if command is not None else None,
            on_frame=depth.submit if depth is not None else None,
            on_result=(Notes(estimation),),
            more_faults=lambda: tuple(name for part in (depth, page) if part is not None for name in part.faults),
            board=lambda: board.state,
            hot_c=runtime.hot_c,
            shedder=shedder,
            on_thread=lambda name: _prioritise(name, runtime.realtime_priority),
            tick_hz=runtime.tick_hz,
        )
        if depth is not None:
            depth.start()
            stack.callback(depth.stop)
        for name in (signal.SIGTERM, signal.SIGINT):
            previous = signal.signal(name, lambda *_: loop.stop())
            stack.callback(signal.signal, name, previous)
        vehicle = config.can.vehicle
        if vehicle.gps_device:
            gps = NmeaPort(vehicle.gps_device, vehicle.gps_baud, loop.on_can, loop.crash)
            gps.start()
            stack.callback(gps.close)
        if config.record.range_device and log is not None:
            rangefinder = RangePort(config.record, log.reference)
            rangefinder.start()
            stack.callback(rangefinder.close)
        bus = _bus(config, base_dir, loop)
        reporter = Reporter(
            config, loop, teller, board=lambda: board.state, depth=depth, recorder=recorder,
            log_waiting=lambda: log.waiting if log is not None else 0,
        )  # fmt: skip
        reporter.bus = bus
        server = StatusServer(status.socket_path(runtime.status_socket), reporter.answer)
        if server.start():
            stack.callback(server.close)
        loop.run(bus)
    return 0


def _prioritise(thread: str, priority: int) -> None:
    """Capture and decisions come before everything else where that is configured."""
    if priority and thread in ("capture", "decision") and (failed := raise_priority(priority)) is not None:
        _log.warning("%s", failed)


def _bus(config: Config, base_dir: Path, loop: LiveLoop) -> BusPort:
    if not config.can.enabled:
        return DisabledCanPort()
    decoder = load_vehicle_decoder(config.can, base_dir)
    return CanPort(config.can, loop.on_can, decoder.filters, loop.crash)


class Notes:
    """Logs what driving shows of the configuration, each thing once while it lasts."""

    def __init__(self, estimation: Estimation) -> None:
        self._estimation = estimation
        self._said: set[str] = set()

    def __call__(self, result: FrameResult) -> None:
        if result.frame_index % 30:
            return
        notes = {note.split(" frames of message ")[-1].split(" (")[0]: note for note in self._estimation.notes}
        for key, note in notes.items():
            if key not in self._said:
                _log.warning("%s", note)
        self._said = set(notes)


def _outlet(config: Config) -> Publisher | None:
    """The socket of the records. One that was asked for by name must work; the default one is a convenience."""
    path = socket_path(config.publish.socket)
    if path is None:
        return None
    try:
        return Publisher(path)
    except DeviceError as error:
        if config.publish.socket != "auto":
            raise
        _log.warning("%s; nobody can look in", error)
        return None


def _page(config: Config) -> PageKeeper | None:
    """The web page where it is wanted."""
    if not config.view.enabled:
        return None
    from tmde_edge.app.view.run import kept_page

    return kept_page(config)


def _depth(
    config: Config,
    on_reading: Callable[[DepthReading], None],
    shedder: Shedder | None,
    network_of: Callable[[Config], Network],
) -> DepthKeeper | None:
    """The depth network on its thread; without it the service runs on, and says once how to get it."""
    if config.depth.kind == "none":
        return None
    if config.depth.kind == "recorded":
        _log.warning('depth.kind = "recorded" is for the desk: depth is off')
        return None
    factor = (lambda: shedder.depth_factor) if shedder is not None else (lambda: 1)
    return DepthKeeper(lambda: network_of(config), rate_hz=config.depth.rate_hz, on_reading=on_reading, factor=factor)
