"""The command hook: runs at a change of level, with a limit, and never holds anything up."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tmde_edge.app.alert_command import AlertCommand
from tmde_edge.app.wiring import check_parts
from tmde_edge.config import from_tree
from tmde_edge.errors import ConfigError
from tmde_edge.messages import Alert, AlertLevel


def script(folder: Path, body: str) -> list[str]:
    path = folder / "buzzer.sh"
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return [str(path), str(folder / "out.txt")]


def alert(level: AlertLevel) -> Alert:
    return Alert(level=level, reason="" if level == "none" else "ttc", ttc_s=None if level == "none" else 2.25)


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.005)


def text(folder: Path) -> str:
    path = folder / "out.txt"
    return path.read_text() if path.exists() else ""


def test_it_runs_once_a_change_with_level_reason_and_ttc(tmp_path: Path) -> None:
    hook = AlertCommand(script(tmp_path, 'echo "$2/$3/$4/$TMDE_ALERT_LEVEL" >> "$1"'), 5.0)
    try:
        for level, count in (("none", 0), ("warning", 1), ("warning", 1), ("none", 2)):
            hook.take(alert(level))  # type: ignore[arg-type]
            wait_for(lambda count=count: text(tmp_path).count("\n") == count)  # type: ignore[misc]
        assert text(tmp_path).splitlines() == ["warning/ttc/2.25/warning", "none///none"]
        assert (hook.runs, hook.failures) == (2, 0)
    finally:
        hook.close()


def test_one_that_hangs_is_killed_with_its_children_and_the_newest_level_is_told_next(tmp_path: Path) -> None:
    body = 'echo "$2" >> "$1"; if [ "$2" = warning ]; then sleep 60 & wait; echo late >> "$1"; fi'
    hook = AlertCommand(script(tmp_path, body), 0.5)
    try:
        start = time.perf_counter()
        hook.take(alert("warning"))
        wait_for(lambda: "warning" in text(tmp_path))
        for _ in range(50):
            hook.take(alert("none"))
            hook.take(alert("caution"))
        assert time.perf_counter() - start < 0.5 or hook.failures == 1
        wait_for(lambda: "caution" in text(tmp_path))
        wait_for(lambda: hook.runs == 2)
        assert text(tmp_path).splitlines() == ["warning", "caution"]
        assert hook.failures == 1
    finally:
        hook.close()


def test_a_lasting_failure_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    hook = AlertCommand(script(tmp_path, "exit 3"), 5.0)
    try:
        with caplog.at_level(logging.INFO):
            for k in range(4):
                hook.take(alert("warning" if k % 2 == 0 else "none"))
                wait_for(lambda k=k: hook.failures == k + 1)  # type: ignore[misc]
        assert [r.getMessage() for r in caplog.records if "exit code 3" in r.getMessage()].__len__() == 1
    finally:
        hook.close()


def test_a_program_that_is_not_there_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"alerts\.command '/nowhere/buzzer'"):
        check_parts(from_tree({"alerts": {"command": ["/nowhere/buzzer"]}}, "test"), tmp_path)


def test_close_does_not_wait_for_what_runs(tmp_path: Path) -> None:
    hook = AlertCommand(script(tmp_path, 'echo x > "$1"; exec sleep 60'), 60.0)
    hook.take(alert("warning"))
    wait_for(lambda: text(tmp_path) != "")
    start = time.perf_counter()
    hook.close()
    assert time.perf_counter() - start < 20.0  # of the 60 s that it sleeps
