"""The service in the vehicle, how it is, and what it kept."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from tmde_edge.cli.common import Verbs, base_dir, config_of, number, say, use_installed
from tmde_edge.errors import UsageError, writing


def add_run(verbs: Verbs) -> None:
    verbs.add("run", run, "the service: camera in, CAN out, until SIGTERM")


def add_view(verbs: Verbs) -> None:
    sub = verbs.add("view", _view, "the web page: over a recording, the configured camera (-c), or the service that runs")
    sub.add_argument("source", nargs="?", metavar="SOURCE", help="a recording as for --dry-run; played again and again")
    sub.add_argument("--can-log", metavar="FILE", type=Path, default=argparse.SUPPRESS, help="CAN beside the recording")
    sub.add_argument("--can-offset", metavar="SECONDS", type=number, default=argparse.SUPPRESS, help="as for --dry-run")
    sub.add_argument("--fps", metavar="N", type=number, default=argparse.SUPPRESS, help="rate of image folders (default 30)")
    sub.add_argument("--host", default=None, help="address to listen on (default view.host: this machine only)")
    sub.add_argument("--port", type=int, default=None, help="port (default view.port: 8470)")


def add_status(verbs: Verbs) -> None:
    sub = verbs.add("status", _status, "how is the running service: rates, latencies, queues, temperature, faults, last alerts")
    sub.add_argument("--json", action="store_true", help="one JSON object")
    sub.add_argument("--follow", action="store_true", help="again each second until interrupted")
    sub.add_argument("--socket", metavar="PATH", default="", help="of the service (default: runtime.status_socket)")


def add_incident(verbs: Verbs) -> None:
    sub = verbs.add(
        "incident", _incident, "some seconds of a drive as a folder: frames, CAN, decisions, configuration, calibration"
    )
    sub.add_argument("folder", nargs="?", metavar="FOLDER", type=Path, help="of the recordings (default: record.folder)")
    which = sub.add_mutually_exclusive_group()
    which.add_argument("--last", action="store_true", help="the last alert in the ring of drive logs (the default)")
    which.add_argument("--at", metavar="TIME", help="a moment in the ring, such as 2026-11-22T06:35:12Z (without Z: local time)")
    which.add_argument("--kept", metavar="NAME", nargs="?", const="", help="an incident that was kept by itself; the newest")
    which.add_argument("--now", metavar="NOTE", nargs="?", const="", help="ask the running service to keep the last seconds")
    which.add_argument("--list", action="store_true", help="what is kept")
    sub.add_argument("--out", metavar="FOLDER", type=Path, help="where to (default: incident-... here)")
    sub.add_argument("--before", metavar="SECONDS", type=number, default=10.0)
    sub.add_argument("--after", metavar="SECONDS", type=number, default=10.0)


def add_shadow_report(verbs: Verbs) -> None:
    sub = verbs.add("shadow-report", _shadow_report, "what would have been said: false-alarm candidates per 100 km and per hour")
    sub.add_argument("folder", nargs="?", metavar="FOLDER", type=Path, help="of the recordings (default: record.folder)")
    sub.add_argument("--html", metavar="FILE", type=Path, help="a page with the pictures")
    sub.add_argument("--json", action="store_true", help="one JSON object")


def run(args: argparse.Namespace) -> int:
    """The service; also what runs without a command."""
    from tmde_edge.app.service import serve

    return serve(config_of(args), base_dir=base_dir(args), log_line=lambda text: print(text, file=sys.stderr, flush=True))


def _view(args: argparse.Namespace) -> int:
    import msgspec

    from tmde_edge.app.view.run import view_camera, view_recording, view_service

    config = config_of(args)
    given = {k: v for k, v in (("host", args.host), ("port", args.port)) if v is not None}
    config = msgspec.structs.replace(config, view=msgspec.structs.replace(config.view, **given))
    if args.can_log is not None and args.source is None:
        raise UsageError("view --can-log needs a SOURCE to play it beside")

    def tell(text: str) -> None:
        say(args, text)

    if args.source is not None:
        return view_recording(config, base_dir(args), args.source, args.fps, args.can_log, args.can_offset, tell)
    return view_camera(config, base_dir(args), tell) if args.config is not None else view_service(config, tell)


def _status(args: argparse.Namespace) -> int:
    import time

    from tmde_edge.app.status import ask, lines_of, socket_path

    use_installed(args)
    path = socket_path(args.socket or config_of(args).runtime.status_socket)
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

    use_installed(args)
    config = config_of(args)
    folder = args.folder or Path(config.record.folder)
    if args.list:
        for line in incidents.list_lines(folder):
            print(line)
        return 0
    if args.now is not None:
        print(incidents.ask_now(config.runtime.status_socket, args.now))
        return 0
    made = incidents.take_out(folder, out=args.out, at=args.at, kept=args.kept, before_s=args.before, after_s=args.after)
    c = made.counts
    say(args, f"{made.what}: {c['frames']} frames, {c['can_frames']} CAN frames, {c['decisions']} decisions in {made.out}")
    return 0


def _shadow_report(args: argparse.Namespace) -> int:
    from tmde_edge.app import shadow

    use_installed(args)
    report = shadow.read_shadow(args.folder or Path(config_of(args).record.folder))
    if args.html is not None:
        with writing(f"--html {args.html}"):
            shadow.write_html(report, args.html)
    print(json.dumps(shadow.as_json(report)) if args.json else "\n".join(shadow.lines_of(report)))
    return 0
