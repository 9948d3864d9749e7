"""V4L2 capture against a driver made of paper: negotiation, newest frame, time stamps, what is no camera."""

from __future__ import annotations

import ctypes
import errno
import select
from collections import deque
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tmde_edge.adapters.cameras import v4l2, v4l2_abi
from tmde_edge.adapters.cameras.v4l2 import Layout, V4l2Camera, V4l2Settings, decode, stamp_ns
from tmde_edge.errors import DeviceError

PAGE = 65536
NOW_NS = 100_000_000_000


def test_the_numbers_are_the_kernels() -> None:
    known = {
        "QUERYCAP": 0x80685600, "ENUM_FMT": 0xC0405602, "S_FMT": 0xC0D05605, "REQBUFS": 0xC0145608, "QUERYBUF": 0xC0585609,
        "QBUF": 0xC058560F, "DQBUF": 0xC0585611, "STREAMON": 0x40045612, "STREAMOFF": 0x40045613, "S_PARM": 0xC0CC5616,
        "S_CTRL": 0xC008561C,
    }  # fmt: skip
    assert {name: getattr(v4l2_abi, name) for name in known} == known
    assert v4l2_abi.fourcc("MJPG") == 0x47504A4D


class Driver:
    """Answers ioctl as a kernel driver would; the buffers' memory is the device file itself."""

    def __init__(self) -> None:
        self.formats: dict[str, tuple[tuple[int, int], float]] = {"YUYV": ((64, 48), 5.0), "MJPG": ((64, 48), 30.0)}
        self.caps = v4l2_abi.CAP_VIDEO_CAPTURE | v4l2_abi.CAP_STREAMING
        self.now = ""
        self.controls: dict[int, int] = {}
        self.queued: deque[int] = deque()
        self.filled: deque[v4l2_abi.Buffer] = deque()
        self.streaming = self.gone = False
        self.sequence = 0
        self.device = Path()

    def ioctl(self, fd: int, request: int, arg: Any) -> None:
        names = {getattr(v4l2_abi, n): n for n in vars(v4l2_abi) if n.isupper() and isinstance(getattr(v4l2_abi, n), int)}
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")
        getattr(self, "on_" + names[request].lower())(arg)

    def on_querycap(self, caps: Any) -> None:
        caps.card, caps.capabilities, caps.device_caps = b"paper camera", self.caps | v4l2_abi.CAP_DEVICE_CAPS, self.caps

    def on_enum_fmt(self, description: Any) -> None:
        if description.index >= len(self.formats):
            raise OSError(errno.EINVAL, "Invalid argument")
        description.pixelformat = v4l2_abi.fourcc(list(self.formats)[description.index])

    def on_s_fmt(self, form: Any) -> None:
        self.now = v4l2_abi.fourcc_text(form.fmt.pix.pixelformat)
        (form.fmt.pix.width, form.fmt.pix.height), _ = self.formats[self.now]
        form.fmt.pix.bytesperline = 0 if self.now == "MJPG" else form.fmt.pix.width * 2

    def on_s_parm(self, parameters: Any) -> None:
        interval = parameters.parm.capture.timeperframe
        wanted = interval.denominator / interval.numerator
        interval.numerator, interval.denominator = 1, round(min(wanted, self.formats[self.now][1]))

    def on_s_ctrl(self, control: Any) -> None:
        if control.id == v4l2_abi.CID_FOCUS_ABSOLUTE:
            raise OSError(errno.EINVAL, "Invalid argument")
        self.controls[control.id] = control.value

    def on_reqbufs(self, request: Any) -> None:
        self.device.write_bytes(bytes(PAGE * request.count))

    def on_querybuf(self, buffer: Any) -> None:
        buffer.length, buffer.m.offset = PAGE, PAGE * buffer.index

    def on_qbuf(self, buffer: Any) -> None:
        self.queued.append(buffer.index)

    def on_dqbuf(self, buffer: Any) -> None:
        if not self.filled:
            raise BlockingIOError(errno.EAGAIN, "Try again")
        first = self.filled.popleft()
        ctypes.memmove(ctypes.addressof(buffer), ctypes.addressof(first), ctypes.sizeof(buffer))

    def on_streamon(self, _: Any) -> None:
        self.streaming = True

    def on_streamoff(self, _: Any) -> None:
        self.streaming = False

    def fill(self, data: bytes, t_ns: int = NOW_NS, flags: int = v4l2_abi.BUF_FLAG_TIMESTAMP_MONOTONIC) -> None:
        """A frame arrives; without a free buffer it is lost."""
        self.sequence += 1
        if not self.queued:
            return
        index = self.queued.popleft()
        with self.device.open("r+b") as file:
            file.seek(PAGE * index)
            file.write(data)
        buffer = v4l2_abi.Buffer(index=index, bytesused=len(data), flags=flags, sequence=self.sequence)
        buffer.timestamp.sec, buffer.timestamp.usec = t_ns // 1_000_000_000, t_ns % 1_000_000_000 // 1000
        self.filled.append(buffer)

    def poll(self) -> Any:
        driver = self

        class Poll:
            def register(self, fd: int, events: int) -> None:
                self.fd = fd

            def poll(self, timeout_ms: float) -> list[tuple[int, int]]:
                return [(self.fd, select.POLLIN)] if driver.filled or driver.gone else []

        return Poll()


@pytest.fixture
def driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Driver:
    driver = Driver()
    driver.device = tmp_path / "video0"
    driver.device.write_bytes(b"")
    monkeypatch.setattr(v4l2_abi, "ioctl", driver.ioctl)
    monkeypatch.setattr(v4l2.select, "poll", driver.poll)
    return driver


def camera(driver: Driver, **settings: Any) -> V4l2Camera:
    wanted = V4l2Settings(**{"device": str(driver.device), "width_px": 64, "height_px": 48, "rate_hz": 30.0, **settings})
    return V4l2Camera(wanted, monotonic_ns=lambda: NOW_NS)


def jpeg(level: int) -> bytes:
    ok, data = cv2.imencode(".jpg", np.full((48, 64, 3), level, np.uint8))
    assert ok
    return bytes(data.tobytes())


def test_the_format_that_reaches_the_rate_is_taken(driver: Driver) -> None:
    one = camera(driver)
    one.open()
    assert one.layout == Layout(fourcc="MJPG", width_px=64, height_px=48, stride=0, rate_hz=30.0)
    assert driver.streaming
    slow = camera(driver, rate_hz=5.0)
    slow.open()
    assert slow.layout is not None
    assert slow.layout.fourcc == "YUYV"  # without compression where it is fast enough


def test_the_fastest_is_taken_where_none_reaches_the_rate(driver: Driver) -> None:
    one = camera(driver, rate_hz=60.0)
    one.open()
    assert one.layout is not None
    assert (one.layout.fourcc, one.layout.rate_hz, driver.now) == ("MJPG", 30.0, "MJPG")


def test_the_newest_frame_wins_and_every_buffer_goes_back(driver: Driver) -> None:
    one = camera(driver)
    one.open()
    for level in (10, 60, 120):
        driver.fill(jpeg(level), t_ns=NOW_NS - 10_000_000 + level)
    captured = one.read(0.1)
    assert captured is not None
    assert captured.index == 3
    assert captured.t_ns == NOW_NS - 10_000_000  # to the microsecond
    image = captured.decode()
    assert image is not None
    assert abs(int(image.mean()) - 120) <= 2
    assert sorted(driver.queued) == [0, 1, 2, 3]
    assert one.read(0.0) is None
    driver.fill(jpeg(200))
    assert abs(int(captured.decode().mean()) - 120) <= 2  # type: ignore[union-attr]  # its bytes are its own


def test_equal_frames_have_equal_fingerprints(driver: Driver) -> None:
    one = camera(driver)
    one.open()
    prints = []
    for level in (10, 10, 11):
        driver.fill(jpeg(level))
        captured = one.read(0.1)
        assert captured is not None
        prints.append(captured.fingerprint)
    assert prints[0] == prints[1] != prints[2]


def test_a_frame_that_the_kernel_calls_damaged_is_garbled(driver: Driver) -> None:
    one = camera(driver)
    one.open()
    driver.fill(jpeg(10), flags=v4l2_abi.BUF_FLAG_TIMESTAMP_MONOTONIC | v4l2_abi.BUF_FLAG_ERROR)
    captured = one.read(0.1)
    assert captured is not None
    assert captured.decode() is None


def test_an_unplugged_camera_raises_and_can_be_closed_and_opened_again(driver: Driver) -> None:
    one = camera(driver)
    one.open()
    driver.gone = True
    with pytest.raises(DeviceError, match="failed"):
        one.read(0.1)
    one.close()
    one.close()
    with pytest.raises(DeviceError, match="no camera"):
        one.open()
    one.close()
    driver.gone = False
    driver.queued.clear()
    one.open()
    driver.fill(jpeg(10))
    assert one.read(0.1) is not None


def test_exposure_gain_and_focus_are_locked_and_a_refusal_is_told(driver: Driver, caplog: pytest.LogCaptureFixture) -> None:
    one = camera(driver, exposure_us=5000.0, gain=20.0, focus=0.0)
    one.open()
    assert driver.controls == {
        v4l2_abi.CID_EXPOSURE_AUTO: 1,
        v4l2_abi.CID_EXPOSURE_ABSOLUTE: 50,
        v4l2_abi.CID_AUTOGAIN: 0,
        v4l2_abi.CID_GAIN: 20,
        v4l2_abi.CID_FOCUS_AUTO: 0,
    }
    assert ["camera.focus" in record.message for record in caplog.records if record.levelname == "WARNING"] == [True]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"formats": {"YUYV": ((32, 24), 30.0)}}, r"does not give 64x48, but YUYV 32x24"),
        ({"formats": {"BA81": ((64, 48), 30.0)}}, r"offers BA81.*raw sensor"),
        ({"formats": {}}, r"offers nothing"),
        ({"caps": v4l2_abi.CAP_STREAMING}, r"no capture node"),
    ],
)
def test_what_cannot_be_used_says_why(driver: Driver, change: dict[str, Any], message: str) -> None:
    for name, value in change.items():
        setattr(driver, name, value)
    with pytest.raises(DeviceError, match=message):
        camera(driver).open()


def test_a_missing_node_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"set camera\.device"):
        V4l2Camera(V4l2Settings(device=str(tmp_path / "video9"), width_px=1, height_px=1, rate_hz=1)).open()
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    with pytest.raises(DeviceError, match="is no camera"):
        V4l2Camera(V4l2Settings(device=str(plain), width_px=1, height_px=1, rate_hz=1)).open()


@pytest.mark.parametrize(
    ("flags", "t_ns", "expected_ns"),
    [
        (v4l2_abi.BUF_FLAG_TIMESTAMP_MONOTONIC, NOW_NS - 30_000_000, NOW_NS - 30_000_000),
        (v4l2_abi.BUF_FLAG_TIMESTAMP_MONOTONIC, NOW_NS + 1_000_000, NOW_NS),  # from the future
        (v4l2_abi.BUF_FLAG_TIMESTAMP_MONOTONIC, 0, NOW_NS),
        (0, NOW_NS - 30_000_000, NOW_NS),  # of a clock that is not known
    ],
)
def test_only_a_monotonic_and_plausible_stamp_counts(flags: int, t_ns: int, expected_ns: int) -> None:
    buffer = v4l2_abi.Buffer(flags=flags)
    buffer.timestamp.sec, buffer.timestamp.usec = t_ns // 1_000_000_000, t_ns % 1_000_000_000 // 1000
    assert stamp_ns(buffer, NOW_NS) == expected_ns


def picture() -> np.ndarray[Any, np.dtype[np.uint8]]:
    ramp = np.linspace(40, 210, 64).astype(np.uint8)
    return np.dstack([np.tile(ramp, (48, 1)), np.full((48, 64), 90, np.uint8), np.tile(ramp[::-1], (48, 1))])


def packed(code: str, padding: int) -> tuple[bytes, int]:
    """The picture in a device's format, rows padded; and its stride."""
    bgr = picture()
    if code in ("BGR3", "RGB3"):
        rows = bgr if code == "BGR3" else bgr[..., ::-1]
        rows = rows.reshape(48, -1)
    elif code == "GREY":
        rows = bgr[..., 0]
    else:
        i420 = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420)
        luma, u, v = i420[:48], i420[48:60].reshape(24, 32), i420[60:].reshape(24, 32)
        if code == "YU12":
            return i420.tobytes(), 64
        if code == "NV12":
            rows = np.vstack([luma, np.dstack([u, v]).reshape(24, 64)])
        else:
            chroma = np.dstack([np.repeat(u, 2, axis=0), np.repeat(v, 2, axis=0)]).reshape(48, 64)
            pair = [luma, chroma] if code == "YUYV" else [chroma, luma]
            rows = np.dstack(pair).reshape(48, 128)
    rows = np.pad(np.ascontiguousarray(rows), ((0, 0), (0, padding)), constant_values=255)
    return rows.tobytes(), rows.shape[1]


@pytest.mark.parametrize("padding", [0, 24])
@pytest.mark.parametrize("code", ["YUYV", "UYVY", "NV12", "YU12", "BGR3", "RGB3", "GREY"])
def test_every_format_gives_the_picture_back(code: str, padding: int) -> None:
    data, stride = packed(code, padding)
    layout = Layout(fourcc=code, width_px=64, height_px=48, stride=stride, rate_hz=30.0)
    image = decode(data, layout)
    assert image is not None
    expected = picture()[..., 0] if code == "GREY" else picture()
    assert np.abs(image.astype(int) - expected).mean() < 3
    assert decode(data[: len(data) - stride - 1], layout) is None  # a row is missing


def test_a_cut_off_jpeg_is_not_half_a_picture() -> None:
    layout = Layout(fourcc="MJPG", width_px=64, height_px=48, stride=0, rate_hz=30.0)
    whole = jpeg(100)
    assert decode(whole, layout) is not None
    assert decode(whole + bytes(20), layout) is not None  # some cameras pad
    assert decode(whole[: len(whole) // 2], layout) is None
    assert decode(b"", layout) is None
