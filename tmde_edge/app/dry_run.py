"""The desk: a recording through perception and estimation on source time. No camera, no bus, no clock: deterministic."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from tmde_edge.adapters.cameras.sources import FrameSource
from tmde_edge.adapters.cameras.video_file import SourceError
from tmde_edge.app.can_times import CanTimeline
from tmde_edge.app.eyes import Eyes
from tmde_edge.app.records import Record, error_record, frame_record
from tmde_edge.errors import InputDataError
from tmde_edge.estimation import Estimation
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import CanFrame, DepthReading, Event, Frame, FrameResult, Output, Sighting, Tick


class DepthSource(Protocol):
    """Relative depth on source time with a fixed latency."""

    def submit(self, frame: Frame) -> None:
        """Offers a frame; the source takes it at its own rate."""
        ...

    def ready(self, t_ns: int) -> Iterable[DepthReading]:
        """Readings that are available by t_ns, in order."""
        ...


class EventLog(Protocol):
    """Takes every input and output in decision order (the drive log)."""

    def write(self, event: Event, outputs: tuple[Output, ...], frame: Frame | None = None) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """What one frame of the source gave: its record, and what a sink may want beside it."""

    record: Record
    frame: Frame | None
    result: FrameResult | None
    sighting: Sighting | None
    can_out: tuple[CanFrame, ...]  # all frames sent since the last step


def dry_run(
    source: FrameSource,
    eyes: Eyes,
    estimation: Estimation,
    *,
    camera: Camera | None,
    can: CanTimeline | None = None,
    depth: DepthSource | None = None,
    log: EventLog | None = None,
    tick_hz: float = 20.0,
) -> Iterator[Step]:
    """Yields one Step a frame. Raises InputDataError where nothing of the source could be used."""
    tick_ns = round(1e9 / tick_hz)
    next_tick_ns = 0
    sent: list[CanFrame] = []
    misfit: str | None = None
    usable = False

    def step(event: Event, frame: Frame | None = None) -> FrameResult | None:
        outputs = estimation.step(event)
        if log is not None:
            log.write(event, outputs, frame)
        sent.extend(o for o in outputs if isinstance(o, CanFrame))
        return next((o for o in outputs if isinstance(o, FrameResult)), None)

    for item in source:
        # Between frames time passes as on the road: CAN in order of arrival, ticks at their rate.
        while next_tick_ns < item.t_ns:
            if can is not None:
                for received in can.until(next_tick_ns):
                    step(received)
            step(Tick(t_ns=next_tick_ns))
            next_tick_ns += tick_ns
        if can is not None:
            for received in can.until(item.t_ns):
                step(received)
        if depth is not None:
            for reading in depth.ready(item.t_ns):
                step(reading)
        if isinstance(item, SourceError):
            yield _taken(Step(record=error_record(item.index, item.t_ns, item.message), frame=None, result=None,
                              sighting=None, can_out=()), sent)  # fmt: skip
            continue
        wrong_size = size_error(camera, item.image.shape[1], item.image.shape[0])
        if wrong_size is not None:
            misfit = misfit or wrong_size
            yield _taken(Step(record=error_record(item.index, item.t_ns, wrong_size), frame=item, result=None, sighting=None,
                              can_out=()), sent)  # fmt: skip
            continue
        if depth is not None:
            depth.submit(item)
        sighting = eyes.see(item)
        usable = True
        result = step(sighting, item)
        if result is None:
            raise RuntimeError("estimation gave no result for a sighting")
        yield _taken(Step(record=frame_record(result, sighting, sighting.timing_ms), frame=item, result=result,
                          sighting=sighting, can_out=()), sent)  # fmt: skip
    if misfit is not None and not usable:
        raise InputDataError(f"{source.name}: not one frame could be used: {misfit}")


def _taken(step: Step, sent: list[CanFrame]) -> Step:
    out = tuple(sent)
    sent.clear()
    return Step(record=step.record, frame=step.frame, result=step.result, sighting=step.sighting, can_out=out)


def size_error(camera: Camera | None, width_px: int, height_px: int) -> str | None:
    """Why an image of this size does not fit the calibration; None when it does."""
    if camera is None:
        return None
    try:
        camera.scaled_to(width_px, height_px)
    except (ValueError, InputDataError) as e:
        return str(e)
    return None
