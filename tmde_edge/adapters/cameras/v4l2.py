"""Live capture from a V4L2 device with the kernel's own time stamps; the newest frame wins."""

from __future__ import annotations

import ctypes
import errno
import logging
import mmap
import os
import select
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.adapters.cameras import v4l2_abi as v4l2
from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.errors import DeviceError

_log = logging.getLogger(__name__)
_BUFFERS = 4
_RATE_TOLERANCE = 0.95
_MAX_AGE_NS = 2_000_000_000  # a stamp older than this is of another clock

# In order of preference: without compression first, grey last (the networks were trained on colour).
_COLOUR_CODES: dict[str, int | None] = {
    "YUYV": cv2.COLOR_YUV2BGR_YUYV,
    "UYVY": cv2.COLOR_YUV2BGR_UYVY,
    "MJPG": None,
    "NV12": cv2.COLOR_YUV2BGR_NV12,
    "YU12": cv2.COLOR_YUV2BGR_I420,
    "BGR3": None,
    "RGB3": cv2.COLOR_RGB2BGR,
    "GREY": None,
}
# Sensor data before any image processor: libcamera's business, not ours (4 letters: packing and order of the colour filter).
RAW_BAYER = frozenset(
    f"{order}{bits}" for order in ("RG", "BG", "GB", "GR") for bits in ("10", "12", "14", "16")
) | frozenset({"RGGB", "BA81", "GBRG", "GRBG", "pRAA", "pBAA", "pGAA", "pgAA", "pRCC", "pBCC", "pGCC", "pgCC", "BYR2"})
_CONFIGURED = {"mjpg": "MJPG", "yuyv": "YUYV", "grey": "GREY"}


@dataclass(frozen=True, slots=True, kw_only=True)
class V4l2Settings:
    """What is asked of the device; None leaves the driver's own choice."""

    device: str
    width_px: int
    height_px: int
    rate_hz: float
    pixel_format: str = "auto"  # auto, mjpg, yuyv, grey
    exposure_us: float | None = None
    gain: float | None = None
    focus: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """The pixel format in force."""

    fourcc: str
    width_px: int
    height_px: int
    stride: int  # bytes a row, of the first plane
    rate_hz: float


class V4l2Camera:
    """A camera node such as /dev/video0."""

    ended = False

    def __init__(self, settings: V4l2Settings, monotonic_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._s = settings
        self._monotonic_ns = monotonic_ns
        self._fd = -1
        self._buffers: list[mmap.mmap] = []
        self._told: str | None = None
        self.layout: Layout | None = None

    @property
    def name(self) -> str:
        """The node."""
        return f"camera {self._s.device}"

    def open(self) -> None:
        """Negotiates the format, locks exposure, gain and focus, starts streaming. Raises DeviceError."""
        try:
            self._fd = os.open(self._s.device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except FileNotFoundError:
            raise DeviceError(f"{self._s.device}: no such camera; plug it in or set camera.device") from None
        except PermissionError:
            raise DeviceError(f"{self._s.device}: no permission; add the user to the group 'video'") from None
        except OSError as error:
            raise DeviceError(f"{self._s.device}: cannot be opened ({error.strerror})") from None
        try:
            self._check_kind()
            self.layout = self._negotiate()
            self._set_controls()
            self._start()
        except OSError as error:
            busy = "; another program uses it" if error.errno == errno.EBUSY else ""
            raise DeviceError(f"{self._s.device}: cannot be set up ({error.strerror}{busy})") from None
        la = self.layout
        text = f"{la.fourcc} {la.width_px}x{la.height_px} at {la.rate_hz:.4g} Hz"
        if text != self._told:
            _log.info("%s: %s", self.name, text)
        self._told = text

    def read(self, timeout_s: float) -> Captured | None:
        """The newest frame; older ones that wait in the driver are given back unread. Raises DeviceError."""
        layout = self.layout
        if self._fd < 0 or layout is None:
            raise DeviceError(f"{self._s.device}: is not open")
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        newest: Captured | None = None
        try:
            events = poll.poll(timeout_s * 1000)
            if events and events[0][1] & (select.POLLERR | select.POLLHUP | select.POLLNVAL):
                raise DeviceError(f"{self._s.device}: is gone")
            while events and (buffer := self._dequeue()) is not None:
                waiting = poll.poll(0)
                if not waiting:  # the newest: copy it out before the driver gets its memory back
                    newest = self._captured(buffer, layout)
                v4l2.ioctl(self._fd, v4l2.QBUF, buffer)
                events = waiting
        except OSError as error:
            raise DeviceError(f"{self._s.device}: failed ({error.strerror})") from None
        return newest

    def close(self) -> None:
        """Stops streaming and lets the device go."""
        if self._fd < 0:
            return
        try:
            v4l2.ioctl(self._fd, v4l2.STREAMOFF, ctypes.c_int(v4l2.BUF_TYPE_VIDEO_CAPTURE))
        except OSError as error:
            _log.debug("%s: stopping: %s", self.name, error)
        for memory in self._buffers:
            memory.close()
        self._buffers = []
        os.close(self._fd)
        self._fd = -1

    def describe(self) -> NodeInfo:
        """Opens the node, asks, closes it. Raises DeviceError."""
        try:
            self._fd = os.open(self._s.device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise DeviceError(f"{self._s.device}: cannot be opened ({error.strerror})") from None
        try:
            caps = v4l2.Capability()
            v4l2.ioctl(self._fd, v4l2.QUERYCAP, caps)
            flags = caps.device_caps if caps.capabilities & v4l2.CAP_DEVICE_CAPS else caps.capabilities
            focus_auto, exposure_auto = self._get(v4l2.CID_FOCUS_AUTO), self._get(v4l2.CID_EXPOSURE_AUTO)
            return NodeInfo(
                card=caps.card.decode(errors="replace"), driver=caps.driver.decode(errors="replace"),
                formats=tuple(self._offered()), captures=bool(flags & v4l2.CAP_VIDEO_CAPTURE),
                autofocus=None if focus_auto is None else bool(focus_auto),
                autoexposure=None if exposure_auto is None else exposure_auto != 1, focus=self._get(v4l2.CID_FOCUS_ABSOLUTE),
            )  # fmt: skip
        except OSError as error:
            raise DeviceError(f"{self._s.device}: is no camera ({error.strerror})") from None
        finally:
            os.close(self._fd)
            self._fd = -1

    def _get(self, control: int) -> int | None:
        asked = v4l2.Control(id=control)
        try:
            v4l2.ioctl(self._fd, v4l2.G_CTRL, asked)
        except OSError:
            return None
        return int(asked.value)

    # -- setting up ---------------------------------------------------------------------------------------------------

    def _check_kind(self) -> None:
        caps = v4l2.Capability()
        try:
            v4l2.ioctl(self._fd, v4l2.QUERYCAP, caps)
        except OSError:
            raise DeviceError(f"{self._s.device}: is no camera") from None
        flags = caps.device_caps if caps.capabilities & v4l2.CAP_DEVICE_CAPS else caps.capabilities
        if not flags & v4l2.CAP_VIDEO_CAPTURE or not flags & v4l2.CAP_STREAMING:
            more = " (it has several planes)" if flags & v4l2.CAP_VIDEO_CAPTURE_MPLANE else ""
            raise DeviceError(f"{self._s.device}: {caps.card.decode(errors='replace')} is no capture node that we know{more}")

    def _negotiate(self) -> Layout:
        """The first format that gives the wanted size at the wanted rate; else the fastest of the wanted size."""
        s = self._s
        offered = self._offered()
        wanted = [f for f in _COLOUR_CODES if f in offered]
        if s.pixel_format != "auto":
            wanted = [f for f in wanted if f == _CONFIGURED[s.pixel_format]]
        if not wanted:
            hint = "; a raw sensor needs libcamera" if any(f not in _COLOUR_CODES for f in offered) else ""
            raise DeviceError(
                f"{s.device}: offers {' '.join(offered) or 'nothing'}, not camera.pixel_format = {s.pixel_format!r}{hint}"
            )
        sizes: list[str] = []
        best: Layout | None = None
        for code in wanted:
            layout = self._try(code)
            if (layout.width_px, layout.height_px) != (s.width_px, s.height_px):
                sizes.append(f"{code} {layout.width_px}x{layout.height_px}")
                continue
            if layout.rate_hz >= _RATE_TOLERANCE * s.rate_hz:
                return layout
            if best is None or layout.rate_hz > best.rate_hz:
                best = layout
        if best is None:
            raise DeviceError(
                f"{s.device}: does not give {s.width_px}x{s.height_px}, but {', '.join(sizes)}; set camera.width_px and height_px"
            )
        return self._try(best.fourcc)

    def _offered(self) -> list[str]:
        found: list[str] = []
        while True:
            description = v4l2.FormatDescription(index=len(found), type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
            try:
                v4l2.ioctl(self._fd, v4l2.ENUM_FMT, description)
            except OSError:  # EINVAL: the end of the list
                return found
            found.append(v4l2.fourcc_text(description.pixelformat))

    def _try(self, code: str) -> Layout:
        s = self._s
        form = v4l2.Format(type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
        form.fmt.pix.width, form.fmt.pix.height = s.width_px, s.height_px
        form.fmt.pix.pixelformat, form.fmt.pix.field = v4l2.fourcc(code), v4l2.FIELD_NONE
        v4l2.ioctl(self._fd, v4l2.S_FMT, form)
        parameters = v4l2.StreamParameters(type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
        interval = parameters.parm.capture.timeperframe
        interval.numerator, interval.denominator = 1000, round(s.rate_hz * 1000)
        try:
            v4l2.ioctl(self._fd, v4l2.S_PARM, parameters)
            rate_hz = interval.denominator / interval.numerator if interval.numerator else s.rate_hz
        except OSError:  # a device with one rate
            rate_hz = s.rate_hz
        pix = form.fmt.pix
        got = v4l2.fourcc_text(pix.pixelformat)
        if got not in _COLOUR_CODES:
            raise DeviceError(f"{s.device}: answers {code} with {got}")
        return Layout(fourcc=got, width_px=pix.width, height_px=pix.height, stride=pix.bytesperline, rate_hz=rate_hz)

    def _set_controls(self) -> None:
        s = self._s
        if s.exposure_us is not None:
            self._control("exposure", v4l2.CID_EXPOSURE_AUTO, 1)
            self._control("exposure", v4l2.CID_EXPOSURE_ABSOLUTE, round(s.exposure_us / 100))
        else:
            self._control(None, v4l2.CID_EXPOSURE_AUTO_PRIORITY, 0)
        if s.gain is not None:
            self._control(None, v4l2.CID_AUTOGAIN, 0)
            self._control("gain", v4l2.CID_GAIN, round(s.gain))
        if s.focus is not None:
            self._control(None, v4l2.CID_FOCUS_AUTO, 0)
            self._control("focus", v4l2.CID_FOCUS_ABSOLUTE, round(s.focus))

    def _control(self, name: str | None, control: int, value: int) -> None:
        try:
            v4l2.ioctl(self._fd, v4l2.S_CTRL, v4l2.Control(id=control, value=value))
        except OSError as error:
            if name is not None and self._told is None:  # once, not at each reopening
                _log.warning("%s: camera.%s cannot be set to %d (%s)", self.name, name, value, error.strerror)

    def _start(self) -> None:
        request = v4l2.RequestBuffers(count=_BUFFERS, type=v4l2.BUF_TYPE_VIDEO_CAPTURE, memory=v4l2.MEMORY_MMAP)
        v4l2.ioctl(self._fd, v4l2.REQBUFS, request)
        for index in range(request.count):
            buffer = v4l2.Buffer(index=index, type=v4l2.BUF_TYPE_VIDEO_CAPTURE, memory=v4l2.MEMORY_MMAP)
            v4l2.ioctl(self._fd, v4l2.QUERYBUF, buffer)
            self._buffers.append(mmap.mmap(self._fd, buffer.length, mmap.MAP_SHARED, mmap.PROT_READ, offset=buffer.m.offset))
            v4l2.ioctl(self._fd, v4l2.QBUF, buffer)
        v4l2.ioctl(self._fd, v4l2.STREAMON, ctypes.c_int(v4l2.BUF_TYPE_VIDEO_CAPTURE))

    # -- frames -------------------------------------------------------------------------------------------------------

    def _dequeue(self) -> v4l2.Buffer | None:
        buffer = v4l2.Buffer(type=v4l2.BUF_TYPE_VIDEO_CAPTURE, memory=v4l2.MEMORY_MMAP)
        try:
            v4l2.ioctl(self._fd, v4l2.DQBUF, buffer)
        except BlockingIOError:
            return None
        return buffer

    def _captured(self, buffer: v4l2.Buffer, layout: Layout) -> Captured:
        data = self._buffers[buffer.index][: buffer.bytesused]
        damaged = bool(buffer.flags & v4l2.BUF_FLAG_ERROR)
        return Captured(
            t_ns=stamp_ns(buffer, self._monotonic_ns()),
            index=int(buffer.sequence),
            decode=lambda: None if damaged else decode(data, layout),
            fingerprint=zlib.crc32(data),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeInfo:
    """What a node says about itself, without streaming."""

    card: str
    driver: str
    formats: tuple[str, ...]
    captures: bool
    autofocus: bool | None  # None: it has no such control
    autoexposure: bool | None
    focus: int | None


def describe(device: str) -> NodeInfo:
    """Asks a node for its name, formats and locks. Raises DeviceError."""
    camera = V4l2Camera(V4l2Settings(device=device, width_px=640, height_px=480, rate_hz=30))
    return camera.describe()


def stamp_ns(buffer: v4l2.Buffer, now_ns: int) -> int:
    """The kernel's stamp where it is of CLOCK_MONOTONIC and plausible, else the time of reading."""
    if buffer.flags & v4l2.BUF_FLAG_TIMESTAMP_MASK == v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC:
        t_ns = int(buffer.timestamp.sec) * 1_000_000_000 + int(buffer.timestamp.usec) * 1000
        if now_ns - _MAX_AGE_NS <= t_ns <= now_ns:
            return t_ns
    return now_ns


def decode(data: bytes, layout: Layout) -> NDArray[np.uint8] | None:
    """Pixels of one frame, uint8 BGR (h, w, 3) or grey (h, w); None where bytes are missing."""
    w, h, code = layout.width_px, layout.height_px, layout.fourcc
    if code == "MJPG":
        # A cut-off JPEG would decode to a picture with a grey rest.
        if data[:2] != b"\xff\xd8" or b"\xff\xd9" not in data[-64:]:
            return None
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return None if image is None or image.shape[:2] != (h, w) else np.asarray(image, dtype=np.uint8)
    rows, row_bytes = {"NV12": (h * 3 // 2, w), "YU12": (h * 3 // 2, w), "GREY": (h, w)}.get(
        code, (h, w * (3 if code in ("BGR3", "RGB3") else 2))
    )
    stride = max(layout.stride, row_bytes)
    if code == "YU12" and stride != row_bytes:
        return None  # chroma rows have half the stride: no driver we know pads them
    if len(data) < stride * (rows - 1) + row_bytes:
        return None
    flat = np.zeros(stride * rows, np.uint8) if len(data) < stride * rows else None
    if flat is not None:
        flat[: len(data)] = np.frombuffer(data, np.uint8)
    pixels = (flat if flat is not None else np.frombuffer(data, np.uint8, stride * rows)).reshape(rows, stride)[:, :row_bytes]
    if code == "GREY":
        return np.ascontiguousarray(pixels)
    if code in ("YUYV", "UYVY"):
        pixels = pixels.reshape(h, w, 2)
    elif code in ("BGR3", "RGB3"):
        pixels = pixels.reshape(h, w, 3)
    conversion = _COLOUR_CODES[code]
    pixels = np.ascontiguousarray(pixels)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
