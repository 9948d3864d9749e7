"""`tmde-edge view`: the page for a recording, for the camera, or for the service that runs already."""

from __future__ import annotations

import json
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from tmde_edge.adapters.cameras.sources import open_source
from tmde_edge.adapters.can_ports.bus import CanPort
from tmde_edge.adapters.can_ports.dbc_files import load_vehicle_decoder
from tmde_edge.adapters.can_ports.disabled import DisabledCanPort
from tmde_edge.adapters.can_ports.log_files import iter_can_log
from tmde_edge.app.can_times import CanTimeline
from tmde_edge.app.dry_run import Step, dry_run
from tmde_edge.app.live import BusPort, LiveLoop
from tmde_edge.app.publish import socket_path
from tmde_edge.app.status import NOT_OURS
from tmde_edge.app.view.hub import Hub
from tmde_edge.app.view.keeper import PageKeeper
from tmde_edge.app.view.server import ViewServer
from tmde_edge.app.wiring import build_camera, build_depth, build_estimation, build_eyes, threads
from tmde_edge.config import Config
from tmde_edge.errors import InputMissingError

RETRY_S = 1.0


def build_hub(config: Config) -> Hub:
    """The hub as configured."""
    v = config.view
    return Hub(config.camera.camera(), config.camera.height_m, rate_hz=v.rate_hz, width_px=v.width_px, quality=v.quality)


def build_page(config: Config, title: str, hub: Hub | None = None) -> tuple[Hub, ViewServer]:
    """Hub and server as configured, listening but not yet started. Raises DeviceError."""
    hub, v, a = hub or build_hub(config), config.view, config.alerts
    limits = {"caution": a.caution_ttc_s, "warning": a.warning_ttc_s}
    return hub, ViewServer(hub, v.host, v.port, v.token, title=title, limits=limits)


def kept_page(config: Config) -> PageKeeper:
    """The service's page: what cannot listen now is tried again."""
    hub = build_hub(config)
    return PageKeeper(hub, lambda: build_page(config, config.camera.device, hub)[1])


def view_recording(
    config: Config, base_dir: Path, source: str, fps: float, can_log: Path | None, can_offset_s: float, say: Callable[[str], None]
) -> int:
    """The page over a recording as the desk sees it, again and again; slower than real time where the machine is."""
    stop = _until_signal()
    recording = open_source(source, fps, threads=threads(config))
    if can_log is None:
        config = msgspec.structs.replace(config, can=msgspec.structs.replace(config.can, enabled=False))
    eyes = build_eyes(config, time.perf_counter_ns)
    hub, server = build_page(config, Path(source).name)
    with _served(hub, server, say):
        while not stop.is_set():
            can = CanTimeline(iter_can_log(can_log), can_offset_s) if can_log is not None else None
            steps = dry_run(
                recording, eyes, build_estimation(config, base_dir), camera=config.camera.camera(), can=can,
                depth=build_depth(config, base_dir), tick_hz=config.runtime.tick_hz,
            )  # fmt: skip
            _play(steps, hub, stop)
    return 0


def _play(steps: Iterable[Step], hub: Hub, stop: threading.Event) -> None:
    """Shows every frame when its time has come; one that comes late delays all that follow."""
    start_s: float | None = None
    for step in steps:
        now_s = time.monotonic()
        t_s = step.record["t"]
        if start_s is None or now_s > start_s + t_s:
            start_s = now_s - t_s
        if stop.wait(start_s + t_s - now_s):
            return
        if step.frame is not None and step.result is not None and step.sighting is not None:
            hub.look(step.frame)
            hub.frame(step.result, step.sighting)


def view_camera(config: Config, base_dir: Path, say: Callable[[str], None]) -> int:
    """The page over the configured camera and bus; nothing is ever sent."""
    can = msgspec.structs.replace(config.can, transmit=False)
    config = msgspec.structs.replace(config, can=can)
    hub, server = build_page(config, config.camera.device)
    loop = LiveLoop(
        build_camera(config, base_dir), build_eyes(config, time.perf_counter_ns).see, build_estimation(config, base_dir),
        calibration=config.camera.camera(), outlets=(hub,), on_frame=hub.look, tick_hz=config.runtime.tick_hz,
    )  # fmt: skip
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: loop.stop())
    bus: BusPort = DisabledCanPort()
    if can.enabled:
        bus = CanPort(can, loop.on_can, load_vehicle_decoder(can, base_dir).filters, loop.crash)
    with _served(hub, server, say):
        loop.run(bus)
    return 0


def view_service(config: Config, say: Callable[[str], None]) -> int:
    """The page over a running service's records: numbers and charts; its picture only it can serve (view.enabled)."""
    path = socket_path(config.publish.socket)
    if path is None or not path.is_socket():
        raise InputMissingError(
            f"{path or 'records.sock'}: no service publishes its records there; name a recording (`tmde-edge view drive.mp4`) "
            "or a configuration with a camera (`-c FILE`)"
        )
    stop = _until_signal()
    hub, server = build_page(config, f"service at {path}")
    say("for the live picture set view.enabled = true in the service's configuration")
    with _served(hub, server, say):
        while not stop.is_set():
            for record in _records(path, stop):
                if "service" in record:
                    hub.service(record["service"])
                elif "error" not in record:
                    hub.record(record)
            stop.wait(RETRY_S)
    return 0


def _records(path: Path, stop: threading.Event) -> Iterator[dict[str, Any]]:
    """JSON lines of a unix socket until it ends. Raises InputMissingError where it is not ours to read."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as s:
        try:
            s.connect(str(path))
            s.settimeout(0.5)
        except PermissionError:
            raise InputMissingError(NOT_OURS.format(path)) from None
        except OSError:
            return
        waiting = b""
        while not stop.is_set():
            try:
                got = s.recv(65536)
            except TimeoutError:
                continue
            except OSError:
                return
            if not got:
                return
            *lines, waiting = (waiting + got).split(b"\n")
            for line in lines:
                yield json.loads(line)


@contextmanager
def _served(hub: Hub, server: ViewServer, say: Callable[[str], None]) -> Iterator[None]:
    hub.start()
    server.start()
    say(f"open {server.url} (Ctrl-C ends it)")
    try:
        yield
    finally:
        server.close()


def _until_signal() -> threading.Event:
    stop = threading.Event()
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: stop.set())
    return stop
