"""Picamera2 and GStreamer cameras against stand-ins with the documented behaviour."""

from __future__ import annotations

import sys
import time
import types
from typing import Any

import numpy as np
import pytest

from tmde_edge.adapters.cameras.gstreamer import GstCamera, has_gstreamer
from tmde_edge.adapters.cameras.pi_camera import PiCamera
from tmde_edge.adapters.cameras.v4l2 import V4l2Settings
from tmde_edge.app.wiring import build_camera
from tmde_edge.config import load
from tmde_edge.errors import ConfigError, DeviceError

NOW_NS, ASLEEP_NS = 900_000_000_000, 40_000_000_000


class Request:
    """A completed request: buffers must be given back."""

    def __init__(self, owner: FakePicamera2, level: int) -> None:
        self.owner, self.level = owner, level

    def make_array(self, name: str) -> np.ndarray:
        assert name == "main"
        w, h = self.owner.configuration["main"]["size"]
        return np.full((h, w, 3), self.level, np.uint8)

    def get_metadata(self) -> dict[str, Any]:
        stamp = NOW_NS + ASLEEP_NS - 20_000_000
        return {"SensorTimestamp": self.owner.stamp or stamp, "ExposureTime": 10_000}

    def release(self) -> None:
        self.owner.out -= 1


class FakePicamera2:
    """The part of picamera2.Picamera2 that its manual promises and we use."""

    made: FakePicamera2
    cameras = 1

    def __init__(self, number: int = 0) -> None:
        if number >= self.cameras:
            raise IndexError("list index out of range")
        self.camera_controls = dict.fromkeys(["FrameDurationLimits", "ExposureTime", "AeEnable", "AnalogueGain"], (0, 1, 0))
        self.started = self.closed = False
        self.level, self.out, self.stamp = 0, 0, None
        self.jobs: list[str] = []
        self.slow = self.gone = False
        FakePicamera2.made = self

    def create_video_configuration(self, main: Any, controls: Any, buffer_count: int, queue: bool) -> dict[str, Any]:
        return {"main": main, "controls": controls, "buffer_count": buffer_count, "queue": queue}

    def configure(self, configuration: dict[str, Any]) -> None:
        self.configuration = configuration

    def start(self) -> None:
        self.started = True

    def capture_request(self, wait: bool = True) -> str:
        assert not wait
        self.jobs.append("job")
        return "job"

    def wait(self, job: str, timeout: float) -> Request:
        if self.gone:
            raise RuntimeError("Camera frontend has timed out")
        if self.slow:
            raise TimeoutError
        self.out += 1
        self.level += 1
        return Request(self, self.level)

    def stop(self) -> None:
        self.started = False

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def picamera2(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("picamera2")
    module.Picamera2 = FakePicamera2  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "picamera2", module)


def pi(**changes: Any) -> PiCamera:
    settings = V4l2Settings(**{"device": "0", "width_px": 64, "height_px": 48, "rate_hz": 25.0, **changes})
    return PiCamera(settings, monotonic_ns=lambda: NOW_NS, boottime_ns=lambda: NOW_NS + ASLEEP_NS)


@pytest.mark.usefixtures("picamera2")
def test_frames_of_the_pi_camera_carry_the_middle_of_their_exposure() -> None:
    one = pi(exposure_us=8000, gain=2.0)
    one.open()
    made = FakePicamera2.made
    assert made.configuration["main"] == {"size": (64, 48), "format": "RGB888"}
    assert made.configuration["controls"] == {
        "FrameDurationLimits": (40_000, 40_000), "AeEnable": False, "ExposureTime": 8000, "AnalogueGain": 2.0,
    }  # fmt: skip
    first, second = one.read(0.1), one.read(0.1)
    assert first is not None
    assert second is not None
    assert (first.t_ns, second.index) == (NOW_NS - 25_000_000, 1)
    image = first.decode()
    assert image is not None
    assert (image.shape, int(image.mean())) == ((48, 64, 3), 1)
    assert first.fingerprint != second.fingerprint
    assert made.out == 0, "a buffer was not given back"
    one.close()
    assert made.closed


@pytest.mark.usefixtures("picamera2")
def test_a_slow_pi_camera_is_waited_for_with_one_job() -> None:
    one = pi()
    one.open()
    FakePicamera2.made.slow = True
    assert one.read(0.01) is None
    assert one.read(0.01) is None
    FakePicamera2.made.slow = False
    assert one.read(0.01) is not None
    assert len(FakePicamera2.made.jobs) == 1
    FakePicamera2.made.gone = True
    with pytest.raises(DeviceError, match="timed out"):
        one.read(0.01)


@pytest.mark.usefixtures("picamera2")
def test_a_stamp_that_cannot_be_gives_the_time_of_reading() -> None:
    one = pi()
    one.open()
    FakePicamera2.made.stamp = 5
    captured = one.read(0.1)
    assert captured is not None
    assert captured.t_ns == NOW_NS


@pytest.mark.usefixtures("picamera2")
def test_a_lens_control_that_is_missing_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    pi(focus=1.0).open()
    assert "LensPosition" not in FakePicamera2.made.configuration["controls"]
    assert "LensPosition" in caplog.text


@pytest.mark.usefixtures("picamera2")
def test_a_pi_camera_that_is_not_there() -> None:
    with pytest.raises(DeviceError, match="cannot be started"):
        pi(device="3").open()


def test_without_picamera2_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(DeviceError, match="apt install python3-picamera2"):
        build_camera(load(None, ["camera.kind=picamera2"]), __import__("pathlib").Path()).open()


class Pipeline:
    """cv2.VideoCapture on a pipeline."""

    def __init__(self, frames: int, opened: bool = True) -> None:
        self.left, self.opened, self.released = frames, opened, False

    def isOpened(self) -> bool:  # noqa: N802
        return self.opened

    def read(self) -> tuple[bool, np.ndarray | None]:
        time.sleep(0.005)
        self.left -= 1
        return (True, np.full((4, 6, 3), self.left % 250, np.uint8)) if self.left >= 0 else (False, None)

    def release(self) -> None:
        self.released = True


def test_a_pipeline_gives_its_newest_frame_and_its_end_is_an_error() -> None:
    made = Pipeline(12)
    camera = GstCamera("videotestsrc ! appsink", make=lambda text: made)
    camera.open()
    first = camera.read(1.0)
    assert first is not None
    time.sleep(0.03)
    later = camera.read(1.0)
    assert later is not None
    assert later.index > first.index + 1, "an old frame was handed out"
    assert later.fingerprint != first.fingerprint
    with pytest.raises(DeviceError, match="ended"):
        all(camera.read(1.0) for _ in range(20))
    camera.close()
    assert made.released


def test_pipelines_that_cannot_be() -> None:
    with pytest.raises(ConfigError, match="appsink"):
        GstCamera("videotestsrc", make=lambda text: Pipeline(0))
    with pytest.raises(DeviceError, match="gst-launch"):
        GstCamera("x ! appsink", make=lambda text: Pipeline(0, opened=False)).open()
    assert has_gstreamer("  GStreamer:                   YES (1.20.3)")
    assert not has_gstreamer("  GStreamer:                   NO")
    if not has_gstreamer():
        with pytest.raises(ConfigError, match="built without GStreamer"):
            GstCamera("x ! appsink")
