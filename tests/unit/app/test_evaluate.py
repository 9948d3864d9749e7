"""evaluate: rendered stills and a short drive with exact truth; metrics and the paired bootstrap; exit codes."""

from __future__ import annotations

import csv
import importlib.util
import json
from pathlib import Path
from typing import Any

import cv2
import pytest

from tmde_edge.app import evaluate as ev
from tmde_edge.app.evaluate_metrics import compare, parts, scores
from tmde_edge.app.evaluate_truth import TrueFrame, TruePlate, recording_truth, rows_of, still_labels
from tmde_edge.app.simulate_stills import simulate_stills
from tmde_edge.cli import main
from tmde_edge.errors import InputDataError, InputMissingError, UsageError
from tmde_edge.simulation.camera import hd_camera
from tmde_edge.simulation.stills import render_still

CAMERA = hd_camera(700.0, 640, 360, height_m=1.0)


@pytest.fixture(scope="module")
def stills(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stills")
    names = ("tl_x_px", "tl_y_px", "tr_x_px", "tr_y_px", "br_x_px", "br_y_px", "bl_x_px", "bl_y_px")
    with (folder / "labels.csv").open("w", newline="") as f:
        rows = csv.writer(f)
        rows.writerow(["image", *names, "characters", "char_height_px", "distance_m"])
        for i, width_px in enumerate((90.0, 60.0, 120.0)):
            still = render_still(width_px=width_px, seed=i + 3, camera=CAMERA, scenery=False)
            cv2.imwrite(str(folder / f"{i}.png"), still.image)
            rows.writerow([f"{i}.png", *still.corners_px.ravel().tolist(), len(still.glyph_boxes_px), still.char_height_px,
                           still.distance_m])  # fmt: skip
    (folder / "config.toml").write_text(
        "[camera]\nwidth_px = 640\nheight_px = 360\nfx_px = 700.0\n[plates]\nexpect = ['de-mittel']\n"
    )
    return folder


def test_labelled_stills_are_judged_per_stage(stills: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rows.csv"
    assert main(["evaluate", str(stills), "--jobs", "1", "--out", str(out), "--json", "-q"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = {(m["stage"], m["metric"]): m["value"] for m in told["configs"]["as recorded"]}
    assert found["detection", "recall"] == 1.0
    assert found["detection", "false a frame"] == 0.0
    assert found["rectification", "corner error / height"] < 0.15
    assert found["segmentation", "height error"] < 0.05
    assert found["range", "ranged"] == 1.0
    assert found["range", "median |error|"] < 0.03
    rows = list(csv.DictReader(out.open()))
    assert [r["image"] for r in rows] == ["0.png", "1.png", "2.png"]
    assert float(rows[0]["distance_m"]) == pytest.approx(float(rows[0]["true_m"]), rel=0.05)


def test_a_worse_configuration_is_exit_1_in_parallel(
    stills: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = tmp_path / "good.toml", tmp_path / "bad.toml"
    good.write_text("")
    bad.write_text("[camera]\nfx_px = 900.0\n")  # every distance 29 % too long
    assert main(["evaluate", str(stills), "--config", str(good), "--config", str(bad), "--jobs", "2", "-q"]) == 1
    told = capsys.readouterr()
    assert "bad.toml is worse than good.toml: range median |error|" in told.err
    assert "WORSE" in told.out
    assert main(["evaluate", str(stills), "--config", str(bad), "--config", str(bad), "--jobs", "1", "-q"]) == 0


def test_wrong_usage_and_missing_things(stills: Path, tmp_path: Path) -> None:
    with pytest.raises(InputMissingError, match="nothing to evaluate"):
        ev.find_items([str(tmp_path)])
    with pytest.raises(InputMissingError, match="no such"):
        ev.find_items([str(tmp_path / "nowhere")])
    with pytest.raises(UsageError, match="two at most"):
        ev.candidates([Path("a"), Path("b"), Path("c")], [])
    broken = tmp_path / "labels.csv"
    broken.write_text("image,x,y,w,h\na.png,1,2,drei,4\n")
    with pytest.raises(InputDataError, match="line 2: 'drei'"):
        still_labels(broken)
    with pytest.raises(UsageError, match="cannot be written"):
        ev.write_rows(tmp_path / "no" / "rows.csv", [])


def test_parquet_where_pyarrow_is_there(stills: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [{"config": "a", "recording": "r", "frame": 1, "found": 1.0}, {"config": "a", "recording": "r", "frame": 2}]
    with monkeypatch.context() as m:
        m.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(UsageError, match="needs pyarrow"):
            ev.write_rows(tmp_path / "rows.parquet", rows)
        m.setattr(ev, "evaluate", lambda *_: pytest.fail("the work was begun"))
        assert main(["evaluate", str(stills), "--out", str(tmp_path / "rows.parquet"), "-q"]) == 2
        assert main(["evaluate", str(stills), "--out", str(tmp_path / "no" / "rows.csv"), "-q"]) == 2
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    ev.write_rows(tmp_path / "rows.parquet", rows)
    assert parquet.read_table(tmp_path / "rows.parquet").column("found").to_pylist() == [1.0, None]


def record(*plates: dict[str, Any]) -> dict[str, Any]:
    return {"plates": list(plates), "lead": None}


def plate(x: float, distance_m: float | None = 10.0) -> dict[str, Any]:
    return {"corners": [[x, 0], [x + 50, 0], [x + 50, 10], [x, 10]], "characters": 7, "char_height_px": 7.0, "standard": "x",
            "distance_m": distance_m, "sigma_m": 0.1}  # fmt: skip


def test_rows_count_misses_false_plates_and_errors() -> None:
    truth = TrueFrame(plates=[TruePlate(box=(0, 0, 50, 10), characters=7, distance_m=9.0),
                              TruePlate(box=(200, 0, 250, 10), distance_m=20.0)])  # fmt: skip
    first, second = rows_of(record(plate(1), plate(400)), truth, {"recording": "r", "frame": 0})
    assert (first["found"], first["count_exact"], first["false_plates"]) == (1.0, 1.0, 1.0)
    assert first["range_error"] == pytest.approx(1 / 9)
    assert (second["found"], second["ranged"]) == (0.0, 0.0)
    (nothing,) = rows_of(record(plate(5)), TrueFrame(), {"recording": "r", "frame": 1})
    assert nothing["false_plates"] == 1.0
    assert [r["found"] for r in rows_of({"error": "x"}, truth, {"recording": "r"})] == [0.0, 0.0]
    for plates in (truth.plates, []):  # a frame that cannot be read hides the lead as well
        unread = rows_of({"error": "x"}, TrueFrame(plates=plates, lead_m=20.0), {"recording": "r"})
        assert [r["lead_reported"] for r in unread if "lead_reported" in r] == [0.0]


def test_a_lead_where_the_truth_has_none_is_counted(tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text("frame,distance_m,in_path\n0,,0\n1,,0\n2,,\n3,20,1\n")
    truth = recording_truth(tmp_path)
    assert [truth[k].no_lead for k in range(4)] == [True, True, False, False]  # an empty cell alone says nothing
    seen = {"plates": [], "lead": {"distance_m": 7.0, "sigma_m": 0.1}}
    rows = [rows_of(seen if k in (0, 2, 3) else record(), truth[k], {"recording": "r", "frame": k})[0] for k in range(4)]
    assert [r.get("lead_false") for r in rows] == [1.0, 0.0, None, None]
    (false,) = [s for s in scores(rows) if (s.metric.stage, s.metric.name) == ("lead", "false a frame")]
    assert (false.value, false.count, false.metric.better) == (0.5, 2, -1)


def test_an_unreadable_image_is_a_miss_of_its_own_plates_only() -> None:
    known, unknown = TruePlate(box=(0, 0, 100, 20), distance_m=9.0), TruePlate(box=(200, 0, 240, 10))
    first, second = rows_of({"error": "x"}, TrueFrame(plates=[known, unknown]), {"recording": "r", "frame": 0})
    assert (first["found"], first["ranged"], second["found"]) == (0.0, 0.0, 0.0)
    assert "ranged" not in second  # nobody knows its distance: no range was asked for
    assert [name for name, _ in parts([first, second], "width")] == ["30 to 45 px", "90 to 150 px"]
    assert [name for name, _ in parts([first], "distance")] == ["5 to 10 m"]


def test_a_bad_cell_is_told_of_the_file_it_stands_in(tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text("frame,distance_m\n0,20\n")
    (tmp_path / "vehicles.csv").write_text("frame,x,y,w,h\n0,1,2,3,4\n0,1,2,wide,4\n")
    with pytest.raises(InputDataError, match=r"vehicles\.csv line 3: 'wide'"):
        recording_truth(tmp_path)


def test_intervals_hold_the_truth_and_pair_the_draws() -> None:
    a = [{"recording": "r", "frame": i, "found": float(i % 4 > 0)} for i in range(200)]
    recall = scores(a)[0]
    assert recall.value == pytest.approx(0.75)
    assert 0.65 < recall.low < 0.75 < recall.high < 0.85
    b = [{**r, "found": 0.0 if r["frame"] == 1 else r["found"]} for r in a]
    same, down = compare(a, a)[0], compare(a, [{**r, "found": r["found"] * (r["frame"] % 8 != 1)} for r in a])[0]
    assert (same.low, same.high, same.worse) == (0.0, 0.0, False)
    assert down.worse
    assert not compare(a, b)[0].worse  # one frame of 200 is no evidence


def test_precision_counts_plates_and_false_plates_together() -> None:
    rows = [{"recording": "r", "frame": 0, "found": 1.0, "false_plates": 2.0}, {"recording": "r", "frame": 1, "found": 0.0},
            {"recording": "r", "frame": 2, "false_plates": 1.0}]  # fmt: skip
    found = {s.metric.name: s for s in scores(rows)}
    assert (found["precision"].value, found["precision"].count) == (0.25, 4)
    assert found["recall"].value == 0.5


def test_tables_by_width_and_distance(stills: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{"true_width_px": w, "true_m": 300 / w} for w in (20.0, 44.9, 45.0, 400.0)]
    assert [(name, len(part)) for name, part in parts(rows, "width")] == [
        ("0 to 30 px", 1), ("30 to 45 px", 1), ("45 to 60 px", 1), ("from 150 px", 1)
    ]  # fmt: skip
    assert [name for name, _ in parts([{"lead_true_m": 12.0}, {}], "distance")] == ["10 to 20 m"]
    assert main(["evaluate", str(stills), "--jobs", "1", "--by", "width", "--json", "-q"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["parts"]["as recorded"]) == 2  # rendered 60, 90 and 120 px wide, within a pixel
    counts = [next(m["count"] for m in found if m["metric"] == "recall") for found in told["parts"]["as recorded"].values()]
    assert sum(counts) == 3
    assert main(["evaluate", str(stills), "--jobs", "1", "--by", "width", "-q"]) == 0
    assert "as recorded: 90 to 150 px" in capsys.readouterr().out


def test_rendered_stills_are_a_set_to_evaluate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "set"
    assert main(["simulate", "--stills", "2", "--plate", "us-mi", "--out", str(folder), "-q", "--seed", "3"]) == 0
    labels = still_labels(folder / "labels.csv")
    assert sorted(labels) == ["0000.jpg", "0001.jpg"]
    for frame in labels.values():
        (plate,) = frame.plates
        assert plate.characters
        assert plate.distance_m is not None
        assert 0 <= plate.box[0] < plate.box[2] < 1280
        assert 0 <= plate.box[1] < plate.box[3] < 720
    assert main(["evaluate", str(folder), "--jobs", "1", "--json", "-q"]) == 0
    assert {m["metric"]: m["count"] for m in json.loads(capsys.readouterr().out)["configs"]["as recorded"]}["recall"] == 2
    assert main(["simulate", "--stills", "2", "--plate", "atlantis", "--out", str(folder), "-q"]) == 2
    assert main(["simulate", "--stills", "2", "approach", "--out", str(folder), "-q"]) == 2


def test_a_still_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)  # what OpenCV says of a full disk
    with pytest.raises(UsageError, match=r"0000\.jpg: cannot be written"):
        simulate_stills(1, tmp_path / "set", standard="us-mi")


def test_a_short_drive_and_its_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tmde_edge.app.simulate import simulate

    folder = tmp_path / "drives" / "follow"
    simulate("follow", folder, max_frames=12)
    log = tmp_path / "follow.mcap"
    assert main(["--dry-run", str(folder / "video.mp4"), "-c", str(folder / "config.toml"), "--can-log", str(folder / "can.log"),
                 "--record", str(log), "-q", "--set", "runtime.threads=1"]) == 0  # fmt: skip
    (tmp_path / "follow.truth.csv").write_text((folder / "truth.csv").read_text())
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "drives"), str(log), "--jobs", "1", "--json", "-q"]) == 0
    found = {(m["stage"], m["metric"]): m for m in json.loads(capsys.readouterr().out)["configs"]["as recorded"]}
    assert found["detection", "recall"]["count"] >= 12
    assert found["lead", "reported"]["count"] == 24  # the drive and its log
    assert found["lead", "median |error|"]["value"] < 0.1
