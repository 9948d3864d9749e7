"""The documents say what the program does: keys, options and files that they name exist, and every key is documented."""

from __future__ import annotations

import argparse
import importlib.machinery
import importlib.util
import itertools
import re
import shlex
from pathlib import Path
from types import ModuleType

import msgspec
import pytest

from tmde_edge.cli import _parser
from tmde_edge.config import Config
from tmde_edge.plates.standard import load_standards

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
IDS = [str(p.relative_to(ROOT)) for p in PAGES]
NOT_KEYS = {"py", "toml", "md", "mp4", "csv", "log", "html", "json", "jsonl", "onnx", "yaml", "npz"}  # ends of file names
OF_RECORDS = {"pose.source", "pose.yaw_rad"}  # fields of the JSON lines


@pytest.fixture(scope="module")
def config_doc() -> ModuleType:
    loader = importlib.machinery.SourceFileLoader("config_doc", str(ROOT / "scripts/config-doc"))
    spec = importlib.util.spec_from_loader("config_doc", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def test_the_page_of_all_keys_is_what_the_program_has(config_doc: ModuleType) -> None:
    assert (ROOT / "docs/configuration.md").read_text(encoding="utf-8") == config_doc.page(), "run scripts/config-doc"


def test_every_key_has_a_meaning_on_it(config_doc: ModuleType) -> None:
    rows = [line for line in config_doc.page().splitlines() if line.startswith("| `")]
    assert len(rows) > 200
    assert [row for row in rows if row.endswith("|  |")] == []


def _keys(config_doc: ModuleType) -> dict[str, set[str]]:
    """Keys of every table by its dotted name."""
    return {
        name: {f.encode_name for f in msgspec.structs.fields(struct)}
        for field in msgspec.structs.fields(Config)
        for name, struct in config_doc.tables(config_doc.inner_struct(field.type), field.name)
    }


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_keys_that_documents_name_exist(page: Path, config_doc: ModuleType) -> None:
    tables = _keys(config_doc)
    text = page.read_text(encoding="utf-8")
    wrong = []
    for table, key in re.findall(r"(?<![\w./])([a-z]+(?:\.[a-z_]+)*)\.([a-z][a-z0-9_]+)(?![\w/(])", text):
        if table in tables and key not in tables[table] | NOT_KEYS and f"{table}.{key}" not in {*tables, *OF_RECORDS}:
            wrong.append(f"{table}.{key}")
    table = ""
    for line in text.splitlines():  # TOML in code blocks: [table], then key = value
        if (head := re.fullmatch(r" *\[([a-z_.]+)\] *(?:#.*)?", line)) is not None:
            table = head[1]
        elif not line.strip():
            continue
        elif (given := re.match(r" {4,}(?:# )?([a-z_0-9]+) = ", line)) is not None and table in tables:
            if given[1] not in tables[table]:
                wrong.append(f"[{table}] {given[1]}")
        elif not line.startswith(" "):
            table = ""
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_commands_that_documents_show_are_understood(page: Path) -> None:
    parser = _parser()
    verbs = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    indented = re.sub(r"^", "    ", "\n".join([*fenced, ""]), flags=re.MULTILINE)
    wrong = []
    for command in re.findall(r"(?:^ +(?:sudo )?(?:\S*/)?|`(?:sudo )?)tmde-edge ([^`\n]*)", text + indented, re.MULTILINE):
        try:
            words = shlex.split(command, comments=True)
        except ValueError:
            continue  # an apostrophe of prose
        words = [w for w in words if not w.startswith("[")]
        verb = next((w for w in words if w in verbs), None)
        known = set(parser._option_string_actions) | (set(verbs[verb]._option_string_actions) if verb else set())
        wrong += [f"{verb}: {w}" for w in words if re.match(r"--[a-z]", w) and w.split("=")[0].rstrip("],") not in known]
        for option, word in itertools.pairwise(words):
            if option in ("--standard", "--plate") and re.match(r"[a-z]", word) and word not in load_standards():
                wrong.append(f"{option} {word}")
        first = words[0] if words else ""
        if re.fullmatch(r"[a-z][a-z-]+", first) and verb is None:
            wrong.append(first)
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_files_that_documents_name_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    names = re.findall(r"`(?:python )?((?:tests|scripts|config|docs|systemd|tmde_edge)/[\w./-]+)", text)
    assert [n for n in names if not (ROOT / n.rstrip(".")).exists()] == []
