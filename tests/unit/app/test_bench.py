"""bench: rows that can be kept, read again and compared; measured on small pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tmde_edge.app import bench
from tmde_edge.config import load
from tmde_edge.errors import InputDataError, InputMissingError


def row(look: str = "tracked", stage: str = "total", p50_ms: float = 10.0, threads: int = 1) -> bench.BenchRow:
    return bench.BenchRow(
        size="640x360", threads=threads, look=look, stage=stage, p50_ms=p50_ms, p95_ms=p50_ms, p99_ms=p50_ms, fps=1e3 / p50_ms,
        count=9,
    )  # fmt: skip


def test_every_look_and_stage_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (90, 160, 3), dtype=np.uint8) for _ in range(24)]
    monkeypatch.setattr(bench, "_pictures", lambda say: pictures)
    monkeypatch.setattr(bench, "SIZES_PX", ((160, 90),))
    said: list[str] = []
    rows = list(bench.bench_all(load(None, ["runtime.threads=1", "depth.model=midas-small-256"]), said.append))
    assert {(r.look, r.stage) for r in rows} >= {
        ("still", "total"), ("full search", "total"), ("full search", "detect"), ("tracked", "total"), ("end to end", "total"),
    }  # fmt: skip
    for r in rows:
        assert 0 < r.p50_ms <= r.p95_ms <= r.p99_ms
        assert (r.fps is not None) == (r.stage == "total")
        assert r.size == "160x90"
        assert bench.line(r).count("|") == bench.header().splitlines()[0].count("|")
    assert any("depth" in r.look for r in rows) or "without depth" in said[0]


def test_rows_come_back_from_their_file(tmp_path: Path) -> None:
    rows = [row(), row("still", "detect")]
    path = tmp_path / "a.jsonl"
    path.write_text("".join(json.dumps(r.as_dict()) + "\n" for r in rows))
    assert bench.read_rows(path) == rows


def test_comparison_tells_what_is_slower() -> None:
    lines, worse = bench.compared([row(p50_ms=10.0)], [row(p50_ms=11.0)])
    assert not worse
    assert "+10.0 %" in lines[0]
    assert bench.compared([row(p50_ms=10.0)], [row(p50_ms=13.0)])[1]
    assert not bench.compared([row(stage="flow", p50_ms=1.0)], [row(stage="flow", p50_ms=3.0)])[1]  # a stage alone is no verdict
    with pytest.raises(InputDataError, match="no row in common"):
        bench.compared([row(threads=1)], [row(threads=4)])


def test_files_that_are_no_runs_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputMissingError):
        bench.read_rows(tmp_path / "no.jsonl")
    bad = tmp_path / "bad.jsonl"
    bad.write_text(json.dumps(row().as_dict()) + '\n{"size": 3}\n')
    with pytest.raises(InputDataError, match="line 2"):
        bench.read_rows(bad)
    bad.write_text("")
    with pytest.raises(InputDataError, match="no row"):
        bench.read_rows(bad)
