"""The drive log keeps every input and output exactly and in order; what a power cut leaves is readable; replay compares."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from tmde_edge.app.drive_log import DriveLogReader, DriveLogWriter, Part, json_schema
from tmde_edge.app.replay import replay
from tmde_edge.errors import InputDataError, InputMissingError
from tmde_edge.messages import (
    Alert,
    CanFrame,
    DepthReading,
    Event,
    FrameResult,
    GlyphSighting,
    LeadEstimate,
    Output,
    PlateResult,
    PlateSighting,
    Pose,
    RangeReference,
    Sighting,
    Tick,
)

GLYPH = GlyphSighting(
    left_px=(1.1, 2.0), right_px=(3.3, 2.0), top_px=(2.0, 0.1), bottom_px=(2.0, 4.2), sigma_tb_px=0.1, sigma_lr_px=1 / 3
)
PLATE = PlateSighting(
    track_id=3, corners_px=((0.1, 0.2), (9.7, 0.2), (9.7, 3.0), (0.1, 3.0)), corners_sigma_px=0.1, score=0.9, glyphs=(GLYPH,)
)


def sighting(index: int) -> Sighting:
    return Sighting(
        t_ns=index * 33_333_333, frame_index=index, width_px=640, height_px=480, status="ok", plates=(PLATE,),
        timing_ms={"detect": 1.5},
    )  # fmt: skip


def result(event: Sighting, distance_m: float) -> FrameResult:
    lead = LeadEstimate(
        track_id=3, distance_m=distance_m, sigma_m=0.1, range_rate_mps=-1.0, range_rate_sigma_mps=0.2, ttc_s=4.0,
        ttc_sigma_s=0.1, headway_s=None, coasting_s=0.0, source="plate",
    )  # fmt: skip
    return FrameResult(
        t_ns=event.t_ns, frame_index=event.frame_index, plates=(PlateResult(sighting=PLATE, range=None, lead=True),),
        lead=lead, ego=None, pose=Pose(pitch_rad=0.1, roll_rad=0.0), depth=None, alert=Alert(), faults=("blind",),
        mode="strict",
    )  # fmt: skip


class Doubler:
    """A decider with state: the distance of frame i is `gain` times the number of CAN bytes seen so far."""

    def __init__(self, gain: float = 0.1) -> None:
        self.gain = gain
        self.seen = 0

    def step(self, event: Event) -> tuple[Output, ...]:
        if isinstance(event, CanFrame):
            self.seen += len(event.data)
            return ()
        if isinstance(event, Sighting):
            answer = CanFrame(t_ns=event.t_ns, can_id=0x300, data=bytes([self.seen % 256]), extended=True, channel="can0")
            return result(event, self.gain * self.seen), answer
        return ()


def events(count: int) -> list[Event]:
    out: list[Event] = []
    for i in range(count):
        out.append(CanFrame(t_ns=i * 33_333_333 - 5, can_id=0xB4, data=bytes(range(i % 9))))
        out.append(sighting(i))
        out.append(Tick(t_ns=i * 33_333_333 + 7, faults=("camera_lost",)))
        out.append(
            DepthReading(
                t_ns=i, ready_t_ns=i + 9, width_px=64, height_px=48, grid_columns=2, grid_rows=1, inverse_depth=(0.1, 2e-17)
            )
        )
    return out


def write_log(path: Path, count: int = 20, **options: Any) -> list[tuple[Event, tuple[Output, ...]]]:
    decider = Doubler()
    steps = []
    with DriveLogWriter(path, {"gain": decider.gain}, **options) as log:
        for event in events(count):
            outputs = decider.step(event)
            log.write(event, outputs)
            steps.append((event, outputs))
    return steps


def test_steps_come_back_equal_and_in_order(tmp_path: Path) -> None:
    steps = write_log(tmp_path / "d.mcap")
    reader = DriveLogReader(tmp_path / "d.mcap")
    assert reader.config == {"gain": 0.1}
    assert [(e.event, e.outputs) for e in reader.entries()] == steps
    assert reader.torn is None


@settings(max_examples=8, deadline=None)
@given(values=st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=50), t_ns=st.integers(0, 2**62))
def test_floats_survive_exactly(tmp_path_factory: pytest.TempPathFactory, values: list[float], t_ns: int) -> None:
    path = tmp_path_factory.mktemp("exact") / "d.mcap"
    event = dataclasses.replace(sighting(0), t_ns=t_ns, timing_ms={str(i): value for i, value in enumerate(values)})
    with DriveLogWriter(path, {}) as log:
        log.write(event, ())
    assert [e.event for e in DriveLogReader(path).entries()] == [event]


def test_numpy_scalars_become_plain_numbers(tmp_path: Path) -> None:
    event = dataclasses.replace(sighting(0), timing_ms={"a": np.float32(0.1), "b": np.float64(0.1)})  # type: ignore[dict-item]
    with DriveLogWriter(tmp_path / "d.mcap", {}) as log:
        log.write(event, ())
    (entry,) = DriveLogReader(tmp_path / "d.mcap").entries()
    assert isinstance(entry.event, Sighting)
    assert entry.event.timing_ms == {"a": float(np.float32(0.1)), "b": 0.1}


def test_a_common_reader_sees_json_with_schemas_and_an_index(tmp_path: Path) -> None:
    write_log(tmp_path / "d.mcap", count=3)
    with (tmp_path / "d.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.chunk_indexes
        topics = {channel.topic for channel in summary.channels.values()}
        assert topics == {"/config", "/sighting", "/can_rx", "/depth", "/tick", "/frame_result", "/can_tx"}
        first = next(m for s, c, m in reader.iter_messages(topics="/frame_result"))
        assert json.loads(first.data)["lead"]["source"] == "plate"
        log_times = [m.log_time for _, _, m in reader.iter_messages(log_time_order=False)]
        assert log_times == sorted(log_times)


def test_schemas_keep_to_what_viewers_understand() -> None:
    schema = json_schema(FrameResult)
    lead = schema["properties"]["lead"]
    assert lead["type"] == "object"
    assert lead["properties"]["ttc_s"] == {"type": "number"}
    assert schema["properties"]["faults"] == {"type": "array", "items": {"type": "string"}}
    assert "$ref" not in json.dumps(schema)
    assert "anyOf" not in json.dumps(schema)
    assert json_schema(CanFrame)["properties"]["data"] == {"type": "string", "contentEncoding": "base64"}


def test_what_is_older_than_the_flush_time_survives_a_power_cut_at_any_byte(tmp_path: Path) -> None:
    path = tmp_path / "d.mcap"
    steps = write_log(path, count=30, flush_s=0.0)  # each step is on the disk before the next
    data = path.read_bytes()
    sizes = []
    for cut in range(len(data) // 3, len(data), 997):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        reader = DriveLogReader(tmp_path / "cut.mcap")
        entries = list(reader.entries())
        assert reader.torn is not None
        assert [e.event for e in entries] == [event for event, _ in steps[: len(entries)]]
        assert [e.outputs for e in entries[:-1]] == [outputs for _, outputs in steps[: len(entries) - 1]]
        sizes.append(len(entries))
        outcome = replay(tmp_path / "cut.mcap", lambda config: Doubler(config["gain"]))
        assert outcome.difference is None
        assert outcome.torn is not None
    assert sizes == sorted(sizes)
    assert len(set(sizes)) > 10


def test_a_damaged_middle_is_noticed(tmp_path: Path) -> None:
    write_log(tmp_path / "d.mcap", count=30, flush_s=0.0)
    data = bytearray((tmp_path / "d.mcap").read_bytes())
    middle = len(data) // 3
    data[middle : middle + 40] = bytes(40)
    (tmp_path / "d.mcap").write_bytes(data)
    reader = DriveLogReader(tmp_path / "d.mcap")
    assert 0 < len(list(reader.entries())) < 120
    assert reader.torn is not None


def test_pictures_come_back_with_their_own_times(tmp_path: Path) -> None:
    with DriveLogWriter(tmp_path / "d.mcap", {}) as log:
        for i in range(4):
            log.write(sighting(i), ())
        log.picture(sighting(1).t_ns, b"jpeg bytes")  # later than its sighting
        log.reference(RangeReference(t_ns=5, distance_m=7.5, text="D=7.5m"))
        log.write(sighting(4), ())
    reader = DriveLogReader(tmp_path / "d.mcap")
    assert list(reader.images()) == [(sighting(1).t_ns, b"jpeg bytes")]
    assert list(reader.references()) == [RangeReference(t_ns=5, distance_m=7.5, text="D=7.5m")]
    assert len(list(reader.entries())) == 5


def test_a_log_says_which_part_of_which_drive_it_is(tmp_path: Path) -> None:
    part = Part(drive=3, segment=2, begins="continued", wall_ns=10, monotonic_ns=4)
    with DriveLogWriter(tmp_path / "d.mcap", {}, part=part):
        pass
    assert DriveLogReader(tmp_path / "d.mcap").part == part
    with DriveLogWriter(tmp_path / "e.mcap", {}):
        pass
    assert DriveLogReader(tmp_path / "e.mcap").part == Part()


@pytest.mark.parametrize("content", [b"", b"not an mcap file", b"\x89MCAP0\r\n"])
def test_what_is_no_drive_log_cannot_be_read(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "d.mcap").write_bytes(content)
    with pytest.raises(InputDataError, match="not a drive log"):
        DriveLogReader(tmp_path / "d.mcap")


def test_a_missing_log_is_missing_input(tmp_path: Path) -> None:
    with pytest.raises(InputMissingError):
        DriveLogReader(tmp_path / "absent.mcap")


def test_an_identical_replay_counts_what_it_compared(tmp_path: Path) -> None:
    write_log(tmp_path / "d.mcap", count=20)
    outcome = replay(tmp_path / "d.mcap", lambda config: Doubler(config["gain"]))
    assert (outcome.events, outcome.outputs, outcome.difference, outcome.torn) == (80, 40, None, None)


def test_replay_names_the_first_field_that_differs(tmp_path: Path) -> None:
    write_log(tmp_path / "d.mcap", count=20)
    difference = replay(tmp_path / "d.mcap", lambda config: Doubler(config["gain"] * (1 + 1e-7))).difference
    assert difference is not None
    assert difference.field == "FrameResult.lead.distance_m"
    assert difference.event_number == 1 + 4  # the second sighting: the first has seen no byte yet
    assert str(difference).startswith("event 5 at 0.033333 s: FrameResult.lead.distance_m: logged 0.1")
    assert replay(tmp_path / "d.mcap", lambda config: Doubler(config["gain"] * (1 + 1e-11))).difference is None


class Changed(Doubler):
    """A decider whose outputs `change` alters."""

    def __init__(self, change: Callable[[tuple[Output, ...]], tuple[Output, ...]]) -> None:
        super().__init__()
        self.change = change

    def step(self, event: Event) -> tuple[Output, ...]:
        return self.change(super().step(event))


def test_lost_outputs_and_other_bytes_are_differences_too(tmp_path: Path) -> None:
    write_log(tmp_path / "d.mcap", count=4)
    lost = replay(tmp_path / "d.mcap", lambda _: Changed(lambda outputs: outputs[:1])).difference
    assert lost is not None
    assert (lost.field, lost.expected, lost.got) == ("outputs", ["FrameResult", "CanFrame"], ["FrameResult"])

    def other(outputs: tuple[Output, ...]) -> tuple[Output, ...]:
        return tuple(dataclasses.replace(o, data=b"?") if isinstance(o, CanFrame) else o for o in outputs)

    bytes_differ = replay(tmp_path / "d.mcap", lambda _: Changed(other)).difference
    assert bytes_differ is not None
    assert bytes_differ.field == "CanFrame.data"
