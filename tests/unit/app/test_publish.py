"""The records' socket: lines as they are decided, many readers, none of which can hold anything up."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tmde_edge.app import publish
from tmde_edge.app.publish import Publisher, socket_path
from tmde_edge.errors import DeviceError
from tmde_edge.messages import Alert, FrameResult, Pose, Sighting


def decided(index: int) -> tuple[FrameResult, Sighting]:
    t_ns = index * 33_000_000
    result = FrameResult(
        t_ns=t_ns, frame_index=index, plates=(), lead=None, ego=None, pose=Pose(pitch_rad=0.0, roll_rad=0.0), depth=None,
        alert=Alert(level="caution", reason="ttc", ttc_s=3.1), faults=("can_lost",), mode="strict",
    )  # fmt: skip
    return result, Sighting(t_ns=t_ns, frame_index=index, width_px=64, height_px=48, status="no_plate", timing_ms={"total": 1.5})


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.005)


def reader(publisher: Publisher) -> socket.socket:
    before = publisher.readers
    s = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    s.settimeout(3.0)
    s.connect(str(publisher.path))
    wait_for(lambda: publisher.readers == before + 1)
    return s


def lines(s: socket.socket, count: int) -> list[dict[str, Any]]:
    with s.makefile("rb") as f:
        return [json.loads(f.readline()) for _ in range(count)]


@pytest.fixture
def publisher(tmp_path: Path) -> Iterator[Publisher]:
    p = Publisher(tmp_path / "run" / "records.sock")
    yield p
    p.close()


def test_each_reader_gets_every_line_in_order(publisher: Publisher) -> None:
    readers = [reader(publisher) for _ in range(3)]
    for k in range(20):
        publisher.frame(*decided(k))
    publisher.service({"status": "all is well"})
    for s in readers:
        got = lines(s, 21)
        assert [r["frame"] for r in got[:20]] == list(range(20))
        assert got[3]["alert"] == {"level": "caution", "reason": "ttc", "ttc_s": 3.1}
        assert got[3]["faults"] == ["can_lost"]
        assert got[20] == {"service": {"status": "all is well"}}
        s.close()
    wait_for(lambda: publisher.readers == 0)


def test_a_reader_that_does_not_read_is_dropped_and_the_others_are_not(publisher: Publisher) -> None:
    lazy, keen = reader(publisher), reader(publisher)
    keen.setblocking(False)
    got = bytearray()
    slowest_s = 0.0
    big = {"text": "x" * 20_000}
    for _ in range(400):
        start = time.perf_counter()
        publisher.service(big)
        slowest_s = max(slowest_s, time.perf_counter() - start)
        time.sleep(0.001)
        try:
            while part := keen.recv(1 << 20):
                got += part
        except BlockingIOError:
            pass
    wait_for(lambda: publisher.dropped_readers == 1)
    assert publisher.readers == 1
    assert slowest_s < 0.1
    assert len(got) > 100 * 20_000
    lazy.close()
    keen.close()


def test_nothing_is_queued_while_nobody_reads(publisher: Publisher) -> None:
    for k in range(1000):
        publisher.frame(*decided(k))
    s = reader(publisher)
    publisher.frame(*decided(7))
    assert lines(s, 1)[0]["frame"] == 7
    s.close()


def test_a_dead_services_socket_is_taken_over_a_living_ones_is_not(tmp_path: Path) -> None:
    path = tmp_path / "records.sock"
    left = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    left.bind(str(path))
    left.close()
    first = Publisher(path)
    with pytest.raises(DeviceError, match="another service listens"):
        Publisher(path)
    # the refused one's probe may still count as a reader: only that a new one gets in is looked at
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as s:
        s.connect(str(path))
    first.close()
    assert not path.exists()


def test_what_cannot_be_listened_at_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "x.sock", tmp_path / ("x" * 200), tmp_path / "file"):
        with pytest.raises(DeviceError, match=r"publish\.socket .*cannot listen"):
            Publisher(path)
    assert (tmp_path / "file").exists()  # only sockets are ever removed


def test_too_many_readers_are_turned_away(publisher: Publisher, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publish, "MAX_READERS", 2)
    kept = [reader(publisher) for _ in range(2)]
    extra = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    extra.settimeout(3.0)
    extra.connect(str(publisher.path))
    assert extra.recv(1) == b""
    for s in (*kept, extra):
        s.close()


def test_where_the_socket_lies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert socket_path("") is None
    assert socket_path("/x/y.sock") == Path("/x/y.sock")
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/one:/run/two")
    assert socket_path("auto") == Path("/run/one/records.sock")
