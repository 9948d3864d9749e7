"""The board's temperature goes from the Tick to STATUS, and "not available" where the board tells none."""

from __future__ import annotations

from pathlib import Path

import cantools
import pytest

from tmde_edge.app.wiring import build_estimation
from tmde_edge.config import load
from tmde_edge.messages import CanFrame, Tick

DBC = Path(__file__).parents[3] / "config/tmde_edge.dbc"


@pytest.mark.parametrize(("temperature_c", "raw"), [(61.4, 121), (-40.0, 20), (None, 255)])
def test_temperature_on_status(temperature_c: float | None, raw: int) -> None:
    config = load(None)
    estimation = build_estimation(config, Path())
    database = cantools.database.load_file(DBC)
    tick = Tick(t_ns=10**9, faults=("camera_lost", "hot"), temperature_c=temperature_c)
    (status,) = [o for o in estimation.step(tick) if isinstance(o, CanFrame) and o.can_id == config.can.status_id]
    decoded = database.decode_message(config.can.status_id, status.data, decode_choices=False, scaling=False)
    assert decoded["Status_Temperature"] == raw
