"""The doctor's hands: tries the camera, the bus and the networks for a moment."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tmde_edge.adapters.cameras.live_camera import LiveCamera
from tmde_edge.adapters.cameras.v4l2 import RAW_BAYER, NodeInfo, describe
from tmde_edge.adapters.can_ports.bus import CanPort
from tmde_edge.adapters.can_ports.dbc_files import load_vehicle_decoder
from tmde_edge.canbus.ego_rx import EgoReceiver
from tmde_edge.config import Config
from tmde_edge.errors import ConfigError, DeviceError, ModelError
from tmde_edge.messages import CanFrame

if TYPE_CHECKING:
    from tmde_edge.app.doctor import Check, Surroundings

_NOT_OPEN = "check adapter and permissions; does another program hold it?"
GRAB_S, LISTEN_S = 2.5, 2.0
SLOW = 0.9  # of the wanted rate
LATE_S = 0.15  # shutter to user space
_SHARED = ("socketcan", "udp_multicast")  # many programs may listen; a serial adapter has one channel
_DARK, _BRIGHT = 8.0, 247.0  # mean grey of a picture that shows nothing


def check_camera(config: Config, s: Surroundings, base_dir: Path) -> Iterator[Check]:
    """Formats, locks, grabbed frames, rate and latency."""
    from tmde_edge.app.doctor import Check
    from tmde_edge.app.wiring import build_camera

    c = config.camera
    if c.kind == "disabled":
        yield Check("camera", "fail", 'camera.kind = "disabled"', 'set camera.kind = "v4l2" and camera.device')
        return
    status = s.status()
    if status is not None:  # the service holds it
        yield _of_service(status)
        return
    if c.kind == "v4l2":
        try:
            info = describe(c.device)
        except DeviceError as error:
            others = ", ".join(sorted(f"/dev/{p.name}" for p in (s.root / "sys/class/video4linux").glob("video*")))
            fix = f"set camera.device; there are {others}" if others else "plug it in; `ls /dev/video*` shows nothing"
            yield Check("camera", "fail", str(error), fix)
            return
        bad = [check for check in judge_node(info, c.device, c.focus) if check.state != "ok"]
        yield from bad
        if any(check.state == "fail" for check in bad):
            return
    try:
        camera = build_camera(config, base_dir)
        yield grab(camera, c.rate_hz)
    except (DeviceError, ConfigError) as error:
        yield Check("camera", "fail", str(error), "")


def judge_node(info: NodeInfo, device: str, focus: float | None) -> Iterator[Check]:
    """A capture node from what it says: raw sensors, focus and exposure locks."""
    from tmde_edge.app.doctor import Check

    raw = [f for f in info.formats if f in RAW_BAYER or f.rstrip("0123456789PC") in ("RG", "BG", "GB", "GR")]
    if raw and len(raw) == len(info.formats):
        yield Check(
            "camera", "fail", f"{device} ({info.card}) is a raw Bayer sensor ({' '.join(raw[:4])}): no picture without libcamera",
            'on a Raspberry Pi: sudo apt install python3-picamera2, camera.kind = "picamera2"; on a Jetson: '
            'camera.kind = "gstreamer" with nvarguscamerasrc',
        )  # fmt: skip
        return
    if not info.captures or not info.formats:
        yield Check("camera", "fail", f"{device} ({info.card}) is no capture node", "set camera.device to another /dev/video*")
        return
    if info.autofocus:
        yield Check(
            "camera focus", "warn", f"{info.card}: the focus is automatic, and a refocusing lens changes the focal length",
            "set camera.focus (the driver's units) so that far things are sharp, then calibrate",
        )  # fmt: skip
    elif info.autofocus is None and focus is not None:
        yield Check("camera focus", "warn", f"{info.card} has no focus control", "remove camera.focus")
    yield Check("camera", "ok", f"{device} {info.card} ({info.driver}): {' '.join(info.formats)}")


def grab(camera: LiveCamera, rate_hz: float, seconds: float = GRAB_S) -> Check:
    """Takes frames for a moment: measured rate, latency, and whether they show something. Raises DeviceError."""
    from tmde_edge.app.doctor import Check

    camera.open()
    try:
        times: list[int] = []
        late_s: list[float] = []
        prints: set[int] = set()
        image = None
        end = time.monotonic() + seconds
        while time.monotonic() < end and not camera.ended:
            captured = camera.read(0.5)
            if captured is None:
                continue
            times.append(captured.t_ns)
            late_s.append((time.monotonic_ns() - captured.t_ns) * 1e-9)
            if captured.fingerprint is not None:
                prints.add(captured.fingerprint)
            image = captured.decode()
    finally:
        camera.close()
    name = camera.name
    if len(times) < 3:
        return Check("camera", "fail", f"{name}: {len(times)} frames in {seconds:.0f} s", "check the cable; try another USB port")
    rate = (len(times) - 1) / max((times[-1] - times[0]) * 1e-9, 1e-6)
    latency = float(np.median(late_s))
    if image is None:
        return Check("camera", "fail", f"{name}: frames cannot be decoded", "try camera.pixel_format, another cable or USB port")
    grey = float(image.mean())
    text = f"{name}: {image.shape[1]}x{image.shape[0]}, {rate:.1f} of {rate_hz:g} frames/s, {1000 * latency:.0f} ms old"
    text += f", mean grey {grey:.0f}"
    if prints and len(prints) < len(times) / 2:
        return Check("camera", "fail", f"{text}; the same frame again and again", "unplug it and plug it in again")
    if not _DARK < grey < _BRIGHT:
        return Check("camera", "warn", f"{text}: it shows nothing", "take off the cap; check camera.exposure_us and camera.gain")
    if rate < SLOW * rate_hz:
        fix = "in the dark exposure may slow it down (camera.exposure_us); else camera.pixel_format, USB 3, or a lower rate_hz"
        return Check("camera", "warn", text, fix)
    if latency > LATE_S:
        return Check("camera", "warn", text, "a format without compression, or fewer pixels, is faster")
    return Check("camera", "ok", text)


def _of_service(status: dict[str, Any]) -> Check:
    from tmde_edge.app.doctor import Check

    camera, frames = status["camera"], status["frames"]
    text = f"{camera['name']} (held by the service): {frames['rate_hz']:.1f} frames/s, lost {camera['lost']}"
    if camera.get("fault"):
        return Check("camera", "fail", f"{text}; {camera['fault']}", "see the journal: journalctl -u tmde-edge")
    return Check("camera", "ok", text)


def check_can(config: Config, s: Surroundings, base_dir: Path) -> Iterator[Check]:
    """The interface, its bit rate and state, what is heard, whether the DBC fits, whether the speed makes sense."""
    from tmde_edge.app.doctor import Check

    if not config.can.enabled:
        yield Check("CAN", "skip", "can.enabled = false")
        return
    if config.can.interface == "socketcan":
        link = judge_link(config.can.channel, s.run(("ip", "-details", "-json", "link", "show", config.can.channel)))
        yield link
        if link.state == "fail":
            return
    try:
        decoder = load_vehicle_decoder(config.can, base_dir)
    except ConfigError as error:
        yield Check("CAN signals", "fail", str(error), "")
        return
    status = s.status()
    if status is not None and config.can.interface not in _SHARED:  # opened again, its channel would close
        yield _can_of_service(config, status)
        return
    heard: list[CanFrame] = []
    port = CanPort(config.can, heard.append, (), open_pause_s=0.5)
    listen = port if not config.can.transmit else CanPort(_silent(config), heard.append, (), open_pause_s=0.5)
    listen.start()
    time.sleep(LISTEN_S)
    connected = listen.connected
    listen.close()
    if not connected and not heard:
        yield Check("CAN traffic", "fail", f"{config.can.channel} cannot be opened", _NOT_OPEN)
        return
    yield from judge_traffic(heard, EgoReceiver(decoder, config.can), [f[0] for f in decoder.filters], LISTEN_S)


def _can_of_service(config: Config, status: dict[str, Any]) -> Check:
    """What the service has heard on an adapter that only one program can hold."""
    from tmde_edge.app.doctor import Check

    can, speed_mps = status["can"], status["speed_mps"]
    if can is None:
        text = f"{config.can.channel}: the service runs without CAN"
        return Check("CAN traffic", "warn", text, "systemctl restart tmde-edge, where the configuration is newer than it")
    text = f"{can['name']} (held by the service): {can['received']} frames received, {can['sent']} sent"
    if can["connected"] is False:
        return Check("CAN traffic", "fail", f"{text}; it cannot be opened", _NOT_OPEN)
    if can["faults"]:
        return Check("CAN traffic", "fail", f"{text}; {', '.join(can['faults'])}", "see the journal: journalctl -u tmde-edge")
    if not can["received"]:
        fix = "ignition on? H and L right? the bit rate of the bus?"
        return Check("CAN traffic", "fail", f"{text}; nothing heard", fix)
    if speed_mps is None:
        fix = "[can.vehicle]; message, signal and checksum rule; more with the service stopped"
        return Check("CAN traffic", "warn", f"{text}; no speed", fix)
    return Check("CAN traffic", "ok", f"{text}, {3.6 * speed_mps:.1f} km/h")


def _silent(config: Config) -> Any:
    from msgspec.structs import replace

    return replace(config.can, transmit=False)


def judge_link(name: str, told: str | None) -> Check:
    """The interface from `ip -details -json link show`."""
    from tmde_edge.app.doctor import Check

    if told is None:
        return Check("CAN", "fail", f"{name}: no such interface", "plug in the adapter; install systemd/80-tmde-can0.network")
    try:
        link = json.loads(told)[0]
        info = link.get("linkinfo") or {}
        data = info.get("info_data") or {}
    except (ValueError, IndexError, AttributeError, KeyError):
        return Check("CAN", "fail", f"{name}: `ip` answers in an unknown form", "update iproute2")
    kind = info.get("info_kind", "?")
    if kind not in ("can", "vcan", "vxcan"):
        return Check("CAN", "fail", f"{name} is {kind}, no CAN interface", "set can.channel")
    if "UP" not in (link.get("flags") or []):
        return Check("CAN", "fail", f"{name} is down", f"sudo ip link set {name} up (systemd-networkd does it at boot)")
    if kind != "can":
        return Check("CAN", "warn", f"{name} is virtual ({kind})", "right for a trial; a vehicle needs a real adapter")
    rate = (data.get("bittiming") or {}).get("bitrate")
    state = data.get("state", "?")
    mode = ", ".join(data.get("ctrlmode") or []) or "normal"
    text = f"{name}: {state}, {rate or '?'} bit/s, {mode}, restart {data.get('restart_ms', 0)} ms"
    if state == "BUS-OFF":
        return Check("CAN", "fail", text, "wrong bit rate, wiring or no termination (120 ohm at both ends)")
    if state == "ERROR-PASSIVE":
        return Check("CAN", "fail", text, "nobody acknowledges: wrong bit rate, H and L swapped, or alone on the bus")
    if state == "ERROR-WARNING":
        return Check("CAN", "warn", text, "errors on the bus: check wiring and termination")
    if not data.get("restart_ms") and "LISTEN-ONLY" not in mode:
        return Check("CAN", "warn", text, "after bus-off it stays silent: RestartSec=100ms in the .network file")
    return Check("CAN", "ok", text)


def judge_traffic(heard: list[CanFrame], receiver: EgoReceiver, wanted: list[int], seconds: float) -> Iterator[Check]:
    """What was heard: anything at all, the ids of the configuration, a speed that can be."""
    from tmde_edge.app.doctor import Check

    ids = {f.can_id for f in heard}
    if not heard:
        fix = "ignition on? H and L right? the bit rate of the bus?"
        yield Check("CAN traffic", "fail", f"nothing heard in {seconds:.0f} s", fix)
        return
    rate = len(heard) / seconds
    text = f"{rate:.0f} frames/s of {len(ids)} ids"
    if not receiver.configured:
        fix = 'set [can.vehicle] profile = "toyota" or the like, or dbc and speed (docs/can.md)'
        yield Check("CAN traffic", "warn", f"{text}; no speed is configured", fix)
        return
    missing = [i for i in wanted if i not in ids and i <= 0x7FF]
    if missing:
        fix = "another bus of the vehicle, or the DBC of another model"
        yield Check("CAN traffic", "fail", f"{text}; never heard: {', '.join(f'0x{i:X}' for i in missing)}", fix)
    else:
        yield Check("CAN traffic", "ok", text)
    speeds = [state.speed_mps for frame in heard if (state := receiver.update(frame)) is not None]
    complaints = "; ".join(receiver.complaints)
    if not speeds:
        text = "no frame gives a speed" + (f": {complaints}" if complaints else "")
        yield Check("CAN speed", "fail", text, "check message, signal and checksum rule")
    elif complaints:
        yield Check("CAN speed", "warn", f"{3.6 * speeds[-1]:.1f} km/h; {complaints}", "check signal, unit and scale")
    else:
        yield Check("CAN speed", "ok", f"{3.6 * speeds[-1]:.1f} km/h: does the vehicle do that?")


def try_networks(config: Config) -> Iterator[Check]:
    """Loads every network and runs it once."""
    from tmde_edge.app.doctor import Check
    from tmde_edge.app.wiring import build_eyes, depth_network
    from tmde_edge.messages import Frame

    shade = np.linspace(40, 200, config.camera.height_px).astype(np.uint8)  # a bright sky and a dark road, no plate
    picture = np.ascontiguousarray(np.broadcast_to(shade[::-1, None, None], (len(shade), config.camera.width_px, 3)))
    frame = Frame(t_ns=0, index=0, image=picture)
    try:
        eyes = build_eyes(config, time.perf_counter_ns)
        took: list[float] = []
        for i in range(6):
            start = time.perf_counter()
            eyes.see(Frame(t_ns=i * 200_000_000, index=i, image=picture))
            took.append((time.perf_counter() - start) * 1e3)
        took_ms = float(np.median(took))
        slow = took_ms > 1e3 / config.camera.rate_hz
        fix = "lower camera.rate_hz or the picture's size, or detector.search_rate_hz" if slow else ""
        text = f"{config.detector.kind} and {config.segmenter.kind}: {took_ms:.0f} ms for a full search"
        yield Check("models", "warn" if slow else "ok", text, fix)
    except ModelError as error:
        yield Check("models", "fail", str(error), "install tmde-edge again")
    if config.depth.kind == "onnx":
        try:
            network = depth_network(config)
            start = time.perf_counter()
            network.infer(frame)
            took_ms = (time.perf_counter() - start) * 1e3
            where = ", ".join(re.sub("ExecutionProvider$", "", p) for p in getattr(network, "providers", ()))
            slow = took_ms > 1e3 / config.depth.rate_hz
            fix = "lower depth.rate_hz, or take a smaller network" if slow else ""
            yield Check("depth", "warn" if slow else "ok", f"{config.depth.model} on {where}: {took_ms:.0f} ms", fix)
        except ModelError as error:
            yield Check("depth", "fail", str(error), f"tmde-edge models fetch {config.depth.model}")
