"""The vehicle's profile and DBC file: found, merged, or one line that says why not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from tmde_edge.adapters.can_ports.dbc_files import load_vehicle_decoder, with_profile
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.errors import ConfigError

SPEED = {"message": "SPEED", "signal": "SPEED", "unit": "km/h"}
DBC = """VERSION ""
BU_: A
BO_ 180 SPEED: 8 A
 SG_ SPEED : 47|16@0+ (0.01,0) [0|250] "" A
CM_ SG_ 180 SPEED "Geschwindigkeit für Anzeige";
"""


def settings(**vehicle: Any) -> CanSettings:
    return msgspec.convert({"vehicle": vehicle}, CanSettings)


@pytest.mark.parametrize("profile", ["toyota", "honda", "vw_mqb", "ford", "hyundai_kia", "hyundai_kia_canfd", "j1939"])
def test_every_profile_gives_a_speed_without_any_dbc(profile: str, tmp_path: Path) -> None:
    decoder = load_vehicle_decoder(settings(profile=profile), tmp_path)
    assert "speed" in decoder.quantities
    assert ("yaw_rate" in decoder.quantities) == (profile != "honda")
    assert decoder.notes == ()


def test_own_keys_win_over_the_profile(tmp_path: Path) -> None:
    own = {"id": 0x77, "start_bit": 0, "length": 16, "unit": "m/s"}
    merged = with_profile(settings(profile="toyota", speed=own, gps_device="/dev/ttyS0"), tmp_path).vehicle
    assert merged.speed is not None
    assert merged.speed.id == 0x77
    assert merged.yaw_rate is not None
    assert merged.yaw_rate.id == 0x24
    assert merged.gps_device == "/dev/ttyS0"
    assert merged.profile == ""  # so that a log of these settings needs no profile


def test_a_profile_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        '[can.vehicle]\ndbc = "mine.dbc"\nspeed = { message = "SPEED", signal = "SPEED", unit = "km/h" }\n'
    )
    (tmp_path / "mine.dbc").write_bytes(DBC.encode("cp1252"))  # what most editors write
    decoder = load_vehicle_decoder(settings(profile="mine.toml"), tmp_path)
    assert decoder.filters == ((180, 0x7FF, False),)


@pytest.mark.parametrize(
    ("vehicle", "says"),
    [
        ({"profile": "toyta"}, "no such file; name a TOML file or one of ford, honda"),
        ({"profile": "broken.toml"}, "not TOML"),
        ({"profile": "other.toml"}, "no [can.vehicle] table"),
        ({"profile": "wrong.toml"}, "Object contains unknown field `sped`"),
        ({"dbc": "none.dbc", "speed": SPEED}, "can.vehicle.dbc"),
        ({"dbc": ".", "speed": SPEED}, "cannot be read"),
        ({"dbc": "other.toml", "speed": SPEED}, "no message (BO_) in it"),
        ({"speed": SPEED}, "can.vehicle.dbc is not set"),
    ],
)
def test_errors_are_one_line(vehicle: dict[str, Any], says: str, tmp_path: Path) -> None:
    (tmp_path / "broken.toml").write_text("[can.vehicle\n")
    (tmp_path / "other.toml").write_text("[camera]\nfx_px = 1200\n")
    (tmp_path / "wrong.toml").write_text("[can.vehicle]\nsped = 1\n")
    with pytest.raises(ConfigError) as caught:
        load_vehicle_decoder(settings(**vehicle), tmp_path)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
