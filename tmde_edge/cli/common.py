"""What every command shares: its options, its configuration, its words to people. Only `tmde_edge.cli` prints."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from tmde_edge.errors import writing

INSTALLED = Path("/etc/tmde-edge/config.toml")
T = TypeVar("T")
Verb = Callable[[argparse.Namespace], int]


class Verbs:
    """The commands of a parser; each module of this package adds its own."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._parsers = parser.add_subparsers(dest="verb", metavar="COMMAND", title="commands")

    def add(self, name: str, function: Verb, text: str, *, several: bool = False) -> argparse.ArgumentParser:
        """A command with the common options; `several`: -c may be given more than once."""
        sub = self._parsers.add_parser(name, help=text, description=text)
        common_options(sub, several=several)
        sub.set_defaults(function=function)
        return sub


def common_options(parser: argparse.ArgumentParser, *, top: bool = False, several: bool = False) -> None:
    """What every command understands; `top`: before the command, `several`: -c more than once."""
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


def number(text: str) -> float:
    """The type of every option that is a number: `nan` and `inf` are none."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


def whole_from(least: int) -> Callable[[str], int]:
    """The type of options that are whole numbers, `least` or more."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least} on")
        return value

    return read


def output_options(parser: argparse._ActionsContainer, *, top: bool = False) -> None:
    """--jsonl."""
    default: Any = None if top else argparse.SUPPRESS
    parser.add_argument("--jsonl", metavar="FILE", default=default, help="JSON lines, one a frame or image; - is stdout")


def config_of(args: argparse.Namespace) -> Any:
    """The configuration of -c and --set."""
    from tmde_edge.config import load

    return load(args.config, args.overrides)


def use_installed(args: argparse.Namespace) -> None:
    """Without -c, what asks about this board means the installed service's configuration, where there is one."""
    if args.config is None and INSTALLED.is_file():
        args.config = INSTALLED


def base_dir(args: argparse.Namespace) -> Path:
    """Relative paths in a configuration are relative to its file."""
    return args.config.resolve().parent if args.config is not None else Path.cwd()


class TextOut:
    """A file for text, or stdout for '-'. Raises UsageError where the file cannot be written."""

    def __init__(self, name: str) -> None:
        self._name, self.is_stdout = name, name == "-"
        with writing(name):
            self._file = sys.stdout if self.is_stdout else open(name, "w", encoding="utf-8")  # noqa: SIM115 (closed by __exit__)

    def write(self, text: str) -> None:
        """Adds text."""
        if self.is_stdout:
            self._file.write(text)
            return
        with writing(self._name):
            self._file.write(text)

    def __enter__(self) -> TextOut:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.is_stdout:
            with writing(self._name):
                self._file.close()


def progress(items: Iterable[T], total: int | None, text: str, quiet: bool) -> Iterator[T]:
    """Passes items on; a bar with ETA on stderr when that is a terminal."""
    if quiet or not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track

    yield from track(items, description=text, total=total, console=Console(stderr=True))


def progress_bar(text: str, quiet: bool) -> Callable[[int, int], None] | None:
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


def say(args: argparse.Namespace, text: str) -> None:
    """A line for people: stderr, so that stdout stays for data."""
    if not args.quiet:
        print(text, file=sys.stderr)


def json_line(record: dict[str, Any]) -> str:
    """One record of JSON lines."""
    return json.dumps(record, allow_nan=False, separators=(",", ":"), ensure_ascii=False) + "\n"
