"""sd_notify datagrams, as systemd receives them."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from tmde_edge.app.sdnotify import Notifier


@pytest.mark.parametrize("abstract", [False, True])
def test_messages_arrive_at_a_path_and_in_the_abstract_namespace(tmp_path: Path, abstract: bool) -> None:
    name = f"@tmde-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind("\0" + name[1:] if abstract else name)
        systemd.settimeout(1)
        notifier = Notifier({"NOTIFY_SOCKET": name})
        notifier.ready()
        notifier.status("two\nlines")
        notifier.watchdog()
        notifier.stopping()
        assert [systemd.recv(100) for _ in range(4)] == [b"READY=1", b"STATUS=two lines", b"WATCHDOG=1", b"STOPPING=1"]


def test_without_systemd_nothing_happens(tmp_path: Path) -> None:
    Notifier({}).ready()
    gone = Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")})
    gone.ready()
    assert gone.watchdog_s is None


@pytest.mark.parametrize(
    ("usec", "pid", "expected_s"),
    [("5000000", "", 5.0), ("5000000", "own", 5.0), ("5000000", "1", None), ("0", "", None), ("soon", "", None)],
)
def test_the_watchdog_time_is_for_this_process_only(usec: str, pid: str, expected_s: float | None) -> None:
    pid = str(os.getpid()) if pid == "own" else pid
    assert Notifier({"WATCHDOG_USEC": usec, "WATCHDOG_PID": pid}).watchdog_s == expected_s
