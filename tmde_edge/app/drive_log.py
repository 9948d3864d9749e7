"""The drive log: an MCAP file of JSON messages (Foxglove opens it) in decision order, floats exact.

One channel a message type. `/config` comes first; then every input, directly followed by the outputs it caused. A long drive
is a row of such files (app/ring.py): `/config` says which part of which drive a file is.
"""

from __future__ import annotations

import base64
import contextlib
import os
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, TypeAlias, get_args, get_origin, get_type_hints

import mcap.exceptions
import msgspec
import numpy as np
import zstandard
from mcap.records import Channel, Message
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, Writer

from tmde_edge import __version__
from tmde_edge.errors import InputDataError, InputMissingError
from tmde_edge.messages import CanFrame, DepthReading, Event, FrameResult, Output, RangeReference, Sighting, Tick

INPUTS: dict[type[Any], str] = {Sighting: "/sighting", CanFrame: "/can_rx", DepthReading: "/depth", Tick: "/tick"}
OUTPUTS: dict[type[Any], str] = {FrameResult: "/frame_result", CanFrame: "/can_tx"}
CONFIG, IMAGE, REFERENCE = "/config", "/image", "/range_reference"
_BY_TOPIC: dict[str, type[Any]] = {topic: kind for kind, topic in (*INPUTS.items(), *OUTPUTS.items())}
# What a cut-off or damaged end of a file makes the reader raise.
_TORN = (
    *(mcap.exceptions.McapError, CRCValidationError, zstandard.ZstdError, struct.error),
    *(EOFError, ValueError, RuntimeError, MemoryError, OverflowError),
)
Json: TypeAlias = dict[str, Any]
Begins: TypeAlias = Literal["start", "continued", "gap", "cut"]


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One step: the input and what was decided on it. `complete` is False for a step that a power cut may have torn."""

    event: Event
    outputs: tuple[Output, ...]
    complete: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Which part of a drive a file is. A replay needs every part from segment 0 on, and no gap."""

    drive: int = 0
    segment: int = 0
    begins: Begins = "start"  # gap: steps were lost before; cut: taken out of a drive
    wall_ns: int = 0  # UTC and monotonic time of one moment: what the clock on the wall said at a t_ns
    monotonic_ns: int = 0


class DriveLogWriter:
    """Writes a drive log; what is older than `flush_s` survives a power cut. Raises OSError when the disk refuses."""

    def __init__(self, path: Path, config: Json, *, part: Part | None = None, flush_s: float = 0.5) -> None:
        self._stream: IO[bytes] = path.open("wb")
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._encoder = msgspec.json.Encoder(enc_hook=_plain_number)
        self._flush_s = flush_s
        self._flushed_s = time.monotonic()
        self._log_time_ns = 0
        self._sequence = 0
        try:
            self._writer.start(profile="", library=f"tmde-edge {__version__}")
            self._channels = {
                topic: self._channel(topic, f"tmde_edge.{kind.__name__}", json_schema(kind)) for topic, kind in _BY_TOPIC.items()
            }
            self._channels[CONFIG] = self._channel(CONFIG, "tmde_edge.Config", {"type": "object", "properties": {}})
            head = {"version": __version__, "config": config, "part": msgspec.to_builtins(part or Part())}
            self._put(CONFIG, 0, msgspec.json.encode(head))
            self.flush()
            _sync_folder(path.parent)  # or a power cut may lose the name of the file
        except OSError:
            self.abandon()
            raise

    def __enter__(self) -> DriveLogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def bytes_written(self) -> int:
        """Size of the file so far."""
        return self._stream.tell()

    def write(self, event: Event, outputs: tuple[Output, ...]) -> None:
        """Logs one step."""
        self._put(INPUTS[type(event)], event.t_ns, self._encoder.encode(event))
        for output in outputs:
            self._put(OUTPUTS[type(output)], output.t_ns, self._encoder.encode(output))
        self._flush_when_due()

    def picture(self, t_ns: int, jpeg: bytes) -> None:
        """Adds the picture of a frame. It may come later than its sighting; viewers sort by its time."""
        if IMAGE not in self._channels:
            self._channels[IMAGE] = self._channel(IMAGE, "foxglove.CompressedImage", _COMPRESSED_IMAGE)
        stamp = {"sec": t_ns // 1_000_000_000, "nsec": t_ns % 1_000_000_000}
        image = {"timestamp": stamp, "frame_id": "camera", "data": jpeg, "format": "jpeg"}  # bytes become base64
        self._put(IMAGE, t_ns, self._encoder.encode(image), in_order=False)
        self._flush_when_due()

    def reference(self, reference: RangeReference) -> None:
        """Adds what another instrument measured."""
        if REFERENCE not in self._channels:
            self._channels[REFERENCE] = self._channel(REFERENCE, "tmde_edge.RangeReference", json_schema(RangeReference))
        self._put(REFERENCE, reference.t_ns, self._encoder.encode(reference), in_order=False)
        self._flush_when_due()

    def _flush_when_due(self) -> None:
        if time.monotonic() - self._flushed_s >= self._flush_s:
            self.flush()

    def flush(self) -> None:
        """Ends the chunk and hands all of it to the disk."""
        # The library ends a chunk only by size; a quiet drive would lose minutes.
        self._writer._Writer__finalize_chunk()
        self._stream.flush()
        os.fdatasync(self._stream.fileno())
        self._flushed_s = time.monotonic()

    def close(self) -> None:
        """Writes the index and closes; closing twice is harmless."""
        if self._stream.closed:
            return
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()

    def abandon(self) -> None:
        """Lets the file go as it is, after an error of the disk."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def _channel(self, topic: str, name: str, schema: Json) -> int:
        schema_id = self._writer.register_schema(name, "jsonschema", msgspec.json.encode(schema))
        channel_id: int = self._writer.register_channel(topic, "json", schema_id)
        return channel_id

    def _put(self, topic: str, t_ns: int, data: bytes, *, in_order: bool = True) -> None:
        # Viewers sort by log time: for steps it must not run backwards, for file order is decision order.
        log_time_ns = max(t_ns, 0)
        if in_order:
            log_time_ns = self._log_time_ns = max(self._log_time_ns, t_ns)
        self._writer.add_message(self._channels[topic], log_time_ns, data, max(t_ns, 0), self._sequence)
        self._sequence += 1


class DriveLogReader:
    """Reads a drive log in decision order; a torn end is left out and told by `torn` once all was read.

    Raises InputMissingError (no such file) or InputDataError (not a drive log).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.torn: str | None = None
        if not path.is_file():
            raise InputMissingError(f"{path}: no such drive log")
        first = next(self._messages(), None)
        if first is None or first[0] != CONFIG:
            raise InputDataError(f"{path}: not a drive log of tmde-edge{f' ({self.torn})' if self.torn else ''}")
        head = self._decode(first[1], Json)
        self.version = str(head.get("version", ""))
        self.config: Json = head.get("config", {})
        self.part: Part = msgspec.convert(head.get("part", {}), Part)

    def entries(self) -> Iterator[LogEntry]:
        """Every step in order. Raises InputDataError for a message that is not what its channel promises."""
        event: Event | None = None
        outputs: list[Output] = []
        for topic, data in self._messages():
            if topic in (CONFIG, IMAGE) or topic not in _BY_TOPIC:
                continue
            message = self._decode(data, _BY_TOPIC[topic])
            if topic in OUTPUTS.values():
                if event is None:
                    raise InputDataError(f"{self._path}: an output stands before the first input")
                outputs.append(message)
                continue
            if event is not None:
                yield LogEntry(event, tuple(outputs))
            event, outputs = message, []
        if event is not None:
            yield LogEntry(event, tuple(outputs), complete=self.torn is None)

    def images(self) -> Iterator[tuple[int, bytes]]:
        """The recorded pictures as (t_ns, JPEG bytes)."""
        for topic, data in self._messages():
            if topic == IMAGE:
                image = self._decode(data, Json)
                stamp = image["timestamp"]
                yield stamp["sec"] * 1_000_000_000 + stamp["nsec"], base64.b64decode(image["data"])

    def references(self) -> Iterator[RangeReference]:
        """What another instrument measured, in order."""
        for topic, data in self._messages():
            if topic == REFERENCE:
                yield self._decode(data, RangeReference)

    def _messages(self) -> Iterator[tuple[str, bytes]]:
        self.torn = None
        topics: dict[int, str] = {}
        try:
            with self._path.open("rb") as stream:
                for record in StreamReader(stream, validate_crcs=True).records:
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, Message):
                        yield topics.get(record.channel_id, ""), record.data
        except _TORN as error:
            self.torn = f"the end is torn: {type(error).__name__} {error}".strip()
        except OSError as error:
            raise InputDataError(f"{self._path}: cannot be read ({error.strerror or error})") from None

    def _decode(self, data: bytes, kind: Any) -> Any:
        try:
            return msgspec.json.decode(data, type=kind)
        except msgspec.MsgspecError as error:
            raise InputDataError(f"{self._path}: unreadable message ({error}); was it written by another version?") from error


def _sync_folder(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def json_schema(kind: Any) -> Json:
    """JSON schema of a message in the subset that viewers understand: no references, unions or arrays of arrays."""
    if hasattr(kind, "__dataclass_fields__"):
        hints = get_type_hints(kind)
        fields = {name: json_schema(hints[name]) for name in kind.__dataclass_fields__}
        return {"type": "object", "title": kind.__name__, "properties": {k: v for k, v in fields.items() if v}}
    simple = {bool: "boolean", int: "integer", float: "number", str: "string"}
    if kind in simple:
        return {"type": simple[kind]}
    if kind is bytes:
        return {"type": "string", "contentEncoding": "base64"}
    arguments = [a for a in get_args(kind) if a is not type(None)]
    if get_origin(kind) is tuple:
        items = json_schema(arguments[0])
        return {"type": "array", "items": items} if items and items["type"] != "array" else {}
    if get_origin(kind) is dict:
        return {"type": "object", "properties": {}}
    if isinstance(arguments[0], str):  # Literal
        return {"type": "string"}
    return json_schema(arguments[0])  # Optional


def _plain_number(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} in a message")


_COMPRESSED_IMAGE: Json = {
    "type": "object",
    "title": "foxglove.CompressedImage",
    "properties": {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
        },
        "frame_id": {"type": "string"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": {"type": "string"},
    },
}
