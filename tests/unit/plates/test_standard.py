import csv
import os
from pathlib import Path

import numpy as np
import pytest

from tmde_edge.errors import ConfigError
from tmde_edge.plates.standard import PlateStandard, Size, bolt_places, line_share, load_standards, parse_standards, select, sizes

SHARED = Path(os.environ.get("TMDE_SHARED", "../shared"))
GOOD = """
[[standard]]
id = "xx-1"
country = "XX"
name = "test"
rows = ["aa bb"]
char_counts = [4]
plate_width = { mm = 500, verified = true }
plate_height = { mm = 100 }
source = "none"
[standard.glyphs.a]
height = { mm = 70 }
[standard.glyphs.b]
main = false
height = { mm = 50 }
"""


def test_every_shipped_standard_is_whole() -> None:
    standards = load_standards()
    assert len(standards) >= 50
    wanted = ["US", "CA", "DE", "GB", "FR", "ES", "IT", "NL", "PL", "RO", "RU", "CN", "JP", "KR", "IN", "BR", "AU", "EU"]
    assert set(wanted) <= {s.country.split("-")[0] for s in standards.values()}
    for s in standards.values():
        assert s.source, s.id
        for path, size in sizes(s):
            mean, sigma = size.belief("glyph_height")
            assert 0 < sigma < mean, (s.id, path)


@pytest.mark.parametrize(
    ("id_", "width", "height", "glyph", "glyph_sigma"),
    [
        ("de-mittel", 520, 110, 75, 0.707),
        ("us-aamva3", 304.8, 152.4, 69.85, 3.67),
        ("ru-1", 520, 112, 76, 0.61),
        ("fr-1", 520, 110, 75, 2.04),
        ("gb-2001", 520, 111, 79, 0.63),
        ("pl-1", 520, 114, 80, 0.64),
        ("pl-2", 305, 214, 80, 2.4),
    ],
)
def test_known_sizes(id_: str, width: float, height: float, glyph: float, glyph_sigma: float) -> None:
    s = load_standards()[id_]
    outline, main = s.outline_belief(), s.main_class.height
    assert outline is not None
    assert main is not None
    assert (outline[0][0], outline[1][0]) == (width, height)
    assert main.belief("glyph_height") == pytest.approx((glyph, glyph_sigma), abs=0.01)


def test_russian_plates_have_two_heights() -> None:
    ru = load_standards()["ru-1"]
    heights = [g.height.mm for g in ru.glyphs.values() if g.height is not None]
    assert ru.main_class.height is not None
    assert ru.main_class.height.mm == 76
    assert 58 in heights
    assert ru.class_counts()["d"] == 3


def test_a_tolerance_is_the_rms_of_a_triangle_about_the_nominal() -> None:
    rng = np.random.default_rng(0)
    size = Size(mm=75, min=74, max=77)
    drawn = rng.triangular(74, 75, 77, 400_000)
    mean, sigma = size.belief("glyph_height")
    assert mean == 75
    assert sigma == pytest.approx(float(np.sqrt(np.mean((drawn - 75) ** 2))), rel=0.01)


def test_limits_without_a_nominal_are_uniform_and_a_bare_number_is_as_good_as_its_source() -> None:
    mean, sigma = Size(min=60, max=72).belief("glyph_height")
    assert (mean, sigma) == pytest.approx((66, 12 / 12**0.5))
    assert Size(mm=75, verified=True).belief("glyph_height")[1] < Size(mm=75).belief("glyph_height")[1]


def test_a_floating_width_is_no_anchor() -> None:
    outline = load_standards()["de-mittel"].outline_belief()
    assert outline is not None
    (width, width_sigma), (height, height_sigma) = outline
    assert width_sigma / width > 5 * height_sigma / height


def test_select_by_id_group_country_and_auto() -> None:
    assert [s.id for s in select(["ru-1"])] == ["ru-1"]
    assert [s.id for s in select(["de-1line"])] == ["de-mittel", "de-eng"]
    assert {s.country for s in select(["us"])} == {"US", "US-MI"}
    assert {s.id for s in select(["US-MI"])} == {"us-mi"}
    assert len(select(["auto"])) == len(load_standards())
    both = [s.id for s in select(["us-mi", "us"])]
    assert both[0] == "us-mi"
    assert len(both) == len(set(both))


def test_unknown_names_point_to_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"unknown plate standard 'us-mx'; did you mean 'us-mi'\?"):
        select(["us-mx"])
    with pytest.raises(ConfigError, match="plates list"):
        select(["§§§§§§§"])
    with pytest.raises(ConfigError, match="empty"):
        select([])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("mm = 70", "mm = 70, max = 60"), "not min <= mm <= max"),
        (('rows = ["aa bb"]', 'rows = ["ac bb"]'), "unknown glyph classes"),
        (("char_counts = [4]", "char_counts = [7]"), "rows hold 4"),
        (("plate_height = { mm = 100 }", ""), "both plate_width"),
        (("main = false", "main = true"), "exactly one main"),
        (('name = "test"', 'nane = "test"'), "nane|name"),
        (("mm = 500", 'mm = "x"'), "plate_width"),
        (('name = "test"', 'name = "test"\nother_backgrounds = { mauve = 0.1 }'), "background 'mauve' is none of white"),
        (('name = "test"', 'name = "test"\nother_backgrounds = { blue = 0.6, green = 0.4 }'), "leave some for the usual ground"),
    ],
)
def test_faults_in_a_standard_name_the_place(change: tuple[str, str], message: str) -> None:
    assert isinstance(parse_standards(GOOD, "xx.toml")[0], PlateStandard)
    with pytest.raises(ConfigError, match=message) as error:
        parse_standards(GOOD.replace(*change), "xx.toml")
    assert "xx.toml" in str(error.value)


@pytest.mark.real
def test_numbers_are_those_of_the_research_table() -> None:
    table = SHARED / "research" / "plate_standards.csv"
    if not table.exists():
        pytest.skip(f"{table} is not here")
    standards = load_standards()
    with table.open(newline="") as f:
        rows = list(csv.DictReader(f))
    assert {r["id"] for r in rows} <= set(standards)
    for r in rows:
        s = standards[r["id"]]
        for column, size in (
            ("plate_h_mm", s.plate_height),
            ("char_h_mm", s.main_class.height),
            ("stroke_mm", s.main_class.stroke),
        ):
            if r[column]:
                assert size is not None, (r["id"], column)
                assert size.mm == float(r[column]), (r["id"], column)


def test_the_chance_of_a_border_line_is_what_the_expected_standards_have() -> None:
    assert line_share(select(["de-mittel"])) == line_share(select(["ru"])) == 0.95
    assert line_share(select(["gb"])) == 0.05
    assert line_share(select(["eu-generic"])) == 0.5
    assert 0.05 < line_share(select(["gb-2001", "ru-1"])) < 0.95


def test_bolts_are_where_the_expected_standards_have_them() -> None:
    assert bolt_places(select(["de", "ru"])) == ()
    assert bolt_places(select(["us"])) == bolt_places(select(["us-mi", "de"])) == ((0.5833, 0.5),)
