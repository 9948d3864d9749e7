"""Verbs and exit codes; the only package that prints. Each module holds one group of commands, their options and all."""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Sequence

from tmde_edge import __version__
from tmde_edge.cli import calibrate, desk, judge, service, setup
from tmde_edge.cli.common import Verb, Verbs, common_options
from tmde_edge.errors import TmdeError, UsageError

# In the order of --help.
COMMANDS = (
    service.add_run, desk.add_measure, desk.add_simulate, desk.add_replay, desk.add_report, service.add_view,
    setup.add_check_config, setup.add_plates, setup.add_range_budget, setup.add_models, service.add_status,
    service.add_incident, setup.add_can, service.add_shadow_report, setup.add_doctor, calibrate.add_calibrate,
    judge.add_evaluate, judge.add_bench,
)  # fmt: skip


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


def _verb(args: argparse.Namespace) -> Verb:
    if args.dry_run is not None:
        if args.verb is not None:
            raise UsageError(f"--dry-run and the command {args.verb!r} exclude each other")
        return desk.dry_run
    if args.verb is None:
        return service.run
    verb: Verb = args.function
    return verb


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tmde-edge",
        description="Distance and time to collision from the number plate of the vehicle ahead. Without a command: the service.",
        epilog="Exit codes: 0 done; 1 a check failed; 2 wrong usage; 65 unreadable data; 66 no such input; 69 a model is "
        "missing or broken; 70 our own fault; 74 device failed; 78 bad configuration.",
    )
    parser.add_argument("--version", action="version", version=f"tmde-edge {__version__}")
    common_options(parser, top=True)
    desk.add_dry_run(parser)
    verbs = Verbs(parser)
    for add in COMMANDS:
        add(verbs)
    sub = verbs.add("completion", _completion, "completion for your shell: see docs/quickstart.md")
    sub.add_argument("shell", choices=["bash", "zsh"])
    return parser


def _completion(args: argparse.Namespace) -> int:
    from tmde_edge.app.completion import script

    print(script(_parser(), args.shell))
    return 0
