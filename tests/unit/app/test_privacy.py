"""Recorded frames: no text, the same heights."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.app.privacy import FrameKeeper, cover_all
from tmde_edge.messages import Corners, Frame, PlateSighting, Sighting

W, H = 260, 60


def plate_image(text: str, corners: Corners) -> np.ndarray:
    """A plate with text, seen under a perspective."""
    plate = np.full((H, W, 3), 230, np.uint8)
    cv2.putText(plate, text, (16, 45), cv2.FONT_HERSHEY_SIMPLEX, 1.3, (20, 20, 20), 4, cv2.LINE_AA)
    flat = np.array([[0, 0], [W - 1, 0], [W - 1, H - 1], [0, H - 1]], np.float32)
    to_image = cv2.getPerspectiveTransform(flat, np.array(corners, np.float32))
    scene = np.full((200, 400, 3), 60, np.uint8)
    return cv2.warpPerspective(plate, to_image, (400, 200), dst=scene, borderMode=cv2.BORDER_TRANSPARENT)


def sighting(t_ms: int, *plates: PlateSighting) -> Sighting:
    return Sighting(t_ns=t_ms * 1_000_000, frame_index=0, width_px=400, height_px=200, status="ok", plates=plates)


def plate(corners: Corners, track: int = 1) -> PlateSighting:
    return PlateSighting(track_id=track, corners_px=corners, corners_sigma_px=0.1, score=0.9)


LEVEL: Corners = ((60.0, 50.0), (320.0, 50.0), (320.0, 110.0), (60.0, 110.0))
TILTED: Corners = ((70.0, 40.0), (310.0, 70.0), (305.0, 128.0), (66.0, 100.0))


@pytest.mark.parametrize("corners", [LEVEL, TILTED])
def test_two_texts_of_the_same_ink_look_the_same_afterwards(corners: Corners) -> None:
    before = [plate_image(text, corners) for text in ("ABC 123", "321 BCA")]
    after = [cover_all(image, [plate(corners)]) for image in before]
    inside = np.zeros((200, 400), np.uint8)
    cv2.fillConvexPoly(inside, np.array(corners, np.int32), 1)
    told = [float(np.abs(a.astype(int) - b)[inside > 0].mean()) for a, b in (before, after)]
    assert told[0] > 20
    assert told[1] < 4  # of 255: what is left of the difference between the texts


def test_rows_keep_their_place() -> None:
    image = plate_image("ABC 123", LEVEL)
    covered = cover_all(image, [plate(LEVEL)])
    row = lambda picture: picture[45:116, 70:310].mean(axis=(1, 2))  # noqa: E731
    assert np.abs(row(image) - row(covered)).max() < 30  # of 170: a sixth of a pixel at the edges of the plate
    assert (image[:40] == covered[:40]).all()
    assert covered[60:100, 80:300].std(axis=1).max() < 1


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(-500, 900), st.floats(-500, 900)), min_size=4, max_size=4), st.booleans())
def test_any_outline_is_survived(points: list[tuple[float, float]], grey: bool) -> None:
    image = np.full((200, 400) if grey else (200, 400, 3), 90, np.uint8)
    corners: Corners = (points[0], points[1], points[2], points[3])
    out = cover_all(image, [plate(corners)], [plate(corners)])
    assert out.shape == image.shape
    assert image.min() == image.max() == 90  # the original stays


def test_a_plate_found_a_moment_later_is_covered_in_the_frames_before() -> None:
    keeper = FrameKeeper(rate_hz=30, quality=95, blur=True)
    image = plate_image("ABC 123", LEVEL)
    got: list[tuple[int, bytes]] = []
    for t_ms in range(0, 900, 33):
        plates = () if t_ms < 200 else (plate(LEVEL),)
        got += keeper.take(sighting(t_ms, *plates), Frame(t_ns=t_ms * 1_000_000, index=0, image=image))
    got += keeper.rest()
    assert [t for t, _ in got] == [t * 1_000_000 for t in range(0, 900, 33)]
    for _, jpeg in got:
        kept = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert kept[60:100, 80:300].std(axis=1).max() < 6, "a text is legible"


def test_without_blur_frames_are_kept_at_once_and_as_they_are() -> None:
    keeper = FrameKeeper(rate_hz=10, quality=95, blur=False)
    image = plate_image("ABC 123", LEVEL)
    times = range(0, 1000, 33)
    got = [len(keeper.take(sighting(t, plate(LEVEL)), Frame(t_ns=t * 1_000_000, index=0, image=image))) for t in times]
    assert sum(got) == 11  # 0, 99, 198 ... 990 ms
    assert got[0] == 1
