"""Making a board ready: configuration, plates, networks, the bus, and whether it all is right."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from tmde_edge.cli.common import INSTALLED, Verbs, base_dir, config_of, number, progress_bar, say, use_installed
from tmde_edge.errors import ModelError, TmdeError, UsageError


def add_check_config(verbs: Verbs) -> None:
    verbs.add("check-config", _check_config, "reads a configuration and prints every value in force")


def add_plates(verbs: Verbs) -> None:
    sub = verbs.add("plates", _plates, "the plate standards")
    sub.add_argument("action", choices=["list", "show"])
    sub.add_argument("ids", nargs="*", metavar="ID")


def add_range_budget(verbs: Verbs) -> None:
    sub = verbs.add("range-budget", _range_budget, "what this camera can measure at which distance")
    sub.add_argument("--json", action="store_true", help="rows as JSON lines")


def add_models(verbs: Verbs) -> None:
    sub = verbs.add("models", _models, "the depth networks: where they come from, checksums, int8")
    sub.add_argument("action", choices=["list", "fetch", "verify", "quantize"])
    sub.add_argument("names", nargs="*", metavar="NAME")
    sub.add_argument("--from", dest="from_file", metavar="FILE", type=Path, help="fetch: from a file instead of the network")
    sub.add_argument(
        "--frames", nargs="+", metavar="SOURCE", default=[], help="quantize: recordings or folders of your own roads"
    )


def add_can(verbs: Verbs) -> None:
    sub = verbs.add("can", _can, "lets the service speak on the bus, or silences it")
    sub.add_argument("action", choices=["enable-transmit", "disable-transmit"])
    sub.add_argument("--yes", action="store_true", help="do not ask")
    sub.add_argument("--seconds", type=number, default=60.0, metavar="N", help="how long to listen for collisions (default 60)")
    sub.add_argument("--empty-bus", action="store_true", help="a bus without any traffic is right (a display of our own)")


def add_doctor(verbs: Verbs) -> None:
    sub = verbs.add("doctor", _doctor, "is this board ready: camera, CAN, models, calibration, heat, power, disk; exit 1 if not")
    sub.add_argument("--json", action="store_true", help="one JSON object")


def _check_config(args: argparse.Namespace) -> int:
    from tmde_edge.app.wiring import check_parts
    from tmde_edge.config import to_tree

    use_installed(args)
    config = config_of(args)
    notes = check_parts(config, base_dir(args))
    print(json.dumps(to_tree(config), indent=1, allow_nan=False))
    for note in notes:
        say(args, note)
    return 0


def _plates(args: argparse.Namespace) -> int:
    from tmde_edge.app.plates import list_lines, show_lines

    for line in list_lines() if args.action == "list" else show_lines(args.ids):
        print(line)
    return 0


def _range_budget(args: argparse.Namespace) -> int:
    from tmde_edge.app.plates import budget_lines

    for line in budget_lines(config_of(args), as_json=args.json):
        print(line)
    return 0


def _models(args: argparse.Namespace) -> int:
    from tmde_edge.adapters.depth.manifest import models_folder
    from tmde_edge.app import models

    config = config_of(args)
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
            say(args, f"no network in {folder}; run `tmde-edge models fetch {config.depth.model}`")
        if any(m.state != "present" for m in states):
            raise ModelError(f"{folder}: not every network is right; run `tmde-edge models fetch NAME` for the broken ones")
    elif args.action == "fetch":
        for name in names:
            got = models.fetch_model(name, folder, from_file=args.from_file, progress=progress_bar(name, args.quiet))
            say(args, f"{name}: {'was there already' if got.already_there else f'{got.bytes} bytes'} in {got.path}")
    else:
        from tmde_edge.app.quantize import calibration_frames, quantize_model

        if not args.frames:
            raise UsageError("models quantize needs --frames SOURCE...: recordings or folders of images of your own roads")
        frames = calibration_frames(args.frames)
        for name in names:
            made = quantize_model(name, folder, frames, progress=progress_bar(f"quantize {name}", args.quiet))
            a = made.agreement
            say(
                args,
                f"{made.spec.name}: {made.bytes} bytes; on {a.frames} held-out frames correlation {a.correlation:.3f}, "
                f"differs by {a.relative_difference:.1%}; {a.float_ms:.0f} ms float, {a.int8_ms:.0f} ms int8",
            )
    return 0


def _can(args: argparse.Namespace) -> int:
    from tmde_edge.app import can_transmit

    path = args.config if args.config is not None else INSTALLED
    if args.overrides:
        raise UsageError("can: --set changes no file; edit the configuration, or name it with -c")
    if args.seconds <= 0:
        raise UsageError(f"can: --seconds {args.seconds:g}: give how long to listen, such as 60")
    on = args.action == "enable-transmit"
    settings, changes, notes = can_transmit.plan(path, on)
    where = f"{settings.interface} {settings.channel}"
    if on and any(change.new is not None for change in changes):
        ids = ", ".join(f"{can_transmit.id_text(key)} ({name})" for key, name in can_transmit.own_ids(settings).items())
        say(args, f"this will send on {where}: {ids}")
        if not args.yes:
            if not sys.stdin.isatty():
                raise UsageError("can enable-transmit asks before it changes anything, and there is no terminal; add --yes")
            if input(f"listen {args.seconds:.0f} s for collisions, then let it send? [y/N] ").strip().lower() not in ("y", "yes"):
                say(args, "nothing is changed")
                return 1
        bar = progress_bar("listening", args.quiet)
        total = round(args.seconds)
        heard = can_transmit.listen(settings, args.seconds, lambda s, _: bar(min(round(s), total), total) if bar else None)
        can_transmit.judge(settings, heard, empty_bus=args.empty_bus)
        say(args, f"{where}: {heard.frames} frames of {len(heard.ids)} ids in {args.seconds:.0f} s, none of them ours")
    for line in can_transmit.apply(changes):
        print(line)
    for note in notes:
        say(args, note)
    if any(change.new is not None for change in changes):
        say(args, f"to make it so: {can_transmit.restart_hint(settings, changes)}")
    return 0


def _doctor(args: argparse.Namespace) -> int:
    from tmde_edge.app import doctor
    from tmde_edge.app.status import ask, socket_path

    use_installed(args)
    config = config_of(args)

    def status() -> dict[str, Any] | None:
        try:
            return ask(socket_path(config.runtime.status_socket), {"request": "status"})
        except TmdeError:
            return None

    running = status()
    checks = doctor.examine(config, doctor.Surroundings(status=lambda: running), args.config, base_dir(args))
    print(doctor.as_json(checks) if args.json else "\n".join(check.line() for check in checks))
    return 1 if any(check.state == "fail" for check in checks) else 0
