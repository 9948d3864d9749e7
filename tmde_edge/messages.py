"""Every dataclass that crosses a stage: frozen, slotted, keyword-only, a unit in every numeric name.

Times are `t_ns`: monotonic nanoseconds of the measurement itself (shutter, CAN arrival; source time on the desk).
Pixels: source image, sub-pixel, pixel centres at integers; points are (x, y); corners TL, TR, BR, BL.
Sightings hold no pixel arrays, so that a drive can be logged and replayed without its video.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Point: TypeAlias = tuple[float, float]
Corners: TypeAlias = tuple[Point, Point, Point, Point]
CoursePoint: TypeAlias = tuple[float, float, float]  # x, y and the sigma of x
AlertLevel: TypeAlias = Literal["none", "caution", "warning"]
Mode: TypeAlias = Literal["strict", "permissive"]
Ground: TypeAlias = Literal["white", "yellow", "green", "blue"]  # "white" is grey too


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One image as captured: uint8, (h, w, 3) BGR or (h, w) grey. Stays on the vision side."""

    t_ns: int
    index: int
    image: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class GlyphSighting:
    """One character: the middle points of its four edges in the source image, each with its sigma across the edge."""

    left_px: Point
    right_px: Point
    top_px: Point
    bottom_px: Point
    sigma_tb_px: float  # of one top or bottom edge
    sigma_lr_px: float  # of one left or right edge
    score: float = 1.0
    row: int = 0
    main: bool = True  # belongs to the tallest height class of the plate (RU: digits; not the small letters)
    stroke_px: float | None = None

    @property
    def height_px(self) -> float:
        return float(np.hypot(self.bottom_px[0] - self.top_px[0], self.bottom_px[1] - self.top_px[1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class BoltSighting:
    """Two bolts (or holes for them) of one row, left and right, and one sigma of either's place."""

    left_px: Point
    right_px: Point
    sigma_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateColours:
    """Of the plate's ground, and whether its left and right end are blue bands; None: cannot be told."""

    ground: Ground | None = None
    left_band: bool | None = None
    right_band: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateSighting:
    """One plate in one frame, measured in source pixels only."""

    track_id: int  # identity in the image, from perception; 0 where stills have none
    corners_px: Corners
    corners_sigma_px: float  # one coordinate of one corner
    score: float
    source: Literal["detector", "flow"] = "detector"
    glyphs: tuple[GlyphSighting, ...] = ()
    char_height_px: float | None = None  # mean over the main characters kept
    stroke_px: float | None = None
    spacing_px: float | None = None  # mean pitch between neighbouring character centres of a row
    border_px: float | None = None
    refined: bool = True  # sub-pixel outline found; False: corners are the finder's own
    light_on_dark: bool = False
    cut: bool = False  # a side lies outside the frame
    blur_px: float | None = None  # estimated edge blur (one sigma)
    side_sigma_px: tuple[float, ...] = ()  # of the top, right, bottom and left line; empty: all as corners_sigma_px
    bolts: tuple[BoltSighting, ...] = ()  # of the rows in which a pair is seen
    colours: PlateColours | None = None  # None: a grey picture, or not looked at


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleChange:
    """Growth of a track's image between two frames, free of any metric knowledge."""

    track_id: int
    t_from_ns: int
    ratio: float  # image size now / then
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleBox:
    """The rear of the vehicle that carries a plate, as tracked in the image."""

    track_id: int
    left_px: float
    top_px: float
    right_px: float
    bottom_px: float
    sigma_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneSighting:
    """Lane geometry in the image: vanishing point, and where the ego lane's borders cross the bottom row."""

    vanishing_px: Point
    sigma_x_px: float
    sigma_y_px: float
    roll_rad: float | None = None
    roll_sigma_rad: float | None = None
    left_bottom_px: float | None = None
    right_bottom_px: float | None = None
    course_px: tuple[CoursePoint, ...] = ()  # our own way if we follow the lane, near to far
    source: Literal["lanes", "network"] = "lanes"


@dataclass(frozen=True, slots=True, kw_only=True)
class TiltChange:
    """How far the far part of the picture moved down since an earlier frame: the camera pitched up by that."""

    t_from_ns: int
    down_px: float
    sigma_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """What perception saw in one frame. NO_PLATE, BLIND and FAILED are different facts."""

    t_ns: int
    frame_index: int
    width_px: int
    height_px: int
    status: Literal["ok", "no_plate", "blind", "failed"]
    plates: tuple[PlateSighting, ...] = ()
    scale_changes: tuple[ScaleChange, ...] = ()
    vehicles: tuple[VehicleBox, ...] = ()
    lanes: LaneSighting | None = None
    tilt: TiltChange | None = None
    mode: Mode = "strict"
    searched: bool = True  # a full search ran on this frame
    error: str | None = None
    timing_ms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class CanFrame:
    """One CAN frame, received or to be sent."""

    t_ns: int
    can_id: int
    data: bytes
    extended: bool = False
    channel: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthReading:
    """Relative inverse depth of one frame on a coarse grid (row-major, bigger is nearer), with the image size it covers."""

    t_ns: int  # of the frame it was made from
    ready_t_ns: int  # when it became available
    width_px: int
    height_px: int
    grid_columns: int
    grid_rows: int
    inverse_depth: tuple[float, ...]
    model: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """Time passes although nothing arrives."""

    t_ns: int
    faults: tuple[str, ...] = ()  # what the adapters know: "camera_lost", "overload", ...
    temperature_c: float | None = None  # of the board


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeReference:
    """A distance that another instrument measured (laser, lidar): recorded beside the drive, never used for a decision."""

    t_ns: int  # when its line was complete
    distance_m: float | None  # None: it said "no target"
    text: str = ""  # its line


@dataclass(frozen=True, slots=True, kw_only=True)
class CueRange:
    """One cue's own distance."""

    cue: str
    distance_m: float
    sigma_m: float
    used: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeMeasurement:
    """Metric range of one plate from one frame, camera frame (x right, y down, z along the vehicle's forward axis).

    `sigma_m` is the whole standard deviation; `noise_m` is the part that is new in every frame (pixels), `scale_sigma`
    the relative part shared by all frames of a track (which true size, focal length). sigma^2 = noise^2 + (scale D)^2.
    """

    track_id: int
    t_ns: int
    distance_m: float
    sigma_m: float
    noise_m: float
    scale_sigma: float
    lateral_m: float
    lateral_sigma_m: float
    down_m: float
    yaw_rad: float | None = None
    standard: str | None = None
    belief: float = 1.0  # probability of that standard's class
    cues: tuple[CueRange, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoState:
    """What the own vehicle does."""

    t_ns: int
    speed_mps: float
    yaw_rate_radps: float | None
    speed_sigma_mps: float = 0.1
    yaw_rate_sigma_radps: float = 0.01
    brake_pressed: bool | None = None
    turn_signal: Literal["left", "right", "none"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Attitude of the camera against the road: pitch positive nose down, roll positive clockwise, yaw positive right."""

    pitch_rad: float
    roll_rad: float
    yaw_rad: float = 0.0
    pitch_sigma_rad: float = 0.0
    roll_sigma_rad: float = 0.0
    source: Literal["lanes", "network", "none"] = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthEstimate:
    """Distance by aligned relative depth."""

    distance_m: float
    sigma_m: float
    age_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LeadEstimate:
    """The filtered state of the lead vehicle. Metric values are None while uncalibrated; TTC needs no metres."""

    track_id: int
    distance_m: float | None
    sigma_m: float | None
    range_rate_mps: float | None
    range_rate_sigma_mps: float | None
    ttc_s: float | None
    ttc_sigma_s: float | None
    headway_s: float | None
    coasting_s: float
    source: Literal["plate", "vehicle", "flow", "depth"]
    lateral_m: float = 0.0
    lateral_sigma_m: float = 0.0
    accel_mps2: float | None = None  # of the lead itself, where the filter carries it


@dataclass(frozen=True, slots=True, kw_only=True)
class Alert:
    """What the driver is told."""

    level: AlertLevel = "none"
    reason: str = ""
    ttc_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateResult:
    """One plate of a record: what was seen and what it means."""

    sighting: PlateSighting
    range: RangeMeasurement | None
    in_path: bool = False
    lead: bool = False
    not_ranged: str | None = None  # why there is no distance


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameResult:
    """Everything decided for one frame."""

    t_ns: int
    frame_index: int
    plates: tuple[PlateResult, ...]
    lead: LeadEstimate | None
    ego: EgoState | None
    pose: Pose
    depth: DepthEstimate | None
    alert: Alert
    faults: tuple[str, ...]
    mode: Mode


Event: TypeAlias = Sighting | CanFrame | DepthReading | Tick
Output: TypeAlias = FrameResult | CanFrame
