"""Verbs and exit codes; the only file that prints."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TextIO, TypeVar

from tmde_edge import __version__
from tmde_edge.errors import CheckFailedError, InputDataError, InputMissingError, ModelError, TmdeError, UsageError

T = TypeVar("T")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code of the contract."""
    args = _parser().parse_args(argv)
    try:
        code: int = _verb(args)(args)
        return code
    except TmdeError as e:
        if args.verbose:
            traceback.print_exc()
        print(f"tmde-edge: {e}", file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing more to flush into the closed pipe
        return 0
    except Exception as e:
        if args.verbose:
            traceback.print_exc()
        print(f"tmde-edge: internal error, please report it: {type(e).__name__}: {e} (-v shows where)", file=sys.stderr)
        return 70


def _verb(args: argparse.Namespace) -> Callable[[argparse.Namespace], int]:
    if args.dry_run is not None:
        if args.verb is not None:
            raise UsageError(f"--dry-run and the command {args.verb!r} exclude each other")
        return _dry_run
    if args.verb is None:
        return _run
    verb: Callable[[argparse.Namespace], int] = args.function
    return verb


# -- arguments -----------------------------------------------------------------------------------------------------------


def _common(parser: argparse.ArgumentParser, *, top: bool = False, several: bool = False) -> None:
    # Sub-commands must not overwrite with their defaults what stood before the verb.
    default: Any = None if top else argparse.SUPPRESS
    flag: Any = False if top else argparse.SUPPRESS
    if several:
        parser.add_argument(
            "-c", "--config", metavar="FILE", type=Path, action="append", dest="config_files", default=[],
            help="configuration (TOML), laid over what a recording brings; give two to compare them",
        )  # fmt: skip
    else:
        parser.add_argument("-c", "--config", metavar="FILE", type=Path, default=default, help="configuration (TOML)")
    parser.add_argument(
        "--set", metavar="TABLE.KEY=VALUE", action="append", dest="overrides", default=[] if top else argparse.SUPPRESS,
        help="set one value, wins over the file; repeatable",
    )  # fmt: skip
    parser.add_argument("-q", "--quiet", action="store_true", default=flag, help="no progress, no summary")
    parser.add_argument("-v", "--verbose", action="store_true", default=flag, help="more detail, tracebacks of errors")


def _outputs(parser: argparse._ActionsContainer, *, top: bool = False) -> None:
    default: Any = None if top else argparse.SUPPRESS
    parser.add_argument("--jsonl", metavar="FILE", default=default, help="JSON lines, one a frame or image; - is stdout")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tmde-edge",
        description="Distance and time to collision from the number plate of the vehicle ahead. Without a command: the service.",
        epilog="Exit codes: 0 done; 1 a check failed; 2 wrong usage; 65 unreadable data; 66 no such input; 69 a model is "
        "missing or broken; 70 our own fault; 74 device failed; 78 bad configuration.",
    )
    parser.add_argument("--version", action="version", version=f"tmde-edge {__version__}")
    _common(parser, top=True)
    desk = parser.add_argument_group("the desk")
    desk.add_argument(
        "--dry-run", metavar="SOURCE", help="a video, a folder of images, or a printf/glob pattern; no camera, no bus"
    )
    _outputs(desk, top=True)
    desk.add_argument("--can-log", metavar="FILE", type=Path, help="candump .log, .asc, .blf, .trc, also .gz")
    desk.add_argument("--can-offset", metavar="SECONDS", type=float, default=0.0, help="t_video = t_can - first + offset")
    desk.add_argument("--fps", metavar="N", type=float, default=30.0, help="rate of image folders (default 30)")
    desk.add_argument("--can-out", metavar="FILE", help="the CAN frames that would be sent, as candump -L")
    desk.add_argument("--video-out", metavar="FILE.mp4", type=Path, help="annotated video")
    desk.add_argument("--report", metavar="FOLDER", type=Path, help="HTML report with plots, thumbnails and a summary")
    desk.add_argument("--record", metavar="FILE.mcap", type=Path, help="drive log of every input and output")
    desk.add_argument("--truth", metavar="FILE.csv", type=Path, help="true distances (columns frame, distance_m): adds errors")
    verbs = parser.add_subparsers(dest="verb", metavar="COMMAND", title="commands")

    def verb(
        name: str, function: Callable[[argparse.Namespace], int], text: str, *, several: bool = False
    ) -> argparse.ArgumentParser:
        sub = verbs.add_parser(name, help=text, description=text)
        _common(sub, several=several)
        sub.set_defaults(function=function)
        return sub

    verb("run", _run, "the service: camera in, CAN out, until SIGTERM")
    sub = verb("measure", _measure, "every still by itself: plates found and their distances")
    sub.add_argument("images", nargs="+", metavar="IMAGE_OR_FOLDER")
    _outputs(sub)
    sub = verb("simulate", _simulate, "renders a scenario with exact truth: video.mp4, can.log, truth.csv, config.toml")
    sub.add_argument("scenario", nargs="?", metavar="SCENARIO")
    sub.add_argument("--list", action="store_true", help="the scenarios there are")
    sub.add_argument("--out", metavar="FOLDER", type=Path)
    sub.add_argument("--seed", type=int, default=0)
    sub.add_argument("--plate", metavar="STANDARD", help="another plate standard than the scenario's own")
    sub.add_argument("--all", action="store_true", help="with --check: every scenario")
    sub.add_argument("--check", action="store_true", help="run the desk on it and judge the alerts; exit 1 on a miss")
    sub.add_argument(
        "--no-pictures", action="store_true", help="with --check: sightings drawn from the truth; judges no perception"
    )
    sub.add_argument("--seeds", type=int, default=1, metavar="N", help="with --check: seeds 0 to N-1")
    sub = verb("replay", _replay, "runs a recorded drive again and compares; exit 1 where it differs")
    sub.add_argument("drive_log", metavar="DRIVE_LOG", type=Path)
    sub = verb("report", _report, "makes the HTML report of kept records (again), with or without the truth")
    sub.add_argument("source", metavar="FOLDER_OR_JSONL", type=Path, help="what --report or --jsonl wrote")
    sub.add_argument("--out", metavar="FOLDER", type=Path, help="default: beside the records")
    sub.add_argument("--truth", metavar="FILE.csv", type=Path, default=argparse.SUPPRESS, help="true distances")
    sub = verb("view", _view, "the web page: over a recording, the configured camera (-c), or the service that runs")
    sub.add_argument("source", nargs="?", metavar="SOURCE", help="a recording as for --dry-run; played again and again")
    sub.add_argument("--can-log", metavar="FILE", type=Path, default=argparse.SUPPRESS, help="CAN beside the recording")
    sub.add_argument("--can-offset", metavar="SECONDS", type=float, default=argparse.SUPPRESS, help="as for --dry-run")
    sub.add_argument("--fps", metavar="N", type=float, default=argparse.SUPPRESS, help="rate of image folders (default 30)")
    sub.add_argument("--host", default=None, help="address to listen on (default view.host: this machine only)")
    sub.add_argument("--port", type=int, default=None, help="port (default view.port: 8470)")
    verb("check-config", _check_config, "reads a configuration and prints every value in force")
    sub = verb("plates", _plates, "the plate standards")
    sub.add_argument("action", choices=["list", "show"])
    sub.add_argument("ids", nargs="*", metavar="ID")
    sub = verb("range-budget", _range_budget, "what this camera can measure at which distance")
    sub.add_argument("--json", action="store_true", help="rows as JSON lines")
    sub = verb("models", _models, "the depth networks: where they come from, checksums, int8")
    sub.add_argument("action", choices=["list", "fetch", "verify", "quantize"])
    sub.add_argument("names", nargs="*", metavar="NAME")
    sub.add_argument("--from", dest="from_file", metavar="FILE", type=Path, help="fetch: from a file instead of the network")
    sub.add_argument(
        "--frames", nargs="+", metavar="SOURCE", default=[], help="quantize: recordings or folders of your own roads"
    )
    sub = verb("status", _status, "how is the running service: rates, latencies, queues, temperature, faults, last alerts")
    sub.add_argument("--json", action="store_true", help="one JSON object")
    sub.add_argument("--follow", action="store_true", help="again each second until interrupted")
    sub.add_argument("--socket", metavar="PATH", default="", help="of the service (default: runtime.status_socket)")
    sub = verb("incident", _incident, "some seconds of a drive as a folder: frames, CAN, decisions, configuration, calibration")
    sub.add_argument("folder", nargs="?", metavar="FOLDER", type=Path, help="of the recordings (default: record.folder)")
    which = sub.add_mutually_exclusive_group()
    which.add_argument("--last", action="store_true", help="the last alert in the ring of drive logs (the default)")
    which.add_argument("--at", metavar="TIME", help="a moment in the ring, such as 2026-11-22T06:35:12Z (without Z: local time)")
    which.add_argument("--kept", metavar="NAME", nargs="?", const="", help="an incident that was kept by itself; the newest")
    which.add_argument("--now", metavar="NOTE", nargs="?", const="", help="ask the running service to keep the last seconds")
    which.add_argument("--list", action="store_true", help="what is kept")
    sub.add_argument("--out", metavar="FOLDER", type=Path, help="where to (default: incident-... here)")
    sub.add_argument("--before", metavar="SECONDS", type=float, default=10.0)
    sub.add_argument("--after", metavar="SECONDS", type=float, default=10.0)
    sub = verb("can", _can, "lets the service speak on the bus, or silences it")
    sub.add_argument("action", choices=["enable-transmit", "disable-transmit"])
    sub.add_argument("--yes", action="store_true", help="do not ask")
    sub.add_argument("--seconds", type=float, default=60.0, metavar="N", help="how long to listen for collisions (default 60)")
    sub.add_argument("--empty-bus", action="store_true", help="a bus without any traffic is right (a display of our own)")
    sub = verb("shadow-report", _shadow_report, "what would have been said: false-alarm candidates per 100 km and per hour")
    sub.add_argument("folder", nargs="?", metavar="FOLDER", type=Path, help="of the recordings (default: record.folder)")
    sub.add_argument("--html", metavar="FILE", type=Path, help="a page with the pictures")
    sub.add_argument("--json", action="store_true", help="one JSON object")
    sub = verb("doctor", _doctor, "is this board ready: camera, CAN, models, calibration, heat, power, disk; exit 1 if not")
    sub.add_argument("--json", action="store_true", help="one JSON object")
    sub = verb("calibrate", _calibrate, "focal length and lens from a plate or a board at known distances")
    _calibrate_options(sub)
    sub = verb("evaluate", _evaluate, "judges many recordings or labelled stills; compares two configurations", several=True)
    sub.add_argument("sources", nargs="+", metavar="SOURCE", help="folders with video and truth.csv, with labels.csv; drive logs")
    sub.add_argument("--jobs", type=int, metavar="N", help="processes (default: one a core)")
    sub.add_argument("--out", type=Path, metavar="FILE", help="every row: .csv, or .parquet where pyarrow is there")
    sub.add_argument("--json", action="store_true", help="the numbers as one JSON object")
    sub.add_argument("--seed", type=int, default=0, help="of the bootstrap")
    sub = verb("bench", _bench, "how fast here: p50, p95, p99 of each stage by resolution")
    sub.add_argument("what", nargs="?", choices=["all", "detect"], default="all", help="detect: perception alone")
    sub.add_argument("--json", action="store_true", help="rows as JSON lines")
    sub.add_argument("--compare", metavar="FILE", type=Path, default=None, help="an earlier run's --json; exit 1 where slower")
    sub = verb("completion", _completion, "completion for your shell: see docs/quickstart.md")
    sub.add_argument("shell", choices=["bash", "zsh"])
    return parser


def _calibrate_options(sub: argparse.ArgumentParser) -> None:
    what = sub.add_argument_group("what to calibrate with (default: a plate before the live camera, with prompts)")
    what.add_argument("--images", nargs="+", metavar="FILE", default=[], help="stills, or folders of them")
    what.add_argument("--video", metavar="FILE", help="a video; its sharp frames are picked")
    what.add_argument("--at", nargs="+", type=float, metavar="SECONDS", default=[], help="--video: when each capture is")
    what.add_argument("--live", action="store_true", help="the camera of the configuration, also with --camera")
    what.add_argument("--distances", nargs="+", type=float, metavar="M", default=[], help="one a capture (default 2 5 10)")
    what.add_argument("--standard", metavar="ID", help="the plate; `tmde-edge plates list`")
    what.add_argument("--plate-mm", metavar="WxH", help="this plate's size by a ruler: surer than its standard")
    what.add_argument("--char-mm", type=float, metavar="MM", help="height of its characters by a ruler")
    what.add_argument("--straight", action="store_true", help="distances are from lens to plate, not along the road")
    what.add_argument("--fit-offset", action="store_true", help="the tape's beginning against the lens is a second unknown")
    what.add_argument("--tape-sigma-m", type=float, default=0.005, metavar="M", help="error of a distance (default 0.005)")
    what.add_argument("--chessboard", metavar="CxR", help="a board of so many inner corners instead of a plate")
    what.add_argument("--charuco", metavar="CxR", help="a ChArUco board of so many squares")
    what.add_argument("--dictionary", default="DICT_4X4_50", metavar="NAME", help="--charuco: its markers")
    what.add_argument("--marker-share", type=float, default=0.75, metavar="X", help="--charuco: marker side over square side")
    what.add_argument("--legacy-pattern", action="store_true", help="--charuco: a board of OpenCV before 4.6")
    other = sub.add_argument_group("other ways, and afterwards")
    other.add_argument("--camera", metavar="NAME", help="a known camera's prior until calibrated, 5 %%; `list` names them")
    other.add_argument("--lens-mm", type=float, metavar="MM", help="--camera: its exchangeable lens")
    other.add_argument("--import", dest="import_file", metavar="FILE", type=Path, help="ROS camera_info or OpenCV YAML")
    other.add_argument("--export", dest="export_file", metavar="FILE", type=Path, help="the configuration's calibration")
    other.add_argument("--format", choices=["ros", "opencv"], default="ros", help="--export: which YAML (default ros)")
    other.add_argument("--check", action="store_true", help="a plate at one known distance: pass or fail in one line")
    other.add_argument("--tolerance", type=float, default=0.03, metavar="X", help="--check: allowed error (default 0.03)")
    other.add_argument("--camera-id", default="", metavar="TEXT", help="which camera this is, for the record")


def _config(args: argparse.Namespace) -> Any:
    from tmde_edge.config import load

    return load(args.config, args.overrides)


# -- helpers of the verbs ------------------------------------------------------------------------------------------------


@contextmanager
def _text_out(name: str) -> Iterator[TextIO]:
    """A file for text, or stdout for '-'."""
    if name == "-":
        yield sys.stdout
        return
    try:
        with open(name, "w", encoding="utf-8") as f:
            yield f
    except OSError as e:
        raise UsageError(f"{name}: cannot be written ({e.strerror or e})") from None


def _progress(items: Iterable[T], total: int | None, text: str, quiet: bool) -> Iterator[T]:
    """Passes items on; a bar with ETA on stderr when that is a terminal."""
    if quiet or not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track

    yield from track(items, description=text, total=total, console=Console(stderr=True))


def _bar(text: str, quiet: bool) -> Callable[[int, int], None] | None:
    """A progress callback (done, total) drawing a bar on a terminal; None where nothing is to be drawn."""
    if quiet or not sys.stderr.isatty():
        return None
    from rich.console import Console
    from rich.progress import Progress

    progress = Progress(console=Console(stderr=True))
    task = progress.add_task(text, total=None)
    progress.start()

    def show(done: int, total: int) -> None:
        progress.update(task, completed=done, total=total or None)
        if total and done >= total:
            progress.stop()

    return show


def _say(args: argparse.Namespace, text: str) -> None:
    """A line for people: stderr, so that stdout stays for data."""
    if not args.quiet:
        print(text, file=sys.stderr)


def _line(record: dict[str, Any]) -> str:
    return json.dumps(record, allow_nan=False, separators=(",", ":"), ensure_ascii=False) + "\n"


# -- verbs ---------------------------------------------------------------------------------------------------------------


def _run(args: argparse.Namespace) -> int:
    from tmde_edge.app.service import serve

    return serve(_config(args), base_dir=_base_dir(args), log_line=lambda text: print(text, file=sys.stderr, flush=True))


def _base_dir(args: argparse.Namespace) -> Path:
    """Relative paths in a configuration are relative to its file."""
    return args.config.resolve().parent if args.config is not None else Path.cwd()


def _dry_run(args: argparse.Namespace) -> int:
    from tmde_edge.app.desk import DeskOptions, run_desk

    config = _config(args)
    stop = {"now": False}

    def interrupted(_signal: int, _frame: object) -> None:  # what was made so far stays whole
        stop["now"] = True

    before = signal.signal(signal.SIGINT, interrupted)
    try:
        with ExitStack() as stack:
            out = stack.enter_context(_text_out(args.jsonl)) if args.jsonl else None
            desk = run_desk(
                config,
                _base_dir(args),
                DeskOptions(
                    source=args.dry_run, fps=args.fps, can_log=args.can_log, can_offset_s=args.can_offset,
                    video_out=args.video_out, report=args.report, record=args.record, truth=args.truth, can_out=args.can_out,
                ),
            )  # fmt: skip
            for record in _progress(desk, desk.frame_count, "dry run", args.quiet):
                if out is not None:
                    out.write(_line(record))
                if stop["now"]:
                    break
            summary = desk.finish()
    finally:
        signal.signal(signal.SIGINT, before)
    for line in summary:
        _say(args, line)
    return 130 if stop["now"] else 0


def _measure(args: argparse.Namespace) -> int:
    from tmde_edge.app.measure import expand
    from tmde_edge.app.wiring import measure_with

    paths = expand(args.images)
    records = measure_with(_config(args), paths)
    usable = 0
    with ExitStack() as stack:
        out = stack.enter_context(_text_out(args.jsonl)) if getattr(args, "jsonl", None) else None
        for record in _progress(records, len(paths), "measure", args.quiet):
            usable += "error" not in record
            if out is not None:
                out.write(_line(record))
            if out is not sys.stdout:
                _say(args, _still_text(record))
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
    if args.check:
        return _simulate_check(args)
    if args.scenario is None or args.out is None:
        raise UsageError("simulate needs a SCENARIO and --out FOLDER; `tmde-edge simulate --list` names the scenarios")
    made = simulate(args.scenario, args.out, seed=args.seed, plate=args.plate, progress=_bar("simulate", args.quiet))
    _say(args, f"{made.frame_count} frames in {args.out}: video.mp4, can.log, truth.csv, config.toml")
    return 0


def _simulate_check(args: argparse.Namespace) -> int:
    import tempfile

    from tmde_edge.app.simulate_check import check_scenarios, check_without_pictures

    if (args.scenario is None) == (not args.all):
        raise UsageError("simulate --check needs a SCENARIO or --all")
    names = [args.scenario] if args.scenario is not None else []
    failed = 0
    with tempfile.TemporaryDirectory(prefix="tmde-simulate-") as scratch:
        folder = args.out if args.out is not None else Path(scratch)
        run = check_without_pictures if args.no_pictures else check_scenarios
        for o in run(folder, names=names, seeds=range(args.seeds), overrides=args.overrides):
            failed += bool(o.faults)
            verdict = f"skipped: {o.skipped}" if o.skipped else "FAILED: " + "; ".join(o.faults) if o.faults else "ok"
            warned = f"first warning at TTC {o.first_warning_ttc_s:.2f} s" if o.first_warning_ttc_s is not None else "no warning"
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
    _say(args, f"identical: {outcome.events} events, {outcome.outputs} outputs")
    return 0


def _report(args: argparse.Namespace) -> int:
    from tmde_edge.app.report.writer import rebuild

    _say(args, f"report: {rebuild(args.source, args.out, args.truth)}")
    return 0


def _view(args: argparse.Namespace) -> int:
    import msgspec

    from tmde_edge.app.view.run import view_camera, view_recording, view_service

    config = _config(args)
    given = {k: v for k, v in (("host", args.host), ("port", args.port)) if v is not None}
    config = msgspec.structs.replace(config, view=msgspec.structs.replace(config.view, **given))
    if args.can_log is not None and args.source is None:
        raise UsageError("view --can-log needs a SOURCE to play it beside")
    def say(text: str) -> None:
        _say(args, text)

    if args.source is not None:
        return view_recording(config, _base_dir(args), args.source, args.fps, args.can_log, args.can_offset, say)
    return view_camera(config, _base_dir(args), say) if args.config is not None else view_service(config, say)


def _check_config(args: argparse.Namespace) -> int:
    from tmde_edge.app.wiring import check_parts
    from tmde_edge.config import to_tree

    config = _config(args)
    notes = check_parts(config, _base_dir(args))
    print(json.dumps(to_tree(config), indent=1, allow_nan=False))
    for note in notes:
        _say(args, note)
    return 0


def _plates(args: argparse.Namespace) -> int:
    from tmde_edge.app.plates import list_lines, show_lines

    for line in list_lines() if args.action == "list" else show_lines(args.ids):
        print(line)
    return 0


def _range_budget(args: argparse.Namespace) -> int:
    from tmde_edge.app.plates import budget_lines

    for line in budget_lines(_config(args), as_json=args.json):
        print(line)
    return 0


def _models(args: argparse.Namespace) -> int:
    from tmde_edge.adapters.depth.manifest import models_folder
    from tmde_edge.app import models

    config = _config(args)
    folder = models_folder(config.depth.folder)
    names = args.names or [config.depth.model]
    if args.action == "list":
        for m in models.list_models(folder):
            print(f"{m.spec.name:28} {m.state:8} {m.spec.bytes:>11} bytes  {m.spec.licence:12} {m.detail or m.path}")
    elif args.action == "verify":
        states = models.verify_models(folder, args.names or None)
        for m in states:
            print(f"{m.spec.name:28} {m.state:8} {m.detail}")
        if not states:
            _say(args, f"no network in {folder}; run `tmde-edge models fetch {config.depth.model}`")
        if any(m.state != "present" for m in states):
            raise ModelError(f"{folder}: not every network is right; run `tmde-edge models fetch NAME` for the broken ones")
    elif args.action == "fetch":
        for name in names:
            got = models.fetch_model(name, folder, from_file=args.from_file, progress=_bar(name, args.quiet))
            _say(args, f"{name}: {'was there already' if got.already_there else f'{got.bytes} bytes'} in {got.path}")
    else:
        from tmde_edge.app.quantize import calibration_frames, quantize_model

        if not args.frames:
            raise UsageError("models quantize needs --frames SOURCE...: recordings or folders of images of your own roads")
        frames = calibration_frames(args.frames)
        for name in names:
            made = quantize_model(name, folder, frames, progress=_bar(f"quantize {name}", args.quiet))
            a = made.agreement
            _say(
                args,
                f"{made.spec.name}: {made.bytes} bytes; on {a.frames} held-out frames correlation {a.correlation:.3f}, "
                f"differs by {a.relative_difference:.1%}; {a.float_ms:.0f} ms float, {a.int8_ms:.0f} ms int8",
            )
    return 0


def _status(args: argparse.Namespace) -> int:
    import time

    from tmde_edge.app.status import ask, lines_of, socket_path

    path = socket_path(args.socket or _config(args).runtime.status_socket)
    while True:
        answer = ask(path, {"request": "status"})
        print(json.dumps(answer) if args.json else "\n".join(lines_of(answer)), flush=True)
        if not args.follow:
            return 0
        time.sleep(1.0)
        if not args.json:
            print()


def _incident(args: argparse.Namespace) -> int:
    from tmde_edge.app import incidents

    config = _config(args)
    folder = args.folder or Path(config.record.folder)
    if args.list:
        for line in incidents.list_lines(folder):
            print(line)
        return 0
    if args.now is not None:
        print(incidents.ask_now(config.runtime.status_socket, args.now))
        return 0
    made = incidents.take_out(
        folder, out=args.out, at=args.at, kept=args.kept, before_s=args.before, after_s=args.after
    )
    c = made.counts
    _say(args, f"{made.what}: {c['frames']} frames, {c['can_frames']} CAN frames, {c['decisions']} decisions in {made.out}")
    return 0


def _can(args: argparse.Namespace) -> int:
    from tmde_edge.app import can_transmit

    path = args.config if args.config is not None else Path("/etc/tmde-edge/config.toml")
    if args.overrides:
        raise UsageError("can: --set changes no file; edit the configuration, or name it with -c")
    if args.seconds <= 0:
        raise UsageError(f"can: --seconds {args.seconds:g}: give how long to listen, such as 60")
    on = args.action == "enable-transmit"
    settings, changes, notes = can_transmit.plan(path, on)
    where = f"{settings.interface} {settings.channel}"
    if on and any(change.new is not None for change in changes):
        ids = ", ".join(f"{can_transmit.id_text(key)} ({name})" for key, name in can_transmit.own_ids(settings).items())
        _say(args, f"this will send on {where}: {ids}")
        if not args.yes:
            if not sys.stdin.isatty():
                raise UsageError("can enable-transmit asks before it changes anything, and there is no terminal; add --yes")
            if input(f"listen {args.seconds:.0f} s for collisions, then let it send? [y/N] ").strip().lower() not in ("y", "yes"):
                _say(args, "nothing is changed")
                return 1
        bar = _bar("listening", args.quiet)
        total = round(args.seconds)
        heard = can_transmit.listen(settings, args.seconds, lambda s, _: bar(min(round(s), total), total) if bar else None)
        can_transmit.judge(settings, heard, empty_bus=args.empty_bus)
        _say(args, f"{where}: {heard.frames} frames of {len(heard.ids)} ids in {args.seconds:.0f} s, none of them ours")
    for line in can_transmit.apply(changes):
        print(line)
    for note in notes:
        _say(args, note)
    if any(change.new is not None for change in changes):
        _say(args, f"to make it so: {can_transmit.restart_hint(settings, changes)}")
    return 0


def _shadow_report(args: argparse.Namespace) -> int:
    from tmde_edge.app import shadow

    report = shadow.read_shadow(args.folder or Path(_config(args).record.folder))
    if args.html is not None:
        try:
            shadow.write_html(report, args.html)
        except OSError as e:
            raise UsageError(f"--html {args.html}: cannot be written ({e.strerror or e})") from None
    print(json.dumps(shadow.as_json(report)) if args.json else "\n".join(shadow.lines_of(report)))
    return 0


def _doctor(args: argparse.Namespace) -> int:
    from tmde_edge.app import doctor
    from tmde_edge.app.status import ask, socket_path

    config = _config(args)

    def status() -> dict[str, Any] | None:
        try:
            return ask(socket_path(config.runtime.status_socket), {"request": "status"})
        except TmdeError:
            return None

    running = status()
    checks = doctor.examine(config, doctor.Surroundings(status=lambda: running), args.config, _base_dir(args))
    print(doctor.as_json(checks) if args.json else "\n".join(check.line() for check in checks))
    return 1 if any(check.state == "fail" for check in checks) else 0


def _evaluate(args: argparse.Namespace) -> int:
    from tmde_edge.app import evaluate as ev
    from tmde_edge.app import evaluate_metrics as metrics

    if args.jobs is not None and args.jobs < 1:
        raise UsageError(f"--jobs {args.jobs}: at least 1")
    configs = ev.candidates([*([args.config] if args.config is not None else []), *args.config_files], args.overrides)
    items = ev.find_items(args.sources)
    rows: list[dict[str, Any]] = []
    done = ev.evaluate(items, configs, args.jobs or ev.default_jobs())
    for part in _progress(done, len(items) * len(configs), "evaluate", args.quiet):
        rows += part
    rows.sort(key=lambda r: (r["config"], r["recording"], r["frame"]))
    if args.out is not None:
        ev.write_rows(args.out, rows)
        _say(args, f"{len(rows)} rows in {args.out}")
    by = [[r for r in rows if r["config"] == c.name] for c in configs]
    scored = [metrics.scores(part, seed=args.seed) for part in by]
    compared = metrics.compare(by[0], by[1], seed=args.seed) if len(by) == 2 else []
    worse = [d for d in compared if d.worse]
    if args.json:
        told = {c.name: [metrics.as_json(s) for s in found] for c, found in zip(configs, scored, strict=True)}
        print(json.dumps({"configs": told, "differences": [metrics.as_json(d) for d in compared], "worse": len(worse)}))
    else:
        for c, found in zip(configs, scored, strict=True):
            print(f"{c.name}: {len({r['recording'] for r in rows})} sources")
            print("\n".join(metrics.score_lines(found)))
        if compared:
            print(f"A = {configs[0].name}, B = {configs[1].name}")
            print("\n".join(metrics.difference_lines(compared)))
    if worse:
        names = ", ".join(f"{d.metric.stage} {d.metric.name}" for d in worse)
        raise CheckFailedError(f"{configs[1].name} is worse than {configs[0].name}: {names}")
    return 0


def _calibrate(args: argparse.Namespace) -> int:
    from tmde_edge.app.calibrate import CalibrateOptions, calibrate
    from tmde_edge.calibration.board import Board, parse_size
    from tmde_edge.calibration.plate import parse_mm
    from tmde_edge.config import load

    board = None
    if args.chessboard and args.charuco:
        raise UsageError("--chessboard and --charuco exclude each other")
    if args.chessboard or args.charuco:
        kind = "chessboard" if args.chessboard else "charuco"
        columns, rows = parse_size(args.chessboard or args.charuco, f"--{kind}")
        board = Board(kind=kind, columns=columns, rows=rows, dictionary=args.dictionary, marker_share=args.marker_share,
                      legacy=args.legacy_pattern)  # fmt: skip
    plate = parse_mm(args.plate_mm) if args.plate_mm else None
    options = CalibrateOptions(
        config_file=args.config, images=tuple(args.images), video=args.video, at_s=tuple(args.at), live=args.live,
        distances_m=tuple(args.distances), standard=args.standard, plate_mm=plate, char_mm=args.char_mm,
        straight=args.straight, fit_offset=args.fit_offset, tape_sigma_m=args.tape_sigma_m, camera=args.camera,
        lens_mm=args.lens_mm, board=board, import_file=args.import_file, export_file=args.export_file,
        export_kind=args.format, check=args.check, tolerance=args.tolerance, camera_id=args.camera_id,
    )  # fmt: skip
    there = args.config is not None and args.config.exists()  # a new file is made
    config = load(args.config if there else None, args.overrides)

    def ask(prompt: str) -> str | None:
        print(prompt, end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        return line if line else None

    return calibrate(config, _base_dir(args), options, ask, lambda text: _say(args, text), print)


def _bench(args: argparse.Namespace) -> int:
    from tmde_edge.app import bench

    old = bench.read_rows(args.compare) if args.compare is not None else None
    if not args.json:
        print(f"{bench.machine()}\n\n{bench.header()}", flush=True)
    rows = []
    for row in (bench.bench_all if args.what == "all" else bench.bench_detect)(_config(args), lambda text: _say(args, text)):
        rows.append(row)
        print(json.dumps(row.as_dict()) if args.json else bench.line(row), flush=True)
    if old is None:
        return 0
    lines, worse = bench.compared(old, rows)
    for text in lines:
        print(text, file=sys.stderr if args.json else sys.stdout)
    return 1 if worse else 0


def _completion(args: argparse.Namespace) -> int:
    from tmde_edge.app.completion import script

    print(script(_parser(), args.shell))
    return 0


if __name__ == "__main__":
    sys.exit(main())
