"""`tmde-edge completion bash|zsh`: completion scripts made from the command line itself, by shtab."""

from __future__ import annotations

import argparse
from pathlib import Path

import shtab

from tmde_edge.adapters.depth.manifest import known_models, models_folder
from tmde_edge.plates.standard import load_standards
from tmde_edge.simulation.scenarios import names as scenarios

SHELLS = ("bash", "zsh")
FOLDERS = ("FOLDER",)
FILES = ("FILE", "FILE.mp4", "FILE.csv", "FILE.mcap", "SOURCE", "IMAGE_OR_FOLDER", "FOLDER_OR_JSONL", "DRIVE_LOG")


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """The script of one shell for `parser`; files, folders, scenarios, standards and networks complete by name."""
    _annotate(parser)
    return shtab.complete(parser, shell=shell)


def _annotate(parser: argparse.ArgumentParser) -> None:
    names = {
        "scenario": [name for name, _ in scenarios()],
        "plate": sorted(load_standards()),
        "ids": sorted(load_standards()),
        "names": sorted(known_models(models_folder())),
    }
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                _annotate(sub)
        elif action.dest in names and action.choices is None:
            action.choices = names[action.dest]
        elif action.metavar in FOLDERS:
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
        elif action.metavar in FILES or action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
