"""The watch over a live camera, and the recording that plays the part of one."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tmde_edge.adapters.cameras import played_file
from tmde_edge.adapters.cameras.disabled import DisabledCamera
from tmde_edge.adapters.cameras.live_camera import Captured, WatchedCamera
from tmde_edge.adapters.cameras.played_file import PlayedFile
from tmde_edge.adapters.cameras.sources import SourceItem
from tmde_edge.errors import DeviceError
from tmde_edge.messages import Frame

IMAGE = np.zeros((2, 2), np.uint8)


class Clock:
    """Time that passes only when someone waits."""

    def __init__(self) -> None:
        self.now_ns = 5_000_000_000

    def s(self) -> float:
        return self.now_ns * 1e-9

    def ns(self) -> int:
        return self.now_ns

    def wait(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


class Script:
    """A camera that does what the test says, 30 times a second."""

    name = "camera test"
    ended = False

    def __init__(self, clock: Clock, act: Callable[[int], Captured | None]) -> None:
        self.clock, self.act = clock, act
        self.calls = self.opens = 0
        self.is_open = False
        self.refuse = False

    def open(self) -> None:
        if self.refuse:
            raise DeviceError("not there")
        assert not self.is_open
        self.opens += 1
        self.is_open = True

    def read(self, timeout_s: float) -> Captured | None:
        self.clock.wait(1 / 30)
        self.calls += 1
        return self.act(self.calls)

    def close(self) -> None:
        self.is_open = False


def frame(index: int, fingerprint: int | None = None) -> Captured:
    return Captured(t_ns=index, index=index, decode=lambda: IMAGE, fingerprint=index if fingerprint is None else fingerprint)


def watch(act: Callable[[int], Captured | None]) -> tuple[WatchedCamera, Script, Clock]:
    clock = Clock()
    script = Script(clock, act)
    return WatchedCamera(script, clock_s=clock.s, pause=clock.wait), script, clock


def run(camera: WatchedCamera, clock: Clock, seconds: float) -> list[Captured]:
    end = clock.s() + seconds
    got = []
    while clock.s() < end:
        captured = camera.next(0.2)
        if captured is not None:
            camera.good()
            got.append(captured)
    return got


def test_a_good_camera_has_no_fault_from_its_first_frame_on() -> None:
    camera, script, clock = watch(frame)
    assert camera.fault == "camera_lost"
    assert len(run(camera, clock, 2.0)) in (60, 61)
    assert camera.fault is None
    assert script.opens == 1


def test_gaps_in_the_count_are_lost_frames() -> None:
    camera, _, clock = watch(lambda call: frame(call * 3))
    got = run(camera, clock, 1.0)
    assert camera.counters.lost == (len(got) - 1) * 2 > 0


def test_a_missing_camera_is_tried_again_with_growing_pauses_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    camera, script, clock = watch(frame)
    script.refuse = True
    with caplog.at_level(logging.INFO):
        start = clock.s()
        pauses = []
        for _ in range(8):
            before = clock.s()
            assert camera.next(0.2) is None
            pauses.append(clock.s() - before)
        assert pauses == pytest.approx([0.25, 0.5, 1, 2, 2, 2, 2, 2])
        assert clock.s() > start
        assert camera.fault == "camera_lost"
        script.refuse = False
        run(camera, clock, 1.0)
    assert camera.fault is None
    assert [record.levelname for record in caplog.records] == ["ERROR", "WARNING"]


def test_an_unplugged_camera_is_opened_again() -> None:
    def act(call: int) -> Captured | None:
        if call == 30:
            raise DeviceError("is gone")
        return frame(call)

    camera, script, clock = watch(act)
    run(camera, clock, 0.99)
    assert camera.fault == "camera_lost"
    assert not script.is_open
    run(camera, clock, 1.0)
    assert camera.fault is None
    assert script.opens == 2


@pytest.mark.parametrize(
    ("act", "fault"),
    [
        (lambda call: frame(call) if call < 30 else None, "camera_stalled"),
        (lambda call: frame(call, 0 if call >= 30 else None), "camera_frozen"),
    ],
)
def test_stalled_and_frozen_cameras_are_told_apart_within_a_second_or_two(
    act: Callable[[int], Captured | None], fault: str
) -> None:
    camera, script, clock = watch(act)
    run(camera, clock, 0.9)
    assert camera.fault is None
    got = run(camera, clock, 1.6)
    assert camera.fault == fault
    assert len(got) <= 3  # a frozen picture is never given out again
    run(camera, clock, 10.0)
    assert camera.fault == fault
    assert 3 <= script.opens <= 8


def test_garbled_frames_become_a_fault_only_when_no_good_one_comes() -> None:
    camera, _, clock = watch(frame)
    run(camera, clock, 1.0)
    for call in range(300):
        if camera.next(0.2) is not None:
            if call % 10 == 0:
                camera.good()
            else:
                camera.garbled()
    assert camera.fault is None
    assert camera.counters.garbled == 270
    for _ in range(60):
        if camera.next(0.2) is not None:
            camera.garbled()
    assert camera.fault == "camera_garbled"


def test_a_slow_look_at_the_frames_is_no_fault_of_the_camera() -> None:
    camera, _, clock = watch(frame)
    run(camera, clock, 1.0)
    for _ in range(200):
        camera.next(0.2)  # the perception hangs: neither good nor garbled is called
    assert camera.fault is None


def test_the_disabled_camera_is_a_camera_that_is_never_there() -> None:
    clock = Clock()
    camera = WatchedCamera(DisabledCamera(), clock_s=clock.s, pause=clock.wait)
    assert camera.next(0.1) is None
    assert camera.fault == "camera_lost"


# -- played file ---------------------------------------------------------------------------------------------------------


def played(folder: Path, clock: Clock, **options: bool) -> PlayedFile:
    for i in range(5):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((4, 4), 40 * i, np.uint8))
    camera = PlayedFile(str(folder), fps=10, clock_ns=clock.ns, sleep=clock.wait, **options)
    camera.open()
    return camera


def level(captured: Captured | None) -> int:
    assert captured is not None
    image = captured.decode()
    assert image is not None
    return int(image[0, 0]) // 40


def test_frames_appear_at_their_time(tmp_path: Path) -> None:
    clock = Clock()
    start = clock.now_ns
    camera = played(tmp_path, clock)
    for i in range(5):
        captured = camera.read(0.2)
        assert level(captured) == i
        assert captured is not None
        assert captured.t_ns == start + i * 100_000_000
        assert clock.now_ns == pytest.approx(captured.t_ns, abs=2)
    assert camera.read(0.2) is None
    assert camera.ended


def test_nothing_is_due_yet(tmp_path: Path) -> None:
    clock = Clock()
    camera = played(tmp_path, clock)
    assert level(camera.read(0.05)) == 0
    before = clock.now_ns
    assert camera.read(0.05) is None
    assert clock.now_ns == pytest.approx(before + 50_000_000, abs=2)


def test_a_late_reader_gets_the_newest_frame(tmp_path: Path) -> None:
    clock = Clock()
    camera = played(tmp_path, clock)
    clock.wait(0.25)
    captured = camera.read(0.2)
    assert level(captured) == 2
    assert captured is not None
    assert captured.index == 2


def test_a_frame_does_not_wait_for_the_decoding_of_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    camera = played(tmp_path, clock)
    items = camera._items
    assert items is not None

    def slow() -> Iterator[SourceItem]:
        for item in items:
            clock.wait(0.03)  # what decoding takes
            yield item

    monkeypatch.setattr(camera, "_items", slow())
    for i in range(5):
        captured = camera.read(0.2)
        assert level(captured) == i
        assert captured is not None
        assert clock.now_ns == pytest.approx(captured.t_ns, abs=2)


def test_a_file_that_decodes_too_slowly_still_gives_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    camera = played(tmp_path, clock, loop=True)

    def slow() -> Iterator[SourceItem]:
        for i in range(50):
            clock.wait(0.15)
            yield Frame(t_ns=i * 100_000_000, index=i, image=IMAGE)

    monkeypatch.setattr(camera, "_items", slow())
    monkeypatch.setattr(camera, "_ahead", None)
    assert sum(camera.read(0.2) is not None for _ in range(10)) == 10


def test_a_loop_goes_on_in_time_and_count(tmp_path: Path) -> None:
    clock = Clock()
    start = clock.now_ns
    camera = played(tmp_path, clock, loop=True)
    got = [camera.read(0.2) for _ in range(12)]
    assert [level(c) for c in got] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1]
    assert [c.t_ns - start for c in got if c] == [i * 100_000_000 for i in range(12)]
    assert [c.index for c in got if c] == list(range(12))


def test_a_file_that_opens_slowly_loses_no_frame_when_it_begins_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    camera = played(tmp_path, clock, loop=True)

    def slow(*args: object, **more: object) -> Iterator[SourceItem]:
        clock.wait(0.35)
        return (Frame(t_ns=i * 100_000_000, index=i, image=IMAGE) for i in range(5))

    monkeypatch.setattr(played_file, "open_source", slow)
    got = [camera.read(1.0) for _ in range(12)]
    assert [c.index for c in got if c] == list(range(12))
    assert got[5] is not None
    assert got[4] is not None
    assert got[5].t_ns - got[4].t_ns == pytest.approx(350_000_000, abs=1_000_000)  # its own time, as of a camera that paused


def test_an_unreadable_picture_is_a_garbled_frame(tmp_path: Path) -> None:
    clock = Clock()
    played(tmp_path, clock)
    (tmp_path / "1.png").write_bytes(b"no picture")
    camera = PlayedFile(str(tmp_path), fps=10, clock_ns=clock.ns, sleep=clock.wait)
    camera.open()
    camera.read(0.2)
    second = camera.read(0.2)
    assert second is not None
    assert second.decode() is None


def test_a_missing_file_is_a_lost_camera(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"absent\.mp4"):
        PlayedFile(str(tmp_path / "absent.mp4")).open()
