"""The doctor, with made-up /sys and /proc trees, made-up tools and devices."""

from __future__ import annotations

import json
import os
import pty
import select
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.adapters.cameras.v4l2 import NodeInfo
from tmde_edge.app import doctor, doctor_devices
from tmde_edge.app.doctor import Check, Surroundings
from tmde_edge.app.doctor_devices import grab, judge_link, judge_node, judge_traffic
from tmde_edge.canbus.ego_rx import EgoReceiver
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.cli import main
from tmde_edge.config import Config, load
from tmde_edge.messages import CanFrame

NOW_S = 1_800_000_000.0


def put(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def around(root: Path, tools: dict[str, str] | None = None, **more: Any) -> Surroundings:
    def run(command: Sequence[str]) -> str | None:
        return (tools or {}).get(command[0])

    return Surroundings(root=root, run=run, wall_s=lambda: NOW_S, **more)


def states(checks: Sequence[Check]) -> dict[str, str]:
    return {c.name: c.state for c in checks}


@pytest.mark.parametrize(("milli", "expected"), [("45000", "ok"), ("75000", "warn"), ("82000", "fail")])
def test_temperature(tmp_path: Path, milli: str, expected: str) -> None:
    put(tmp_path, "sys/class/thermal/thermal_zone0/temp", milli)
    put(tmp_path, "proc/device-tree/model", "Raspberry Pi 5 Model B\0")
    first = next(doctor.check_board(Config(), around(tmp_path)))
    assert (first.state, "Raspberry Pi 5 Model B:" in first.text) == (expected, True)


@pytest.mark.parametrize(
    ("word", "throttling", "power"),
    [("0x0", "ok", "ok"), ("0x50005", "fail", "fail"), ("0x10000", "ok", "warn"), ("0x80008", "fail", "ok"),
     ("0x40000", "warn", "ok")],
)
def test_throttling_and_under_voltage(tmp_path: Path, word: str, throttling: str, power: str) -> None:
    s = around(tmp_path, {"vcgencmd": f"throttled={word}\n"})
    assert states([*doctor.check_board(Config(), s)])["throttling"] == throttling
    assert states([*doctor.check_power(Config(), s)])["power"] == power


def test_a_supply_sensor_that_alarms(tmp_path: Path) -> None:
    assert states([*doctor.check_power(Config(), around(tmp_path))])["power"] == "skip"
    put(tmp_path, "sys/class/hwmon/hwmon3/in0_lcrit_alarm", "1\n")
    assert states([*doctor.check_power(Config(), around(tmp_path))])["power"] == "fail"


def test_jetson_tells_by_tegrastats(tmp_path: Path) -> None:
    put(tmp_path, "etc/nv_tegra_release", "R36")
    put(tmp_path, "sys/class/thermal/thermal_zone0/temp", "45000")
    first = next(doctor.check_board(Config(), around(tmp_path, {"tegrastats": "RAM 2448/7620MB CPU [3%@1510]\n"})))
    assert "RAM 2448/7620MB" in first.text


def test_the_clock(tmp_path: Path) -> None:
    def state(s: Surroundings) -> str:
        return next(doctor.check_clock(Config(), s)).state

    assert state(around(tmp_path)) == "warn"
    assert state(around(tmp_path, {"timedatectl": "yes\n"})) == "ok"
    put(tmp_path, "sys/class/rtc/rtc0", "")
    assert state(around(tmp_path)) == "ok"
    assert state(Surroundings(root=tmp_path, run=lambda _: None, wall_s=lambda: 0.0)) == "fail"


def test_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def state(**changes: Any) -> str:
        config = Config()
        config = replace(config, record=replace(config.record, folder="/data/drives", **changes))
        return next(doctor.check_disk(config, around(tmp_path))).state

    (tmp_path / "data").mkdir()
    assert state(max_mb=1, incidents_max_mb=1, min_free_mb=1) == "ok"
    assert state(enabled=True, max_mb=10**9) == "warn"
    assert state(min_free_mb=10**9) == "fail"
    assert state(shadow=False) == "skip"


def test_memory(tmp_path: Path) -> None:
    put(tmp_path, "proc/meminfo", "MemTotal: 1000000 kB\nMemAvailable:   90000 kB\n")
    assert next(doctor.check_memory(Config(), around(tmp_path))).state == "warn"
    assert next(doctor.check_memory(Config(), around(tmp_path / "no"))).state == "skip"


def test_calibration_and_its_age(tmp_path: Path) -> None:
    import os

    file = tmp_path / "config.toml"
    file.write_text("")

    def state(age_days: float, *values: str) -> str:
        os.utime(file, (NOW_S - age_days * 86400,) * 2)
        return next(doctor.check_calibration(load(None, values), around(tmp_path), file)).state

    good = ("camera.fx_px=1200", "camera.height_m=1.3", "camera.to_bumper_m=1.6")
    assert state(1) == "fail"
    assert state(1, *good) == "ok"
    assert state(400, *good) == "warn"
    assert state(1, good[0]) == "warn"
    (prior,) = doctor.check_calibration(load(None, ['camera.prior="pi-v3"']), around(tmp_path), file)
    assert (prior.state, "f = 940 px, +- 5% in every distance" in prior.text) == ("warn", True), prior.line()


@pytest.mark.parametrize(
    ("value", "piece"),
    [('plates.expect=["xx-nowhere"]', "xx-nowhere"), ('alerts.command=["/no/such"]', "/no/such"),
     ("camera.kind=gstreamer", "camera.pipeline"), ("detector.kind=onnx", "detector.onnx_path")],
)  # fmt: skip
def test_what_the_service_would_not_start_with(value: str, piece: str, tmp_path: Path) -> None:
    (check,) = doctor.check_configuration(load(None, [value]), tmp_path)
    assert (check.state, piece in check.text) == ("fail", True), check.line()
    (check,) = doctor.check_configuration(load(None, []), tmp_path)
    assert check.state == "ok"


def test_a_wrong_configuration_does_not_end_the_doctor(tmp_path: Path) -> None:
    values = ['plates.expect=["xx-nowhere"]', "detector.kind=contour", "can.enabled=false", f"camera.device={tmp_path / 'v'}"]
    found = states(doctor.examine(load(None, values), around(tmp_path), None, tmp_path))
    assert (found["configuration"], found["models"], "memory" in found) == ("fail", "fail", True)


NODE = NodeInfo(
    card="HD cam", driver="uvcvideo", formats=("MJPG", "YUYV"), captures=True, autofocus=False, autoexposure=True, focus=0
)


def node(**changes: Any) -> list[Check]:
    values = {name: getattr(NODE, name) for name in NodeInfo.__slots__}
    return list(judge_node(NodeInfo(**(values | changes)), "/dev/video0", None))


def test_a_camera_node() -> None:
    assert states(node()) == {"camera": "ok"}
    assert states(node(autofocus=True))["camera focus"] == "warn"
    assert states(node(formats=(), captures=False)) == {"camera": "fail"}


@pytest.mark.parametrize("formats", [("pRAA", "pBAA", "RG10"), ("RG10",), ("BYR2",), ("RGGB", "BA81")])
def test_a_raw_bayer_node_is_named(formats: tuple[str, ...]) -> None:
    (check,) = node(formats=formats)
    assert check.state == "fail"
    assert "raw Bayer" in check.text
    assert "picamera2" in check.fix
    assert "gstreamer" in check.fix


class Camera:
    """Frames at a rate, of an age and a brightness."""

    name, ended = "camera test", False

    def __init__(self, now: Callable[[], int], rate_hz: float, *, grey: int = 90, same: bool = False, good: bool = True) -> None:
        self.now, self.step_ns, self.grey, self.same, self.good = now, round(1e9 / rate_hz), grey, same, good
        self.count = 0

    def open(self) -> None: ...

    def close(self) -> None: ...

    def read(self, timeout_s: float) -> Captured:
        self.count += 1
        image = np.full((9, 16), self.grey, np.uint8)
        t_ns = self.now() + self.count * self.step_ns
        return Captured(
            t_ns=t_ns, index=self.count, decode=lambda: image if self.good else None, fingerprint=1 if self.same else self.count
        )


@pytest.mark.parametrize(
    ("options", "state", "piece"),
    [
        ({}, "ok", "30.0 of 30 frames/s"),
        ({"rate_hz": 12}, "warn", "12.0 of 30"),
        ({"grey": 1}, "warn", "shows nothing"),
        ({"same": True}, "fail", "same frame"),
        ({"good": False}, "fail", "cannot be decoded"),
    ],
)
def test_grabbed_frames(options: dict[str, Any], state: str, piece: str) -> None:
    import time

    start = time.monotonic_ns()
    check = grab(Camera(lambda: start, **{"rate_hz": 30, **options}), 30.0, seconds=0.02)
    assert (check.state, piece in check.text) == (state, True), check


def link(**changes: Any) -> str:
    data = {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 500000}, "restart_ms": 100} | changes
    kind = data.pop("kind", "can")
    flags = data.pop("flags", ["NOARP", "UP", "LOWER_UP"])
    return json.dumps([{"ifname": "can0", "flags": flags, "linkinfo": {"info_kind": kind, "info_data": data}}])


@pytest.mark.parametrize(
    ("told", "state", "piece"),
    [
        (link(), "ok", "ERROR-ACTIVE, 500000 bit/s"),
        (None, "fail", "no such interface"),
        (link(flags=["NOARP"]), "fail", "is down"),
        (link(state="BUS-OFF"), "fail", "120 ohm"),
        (link(state="ERROR-PASSIVE"), "fail", "acknowledges"),
        (link(restart_ms=0), "warn", "RestartSec"),
        (link(restart_ms=0, ctrlmode=["LISTEN-ONLY"]), "ok", "LISTEN-ONLY"),
        (link(kind="vcan"), "warn", "virtual"),
        (link(kind="veth"), "fail", "no CAN interface"),
        ("nonsense", "fail", "unknown form"),
    ],
)
def test_the_interface(told: str | None, state: str, piece: str) -> None:
    check = judge_link("can0", told)
    assert (check.state, piece in f"{check.text} {check.fix}") == (state, True), check


def receiver() -> tuple[EgoReceiver, list[int], CanSettings]:
    from tmde_edge.adapters.can_ports.dbc_files import load_vehicle_decoder

    settings = load(None, ['can.vehicle.speed={id=180, start_bit=47, length=16, byte_order="big", scale=0.01, unit="km/h"}']).can
    decoder = load_vehicle_decoder(settings, Path())
    return EgoReceiver(decoder, settings), [f[0] for f in decoder.filters], settings


def frames(can_id: int, raw: int, count: int = 40) -> list[CanFrame]:
    data = bytes(5) + raw.to_bytes(2, "big") + b"\0"
    return [CanFrame(t_ns=i * 20_000_000, can_id=can_id, data=data) for i in range(count)]


def test_what_is_heard_on_the_bus() -> None:
    ego, wanted, _ = receiver()
    checks = list(judge_traffic(frames(180, 5000), ego, wanted, 1.0))
    assert states(checks) == {"CAN traffic": "ok", "CAN speed": "ok"}
    assert "50.0 km/h" in checks[-1].text
    assert states(list(judge_traffic([], ego, wanted, 1.0))) == {"CAN traffic": "fail"}
    other = list(judge_traffic(frames(0x300, 5000), receiver()[0], wanted, 1.0))
    assert "never heard: 0xB4" in other[0].text
    plain = EgoReceiver(doctor_devices.load_vehicle_decoder(CanSettings(), Path()), CanSettings())
    assert "no speed is configured" in next(judge_traffic(frames(180, 1), plain, [], 1.0)).text


def test_where_the_service_runs_it_is_asked(tmp_path: Path) -> None:
    status = {"faults": [], "frames": {"rate_hz": 29.9}, "camera": {"name": "camera /dev/video0", "fault": None, "lost": 2}}
    s = around(tmp_path, status=lambda: status)
    assert states([*doctor.check_service(Config(), s)]) == {"service": "ok"}
    (check,) = doctor_devices.check_camera(Config(), s, tmp_path)
    assert (check.state, "held by the service" in check.text) == ("ok", True)
    status["faults"], status["camera"]["fault"] = ["blind"], "camera_lost"  # type: ignore[index, call-overload]
    assert states([*doctor.check_service(Config(), s)]) == {"service": "warn"}
    (check,) = doctor_devices.check_camera(Config(), s, tmp_path)
    assert check.state == "fail"


@pytest.mark.parametrize(
    ("can", "speed_mps", "state", "piece"),
    [({}, 12.5, "ok", "900 frames received, 40 sent, 45.0 km/h"), ({}, None, "warn", "no speed"),
     ({"received": 0}, None, "fail", "nothing heard"), ({"faults": ["can_tx"]}, 12.5, "fail", "can_tx"),
     ({"connected": False}, None, "fail", "cannot be opened"), (None, None, "warn", "runs without CAN")],
)  # fmt: skip
def test_a_serial_adapter_that_the_service_holds_is_not_opened(
    tmp_path: Path, can: dict[str, Any] | None, speed_mps: float | None, state: str, piece: str
) -> None:
    master, slave = pty.openpty()
    try:
        tty.setraw(slave)
        settings = replace(CanSettings(), interface="slcan", channel=os.ttyname(slave))
        whole = {"name": "slcan x", "connected": True, "faults": [], "received": 900, "sent": 40}
        status = {"can": None if can is None else {**whole, **can}, "speed_mps": speed_mps}
        (check,) = doctor_devices.check_can(replace(Config(), can=settings), around(tmp_path, status=lambda: status), tmp_path)
        assert (check.name, check.state, piece in check.text) == ("CAN traffic", state, True), check.line()
        assert select.select([master], [], [], 0)[0] == []  # a command would close the service's channel
    finally:
        os.close(master)
        os.close(slave)


def test_the_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    monkeypatch.setattr(doctor_devices, "try_networks", lambda config: iter([Check("models", "ok", "fine")]))
    arguments = ["doctor", "--json", "--set", "can.enabled=false", "--set", f"camera.device={tmp_path / 'video9'}",
                 "--set", f"runtime.status_socket={tmp_path / 's'}"]  # fmt: skip
    assert main(arguments) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["ready"] is False
    names = {c["name"] for c in told["checks"]}
    assert names >= {"service", "configuration", "camera", "calibration", "CAN", "models", "clock", "disk"}
    assert all(c["fix"] or c["state"] != "fail" for c in told["checks"])
    lines = [Check("camera", "fail", "is gone", "plug it in").line()]
    assert lines == ["FAIL  camera       is gone -> plug it in"]
