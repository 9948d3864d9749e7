"""Shadow mode's report: rates with their intervals, candidates, pictures; and the plain folder of an incident."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from recorded_drive import Drive, S

from tmde_edge.adapters.cameras.sources import open_source
from tmde_edge.app import incidents
from tmde_edge.app.incident import incident_folders
from tmde_edge.app.shadow import as_json, lines_of, rate, read_shadow, write_html
from tmde_edge.app.toml_out import to_toml
from tmde_edge.cli import main
from tmde_edge.config import from_tree, load, to_tree
from tmde_edge.errors import InputDataError, InputMissingError, UsageError
from tmde_edge.messages import RangeReference


@pytest.fixture
def driven(tmp_path: Path) -> Path:
    """100 s: a warning that the driver answered, one that he did not, a caution."""
    drive = Drive(tmp_path, enabled=True, frames=True)
    drive.run(20, speed_mps=20.0)
    drive.run(1, "warning", 20.0, slope=-6.0)
    drive.run(30, speed_mps=14.0)
    drive.run(1, "warning", 14.0)
    drive.recorder.reference(RangeReference(t_ns=drive.now_ns, distance_m=12.3, text=""))
    drive.run(25, speed_mps=14.0)
    drive.run(1, "caution", 14.0)
    drive.run(22, speed_mps=14.0)
    drive.recorder.close()
    return tmp_path


def test_counts_rates_and_candidates(driven: Path) -> None:
    j = as_json(read_shadow(driven))
    km = (20 * 20 + 17 + 79 * 14) / 1000
    assert j["distance_km"] == pytest.approx(km, rel=0.01)
    assert j["hours"] == pytest.approx(100 / 3600, rel=0.01)
    assert j["counts"] == {"cautions": 1, "warnings": 2, "false_alarm_candidates": 1}
    assert j["per_100_km"]["warnings"]["rate"] == pytest.approx(2 / km * 100, rel=0.01)
    assert j["per_hour"]["false_alarm_candidates"]["rate"] == pytest.approx(36, rel=0.01)
    assert [i["verdict"] for i in j["incidents"]] == ["answered", "candidate"]
    assert {i["transmitted"] for i in j["incidents"]} == {False}
    json.dumps(j, allow_nan=False)
    assert any("candidate: the driver did not brake" in line for line in lines_of(read_shadow(driven)))


def test_the_page_stands_alone_with_its_pictures(driven: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    write_html(read_shadow(driven), page)
    text = page.read_text()
    assert text.count("data:image/jpeg;base64,") == 6
    assert re.findall(r'(?:src|href)="([^:"]*)', text) == ["data"] * 6
    assert text.index('class="candidate"') < text.index('class="other"')  # what needs eyes comes first


def test_nothing_watched_is_said_as_such(tmp_path: Path) -> None:
    with pytest.raises(InputMissingError, match="no such folder"):
        read_shadow(tmp_path / "no")
    with pytest.raises(InputMissingError, match="nothing was watched"):
        read_shadow(tmp_path)


def test_warnings_that_follow_one_another_are_all_counted(tmp_path: Path) -> None:
    drive = Drive(tmp_path)
    for _ in range(3):
        drive.run(2)
        drive.run(1, "warning")
    drive.run(15)
    drive.recorder.close()
    assert as_json(read_shadow(tmp_path))["counts"] == {"cautions": 0, "warnings": 3, "false_alarm_candidates": 3}


def test_candidates_are_counted_when_their_folders_made_room(tmp_path: Path) -> None:
    drive = Drive(tmp_path, incidents_max_mb=0.0)
    for _ in range(4):
        drive.run(1, "warning")
        drive.run(12)
    drive.recorder.close()
    assert len(incident_folders(tmp_path)) == 1
    j = as_json(read_shadow(tmp_path))
    assert (j["counts"]["warnings"], j["counts"]["false_alarm_candidates"], j["warnings_not_judged"]) == (4, 4, 0)
    assert j["per_100_km"]["false_alarm_candidates"] == j["per_100_km"]["warnings"]


def test_where_warnings_were_not_judged_there_is_no_rate_that_looks_good(driven: Path) -> None:
    odometer = driven / "odometer.jsonl"
    odometer.write_text("".join(line + "\n" for line in odometer.read_text().splitlines() if "verdict" not in line))
    _, candidate = incident_folders(driven)
    assert as_json(read_shadow(driven))["warnings_not_judged"] == 0  # as an older version left it: the folders still tell
    shutil.rmtree(candidate)
    report = read_shadow(driven)
    j = as_json(report)
    assert (j["counts"]["false_alarm_candidates"], j["warnings_not_judged"]) == (0, 1)
    found = j["per_100_km"]["false_alarm_candidates"]
    assert found["rate"] is None
    assert found["low"] == 0.0
    assert found["high"] == pytest.approx(5.57 / j["distance_km"] * 100, rel=0.01)  # the exact 95 % limit for one event
    assert any("1 of the warnings were not judged" in line for line in lines_of(report))
    write_html(report, driven / "x.html")
    assert "1 of the warnings were not judged" in (driven / "x.html").read_text()


def test_a_torn_incident_spoils_no_report(driven: Path) -> None:
    (incident_folders(driven)[0] / "incident.json").write_text('{"level": "warn')
    j = as_json(read_shadow(driven))
    assert len(j["incidents"]) == 2
    write_html(read_shadow(driven), driven / "x.html")


@given(st.integers(0, 500), st.floats(0.01, 1000))
def test_an_interval_holds_its_rate(count: int, exposure: float) -> None:
    found = rate(count, exposure)
    assert found is not None
    assert found["low"] <= found["rate"] <= found["high"]


def test_known_poisson_limits() -> None:
    # Exact 95 % limits for 10 events: 4.80 to 18.39 (Ulm 1990).
    found = rate(10, 1.0)
    assert found is not None
    assert found["low"] == pytest.approx(4.80, abs=0.03)
    assert found["high"] == pytest.approx(18.39, abs=0.03)
    assert rate(3, 0.0) is None


def test_the_last_alert_of_the_ring_as_plain_files(driven: Path, tmp_path: Path) -> None:
    made = incidents.take_out(driven, out=tmp_path / "out", at=None, kept=None, before_s=10, after_s=10)
    assert made.what == "caution (ttc)"
    assert made.counts["frames"] == len(list((made.out / "frames").iterdir())) == pytest.approx(200, abs=10)
    assert made.counts["decisions"] == pytest.approx(400, abs=10)
    lines = (made.out / "can.log").read_text().splitlines()
    assert lines[0].startswith("(0000000000.000000) mark 7FF#")
    assert len(lines) == pytest.approx(400, abs=10)
    assert load(made.out / "config.toml").camera.fx_px == 800
    frames, decided = list(open_source(str(made.out / "frames"))), (made.out / "decisions.jsonl").read_text().splitlines()
    decided_s = [t for t in (json.loads(line)["t"] for line in decided) if t >= 0]
    assert {round(f.t_ns / S, 2) for f in frames} <= {round(t, 2) for t in decided_s}  # one time for both
    assert frames[-1].t_ns / S > 19
    with pytest.raises(UsageError, match="not empty"):
        incidents.take_out(driven, out=tmp_path / "out", at=None, kept=None, before_s=10, after_s=10)


def test_a_moment_by_the_clock_with_its_truth(driven: Path, tmp_path: Path) -> None:
    made = incidents.take_out(driven, out=tmp_path / "out", at=f"{_utc(52)}Z", kept=None, before_s=3, after_s=3)
    rows = list(csv.DictReader((made.out / "truth.csv").open()))
    assert {row["distance_m"] for row in rows} == {"12.3000"}
    assert 1 <= len(rows) <= 3
    with pytest.raises(InputDataError, match="nothing was recorded between"):
        incidents.take_out(driven, out=tmp_path / "late", at="2090-01-01T00:00:00Z", kept=None, before_s=3, after_s=3)
    with pytest.raises(InputMissingError, match="nothing was recorded at"):
        incidents.take_out(driven, out=tmp_path / "late", at="1990-01-01T00:00:00Z", kept=None, before_s=3, after_s=3)
    with pytest.raises(UsageError, match="not a time"):
        incidents.take_out(driven, out=None, at="yesterday", kept=None, before_s=3, after_s=3)


@pytest.mark.parametrize("at", [None, "a time"])
def test_a_part_that_a_power_cut_left_empty_hides_no_other(
    driven: Path, tmp_path: Path, at: str | None, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    (part,) = driven.glob("*.mcap")
    for name in (part.name.replace("-0000.", "-0001."), "000009-20991231T000000Z-0000.mcap"):
        (driven / name).write_bytes(b"")
    options = ["--at", f"{_utc(52)}Z"] if at else []
    assert main(["incident", str(driven), "--out", str(tmp_path / "out"), "--before", "3", "--after", "3", *options]) == 0
    assert "decisions in" in capsys.readouterr().err
    assert sum("left out: " in text and "-0000.mcap: not a drive log" in text for text in caplog.messages) == 1


def _utc(after_s: float) -> str:
    from datetime import datetime, timezone

    start_s = 1_700_000_000 + 100
    return datetime.fromtimestamp(start_s + after_s, timezone.utc).strftime("%Y-%m-%dT%H:%M:%S")


def test_the_commands(driven: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["incident", str(driven), "--list"]) == 0
    listed = capsys.readouterr().out
    assert listed.startswith("ring: 1 drives, 1 files")
    assert listed.count("would have been said") == 2
    assert main(["incident", str(driven), "--kept", "1", "--out", str(tmp_path / "one")]) == 0
    assert (tmp_path / "one" / "incident.json").exists()
    assert (tmp_path / "one" / "alert.jpg").exists()
    capsys.readouterr()
    assert main(["shadow-report", str(driven), "--json", "--html", str(tmp_path / "r.html")]) == 0
    assert json.loads(capsys.readouterr().out)["counts"]["warnings"] == 2
    assert main(["incident", str(tmp_path / "none")]) == 66
    assert main(["shadow-report", str(driven), "--html", str(tmp_path / "no" / "r.html")]) == 2
    assert main(["status", "--socket", str(tmp_path / "s.sock")]) == 66
    assert main(["incident", "--now", "--set", f"runtime.status_socket={tmp_path / 's.sock'}"]) == 66


def test_a_configuration_survives_its_own_toml(tmp_path: Path) -> None:
    speed = "can.vehicle.speed={id=180, start_bit=47, length=16, sign={start_bit=3}}"
    text = 'can.channel="a \\"b\\" ä\\n"'
    config = load(None, ["camera.fx_px=800.5", 'plates.expect=["de", "us-mi"]', text, "can.receive_ids=[1, 2]", speed])
    path = tmp_path / "c.toml"
    path.write_text(to_toml(to_tree(config)), encoding="utf-8")
    assert load(path) == config
    assert from_tree({}, "") == load(None)
    assert S == 10**9
