"""How common each standard is where one drives: `plates.region` weighs what `plates.expect` lets in."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import msgspec

from tmde_edge.errors import ConfigError
from tmde_edge.plates.standard import PlateStandard, select

CONTINENTS: dict[str, tuple[str, ...]] = {
    "asia": ("CN", "IL", "IN", "JP", "KR", "RU"),
    "europe": ("DE", "ES", "EU", "FR", "GB", "IT", "NL", "PL", "RO", "RU"),
    "north-america": ("CA", "MX", "US"),
    "oceania": ("AU",),
    "south-america": ("BR", "CO"),
}
ALIASES = {"eu": "europe", "uk": "gb", "usa": "us"}
# Plates of the same continent, and of others, against those of the region itself: cautious guesses, for strangers do come.
NEIGHBOUR, ELSEWHERE = 0.1, 0.01


def expected(expect: Sequence[str], region: Sequence[str] = ()) -> tuple[PlateStandard, ...]:
    """The standards that `plates.expect` names, each as common as `plates.region` makes it (none: as in the tables).

    region: countries ("de") and continents ("europe"). Raises ConfigError for an unknown name, naming the nearest right one.
    """
    standards = select(expect)
    if not region:
        return standards
    known = {c for countries in CONTINENTS.values() for c in countries}
    countries: set[str] = set()
    near: set[str] = set()
    for name in region:
        key = name.strip().lower()
        key = ALIASES.get(key, key)
        if key in CONTINENTS:
            countries |= set(CONTINENTS[key])
        elif key.upper() in known:
            countries |= {key.upper(), *(("EU",) if key.upper() in CONTINENTS["europe"] else ())}  # EU: of any country
            near |= {c for group in CONTINENTS.values() if key.upper() in group for c in group}
        else:
            names = sorted(c.lower() for c in known if c != "EU")
            guess = difflib.get_close_matches(key, CONTINENTS, n=1, cutoff=0.6)
            hint = f"known are {', '.join(names)}; elsewhere name the continent: {', '.join(CONTINENTS)}"
            hint = f"did you mean {guess[0]!r}?" if guess else hint
            raise ConfigError(f"plates.region: unknown country or continent {name!r}; {hint}")

    def factor(standard: PlateStandard) -> float:
        country = standard.country.split("-")[0]
        return 1.0 if country in countries else NEIGHBOUR if country in near else ELSEWHERE

    return tuple(msgspec.structs.replace(s, weight=s.weight * factor(s)) for s in standards)
