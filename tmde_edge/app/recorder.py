"""What is recorded of a drive: the ring of drive logs, the evidence of warnings, the odometer; and the desk's single log."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from tmde_edge.app.drive_log import DriveLogWriter, Json
from tmde_edge.app.incident import Evidence
from tmde_edge.app.odometer import Odometer
from tmde_edge.app.privacy import FrameKeeper
from tmde_edge.app.ring import Ring
from tmde_edge.config import Config, RecordConfig
from tmde_edge.errors import writing
from tmde_edge.messages import Event, Frame, FrameResult, Output, RangeReference, Sighting, Tick


def frame_keeper(settings: RecordConfig) -> FrameKeeper:
    """The frames to keep, unreadable plates unless `record.blur = false`."""
    return FrameKeeper(rate_hz=settings.frames_hz, quality=settings.jpeg_quality, blur=settings.blur)


class SingleLog:
    """One drive log with its frames, for the desk (`--record`). Raises UsageError when the disk refuses."""

    def __init__(self, path: Path, config: Json, keeper: FrameKeeper | None) -> None:
        """`config`: what a drive log keeps of the configuration (wiring.log_config)."""
        self._path, self._keeper = path, keeper
        with writing(path):
            self._writer = DriveLogWriter(path, config)

    def __enter__(self) -> SingleLog:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            with writing(self._path):
                if self._keeper is not None:
                    for t_ns, jpeg in self._keeper.rest():
                        self._writer.picture(t_ns, jpeg)
                self._writer.close()
        finally:
            self._writer.abandon()  # where it could not be finished

    def write(self, event: Event, outputs: tuple[Output, ...], frame: Frame | None = None) -> None:
        """Logs one step."""
        with writing(self._path):
            self._writer.write(event, outputs)
            if self._keeper is not None and isinstance(event, Sighting):
                for t_ns, jpeg in self._keeper.take(event, frame):
                    self._writer.picture(t_ns, jpeg)


class Recorder:
    """Ring, evidence and odometer of the service, each where it is configured. Used by one thread; never raises OSError."""

    def __init__(
        self,
        settings: RecordConfig,
        config: Json,
        *,
        transmits: bool,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """`config`: what a drive log keeps of the configuration (wiring.log_config)."""
        self._s = settings
        self.ring = Ring(settings, config, monotonic_ns=monotonic_ns, wall_ns=wall_ns) if settings.enabled else None
        wanted = keeps_evidence(settings, transmits)
        self.evidence = Evidence(settings, config, transmits=transmits, wall_ns=wall_ns) if wanted else None
        self._odometer = (
            Odometer(Path(settings.folder), transmits=transmits, monotonic_ns=monotonic_ns, wall_ns=wall_ns) if wanted else None
        )
        self._keeper = frame_keeper(settings) if wanted or (settings.enabled and settings.frames) else None

    @property
    def problem(self) -> str | None:
        """Why something is not recorded; None: all is well."""
        problems = (part.problem for part in (self.ring, self.evidence, self._odometer) if part is not None)
        return next((p for p in problems if p is not None), None)

    @property
    def keeps_frames(self) -> bool:
        """Whether it has a use for pictures."""
        return self._keeper is not None

    def write(self, event: Event, outputs: tuple[Output, ...], frame: Frame | None = None) -> None:
        """Takes one step."""
        if self.ring is not None:
            self.ring.write(event, outputs)
        if self.evidence is not None:
            self.evidence.write(event, outputs)
        if self._odometer is not None:
            if isinstance(event, Tick):
                self._odometer.wait(event.t_ns)
            for output in outputs:
                if isinstance(output, FrameResult):
                    self._odometer.take(output)
        if self._keeper is not None and isinstance(event, Sighting):
            self._keep(self._keeper.take(event, frame))

    def reference(self, reference: RangeReference) -> None:
        """Takes what another instrument measured."""
        if self.ring is not None:
            self.ring.reference(reference)
        if self.evidence is not None:
            self.evidence.reference(reference)

    def lost(self) -> None:
        """Steps were lost on the way here."""
        if self.ring is not None:
            self.ring.lost()

    def idle(self) -> None:
        """Nothing came for a moment."""

    def close(self) -> None:
        """Finishes every file."""
        if self._keeper is not None:
            self._keep(self._keeper.rest())
        for part in (self.ring, self.evidence, self._odometer):
            if part is not None:
                part.close()

    def _keep(self, pictures: list[tuple[int, bytes]]) -> None:
        for t_ns, jpeg in pictures:
            if self.ring is not None and self._s.frames:
                self.ring.picture(t_ns, jpeg)
            if self.evidence is not None:
                self.evidence.picture(t_ns, jpeg)


def keeps_evidence(settings: RecordConfig, transmits: bool) -> bool:
    """Whether warnings leave their evidence: shadow mode, or incidents while transmitting, and a place to keep it.

    Shadow mode is on by itself; where no state folder was made for it (a desk, a test) it keeps nothing and is no fault.
    """
    if transmits:
        return settings.incidents
    return settings.incidents or (settings.shadow and Path(settings.folder).parent.is_dir())


def make_recorder(config: Config, kept: Json) -> Recorder | None:
    """The recorder of the service; None where nothing is to be recorded."""
    transmits = config.can.enabled and config.can.transmit
    if not config.record.enabled and not keeps_evidence(config.record, transmits):
        return None
    return Recorder(config.record, kept, transmits=transmits)
