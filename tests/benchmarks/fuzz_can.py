"""Ten million hostile frames into the receiver: no crash, no NaN, no state from a bad frame. Run by hand:

python tests/benchmarks/fuzz_can.py [frames] [seed]
"""

from __future__ import annotations

import json
import math
import random
import sys
import time

import msgspec

from tmde_edge.adapters.can_ports.log_files import candump_line
from tmde_edge.canbus.checks import toyota
from tmde_edge.canbus.decoder import build_decoder
from tmde_edge.canbus.ego_rx import EgoReceiver
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.messages import CanFrame

VEHICLE = {
    "speed": {"id": 0xB4, "start_bit": 47, "length": 16, "byte_order": "big", "scale": 0.01, "unit": "km/h",
              "checksum": "toyota"},
    "yaw_rate": {"id": 0x24, "start_bit": 1, "length": 10, "byte_order": "big", "scale": 0.244, "offset": -125, "unit": "deg/s",
                 "checksum": "toyota"},
    "brake": {"id": 0x17C, "start_bit": 53, "length": 1, "byte_order": "big", "checksum": "honda",
              "counter": {"start_bit": 60, "length": 2}},
    "turn_signal": {"id": 0x326, "start_bits": [26, 27], "length": 1, "byte_order": "big"},
    "gps_device": "/dev/null",
}  # fmt: skip
IDS = (0xB4, 0xB4, 0xB4, 0x24, 0x24, 0x17C, 0x326, 0x1FFFFF47, 0x18FEF100)


def main() -> None:
    total = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000_000
    chance = random.Random(int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    settings = msgspec.convert({"vehicle": VEHICLE}, CanSettings)
    receiver = EgoReceiver(build_decoder(settings), settings)
    start_s, t_ns, states, wrong = time.monotonic(), 0, 0, 0
    good: dict[int, float] = {}  # time and speed of the latest frames that were right
    for n in range(total):
        dice = chance.random()
        t_ns += chance.randrange(30_000_000) if dice < 0.97 else chance.randrange(-(10**13), 10**13)
        can_id = chance.choice(IDS) if dice < 0.8 else chance.randrange(0x20000000)
        size = 8 if dice < 0.9 else chance.randrange(65)
        data = chance.randbytes(size)
        if dice < 0.2 and size == 8:  # a right checksum, any content
            body = data[:7]
            data = body + bytes([(8 + (can_id >> 8) + (can_id & 0xFF) + sum(body)) & 0xFF])
        channel = "gps" if can_id == 0x1FFFFF47 else "can0" if dice < 0.95 else "can1"
        frame = CanFrame(t_ns=t_ns, can_id=can_id, data=data, extended=can_id > 0x7FF, channel=channel)
        if can_id == 0xB4 and toyota(can_id, data):
            good[t_ns] = int.from_bytes(data[5:7], "big") * 0.01 / 3.6
            if len(good) > 20_000:
                good = dict(list(good.items())[-10_000:])
        state = receiver.update(frame)
        if n % 16 == 0:
            receiver.lost(t_ns)
        if state is not None:
            states += 1
            values = (state.speed_mps, state.speed_sigma_mps, state.yaw_rate_sigma_radps, state.yaw_rate_radps or 0.0)
            if not all(map(math.isfinite, values)) or not 0 <= state.speed_mps <= 150 or abs(values[3]) > 2.1:
                sys.exit(f"frame {n}: {state} from {candump_line(frame)}")
            from_bus = state.speed_sigma_mps < 0.2  # the rest is GPS
            wrong += from_bus and abs(good.get(state.t_ns, math.nan) - state.speed_mps) > 1e-9
            wrong += from_bus and state.t_ns not in good
    outcome = {
        "frames": total,
        "states": states,
        "states_from_bad_frames": wrong,
        "seconds": round(time.monotonic() - start_s, 1),
    }
    print(json.dumps(outcome | {"counts": dict(receiver.counts), "offset_dps": math.degrees(receiver.yaw_offset.offset_radps)}))
    sys.exit(1 if wrong else 0)


main()
