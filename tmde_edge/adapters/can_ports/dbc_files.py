"""Reads the vehicle's profile and DBC file, so that the canbus package needs no file."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec

from tmde_edge import canbus
from tmde_edge.canbus.decoder import VehicleDecoder, build_decoder
from tmde_edge.canbus.settings import CanSettings, VehicleSettings
from tmde_edge.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_PROFILES = Path(canbus.__file__).parent / "data" / "vehicles"  # the same files as config/vehicles


def load_vehicle_decoder(settings: CanSettings, base_dir: Path) -> VehicleDecoder:
    """Resolves `[can.vehicle]` with its files, whose paths are relative to base_dir (the configuration's folder).

    Raises ConfigError: one line with what, where, the value and what to do.
    """
    settings = with_profile(settings, base_dir)
    dbc = settings.vehicle.dbc
    if dbc is None:
        return build_decoder(settings)
    path = base_dir / dbc
    return build_decoder(settings, _read(path, "can.vehicle.dbc", "name the vehicle's DBC file"), path.name)


def with_profile(settings: CanSettings, base_dir: Path) -> CanSettings:
    """The settings with the profile's keys filled in and `profile` empty: what a log needs to keep; the user's keys win."""
    profile = settings.vehicle.profile
    if not profile:
        return settings
    path = base_dir / profile
    if "/" not in profile and not profile.endswith(".toml"):
        path = _PROFILES / f"{profile}.toml"
    known = ", ".join(sorted(p.stem for p in _PROFILES.glob("*.toml")))
    text = _read(path, "can.vehicle.profile", f"name a TOML file or one of {known}")
    try:
        table = tomllib.loads(text)["can"]["vehicle"]
        base = msgspec.convert(table, VehicleSettings)
    except tomllib.TOMLDecodeError as e:
        raise ConfigError(f"can.vehicle.profile {path}: not TOML: {e}") from None
    except (KeyError, TypeError):
        raise ConfigError(f"can.vehicle.profile {path}: no [can.vehicle] table in it; see config/vehicles") from None
    except msgspec.ValidationError as e:
        raise ConfigError(f"can.vehicle.profile {path}: {e}; see config/vehicles") from None
    defaults = VehicleSettings()
    own = {
        name: value
        for name in VehicleSettings.__struct_fields__
        if (value := getattr(settings.vehicle, name)) != getattr(defaults, name)
    }
    return msgspec.structs.replace(settings, vehicle=msgspec.structs.replace(base, **own | {"profile": ""}))


def _read(path: Path, key: str, advice: str) -> str:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{key} {path}: no such file; {advice}") from None
    except OSError as e:
        raise ConfigError(f"{key} {path}: cannot be read ({e.strerror}); {advice}") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")  # what most DBC editors write
