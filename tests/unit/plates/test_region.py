"""Where one drives says which plates are usual."""

from __future__ import annotations

from pathlib import Path

import pytest

from tmde_edge.app import wiring
from tmde_edge.app.wiring import check_parts
from tmde_edge.config import from_tree
from tmde_edge.errors import ConfigError
from tmde_edge.plates.region import CONTINENTS, ELSEWHERE, NEIGHBOUR, expected
from tmde_edge.plates.standard import PlateStandard, load_standards, select
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.settings import RangingSettings


def _weights(*region: str) -> dict[str, float]:
    return {s.id: s.weight / load_standards()[s.id].weight for s in expected(["auto"], region)}


def test_every_country_lies_on_a_continent() -> None:
    listed = {c for countries in CONTINENTS.values() for c in countries}
    assert {s.country.split("-")[0] for s in load_standards().values()} == listed


def test_without_a_region_the_tables_weights_stand() -> None:
    assert expected(["de", "us"]) == select(["de", "us"])


def test_a_country_makes_its_neighbours_rarer_and_others_rarer_still() -> None:
    weights = _weights("de")
    assert weights["de-mittel"] == 1.0
    assert weights["pl-1"] == pytest.approx(NEIGHBOUR)
    assert weights["us-mi"] == pytest.approx(ELSEWHERE)


def test_a_continent_and_several_names() -> None:
    weights = _weights(" Europe ", "US")
    assert weights["pl-1"] == weights["us-mi"] == 1.0
    assert weights["ca"] == pytest.approx(NEIGHBOUR)  # of the US
    assert weights["jp-mid"] == pytest.approx(ELSEWHERE)
    assert weights["ru-1"] == 1.0


@pytest.mark.parametrize(("alias", "name"), [("eu", "europe"), ("UK", "gb"), ("usa", "us")])
def test_names_people_use(alias: str, name: str) -> None:
    assert _weights(alias) == _weights(name)


def test_plates_of_no_certain_country_of_europe_are_no_strangers_in_it() -> None:
    assert _weights("de")["eu-generic"] == 1.0
    assert _weights("us")["eu-generic"] == pytest.approx(ELSEWHERE)


@pytest.mark.parametrize(
    ("name", "hint"),
    [("europa", "did you mean 'europe'"), ("at", "known are au, br"), ("germany", "elsewhere name the continent"), ("", "asia")],
)
def test_an_unknown_region_is_named(name: str, hint: str) -> None:
    with pytest.raises(ConfigError, match=rf"plates\.region: unknown country or continent '{name}'; .*{hint}"):
        expected(["auto"], ["de", name])


def test_the_region_reaches_the_ranger_and_the_eyes(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[dict[str, float]] = []

    class Spy(Ranger):
        def __init__(self, settings: RangingSettings, standards: tuple[PlateStandard, ...]) -> None:
            seen.append({s.id: s.weight for s in standards})
            super().__init__(settings, standards)

    monkeypatch.setattr(wiring, "Ranger", Spy)
    config = from_tree({"plates": {"expect": ["pl-2", "fr-2"], "region": ["pl"]}}, "test")
    wiring.build_estimation(config, Path("."))
    list(wiring.measure_with(config, []))
    assert len(seen) == 2
    assert all(w["fr-2"] == pytest.approx(NEIGHBOUR * load_standards()["fr-2"].weight) for w in seen)


def test_a_configuration_with_an_unknown_region_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"plates\.region"):
        check_parts(from_tree({"plates": {"region": ["atlantis"]}}, "test"), Path("."))
