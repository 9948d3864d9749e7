"""Reads only the wanted messages of a DBC text, so that one bad line elsewhere does not lose the file.

cantools rejects whole files for one comment or one overlapping signal (a third of opendbc). Each `BO_` block is given to
cantools by itself, without comments and attributes; what fails is named with cantools' reason.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from tmde_edge.errors import ConfigError

_HEAD = re.compile(r"^BO_\s+(\d+)\s+(\w+)\s*:\s*(\d+)\s*(\w*)")
_VALUES = re.compile(r"^VAL_\s+(\d+)\s+(\w+)\s+(.*?);?\s*$")
_FLOAT = re.compile(r"^SIG_VALTYPE_\s+(\d+)\s")
_MULTIPLEX = re.compile(r"^SG_MUL_VAL_\s+(\d+)\s")
_UNAVAILABLE = re.compile(
    r"not.?avail|unavail|invalid|ung.?ltig|init|fehler|fault|error|defekt|no.?data|unknown|\bsna\b|nicht.?verf", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class DbcMessages:
    """The messages that loaded (cantools objects by name), and a line for each that did not."""

    messages: dict[str, Any]
    skipped: tuple[str, ...]
    known: tuple[str, ...]  # names of all messages in the file


@dataclass(slots=True)
class _Block:
    dbc_id: int
    name: str
    line: int
    lines: list[str]


def load_messages(text: str, name: str, wanted: Collection[str] | None = None) -> DbcMessages:
    """Loads the wanted messages (None: all) of a DBC text; `name` is the file's, for messages to the user.

    Raises ConfigError where the text holds no message at all, which means that it is no DBC.
    """
    blocks, extras = _split(text)
    if not blocks:
        first = next((line.strip() for line in text.splitlines() if line.strip()), "")[:60]
        raise ConfigError(f"can.vehicle.dbc {name}: no message (BO_) in it, it begins with {first!r}; name a DBC file")
    from cantools.database import Error, load_string  # slow to import: only where a DBC is used

    messages: dict[str, Any] = {}
    skipped: list[str] = []
    for block in blocks:
        if wanted is not None and block.name not in wanted:
            continue
        if block.name in messages:
            skipped.append(f"{block.name} (line {block.line}): a second message of this name; the first is used")
            continue
        source = "\n".join(['VERSION ""', "BU_:", *block.lines, *extras.get(block.dbc_id, ()), ""])
        try:
            messages[block.name] = load_string(source, database_format="dbc", strict=False).messages[0]
        except (Error, ValueError, KeyError, IndexError) as e:
            skipped.append(f"{block.name} (line {block.line}): {' '.join(str(e).split())}")
    return DbcMessages(messages, tuple(skipped), tuple(block.name for block in blocks))


def unavailable_codes(signal: Any) -> tuple[int, ...]:
    """Raw values that the DBC's value table (VAL_) calls invalid, faulty or not available."""
    choices = signal.choices or {}
    return tuple(sorted(int(raw) for raw, label in choices.items() if _UNAVAILABLE.search(str(label))))


def _split(text: str) -> tuple[list[_Block], dict[int, list[str]]]:
    """The BO_ blocks in file order, and by message id the lines that change how its bits are read."""
    blocks: list[_Block] = []
    extras: dict[int, list[str]] = {}
    current: _Block | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        head = _HEAD.match(line)
        if head:
            current = _Block(int(head[1]), head[2], number, [line])
            blocks.append(current)
        elif current is not None and line.lstrip().startswith("SG_ "):
            current.lines.append(line)
        else:
            if line.strip():
                current = None
            values = _VALUES.match(line)
            other = _FLOAT.match(line) or _MULTIPLEX.match(line)
            if values:
                extras.setdefault(int(values[1]), []).append(f"VAL_ {values[1]} {values[2]} {values[3]};")
            elif other:
                extras.setdefault(int(other[1]), []).append(line)
    return blocks, extras
