"""`tmde-edge doctor`: is this board ready? One line a subject, with what to do where something is wrong.

Everything is read from /sys, /proc and small tools below a root folder; the camera and the bus are tried for a moment, or, where
the service holds them, the service is asked.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from tmde_edge.app import board
from tmde_edge.app.board import Run, read_text
from tmde_edge.config import Config
from tmde_edge.errors import TmdeError

State: TypeAlias = Literal["ok", "warn", "fail", "skip"]
_WARM_C = 70.0
_DAY_S = 86_400.0
_OLD_CALIBRATION_DAYS = 365
_MEMORY_MB = 300.0
_BUILT_S = 1_760_000_000.0  # October 2025: a clock before this is not set
_GRABS_S = 2.0


@dataclass(frozen=True, slots=True)
class Check:
    """One line: the subject, how it is, and what to do about it."""

    name: str
    state: State
    text: str
    fix: str = ""

    def line(self) -> str:
        """For people."""
        return f"{self.state.upper():5} {self.name:12} {self.text}" + (f" -> {self.fix}" if self.fix else "")


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """Where the doctor looks; tests put made-up trees and tools here."""

    root: Path = Path("/")
    run: Run = board.run_tool
    wall_s: Callable[[], float] = time.time
    status: Callable[[], dict[str, Any] | None] = lambda: None  # of the running service


Checker: TypeAlias = Callable[[Config, Surroundings], Iterator[Check]]


def check_board(config: Config, s: Surroundings) -> Iterator[Check]:
    """Temperature and throttling."""
    model = (read_text(s.root / "proc/device-tree/model") or "").replace("\0", "") or os.uname().machine
    zones = board.temperatures_c(s.root)
    hottest = board.processor_c(s.root)
    tegra = s.run(("tegrastats", "--interval", "100", "--once")) if (s.root / "etc/nv_tegra_release").exists() else None
    if hottest is None:
        yield Check("temperature", "warn", f"{model}: no thermal zone tells one", "load is not shed by heat here")
    elif hottest >= config.runtime.hot_c:
        yield Check("temperature", "fail", f"{model}: {hottest:.0f} °C", "cool the board: a fan, a heat sink, air, shade")
    elif hottest >= _WARM_C:
        text = f"{model}: {hottest:.0f} °C"
        yield Check("temperature", "warn", text, "it will throttle in summer: a fan or a heat sink")
    else:
        note = f"; {' '.join(tegra.split())[:120]}" if tegra else ""
        yield Check("temperature", "ok", f"{model}: {hottest:.0f} °C, {len(zones)} sensors{note}")
    flags = board.throttle_flags(s.root, s.run)
    if flags is None:
        yield Check("throttling", "skip", "this board does not tell")
        return
    now, before = board.throttle_words(flags)
    heat = [w for w in now if "voltage" not in w]
    if heat:
        yield Check("throttling", "fail", ", ".join(heat), "cool the board, or lower camera.rate_hz")
    elif any("voltage" not in w for w in before):
        yield Check("throttling", "warn", ", ".join(w for w in before if "voltage" not in w), "cool the board")
    else:
        yield Check("throttling", "ok", "none since boot")


def check_power(config: Config, s: Surroundings) -> Iterator[Check]:
    """Under-voltage, of Raspberry Pi's firmware or of any sensor that alarms."""
    flags = board.throttle_flags(s.root, s.run)
    alarms = [p for p in (s.root / "sys/class/hwmon").glob("hwmon*/in*_lcrit_alarm") if read_text(p) == "1"]
    fix = "a supply of 5 V and 5 A (Pi 5) or 3 A (Pi 4) with a short thick cable; in a car, a proper converter"
    if alarms or (flags is not None and flags & 1):
        yield Check("power", "fail", "under-voltage now", fix)
    elif flags is not None and flags >> 16 & 1:
        yield Check("power", "warn", "under-voltage since boot", fix)
    elif flags is None and not list((s.root / "sys/class/hwmon").glob("hwmon*/in*_lcrit_alarm")):
        yield Check("power", "skip", "this board does not measure its supply")
    else:
        yield Check("power", "ok", "no under-voltage since boot")


def check_clock(config: Config, s: Surroundings) -> Iterator[Check]:
    """Only names of files and the journal depend on it; decisions run on the monotonic clock."""
    now_s = s.wall_s()
    synced = (s.root / "run/systemd/timesync/synchronized").exists()
    if not synced:
        synced = (s.run(("timedatectl", "show", "-p", "NTPSynchronized", "--value")) or "").strip() == "yes"
    battery = any((s.root / "sys/class/rtc").glob("rtc*"))
    if now_s < _BUILT_S:
        when = time.strftime("%Y-%m-%d", time.gmtime(now_s))
        yield Check("clock", "fail", f"it is not {when}", "timedatectl set-time, or add a battery clock or a network")
    elif synced:
        yield Check("clock", "ok", "synchronised" + (", with a battery clock" if battery else ""))
    elif battery:
        yield Check("clock", "ok", "not synchronised, but there is a battery clock")
    else:
        fix = "add a battery clock, or names of recordings will carry wrong times; decisions do not depend on it"
        yield Check("clock", "warn", "not synchronised, and no battery clock", fix)


def check_disk(config: Config, s: Surroundings) -> Iterator[Check]:
    """Room and permission for what is recorded."""
    r = config.record
    if not (r.enabled or r.incidents or r.shadow):
        yield Check("disk", "skip", "nothing is recorded ([record])")
        return
    folder = s.root / r.folder.lstrip("/") if s.root != Path("/") else Path(r.folder)
    there = next(p for p in (folder, *folder.parents) if p.exists())
    try:
        disk = os.statvfs(there)
    except OSError as error:
        yield Check("disk", "fail", f"{there}: {error.strerror}", "choose another record.folder")
        return
    free_mb = disk.f_bavail * disk.f_frsize / 1e6
    used_mb = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e6 if folder.is_dir() else 0.0
    needed_mb = max((r.max_mb if r.enabled else 0) + r.incidents_max_mb - used_mb, 0) + r.min_free_mb
    if disk.f_flag & os.ST_RDONLY:
        yield Check("disk", "fail", f"{there} is read-only", "record to a disk that can be written: record.folder")
    elif free_mb < r.min_free_mb:
        yield Check("disk", "fail", f"{free_mb:.0f} MB free on {there}: recording pauses", "make room, or lower record.max_mb")
    elif not os.access(there, os.W_OK):
        fix = "run the doctor as the service does: sudo -u tmde-edge"
        yield Check("disk", "warn", f"{there} cannot be written by this user", fix)
    elif free_mb < needed_mb:
        text = f"{free_mb:.0f} MB free, the limits of [record] allow {needed_mb:.0f} MB more"
        yield Check("disk", "warn", text, "lower record.max_mb and record.incidents_max_mb, or use a larger disk")
    else:
        yield Check("disk", "ok", f"{free_mb:.0f} MB free in {folder}")


def check_memory(config: Config, s: Surroundings) -> Iterator[Check]:
    """What is left for us."""
    for line in (read_text(s.root / "proc/meminfo") or "").splitlines():
        if line.startswith("MemAvailable:"):
            mb = int(line.split()[1]) / 1024
            low = mb < _MEMORY_MB and s.status() is None
            fix = "close other programs; the service takes 200 to 350 MB without depth" if low else ""
            yield Check("memory", "warn" if low else "ok", f"{mb:.0f} MB available", fix)
            return
    yield Check("memory", "skip", "/proc/meminfo does not tell")


def check_models(config: Config, s: Surroundings) -> Iterator[Check]:
    """Every network that the configuration asks for loads and runs."""
    from tmde_edge.app.doctor_devices import try_networks

    yield from try_networks(config)


def check_calibration(config: Config, s: Surroundings, path: Path | None) -> Iterator[Check]:
    """Whether there is one, and how old the file is that holds it."""
    c = config.camera
    camera = c.camera()
    if camera is None:
        yield Check("calibration", "fail", "camera.fx_px is not set: no distances", "run `tmde-edge calibrate`")
        return
    if c.fx_px is None:
        text = f"camera.prior = {c.prior!r}: f = {camera.fx_px:.0f} px, +- {camera.focal_sigma:.0%} in every distance"
        yield Check("calibration", "warn", text, "run `tmde-edge calibrate`: it measures f of this camera")
        return
    missing = [k for k, v in (("height_m", c.height_m), ("to_bumper_m", c.to_bumper_m or None)) if v is None]
    age_days = (s.wall_s() - path.stat().st_mtime) / _DAY_S if path is not None and path.exists() else None
    age = f", file {age_days:.0f} days old" if age_days is not None and age_days >= 0 else ""
    text = f"fx {c.fx_px:.0f} px at {c.width_px}x{c.height_px}, {'with' if c.distortion else 'without'} distortion{age}"
    if age_days is not None and age_days > _OLD_CALIBRATION_DAYS:
        yield Check("calibration", "warn", text, "check it: a known plate at a measured distance, `tmde-edge calibrate`")
    elif missing:
        yield Check("calibration", "warn", f"{text}; camera.{', camera.'.join(missing)} not set", "measure and set them")
    else:
        yield Check("calibration", "ok", text)


def check_configuration(config: Config, base_dir: Path) -> Iterator[Check]:
    """What the service looks at before it starts, and ends on where it is wrong."""
    from tmde_edge.app.wiring import check_parts

    try:
        check_parts(config, base_dir)
    except TmdeError as error:
        yield Check("configuration", "fail", str(error), "correct it; the service does not start with it")
    else:
        yield Check("configuration", "ok", "the service can start with it")


def check_service(config: Config, s: Surroundings) -> Iterator[Check]:
    """How the service is, where it runs."""
    status = s.status()
    if status is None:
        yield Check("service", "skip", "does not run")
    elif status.get("faults"):
        yield Check("service", "warn", f"runs, faults: {', '.join(status['faults'])}", "see `tmde-edge status`")
    else:
        yield Check("service", "ok", f"runs, {status['frames']['rate_hz']:.1f} frames/s")


def examine(config: Config, s: Surroundings, config_path: Path | None = None, base_dir: Path = Path()) -> list[Check]:
    """Every check in the order of the report; one that fails itself is a failed check, not the end."""
    from tmde_edge.app.doctor_devices import check_camera, check_can

    subjects: Sequence[tuple[str, Callable[[], Iterator[Check]]]] = (
        ("service", lambda: check_service(config, s)),
        ("configuration", lambda: check_configuration(config, base_dir)),
        ("camera", lambda: check_camera(config, s, base_dir)),
        ("calibration", lambda: check_calibration(config, s, config_path)),
        ("CAN", lambda: check_can(config, s, base_dir)),
        ("models", lambda: check_models(config, s)),
        ("temperature", lambda: check_board(config, s)),
        ("power", lambda: check_power(config, s)),
        ("clock", lambda: check_clock(config, s)),
        ("disk", lambda: check_disk(config, s)),
        ("memory", lambda: check_memory(config, s)),
    )
    found: list[Check] = []
    for name, subject in subjects:
        try:
            found += subject()
        except TmdeError as error:
            found.append(Check(name, "fail", str(error), "correct the configuration"))
        except OSError as error:
            found.append(Check(name, "fail", f"cannot be examined ({error.strerror or error})", "run it as root, or report it"))
    return found


def as_json(checks: Sequence[Check]) -> str:
    """One object: whether all is well, and every check."""
    return json.dumps({"ready": not any(c.state == "fail" for c in checks), "checks": [asdict(c) for c in checks]})
