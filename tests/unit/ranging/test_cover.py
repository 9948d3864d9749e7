"""A covered plate is told by its characters, all unsure at once; a change that lasts is a change of light."""

from __future__ import annotations

from tmde_edge.messages import GlyphSighting, PlateSighting
from tmde_edge.ranging.cover import CoverCheck

BOX = ((0.0, 0.0), (52.0, 0.0), (52.0, 11.0), (0.0, 11.0))


def plate(score: float | None, track: int = 1) -> PlateSighting:
    glyph = GlyphSighting(left_px=(0, 5), right_px=(5, 5), top_px=(2, 1), bottom_px=(2, 9), sigma_tb_px=0.2, sigma_lr_px=0.2,
                          score=score or 0.0)  # fmt: skip
    glyphs = () if score is None else (glyph,) * 7
    return PlateSighting(track_id=track, corners_px=BOX, corners_sigma_px=0.3, score=0.9, glyphs=glyphs)


def verdicts(check: CoverCheck, scores: list[float | None], start_s: float = 0.0, track: int = 1) -> list[bool]:
    return [check.covered(plate(v, track), round((start_s + k / 30) * 1e9)) for k, v in enumerate(scores)]


def test_cover_is_noticed_at_once_and_ends_with_it() -> None:
    check = CoverCheck()
    assert not any(verdicts(check, [0.8] * 60))
    assert all(verdicts(check, [0.35, None, 0.4, None] * 12, 2.0))  # also where the reader finds nothing at all
    assert not any(verdicts(check, [0.8, None, 0.8], 4.0))


def test_one_bad_reading_does_not_cover_a_plate_for_good() -> None:
    """An outline without characters (glare, a reader that finds none) is measured again after a while."""
    check = CoverCheck()
    verdicts(check, [0.85] * 60)
    told = verdicts(check, [0.4] + [None] * 60, 2.0)
    assert all(told[:30])
    assert not any(told[32:])
    assert all(verdicts(check, [0.4, None, None], 4.1))  # still nothing to read: still covered


def test_a_plate_that_was_never_read_with_ease_is_never_covered() -> None:
    assert not any(verdicts(CoverCheck(), [0.5] * 60 + [0.3] * 60 + [None] * 3))


def test_some_blur_is_no_cover() -> None:
    assert not any(verdicts(CoverCheck(), [0.85] * 60 + [0.55] * 10 + [0.85] * 10))


def test_night_falls() -> None:
    """Unsure for good: measured again after a few seconds."""
    told = verdicts(CoverCheck(), [0.85] * 60 + [0.4] * 200)
    assert told[61]
    assert not told[-1]


def test_tracks_are_their_own_and_forgotten() -> None:
    check = CoverCheck()
    verdicts(check, [0.85] * 30)
    assert not any(verdicts(check, [0.35] * 5, 1.0, track=2))
    check.keep({2})
    assert not any(verdicts(check, [0.35] * 5, 1.2))
