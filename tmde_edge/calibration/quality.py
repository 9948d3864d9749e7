"""What is wrong with a capture or with a calibration, each named for what it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tmde_edge.calibration.plate import Capture, CaptureFocal, PlateCalibration
from tmde_edge.messages import PlateSighting
from tmde_edge.plates.standard import PlateStandard

Kind = Literal[
    "no_plate", "cut", "too_small", "blur", "tilt", "shape", "outlier", "not_ranged", "too_few", "one_distance", "focal_range",
    "prior", "trend", "scatter", "size",
]

MIN_FOCAL_PX, MAX_FOCAL_PX = 300.0, 5000.0
MAX_TILT = 0.15  # relative difference of opposite edges
MAX_TURN_RAD = 0.44
MIN_WIDTH_PX = 40.0  # of the plate, and
MIN_CHAR_PX = 7.0  # of its characters; two-row plates are narrow, long plates low
MAX_BLUR_PX = 1.3  # one sigma of an edge; sharp pictures have 0.7 to 1.0
MAX_BLUR_OF_CHAR = 0.085  # of a character's height: below, blur matters less than the tape
TREND_CHAR_PX = 14.0  # characters at least this tall tell by their heights how far the plate is turned
TURNED = 0.06  # relative difference of opposite edges from which on wrong proportions are a turned plate's
MIN_CAPTURES = 3
TREND_SIGMAS = 3.0
OUTLIER_SIGMAS = 4.0
OUTLIER_LEAST = 0.02  # relative
PRIOR_TOLERANCE = 0.20
MAX_SIGMA = 0.02


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong: its kind, and a line that says what, how much and what to do."""

    kind: Kind
    text: str


def edges_differ(plate: PlateSighting) -> float:
    """The larger relative difference of opposite edges: perspective, that is, how far the plate is turned away."""
    c = np.array(plate.corners_px)
    a = [float(np.hypot(*(c[i] - c[k]))) for i, k in ((1, 0), (2, 3), (3, 0), (2, 1))]
    trend = 0.0
    tall = [g for g in plate.glyphs if g.main and g.row == 0]
    if len(tall) >= 4 and tall[0].height_px >= TREND_CHAR_PX:  # better than an outline: they shrink towards the far end
        x = np.array([(g.left_px[0] + g.right_px[0]) / 2 for g in tall])
        heights = np.array([g.height_px for g in tall])
        trend = abs(float(np.polyfit(x, heights, 1)[0])) * (a[0] + a[1]) / 2 / float(heights.mean())
    return max(2 * abs(a[0] - a[1]) / (a[0] + a[1]), 2 * abs(a[2] - a[3]) / (a[2] + a[3]), trend)


def aspect_of(plate: PlateSighting) -> float:
    """Height over width of the outline, means of opposite edges."""
    c = np.array(plate.corners_px)
    a = [float(np.hypot(*(c[i] - c[k]))) for i, k in ((1, 0), (2, 3), (3, 0), (2, 1))]
    return (a[2] + a[3]) / max(a[0] + a[1], 1e-9)


def check_sighting(plate: PlateSighting, blur_px: float | None) -> Problem | None:
    """Whether one sighting of a plate is good enough to calibrate with; blur_px: one sigma of its edges in the image."""
    c = np.array(plate.corners_px)
    top, bottom = float(np.hypot(*(c[1] - c[0]))), float(np.hypot(*(c[2] - c[3])))
    left, right = float(np.hypot(*(c[3] - c[0]))), float(np.hypot(*(c[2] - c[1])))
    width = (top + bottom) / 2
    if plate.cut:
        return Problem("cut", "the frame cuts the plate: move it into the picture")
    char = plate.char_height_px or 0.0
    if width < MIN_WIDTH_PX or (0 < char < MIN_CHAR_PX):
        return Problem(
            "too_small",
            f"too small: the plate is {width:.0f} px wide and its characters {char:.1f} px tall; at least {MIN_WIDTH_PX:g} px "
            f"and {MIN_CHAR_PX:g} px are needed: go nearer",
        )
    blur = blur_px
    if blur is not None and blur > max(MAX_BLUR_PX, MAX_BLUR_OF_CHAR * (char or (left + right) / 3)):
        return Problem("blur", f"blurred: edges are {blur:.1f} px wide (one sigma); hold still, focus, add light")
    differ = edges_differ(plate)
    if differ > MAX_TILT:
        return Problem("tilt", f"tilted: opposite edges differ by {100 * differ:.0f} %, at most {100 * MAX_TILT:.0f} %; "
                               "let the plate face the camera")  # fmt: skip
    return None


def check_capture(found: CaptureFocal, standard: PlateStandard) -> Problem | None:
    """Whether the plate faced the camera and has the proportions of its standard."""
    turn = math.hypot(found.yaw_rad, found.lean_rad)
    if turn > MAX_TURN_RAD:
        return Problem("tilt", f"tilted: the plate is turned away by {math.degrees(turn):.0f} deg, at most "
                               f"{math.degrees(MAX_TURN_RAD):.0f}; let it face the camera")  # fmt: skip
    h, w = found.by_height_px, found.by_width_px
    if h is None or w is None or found.by_height_sigma is None or found.by_width_sigma is None:
        return None
    # A turned plate is narrower, a leaning one lower: what the joint fit says of both is taken out.
    ratio = (h / math.cos(found.lean_rad)) / (w / math.cos(found.yaw_rad))
    allowed = 0.05 + 3 * math.hypot(found.by_height_sigma, found.by_width_sigma)
    outline, aspect = standard.outline_belief(), found.capture.aspect
    first = ratio  # an outline that followed another edge at the second look is outvoted by the characters: no fault of the plate
    if outline is not None and aspect is not None:
        first = aspect * outline[0][0] / outline[1][0] * math.cos(found.yaw_rad) / math.cos(found.lean_rad)
    if abs(math.log(ratio)) > allowed and abs(math.log(first)) > allowed and (ratio > 1) == (first > 1):
        if ratio > 1 and found.capture.edges_differ > TURNED:
            differ = 100 * found.capture.edges_differ
            return Problem("tilt", f"tilted: opposite edges differ by {differ:.0f} % and the plate looks too narrow; let it face "
                                   "the camera")  # fmt: skip
        return Problem(
            "shape", f"height and width disagree: f = {h:.0f} px by the plate's height, {w:.0f} px by its width; is it a "
            f"{standard.id} plate ({standard.name})?",
        )
    return None


def outliers(calibration: PlateCalibration) -> list[Problem | None]:
    """For each capture, whether it contradicts the others: a wrong distance or another plate."""
    out: list[Problem | None] = [None] * len(calibration.captures)
    if len(calibration.captures) < MIN_CAPTURES + 1:
        return out
    r = np.array(calibration.residuals)
    middle = float(np.median(r))
    spread = max(1.4826 * float(np.median(np.abs(r - middle))), OUTLIER_LEAST / OUTLIER_SIGMAS)
    worst = int(np.argmax(np.abs(r - middle)))
    off = r[worst] - middle
    if abs(off) > OUTLIER_SIGMAS * spread:
        c = calibration.captures[worst]
        out[worst] = Problem(
            "outlier", f"disagrees with the others: {100 * off:+.1f} % of {c.capture.distance_m:g} m "
            f"(f = {c.f_px:.0f} px); is the distance right?",
        )
    return out


def check_calibration(calibration: PlateCalibration, *, prior_px: float | None = None) -> list[Problem]:
    """Problems of the whole: those that forbid to use it come first (see `fatal`)."""
    found: list[Problem] = []
    f, n = calibration.f_px, len(calibration.captures)
    distances = {round(c.capture.distance_m, 3) for c in calibration.captures}
    if n < MIN_CAPTURES:
        found.append(Problem("too_few", f"too few good captures: {n}, at least {MIN_CAPTURES}"))
    if len(distances) < 2:
        found.append(Problem("one_distance", "all captures are at one distance: a wrong reference point cannot be seen; use "
                                             "two distances or more, for example 2, 5 and 10 m"))  # fmt: skip
    if prior_px is not None:
        if abs(f / prior_px - 1) > PRIOR_TOLERANCE:
            found.append(Problem("prior", f"f = {f:.0f} px, but this camera should have about {prior_px:.0f} px: is it the "
                                          "right camera, lens and mode, and are the distances in metres?"))  # fmt: skip
    elif not MIN_FOCAL_PX <= f <= MAX_FOCAL_PX:
        found.append(Problem(
            "focal_range", f"f = {f:.0f} px is not between {MIN_FOCAL_PX:g} and {MAX_FOCAL_PX:g} px: are the distances in "
            "metres? A tele lens needs its own prior: --camera NAME --lens-mm MM",
        ))
    if calibration.offset_m is None and abs(calibration.trend_m) > TREND_SIGMAS * calibration.trend_sigma_m:
        found.append(Problem(
            "trend", f"the residuals grow towards near distances as if the tape began {100 * abs(calibration.trend_m):.0f} cm "
            f"{'in front of' if calibration.trend_m > 0 else 'behind'} the lens (+- {100 * calibration.trend_sigma_m:.0f} cm): "
            "measure from the lens, or make the offset the second unknown (--fit-offset)",
        ))  # fmt: skip
    if calibration.sigma > MAX_SIGMA:
        found.append(Problem(
            "scatter", f"uncertain: one sigma of f is {100 * calibration.sigma:.1f} %, at most {100 * MAX_SIGMA:.0f} %; "
            "repeat with a tape and larger plates in the picture",
        ))
    return found


FATAL: frozenset[Kind] = frozenset({"too_few", "focal_range", "prior", "trend", "scatter"})


def fatal(problems: Sequence[Problem]) -> list[Problem]:
    """Those with which a calibration is not written."""
    return [p for p in problems if p.kind in FATAL]


def same_size(captures: Sequence[Capture]) -> list[Problem | None]:
    """Which captures have another image size than most: one calibration is of one mode of the camera."""
    sizes = [(c.width_px, c.height_px) for c in captures]
    usual = max(sizes, key=sizes.count) if sizes else (0, 0)
    return [
        None if size == usual else Problem("size", f"{size[0]}x{size[1]} px, the others {usual[0]}x{usual[1]} px")
        for size in sizes
    ]
