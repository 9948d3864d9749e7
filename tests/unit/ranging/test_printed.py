"""Colours, bands and groups of characters tell standards apart, once a track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plate_scenes import AHEAD, CAMERA, sighting

from tmde_edge.messages import PlateColours, PlateSighting
from tmde_edge.plates.standard import load_standards, select
from tmde_edge.ranging.printed import group_count, print_log_likelihoods
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.settings import RangingSettings

STANDARDS = load_standards()


def _belief(plate: PlateSighting, id_: str, *ids: str) -> float:
    _, after, _ = Ranger(RangingSettings(), select([id_, *ids])).measure(plate, CAMERA, AHEAD, 0)
    return float(sum(np.exp(v) for k, v in after.evidence.log_belief().items() if k.split(" ")[0] == id_))


@pytest.mark.parametrize(
    ("id_", "groups"), [("de-mittel", 3), ("fr-1", 3), ("pl-1", 2), ("ru-1", 2), ("br-mercosul", 1), ("jp-mid", 3), ("in-car", 4)]
)
def test_groups_are_counted(id_: str, groups: int) -> None:
    assert group_count(sighting(STANDARDS[id_], distance_m=8.0, yaw=0.2)) == groups


def test_small_or_few_characters_form_no_groups() -> None:
    plate = sighting(STANDARDS["de-mittel"], distance_m=8.0)
    assert group_count(replace(plate, glyphs=plate.glyphs[:3])) is None
    assert group_count(sighting(STANDARDS["de-mittel"], distance_m=30.0)) is None


def test_every_kind_of_print_speaks_for_its_standard() -> None:
    kinds = {
        "de-mittel": PlateColours(ground="white", left_band=True, right_band=False),
        "fr-1": PlateColours(ground="white", left_band=True, right_band=True),
        "gb-2001": PlateColours(ground="yellow", left_band=False, right_band=False),
        "ru-1": PlateColours(ground="white", left_band=False, right_band=False),
    }
    for id_, colours in kinds.items():
        said = {k: print_log_likelihoods(STANDARDS[k], colours, 7, None)["colours"] for k in kinds}
        assert max(said, key=lambda k: said[k]) == id_
    said = {k: print_log_likelihoods(STANDARDS[k], None, 7, 2) for k in ("pl-1", "fr-1", "in-car")}
    assert all("colours" not in v for v in said.values())
    assert said["pl-1"]["groups"] > said["fr-1"]["groups"] > said["in-car"]["groups"] - 1e-9


def test_other_grounds_of_a_standard_are_possible() -> None:
    gb, grounds = STANDARDS["gb-2001"], ("white", "yellow", "blue")
    white, yellow, blue = (print_log_likelihoods(gb, PlateColours(ground=g), 7, None)["colours"] for g in grounds)  # type: ignore[arg-type]
    assert yellow > white > blue


def test_characters_that_were_missed_make_groups_say_less() -> None:
    said = [print_log_likelihoods(STANDARDS["fr-1"], None, count, 1)["groups"] for count in (7, 5)]
    assert said[1] > said[0]


def test_the_ground_moves_the_belief_and_the_distance_with_it() -> None:
    plate = sighting(STANDARDS["pl-1"], distance_m=9.0, corner_sigma=0.3, glyph_sigma=0.15)
    plain, white, yellow = (
        _belief(replace(plate, colours=c), "gb-2001", "pl-1", "de-mittel")
        for c in (None, PlateColours(ground="white"), PlateColours(ground="yellow"))
    )
    assert white < plain < yellow


def test_a_track_counts_print_once() -> None:
    ranger, state, beliefs = Ranger(RangingSettings(), select(["gb-2001", "kr-film"])), None, []
    rng = np.random.default_rng(4)
    for frame, distance_m in enumerate(np.geomspace(14.0, 5.0, 40).tolist()):  # eight looks of another size each
        # the ground is not Korea's, all sizes are
        plate = sighting(STANDARDS["kr-film"], distance_m=distance_m, rng=rng, corner_sigma=0.3, glyph_sigma=0.15)
        plate = replace(plate, colours=PlateColours(ground="yellow") if frame % 3 == 0 else None)
        _, state, _ = ranger.measure(plate, CAMERA, AHEAD, frame * 50_000_000, state)
        beliefs.append(state.evidence.log_belief()["kr-film"])
    assert len(state.evidence.looks) >= 6
    assert set(state.evidence.printed) == {"colours", "groups"}
    mean, frames = state.evidence.printed["colours"]["kr-film"]
    assert frames == 40  # those without colours repeat the last ones
    assert mean == pytest.approx(print_log_likelihoods(STANDARDS["kr-film"], PlateColours(ground="yellow"), 8, None)["colours"])
    assert beliefs[-1] > np.log(0.9)


def test_a_second_band_that_was_left_out_costs_the_width_its_say() -> None:
    """A French plate on a blue body: the right band was taken for the body, the outline is 8 % too narrow."""
    ranger = Ranger(RangingSettings(), select(["fr-1"]))
    plate = sighting(STANDARDS["fr-1"], distance_m=8.0, corner_sigma=0.3, glyph_sigma=0.15, width_mm=480.0)
    looks = (PlateColours(ground="white", left_band=True, right_band=right) for right in (True, False))
    both, one = (ranger.measure(replace(plate, colours=look), CAMERA, AHEAD, 0)[0] for look in looks)
    assert both is not None
    assert one is not None
    assert abs(one.distance_m - 8.0) < 0.5 * abs(both.distance_m - 8.0)
    assert abs(one.distance_m - 8.0) < 2 * one.sigma_m


def test_colours_of_an_earlier_frame_count_where_a_hurried_one_has_none() -> None:
    ranger = Ranger(RangingSettings(), select(["fr-1"]))
    plate = sighting(STANDARDS["fr-1"], distance_m=8.0, corner_sigma=0.3, glyph_sigma=0.15, width_mm=480.0)
    looked = replace(plate, colours=PlateColours(ground="white", left_band=True, right_band=False))
    first, state, _ = ranger.measure(looked, CAMERA, AHEAD, 0)
    second, _, _ = ranger.measure(plate, CAMERA, AHEAD, 33_000_000, state)
    assert first is not None
    assert second is not None
    assert second.distance_m == pytest.approx(first.distance_m, rel=1e-2)
