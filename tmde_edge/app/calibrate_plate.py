"""Captures of a plate at stated distances: from images to sightings, quality named, and one calibration out of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tmde_edge.app.eyes import Eyes
from tmde_edge.calibration.plate import (
    TAPE_SIGMA_M,
    Capture,
    CaptureFocal,
    PlateCalibration,
    capture_focal,
    combine,
)
from tmde_edge.calibration.quality import (
    Problem,
    aspect_of,
    check_calibration,
    check_capture,
    check_sighting,
    edges_differ,
    fatal,
    outliers,
    same_size,
)
from tmde_edge.calibration.sharpen import sharpened
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.messages import Frame, PlateSighting
from tmde_edge.plates.standard import PlateStandard
from tmde_edge.ranging.settings import RangingSettings

Image = NDArray[np.uint8]

# A plate to calibrate with is bare and its outline is looked at twice: its edges are the plate's own, not a frame's, and
# the ruler lay on them. One plate's characters come from one set of dies.
BARE_PLATE = RangingSettings(
    outline_sigma_mm=0.25, outline_sigma_tb_mm=0.25, outline_bias_px=0.2, glyph_bias_px=0.1, glyph_jitter=0.005
)
SHARPEST = 5  # frames of a video or a live camera that one capture is made of
POSE_SIGMA_RAD = 0.006  # a pitch surer than this turns the rays and is written,
POSE_CAPTURES = 4  # and of so many captures: plates held by hand at other heights look like a pitch


@dataclass(frozen=True, slots=True)
class Seen:
    """The plate of one image: as found (its quality is judged on that), and with its outline looked at again."""

    found: PlateSighting
    plate: PlateSighting
    blur_px: float  # one sigma of its edges


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """What was taken at one stated distance: the plate in one or more frames, or why it is of no use."""

    name: str
    distance_m: float
    width_px: int
    height_px: int
    seen: tuple[Seen, ...] = ()
    problem: Problem | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateJob:
    """How to calibrate with a plate."""

    standard: PlateStandard
    tape_sigma_m: float = TAPE_SIGMA_M
    straight: bool = False
    fit_offset: bool = False
    prior_px: float | None = None
    lens: Camera | None = None  # principal point and distortion, where known
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    settings: RangingSettings = BARE_PLATE


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateOutcome:
    """The calibration (None: no good capture), refused shots by name, and what is wrong with the whole."""

    calibration: PlateCalibration | None
    refused: tuple[tuple[str, Problem], ...]
    problems: tuple[Problem, ...]

    @property
    def usable(self) -> bool:
        """Whether the result may be written."""
        return self.calibration is not None and not fatal(self.problems)


def see_plate(eyes: Eyes, image: Image) -> Seen | Problem:
    """The largest plate of an image."""
    sighting = eyes.see_still(Frame(t_ns=0, index=0, image=image))
    if sighting.status == "blind":
        return Problem("no_plate", "the picture is black, white or empty")
    if not sighting.plates:
        return Problem("no_plate", "no plate is found: is it lit, whole and sharp?")
    largest = max(sighting.plates, key=lambda p: _area(p))
    return Seen(found=largest, plate=sharpened(image, largest), blur_px=edge_blur_px(image, largest))


def shot_of(name: str, distance_m: float, size: tuple[int, int], seen: Sequence[Seen | Problem]) -> Shot:
    """A shot of the sharpest good frames; its problem is that of the best frame where none is good."""
    width_px, height_px = size
    plates = sorted((s for s in seen if isinstance(s, Seen)), key=lambda s: s.blur_px)
    checked = [(s, check_sighting(s.found, s.blur_px)) for s in plates]
    good = tuple(s for s, problem in checked if problem is None)[:SHARPEST]
    base = Shot(name=name, distance_m=distance_m, width_px=width_px, height_px=height_px)
    if good:
        return replace(base, seen=good)
    if checked:
        return replace(base, problem=checked[0][1])
    problem = next((s for s in seen if isinstance(s, Problem)), Problem("no_plate", "no frame"))
    return replace(base, problem=problem)


def solve(shots: Sequence[Shot], job: PlateJob) -> PlateOutcome:
    """f from all good shots; shots that contradict the others are refused one by one."""
    refused: list[tuple[str, Problem]] = [(s.name, s.problem) for s in shots if s.problem is not None]
    captures = [
        Capture(name=s.name, distance_m=s.distance_m, width_px=s.width_px, height_px=s.height_px, straight=job.straight,
                sightings=tuple(v.plate for v in s.seen), edges_differ=max(edges_differ(v.found) for v in s.seen),
                aspect=float(np.median([aspect_of(v.found) for v in s.seen])))
        for s in shots if s.problem is None
    ]  # fmt: skip
    for capture, problem in zip(captures, same_size(captures), strict=True):
        if problem is not None:
            refused.append((capture.name, problem))
    captures = [c for c, p in zip(captures, same_size(captures), strict=True) if p is None]
    pose = (job.pitch_rad, job.roll_rad)
    found = _range_all(captures, job, pose, refused)
    if not found:
        return PlateOutcome(calibration=None, refused=tuple(refused), problems=(Problem("too_few", "no good capture"),))
    calibration = _combine(found, job, pose)
    if calibration.pose.pitch_rad is not None and pose_is_sure(calibration):
        # The plates themselves say how the camera looks down: distances are along the road, so the rays are turned.
        pose = (calibration.pose.pitch_rad, job.roll_rad)
        found = _range_all([c.capture for c in found], job, pose, refused)
        calibration = _combine(found, job, pose)
    while len(found) > 3:
        wrong = outliers(calibration)
        bad = next((i for i, p in enumerate(wrong) if p is not None), None)
        if bad is None or (problem := wrong[bad]) is None:
            break
        refused.append((found[bad].capture.name, problem))
        del found[bad]
        calibration = _combine(found, job, pose)
    problems = check_calibration(calibration, prior_px=job.prior_px)
    return PlateOutcome(calibration=calibration, refused=tuple(refused), problems=tuple(problems))


def pose_is_sure(calibration: PlateCalibration) -> bool:
    """Whether the pose while calibrating is worth writing."""
    sigma_rad = calibration.pose.pitch_sigma_rad
    return sigma_rad is not None and sigma_rad < POSE_SIGMA_RAD and len(calibration.captures) >= POSE_CAPTURES


def _combine(found: Sequence[CaptureFocal], job: PlateJob, pose: tuple[float, float]) -> PlateCalibration:
    offset = job.fit_offset and len(found) >= 3
    return combine(found, tape_sigma_m=job.tape_sigma_m, with_offset=offset, known_pose=pose)


def _range_all(captures: Sequence[Capture], job: PlateJob, pose: tuple[float, float],
               refused: list[tuple[str, Problem]]) -> list[CaptureFocal]:
    found: list[CaptureFocal] = []
    for capture in captures:
        one = capture_focal(capture, job.standard, job.settings, pitch_rad=pose[0], roll_rad=pose[1], lens=job.lens)
        problem = Problem("not_ranged", one) if isinstance(one, str) else check_capture(one, job.standard)
        if problem is not None:
            refused.append((capture.name, problem))
        elif not isinstance(one, str):
            found.append(one)
    return found


def _area(plate: PlateSighting) -> float:
    c = np.array(plate.corners_px)
    return float(np.hypot(*(c[1] - c[0])) * np.hypot(*(c[3] - c[0])))


def edge_blur_px(image: Image, plate: PlateSighting) -> float:
    """One sigma of the plate's sharpest edges: a step of contrast C and spread s is at most C / (s sqrt(2 pi)) steep."""
    c = np.array(plate.corners_px, dtype=np.float32)
    size = max(8, round(float(np.hypot(*(c[1] - c[0]))))), max(8, round(float(np.hypot(*(c[3] - c[0])))))
    flat = np.array([[0, 0], [size[0], 0], [size[0], size[1]], [0, size[1]]], np.float32)
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    patch = cv2.warpPerspective(grey, cv2.getPerspectiveTransform(c, flat), size).astype(np.float32)
    contrast = float(np.percentile(patch, 95) - np.percentile(patch, 5))
    slope = np.hypot(cv2.Sobel(patch, cv2.CV_32F, 1, 0), cv2.Sobel(patch, cv2.CV_32F, 0, 1)) / 8
    return contrast / (math.sqrt(2 * math.pi) * max(float(np.percentile(slope, 98)), 1e-3))
