"""The other ECU, a process of its own: sends the speed and a few others, prints each ALERT as cantools decodes it.

Arguments: interface, channel, seconds at most; it ends a second after the last ALERT. With udp_multicast it refuses to run
where a packet could leave the machine.
"""

from __future__ import annotations

import json
import socket
import sys
import time
from pathlib import Path

import can
from cantools.database import load_file


def main() -> None:
    interface, channel, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
    if interface == "udp_multicast" and [name for _, name in socket.if_nameindex() if name != "lo"]:
        sys.exit("this test needs a network namespace of its own with nothing but loopback")
    dbc = load_file(Path(__file__).parents[3] / "config" / "tmde_edge.dbc")
    options = {"bitrate": 500_000, "sleep_after_open": 0.1, "timeout": 0.02} if interface == "slcan" else {"hop_limit": 0}
    bus = can.Bus(interface=interface, channel=channel, **options)
    print("up", flush=True)
    end = time.monotonic() + seconds
    due = time.monotonic()
    last = None
    while time.monotonic() < end and (last is None or time.monotonic() - last < 1.0):
        if time.monotonic() >= due:
            due += 0.02
            data = bytearray(8)
            data[5:7] = round(10.0 * 360).to_bytes(2, "big")
            data[7] = (8 + 0xB4 + sum(data[:7])) & 0xFF
            bus.send(can.Message(arbitration_id=0xB4, data=data, is_extended_id=False))
            bus.send(can.Message(arbitration_id=0x123, data=b"\x01", is_extended_id=False))
        message = bus.recv(0.005)
        if message is not None and message.arbitration_id == 0x6D0:
            last = time.monotonic()
            values = dbc.decode_message(message.arbitration_id, message.data)
            print(json.dumps({k: v if isinstance(v, (int, float)) else str(v) for k, v in values.items()}), flush=True)
    bus.shutdown()


main()
