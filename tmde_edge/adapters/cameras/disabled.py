"""No camera: the same calls, no frame ever."""

from __future__ import annotations

import time

from tmde_edge.adapters.cameras.live_camera import Captured
from tmde_edge.errors import DeviceError


class DisabledCamera:
    """What `camera.kind = "disabled"` gives: a camera that is never there, so that everything else still runs."""

    name = "camera"
    ended = False

    def open(self) -> None:
        """Raises DeviceError: blindness is reported, not hidden."""
        raise DeviceError('camera.kind = "disabled": no camera is used')

    def read(self, timeout_s: float) -> Captured | None:
        """Nothing, after the time it was given."""
        time.sleep(timeout_s)
        return None

    def close(self) -> None:
        """Nothing to close."""
