"""A serial port read in blocks: python-can's slcan asks for each byte by itself, at two system calls a byte.

A hundred CAN frames a second made the reading thread ask the kernel, and the interpreter's lock, 5,000 times a second: enough to
make the camera lose frames.
"""

from __future__ import annotations

from typing import Any


def open_bus(options: dict[str, Any]) -> Any:
    """python-can's bus of these options, a serial one read in blocks. Raises what python-can raises."""
    import can  # slow to import

    bus = can.Bus(**options)
    if hasattr(bus, "serialPortOrig"):  # slcan
        bus.serialPortOrig = BlockReader(bus.serialPortOrig)
    return bus


class BlockReader:
    """A pyserial port whose `read` hands out of what one call of the system brought; all else is the port's own."""

    def __init__(self, port: Any) -> None:
        self._port = port
        self._ahead = b""
        self._at = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)

    @property
    def in_waiting(self) -> int:
        """Bytes that `read` gives without waiting."""
        return len(self._ahead) - self._at or int(self._port.in_waiting)

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes; waits, as the port's own, only where it has none. Raises what the port raises."""
        if self._at >= len(self._ahead):
            # The first byte is waited for, the others of the line are there or come with the next call.
            self._ahead, self._at = self._port.read(max(1, int(self._port.in_waiting))), 0
        out = self._ahead[self._at : self._at + size]
        self._at += len(out)
        return out

    def reset_input_buffer(self) -> None:
        """Throws away what was not read."""
        self._ahead, self._at = b"", 0
        self._port.reset_input_buffer()
