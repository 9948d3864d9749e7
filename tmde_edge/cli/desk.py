"""The desk: recordings, stills and rendered drives; no camera, no bus."""

from __future__ import annotations

import argparse
import signal
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tmde_edge.cli.common import (
    TextOut,
    Verbs,
    base_dir,
    config_of,
    json_line,
    number,
    output_options,
    progress,
    progress_bar,
    say,
    whole_from,
)
from tmde_edge.errors import CheckFailedError, InputDataError, InputMissingError, UsageError


def add_dry_run(parser: argparse.ArgumentParser) -> None:
    """--dry-run and its options, beside the commands."""
    desk = parser.add_argument_group("the desk")
    desk.add_argument(
        "--dry-run", metavar="SOURCE", help="a video, a folder of images, or a printf/glob pattern; no camera, no bus"
    )
    output_options(desk, top=True)
    desk.add_argument("--can-log", metavar="FILE", type=Path, help="candump .log, .asc, .blf, .trc, also .gz")
    desk.add_argument("--can-offset", metavar="SECONDS", type=number, default=0.0, help="t_video = t_can - first + offset")
    desk.add_argument("--fps", metavar="N", type=number, default=30.0, help="rate of images without a frames.csv (default 30)")
    desk.add_argument("--can-out", metavar="FILE", help="the CAN frames that would be sent, as candump -L")
    desk.add_argument("--video-out", metavar="FILE.mp4", type=Path, help="annotated video")
    desk.add_argument("--report", metavar="FOLDER", type=Path, help="HTML report with plots, thumbnails and a summary")
    desk.add_argument("--record", metavar="FILE.mcap", type=Path, help="drive log of every input and output")
    desk.add_argument("--truth", metavar="FILE.csv", type=Path, help="true distances (columns frame, distance_m): adds errors")


def add_measure(verbs: Verbs) -> None:
    sub = verbs.add("measure", _measure, "every still by itself: plates found and their distances")
    sub.add_argument("images", nargs="+", metavar="IMAGE_OR_FOLDER")
    output_options(sub)


def add_simulate(verbs: Verbs) -> None:
    sub = verbs.add("simulate", _simulate, "renders a scenario with exact truth: video.mp4, can.log, truth.csv, config.toml")
    sub.add_argument("scenario", nargs="?", metavar="SCENARIO")
    sub.add_argument("--stills", type=int, metavar="N", help="instead: N photos of one plate each, with labels.csv for evaluate")
    sub.add_argument("--list", action="store_true", help="the scenarios there are")
    sub.add_argument("--out", metavar="FOLDER", type=Path)
    sub.add_argument("--seed", type=whole_from(0), default=0)
    sub.add_argument("--plate", metavar="STANDARD", help="another plate standard than the scenario's own (--stills: de-mittel)")
    sub.add_argument("--all", action="store_true", help="with --check: every scenario")
    sub.add_argument("--check", action="store_true", help="run the desk on it and judge the alerts; exit 1 on a miss")
    sub.add_argument(
        "--no-pictures", action="store_true", help="with --check: sightings drawn from the truth; judges no perception"
    )
    sub.add_argument(
        "--no-video", action="store_true", help="with --check: the rendered pictures themselves, no H.264 between; half the work"
    )
    sub.add_argument(
        "--seeds", type=whole_from(1), default=1, metavar="N", help="with --check: so many seeds, from --seed on"
    )


def add_replay(verbs: Verbs) -> None:
    sub = verbs.add("replay", _replay, "runs a recorded drive again and compares; exit 1 where it differs")
    sub.add_argument("drive_log", metavar="DRIVE_LOG", type=Path)


def add_report(verbs: Verbs) -> None:
    sub = verbs.add("report", _report, "makes the HTML report of kept records (again), with or without the truth")
    sub.add_argument("source", metavar="FOLDER_OR_JSONL", type=Path, help="what --report or --jsonl wrote")
    sub.add_argument("--out", metavar="FOLDER", type=Path, help="default: beside the records")
    sub.add_argument("--truth", metavar="FILE.csv", type=Path, default=argparse.SUPPRESS, help="true distances")


def dry_run(args: argparse.Namespace) -> int:
    """--dry-run SOURCE."""
    from tmde_edge.app.desk import DeskOptions, run_desk

    config = config_of(args)
    stop = {"now": False}

    def interrupted(_signal: int, _frame: object) -> None:  # what was made so far stays whole
        stop["now"] = True

    before = signal.signal(signal.SIGINT, interrupted)
    try:
        with ExitStack() as stack:
            out = stack.enter_context(TextOut(args.jsonl)) if args.jsonl else None
            desk = stack.enter_context(run_desk(
                config,
                base_dir(args),
                DeskOptions(
                    source=args.dry_run, fps=args.fps, can_log=args.can_log, can_offset_s=args.can_offset,
                    video_out=args.video_out, report=args.report, record=args.record, truth=args.truth, can_out=args.can_out,
                ),
            ))  # fmt: skip
            for record in progress(desk, desk.frame_count, "dry run", args.quiet):
                if out is not None:
                    out.write(json_line(record))
                if stop["now"]:
                    break
            summary = desk.finish()
    finally:
        signal.signal(signal.SIGINT, before)
    for line in summary:
        say(args, line)
    return 130 if stop["now"] else 0


def _measure(args: argparse.Namespace) -> int:
    from tmde_edge.app.measure import expand
    from tmde_edge.app.wiring import measure_with

    paths = expand(args.images)
    records = measure_with(config_of(args), paths)
    usable = 0
    with ExitStack() as stack:
        out = stack.enter_context(TextOut(args.jsonl)) if getattr(args, "jsonl", None) else None
        for record in progress(records, len(paths), "measure", args.quiet):
            usable += "error" not in record
            if out is not None:
                out.write(json_line(record))
            if out is None or not out.is_stdout:
                say(args, _still_text(record))
    if not usable:
        first = f"{paths[0]}" if len(paths) == 1 else f"none of {len(paths)} images"
        raise InputDataError(f"{first} could be used; see the error records for the reasons")
    return 0


def _still_text(record: dict[str, Any]) -> str:
    if "error" in record:
        return f"{record['image']}: {record['error']}"
    texts = []
    for p in record["plates"]:
        where = f"at ({p['corners'][0][0]:.0f}, {p['corners'][0][1]:.0f})"
        metres = (
            f"{p['distance_m']:.2f} m +- {p['sigma_m']:.2f}" if p["distance_m"] is not None else p.get("not_ranged", "not ranged")
        )
        texts.append(f"{metres}, {p['characters']} characters {where}")
    return f"{record['image']}: " + ("; ".join(texts) or "no plate")


def _simulate(args: argparse.Namespace) -> int:
    from tmde_edge.app.simulate import list_scenarios, simulate

    if args.list:
        for name, text in list_scenarios():
            print(f"{name:24} {text}")
        return 0
    if args.config is not None:
        raise UsageError(f"simulate -c {args.config}: a scenario has its own configuration; --set changes it (with --check)")
    if args.check:
        return _simulate_check(args)
    if (args.scenario is None) == (args.stills is None) or args.out is None:
        raise UsageError("simulate needs a SCENARIO (`tmde-edge simulate --list`) or --stills N, and --out FOLDER")
    if args.stills is not None:
        from tmde_edge.app.simulate_stills import simulate_stills

        bar = progress_bar("simulate", args.quiet)
        simulate_stills(args.stills, args.out, standard=args.plate or "de-mittel", seed=args.seed, progress=bar)
        say(args, f"{args.stills} stills in {args.out}, labels.csv, config.toml; next: tmde-edge evaluate {args.out}")
        return 0
    made = simulate(args.scenario, args.out, seed=args.seed, plate=args.plate, progress=progress_bar("simulate", args.quiet))
    say(args, f"{made.frame_count} frames in {args.out}: video.mp4, can.log, truth.csv, config.toml")
    return 0


def _simulate_check(args: argparse.Namespace) -> int:
    import tempfile

    from tmde_edge.app.simulate_check import check_scenarios, check_without_pictures, check_without_video

    if (args.scenario is None) == (not args.all):
        raise UsageError("simulate --check needs a SCENARIO or --all")
    names = [args.scenario] if args.scenario is not None else []
    failed = 0
    with tempfile.TemporaryDirectory(prefix="tmde-simulate-") as scratch:
        folder = args.out if args.out is not None else Path(scratch)
        run = check_without_pictures if args.no_pictures else check_without_video if args.no_video else check_scenarios
        seeds = range(args.seed, args.seed + args.seeds)
        for o in run(folder, names=names, seeds=seeds, plate=args.plate, overrides=args.overrides):
            failed += bool(o.faults)
            verdict = f"skipped: {o.skipped}" if o.skipped else "FAILED: " + "; ".join(o.faults) if o.faults else "ok"
            warned = "no warning"
            if o.first_warning_s is not None:
                ttc = "no lead closing" if o.first_warning_ttc_s is None else f"TTC {o.first_warning_ttc_s:.2f} s"
                warned = f"first warning at {o.first_warning_s:.2f} s, {ttc}"
            error = f"median |error| {100 * o.median_error:.2f} %" if o.median_error is not None else "never ranged"
            print(f"{o.name:20} seed {o.seed}  {verdict}  ({warned}, {error})", flush=True)
    return 1 if failed else 0


def _replay(args: argparse.Namespace) -> int:
    from tmde_edge.app.wiring import replay_log

    if not args.drive_log.exists():
        raise InputMissingError(f"{args.drive_log}: no such drive log")
    outcome = replay_log(args.drive_log)
    if outcome.difference is not None:
        raise CheckFailedError(f"{args.drive_log}: {outcome.difference}")
    say(args, f"identical: {outcome.events} events, {outcome.outputs} outputs")
    return 0


def _report(args: argparse.Namespace) -> int:
    from tmde_edge.app.report.writer import rebuild

    say(args, f"report: {rebuild(args.source, args.out, args.truth)}")
    return 0
