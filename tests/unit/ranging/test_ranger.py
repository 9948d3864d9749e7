from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace as replace_struct
from plate_scenes import AHEAD, CAMERA, sighting

from tmde_edge.geometry.pinhole import Camera, view_from_vehicle
from tmde_edge.messages import BoltSighting, GlyphSighting, PlateColours, PlateSighting, RangeMeasurement
from tmde_edge.plates.region import expected
from tmde_edge.plates.standard import Size, load_standards, select
from tmde_edge.ranging.budget import ideal_sighting
from tmde_edge.ranging.classify import classes
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.ranging.scale_memory import TrackScale
from tmde_edge.ranging.settings import RangingSettings

STANDARDS = load_standards()
JOINT = RangingSettings()


def ranger(*expect: str, **changes: object) -> Ranger:
    return Ranger(RangingSettings(**changes), select(expect))  # type: ignore[arg-type]


def ranged(r: Ranger, plate: object, camera: Camera = CAMERA, view: np.ndarray = AHEAD) -> RangeMeasurement:
    measured, _, reason = r.measure(plate, camera, view, 0)  # type: ignore[arg-type]
    assert measured is not None, reason
    return measured


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["de-mittel", "us-mi", "ru-1", "gb-2001", "fr-1", "cn-small", "kr-film", "jp-mid"]),
    st.floats(0.8, 12.0),
    st.floats(-0.5, 0.5),
    st.floats(-0.15, 0.15),
    st.floats(-0.25, 0.25),
)
def test_project_then_range_is_the_identity(id_: str, distance: float, yaw: float, lean: float, u: float) -> None:
    plate = sighting(STANDARDS[id_], distance_m=distance, yaw=yaw, lean=lean, u=u)
    measured = ranged(ranger(id_), plate)
    # The priors on heading and lean pull a little where perspective no longer shows them.
    tolerance = 0.003 if distance < 6 or max(abs(yaw), abs(lean)) < 0.05 else 0.015
    assert abs(measured.distance_m / distance - 1) < tolerance
    assert abs(measured.distance_m - distance) < measured.sigma_m
    assert abs(measured.lateral_m - u * distance) < 0.02 * distance


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.12, 0.12), st.floats(-0.1, 0.1), st.floats(-0.12, 0.12), st.floats(-0.3, 0.3))
def test_distance_is_along_the_vehicles_axis_whatever_the_cameras_attitude(
    pitch: float, roll: float, yaw: float, u: float
) -> None:
    view = view_from_vehicle(pitch, roll, yaw)
    plate = sighting(STANDARDS["ru-1"], distance_m=5.0, u=u, view_from_vehicle=view)
    measured = ranged(ranger("ru"), plate, view=view)
    assert measured.distance_m == pytest.approx(5.0, rel=2e-3)
    assert measured.lateral_m == pytest.approx(5.0 * u, abs=0.01)


def test_lens_distortion_and_image_scale_do_not_change_the_distance() -> None:
    lens = Camera(
        width_px=1920, height_px=1080, fx_px=1400, fy_px=1400, cx_px=959.5, cy_px=539.5, distortion=(-0.3, 0.1, 0.0, 0.0)
    )
    for camera in (lens, lens.scaled_to(1280, 720)):
        plate = sighting(STANDARDS["us-mi"], camera, distance_m=4.0, u=0.5, v=0.2)
        assert ranged(ranger("us-mi"), plate, camera).distance_m == pytest.approx(4.0, rel=2e-3)


@pytest.mark.parametrize(
    ("id_", "width_px"), [("de-mittel", 120), ("us-aamva3", 60), ("ru-1", 60), ("fr-1", 200), ("gb-2001", 30)]
)
def test_sigma_is_honest_and_not_lazy(id_: str, width_px: float) -> None:
    """Sizes drawn within their tolerance, focal length and edges within theirs: 68 % inside one sigma, 95 % inside two."""
    rng = np.random.default_rng(7)
    s, r = STANDARDS[id_], ranger(id_)
    outline, height = s.outline_belief(), s.main_class.height
    assert outline is not None
    assert height is not None
    frame, frame_tb = 2**0.5 * JOINT.outline_sigma_mm, 2**0.5 * JOINT.outline_sigma_tb_mm
    mean, sigma = height.belief("glyph_height")
    z = []
    for _ in range(90):
        f = 1400 * (1 + rng.normal(0, CAMERA.focal_sigma))
        camera = replace(CAMERA, fx_px=f, fy_px=f)
        d = 1.4 * outline[0][0] / width_px * rng.uniform(0.95, 1.05)
        plate = sighting(
            s,
            camera,
            distance_m=d,
            yaw=rng.normal(0, 0.08),
            lean=rng.normal(0, 0.07),
            roll=rng.normal(0, 0.03),
            u=rng.uniform(-0.2, 0.2),
            rng=rng,
            corner_sigma=0.3,
            glyph_sigma=0.15,
            glyph_mm=rng.normal(mean, sigma),
            width_mm=rng.normal(outline[0][0], np.hypot(outline[0][1], frame)),
            height_mm=rng.normal(outline[1][0], np.hypot(outline[1][1], frame_tb)),
        )
        measured = ranged(r, plate)
        z.append(abs(measured.distance_m - d) / measured.sigma_m)
        assert measured.sigma_m**2 == pytest.approx(measured.noise_m**2 + (measured.scale_sigma * measured.distance_m) ** 2)
    # far plates are given sigmas for what blur does to small characters, which ideal sightings lack
    assert 0.56 < np.mean(np.array(z) < 1) < 0.95
    assert np.mean(np.array(z) < 2) > 0.91


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(["de-mittel", "us-mi", "ru-1", "kr-film", "gb-2001", "pl-2"]), st.floats(2.0, 14.0))
def test_the_fit_is_never_less_certain_than_its_best_cue(id_: str, distance: float) -> None:
    measured = ranged(ranger(id_), ideal_sighting(STANDARDS[id_], CAMERA, distance))
    # The cues take the plate as facing us; the fit pays for not knowing its heading.
    assert measured.sigma_m < 1.03 * min(c.sigma_m for c in measured.cues if c.used)


def test_one_wrong_corner_moves_the_distance_less_than_it_moves_the_width_cue() -> None:
    plate = sighting(STANDARDS["ru-1"], distance_m=8.0)
    tl, tr, br, bl = plate.corners_px
    broken = replace(plate, corners_px=((tl[0] - 6, tl[1]), tr, br, bl), corners_sigma_px=0.4)
    measured = ranged(ranger("ru"), broken)
    width = next(c.distance_m for c in measured.cues if c.cue == "plate_width")
    assert abs(width / 8 - 1) > 0.025
    assert abs(measured.distance_m / 8 - 1) < 0.3 * abs(width / 8 - 1)


@pytest.mark.parametrize("order", [1, -1])
def test_small_letters_never_count_as_tall_ones(order: int) -> None:
    plate = sighting(STANDARDS["ru-1"], distance_m=6.0, glyph_sigma=0.1, corner_sigma=0.2)
    # the reader's own opinion which characters are tall must not matter
    plate = replace(plate, glyphs=tuple(replace(g, main=(i % 2 == 0)) for i, g in enumerate(plate.glyphs))[::order])
    measured = ranged(ranger("ru"), plate)
    cue = next(c for c in measured.cues if c.cue == "char_height")
    assert cue.distance_m == pytest.approx(6.0, rel=0.015)
    only_small = replace(plate, glyphs=tuple(g for g in plate.glyphs if g.height_px < 15.5))
    assert 0 < len(only_small.glyphs) < len(plate.glyphs)
    assert ranged(ranger("ru"), only_small).distance_m == pytest.approx(6.0, rel=0.015)


def test_a_wild_glyph_is_ignored() -> None:
    plate = sighting(STANDARDS["de-mittel"], distance_m=6.0, glyph_sigma=0.1, corner_sigma=0.3)
    first = plate.glyphs[0]
    wild = replace(first, bottom_px=(first.bottom_px[0], first.bottom_px[1] + 9))
    before = ranged(ranger("de-1line"), plate).distance_m
    assert ranged(ranger("de-1line"), replace(plate, glyphs=(wild, *plate.glyphs[1:]))).distance_m == pytest.approx(
        before, rel=3e-3
    )


def test_a_cut_short_german_plate_is_ranged_by_its_characters() -> None:
    plate = sighting(STANDARDS["de-mittel"], distance_m=6.0, width_mm=440.0)
    measured = ranged(ranger("de-mittel"), plate)
    width = next(c for c in measured.cues if c.cue == "plate_width")
    assert width.distance_m > 6.9  # the baseline is off by 18 %
    assert measured.distance_m == pytest.approx(6.0, rel=0.015)


def test_a_plate_cut_by_the_frame_is_ranged_by_what_is_left() -> None:
    plate = sighting(STANDARDS["us-mi"], distance_m=0.5, u=0.60, cut=True)
    assert plate.corners_px[1][0] > CAMERA.width_px
    measured = ranged(ranger("us-mi"), plate)
    assert measured.distance_m == pytest.approx(0.5, rel=0.03)
    assert abs(measured.distance_m - 0.5) < 2 * measured.sigma_m
    assert "plate_width" not in {c.cue for c in measured.cues}


def test_a_plate_that_fills_the_frame_without_characters_is_not_ranged() -> None:
    plate = replace(sighting(STANDARDS["us-mi"], distance_m=0.15, v=0.0, cut=True), glyphs=())
    measured, _, reason = ranger("us-mi").measure(plate, CAMERA, AHEAD, 0)
    assert measured is None
    assert reason is not None
    assert "cut by the frame" in reason


def test_far_plates_are_refused_with_the_reason() -> None:
    measured, state, reason = ranger("us-mi").measure(sighting(STANDARDS["us-mi"], distance_m=60.0), CAMERA, AHEAD, 0)
    assert measured is None
    assert reason is not None
    assert "too small" in reason
    assert isinstance(state, TrackScale)


def test_nothing_but_nan_gives_a_reason_not_a_nan() -> None:
    nan = (float("nan"), float("nan"))
    plate = replace(sighting(STANDARDS["us-mi"]), corners_px=(nan, nan, nan, nan), glyphs=())
    measured, _, reason = ranger("us-mi").measure(plate, CAMERA, AHEAD, 0)
    assert measured is None
    assert reason


@pytest.mark.parametrize("method", ["joint", "paper"])
def test_characters_found_twice_on_one_place_have_no_spacing(method: str) -> None:
    plate = sighting(STANDARDS["de-mittel"], distance_m=5.0)
    twice = replace(plate, glyphs=(plate.glyphs[0],) * 2)
    measured = ranged(ranger("de", method=method), twice)
    assert "char_spacing" not in {c.cue for c in measured.cues}
    assert measured.distance_m == pytest.approx(5.0, rel=0.05)


@pytest.mark.parametrize("fusion", [True, False])
def test_the_papers_method(fusion: bool) -> None:
    plate = replace(sighting(STANDARDS["gb-2001"], distance_m=5.0), stroke_px=14 * 0.28, border_px=1.0)
    measured = ranged(ranger("gb-2001", method="paper", fusion=fusion), plate)
    assert measured.distance_m == pytest.approx(5.0, rel=0.01)
    used = {c.cue for c in measured.cues if c.used}
    assert used == ({"char_height", "stroke_width", "char_spacing"} if fusion else {"char_height"})
    assert {"plate_width", "plate_height"} <= {c.cue for c in measured.cues}
    if fusion:
        assert measured.sigma_m < 1.2 * min(c.sigma_m for c in measured.cues if c.used)


def test_an_unsure_standard_widens_the_sigma() -> None:
    plate = sighting(STANDARDS["us-mi"], distance_m=9.0, glyph_sigma=0.15, corner_sigma=0.3)
    sure, unsure = ranged(ranger("us-mi"), plate), ranged(ranger("us-mi", "co", "jp-mid"), plate)
    assert unsure.sigma_m > sure.sigma_m
    assert abs(unsure.distance_m - 9.0) < 2 * unsure.sigma_m


@pytest.mark.parametrize("id_", ["us-aamva3", "ru-1", "gb-2001", "es-long", "cn-small", "jp-mid", "kr-film", "in-car", "pl-2"])
def test_auto_finds_the_class_or_says_how_unsure_it_is(id_: str) -> None:
    rng, r, truth = np.random.default_rng(5), ranger("auto"), STANDARDS[id_]
    outline = truth.outline_belief()
    assert outline is not None
    hits = covered = 0
    for _ in range(6):
        plate = sighting(
            truth, distance_m=1.4 * outline[0][0] / 100, yaw=rng.normal(0, 0.05), rng=rng, corner_sigma=0.2, glyph_sigma=0.1
        )
        measured = ranged(r, plate)
        assert measured.standard is not None
        got = STANDARDS[measured.standard].outline_belief()
        hits += got is not None and all(abs(a[0] / b[0] - 1) < 0.03 for a, b in zip(got, outline, strict=True))
        covered += abs(measured.distance_m - 1.4 * outline[0][0] / 100) < 2 * measured.sigma_m
    assert hits >= 5
    assert covered == 6


def test_a_ranger_without_standards_is_refused() -> None:
    with pytest.raises(ValueError):
        Ranger(JOINT, [])


def test_characters_that_scatter_more_than_stated_are_believed_less() -> None:
    rng = np.random.default_rng(2)
    honest = sighting(STANDARDS["de-mittel"], distance_m=12.0, rng=rng, corner_sigma=0.3, glyph_sigma=0.1)

    def shaken(g: GlyphSighting) -> GlyphSighting:
        return replace(g, top_px=(g.top_px[0], g.top_px[1] + rng.normal(0, 0.5)))

    worse = replace(honest, glyphs=tuple(shaken(g) for g in honest.glyphs))
    r = ranger("de-mittel")
    assert ranged(r, worse).sigma_m > 1.25 * ranged(r, honest).sigma_m


def test_an_outline_that_was_not_refined_is_believed_less() -> None:
    plate = replace(sighting(STANDARDS["pl-2"], distance_m=6.0, corner_sigma=0.3), glyphs=())
    refined, rough = (ranged(ranger("pl-2"), replace(plate, refined=r)) for r in (True, False))
    assert rough.sigma_m > 1.1 * refined.sigma_m


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["auto", "us", "ru"]),
    st.lists(st.tuples(st.floats(-400, 2400), st.floats(-400, 1500)), min_size=4, max_size=4),
    st.integers(0, 8),
    st.sampled_from([0.0, 0.3, 5.0]),
    st.booleans(),
)
def test_any_quadrilateral_gives_a_finite_answer_or_a_reason(
    expect: str, corners: list[tuple[float, float]], glyphs: int, sigma: float, collapse: bool
) -> None:
    plate = sighting(STANDARDS["us-mi"], distance_m=6.0, glyph_sigma=0.2)
    corners = [corners[0]] * 4 if collapse else corners
    plate = replace(
        plate, corners_px=(corners[0], corners[1], corners[2], corners[3]), glyphs=plate.glyphs[:glyphs], corners_sigma_px=sigma
    )
    state = None
    for i in range(2):
        measured, state, reason = ranger(expect).measure(plate, CAMERA, AHEAD, i * 10**8, state)
        if measured is None:
            assert reason
            continue
        numbers = [
            measured.distance_m,
            measured.sigma_m,
            measured.noise_m,
            measured.scale_sigma,
            measured.lateral_m,
            measured.lateral_sigma_m,
        ]
        assert np.isfinite(numbers).all()
        assert measured.sigma_m > 0
        assert np.isfinite([x for c in measured.cues for x in (c.distance_m, c.sigma_m)]).all()


def test_missed_characters_do_not_outvote_the_width_of_a_low_plate() -> None:
    """Characters of 3 px of which only every second is seen: their spacing doubles; the plate's width must decide."""
    plate = sighting(STANDARDS["fr-1"], distance_m=34.0, corner_sigma=0.3, glyph_sigma=0.1)
    sparse = replace(plate, glyphs=plate.glyphs[::2])
    measured = ranged(ranger("fr-1"), sparse)
    assert measured.distance_m == pytest.approx(34.0, rel=0.04)


def test_each_side_of_the_outline_is_believed_as_far_as_it_was_seen() -> None:
    plate = sighting(STANDARDS["us-mi"], distance_m=8.0, corner_sigma=0.2, glyphs=False)
    far = tuple((x + (1.5 if i in (1, 2) else 0.0), y) for i, (x, y) in enumerate(plate.corners_px))
    wrong = replace(plate, corners_px=far)  # the right side 1.5 px too far out
    known = replace(wrong, side_sigma_px=(0.2, 1.5, 0.2, 0.2))
    off = [abs(ranged(ranger("us-mi"), p).distance_m / 8.0 - 1) for p in (wrong, known)]
    assert off[1] < 0.9 * off[0]


def test_crooked_short_sides_do_not_turn_the_plate() -> None:
    """Lettering tilts the short sides by a pixel between their ends; all sizes still say 6.07 m."""
    straight = replace(sighting(STANDARDS["ru-1"], distance_m=6.07, glyph_sigma=0.1), side_sigma_px=(0.2,) * 4)
    tl, tr, br, bl = straight.corners_px
    bent = ((tl[0] + 0.5, tl[1] - 0.25), (tr[0] + 0.5, tr[1] + 0.25), (br[0] - 0.5, br[1] - 0.25), (bl[0] - 0.5, bl[1] + 0.25))
    a, b = (ranged(ranger("ru-1"), p) for p in (straight, replace(straight, corners_px=bent)))
    assert abs(b.distance_m / a.distance_m - 1) < 0.005


def test_cues_that_contradict_each_other_widen_the_sigma() -> None:
    """Characters that say 4 % farther than the outline: one of the sizes is wrong, and nobody knows which."""
    agree = sighting(STANDARDS["ru-1"], distance_m=6.0, glyph_sigma=0.05, corner_sigma=0.1)
    torn = sighting(STANDARDS["ru-1"], distance_m=6.0, glyph_sigma=0.05, corner_sigma=0.1, glyph_mm=76 * 0.96)
    a, b = (ranged(ranger("ru-1"), p) for p in (agree, torn))
    assert b.sigma_m > 1.3 * a.sigma_m
    assert b.noise_m > 1.3 * a.noise_m  # such frames weigh less in a track too


@pytest.mark.parametrize("share", [0.90, 0.85, 0.80])
def test_characters_that_the_fit_calls_wild_still_widen_the_sigma(share: float) -> None:
    """10 to 20 % too small against both sides of the outline: whoever is right, the other stays within 5 sigma of it."""
    torn = sighting(STANDARDS["ru-1"], distance_m=8.0, glyph_sigma=0.05, corner_sigma=0.1, glyph_mm=76 * share)
    found = ranged(ranger("ru-1"), torn)
    assert found.sigma_m > 0.2 * (1 / share - 1) * 8.0


def test_a_turn_that_only_reconciles_two_sizes_hides_no_contradiction() -> None:
    """Characters 6 % too tall on a far plate that faces us: the fit could turn the plate until its width agrees."""
    tall = sighting(STANDARDS["ru-1"], distance_m=8.0, glyph_sigma=0.05, corner_sigma=0.1, glyph_mm=76 * 1.06)
    found = ranged(ranger("ru-1"), tall)
    assert 2 * found.sigma_m > abs(found.distance_m - 8.0)
    assert found.sigma_m > 0.02 * 8.0


@pytest.mark.parametrize("yaw", [0.2, 0.4])
def test_a_turn_that_perspective_shows_contradicts_nothing(yaw: float) -> None:
    facing, turned = (
        ranged(ranger("ru-1"), sighting(STANDARDS["ru-1"], distance_m=1.5, yaw=y, glyph_sigma=0.05, corner_sigma=0.1))
        for y in (0.0, yaw)
    )
    assert turned.sigma_m < 1.2 * facing.sigma_m


@pytest.mark.parametrize(("id_", "most"), [("de-mittel", 0.07), ("fr-1", 0.05)])
def test_what_blur_has_made_tall_is_not_believed_the_more_for_it(id_: str, most: float) -> None:
    """A plate of 30 px whose height reads 30 % and whose characters read 18 % too large: the width tells how small they are."""
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        tall = {"height_mm": 1.3 * 110, "glyph_mm": 1.18 * 75}
        plate = sighting(STANDARDS[id_], distance_m=24.0, rng=rng, corner_sigma=0.2, glyph_sigma=0.2, **tall)
        measured = ranged(ranger(id_), plate)
        errors.append(abs(measured.distance_m / 24.0 - 1))
        assert errors[-1] < 2 * measured.sigma_m / measured.distance_m
    assert float(np.mean(errors)) < most


def _with_bolts(distance_m: float, *, apart_mm: float = 177.8, width_mm: float | None = None) -> PlateSighting:
    """An American plate with one row of bolts; width_mm: the outline that is seen, a frame's perhaps."""
    plate = sighting(STANDARDS["us-aamva3"], distance_m=distance_m, width_mm=width_mm, corner_sigma=0.0, glyph_sigma=0.0)
    x, y = (np.array(plate.corners_px).mean(axis=0)).tolist()
    half = apart_mm / 2000 / distance_m * CAMERA.fx_px
    row = y + 0.06 / distance_m * CAMERA.fy_px
    bolts = BoltSighting(left_px=(x - half, row), right_px=(x + half, row), sigma_px=0.25)
    return replace(plate, corners_sigma_px=0.3, glyphs=(), bolts=(bolts,))


def test_bolts_correct_a_plate_whose_edges_a_frame_hides() -> None:
    r, framed = ranger("us-aamva3"), _with_bolts(4.0, width_mm=304.8 * 1.03)
    without, with_bolts = ranged(r, replace(framed, bolts=())), ranged(r, framed)
    assert abs(with_bolts.distance_m - 4.0) < 0.6 * abs(without.distance_m - 4.0)
    assert with_bolts.sigma_m < 0.85 * without.sigma_m
    cue = next(c for c in with_bolts.cues if c.cue == "bolt_spacing")
    assert cue.used
    assert cue.distance_m == pytest.approx(4.0, rel=1e-3)


def test_print_that_was_taken_for_bolts_moves_the_distance_little() -> None:
    r = ranger("us-aamva3")
    full = replace(_with_bolts(4.0), glyphs=sighting(STANDARDS["us-aamva3"], distance_m=4.0).glyphs)
    wild = replace(full, bolts=_with_bolts(4.0, apart_mm=177.8 * 1.07).bolts)
    assert abs(ranged(r, wild).distance_m / ranged(r, full).distance_m - 1) < 0.015


def test_bolts_say_nothing_of_plates_whose_spacing_no_source_gives() -> None:
    plate = _with_bolts(4.0)
    r = ranger("jp-mid")
    with_bolts, without = ranged(r, plate), ranged(r, replace(plate, bolts=()))
    assert with_bolts == without
    assert "bolt_spacing" not in {c.cue for c in with_bolts.cues}


def test_bolts_at_the_frames_edge_are_left_out() -> None:
    plate = _with_bolts(4.0)
    apart_px = 1.03 * (plate.bolts[0].right_px[0] - plate.bolts[0].left_px[0])
    cut, whole = (BoltSighting(left_px=(x, 500.0), right_px=(x + apart_px, 500.0), sigma_px=0.25) for x in (0.2, 3.0))
    r = ranger("us-aamva3")
    assert ranged(r, replace(plate, bolts=(whole,))).distance_m != ranged(r, replace(plate, bolts=())).distance_m
    assert ranged(r, replace(plate, bolts=(cut,))).distance_m == ranged(r, replace(plate, bolts=())).distance_m


@pytest.mark.parametrize("off", [0.07, 0.05, 0.04, 0.03, 0.0, -0.03, -0.04, -0.05, -0.07])
@pytest.mark.parametrize("nearest_m", [3.0, 6.0])
def test_the_same_print_in_every_frame_is_no_proof(off: float, nearest_m: float) -> None:
    """On the way to a plate, from where a bolt is just seen, whatever print is taken for bolts: inside two sigmas."""
    rng, state, r = np.random.default_rng(2), None, ranger("us-aamva3")
    for frame, distance_m in enumerate(np.linspace(6.8, nearest_m, 40).tolist()):
        plate = _with_bolts(distance_m, apart_mm=177.8 * (1 + off) + rng.normal(0, 0.5))
        plate = replace(plate, glyphs=sighting(STANDARDS["us-aamva3"], distance_m=distance_m).glyphs)
        corners = np.array(plate.corners_px) + rng.normal(0, 0.3, (4, 2))
        plate = replace(plate, corners_px=tuple((float(x), float(y)) for x, y in corners))
        measured, state, _ = r.measure(plate, CAMERA, AHEAD, frame * 50_000_000, state)
        assert measured is not None
        assert frame < 5 or abs(measured.distance_m - distance_m) < 2.0 * measured.sigma_m
    if off == 0.0:
        assert measured.sigma_m < 0.014 * measured.distance_m


def test_frames_without_bolts_keep_what_the_others_said() -> None:
    """A frame makes the plate 3 % too wide; bolts are looked for in every third picture only."""
    r, state, found = ranger("us-aamva3"), None, []
    for frame in range(12):
        plate = _with_bolts(4.0, width_mm=304.8 * 1.03)
        plate = plate if frame % 3 == 0 else replace(plate, bolts=())
        measured, state, _ = r.measure(plate, CAMERA, AHEAD, frame * 33_000_000, state)
        assert measured is not None
        found.append(measured.distance_m)
    assert np.ptp(found) < 0.004 * 4.0
    assert abs(found[-1] - 4.0) < 0.08


def test_bolts_tell_standards_apart_only_where_they_fit() -> None:
    r = ranger("us-aamva3", "jp-mid")

    def belief_in_us(plate: PlateSighting) -> float:
        measured = ranged(r, plate)
        return measured.belief if measured.standard == "us-aamva3" else 1 - measured.belief

    plain = belief_in_us(replace(_with_bolts(4.0), bolts=()))
    assert belief_in_us(_with_bolts(4.0)) > plain + 0.1
    assert belief_in_us(_with_bolts(4.0, apart_mm=177.8 * 1.07)) < plain
    assert belief_in_us(_with_bolts(4.0, apart_mm=177.8 * 1.07)) > 0.05 * plain  # print is no proof of another country


@pytest.mark.parametrize("apart_mm", [0.0, -177.8])
def test_bolts_that_are_no_pair_are_left_out(apart_mm: float) -> None:
    r, plate = ranger("us-aamva3"), _with_bolts(4.0, apart_mm=apart_mm)
    assert ranged(r, plate) == ranged(r, replace(plate, bolts=()))


def test_a_pair_that_is_not_believed_is_not_called_used() -> None:
    r = ranger("us-aamva3")
    for apart_mm, used in ((177.8, True), (177.8 * 1.07, False)):
        cue = next(c for c in ranged(r, _with_bolts(4.0, apart_mm=apart_mm)).cues if c.cue == "bolt_spacing")
        assert cue.used is used


def test_standards_with_and_without_bolts_are_two_classes() -> None:
    twin = replace_struct(STANDARDS["us-aamva3"], id="twin", hole_spacing=None)
    assert len(classes([STANDARDS["us-aamva3"], twin], JOINT)) == 2
    assert len(classes([STANDARDS["us-aamva3"], replace_struct(STANDARDS["us-aamva3"], id="twin")], JOINT)) == 1
    wider = replace_struct(STANDARDS["us-aamva3"], id="wider", hole_spacing=Size(mm=190.0))
    assert len(classes([STANDARDS["us-aamva3"], wider], JOINT)) == 2


def test_without_memory_every_frame_stands_for_itself() -> None:
    """Bolts and colours of an earlier frame say nothing, nor do sizes."""
    framed = _with_bolts(4.0, width_mm=304.8 * 1.03)
    french = sighting(STANDARDS["fr-1"], distance_m=8.0, corner_sigma=0.3, glyph_sigma=0.15, width_mm=480.0)
    one_band = PlateColours(ground="white", left_band=True, right_band=False)
    for id_, told, plain in (
        ("us-aamva3", framed, replace(framed, bolts=())), ("fr-1", replace(french, colours=one_band), french),
    ):  # fmt: skip
        r = Ranger(RangingSettings(memory=False), select([id_]))
        alone = ranged(r, plain)
        _, state, _ = r.measure(told, CAMERA, AHEAD, 0)
        after, _, _ = r.measure(plain, CAMERA, AHEAD, 33_000_000, state)
        assert after is not None
        assert after.distance_m == pytest.approx(alone.distance_m, rel=1e-4)


def test_the_region_decides_what_the_picture_leaves_open() -> None:
    """Two-row plates of Poland and France differ by 10 % in size and by 3 % in shape."""
    plate = sighting(STANDARDS["pl-2"], distance_m=14.0, rng=np.random.default_rng(1), corner_sigma=0.8, glyph_sigma=0.4)
    told = []
    for region in ("pl", "fr"):
        measured = ranged(Ranger(JOINT, expected(["pl-2", "fr-2"], [region])), plate)
        told.append(measured.belief if measured.standard == "pl-2" else 1 - measured.belief)
    assert told[0] > told[1] + 0.2
