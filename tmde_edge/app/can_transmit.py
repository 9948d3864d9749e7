"""`tmde-edge can enable-transmit` and `disable-transmit`: listen for collisions, then change both places."""

from __future__ import annotations

import configparser
import fnmatch
import os
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from tmde_edge.adapters.can_ports.serial_blocks import open_bus
from tmde_edge.adapters.can_ports.serial_hold import hold_serial
from tmde_edge.canbus.j1939 import PGN_ACC1, PGN_AEBS1, PRIORITY, j1939_id
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.config import load
from tmde_edge.errors import CheckFailedError, ConfigError, DeviceError, UsageError

NETWORK_FOLDER = Path("/etc/systemd/network")
_LISTEN_ONLY = re.compile(r"^(\s*ListenOnly\s*=\s*)(\S*)(.*)$", re.IGNORECASE)
_EOL = "\r\n"
_TRUE = ("1", "yes", "true", "on", "y", "t")


@dataclass(slots=True)
class Heard:
    """What passed on the bus while we listened."""

    seconds: float
    frames: int = 0
    ids: Counter[tuple[int, bool]] = field(default_factory=Counter)  # (id, extended)
    error_frames: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """A file and its new text; None: it says so already."""

    path: Path
    what: str  # for people: "can.transmit = true"
    old: str
    new: str | None


def own_ids(settings: CanSettings) -> dict[tuple[int, bool], str]:
    """(id, extended) of every frame that would be sent, with its name."""
    ids = {(settings.alert_id, False): "ALERT", (settings.lead_id, False): "LEAD", (settings.status_id, False): "STATUS"}
    if settings.j1939:
        for pgn, name in ((PGN_ACC1, "ACC1"), (PGN_AEBS1, "AEBS1")):
            ids[j1939_id(pgn, settings.j1939_source_address, PRIORITY[pgn]), True] = name
    return ids


def id_text(key: tuple[int, bool]) -> str:
    """0x6D0, or 0x18FE6FE8 for 29 bits."""
    return f"0x{key[0]:08X}" if key[1] else f"0x{key[0]:03X}"


def listen(
    settings: CanSettings, seconds: float, on_second: Callable[[float, int], None] | None = None, poll_s: float = 0.1
) -> Heard:
    """Counts what passes on the bus, sending nothing. Raises DeviceError where it cannot be opened or read."""
    import can  # slow to import

    where = f"CAN {settings.interface} {settings.channel}"
    options: dict[str, Any] = {"interface": settings.interface, "channel": settings.channel}
    if settings.fd:
        options["fd"] = True
    if settings.interface == "slcan":
        options |= {"bitrate": settings.bitrate, "listen_only": True, "timeout": 0.1}
    elif settings.interface == "udp_multicast":
        options |= {"hop_limit": 0}
    heard = Heard(seconds)
    held: int | None = None
    try:
        held = hold_serial(settings.channel) if settings.interface == "slcan" else None
        with open_bus(options) as bus:
            start_s = time.monotonic()
            told_s = start_s
            while (now_s := time.monotonic()) - start_s < seconds:
                message = bus.recv(poll_s)
                if message is not None:
                    if message.is_error_frame:
                        heard.error_frames += 1
                    else:
                        heard.frames += 1
                        heard.ids[message.arbitration_id, message.is_extended_id] += 1
                if on_second is not None and now_s - told_s >= 1.0:
                    told_s = now_s
                    on_second(now_s - start_s, heard.frames)
    except (can.CanError, OSError, ValueError) as e:
        advice = "`ip -details link show` tells its state; is can.channel right?"
        if settings.interface == "slcan":
            advice = "a serial adapter serves one program: stop the service first (systemctl stop tmde-edge)"
        raise DeviceError(f"{where}: cannot be listened to ({e}); {advice}") from None
    finally:
        if held is not None:
            os.close(held)
    return heard


def judge(settings: CanSettings, heard: Heard, *, empty_bus: bool) -> None:
    """Raises CheckFailedError where sending would disturb others, or where nobody can tell."""
    where = f"{settings.interface} {settings.channel}"
    taken = [f"{id_text(key)} ({name}) {heard.ids[key]} times" for key, name in own_ids(settings).items() if heard.ids[key] > 0]
    address = settings.j1939_source_address
    if settings.j1939 and not taken:  # an address belongs to one sender, whatever it says
        taken = [
            f"{id_text(key)} (address {address}) {n} times" for key, n in heard.ids.items() if key[1] and key[0] & 0xFF == address
        ]
    if taken:
        raise CheckFailedError(
            f"{where}: nothing is changed: somebody else sends with our ids: {', '.join(taken)} in {heard.seconds:.0f} s. Choose "
            "others: can.alert_id, can.lead_id, can.status_id, can.j1939_source_address"
        )
    if heard.frames == 0 and heard.error_frames > 0:
        raise CheckFailedError(
            f"{where}: nothing is changed: {heard.error_frames} error frames and no good one in {heard.seconds:.0f} s. The bit "
            "rate is wrong, or the wiring; sending would disturb the bus"
        )
    if heard.frames == 0 and not empty_bus:
        raise CheckFailedError(
            f"{where}: nothing is changed: no frame in {heard.seconds:.0f} s, so nobody can tell whether our ids are free. "
            "Switch the ignition on, check bit rate and wiring; for a bus of its own: --empty-bus"
        )


def plan(config_path: Path, on: bool, network_folder: Path = NETWORK_FOLDER) -> tuple[CanSettings, list[Change], list[str]]:
    """The settings in force, the changes in their order, and notes; changes nothing. Raises ConfigError, UsageError."""
    settings = load(config_path).can
    if not settings.enabled:
        raise ConfigError(f"{config_path}: can.enabled = false: there is no bus to send on; set it to true first")
    changes = [_config_change(config_path, on)]
    notes: list[str] = []
    if settings.interface == "socketcan":
        network = find_network(settings.channel, network_folder)
        if network is not None:
            changes.append(_network_change(network, listen_only=not on))
        elif not settings.channel.startswith(("vcan", "vxcan")):
            notes.append(
                f"no file in {network_folder} sets up {settings.channel}: see yourself that it is "
                f"{'not listen-only' if on else 'listen-only'} (ip -details link show {settings.channel})"
            )
    for change in changes:
        if change.new is not None and not _writable(change.path):
            raise UsageError(
                f"{change.path}: cannot be written; run it with sudo, and with a read-only root first: mount -o remount,rw /"
            )
    # Silent is the safe state: on, the program speaks last; off, it falls silent first.
    return settings, changes[::-1] if on else changes, notes


def apply(changes: list[Change]) -> list[str]:
    """Writes them, each atomically, all or none; one line for each. Raises DeviceError."""
    done: list[Change] = []
    try:
        for change in changes:
            if change.new is not None:
                write_atomically(change.path, change.new)
                done.append(change)
    except OSError as e:
        for change in reversed(done):
            write_atomically(change.path, change.old)
        raise DeviceError(f"{change.path}: cannot be written ({e.strerror}); nothing is changed") from None
    return [f"{c.path}: {c.what}" + (" (as it was)" if c.new is None else "") for c in changes]


def restart_hint(settings: CanSettings, changes: list[Change]) -> str:
    """The commands that make it take effect."""
    network = any(c.path.suffix == ".network" and c.new is not None for c in changes)
    reload = f"sudo networkctl reload && sudo networkctl reconfigure {settings.channel} && " if network else ""
    return f"{reload}sudo systemctl restart tmde-edge"


def find_network(channel: str, folder: Path) -> Path | None:
    """The first .network file whose [Match] Name= fits the interface, as systemd-networkd chooses."""
    for path in sorted(folder.glob("*.network")):
        parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",), allow_no_value=True)
        try:
            parser.read_string(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, configparser.Error):
            continue  # systemd-networkd cannot read it either
        names = (parser.get("Match", "Name", fallback="") or "").split()
        if any(fnmatch.fnmatchcase(channel, name) for name in names):
            return path
    return None


def write_atomically(path: Path, text: str) -> None:
    """The old or the new text whatever happens; mode and owner stay. Raises OSError."""
    path = path.resolve()  # a link stays a link
    kept = path.stat()
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as file:
            os.fchmod(file.fileno(), kept.st_mode & 0o7777)
            if (kept.st_uid, kept.st_gid) != (os.geteuid(), os.getegid()):
                os.fchown(file.fileno(), kept.st_uid, kept.st_gid)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _config_change(path: Path, on: bool) -> Change:
    with path.open(encoding="utf-8", newline="") as file:
        old = file.read()
    try:
        document = tomlkit.parse(old)
        can: Any = document.setdefault("can", tomlkit.table())
        same = can.get("transmit", False) == on
        can["transmit"] = on
        new = tomlkit.dumps(document)
    except TOMLKitError as e:
        raise ConfigError(f"{path}: cannot be edited ({e}); set can.transmit = {str(on).lower()} by hand") from None
    return Change(path=path, what=f"can.transmit = {str(on).lower()}", old=old, new=None if same else new)


def _network_change(path: Path, *, listen_only: bool) -> Change:
    with path.open(encoding="utf-8", newline="") as file:
        old = file.read()
    word = "yes" if listen_only else "no"
    lines = old.splitlines(keepends=True)
    section, header, found, same = "", None, False, True
    for i, line in enumerate(lines):
        bare = line.strip()
        if bare.startswith("[") and bare.endswith("]"):
            section = bare[1:-1].lower()
            header = i if section == "can" else header
        elif section == "can" and (match := _LISTEN_ONLY.match(line.rstrip(_EOL))) is not None:
            found = True
            if (match[2].lower() in _TRUE) != listen_only:
                same = False
                lines[i] = f"{match[1]}{word}{match[3]}{line[len(line.rstrip(_EOL)) :]}"
    if not found and listen_only:  # absent means no
        same = False
        if header is None:
            lines.append(("" if not lines or lines[-1].endswith("\n") else "\n") + f"\n[CAN]\nListenOnly={word}\n")
        else:
            lines.insert(header + 1, f"ListenOnly={word}\n")
    return Change(path=path, what=f"ListenOnly={word}", old=old, new=None if same else "".join(lines))


def _writable(path: Path) -> bool:
    """Whether the file can be replaced there (a new file in its folder)."""
    return os.access(path.resolve().parent, os.W_OK) and os.access(path, os.W_OK)
