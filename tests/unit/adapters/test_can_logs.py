"""CAN logs: every format back to the same frames, candump lines of every kind, and errors that name the line."""

from __future__ import annotations

import contextlib
import gzip
import random
from pathlib import Path

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.adapters.can_ports.log_files import CandumpWriter, candump_line, iter_can_log
from tmde_edge.errors import DeviceError, InputDataError, InputMissingError
from tmde_edge.messages import CanFrame

FRAMES = [
    CanFrame(t_ns=0, can_id=0xB4, data=bytes.fromhex("000000001D0B7A5E"), channel="can0"),
    CanFrame(t_ns=10_000_000, can_id=0x18FEF100, data=b"\x01\x02", extended=True, channel="can0"),
    CanFrame(t_ns=1_500_000_000, can_id=0x7FF, data=b"", channel="can1"),
]


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_candump_lines_of_every_kind(tmp_path: Path) -> None:
    path = write(
        tmp_path / "drive",  # no suffix
        "(1436509052.249713) can0 0B4#000000001D0B7A5E\n"
        "\n"
        "(1436509052.249714500) can0 18FEF100#0102 R\n"
        "(1436509052.249720) can0 0B4#R8\n"  # remote
        "(1436509052.249730) can0 20000004#0000000000000000\n"  # error frame
        "(1436509052.249740) vcan1 123##0AABBCC\n"  # CAN FD
        "  (1436509052.249750) can0 7FF#\r\n"
        "(1436509052.1) can0 001#FF\n"  # a clock that stepped back
        "(1436509053.0000",  # the power went
    )
    assert list(iter_can_log(path)) == [
        CanFrame(t_ns=0, can_id=0xB4, data=bytes.fromhex("000000001D0B7A5E"), channel="can0"),
        CanFrame(t_ns=1_500, can_id=0x18FEF100, data=b"\x01\x02", extended=True, channel="can0"),
        CanFrame(t_ns=27_000, can_id=0x123, data=b"\xaa\xbb\xcc", channel="vcan1"),
        CanFrame(t_ns=37_000, can_id=0x7FF, data=b"", channel="can0"),
        CanFrame(t_ns=-149_713_000, can_id=1, data=b"\xff", channel="can0"),
    ]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.builds(
            lambda t, i, d, e: CanFrame(t_ns=t * 1000, can_id=i if e else i & 0x7FF, data=d, extended=e, channel="can0"),
            st.integers(0, 10**12), st.integers(0, 0x1FFFFFFF), st.binary(max_size=64), st.booleans(),
        ),
        min_size=1,
    )
)  # fmt: skip
def test_what_is_written_reads_back(tmp_path_factory: pytest.TempPathFactory, frames: list[CanFrame]) -> None:
    path = tmp_path_factory.mktemp("log") / "out.log"
    with CandumpWriter(path) as writer:
        for frame in frames:
            writer.write(frame)
    first = frames[0].t_ns
    assert [(f.t_ns + first, f.can_id, f.data, f.extended) for f in iter_can_log(path)] == [
        (f.t_ns, f.can_id, f.data, f.extended) for f in frames
    ]


def test_python_can_reads_what_is_written(tmp_path: Path) -> None:
    path = tmp_path / "out.log"
    with CandumpWriter(path) as writer:
        for frame in FRAMES:
            writer.write(frame)
    read = list(can.CanutilsLogReader(str(path)))
    assert [(m.arbitration_id, bytes(m.data), m.is_extended_id, m.channel) for m in read] == [
        (f.can_id, f.data, f.extended, f.channel) for f in FRAMES
    ]
    assert candump_line(FRAMES[0]) == "(0000000000.000000) can0 0B4#000000001D0B7A5E\n"


def test_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    writer = CandumpWriter("-")
    writer.write(CanFrame(t_ns=1_234_567_891, can_id=0x6D0, data=b"\x01"))
    writer.write(CanFrame(t_ns=-5, can_id=0x6D0, data=b""))
    writer.close()
    assert capsys.readouterr().out == "(0000000001.234568) can0 6D0#01\n(0000000000.000000) can0 6D0#\n"


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("suffix", "writer"),
    [(".asc", can.ASCWriter), (".blf", can.BLFWriter), (".trc", can.TRCWriter), (".log", can.CanutilsLogWriter)],
)
def test_other_formats_give_the_same_frames(tmp_path: Path, suffix: str, writer: type, packed: bool) -> None:
    path = tmp_path / f"drive{suffix}"
    with writer(str(path)) as out:
        for f in FRAMES:
            message = can.Message(
                timestamp=1_700_000_000 + f.t_ns * 1e-9,
                arbitration_id=f.can_id,
                data=f.data,
                is_extended_id=f.extended,
                channel=0,
            )
            out(message)
    if packed:
        packed_path = tmp_path / f"drive{suffix}.gz"
        packed_path.write_bytes(gzip.compress(path.read_bytes()))
        path = packed_path
    read = list(iter_can_log(path))
    assert [(f.can_id, f.data, f.extended) for f in read] == [(f.can_id, f.data, f.extended) for f in FRAMES]
    assert [f.t_ns for f in read] == pytest.approx([f.t_ns for f in FRAMES], abs=1_100_000)  # .trc: a tenth of a ms, .asc: 1 us
    assert read[0].t_ns == 0


def test_formats_are_known_without_a_suffix(tmp_path: Path) -> None:
    path = tmp_path / "drive.blf"
    with can.BLFWriter(str(path)) as out:
        out(can.Message(timestamp=5.0, arbitration_id=0xB4, data=b"\x01", is_extended_id=False))
    plain = path.rename(tmp_path / "drive")
    assert [f.can_id for f in iter_can_log(plain)] == [0xB4]


def test_a_bad_line_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.log", "(0.0) can0 0B4#00\nspeed,12.0\n(0.1) can0 0B4#00\n")
    with pytest.raises(InputDataError, match=r"a\.log: line 2: 'speed,12\.0' is not a candump line"):
        list(iter_can_log(path))
    path = write(tmp_path / "b.log", "(0.0) can0 8FF#00\n")
    with pytest.raises(InputDataError, match=r"line 1: .*id or length"):
        list(iter_can_log(path))


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("video.log", b"\x00\x00\x00\x20ftypisom" * 50, "line 1"),
        ("empty.log", b"", "no CAN frame in it"),
        ("x.blf", b"not a blf file at all, but long enough to be one" * 10, "not readable as blf"),
        ("x.asc", b"some text\nmore text\n", "asc"),
        ("x.trc", b"some text\nmore text\n", "trc"),
        ("x.log.gz", gzip.compress(b"(0.0) can0 0B4#00\n" * 5000, mtime=0)[:60], "damaged gzip file"),
        ("truncated.log", b"(0.0) can0 0B", "line 1"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputDataError) as caught:
        list(iter_can_log(path))
    assert says in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_log_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputMissingError, match="no such file"):
        list(iter_can_log(tmp_path / "none.log"))
    with pytest.raises(InputMissingError, match="is a folder"):
        list(iter_can_log(tmp_path))
    with pytest.raises(DeviceError, match="cannot be written"):
        CandumpWriter(tmp_path / "no" / "such" / "x.log")


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(["a.log", "a.asc", "a.trc", "a.blf", "a"]), st.binary(max_size=400))
def test_no_file_breaks_the_reader(tmp_path_factory: pytest.TempPathFactory, name: str, content: bytes) -> None:
    path = tmp_path_factory.mktemp("junk") / name
    path.write_bytes((b"LOGG" if name == "a.blf" else b"") + content)
    with contextlib.suppress(InputDataError):
        assert all(0 <= f.can_id <= 0x1FFFFFFF for f in iter_can_log(path))


def samples(folder: Path) -> dict[str, bytes]:
    """A small log of each format that python-can writes."""
    made = {}
    for suffix, writer in (("asc", can.ASCWriter), ("trc", can.TRCWriter), ("blf", can.BLFWriter)):
        path = folder / f"x.{suffix}"
        with writer(str(path)) as out:
            for n in range(5):
                out(can.Message(timestamp=1.0 + n, arbitration_id=0xB4 + n, data=bytes(n), is_extended_id=False, channel=1))
        made[suffix] = path.read_bytes()
    return made


def test_damaged_logs_of_other_formats_never_crash(tmp_path: Path) -> None:
    chance = random.Random(7)
    for suffix, whole in samples(tmp_path).items():
        for _ in range(60):
            content = bytearray(whole)
            for _ in range(chance.randint(1, 4)):
                content[chance.randrange(len(content))] = chance.randrange(256)
            path = tmp_path / f"damaged.{suffix}"
            path.write_bytes(content[: chance.randint(0, len(content)) if chance.random() < 0.3 else len(content)])
            with contextlib.suppress(InputDataError):
                assert all(0 <= f.can_id <= 0x1FFFFFFF for f in iter_can_log(path))


def test_reading_is_lazy(tmp_path: Path) -> None:
    path = write(tmp_path / "a.log", "(0.0) can0 0B4#00\nbroken\n")
    assert next(iter_can_log(path)).can_id == 0xB4
