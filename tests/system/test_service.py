"""`tmde-edge run` as a process: a played file in, CAN frames on a serial bus out, systemd's words, a quick end."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import cantools
import cv2
import numpy as np
import pytest

from tmde_edge.adapters.video_out import VideoWriter
from tmde_edge.app.wiring import replay_log
from tmde_edge.cli import main

DBC = Path(__file__).parents[2] / "config/tmde_edge.dbc"
PATIENCE_S = 60.0  # on a machine that is busy with other tests


class SerialBus:
    """The far end of an slcan adapter on a pseudo-terminal: collects the frames the service sends."""

    def __init__(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave
        self.frames: list[tuple[int, bytes]] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        pending = b""
        with contextlib.suppress(OSError):  # closed
            while True:
                *lines, pending = (pending + os.read(self._master, 4096)).split(b"\r")
                for line in lines:
                    if (match := re.fullmatch(rb"t([0-9A-F]{3})\d([0-9A-F]*)|T([0-9A-F]{8})\d([0-9A-F]*)", line)) is not None:
                        can_id, data = (match[1], match[2]) if match[1] else (match[3], match[4])
                        self.frames.append((int(can_id, 16), bytes.fromhex(data.decode())))

    def close(self) -> None:
        os.close(self._slave)
        os.close(self._master)


class Service:
    """The process and what it tells systemd."""

    def __init__(self, folder: Path, *arguments: str, wrapper: tuple[str, ...] = ()) -> None:
        self._notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._notify.bind(str(folder / "notify"))
        self.heard: list[str] = []
        threading.Thread(target=self._listen, daemon=True).start()
        environment = {**os.environ, "NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "2000000", "OMP_NUM_THREADS": "1"}
        self.stderr_file = folder / "stderr.txt"
        with self.stderr_file.open("w") as stderr:
            self.process = subprocess.Popen(
                [*wrapper, sys.executable, "-m", "tmde_edge.cli", "run", *arguments], env=environment, stderr=stderr
            )

    def _listen(self) -> None:
        while True:
            self.heard.append(self._notify.recv(4096).decode())

    def wait_for(self, what: str, true: object) -> None:
        end = time.monotonic() + PATIENCE_S
        while not true():  # type: ignore[operator]
            assert self.process.poll() is None, f"ended while waiting for {what}: {self.stderr_file.read_text()[-2000:]}"
            assert time.monotonic() < end, f"{what} did not come; heard {self.heard[-5:]}"
            time.sleep(0.02)

    def stop(self) -> float:
        """Sends SIGTERM; returns the seconds the end took."""
        start = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(PATIENCE_S) == 0, self.stderr_file.read_text()[-2000:]
        return time.monotonic() - start


def stop_limit_s() -> float:
    """A second is promised, on a machine that has a core for us."""
    return 1.5 if os.getloadavg()[0] < (os.cpu_count() or 1) else 20.0


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    noise = np.random.default_rng(2).integers(0, 255, (240, 320, 3), np.uint8)
    with VideoWriter(tmp_path / "clip.mp4", 10) as video:
        for i in range(20):
            video.write(np.roll(noise, 4 * i, axis=1), i * 100_000_000)
    return tmp_path / "clip.mp4"


@pytest.fixture
def bus() -> Iterator[SerialBus]:
    made = SerialBus()
    yield made
    made.close()


def settings(clip: Path, **more: str) -> list[str]:
    values = {
        "camera.kind": "video_file", "camera.device": str(clip), "camera.loop": "true", "camera.width_px": "320",
        "camera.height_px": "240", "camera.rate_hz": "10", "camera.fx_px": "300", "runtime.threads": "1", "depth.kind": "none",
        "can.enabled": "false", **more,
    }  # fmt: skip
    return [part for key, value in values.items() for part in ("--set", f"{key}={value}")]


def test_frames_reach_the_bus_and_sigterm_ends_it_quickly(tmp_path: Path, clip: Path, bus: SerialBus) -> None:
    can = {"can.enabled": "true", "can.interface": "slcan", "can.channel": bus.path, "can.transmit": "true"}
    record = {"record.enabled": "true", "record.folder": str(tmp_path / "drives")}
    service = Service(tmp_path, *settings(clip, **can, **record))
    service.wait_for("READY", lambda: "READY=1" in service.heard)
    service.wait_for("frames on the bus", lambda: len(bus.frames) >= 20)
    service.wait_for("a sign of life", lambda: "WATCHDOG=1" in service.heard)
    service.wait_for("a status", lambda: any(re.match(r"STATUS=[1-9][0-9.]* frames/s", line) for line in service.heard))
    took_s = service.stop()
    assert took_s < stop_limit_s()
    assert service.heard[-1] == "STOPPING=1"
    database = cantools.database.load_file(DBC)
    known = {message.frame_id for message in database.messages}
    assert {can_id for can_id, _ in bus.frames} <= known
    decoded = [database.decode_message(can_id, data) for can_id, data in bus.frames]
    assert all(decoded)
    (log,) = (tmp_path / "drives").glob("*.mcap")
    outcome = replay_log(log)
    assert outcome.difference is None, str(outcome.difference)
    assert outcome.torn is None
    assert outcome.outputs > 20


def test_the_service_says_how_it_is_and_the_doctor_asks_it(
    tmp_path: Path, clip: Path, bus: SerialBus, capsys: pytest.CaptureFixture[str]
) -> None:
    at = str(tmp_path / "status.sock")
    can = {"can.enabled": "true", "can.interface": "slcan", "can.channel": bus.path, "can.transmit": "true"}
    record = {"record.enabled": "true", "record.incidents": "true", "record.folder": str(tmp_path / "drives"),
              "record.incident_after_s": "1", "runtime.status_socket": at}  # fmt: skip
    service = Service(tmp_path, *settings(clip, **can, **record))
    service.wait_for("frames on the bus", lambda: len(bus.frames) >= 40)
    assert main(["status", "--json", "--socket", at]) == 0
    status = json.loads(capsys.readouterr().out)
    assert status["pid"] == service.process.pid
    assert status["frames"]["decided"] > 0
    assert status["frames"]["latency_p50_ms"] > 0
    assert status["camera"]["fault"] is None
    assert status["can"]["connected"] is True
    assert status["can"]["sent"] > 0
    assert status["board"]["memory_mb"] > 50
    assert status["record"]["problem"] is None
    assert main(["status", "--socket", at]) == 0
    assert "played file clip.mp4: works" in capsys.readouterr().out
    assert main(["incident", "--now", "a test", "--set", f"runtime.status_socket={at}"]) == 0
    service.wait_for("an incident", lambda: list((tmp_path / "drives" / "incidents").glob("*-manual/alert.jpg")))
    capsys.readouterr()
    main(["doctor", "--json", "--set", f"runtime.status_socket={at}", "--set", "can.enabled=false"])
    checks = {check["name"]: check for check in json.loads(capsys.readouterr().out)["checks"]}
    assert "held by the service" in checks["camera"]["text"]
    assert checks["service"]["state"] in ("ok", "warn")
    service.stop()
    assert main(["status", "--socket", at]) == 66


def test_kill_9_leaves_a_readable_log_that_replays(tmp_path: Path, clip: Path) -> None:
    service = Service(tmp_path, *settings(clip, **{"record.enabled": "true", "record.folder": str(tmp_path / "drives")}))
    service.wait_for("a status", lambda: any(re.match(r"STATUS=[1-9][0-9.]* frames/s", line) for line in service.heard))
    time.sleep(1.0)  # beyond the half second that may be lost
    service.process.kill()
    service.process.wait(PATIENCE_S)
    (log,) = (tmp_path / "drives").glob("*.mcap")
    outcome = replay_log(log)
    assert outcome.difference is None, str(outcome.difference)
    assert outcome.torn is not None
    assert outcome.events > 10


def test_a_missing_camera_and_bus_are_faults_not_a_failed_start(tmp_path: Path, clip: Path) -> None:
    wrong = {"camera.kind": "v4l2", "camera.device": str(tmp_path / "video9"), "can.enabled": "true", "can.interface": "slcan",
             "can.channel": str(tmp_path / "ttyUSB9"), "can.transmit": "true"}  # fmt: skip
    service = Service(tmp_path, *settings(clip, **wrong))
    service.wait_for("READY", lambda: "READY=1" in service.heard)
    service.wait_for("the fault", lambda: any("camera_lost" in line for line in service.heard))
    service.wait_for("a sign of life", lambda: "WATCHDOG=1" in service.heard)
    assert service.stop() < stop_limit_s()


def ask(port: int, path: str, cookie: str = "") -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    with contextlib.closing(connection):
        connection.request("GET", path, headers={"Cookie": cookie} if cookie else {})
        answer = connection.getresponse()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()


def test_the_page_shows_the_running_service_and_holds_up_nothing_at_the_end(tmp_path: Path, clip: Path) -> None:
    other = socket.create_server(("127.0.0.1", 0))  # the page's port is taken at first
    port = other.getsockname()[1]
    at = str(tmp_path / "status.sock")
    page = {"view.enabled": "true", "view.port": str(port), "view.token": "s3cret", "runtime.status_socket": at}
    service = Service(tmp_path, *settings(clip, **page))
    service.wait_for("the fault", lambda: any("view_lost" in line for line in service.heard))
    other.close()
    service.wait_for("the page", lambda: f"works again; it is at http://127.0.0.1:{port}/" in service.stderr_file.read_text())
    service.wait_for("the end of the fault", lambda: "view_lost" not in [line for line in service.heard if "STATUS" in line][-1])
    assert ask(port, "/picture.jpg")[0] == 401
    status, headers, _ = ask(port, "/?token=s3cret")
    assert status == 303
    cookie = headers["set-cookie"].split(";")[0]
    status, headers, jpeg = ask(port, "/picture.jpg", cookie)
    assert (status, headers["content-type"]) == (200, "image/jpeg")
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape[:2] == (240, 320)
    streams = [socket.create_connection(("127.0.0.1", port)) for _ in range(2)]  # one reads, one never does
    for s, path in zip(streams, ("/events", "/video"), strict=True):
        s.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {cookie}\r\n\r\n".encode())
    heard = b""
    while heard.count(b"data: ") < 3:
        heard += streams[0].recv(65536)
    assert b'"distance_m"' in heard or b'"plates"' in heard
    assert service.stop() < stop_limit_s()
    for s in streams:
        s.close()


def test_a_wrong_configuration_ends_with_78(tmp_path: Path, clip: Path) -> None:
    service = Service(tmp_path, *settings(clip, **{"camera.fx_px": "-1"}))
    assert service.process.wait(PATIENCE_S) == 78
    text = service.stderr_file.read_text()
    assert "camera.fx_px" in text
    assert len(text.splitlines()) == 1


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
def test_the_service_opens_no_network_connection(tmp_path: Path, clip: Path) -> None:
    trace = tmp_path / "trace.txt"
    wrapper = ("strace", "-f", "-qq", "-e", "trace=socket,connect,sendto,bind", "-o", str(trace))
    service = Service(tmp_path, *settings(clip, **{"camera.loop": "false"}), wrapper=wrapper)
    assert service.process.wait(PATIENCE_S) == 0
    calls = trace.read_text()
    assert 'sun_path="' in calls  # it did watch: the words to systemd are there
    assert "AF_INET" not in calls
