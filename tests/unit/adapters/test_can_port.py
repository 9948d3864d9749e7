"""The bus port: two processes over slcan and (in a network namespace of their own) multicast; faults, queues, clocks."""

from __future__ import annotations

import itertools
import json
import logging
import os
import select
import shutil
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest
from can.interfaces.virtual import VirtualBus
from hypothesis import given
from hypothesis import strategies as st

from tmde_edge.adapters.can_ports.bus import CanPort, monotonic_from_wall
from tmde_edge.adapters.can_ports.disabled import DisabledCanPort
from tmde_edge.adapters.can_ports.nmea import NmeaPort
from tmde_edge.adapters.can_ports.retry import BackOff
from tmde_edge.adapters.can_ports.serial_blocks import BlockReader
from tmde_edge.app.can_transmit import listen
from tmde_edge.canbus.gps import speed_from_frame
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.errors import DeviceError
from tmde_edge.messages import CanFrame

HERE = Path(__file__).parent


class Wire:
    """Two serial CAN adapters on one wire: what is sent on one pseudo-terminal arrives on the other."""

    def __init__(self) -> None:
        self.masters: list[int] = []
        self._slaves: list[int] = []
        self.paths: list[str] = []
        for _ in range(2):
            master, slave = os.openpty()
            tty.setraw(slave)
            tty.setraw(master, termios.TCSANOW)
            self.masters.append(master)
            self._slaves.append(slave)
            self.paths.append(os.ttyname(slave))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._relay, daemon=True)
        self._thread.start()

    def _relay(self) -> None:
        pending = dict.fromkeys(self.masters, b"")
        while not self._stop.is_set():
            for master in select.select(self.masters, [], [], 0.05)[0]:
                lines = (pending[master] + os.read(master, 4096)).split(b"\r")
                pending[master] = lines.pop()
                other = self.masters[1 - self.masters.index(master)]
                for line in lines:
                    if line[:1] in b"tT":  # frames; the rest are the adapter's own commands
                        os.write(other, line + b"\r")

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for fd in (*self.masters, *self._slaves):
            os.close(fd)


@pytest.fixture
def wire() -> Iterator[Wire]:
    made = Wire()
    yield made
    made.close()


def wait_for(true: Callable[[], bool], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


def check(ours: str, theirs: str) -> None:
    """What both processes of a two-process test printed."""
    got = json.loads(ours)
    assert got["ids"] == [0xB4]  # 0x123 is not wanted
    assert got["states"] > 40
    assert got["speeds"] == [10.0]
    assert 0 <= got["median_delay_ms"] < 200
    assert got["counters"]["received"] == got["states"]
    assert got["counters"]["failed"] == 0
    lines = theirs.splitlines()
    assert lines[0] == "up"
    alerts = [json.loads(line) for line in lines[1:]]
    warnings = [a for a in alerts if a["Alert_Level"] == "warning"]
    assert len(warnings) > 15
    assert {a["Alert_TTC"] for a in warnings} == {1.5}
    steps = {(b["Alert_Counter"] - a["Alert_Counter"]) % 16 for a, b in itertools.pairwise(warnings)}
    assert steps == {1}  # none lost


def test_two_processes_over_serial_adapters(wire: Wire) -> None:
    peer = subprocess.Popen(
        [sys.executable, str(HERE / "can_peer.py"), "slcan", wire.paths[1], "25"], stdout=subprocess.PIPE, text=True
    )
    ours = subprocess.run(
        [sys.executable, str(HERE / "can_daemon_side.py"), "slcan", wire.paths[0], "20"],
        capture_output=True,
        text=True,
        timeout=30,
    )
    theirs, _ = peer.communicate(timeout=30)
    assert ours.returncode == 0, ours.stderr
    assert peer.returncode == 0
    check(ours.stdout, theirs)


def test_two_processes_over_multicast_in_a_namespace_of_their_own() -> None:
    pytest.importorskip("msgpack", reason="python-can's udp_multicast needs msgpack")
    script = (
        "ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && "
        f"{sys.executable} {HERE / 'can_peer.py'} udp_multicast 239.74.163.2 25 & "
        f"{sys.executable} {HERE / 'can_daemon_side.py'} udp_multicast 239.74.163.2 20; wait"
    )
    unshare = shutil.which("unshare")
    assert unshare is not None, "util-linux's unshare is needed: this test sends nothing outside a namespace"
    ran = subprocess.run([unshare, "-r", "-n", "sh", "-c", script], capture_output=True, text=True, timeout=40)
    assert ran.returncode == 0, ran.stderr
    lines = ran.stdout.splitlines()
    ours = [line for line in lines if '"states"' in line]
    assert len(ours) == 1, ran.stderr
    check(ours[0], "\n".join(line for line in lines if '"states"' not in line))


def settings(channel: str, **changes: object) -> CanSettings:
    return CanSettings(interface="virtual", channel=channel, transmit=True, **changes)  # type: ignore[arg-type]


def test_nothing_is_sent_before_the_user_says_so(caplog: pytest.LogCaptureFixture) -> None:
    port = CanPort(CanSettings(interface="virtual", channel="silent"), lambda frame: None)
    with can.Bus(interface="virtual", channel="silent") as other, caplog.at_level(logging.WARNING):
        port.start()
        wait_for(lambda: port.connected)
        port.send(CanFrame(t_ns=0, can_id=0x6D0, data=b"\x01"))
        assert other.recv(0.2) is None
        port.close()
    assert port.counters.silent == 1
    assert sum("silent" in r.message for r in caplog.records) == 1
    assert port.faults == ()


def test_a_frame_carries_monotonic_time_and_all_its_bytes() -> None:
    got: list[CanFrame] = []
    port = CanPort(settings("plain"), got.append)
    port.start()
    wait_for(lambda: port.connected)
    with can.Bus(interface="virtual", channel="plain") as other:
        before = time.monotonic_ns()
        other.send(can.Message(arbitration_id=0x18FEF100, data=b"\x01\x02", is_extended_id=True))
        other.send(can.Message(arbitration_id=0x123, is_remote_frame=True, is_extended_id=False))
        wait_for(lambda: len(got) == 1)
        after = time.monotonic_ns()
    port.close()
    assert (got[0].can_id, got[0].data, got[0].extended, got[0].channel) == (0x18FEF100, b"\x01\x02", True, "plain")
    assert before - 5_000_000 <= got[0].t_ns <= after


def test_wall_clock_stamps_survive_a_jump() -> None:
    second = 1_000_000_000
    wall, mono = 1_800_000_000 * second, 500 * second
    t_ns, jumped = monotonic_from_wall(1_800_000_000 - 0.25, wall, mono)
    assert not jumped
    assert t_ns == pytest.approx(mono - second // 4, abs=300)  # a float of seconds since 1970 is no finer
    assert monotonic_from_wall(1_800_000_000 + 3600, wall, mono) == (mono, True)  # the clock was set back meanwhile
    assert monotonic_from_wall(1_800_000_000 - 3600, wall, mono) == (mono, True)  # ... or forward
    assert monotonic_from_wall(0.0, wall, mono) == (mono, False)  # no stamp at all


def test_send_never_blocks_and_the_oldest_goes() -> None:
    port = CanPort(settings("full", queue_frames=8), lambda frame: None)  # not started: nobody empties the queue
    start = time.monotonic()
    for n in range(1000):
        port.send(CanFrame(t_ns=n, can_id=n, data=b""))
    assert time.monotonic() - start < 0.5
    assert port.counters.dropped == 992
    with can.Bus(interface="virtual", channel="full") as other:
        port.start()
        wait_for(lambda: port.counters.sent + port.counters.dropped == 1000)
        while (message := other.recv(0.1)) is not None:
            assert message.arbitration_id >= 992
        port.close()


def test_an_adapter_that_takes_nothing_is_reported_and_recovers(caplog: pytest.LogCaptureFixture) -> None:
    master, slave = os.openpty()  # nobody reads: the serial port blocks, as a hung adapter does
    tty.setraw(slave)
    os.set_blocking(master, False)
    quick = CanSettings(interface="slcan", channel=os.ttyname(slave), transmit=True, queue_frames=8)
    port = CanPort(quick, lambda frame: None, open_pause_s=0.05)
    drained = threading.Event()

    def drain() -> None:
        while not drained.is_set():
            if select.select([master], [], [], 0.02)[0]:
                os.read(master, 4096)

    with caplog.at_level(logging.WARNING):
        port.start()
        helper = threading.Thread(target=drain, daemon=True)
        helper.start()  # opening waits for its commands to leave
        wait_for(lambda: port.connected)
        drained.set()
        helper.join()

        def stuck() -> bool:
            for n in range(8):
                port.send(CanFrame(t_ns=n, can_id=0x6D0, data=bytes(8)))
            time.sleep(0.02)
            return port.faults == ("can_tx",)

        wait_for(stuck, 20.0)  # the terminal's own buffer is full, then the queue
        start = time.monotonic()
        port.send(CanFrame(t_ns=0, can_id=0x6D0, data=bytes(8)))
        assert time.monotonic() - start < 0.1
        assert port.faults == ("can_tx",)
        assert port.counters.dropped > 0
        drained.clear()
        helper = threading.Thread(target=drain, daemon=True)
        helper.start()
        wait_for(lambda: port.send(CanFrame(t_ns=0, can_id=0x6D0, data=b"")) is None and port.faults == ())
    assert sum(r.levelno == logging.ERROR for r in caplog.records) == 1
    port.close()
    drained.set()
    helper.join()
    os.close(master)
    os.close(slave)


def test_a_refusing_adapter_is_logged_once(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    refuse = [True]
    real = VirtualBus.send

    def send(self: object, message: can.Message, timeout: float | None = None) -> None:
        if refuse[0]:
            raise can.CanOperationError("No buffer space available")
        real(self, message, timeout)  # type: ignore[arg-type]

    monkeypatch.setattr(VirtualBus, "send", send)
    port = CanPort(settings("refuse"), lambda frame: None)
    with caplog.at_level(logging.WARNING):
        port.start()
        wait_for(lambda: port.connected)
        for n in range(5):
            port.send(CanFrame(t_ns=n, can_id=0x6D0, data=b""))
        wait_for(lambda: port.counters.failed == 5)
        assert port.faults == ("can_tx",)
        refuse[0] = False
        port.send(CanFrame(t_ns=9, can_id=0x6D0, data=b""))
        time.sleep(0.1)
        assert port.faults == ("can_tx",)  # one that got through is no recovery yet
        wait_for(lambda: port.send(CanFrame(t_ns=9, can_id=0x6D0, data=b"")) is None and port.faults == ())
    port.close()
    assert [r.levelno for r in caplog.records] == [logging.ERROR, logging.WARNING]


def test_no_bus_is_logged_once_and_tried_again(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    missing = tmp_path / "ttyACM0"
    port = CanPort(CanSettings(interface="slcan", channel=str(missing), transmit=True), lambda frame: None, open_pause_s=0.05)
    with caplog.at_level(logging.WARNING):
        port.start()
        wait_for(lambda: port.faults == ("can_tx",))
        port.send(CanFrame(t_ns=0, can_id=0x6D0, data=b""))
        wait_for(lambda: port.counters.dropped == 1)
        time.sleep(0.6)  # several tries
        assert sum("cannot be opened" in r.message for r in caplog.records) == 1
        wire = Wire()
        missing.symlink_to(wire.paths[0])  # plugged in
        wait_for(lambda: port.connected and not port.faults)
        assert sum("works again" in r.message for r in caplog.records) == 1
    port.close()
    wire.close()


def test_an_unplugged_adapter_is_noticed_and_comes_back(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    wire, device = Wire(), tmp_path / "ttyACM0"
    device.symlink_to(wire.paths[0])
    got: list[CanFrame] = []
    port = CanPort(CanSettings(interface="slcan", channel=str(device), transmit=True), got.append, open_pause_s=0.05)
    with caplog.at_level(logging.WARNING):
        port.start()
        wait_for(lambda: port.connected)
        os.write(wire.masters[0], b"t0B42A1B2\r")
        wait_for(lambda: len(got) == 1)
        os.write(wire.masters[0], b"tXYZ9\xff\xfe\r" + b"t0B41A3\r")  # noise, then a frame
        wait_for(lambda: port.counters.garbled >= 1)
        wire.close()
        wait_for(lambda: port.faults == ("can_tx",))
        device.unlink()
        wire = Wire()
        device.symlink_to(wire.paths[0])
        wait_for(lambda: port.connected)
        wait_for(lambda: os.write(wire.masters[0], b"t0B41A4\r") > 0 and any(f.data == b"\xa4" for f in got))
    assert port.counters.opened >= 2
    assert sum(r.levelno == logging.ERROR for r in caplog.records) <= 2  # bus and sending, once each
    assert port.faults == ()
    port.close()
    wire.close()


def test_bus_off_is_counted_and_reported() -> None:
    port = CanPort(settings("off"), lambda frame: None)
    port.start()
    wait_for(lambda: port.connected)
    with can.Bus(interface="virtual", channel="off") as other:
        other.send(can.Message(is_error_frame=True, arbitration_id=0x40, is_extended_id=True))
        wait_for(lambda: port.counters.bus_off == 1)
        assert port.faults == ("can_tx",)
        other.send(can.Message(is_error_frame=True, arbitration_id=0x100, is_extended_id=True))
        wait_for(lambda: port.faults == ())
    port.close()
    assert port.counters.error_frames == 2


def test_an_unknown_error_reaches_the_service() -> None:
    crashed: list[BaseException] = []

    def broken(frame: CanFrame) -> None:
        raise LookupError("ours")

    port = CanPort(settings("crash"), broken, on_crash=crashed.append)
    port.start()
    wait_for(lambda: port.connected)
    with can.Bus(interface="virtual", channel="crash") as other:
        other.send(can.Message(arbitration_id=1, is_extended_id=False))
        wait_for(lambda: len(crashed) == 1)
    assert isinstance(crashed[0], LookupError)
    port.close()


def test_disabled_port_takes_the_same_calls() -> None:
    port = DisabledCanPort()
    port.start()
    port.send(CanFrame(t_ns=0, can_id=1, data=b""))
    port.close()
    assert (port.counters.silent, port.faults) == (1, ())


def test_pauses_grow_to_a_limit() -> None:
    back_off = BackOff(0.25, 1.0)
    assert [back_off.pause_s() for _ in range(4)] == [0.25, 0.5, 1.0, 1.0]
    back_off.reset()
    assert back_off.pause_s() == 0.25


def test_a_serial_adapter_serves_one_program(caplog: pytest.LogCaptureFixture) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    settings = CanSettings(interface="slcan", channel=os.ttyname(slave))
    first = CanPort(settings, lambda frame: None, open_pause_s=0.05)
    second = CanPort(settings, lambda frame: None, open_pause_s=0.05)
    first.start()
    wait_for(lambda: first.connected)
    while select.select([master], [], [], 0.1)[0]:  # what opening says to the adapter
        os.read(master, 4096)
    second.start()
    wait_for(lambda: "another program holds it" in caplog.text)
    with pytest.raises(DeviceError, match="stop the service first"):
        listen(settings, 0.1)
    assert select.select([master], [], [], 0.05)[0] == []  # "C" would have closed the first one's channel
    first.close()
    wait_for(lambda: second.connected)
    second.close()
    os.close(master)
    os.close(slave)


class CountedPort:
    """A serial port that counts how often it is asked."""

    def __init__(self, data: bytes) -> None:
        self.data, self.reads = data, 0
        self.baudrate = 115200

    @property
    def in_waiting(self) -> int:
        return len(self.data)

    def read(self, size: int = 1) -> bytes:
        self.reads += 1
        out, self.data = self.data[:size], self.data[size:]
        return out

    def reset_input_buffer(self) -> None:
        self.data = b""


@given(st.lists(st.binary(min_size=1, max_size=60), max_size=6), st.integers(1, 7))
def test_a_serial_port_read_in_blocks_gives_every_byte_once(blocks: list[bytes], size: int) -> None:
    port = CountedPort(b"")
    reader = BlockReader(port)
    assert reader.read(1) == b""  # the port's own timeout
    asked = port.reads
    got = b""
    for block in blocks:
        port.data += block
        while reader.in_waiting:
            got += reader.read(size)
    assert got == b"".join(blocks)
    assert port.reads - asked == len(blocks)


def test_a_serial_port_read_in_blocks_forgets_what_was_thrown_away() -> None:
    port = CountedPort(b"t1230\rt45")
    reader = BlockReader(port)
    assert reader.read(1) == b"t"
    reader.reset_input_buffer()
    assert reader.in_waiting == 0
    port.data = b"60\r"
    assert reader.read(9) == b"60\r"
    assert reader.baudrate == 115200  # all else is the port's own


def test_gps_over_a_serial_port(tmp_path: Path) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    got: list[CanFrame] = []
    port = NmeaPort(os.ttyname(slave), 9600, got.append)
    port.start()
    wait_for(
        lambda: os.write(master, b"\xfe\xfa$GPRMC,broken\r\n$GPVTG,054.7,T,034.4,M,005.5,N,010.2,K*48\r\n") > 0 and bool(got)
    )
    port.close()
    assert got[0].channel == "gps"
    assert speed_from_frame(got[0]) == pytest.approx(5.5 * 1852 / 3600, abs=0.001)
    os.close(master)
    os.close(slave)
