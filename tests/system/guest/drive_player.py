"""Plays a rendered drive into a virtual camera and a virtual bus, in step; only Python's standard library."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
import threading
import time
from pathlib import Path

VIDIOC_S_FMT = 0xC0D05605
VIDEO_OUTPUT = 2
CAN_FRAME = struct.Struct("=IB3x8s")


class DrivePlayer:
    """Holds the first picture and the first CAN values until `go`, plays the drive once, then holds the last of both.

    Every buffer differs from the one before by a few pixels of noise, as a camera's would: else it counts as frozen.
    """

    def __init__(self, folder: Path, fps: float, width_px: int, height_px: int, device: str, channel: str) -> None:
        self.fps, self.width_px, self.height_px, self.device, self.channel = fps, width_px, height_px, device, channel
        size = 2 * width_px * height_px
        data = (folder / "frames.yuyv").read_bytes()
        self.frames = [data[i : i + size] for i in range(0, len(data), size)]
        self.messages = [_message(line) for line in (folder / "can.log").read_text().splitlines()]
        self.start_s: float | None = None  # wall clock of the first moving picture
        self._camera_on, self._bus_on, self._over = threading.Event(), threading.Event(), threading.Event()
        self._let_go = threading.Event()  # the camera's device is closed
        self._let_go.set()
        for work in (self._film, self._drive):
            threading.Thread(target=work, daemon=True).start()

    def go(self) -> float:
        """Begins the drive; returns the wall clock of its first moving picture."""
        self.start_s = time.time() + 0.2
        return self.start_s

    def hold(self) -> None:
        """Back to the first picture."""
        self.start_s = None

    def camera(self, on: bool) -> None:
        """Plugs the camera in or out; returns when the device is let go."""
        if on:
            self._camera_on.set()
        else:
            self._camera_on.clear()
            self._let_go.wait(10)

    def bus(self, on: bool) -> None:
        """The car's traffic."""
        (self._bus_on.set if on else self._bus_on.clear)()

    def close(self) -> None:
        """Stops both."""
        self._over.set()
        self.camera(False)

    def _drive_s(self) -> float:
        start_s = self.start_s
        return max(0.0, time.time() - start_s) if start_s is not None else 0.0

    def _film(self) -> None:
        while not self._over.is_set():
            if not self._camera_on.wait(0.1):
                continue
            self._let_go.clear()
            try:
                handle = os.open(self.device, os.O_RDWR)
            except OSError:
                self._let_go.set()
                time.sleep(0.2)
                continue
            try:
                _set_format(handle, self.width_px, self.height_px)
                next_s = time.monotonic()
                while self._camera_on.is_set():
                    frame = self.frames[min(int(self._drive_s() * self.fps), len(self.frames) - 1)]
                    os.write(handle, os.urandom(32) + frame[32:])
                    next_s = max(next_s + 1 / self.fps, time.monotonic() - 1 / self.fps)
                    time.sleep(max(0.0, next_s - time.monotonic()))
            except OSError as error:
                print(f"drive_player: {self.device}: {error}", flush=True)
                time.sleep(0.2)
            finally:
                os.close(handle)
                self._let_go.set()

    def _drive(self) -> None:
        firsts: dict[int, bytes] = {}
        for _, can_id, data in self.messages:
            firsts.setdefault(can_id, data)
        values, at = dict(firsts), 0
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
            bus.bind((self.channel,))
            while not self._over.is_set():
                time.sleep(0.02)
                if not self._bus_on.is_set():
                    continue
                if self.start_s is None:
                    values, at = dict(firsts), 0
                else:
                    now_s = self._drive_s()
                    while at < len(self.messages) and self.messages[at][0] <= now_s:
                        values[self.messages[at][1]] = self.messages[at][2]
                        at += 1
                for can_id, data in values.items():
                    with contextlib.suppress(OSError):  # the bus is down: a part of the test
                        bus.send(CAN_FRAME.pack(can_id, len(data), data))


def _message(line: str) -> tuple[float, int, bytes]:
    stamp, _, frame = line.split()
    can_id, data = frame.split("#")
    return float(stamp.strip("()")) - 1_700_000_000, int(can_id, 16), bytes.fromhex(data)


def _set_format(handle: int, width_px: int, height_px: int) -> None:
    form = bytearray(208)
    struct.pack_into("<I4x", form, 0, VIDEO_OUTPUT)
    yuyv = int.from_bytes(b"YUYV", "little")
    struct.pack_into("<IIIIIII", form, 8, width_px, height_px, yuyv, 1, 2 * width_px, 2 * width_px * height_px, 8)
    fcntl.ioctl(handle, VIDIOC_S_FMT, form)
