"""The status socket: questions, answers, and clients that misbehave."""

from __future__ import annotations

import json
import os
import socket
import stat
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tmde_edge.adapters.cameras.disabled import DisabledCamera
from tmde_edge.adapters.can_ports.bus import CanPort
from tmde_edge.app.board import BoardState
from tmde_edge.app.live import LiveLoop
from tmde_edge.app.service_status import Reporter
from tmde_edge.app.status import StatusServer, ask, lines_of, socket_path
from tmde_edge.app.teller import Teller
from tmde_edge.config import load
from tmde_edge.errors import InputDataError, InputMissingError
from tmde_edge.messages import CanFrame

STATUS = {"state": "degraded", "faults": ["blind"], "uptime_s": 3700.0, "version": "0.1.0"}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "run" / "status.sock"
    made = StatusServer(path, lambda request: {"got": request} if request.get("request") != "status" else STATUS)
    assert made.start()
    yield path
    made.close()
    assert not path.exists()


def test_a_question_gets_its_answer(server: Path) -> None:
    assert ask(server, {"request": "status"}) == STATUS
    assert ask(server, {"request": "other"}) == {"got": {"request": "other"}}
    assert stat.S_IMODE(server.stat().st_mode) == 0o660


def test_what_a_silent_bus_held_back_is_told() -> None:
    config = load(None, ["can.transmit=false"])
    loop = LiveLoop(DisabledCamera(), None, None)  # type: ignore[arg-type]
    reporter = Reporter(config, loop, Teller(), board=BoardState)
    reporter.bus = CanPort(config.can, lambda frame: None)
    for _ in range(3):
        reporter.bus.send(CanFrame(t_ns=0, can_id=0x6D0, data=b"\x01"))
    can = reporter.answer({"request": "status"})["can"]
    assert (can["transmit"], can["sent"], can["withheld"]) == (False, 0, 3)


@pytest.mark.parametrize("line", [b"nonsense\n", b"[1, 2]\n", b"\xff\xfe\n", b"x" * 10_000 + b"\n"])
def test_nonsense_is_answered_and_the_next_one_served(server: Path, line: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(server))
        client.settimeout(5)
        client.sendall(line)
        assert "not a request" in json.loads(client.makefile().readline())["error"]
    assert ask(server, {"request": "status"}) == STATUS


def test_clients_that_hang_up_or_say_nothing_block_nobody(server: Path) -> None:
    for _ in range(5):
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(server))
            client.sendall(b'{"request": "status"}\n')
    with socket.socket(socket.AF_UNIX) as silent:
        silent.connect(str(server))
        assert ask(server, {"request": "status"}) == STATUS  # after the silent one was hung up on


def test_a_dead_socket_file_is_replaced_and_a_live_one_respected(tmp_path: Path) -> None:
    path = tmp_path / "status.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    first = StatusServer(path, lambda _: STATUS)
    assert first.start()
    second = StatusServer(path, lambda _: {"error": "second"})
    assert not second.start()
    second.close()
    assert ask(path, {"request": "status"}) == STATUS
    first.close()


def test_errors_are_one_line_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputMissingError, match="is it running"):
        ask(tmp_path / "none.sock", {})
    path = tmp_path / "mute.sock"
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(str(path))
        mute.listen()
        with pytest.raises(InputDataError, match="did not answer"):
            ask(path, {}, timeout_s=0.1)
    complaining = StatusServer(tmp_path / "c.sock", lambda _: {"error": "no such request"})
    complaining.start()
    with pytest.raises(InputDataError, match="no such request"):
        ask(tmp_path / "c.sock", {})
    complaining.close()


def test_the_service_survives_without_descriptors(server: Path) -> None:
    """accept() fails while no descriptor is free; afterwards the socket answers again."""
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    client = socket.socket(socket.AF_UNIX)
    held: list[int] = []
    try:
        while True:
            held.append(os.open(os.devnull, os.O_RDONLY))
    except OSError:
        client.connect(str(server))
        time.sleep(0.05)
    finally:
        for fd in held:
            os.close(fd)
        client.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert ask(server, {"request": "status"}) == STATUS


def test_where_they_meet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "xdg"))
    assert socket_path("/a/b.sock") == Path("/a/b.sock")
    assert socket_path("", tmp_path / "no") == tmp_path / "xdg/tmde-edge/status.sock"
    assert socket_path("", tmp_path) == tmp_path / "status.sock"
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/x:/run/y")
    assert socket_path("", tmp_path) == Path("/run/x/status.sock")


def test_words_for_people_of_any_part_that_is_there() -> None:
    text = "\n".join(lines_of(STATUS))
    assert "degraded; faults blind; up 1 h 1 min" in text
    full = {
        **STATUS, "frames": {"rate_hz": 29.97, "latency_p50_ms": 31.04, "busy": 0.5}, "can": {"name": "can0", "transmit": False},
        "depth": {"state": "works", "providers": ["CPUExecutionProvider"]}, "record": {"problem": "disk full"},
        "lead": {"distance_m": 7.8, "sigma_m": 0.1, "range_rate_mps": -1.0, "ttc_s": 7.8},
        "last_alerts": [{"time": "t", "level": "warning", "reason": "ttc", "ttc_s": 2.0}],
    }  # fmt: skip
    text = "\n".join(lines_of(full))
    for piece in ("30.0/s", "silent", "CPUExecutionProvider", "disk full", "7.8 m ± 0.1, -1.0 m/s", "warning (ttc), TTC 2.0 s"):
        assert piece in text
    assert threading.active_count() < 50
