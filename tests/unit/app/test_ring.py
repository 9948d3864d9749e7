"""The ring: parts that replay as one drive, limits, disks that fail and come back."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from msgspec.structs import replace

from tmde_edge.app import ring as ring_module
from tmde_edge.app.drive_log import DriveLogReader
from tmde_edge.app.replay import replay
from tmde_edge.app.ring import Ring, parts_before, prune, segments
from tmde_edge.config import RecordConfig
from tmde_edge.errors import InputDataError
from tmde_edge.messages import CanFrame, Event, Output, Tick

S = 1_000_000_000


class Clock:
    ns = 50 * S

    def __call__(self) -> int:
        return self.ns


class Counter:
    """A decider with state: answers each tick with the number of ticks so far."""

    def __init__(self) -> None:
        self.seen = 0

    def step(self, event: Event) -> tuple[Output, ...]:
        self.seen += 1
        return (CanFrame(t_ns=event.t_ns, can_id=1, data=self.seen.to_bytes(4, "big")),)


def make(folder: Path, clock: Clock, **changes: object) -> Ring:
    settings = replace(RecordConfig(folder=str(folder), enabled=True, min_free_mb=0), **changes)
    return Ring(settings, {"a": 1}, monotonic_ns=clock, wall_ns=lambda: 1_700_000_000 * S + clock())


def feed(ring: Ring, clock: Clock, decider: Counter, seconds: float) -> None:
    for _ in range(round(seconds * 10)):
        clock.ns += S // 10
        tick = Tick(t_ns=clock.ns)
        ring.write(tick, decider.step(tick))


def test_a_drive_of_several_parts_replays_as_one(tmp_path: Path) -> None:
    clock, decider = Clock(), Counter()
    ring = make(tmp_path, clock, segment_s=2.0)
    feed(ring, clock, decider, 7)
    ring.close()
    parts = segments(tmp_path)
    assert [s.number for s in parts] == [0, 1, 2, 3]
    assert [DriveLogReader(s.path).part.begins for s in parts] == ["start", "continued", "continued", "continued"]
    outcome = replay(parts[-1].path, lambda _: Counter())
    assert outcome.difference is None
    assert outcome.events == 70
    assert replay(parts[0].path, lambda _: Counter()).events < 25
    parts[1].path.unlink()
    with pytest.raises(InputDataError, match="part 1 of drive 1"):
        replay(parts[-1].path, lambda _: Counter())


def test_the_next_drive_has_the_next_number_whatever_the_clock_says(tmp_path: Path) -> None:
    for expected, year_s in ((1, 1_700_000_000), (2, 0), (3, 900_000_000)):  # a board without a battery begins in the past
        clock = Clock()
        settings = RecordConfig(folder=str(tmp_path), enabled=True, min_free_mb=0, max_age_days=1e6)
        ring = Ring(settings, {}, monotonic_ns=clock, wall_ns=lambda s=year_s: s * S)  # type: ignore[misc]
        feed(ring, clock, Counter(), 0.5)
        ring.close()
        assert segments(tmp_path)[-1].drive == expected


def test_size_and_age_remove_the_oldest_and_never_the_one_being_written(tmp_path: Path) -> None:
    for i in range(6):
        path = tmp_path / f"000001-20260101T000000Z-{i:04d}.mcap"
        path.write_bytes(bytes(1_000_000))
        os.utime(path, (1000.0 + i, 1000.0 + i))
    (tmp_path / "notes.txt").write_text("mine")
    keep = tmp_path / "000001-20260101T000000Z-0005.mcap"
    gone = prune(tmp_path, max_mb=4.5, max_age_days=365, wall_s=2000, keep=keep)
    assert [p.name[-9:-5] for p in gone] == ["0000", "0001"]
    gone = prune(tmp_path, max_mb=4.5, max_age_days=1, wall_s=1003.5 + 86400, keep=keep)
    assert [p.name[-9:-5] for p in gone] == ["0002", "0003"]
    prune(tmp_path, max_mb=0.1, max_age_days=1e-9, wall_s=1e9, keep=keep)
    assert sorted(p.name for p in tmp_path.iterdir()) == [keep.name, "notes.txt"]


def test_a_disk_that_fills_up_costs_nothing_of_before_and_recording_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, decider = Clock(), Counter()
    ring = make(tmp_path, clock)
    feed(ring, clock, decider, 3)
    ring.flush()
    real, full = ring_module.DriveLogWriter.write, True

    def write(self: object, *step: object) -> None:
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(self, *step)  # type: ignore[arg-type]

    monkeypatch.setattr(ring_module.DriveLogWriter, "write", write)
    feed(ring, clock, decider, 2)
    assert ring.problem == "No space left on device"
    first = DriveLogReader(segments(tmp_path)[0].path)
    assert len(list(first.entries())) == 30
    full = False
    feed(ring, clock, decider, 20)
    assert ring.problem is None
    ring.close()
    last = DriveLogReader(segments(tmp_path)[-1].path)
    assert last.part.begins == "gap"
    assert len(list(last.entries())) > 100
    with pytest.raises(InputDataError, match="steps are missing"):
        replay(segments(tmp_path)[-1].path, lambda _: Counter())


def test_it_stops_before_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, free = Clock(), [1000.0]
    monkeypatch.setattr(ring_module, "free_mb", lambda folder: free[0])
    ring = make(tmp_path, clock, min_free_mb=200)
    feed(ring, clock, Counter(), 6)
    free[0] = 150.0
    feed(ring, clock, Counter(), 11)
    assert "only 150 MB free" in str(ring.problem)
    free[0] = 300.0
    feed(ring, clock, Counter(), 6)
    assert ring.problem is None


def test_a_folder_that_cannot_be_written_is_a_problem_not_a_crash(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    clock = Clock()
    ring = make(tmp_path / "file" / "drives", clock)
    feed(ring, clock, Counter(), 1)
    assert ring.problem is not None
    ring.close()


def test_a_hole_in_the_steps_begins_a_new_part(tmp_path: Path) -> None:
    clock, decider = Clock(), Counter()
    ring = make(tmp_path, clock)
    feed(ring, clock, decider, 1)
    ring.lost()
    feed(ring, clock, decider, 1)
    ring.close()
    assert [DriveLogReader(s.path).part.begins for s in segments(tmp_path)] == ["start", "gap"]


def test_a_single_log_needs_nothing_before_it(tmp_path: Path) -> None:
    assert parts_before(tmp_path / "mine.mcap") == [tmp_path / "mine.mcap"]
