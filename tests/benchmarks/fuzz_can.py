"""Ten million hostile frames into the receiver: no crash, no NaN, no state from a bad frame. Run by hand:

python tests/benchmarks/fuzz_can.py [frames] [seed]
"""

from __future__ import annotations

import json
import math
import sys
import time

import msgspec
import numpy as np

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
KNOWN = np.array([0xB4, 0xB4, 0xB4, 0x24, 0x24, 0x17C, 0x326, 0x1FFFFF47, 0x18FEF100])
BLOCK = 50_000


def block(chance: np.random.Generator, t_ns: int) -> list[CanFrame]:
    """Random ids, lengths, payloads, buses and times; a fifth with Toyota's checksum made right."""
    dice = chance.random(BLOCK)
    known = KNOWN[chance.integers(len(KNOWN), size=BLOCK)]
    ids = np.where(dice < 0.8, known, chance.integers(0x20000000, size=BLOCK)).tolist()
    sizes = np.where(dice < 0.9, 8, chance.integers(65, size=BLOCK)).tolist()
    steps = np.where(dice < 0.97, chance.integers(30_000_000, size=BLOCK), chance.integers(-(10**13), 10**13, size=BLOCK))
    times = (t_ns + np.cumsum(steps)).tolist()
    payload = chance.bytes(BLOCK * 64)
    frames = []
    for n, (can_id, size, d) in enumerate(zip(ids, sizes, dice.tolist(), strict=True)):
        data = payload[n * 64 : n * 64 + size]
        if d < 0.2:
            data = data[:7] + bytes([(8 + (can_id >> 8) + (can_id & 0xFF) + sum(data[:7])) & 0xFF])
        channel = "gps" if can_id == 0x1FFFFF47 else "can0" if d < 0.95 else "can1"
        frames.append(CanFrame(t_ns=times[n], can_id=can_id, data=data, extended=can_id > 0x7FF, channel=channel))
    return frames


def main() -> None:
    total = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000_000
    chance = np.random.default_rng(int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    settings = msgspec.convert({"vehicle": VEHICLE}, CanSettings)
    receiver = EgoReceiver(build_decoder(settings), settings)
    start_s, cpu_s, t_ns, done, states = time.monotonic(), time.process_time(), 0, 0, 0
    good: dict[int, float] = {}  # time and speed of the latest frames that were right
    while done < total:
        for frame in block(chance, t_ns):
            t_ns = frame.t_ns
            if frame.can_id == 0xB4 and toyota(0xB4, frame.data):
                good[t_ns] = int.from_bytes(frame.data[5:7], "big") * 0.01 / 3.6
            state = receiver.update(frame)
            if state is None:
                continue
            states += 1
            yaw = state.yaw_rate_radps or 0.0
            finite = math.isfinite(state.speed_mps + state.speed_sigma_mps + state.yaw_rate_sigma_radps + yaw)
            from_bus = state.speed_sigma_mps < 0.2  # the rest is GPS
            true = not from_bus or abs(good.get(state.t_ns, math.nan) - state.speed_mps) < 1e-9
            if not finite or not true or abs(yaw) > 2.1 or not 0 <= state.speed_mps <= 150:
                sys.exit(f"after {done} frames, seed {sys.argv[2:]}: {state} from {frame}")
        receiver.lost(t_ns)
        good = dict(list(good.items())[-BLOCK // 10 :])
        done += BLOCK
        if done % 1_000_000 == 0:
            print(f"{done} frames, {states} states", file=sys.stderr, flush=True)
    outcome = {
        "frames": done,
        "states": states,
        "states_from_bad_frames": 0,
        "seconds": round(time.monotonic() - start_s, 1),
        "cpu_seconds": round(time.process_time() - cpu_s, 1),
        "counts": dict(receiver.counts),
        "yaw_offset_dps": math.degrees(receiver.yaw_offset.offset_radps),
    }
    print(json.dumps(outcome))


main()
