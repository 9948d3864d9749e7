"""Log records as systemd's journal receives them."""

from __future__ import annotations

import logging
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.app import journal


def parse(data: bytes) -> dict[str, str]:
    """The receiving side of the native protocol."""
    fields, at = {}, 0
    while at < len(data):
        end = data.index(b"\n", at)
        line = data[at:end]
        if b"=" in line:
            name, _, value = line.partition(b"=")
            at = end + 1
        else:
            (size,) = struct.unpack_from("<Q", data, end + 1)
            name, value = line, data[end + 9 : end + 9 + size]
            at = end + 9 + size + 1
        fields[name.decode()] = value.decode("utf-8", errors="surrogateescape")
    return fields


@given(st.dictionaries(st.from_regex(r"[A-Z][A-Z_]{0,8}", fullmatch=True), st.text(max_size=40), max_size=6))
def test_any_text_comes_through(fields: dict[str, str]) -> None:
    fields = {k: v.encode("utf-8", errors="ignore").decode() for k, v in fields.items()}
    assert parse(journal.datagram(fields)) == fields


@pytest.fixture
def log() -> Iterator[logging.Logger]:
    logger = logging.getLogger("tmde_edge.test_journal")
    logger.propagate = False
    yield logger
    logger.handlers.clear()


def test_a_record_arrives_with_its_fields(tmp_path: Path, log: logging.Logger) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journald:
        journald.bind(str(tmp_path / "socket"))
        journald.settimeout(1)
        handler = journal.JournalHandler(tmp_path / "socket")
        handler.setFormatter(logging.Formatter("%(message)s"))
        log.addHandler(handler)
        log.warning("alert: %s", "warning\nttc", extra={"fields": {"TMDE_EVENT": "alert", "TMDE_TTC_S": 2.1, "bad name": "x"}})
        got = parse(journald.recv(65536))
        handler.close()
    assert got["MESSAGE"] == "alert: warning\nttc"
    assert (got["PRIORITY"], got["TMDE_EVENT"], got["TMDE_TTC_S"]) == ("4", "alert", "2.1")
    assert "bad name" not in got


def test_without_the_journal_lines_go_to_stderr_with_their_level(
    tmp_path: Path, log: logging.Logger, capsys: pytest.CaptureFixture[str]
) -> None:
    handler = journal.JournalHandler(tmp_path / "gone")
    log.addHandler(handler)
    log.error("two\nlines")
    handler.close()
    assert capsys.readouterr().err == "<3>two\n<3>lines\n"


def test_the_journal_is_known_by_its_stream(tmp_path: Path) -> None:
    with (tmp_path / "stderr").open("w") as f:
        found = os.fstat(f.fileno())
        assert journal.under_journal({"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}, f.fileno())
        assert not journal.under_journal({"JOURNAL_STREAM": "1:2"}, f.fileno())
        assert not journal.under_journal({}, f.fileno())
