"""Writes a configuration as TOML that `tmde-edge -c` reads again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def to_toml(tree: Mapping[str, Any]) -> str:
    """Tables of plain values and lists; None is left out (it is the default)."""
    lines: list[str] = []
    _table(tree, (), lines)
    return "\n".join(lines) + "\n"


def write_config(folder: Path, kept: Mapping[str, Any]) -> Path:
    """`config.toml`, and the files it names beside it, from what a drive log keeps (wiring.log_config)."""
    values = json.loads(json.dumps(kept.get("values", {})))
    for name, text in kept.get("files", {}).items():
        (folder / Path(name).name).write_bytes(text.encode("utf-8", errors="surrogateescape"))
        values["can"]["vehicle"]["dbc"] = Path(name).name
    path = folder / "config.toml"
    path.write_text(to_toml(values), encoding="utf-8")
    return path


def _table(tree: Mapping[str, Any], at: tuple[str, ...], lines: list[str]) -> None:
    plain = {k: v for k, v in tree.items() if v is not None and not isinstance(v, Mapping)}
    if at and plain:
        lines += ["", f"[{'.'.join(_key(k) for k in at)}]"]
    lines += [f"{_key(k)} = {_value(v)}" for k, v in plain.items()]
    for key, value in tree.items():
        if isinstance(value, Mapping):
            if not value and at:
                lines += ["", f"[{'.'.join(_key(k) for k in (*at, key))}]"]
            _table(value, (*at, key), lines)


def _key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else json.dumps(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    if isinstance(value, Mapping):  # inside a list
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None) + " }"
    raise TypeError(f"{type(value).__name__} has no place in TOML")
