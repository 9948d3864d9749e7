"""The live page: what it shows, who may look, what it costs when nobody does, and that slow or gone readers harm nothing."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tmde_edge.adapters.can_ports.retry import BackOff
from tmde_edge.app.view.aiming import aim, exposure, nominal_camera, sharpness
from tmde_edge.app.view.hub import Hub
from tmde_edge.app.view.keeper import PageKeeper
from tmde_edge.app.view.server import ViewServer, is_loopback
from tmde_edge.cli import main
from tmde_edge.errors import DeviceError
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Alert, Frame, FrameResult, LeadEstimate, Pose, Sighting

CAMERA = Camera(width_px=320, height_px=180, fx_px=300.0, fy_px=300.0, cx_px=159.5, cy_px=89.5)


def result(k: int, distance_m: float | None = 20.0, level: Any = "none") -> FrameResult:
    lead = LeadEstimate(
        track_id=1, distance_m=distance_m, sigma_m=0.3, range_rate_mps=-4.0, range_rate_sigma_mps=0.2, ttc_s=5.0,
        ttc_sigma_s=0.1, headway_s=None, coasting_s=0.0, source="plate",
    )  # fmt: skip
    return FrameResult(
        t_ns=round(k * 1e9 / 30), frame_index=k, plates=(), lead=lead, ego=None, pose=Pose(pitch_rad=0.0, roll_rad=0.0),
        depth=None, alert=Alert(level=level), faults=(), mode="strict",
    )  # fmt: skip


def sighting(k: int) -> Sighting:
    return Sighting(
        t_ns=round(k * 1e9 / 30), frame_index=k, width_px=320, height_px=180, status="no_plate", timing_ms={"total": 5.0}
    )


def frame(k: int) -> Frame:
    image = np.full((180, 320, 3), 90, np.uint8)
    cv2.putText(image, str(k), (100, 100), cv2.FONT_HERSHEY_SIMPLEX, 2, (255, 255, 255), 3)
    return Frame(t_ns=round(k * 1e9 / 30), index=k, image=image)


def hub() -> Hub:
    return Hub(CAMERA, 1.3, rate_hz=30.0, width_px=320, quality=70)


class Running:
    """A page with a drive of 30 frames a second behind it."""

    def __init__(self, token: str = "", host: str = "127.0.0.1") -> None:
        self.hub = hub()
        self.server = ViewServer(self.hub, host, 0, token, title="test", limits={"caution": 3.6, "warning": 2.7})
        self.hub.start()
        self.server.start()
        self._stop = threading.Event()
        self._drive = threading.Thread(target=self._go, daemon=True)
        self._drive.start()

    def _go(self) -> None:
        k = 0
        while not self._stop.wait(1 / 30):
            self.hub.look(frame(k))
            self.hub.frame(result(k), sighting(k))
            k += 1

    def ask(self, path: str, headers: dict[str, str] | None = None) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=5)
        connection.request("GET", path, headers=headers or {})
        return connection.getresponse()

    def close(self) -> None:
        self._stop.set()
        self._drive.join()
        self.server.close()


@pytest.fixture
def page() -> Iterator[Running]:
    running = Running()
    yield running
    running.close()


def until(condition: Any, seconds: float = 5.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


def events(answer: http.client.HTTPResponse, count: int) -> list[Any]:
    found: list[Any] = []
    while len(found) < count:
        line = answer.readline()
        if line.startswith(b"data: "):
            found.append(json.loads(line[6:]))
    return found


def test_the_numbers_are_the_records_of_the_contract(page: Running) -> None:
    assert until(lambda: len(page.hub.history()) > 1)
    answer = page.ask("/events")
    assert answer.status == 200
    start, state = events(answer, 2)
    assert start["limits"] == {"caution": 3.6, "warning": 2.7}
    assert start["history"][0][1:5] == [20.0, 0.3, -4.0, 5.0]
    assert state["record"]["lead"]["distance_m"] == 20.0
    assert state["record"]["timing_ms"] == {"total": 5.0}


def test_the_picture_is_a_jpeg_that_changes_and_ends_with_its_reader(page: Running) -> None:
    assert page.hub.jpeg is None  # nobody watched: nothing was drawn
    answer = page.ask("/video")
    pictures = []
    while len(pictures) < 3:
        line = answer.readline()
        if line.lower().startswith(b"content-length"):
            size = int(line.split(b":")[1])
            answer.readline()
            pictures.append(answer.read(size))
    for jpeg in pictures:
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape == (180, 320, 3)
    assert pictures[0] != pictures[2]
    assert page.hub.watchers == 1
    answer.close()
    assert until(lambda: page.hub.watchers == 0)


def test_a_single_picture(page: Running) -> None:
    answer = page.ask("/picture.jpg")
    assert answer.status == 200
    assert answer.read()[:2] == b"\xff\xd8"


def test_nothing_is_drawn_or_kept_while_nobody_watches() -> None:
    watched = hub()
    watched.start()
    for k in range(100):
        watched.look(frame(0))
        watched.frame(result(k), sighting(k))
    time.sleep(0.1)
    assert watched.jpeg is None
    assert watched.state == {}
    assert not watched._frames
    assert len(watched.history()) == pytest.approx(100 / 3, abs=2)  # ten a second
    watched.close()


def test_a_warning_does_not_stay_on_the_page_when_the_camera_is_gone() -> None:
    shown = hub()
    shown.start()
    shown.watch(picture=False, change=1)
    shown.frame(result(1, level="warning"), sighting(1))
    assert until(lambda: shown.state.get("record", {}).get("alert", {}).get("level") == "warning")
    shown.frame(replace(result(40), lead=None, faults=("camera_lost", "blind")), None)
    shown.service({"faults": ["camera_lost", "blind"]})
    assert until(lambda: shown.state["record"]["alert"]["level"] == "none")
    record = shown.state["record"]
    assert (record["lead"], record["status"], record["faults"]) == (None, "blind", ["camera_lost", "blind"])
    shown.close()


def test_history_is_the_last_minute_and_starts_anew_with_the_recording() -> None:
    kept = hub()
    for k in range(0, 30 * 100, 3):
        kept.frame(result(k), sighting(k))
    points = kept.history()
    assert 590 <= len(points) <= 601
    kept.frame(result(0), sighting(0))
    assert len(kept.history()) == 1


def test_the_rate_of_pictures_is_bounded() -> None:
    slow = Hub(CAMERA, 1.3, rate_hz=5.0, width_px=320, quality=70)
    slow.start()
    slow.watch(picture=True, change=1)
    end = time.monotonic() + 1.0
    k = 0
    while time.monotonic() < end:
        slow.look(frame(k))
        slow.frame(result(k), sighting(k))
        k += 1
        time.sleep(0.005)
    slow.close()
    assert 1 <= slow.picture_number <= 7


def test_one_picture_waits_for_a_picture_whatever_other_news_there_is() -> None:
    shown = hub()
    server = ViewServer(shown, "127.0.0.1", 0, "", title="test", limits={})
    shown.start()
    server.start()

    def news() -> None:  # of the service, many times, and then one frame
        until(lambda: shown.watchers == 1)
        for k in range(40):
            shown.service({"t": k})
            shown._wake()
            time.sleep(0.005)
        shown.look(frame(1))
        shown.frame(result(1), sighting(1))

    speaker = threading.Thread(target=news)
    speaker.start()
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/picture.jpg", timeout=10) as answer:
            assert answer.headers["content-type"] == "image/jpeg"
            assert shown.picture_number == 1
        assert until(lambda: shown.watchers == 0)
    finally:
        speaker.join()
        server.close()


def test_other_names_and_wrong_tokens_are_turned_away(page: Running) -> None:
    assert page.ask("/", {"Host": "evil.example"}).status == 403
    assert page.ask("/", {"Host": f"localhost:{page.server.port}"}).status == 200
    guarded = Running(token="s3cret")
    try:
        for path in ("/", "/events", "/video", "/picture.jpg", "/view.js", "/?token=wrong"):
            answer = guarded.ask(path)
            assert answer.status == 401, path
            assert b"s3cret" not in answer.read()
        welcome = guarded.ask("/?token=s3cret")
        assert welcome.status == 303
        cookie = welcome.headers["set-cookie"]
        assert "httponly" in cookie.lower()
        assert "samesite=strict" in cookie.lower()
        assert guarded.ask("/", {"Cookie": cookie.split(";")[0]}).status == 200
        assert guarded.ask("/", {"Cookie": "tmde_edge_view=wrong"}).status == 401
    finally:
        guarded.close()


def test_elsewhere_than_on_this_machine_there_is_always_a_token() -> None:
    server = ViewServer(hub(), "0.0.0.0", 0, "", title="x", limits={})
    assert len(server.token) >= 16
    assert server.token in server.url
    server._socket.close()
    assert [is_loopback(h) for h in ("127.0.0.1", "::1", "localhost", "0.0.0.0", "192.168.1.4", "pi.local")] == [True] * 3 + [
        False
    ] * 3


def test_pages_carry_careful_headers_and_load_only_from_here(page: Running) -> None:
    answer = page.ask("/")
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    text = answer.read().decode()
    assert "http://" not in text
    assert "https://" not in text
    for name in ("view.css", "view.js"):
        assert name in text
        assert page.ask(f"/{name}").status == 200
    assert page.ask("/../view.js").status in (400, 404)
    assert page.ask("/nothing").status == 404


def test_a_reader_that_does_not_read_stops_nobody(page: Running) -> None:
    stuck = socket.create_connection(("127.0.0.1", page.server.port))
    stuck.sendall(b"GET /video HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    assert until(lambda: page.hub.watchers == 1)
    assert len(events(page.ask("/events"), 5)) == 5
    stuck.close()


def test_too_many_watchers_are_told_so(page: Running) -> None:
    answers = [page.ask("/events") for _ in range(8)]
    assert until(lambda: page.hub._readers == 8)
    assert page.ask("/video").status == 503
    for a in answers:
        a.close()


def test_a_taken_port_is_a_clear_error(page: Running) -> None:
    with pytest.raises(DeviceError, match=f"port {page.server.port}: cannot listen"):
        ViewServer(hub(), "127.0.0.1", page.server.port, "", title="x", limits={})


def test_close_ends_open_streams_soon() -> None:
    running = Running()
    answer = running.ask("/events")
    start = time.monotonic()
    running.close()
    assert time.monotonic() - start < 5.0
    answer.close()


# -- aiming -------------------------------------------------------------------------------------------------------------


def test_the_horizon_and_the_zones_lie_where_geometry_says() -> None:
    found = aim(CAMERA, Pose(pitch_rad=0.0, roll_rad=0.0), 1.3)
    assert [p[1] for p in found["horizon"]] == pytest.approx([0.5, 0.5], abs=1e-3)
    ten = next(z["box"] for z in found["zones"] if z["distance_m"] == 10.0)
    # 1.3 m to each side and 0.2 to 1.0 m below the lens at 10 m, f = 300 px
    assert ten == pytest.approx([0.5 - 39 / 320, 0.5 + 6 / 180, 0.5 + 39 / 320, 0.5 + 30 / 180], abs=2e-3)
    assert "fall out" in aim(CAMERA, Pose(pitch_rad=-0.25, roll_rad=0.0), 1.3)["advice"]
    assert "aim up" in aim(CAMERA, Pose(pitch_rad=0.2, roll_rad=0.0), 1.3)["advice"]
    assert "level" in aim(CAMERA, Pose(pitch_rad=0.03, roll_rad=0.1), 1.3)["advice"]
    assert aim(nominal_camera(1280, 720), Pose(pitch_rad=0.02, roll_rad=0.0), None)["advice"] == ""


def test_sharpness_falls_with_blur_and_not_with_light() -> None:
    rng = np.random.default_rng(1)
    sharp = cv2.resize(rng.integers(0, 255, (60, 80, 3), dtype=np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST)
    values = [sharpness(np.asarray(cv2.GaussianBlur(sharp, (0, 0), s), np.uint8)) for s in (0.5, 1.0, 2.0, 4.0)]
    assert values == sorted(values, reverse=True)
    assert values[0] > 3 * values[-1]
    dimmed = (sharp // 2).astype(np.uint8)
    assert sharpness(dimmed) == pytest.approx(sharpness(sharp), rel=0.1)


def test_exposure_has_a_word() -> None:
    flat = np.ones((100, 100, 3), np.uint8)
    assert exposure(flat * 110)["word"] == "good"
    assert exposure(flat * 254)["word"] == "too bright"
    assert exposure(flat * 12)["word"] == "too dark"


def test_the_command_line_names_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path / "no.mp4")]) == 66
    assert main(["view", "--set", f"publish.socket={tmp_path / 'no.sock'}"]) == 66
    assert "no service publishes" in capsys.readouterr().err
    assert main(["view", "--can-log", "x.log"]) == 2


# -- in the service -----------------------------------------------------------------------------------------------------


def test_a_taken_port_is_a_fault_until_it_is_free(caplog: pytest.LogCaptureFixture) -> None:
    other = socket.create_server(("127.0.0.1", 0))
    port = other.getsockname()[1]
    shown = hub()
    keeper = PageKeeper(
        shown, lambda: ViewServer(shown, "127.0.0.1", port, "", title="test", limits={}), BackOff(0.05, 0.05)
    )
    keeper.start()
    try:
        assert keeper.faults == ("view_lost",)
        other.close()
        assert until(lambda: not keeper.faults)
        shown.frame(result(0), sighting(0))
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5) as answer:
            assert answer.status == 200
    finally:
        keeper.close()
    texts = [r.getMessage() for r in caplog.records if "web page" in r.getMessage()]
    assert [("is off" in t, "works again" in t) for t in texts] == [(True, False), (False, True)]  # each told once
    assert keeper.faults == ()


def test_a_page_that_stopped_by_itself_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = hub()
    monkeypatch.setattr(shown, "_step", lambda: 1 / 0)
    keeper = PageKeeper(shown, lambda: ViewServer(shown, "127.0.0.1", 0, "", title="test", limits={}))
    keeper.start()
    assert until(lambda: keeper.faults == ("view_lost",))
    keeper.close()
