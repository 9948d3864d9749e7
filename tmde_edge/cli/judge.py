"""How good and how fast: `tmde-edge evaluate` and `bench`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from tmde_edge.cli.common import Verbs, config_of, progress, say, whole_from
from tmde_edge.errors import CheckFailedError, UsageError


def add_evaluate(verbs: Verbs) -> None:
    sub = verbs.add("evaluate", _evaluate, "judges many recordings or labelled stills; compares two configurations", several=True)
    sub.add_argument("sources", nargs="+", metavar="SOURCE", help="folders with video and truth.csv, with labels.csv; drive logs")
    sub.add_argument("--jobs", type=int, metavar="N", help="processes (default: one a core)")
    sub.add_argument("--out", type=Path, metavar="FILE", help="every row: .csv, or .parquet where pyarrow is there")
    sub.add_argument("--json", action="store_true", help="the numbers as one JSON object")
    sub.add_argument("--by", choices=["width", "distance"], default="", help="a table for each range of plate width or distance")
    sub.add_argument("--seed", type=whole_from(0), default=0, help="of the bootstrap")


def add_bench(verbs: Verbs) -> None:
    sub = verbs.add("bench", _bench, "how fast here: p50, p95, p99 of each stage by resolution")
    sub.add_argument("what", nargs="?", choices=["all", "detect"], default="all", help="detect: perception alone")
    sub.add_argument("--json", action="store_true", help="rows as JSON lines")
    sub.add_argument("--compare", metavar="FILE", type=Path, default=None, help="an earlier run's --json; exit 1 where slower")


def _evaluate(args: argparse.Namespace) -> int:
    from tmde_edge.app import evaluate as ev
    from tmde_edge.app import evaluate_metrics as metrics

    if args.jobs is not None and args.jobs < 1:
        raise UsageError(f"--jobs {args.jobs}: at least 1")
    if args.out is not None:
        ev.check_out(args.out)
    configs = ev.candidates([*([args.config] if args.config is not None else []), *args.config_files], args.overrides)
    items = ev.find_items(args.sources)
    rows: list[dict[str, Any]] = []
    done = ev.evaluate(items, configs, args.jobs or ev.default_jobs())
    for part in progress(done, len(items) * len(configs), "evaluate", args.quiet):
        rows += part
    rows.sort(key=lambda r: (r["config"], r["recording"], r["frame"]))
    if args.out is not None:
        ev.write_rows(args.out, rows)
        say(args, f"{len(rows)} rows in {args.out}")
    by = [[r for r in rows if r["config"] == c.name] for c in configs]
    compared = metrics.compare(by[0], by[1], seed=args.seed) if len(by) == 2 else []
    worse = [d for d in compared if d.worse]
    if args.json:
        told: dict[str, Any] = {"configs": {}, "parts": {}, "differences": [metrics.as_json(d) for d in compared]}
        for c, of in zip(configs, by, strict=True):
            told["configs"][c.name] = [metrics.as_json(s) for s in metrics.scores(of, seed=args.seed)]
            if args.by:
                told["parts"][c.name] = {name: [metrics.as_json(s) for s in metrics.scores(part, seed=args.seed)]
                                         for name, part in metrics.parts(of, args.by)}  # fmt: skip
        print(json.dumps({**told, "worse": len(worse)}))
    else:
        for c, of in zip(configs, by, strict=True):
            for name, part in metrics.parts(of, args.by):
                print(f"{c.name}: {name or str(len({r['recording'] for r in of})) + ' sources'}")
                print("\n".join(metrics.score_lines(metrics.scores(part, seed=args.seed))))
        if compared:
            print(f"A = {configs[0].name}, B = {configs[1].name}")
            print("\n".join(metrics.difference_lines(compared)))
    if worse:
        names = ", ".join(f"{d.metric.stage} {d.metric.name}" for d in worse)
        raise CheckFailedError(f"{configs[1].name} is worse than {configs[0].name}: {names}")
    return 0


def _bench(args: argparse.Namespace) -> int:
    from tmde_edge.app import bench

    old = bench.read_rows(args.compare) if args.compare is not None else None
    if not args.json:
        print(f"{bench.machine()}\n\n{bench.header()}", flush=True)
    rows = []
    for row in (bench.bench_all if args.what == "all" else bench.bench_detect)(config_of(args), lambda text: say(args, text)):
        rows.append(row)
        print(json.dumps(row.as_dict()) if args.json else bench.line(row), flush=True)
    if old is None:
        return 0
    lines, worse = bench.compared(old, rows)
    for text in lines:
        print(text, file=sys.stderr if args.json else sys.stdout)
    return 1 if worse else 0
