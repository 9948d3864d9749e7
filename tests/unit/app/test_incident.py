"""The evidence of warnings: the seconds before and after, what the driver did, the odometer behind every rate."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import cv2
import pytest
from msgspec.structs import replace
from recorded_drive import RATE_HZ, Drive, S

from tmde_edge.app import incident as incident_module
from tmde_edge.app import recorder as recorder_module
from tmde_edge.app.drive_log import DriveLogReader, DriveLogWriter
from tmde_edge.app.incident import incident_folders
from tmde_edge.app.odometer import read_odometer
from tmde_edge.app.recorder import keeps_evidence, make_recorder
from tmde_edge.app.verdict import Moment, judge
from tmde_edge.config import Config, RecordConfig, load
from tmde_edge.messages import CanFrame, RangeReference, Tick


def info_of(folder: Path) -> dict[str, object]:
    return dict(json.loads((folder / "incident.json").read_text()))


def test_ten_seconds_before_and_after_with_frames_can_and_calibration(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    drive.run(25)
    drive.recorder.reference(RangeReference(t_ns=drive.now_ns, distance_m=12.1, text="12.1"))
    drive.run(1.0, "warning")
    drive.run(12)
    (folder,) = incident_folders(tmp_path)
    info = info_of(folder)
    assert (info["level"], info["transmitted"], info["complete"]) == ("warning", False, True)
    reader = DriveLogReader(folder / "drive.mcap")
    entries = list(reader.entries())
    t_s = [(e.event.t_ns - 100 * S) / S for e in entries]
    assert min(t_s) == pytest.approx(25 - 10, abs=0.2)
    assert max(t_s) == pytest.approx(25 + 10, abs=0.2)
    assert sum(isinstance(e.event, CanFrame) for e in entries) == pytest.approx(20 * RATE_HZ, abs=5)
    images = list(reader.images())
    assert len(images) == pytest.approx(200, abs=10)
    assert (images[-1][0] - images[0][0]) / S == pytest.approx(20, abs=0.8)
    assert [r.distance_m for r in reader.references()] == [12.1]
    assert load(folder / "config.toml").camera.fx_px == 800
    for name in ("before", "alert", "after"):
        assert cv2.imread(str(folder / f"{name}.jpg")).shape[1] == 640
    assert drive.recorder.problem is None


def test_alerts_that_follow_one_another_are_one_incident(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    for _ in range(3):
        drive.run(2)
        drive.run(1, "warning")
    drive.run(15)
    (folder,) = incident_folders(tmp_path)
    assert len(info_of(folder)["alerts"]) == 2  # type: ignore[arg-type]
    entries = list(DriveLogReader(folder / "drive.mcap").entries())
    assert (entries[-1].event.t_ns - entries[0].event.t_ns) / S > 17


def test_cautions_are_counted_but_leave_no_evidence_unless_asked(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    drive.run(1, "caution")
    drive.run(12)
    drive.recorder.close()
    assert incident_folders(tmp_path) == []
    assert sum(w.began("caution") for _, w in read_odometer(tmp_path)) == 1
    other = Drive(tmp_path, incident_level="caution")
    other.run(1, "caution")
    other.run(12)
    assert len(incident_folders(tmp_path)) == 1


def test_the_driver_who_braked_agreed(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    drive.run(5)
    drive.run(1, "warning", 10.0, slope=-5.0)
    drive.run(12, "none", 5.0)
    drive.run(1, "warning", 5.0)
    drive.run(12, "none", 5.0)
    first, second = (info_of(f) for f in incident_folders(tmp_path))
    assert first["verdict"] == "answered"
    assert first["braking_mps2"] == pytest.approx(5.0, abs=0.3)
    assert second["verdict"] == "candidate"
    assert second["why"] == ["the driver did not brake"]


def test_hints_name_what_speaks_for_a_false_alarm() -> None:
    def moment(t_s: float, track: int | None) -> Moment:
        return Moment(t_s=t_s, level="none", speed_mps=10.0, brake=None, yaw_rate_radps=0.2, track=track, lateral_m=-2.0,
                      distance_m=None if track is None else 9.0, ttc_s=None)  # fmt: skip

    moments = [moment(t / 10, 4 if -2 <= t <= 3 else None) for t in range(-50, 50)]
    why = " ".join(judge(moments)["why"])
    for piece in ("did not brake", "gone 0.3 s later", "followed for 0.2 s", "in a curve", "2.0 m to the left"):
        assert piece in why
    assert "cannot be told" in judge([])["why"][0]


def test_the_service_stops_in_the_middle(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    drive.run(5)
    drive.run(1, "warning")
    drive.recorder.close()
    (folder,) = incident_folders(tmp_path)
    assert info_of(folder)["complete"] is False
    assert DriveLogReader(folder / "drive.mcap").torn is None


def test_a_power_cut_in_the_middle_leaves_what_there_is(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    drive.run(5)
    drive.run(1, "warning")
    (folder,) = incident_folders(tmp_path)  # nothing was closed
    assert info_of(folder)["level"] == "warning"
    assert len(list(DriveLogReader(folder / "drive.mcap").entries())) > 200  # the five seconds before it at least


def test_somebody_asks(tmp_path: Path) -> None:
    drive = Drive(tmp_path, transmits=True, incidents=True)
    drive.run(5)
    assert drive.recorder.evidence is not None
    drive.recorder.evidence.ask("a strange noise")
    drive.run(12)
    (folder,) = incident_folders(tmp_path)
    assert folder.name.endswith("-manual")
    assert info_of(folder)["note"] == "a strange noise"


def test_the_oldest_incidents_go(tmp_path: Path) -> None:
    drive = Drive(tmp_path, incidents_max_mb=1)
    old = tmp_path / "incidents" / "000001-20200101T000000Z-warning"
    old.mkdir(parents=True)
    (old / "drive.mcap").write_bytes(bytes(2_000_000))
    drive.run(1, "warning")
    drive.run(12)
    assert [f.name[:6] for f in incident_folders(tmp_path)] == ["000002"]


def test_a_full_disk_is_a_problem_and_the_next_incident_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = Drive(tmp_path)
    full = True

    def write_config(folder: Path, config: object) -> Path:
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return folder

    monkeypatch.setattr(incident_module, "write_config", write_config)
    drive.run(1, "warning")
    assert "No space left" in str(drive.recorder.problem)
    full = False
    drive.run(2)
    drive.run(1, "warning")
    drive.run(12)
    assert drive.recorder.problem is None


def test_a_disk_that_fails_while_an_incident_begins_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = Drive(tmp_path)
    drive.run(2)

    def write(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(DriveLogWriter, "write", write)
        drive.run(1, "warning")
        assert "No space left" in str(drive.recorder.problem)
    drive.run(2)
    drive.run(1, "warning")
    drive.run(12)
    assert drive.recorder.problem is None
    assert info_of(incident_folders(tmp_path)[-1])["complete"] is True


def test_memory_stays_bounded_in_a_flood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = Drive(tmp_path)
    monkeypatch.setattr(incident_module, "_PICTURE_BYTES", 10_000)
    drive.run(20)
    evidence = drive.recorder.evidence
    assert evidence is not None
    assert len(evidence._steps) <= 10 * RATE_HZ * 2 + 4
    assert evidence._picture_bytes <= 10_000 + 5_000
    assert evidence._picture_bytes == sum(len(j) for _, j in evidence._pictures)


def test_distance_and_time_for_the_rates(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    drive.run(150, speed_mps=20.0)
    drive.run(30, speed_mps=0.0)
    drive.run(30, speed_mps=None)
    drive.now_ns += 100 * S  # a pause is not watched
    drive.run(1, speed_mps=20.0)
    drive.recorder.close()
    lines = list(read_odometer(tmp_path))
    assert len(lines) >= 3
    (tmp_path / "odometer.jsonl").open("a").write('{"torn')
    assert sum(w.distance_m for _, w in read_odometer(tmp_path)) == pytest.approx(151 * 20, rel=0.01)
    assert sum(w.watched_s for _, w in read_odometer(tmp_path)) == pytest.approx(211, rel=0.01)
    assert sum(w.moving_s for _, w in read_odometer(tmp_path)) == pytest.approx(151, rel=0.01)
    assert sum(w.speed_known_s for _, w in read_odometer(tmp_path)) == pytest.approx(181, rel=0.01)
    again = Drive(tmp_path)
    again.run(10)
    again.recorder.close()
    assert len(list(read_odometer(tmp_path))) == len(lines) + 1  # the torn line spoils no other


def test_time_without_a_camera_since_the_start_was_blind(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    start_ns = drive.now_ns
    for i in range(1401):  # 70 s
        drive.now_ns = start_ns + i * S // 20
        drive.recorder.write(Tick(t_ns=drive.now_ns, faults=("camera_lost",)), ())
    drive.now_ns += S
    drive.run(30, speed_mps=20.0)
    drive.recorder.write(Tick(t_ns=drive.now_ns), ())
    drive.recorder.close()
    lines = list(read_odometer(tmp_path))
    assert len(lines) >= 2  # a line a minute, camera or not
    assert sum(w.blind_s for _, w in lines) == pytest.approx(70, abs=0.1)
    assert sum(w.watched_s for _, w in lines) == pytest.approx(100, abs=0.5)
    assert sum(w.distance_m for _, w in lines) == pytest.approx(600, rel=0.02)


def test_where_nothing_was_made_ready_shadow_mode_keeps_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, nowhere = RecordConfig(folder=str(tmp_path / "drives")), RecordConfig(folder=str(tmp_path / "no" / "drives"))
    assert keeps_evidence(here, transmits=False)
    assert not keeps_evidence(here, transmits=True)
    assert not keeps_evidence(nowhere, transmits=False)
    assert keeps_evidence(replace(nowhere, incidents=True), transmits=True)
    assert make_recorder(Config(record=nowhere), {}) is None
    assert recorder_module.make_recorder(Config(record=replace(nowhere, enabled=True)), {}) is not None
