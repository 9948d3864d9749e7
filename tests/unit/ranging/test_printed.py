"""Colours, bands and groups of characters tell standards apart, once a track."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as replace_struct
from plate_scenes import AHEAD, CAMERA, sighting

from tmde_edge.messages import PlateColours, PlateSighting
from tmde_edge.plates.standard import load_standards, select
from tmde_edge.ranging.classify import classes, said_by_print
from tmde_edge.ranging.printed import group_count, log_chances
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.scale_memory import TOLD, Evidence, TrackScale, normalised
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
        "nl": PlateColours(ground="yellow", left_band=True, right_band=False),
        "ru-1": PlateColours(ground="white", left_band=False, right_band=False),
    }
    for id_, colours in kinds.items():
        said = {k: sum(log_chances(STANDARDS[k], colours, 7, None).values()) for k in kinds}
        assert max(said, key=lambda k: said[k]) == id_
    said = {k: log_chances(STANDARDS[k], None, 7, 2)["groups"] for k in ("pl-1", "fr-1", "in-car")}
    assert said["pl-1"] > said["fr-1"] > said["in-car"] - 1e-9


def test_what_cannot_be_told_is_absent() -> None:
    assert set(log_chances(STANDARDS["fr-1"], PlateColours(left_band=True), 7, None)) == {"left band"}
    assert set(log_chances(STANDARDS["fr-1"], PlateColours(ground="white"), 7, 3)) == {"ground", "groups"}
    assert log_chances(STANDARDS["fr-1"], None, 7, None) == {}


def test_chances_of_all_grounds_and_of_a_band_add_up() -> None:
    for standard in STANDARDS.values():
        seen = [log_chances(standard, PlateColours(left_band=band), 7, None)["left band"] for band in (True, False)]
        assert np.exp(seen).sum() == pytest.approx(1.0)
        looks = [PlateColours(ground=g) for g in ("white", "yellow", "green", "blue")]  # type: ignore[arg-type]
        chances = [np.exp(log_chances(standard, look, 7, None)["ground"]) for look in looks]
        assert max(chances) <= 1.0
        assert sum(chances) < 1.2 + 1e-9  # an odd ground may be any of them


def test_other_grounds_of_a_standard_are_possible() -> None:
    gb, grounds = STANDARDS["gb-2001"], ("white", "yellow", "blue")
    white, yellow, blue = (log_chances(gb, PlateColours(ground=g), 7, None)["ground"] for g in grounds)  # type: ignore[arg-type]
    assert yellow > white > blue
    assert log_chances(STANDARDS["br-pnu"], PlateColours(ground="white"), 7, None)["ground"] > -0.1  # grey looks white


def test_a_band_that_only_some_plates_have_says_little() -> None:
    gb = [log_chances(STANDARDS["gb-2001"], PlateColours(left_band=band), 7, None)["left band"] for band in (True, False)]
    assert min(gb) > -1.5


def test_characters_that_were_missed_make_groups_say_less() -> None:
    said = [log_chances(STANDARDS["fr-1"], None, count, 1)["groups"] for count in (7, 5)]
    assert said[1] > said[0]


def test_a_class_of_several_standards_says_what_its_members_say_on_average() -> None:
    rare = replace_struct(STANDARDS["us-aamva3"], id="rare", weight=0.01, other_backgrounds={"yellow": 0.9})
    found = classes([STANDARDS["us-aamva3"], rare], RangingSettings())
    assert len(found) == 1
    plate = replace(sighting(STANDARDS["us-aamva3"]), colours=PlateColours(ground="yellow"))
    alone = log_chances(STANDARDS["us-aamva3"], plate.colours, 7, None)["ground"]
    assert said_by_print(found, plate)["ground"]["us-aamva3"] == pytest.approx(alone, abs=0.12)


def test_plates_of_other_colours_are_another_class() -> None:
    yellow = replace_struct(STANDARDS["it-rear"], id="yellow", background="yellow")
    assert len(classes([STANDARDS["it-rear"], yellow], RangingSettings())) == 2


def test_the_ground_moves_the_belief_and_the_distance_with_it() -> None:
    plate = sighting(STANDARDS["pl-1"], distance_m=9.0, corner_sigma=0.3, glyph_sigma=0.15)
    plain, white, yellow = (
        _belief(replace(plate, colours=c), "gb-2001", "pl-1", "de-mittel")
        for c in (None, PlateColours(ground="white"), PlateColours(ground="yellow"))
    )
    assert white < plain < yellow


def _approach(colours: Iterable[PlateColours | None], id_: str, *ids: str) -> TrackScale:
    ranger, state = Ranger(RangingSettings(), select([id_, *ids])), None
    rng = np.random.default_rng(4)
    looks = list(colours)
    for frame, distance_m in enumerate(np.geomspace(14.0, 5.0, len(looks)).tolist()):
        plate = sighting(STANDARDS[id_], distance_m=distance_m, rng=rng, corner_sigma=0.3, glyph_sigma=0.15)
        _, state, _ = ranger.measure(replace(plate, colours=looks[frame]), CAMERA, AHEAD, frame * 50_000_000, state)
    assert state is not None
    return state


def test_looks_add_up_and_print_counts_once() -> None:
    looks = {1: {"a": (0.0, 3), "b": (-0.5, 3)}, 2: {"a": (0.0, 9), "b": (-0.25, 9)}, 5: {"b": (0.5, 1)}}
    printed = {"ground": {"a": (-1.0, TOLD), "b": (-0.5, 1)}, "groups": {"b": (0.25, 99)}}
    evidence = Evidence({"a": -0.7, "b": -0.7}, looks, printed)
    assert evidence.log_belief() == pytest.approx(normalised({"a": -0.7 - 1.0, "b": -0.7 - 0.25 - 0.5 / TOLD + 0.25}))


@pytest.mark.parametrize("max_fits", [1, 3])
def test_print_weighs_as_much_for_classes_that_were_not_fitted(max_fits: int) -> None:
    ids = ("pl-1", "gb-2001", "in-car")
    ranger = Ranger(RangingSettings(max_fits=max_fits), select(ids))
    plate = sighting(STANDARDS["pl-1"], distance_m=14.0, corner_sigma=1.0)
    colours = PlateColours(ground="white", left_band=True, right_band=False)
    plain, seen = (
        ranger.measure(replace(plate, colours=c), CAMERA, AHEAD, 0)[1].evidence.log_belief() for c in (None, colours)
    )  # fmt: skip
    said = {k: sum(v for kind, v in log_chances(STANDARDS[k], colours, 7, None).items()) for k in ids}
    for k in ids[1:]:
        assert (seen[k] - seen["pl-1"]) - (plain[k] - plain["pl-1"]) == pytest.approx(said[k] - said["pl-1"], abs=1e-6)


def test_a_track_counts_print_once() -> None:
    """The ground is not Korea's, all sizes are: eight looks of other sizes, one of the print."""
    yellow = PlateColours(ground="yellow")
    evidence = _approach([yellow if i % 3 == 0 else None for i in range(40)], "kr-film", "gb-2001").evidence
    assert len(evidence.looks) >= 6
    assert set(evidence.printed) == {"ground", "groups"}
    mean, frames = evidence.printed["ground"]["kr-film"]
    assert frames == TOLD + 13  # what no frame tells is not counted again
    assert mean == pytest.approx(log_chances(STANDARDS["kr-film"], yellow, 8, None)["ground"])
    total = {
        k: evidence.prior[k] + sum(look[k][0] for look in evidence.looks.values() if k in look)
        + sum(kind[k][0] for kind in evidence.printed.values()) for k in ("kr-film", "gb-2001")
    }  # fmt: skip
    assert evidence.log_belief() == pytest.approx(normalised(total))


def test_one_odd_look_does_not_outweigh_the_others() -> None:
    """Two clear looks, one by a street lamp, then hurried frames only."""
    good, odd = PlateColours(ground="white", left_band=True), PlateColours(ground="yellow")
    evidence = _approach([good, good, odd, *[None] * 30], "de-mittel", "gb-2001").evidence
    mean = evidence.printed["ground"]["de-mittel"][0]
    assert mean > 0.5 * log_chances(STANDARDS["de-mittel"], odd, 8, None)["ground"]


def test_the_dark_erases_no_ground() -> None:
    states = [_approach([PlateColours(ground="yellow"), *[rest] * 30], "gb-2001", "pl-1") for rest in (None, PlateColours())]
    assert states[0].evidence.printed["ground"] == states[1].evidence.printed["ground"]


def test_colours_that_are_seen_late_move_the_belief_step_by_step() -> None:
    ranger, state, beliefs = Ranger(RangingSettings(), select(["gb-2001", "pl-1"])), None, []
    plate = sighting(STANDARDS["pl-1"], distance_m=14.0, corner_sigma=1.0, glyph_sigma=0.5)
    for frame in range(12):
        looked = replace(plate, colours=PlateColours(ground="yellow") if frame >= 4 else None)
        _, state, _ = ranger.measure(looked, CAMERA, AHEAD, frame * 50_000_000, state)
        beliefs.append(state.evidence.log_belief()["gb-2001"] - state.evidence.log_belief()["pl-1"])
    gain = log_chances(STANDARDS["gb-2001"], looked.colours, 7, None)["ground"]
    gain -= log_chances(STANDARDS["pl-1"], looked.colours, 7, None)["ground"]
    steps = np.diff(beliefs)
    assert steps[3:].max() < 0.3 * gain
    assert beliefs[-1] - beliefs[3] == pytest.approx(gain, rel=0.1)


def test_a_new_plate_on_an_old_track_brings_its_own_print() -> None:
    """Characters of 76 mm, then of 62: a swap that only the sizes show."""
    ranger, state, rng = Ranger(RangingSettings(), select(["us-aamva3", "jp-mid"])), None, np.random.default_rng(0)
    near = [*np.linspace(5, 3, 25).tolist(), *[4.0] * 8]
    for frame, distance_m in enumerate(near):
        plate = sighting(
            STANDARDS["us-aamva3"], distance_m=distance_m, rng=rng, corner_sigma=0.3, glyph_sigma=0.15,
            glyph_mm=76.0 if frame < 25 else 62.0,
        )  # fmt: skip
        plate = replace(plate, colours=PlateColours(ground="yellow") if frame < 25 else None)
        _, state, _ = ranger.measure(plate, CAMERA, AHEAD, frame * 50_000_000, state)
    assert state is not None
    assert state.frames < 9
    assert state.colours is None
    assert "ground" not in state.evidence.printed


def test_a_band_that_cannot_be_told_costs_the_width_nothing() -> None:
    ranger, plate = Ranger(RangingSettings(), select(["fr-1"])), sighting(STANDARDS["fr-1"], distance_m=8.0, corner_sigma=0.3)
    looks = (PlateColours(ground="white", left_band=True, right_band=right) for right in (None, True))
    unsure, both = (ranger.measure(replace(plate, colours=look), CAMERA, AHEAD, 0)[0] for look in looks)
    assert unsure == both


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
    second, state, _ = ranger.measure(plate, CAMERA, AHEAD, 33_000_000, state)
    assert state.colours == looked.colours  # for the next one, too
    assert first is not None
    assert second is not None
    assert second.distance_m == pytest.approx(first.distance_m, rel=1e-2)
