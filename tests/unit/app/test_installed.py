"""On a board: the installed configuration is meant, and what is not ours to read is said in one line."""

from __future__ import annotations

import os
import socket
import threading
from pathlib import Path

import pytest

from tmde_edge.adapters.depth import manifest
from tmde_edge.app import incidents, shadow
from tmde_edge.app.view import server
from tmde_edge.app.view.run import _records
from tmde_edge.cli import common, main
from tmde_edge.errors import InputMissingError


def test_what_asks_about_this_board_means_the_installed_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed = tmp_path / "config.toml"
    installed.write_text("[camera]\nheight_m = 1.234\n", encoding="utf-8")
    monkeypatch.setattr(common, "INSTALLED", installed)
    assert main(["check-config"]) == 0
    assert "1.234" in capsys.readouterr().out
    other = tmp_path / "other.toml"
    other.write_text("[camera]\nheight_m = 0.9\n", encoding="utf-8")
    assert main(["check-config", "-c", str(other)]) == 0
    assert "1.234" not in capsys.readouterr().out


@pytest.mark.parametrize("read", [shadow.read_shadow, lambda folder: list(incidents.list_lines(folder))])
def test_recordings_of_others_are_refused_in_one_line(
    read: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(path: object) -> list[str]:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "listdir", closed)
    with pytest.raises(InputMissingError, match="usermod"):
        read(tmp_path)  # type: ignore[operator]


def test_a_page_over_records_that_are_not_ours_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: socket.socket, address: str) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket.socket, "connect", refused)
    with pytest.raises(InputMissingError, match="group"):
        list(_records(tmp_path / "records.sock", threading.Event()))


def test_models_go_where_the_installed_service_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setattr(manifest, "INSTALLED_STATE", tmp_path)
    assert manifest.models_folder() == tmp_path / "models"
    monkeypatch.setattr(manifest, "INSTALLED_STATE", tmp_path / "away")
    assert manifest.models_folder() != tmp_path / "away" / "models"


def test_every_address_is_shown_as_one_that_can_be_opened() -> None:
    assert server._own_address() not in ("", *server.EVERY_ADDRESS)
