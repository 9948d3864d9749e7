"""Our side for the two-process test: a CanPort with receiver and transmitter on the channel given; prints what it came to.

Arguments: interface, channel, seconds at most; it ends when it has heard 50 speeds and said 50 frames.
"""

from __future__ import annotations

import json
import sys
import threading
import time

import msgspec

from tmde_edge.adapters.can_ports.bus import CanPort
from tmde_edge.canbus.alert_tx import AlertTransmitter, StatusInfo
from tmde_edge.canbus.decoder import build_decoder
from tmde_edge.canbus.ego_rx import EgoReceiver
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.messages import Alert, CanFrame, FrameResult, Pose


def main() -> None:
    interface, channel, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
    speed = {"id": 0xB4, "start_bit": 47, "length": 16, "byte_order": "big", "scale": 0.01, "unit": "km/h", "checksum": "toyota"}
    settings = msgspec.convert(
        {"interface": interface, "channel": channel, "transmit": True, "vehicle": {"speed": speed}}, CanSettings
    )
    decoder = build_decoder(settings)
    receiver, sender = EgoReceiver(decoder, settings), AlertTransmitter(settings)
    lock = threading.Lock()
    states, ids = [], set()

    def on_frame(frame: CanFrame) -> None:
        with lock:
            ids.add(frame.can_id)
            state = receiver.update(frame)
            if state is not None:
                states.append((time.monotonic_ns() - frame.t_ns, state.speed_mps))

    port = CanPort(settings, on_frame, decoder.filters, open_pause_s=0.1)
    port.start()
    end = time.monotonic() + seconds
    while time.monotonic() < end and (len(states) < 50 or port.counters.sent < 50):
        t_ns = time.monotonic_ns()
        result = FrameResult(
            t_ns=t_ns, frame_index=0, plates=(), lead=None, ego=None, pose=Pose(pitch_rad=0.0, roll_rad=0.0), depth=None,
            alert=Alert(level="warning", reason="ttc", ttc_s=1.5), faults=(), mode="strict",
        )  # fmt: skip
        for frame in sender.frames(result, StatusInfo(), t_ns):
            port.send(frame)
        time.sleep(0.01)
    port.close()
    delays_ms = sorted(d / 1e6 for d, _ in states)
    outcome = {
        "states": len(states),
        "speeds": sorted({s for _, s in states}),
        "ids": sorted(ids),
        "counters": port.counters.as_dict(),
        "median_delay_ms": delays_ms[len(delays_ms) // 2] if delays_ms else None,
    }
    print(json.dumps(outcome))


main()
