"""Recorded sources: order, times, damage in its place, and the right error for nothing at all."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from tmde_edge.adapters.cameras.sources import SourceError, open_source, read_image
from tmde_edge.errors import InputDataError, InputMissingError, UsageError
from tmde_edge.messages import Frame

GREY_LEVELS = [20, 60, 100, 140, 180, 220]


def write_images(folder: Path, names: list[str]) -> None:
    for level, name in zip(GREY_LEVELS, names, strict=False):
        assert cv2.imwrite(str(folder / name), np.full((24, 32, 3), level, np.uint8))


def write_video(path: Path, stamps_ms: list[int], *, faststart: bool = True, size: tuple[int, int] = (64, 48)) -> None:
    """H.264 with the given presentation stamps; the picture of frame i is flat grey 20 + 8 i with one noisy corner."""
    noise = np.random.default_rng(1).integers(0, 255, (size[1] // 2, size[0] // 2, 3), np.uint8)
    with av.open(str(path), "w", options={"movflags": "+faststart"} if faststart else {}) as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.options = {"bf": "0", "g": "10", "crf": "20"}
        for index, stamp in enumerate(stamps_ms):
            image = np.full((size[1], size[0], 3), 20 + 8 * index, np.uint8)
            image[: noise.shape[0], : noise.shape[1]] = np.roll(noise, index, axis=1)
            frame = av.VideoFrame.from_ndarray(cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420), format="yuv420p")
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def levels(source: object) -> list[int]:
    return [round(float(item.image[-4:, -4:].mean())) for item in source if isinstance(item, Frame)]  # type: ignore[attr-defined]


def test_a_folder_is_read_in_name_order_and_other_files_are_skipped(tmp_path: Path) -> None:
    write_images(tmp_path, ["b.png", "a.JPG", "c.bmp"])
    (tmp_path / "labels.csv").write_text("image\n")
    (tmp_path / "._a.jpg").write_bytes(b"resource fork")
    source = open_source(str(tmp_path), fps=10)
    assert source.frame_count == 3
    assert levels(source) == [60, 20, 100]
    assert [(f.index, f.t_ns) for f in source] == [(0, 0), (1, 100_000_000), (2, 200_000_000)]


@pytest.mark.parametrize("beside", [False, True])
def test_frames_csv_says_when_each_image_was_taken(tmp_path: Path, beside: bool) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    write_images(folder, ["a.png", "b.png", "c.png"])
    table = (folder.parent if beside else folder) / "frames.csv"
    table.write_text("file,t_s\na.png,170.1\nb.png,170.22\nc.png,170.5\n")
    for spec in (str(folder), f"{folder}/*.png"):
        assert [f.t_ns for f in open_source(spec, fps=10)] == [0, 120_000_000, 400_000_000]
    (folder / "a.png").unlink()  # the others keep their place on the CAN log's time
    assert [f.t_ns for f in open_source(str(folder))] == [120_000_000, 400_000_000]
    table.write_text("number,exposure\n1,2\n")  # someone else's table
    assert [f.t_ns for f in open_source(str(folder), fps=10)] == [0, 100_000_000]


@pytest.mark.parametrize("lines", ["b.png,1\n", "a.png,1\nb.png,1\n", "a.png,1\nb.png,nan\n", "a.png,1\nb.png\n"])
def test_a_frames_csv_that_gives_no_times_is_an_error(tmp_path: Path, lines: str) -> None:
    write_images(tmp_path, ["a.png", "b.png"])
    (tmp_path / "frames.csv").write_text("file,t_s\n" + lines)
    with pytest.raises(InputDataError, match=r"frames\.csv: .*(correct|remove)"):
        open_source(str(tmp_path))


def test_an_unreadable_image_is_an_error_in_its_place(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png", "c.png"])
    (tmp_path / "b.png").write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    items = list(open_source(str(tmp_path), fps=10))
    assert [type(item) for item in items] == [Frame, SourceError, Frame]
    assert isinstance(items[1], SourceError)
    assert (items[1].index, items[1].t_ns) == (1, 100_000_000)
    assert "b.png" in items[1].message
    assert isinstance(items[2], Frame)
    assert items[2].t_ns == 200_000_000


def test_none_readable_is_told_after_the_error_of_each(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no")
    (tmp_path / "b.jpg").write_bytes(b"")
    items = iter(open_source(str(tmp_path)))
    assert [type(next(items)) for _ in range(2)] == [SourceError, SourceError]
    with pytest.raises(InputDataError, match="none of its 2 images"):
        next(items)


def test_grey_images_stay_grey_and_alpha_is_dropped(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((10, 12), 7, np.uint8))
    cv2.imwrite(str(tmp_path / "b.png"), np.full((10, 12, 4), 7, np.uint8))
    cv2.imwrite(str(tmp_path / "c.png"), np.full((10, 12), 7 * 256, np.uint16))
    shapes = [item.image.shape for item in open_source(str(tmp_path)) if isinstance(item, Frame)]
    assert shapes == [(10, 12), (10, 12, 3), (10, 12)]
    deep = read_image(tmp_path / "c.png")
    assert not isinstance(deep, str)
    assert int(deep[0, 0]) == 7


@pytest.mark.parametrize("spec", ["img_%02d.png", "img_%d.png", "img_*.png", "img_[0-9]*.png"])
def test_patterns(tmp_path: Path, spec: str) -> None:
    write_images(tmp_path, ["img_08.png", "img_09.png", "img_10.png"])
    write_images(tmp_path, ["other.png"])
    assert levels(open_source(str(tmp_path / spec))) == [20, 60, 100]


def test_a_printf_pattern_orders_by_number_not_by_name(tmp_path: Path) -> None:
    write_images(tmp_path, ["i9.png", "i10.png"])
    assert levels(open_source(str(tmp_path / "i%d.png"))) == [20, 60]
    assert levels(open_source(str(tmp_path))) == [60, 20]


def test_a_single_image_is_a_recording_of_one_frame(tmp_path: Path) -> None:
    write_images(tmp_path, ["one%d[1].png"])  # a name that exists wins over a pattern
    assert levels(open_source(str(tmp_path / "one%d[1].png"))) == [20]


@pytest.mark.parametrize("spec", ["absent.mp4", "absent_%d.png", "absent*.png", "absent/%d.png", "http://127.0.0.1/x.mp4"])
def test_what_does_not_exist_is_missing(tmp_path: Path, spec: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputMissingError):
        open_source(spec)


def test_a_folder_without_images_is_missing_input(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(InputMissingError, match="no images in"):
        open_source(str(tmp_path))


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_wrong_usage(tmp_path: Path, fps: float) -> None:
    with pytest.raises(UsageError, match="--fps"):
        open_source(str(tmp_path), fps)


def test_video_with_a_variable_frame_rate_keeps_its_times_from_zero(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", [500, 533, 700, 1200])
    source = open_source(str(tmp_path / "v.mp4"), fps=5)
    assert source.frame_count == 4
    frames = [item for item in source if isinstance(item, Frame)]
    assert [f.t_ns // 1_000_000 for f in frames] == [0, 33, 200, 700]
    assert [f.index for f in frames] == [0, 1, 2, 3]
    assert frames[0].image.shape == (48, 64, 3)
    assert np.allclose(levels(source), [20, 28, 36, 44], atol=3)  # and it can be read twice


def test_a_stream_without_time_stamps_is_timed_by_its_rate(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "v.h264"), "w", format="h264") as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.options = {"bf": "0"}
        for level in GREY_LEVELS:
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="bgr24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    times_ms = [item.t_ns / 1e6 for item in open_source(str(tmp_path / "v.h264"))]
    assert times_ms == pytest.approx([0, 50, 100, 150, 200, 250])


def test_stamps_that_start_again_go_on_after_the_last(tmp_path: Path) -> None:
    for name in ("a.ts", "b.ts"):
        write_video(tmp_path / name, [0, 33, 66, 99], faststart=False)
    (tmp_path / "joined.ts").write_bytes((tmp_path / "a.ts").read_bytes() + (tmp_path / "b.ts").read_bytes())
    times = [item.t_ns for item in open_source(str(tmp_path / "joined.ts")) if isinstance(item, Frame)]
    assert len(times) == 8
    steps_ms = np.diff(times) / 1e6
    assert steps_ms.min() > 30
    assert steps_ms.max() < 45


def test_a_truncated_video_gives_what_it_has_and_says_what_is_missing(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", list(range(0, 660, 33)))
    data = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: int(len(data) * 0.6)])
    items = list(open_source(str(tmp_path / "cut.mp4")))
    frames = [item for item in items if isinstance(item, Frame)]
    assert 3 <= len(frames) < 20
    assert isinstance(items[-1], SourceError)
    assert "of 20 frames" in items[-1].message
    assert [item.index for item in items] == list(range(len(items)))


def test_damage_inside_a_video_is_reported_and_not_shown_as_a_picture(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", list(range(0, 660, 33)))
    data = bytearray((tmp_path / "v.mp4").read_bytes())
    with av.open(str(tmp_path / "v.mp4")) as container:
        third = [packet.pos for packet in container.demux(video=0)][3]
    data[third : third + 100] = np.random.default_rng(3).bytes(100)
    (tmp_path / "bad.mp4").write_bytes(data)
    items = list(open_source(str(tmp_path / "bad.mp4")))
    assert len(items) == 20
    assert [item.index for item in items if isinstance(item, SourceError)] == list(range(3, 10))
    assert "damaged" in str(items[3])
    for item in items:
        if isinstance(item, Frame):
            assert item.image[-4:, -4:].mean() == pytest.approx(20 + 8 * item.index, abs=4)
    assert [item.t_ns for item in items] == pytest.approx([33e6 * i for i in range(20)], abs=1e6)


@pytest.mark.parametrize("content", [b"", b"not a video at all" * 50, b"\x00\x00\x00\x18ftypmp42" + b"\x00" * 300])
def test_what_is_no_video_cannot_be_read(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "v.mp4").write_bytes(content)
    with pytest.raises(InputDataError, match=r"v\.mp4"):
        list(open_source(str(tmp_path / "v.mp4")))


def test_a_playlist_opens_no_network_connection(tmp_path: Path) -> None:
    (tmp_path / "v.m3u8").write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n#EXT-X-ENDLIST\n")
    with pytest.raises(InputDataError):
        list(open_source(str(tmp_path / "v.m3u8")))


def test_a_turned_video_is_upright_as_opencv_shows_it(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", [0, 33, 66])
    data = bytearray((tmp_path / "v.mp4").read_bytes())
    matrix = data.index(b"tkhd") + 4 + 4 + 20 + 16  # version 0: after the times, layer and volume
    data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 48 << 16, 0, 1 << 30)
    (tmp_path / "turned.mp4").write_bytes(data)
    capture = cv2.VideoCapture(str(tmp_path / "turned.mp4"))
    ok, expected = capture.read()
    assert ok
    first = next(iter(open_source(str(tmp_path / "turned.mp4"))))
    assert isinstance(first, Frame)
    assert first.image.shape == expected.shape == (64, 48, 3)
    assert np.abs(first.image.astype(int) - expected).mean() < 3
