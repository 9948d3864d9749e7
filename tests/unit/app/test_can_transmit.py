"""Speaking on the bus: collisions refuse it, both files change together, comments stay."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from tmde_edge.app import can_transmit
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.cli import main
from tmde_edge.config import load
from tmde_edge.errors import CheckFailedError, DeviceError, UsageError

ROOT = Path(__file__).parents[3]
CONFIG = """# mine
[camera]
fx_px = 1200.0   # measured

[can]            # the bus
interface = "virtual"
channel = "{channel}"
transmit = false # silent
alert_id = 0x6D0
"""
NETWORK = (ROOT / "systemd/80-tmde-can0.network").read_text(encoding="utf-8")


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    return f"bus-{request.node.name}"


@pytest.fixture
def config(tmp_path: Path, channel: str) -> Path:
    path = tmp_path / "config.toml"
    path.write_text(CONFIG.format(channel=channel), encoding="utf-8")
    return path


class Traffic:
    """Another control unit on the virtual bus, sending one id."""

    def __init__(self, channel: str, can_id: int, extended: bool = False) -> None:
        self._stop = threading.Event()
        self._message = can.Message(arbitration_id=can_id, is_extended_id=extended, data=b"\x01\x02")
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def _send(self) -> None:
        while not self._stop.wait(0.01):
            self._bus.send(self._message)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()


@pytest.fixture
def car(channel: str) -> Iterator[Traffic]:
    traffic = Traffic(channel, 0x0B4)
    yield traffic
    traffic.close()


def enable(config: Path, *more: str) -> int:
    return main(["can", "enable-transmit", "-c", str(config), "--yes", "--seconds", "0.3", *more])


def test_it_speaks_after_hearing_a_car_that_leaves_our_ids_alone(
    config: Path, car: Traffic, capsys: pytest.CaptureFixture[str]
) -> None:
    before = config.read_text()
    assert enable(config) == 0
    assert config.read_text() == before.replace("transmit = false # silent", "transmit = true # silent")
    told = capsys.readouterr()
    assert f"{config}: can.transmit = true" in told.out
    assert "0x6D0 (ALERT), 0x6D1 (LEAD), 0x6D2 (STATUS)" in told.err
    assert "systemctl restart tmde-edge" in told.err
    assert main(["can", "disable-transmit", "-c", str(config)]) == 0
    assert config.read_text() == before


def test_an_id_that_somebody_uses_refuses_it_and_is_counted(
    config: Path, channel: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = config.read_text()
    other = Traffic(channel, 0x6D1)
    try:
        assert enable(config) == 1
    finally:
        other.close()
    told = capsys.readouterr().err
    assert "0x6D1 (LEAD)" in told
    count = int(told.split("0x6D1 (LEAD) ")[1].split()[0])
    assert count > 5
    assert config.read_text() == before


def test_a_silent_bus_refuses_it_unless_that_is_right(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = config.read_text()
    assert enable(config) == 1
    assert "--empty-bus" in capsys.readouterr().err
    assert config.read_text() == before
    assert enable(config, "--empty-bus") == 0
    assert load(config).can.transmit


def test_the_same_number_as_a_29_bit_id_is_no_collision(config: Path, channel: str) -> None:
    other = Traffic(channel, 0x6D0, extended=True)
    try:
        assert enable(config) == 0
    finally:
        other.close()


def test_error_frames_alone_tell_of_a_wrong_bit_rate() -> None:
    heard = can_transmit.Heard(60.0, error_frames=12)
    with pytest.raises(CheckFailedError, match="12 error frames"):
        can_transmit.judge(CanSettings(), heard, empty_bus=True)


def test_a_foreign_sender_with_our_j1939_address_refuses_it() -> None:
    heard = can_transmit.Heard(60.0, frames=3)
    heard.ids[0x18FEF1E8, True] = 3
    can_transmit.judge(CanSettings(), heard, empty_bus=False)
    with pytest.raises(CheckFailedError, match=r"0x18FEF1E8 \(address 232\) 3 times"):
        can_transmit.judge(CanSettings(j1939=True), heard, empty_bus=False)


def test_without_a_terminal_it_asks_for_yes(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115 (given to the monkeypatch)
    assert main(["can", "enable-transmit", "-c", str(config), "--seconds", "0.1"]) == 2
    assert "--yes" in capsys.readouterr().err


def test_a_second_time_changes_nothing_and_listens_to_nothing(config: Path, car: Traffic) -> None:
    assert enable(config) == 0
    stamp = config.stat().st_mtime_ns
    start = time.monotonic()
    assert main(["can", "enable-transmit", "-c", str(config), "--yes", "--seconds", "30"]) == 0
    assert time.monotonic() - start < 10
    assert config.stat().st_mtime_ns == stamp


# -- both places -----------------------------------------------------------------------------------------------------


@pytest.fixture
def both(tmp_path: Path) -> tuple[Path, Path]:
    config, folder = tmp_path / "config.toml", tmp_path / "network"
    config.write_text('[can]\nchannel = "can0"\n', encoding="utf-8")
    folder.mkdir()
    (folder / "80-tmde-can0.network").write_text(NETWORK, encoding="utf-8")
    (folder / "10-eth.network").write_text("[Match]\nName=eth* en*\n", encoding="utf-8")
    return config, folder


def test_the_interface_is_changed_with_the_configuration_and_back(both: tuple[Path, Path]) -> None:
    config, folder = both
    network = folder / "80-tmde-can0.network"
    network.chmod(0o640)
    settings, changes, notes = can_transmit.plan(config, True, folder)
    assert [change.path for change in changes] == [network, config]  # the program speaks last
    assert notes == []
    lines = can_transmit.apply(changes)
    assert lines == [f"{network}: ListenOnly=no", f"{config}: can.transmit = true"]
    assert network.read_text() == NETWORK.replace("ListenOnly=yes", "ListenOnly=no")
    assert network.stat().st_mode & 0o777 == 0o640
    assert load(config).can.transmit
    assert "networkctl reconfigure can0" in can_transmit.restart_hint(settings, changes)
    _, changes, _ = can_transmit.plan(config, False, folder)
    assert [change.path for change in changes] == [config, network]  # it falls silent first
    can_transmit.apply(changes)
    assert network.read_text() == NETWORK
    assert not load(config).can.transmit
    assert sorted(p.name for p in folder.iterdir()) == ["10-eth.network", "80-tmde-can0.network"]


def test_without_the_line_the_interface_speaks_and_silence_is_written(both: tuple[Path, Path]) -> None:
    config, folder = both
    network = folder / "80-tmde-can0.network"
    bare = NETWORK.replace("ListenOnly=yes\n", "")
    network.write_text(bare, encoding="utf-8")
    _, changes, _ = can_transmit.plan(config, True, folder)
    assert changes[0].new is None
    _, changes, _ = can_transmit.plan(config, False, folder)
    assert changes[1].new is not None
    assert "[CAN]\nListenOnly=yes\n" in changes[1].new


def test_an_interface_that_others_set_up_is_named(both: tuple[Path, Path]) -> None:
    config, folder = both
    (folder / "80-tmde-can0.network").unlink()
    _, changes, notes = can_transmit.plan(config, True, folder)
    assert len(changes) == 1
    assert "can0" in notes[0]


def test_where_the_second_file_cannot_be_written_the_first_is_taken_back(
    both: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    config, folder = both
    _, changes, _ = can_transmit.plan(config, True, folder)
    write = can_transmit.write_atomically

    def failing(path: Path, text: str) -> None:
        if path == config:
            raise OSError(28, "No space left on device")
        write(path, text)

    monkeypatch.setattr(can_transmit, "write_atomically", failing)
    with pytest.raises(DeviceError, match="No space left"):
        can_transmit.apply(changes)
    assert (folder / "80-tmde-can0.network").read_text() == NETWORK


def test_files_that_cannot_be_written_are_named_before_it_listens(
    both: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    config, folder = both
    monkeypatch.setattr(can_transmit, "_writable", lambda path: False)  # root may write everywhere
    with pytest.raises(UsageError, match="sudo"):
        can_transmit.plan(config, True, folder)


def test_a_write_that_fails_leaves_the_old_file_and_no_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "config.toml"
    path.write_text("old")

    def fail(handle: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="Input/output"):
        can_transmit.write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "text", ["can = { transmit = false, alert_id = 0x600 } # one line\n", "can.transmit = false\n", "[camera]\nfx_px = 900\n", ""]
)
def test_every_way_to_write_it_is_edited_and_keeps_the_rest(tmp_path: Path, text: str) -> None:
    config = tmp_path / "config.toml"
    config.write_text(text, encoding="utf-8")
    before = load(config)
    _, changes, _ = can_transmit.plan(config, True, tmp_path)
    can_transmit.apply(changes)
    after = load(config)
    assert after.can.transmit
    assert (after.camera, after.can.alert_id) == (before.camera, before.can.alert_id)
    assert "# one line" in config.read_text() or "#" not in text


def test_the_shipped_configuration_is_silent_and_valid() -> None:
    config = load(ROOT / "config/tmde-edge.toml")
    assert not config.can.transmit
    assert "ListenOnly=yes" in NETWORK
