"""The unit files say what the code relies on, and stay hardened."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tmde_edge.errors import ConfigError

SYSTEMD = Path(__file__).parents[3] / "systemd"
SERVICE = SYSTEMD / "tmde-edge.service"


def lines() -> list[str]:
    return SERVICE.read_text(encoding="utf-8").splitlines()


def test_the_service_waits_for_ready_is_watched_and_never_gives_up() -> None:
    for line in ("Type=notify", "Restart=on-failure", "StartLimitIntervalSec=0", "WantedBy=multi-user.target"):
        assert line in lines()
    assert any(line.startswith("WatchdogSec=") for line in lines())


def test_only_a_wrong_configuration_is_not_tried_again() -> None:
    assert f"RestartPreventExitStatus={ConfigError.exit_code}" in lines()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_finds_nothing_wrong_and_rates_the_exposure_low(tmp_path: Path) -> None:
    # The program is not installed where the unit expects it.
    text = "\n".join("ExecStart=/bin/true" if line.startswith("ExecStart=") else line for line in lines())
    unit = tmp_path / SERVICE.name
    unit.write_text(text + "\n", encoding="utf-8")
    verify = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, timeout=60)
    assert (verify.returncode, verify.stderr) == (0, "")
    security = ["systemd-analyze", "security", "--offline=true", "--threshold=25", str(unit)]
    rated = subprocess.run(security, capture_output=True, text=True, timeout=60)
    assert rated.returncode == 0, rated.stdout[-300:]
