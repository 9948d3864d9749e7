"""The annotated video: playable, of even size, with the frames' own times."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from tmde_edge.adapters.cameras.sources import open_source
from tmde_edge.adapters.video_out import VideoWriter
from tmde_edge.errors import UsageError
from tmde_edge.messages import Frame


@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
def test_what_was_written_is_read_again_at_its_time(tmp_path: Path, size: tuple[int, int]) -> None:
    width, height = size
    times_ms = [0, 33, 67, 200, 233]
    ramp = np.linspace(30, 220, width).astype(np.uint8)
    with VideoWriter(tmp_path / "v.mp4", 30.0) as writer:
        for i, t_ms in enumerate(times_ms):
            image = np.dstack([np.tile(ramp, (height, 1)), np.full((height, width), 40 * i), np.full((height, width), 100)])
            writer.write(image.astype(np.uint8), t_ms * 1_000_000)
    frames = [f for f in open_source(str(tmp_path / "v.mp4")) if isinstance(f, Frame)]
    assert [round(f.t_ns / 1e6) for f in frames] == times_ms
    assert frames[0].image.shape == (48, 64, 3)
    for i, frame in enumerate(frames):
        got = frame.image[:height, :width].astype(int)
        assert np.abs(got[..., 0] - ramp).mean() < 6
        assert abs(got[..., 1].mean() - 40 * i) < 4
    with av.open(str(tmp_path / "v.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    data = (tmp_path / "v.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # a browser starts before all is loaded
    assert cv2.VideoCapture(str(tmp_path / "v.mp4")).read()[0]


def test_grey_and_other_sizes_fit_the_first_picture(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "v.mp4") as writer:
        writer.write(np.full((48, 64), 50, np.uint8), 0)
        writer.write(np.full((96, 128, 3), 150, np.uint8), 33_000_000)
        writer.write(np.full((48, 64, 3), 200, np.uint8), 33_000_000)  # the same time again: still a frame of its own
    levels = [round(f.image.mean() / 10) * 10 for f in open_source(str(tmp_path / "v.mp4")) if isinstance(f, Frame)]
    assert levels == [50, 150, 200]


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be written"):
        VideoWriter(tmp_path / "absent" / "v.mp4")


def test_no_picture_leaves_no_file(tmp_path: Path) -> None:
    VideoWriter(tmp_path / "v.mp4").close()
    assert list(tmp_path.iterdir()) == []
