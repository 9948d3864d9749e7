"""`tmde-edge run`: builds the live loop from the configuration and runs it until SIGTERM."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import datetime, timezone
from pathlib import Path

from tmde_edge.adapters.can_ports.bus import CanPort
from tmde_edge.adapters.can_ports.dbc_files import load_vehicle_decoder
from tmde_edge.adapters.can_ports.disabled import DisabledCanPort
from tmde_edge.adapters.can_ports.nmea import NmeaPort
from tmde_edge.adapters.depth.threaded import ThreadedDepth
from tmde_edge.app.alert_command import AlertCommand
from tmde_edge.app.background_log import BackgroundLog
from tmde_edge.app.drive_log import DriveLogWriter, JpegSettings
from tmde_edge.app.live import BusPort, LiveLoop
from tmde_edge.app.publish import Publisher, socket_path
from tmde_edge.app.sdnotify import Notifier
from tmde_edge.app.wiring import build_camera, build_estimation, build_eyes, check_parts, depth_network, log_config
from tmde_edge.config import Config
from tmde_edge.errors import DeviceError, ModelError
from tmde_edge.messages import CanFrame
from tmde_edge.plates.standard import select
from tmde_edge.ranging.budget import one_line

_log = logging.getLogger(__name__)


class _Silent:
    """A bus that is listened to only: what would be sent is counted, not sent."""

    def __init__(self, port: BusPort) -> None:
        self._port = port
        self.withheld = 0

    @property
    def faults(self) -> tuple[str, ...]:
        return self._port.faults

    def start(self) -> None:
        self._port.start()

    def send(self, frame: CanFrame) -> None:
        self.withheld += 1

    def close(self) -> None:
        self._port.close()


def serve(config: Config, base_dir: Path, log_line: Callable[[str], None]) -> int:
    """Runs the service; returns 0 after SIGTERM, SIGINT or the end of a played file."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    for note in check_parts(config, base_dir):
        log_line(note)
    camera = config.camera.camera()
    if camera is not None:
        log_line(one_line(camera, select(config.plates.expect), config.ranging))
    eyes = build_eyes(config, time.perf_counter_ns)
    estimation = build_estimation(config, base_dir)
    with ExitStack() as stack:
        depth = _depth(config, lambda: loop)
        outlet = _outlet(config)
        if outlet is not None:
            stack.callback(outlet.close)
        command = None
        if config.alerts.command:
            command = AlertCommand(config.alerts.command, config.alerts.command_timeout_s)
            stack.callback(command.close)
        loop = LiveLoop(
            build_camera(config, base_dir),
            eyes.see,
            estimation,
            notifier=Notifier(),
            log=_drive_log(config, base_dir),
            outlet=outlet,
            on_alert=command.take if command is not None else None,
            on_frame=depth.submit if depth is not None else None,
            tick_hz=config.runtime.tick_hz,
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
        loop.run(_bus(config, base_dir, loop))
    return 0


def _bus(config: Config, base_dir: Path, loop: LiveLoop) -> BusPort:
    if not config.can.enabled:
        return DisabledCanPort()
    decoder = load_vehicle_decoder(config.can, base_dir)
    port = CanPort(config.can, loop.on_can, decoder.filters, loop.crash)
    return port if config.can.transmit else _Silent(port)


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


def _depth(config: Config, loop: Callable[[], LiveLoop]) -> ThreadedDepth | None:
    """The depth network on its thread; without it the service runs on, and says once how to get it."""
    if config.depth.kind == "none":
        return None
    if config.depth.kind == "recorded":
        _log.warning('depth.kind = "recorded" is for the desk: depth is off')
        return None
    try:
        network = depth_network(config)
    except ModelError as error:
        _log.warning("depth is off: %s", error)
        return None
    return ThreadedDepth(
        network,
        rate_hz=config.depth.rate_hz,
        clock_ns=time.monotonic_ns,
        on_reading=lambda reading: loop().on_depth(reading),
        on_failure=lambda error: _log.error("depth stopped: %s", error),
    )


def _drive_log(config: Config, base_dir: Path) -> BackgroundLog | None:
    r = config.record
    if not r.enabled:
        return None
    folder = Path(r.folder)
    name = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        kept = log_config(config, base_dir)
        writer = DriveLogWriter(folder / f"{name}.mcap", kept, jpeg=JpegSettings() if r.frames else None)
    except OSError as error:
        raise DeviceError(f"record.folder {folder}: cannot be written ({error.strerror or error}); choose another one") from None
    return BackgroundLog(writer, keep_frames=r.frames)
