"""The report: every kind of record gives a whole page, with right numbers, nothing from outside and nothing unescaped."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from tmde_edge.app.report.about import About, about_run
from tmde_edge.app.report.page import page
from tmde_edge.app.report.series import Series
from tmde_edge.app.report.summary import sentences, tiles
from tmde_edge.app.report.writer import ReportWriter, rebuild
from tmde_edge.app.truth import TruthComparison, TruthRow, stats
from tmde_edge.cli import main
from tmde_edge.config import load
from tmde_edge.errors import InputDataError, InputMissingError, UsageError


def record(frame: int, distance_m: float | None = 20.0, level: str = "none", **more: Any) -> dict[str, Any]:
    plate = {
        "corners": [[600, 400], [660, 400], [660, 414], [600, 414]], "score": 0.9, "standard": "de-1line", "characters": 8,
        "char_height_px": 9.0, "distance_m": distance_m, "sigma_m": None if distance_m is None else 0.2,
        "cues": [{"cue": "char_height", "distance_m": 20.4, "sigma_m": 0.4, "used": True},
                 {"cue": "plate_width", "distance_m": 19.0, "sigma_m": 0.4, "used": True}] if distance_m is not None else [],
        "in_path": True, "lead": True,
    }  # fmt: skip
    lead = {
        "distance_m": distance_m, "sigma_m": None if distance_m is None else 0.1, "range_rate_mps": -5.0,
        "range_rate_sigma_mps": 0.2,
        "ttc_s": 4.0, "headway_s": 2.0, "coasting_s": 0.0, "source": "plate",
    }  # fmt: skip
    whole = {
        "frame": frame, "t": frame / 10, "plates": [plate], "lead": lead, "ego": {"speed_mps": 10.0, "yaw_rate_radps": None},
        "pose": {"pitch_rad": 0.01, "roll_rad": 0.0, "source": "lanes"}, "depth": None,
        "alert": {"level": level, "reason": "ttc" if level != "none" else "", "ttc_s": 4.0}, "faults": [], "mode": "strict",
        "timing_ms": {"total": 6.0 + frame % 3, "detect": 2.0},
    }  # fmt: skip
    return whole | more


def series(records: list[dict[str, Any]]) -> Series:
    made = Series()
    for r in records:
        made.add(r)
    return made


def parts(html: str) -> tuple[str, list[ElementTree.Element]]:
    """The visible text, and every picture parsed as XML."""

    class Text(HTMLParser):
        seen = ""

        def handle_data(self, data: str) -> None:
            self.seen += data + "\n"

    text = Text()
    text.feed(html)
    return text.seen, [ElementTree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", html, re.DOTALL)]


DRIVE = [record(k, 20.0 - k / 2, "none" if k < 5 else "caution" if k < 9 else "warning") for k in range(20)]


@pytest.mark.parametrize(
    "records",
    [
        DRIVE,
        [record(0)],
        [record(k, None, faults=["uncalibrated"]) for k in range(4)],
        [record(k, lead=None, plates=[], ego=None, depth={"distance_m": 9.0, "sigma_m": 1.0, "age_s": 0.1}) for k in range(4)],
        [{"frame": 0, "t": 0.0, "error": "x.png: <b>empty</b> & file"}, record(1, faults=["blind"]), record(2)],
        [{"frame": 0, "t": 0.0, "error": "none of it"}],
    ],
    ids=["drive", "one frame", "uncalibrated", "no lead", "with errors", "only errors"],
)
@pytest.mark.parametrize("with_truth", [False, True])
def test_every_kind_of_drive_gives_a_whole_page(records: list[dict[str, Any]], with_truth: bool) -> None:
    truth = {k: TruthRow(distance_m=20.0 - k / 2, characters=8) for k in range(20)} if with_truth else None
    comparison = TruthComparison(truth) if truth is not None else None
    for r in records:
        if comparison is not None:
            comparison.add(r)
    html = page(series(records), About(source="a/<i>drive</i>.mp4", width_px=1280, height_px=720), [], truth, comparison)
    text, pictures = parts(html)
    assert "<i>drive" not in html
    assert "<b>empty" not in html
    assert "{{" not in html
    for picture in pictures:
        drawn = ElementTree.tostring(picture, encoding="unicode")
        assert not re.search(r"\b(nan|inf|None)\b", drawn)
    assert not re.search(r"\bnan\b", text)
    # Offline: nothing is loaded from anywhere (the name space of SVG is a name, not an address to load).
    assert set(re.findall(r"https?://[^\"' )]+", html)) <= {"http://www.w3.org/2000/svg"}
    assert not re.search(r"<(link|script|img|iframe)[^>]+(src|href)=\"(?!data:)", html)


def test_the_summary_says_what_happened() -> None:
    s = series(DRIVE)
    said = " ".join(sentences(s, About(source="x", fx_px=1000.0, rate_hz=10.0), None))
    assert "followed in 100 % of the frames, between 20.0 m and 10.5 m" in said
    assert "warned once, first at 0.9 s at 15.5 m" in said
    assert "There was 1 caution" in said
    assert [t.value for t in tiles(s, None) if t.name in ("warning", "caution", "nearest")] == ["10.5 m", "1", "1"]
    assert [(c.kind, c.frame) for c in s.changes] == [("lead", 0), ("caution", 5), ("warning", 9)]
    assert list(s.spans("caution")) == [(0.5, 0.9)]
    assert list(s.spans("warning")) == [(0.9, 1.9)]


def test_truth_tables_have_the_papers_numbers() -> None:
    """The paper's Table 1: seven distances of a plate at 0.030 m."""
    measured = np.array([0.03150, 0.03317, 0.03230, 0.03222, 0.03265, 0.03143, 0.03363])
    found = stats(measured, np.full(7, 0.030))
    assert found is not None
    assert found.cv == pytest.approx(0.023, abs=5e-4)
    assert found.mae_m == pytest.approx(0.00241, abs=1e-5)
    assert found.rmse_m == pytest.approx(0.00253, abs=1e-5)


def test_table_2_and_the_bins_stand_in_the_page() -> None:
    truth = {k: TruthRow(distance_m=20.0, characters=7) for k in range(10)}
    comparison = TruthComparison(truth)
    records = [record(k, 20.2 if k % 2 else 20.0) for k in range(10)]
    for r in records:
        comparison.add(r)
    text, _ = parts(page(series(records), About(source="x"), [], truth, comparison))
    assert "0.50 %" in text  # median |error| of 0 and 1 %
    assert "20 to 30 m" in text
    assert "right in 0 % of 10 frames" in text
    assert "plate width alone" in text


def drawn() -> np.ndarray:
    return np.full((90, 160, 3), 128, np.uint8)


def test_writing_reading_and_making_the_page_again(tmp_path: Path) -> None:
    writer = ReportWriter(tmp_path / "deep" / "report", About(source="drive.mp4", fx_px=1000.0))
    for r in DRIVE:
        writer.add(r, (160, 90), drawn)
    path = writer.finish(None, None)
    first = path.read_text()
    assert first.count("data:image/jpeg;base64,") == 4  # lead, caution, warning, shortest TTC
    assert [json.loads(line)["frame"] for line in (path.parent / "records.jsonl").open()] == list(range(20))
    path.unlink()
    assert rebuild(path.parent, None, None).read_text() == first
    truth = tmp_path / "truth.csv"
    truth.write_text("frame,distance_m\n0,20\n1,20\n")
    assert "Against the truth" in rebuild(path.parent / "records.jsonl", tmp_path / "again", truth).read_text()


def test_an_earlier_reports_pictures_do_not_stay(tmp_path: Path) -> None:
    for _ in range(2):
        writer = ReportWriter(tmp_path, About(source="x"))
        writer.add(record(0), (160, 90), drawn)
        writer.finish(None, None)
        (tmp_path / "thumbnails" / "999999-old.jpg").write_bytes(b"x")
    writer = ReportWriter(tmp_path, About(source="x"))
    writer.add(record(0, lead=None), (160, 90), drawn)
    writer.finish(None, None)
    assert list((tmp_path / "thumbnails").iterdir()) == []


def test_what_cannot_be_reported_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("{}")
    with pytest.raises(UsageError, match="cannot be written"):
        ReportWriter(tmp_path / "file", About(source="x"))
    with pytest.raises(InputMissingError, match=r"records\.jsonl"):
        rebuild(tmp_path, None, None)
    bad = tmp_path / "bad.jsonl"
    bad.write_text(json.dumps(record(0)) + "\n{broken\n")
    with pytest.raises(InputDataError, match="line 2"):
        rebuild(bad, None, None)
    bad.write_text('{"image": "a.png"}\n')
    with pytest.raises(InputDataError, match="line 1"):
        rebuild(bad, None, None)
    bad.write_text("")
    with pytest.raises(InputDataError, match="no record"):
        rebuild(bad, None, None)


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "street"
    folder.mkdir()
    base = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8), (0, 0), 5)
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), np.roll(base, 3 * k, axis=1))
    args = ["--dry-run", str(folder), "--report", str(tmp_path / "report"), "--set", "runtime.threads=1"]
    assert main(args) == 0
    assert "index.html" in capsys.readouterr().err
    text, _ = parts((tmp_path / "report" / "index.html").read_text())
    assert "320x240 px" in text
    assert "not calibrated" in text
    assert main(["report", str(tmp_path / "report"), "--out", str(tmp_path / "b")]) == 0
    assert (tmp_path / "b" / "index.html").exists()
    (tmp_path / "file").write_text("")
    assert main(["--dry-run", str(folder), "--report", str(tmp_path / "file"), "-q"]) == 2


def test_a_known_camera_has_a_focal_length() -> None:
    about = about_run(load(None, ['camera.prior="pi-v3"']), "drive.mp4", None, "today")
    assert about.fx_px == pytest.approx(940, abs=1)
    assert about.focal_sigma == 0.05
    assert about_run(load(None, []), "drive.mp4", None, "today").fx_px is None
