"""The configuration tree (TOML, SI units, unit in the key) and load(): unknown keys, wrong types and NaN are clear errors."""

from __future__ import annotations

import difflib
import itertools
import math
import re
import sys
import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from tmde_edge.alerts.settings import AlertSettings
from tmde_edge.calibration.priors import PRIOR_SIGMA, camera_prior
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.errors import ConfigError
from tmde_edge.geometry.pinhole import Camera
from tmde_edge.pose.settings import PoseSettings
from tmde_edge.ranging.depth_scale import DepthSettings
from tmde_edge.ranging.settings import RangingSettings
from tmde_edge.tracking.settings import TrackerSettings
from tmde_edge.vision.settings import DetectorSettings, FlowSettings, SegmenterSettings

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
PositiveInt = Annotated[int, Meta(gt=0)]


_ORDERED = (  # the first must not be above the second, and why
    ("alerts.warning_ttc_s", "alerts.caution_ttc_s", "a caution comes before a warning"),
    ("alerts.caution_ttc_s", "alerts.max_ttc_s", "no caution and no warning by TTC comes above max_ttc_s: raise it too"),
    ("alerts.inactive_speed_mps", "alerts.active_speed_mps", "alerts go off below the speed at which they come on"),
    ("tracker.path_half_width_m", "tracker.path_leave_m", "what enters the path must not leave it at once: raise both"),
    ("tracker.standing_half_width_m", "tracker.standing_leave_m", "what enters the path must not leave it at once: raise both"),
    ("ranging.min_distance_m", "ranging.max_distance_m", "nothing would ever be ranged"),
)


class CalibrationRecord(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[camera.calibration]` table: how the numbers of `[camera]` were found; for people, nothing is computed from it."""

    method: Literal["plate", "chessboard", "charuco", "prior", "import"]  # how
    date: str  # ISO 8601, UTC
    camera_id: str = ""  # which camera it was
    width_px: PositiveInt  # of the pictures it was made with
    height_px: PositiveInt  # the same
    sigma: NotNegative  # relative, of the focal length
    distances_m: list[float] = []  # of the captures
    residuals: list[float] = []  # (measured - stated) / stated distance; boards: rms of each view in pixels
    offset_m: float | None = None  # the tape began this far in front of the lens
    note: str = ""  # yours


class CameraConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[camera]` table: where frames come from, and the calibration (no default for fx_px: uncalibrated)."""

    kind: Literal["v4l2", "picamera2", "gstreamer", "video_file", "disabled"] = "v4l2"  # what gives the pictures
    device: str = "/dev/video0"  # or the file of kind "video_file", or the camera's number of kind "picamera2"
    pipeline: str = ""  # kind "gstreamer": the pipeline, ending in an appsink
    loop: bool = False  # video_file: begin again at the end
    # what the camera is asked for; mjpg where yuyv is slow over USB
    pixel_format: Literal["auto", "mjpg", "yuyv", "grey"] = "auto"
    width_px: PositiveInt = 1280  # of the pictures, and of the calibration
    height_px: PositiveInt = 720  # the same
    rate_hz: Positive = 30.0  # frames a second the camera is asked for
    exposure_us: NotNegative | None = None  # set: manual exposure
    gain: NotNegative | None = None  # set: manual gain, in the driver's own units
    focus: NotNegative | None = None  # set: autofocus off, in the driver's own units
    fx_px: Positive | None = None  # focal length in pixels at this size: `tmde-edge calibrate`
    fy_px: Positive | None = None  # default: fx_px
    cx_px: float | None = None  # default: the middle, (width - 1) / 2
    cy_px: float | None = None  # default: the middle, (height - 1) / 2
    distortion: list[float] = []  # OpenCV order k1 k2 p1 p2 [k3 ...]
    focal_sigma: NotNegative = 0.005  # relative, one sigma, of fx_px and fy_px
    prior: str | None = None  # a known camera (`tmde-edge calibrate --camera list`): stands in for fx_px at 5 % until calibrated
    lens_mm: Positive | None = None  # of the prior's exchangeable lens
    calibration: CalibrationRecord | None = None  # written by `tmde-edge calibrate`: where fx_px comes from
    height_m: Positive | None = None  # of the lens above the road
    pitch_rad: Annotated[float, Meta(ge=-0.8, le=0.8)] = 0.0  # at calibration, nose down positive
    roll_rad: Annotated[float, Meta(ge=-0.8, le=0.8)] = 0.0  # clockwise positive
    yaw_rad: Annotated[float, Meta(ge=-0.8, le=0.8)] = 0.0  # turned to the right positive
    to_bumper_m: NotNegative = 0.0  # from the lens forward to the own front bumper

    def camera(self) -> Camera | None:
        """The pinhole camera of the calibrated size, by prior with its sigma, or None while uncalibrated."""
        fx_px, sigma = self.fx_px, self.focal_sigma
        if fx_px is None:
            if self.prior is None:
                return None
            fx_px = camera_prior(self.prior).focal_px(self.width_px, self.height_px, self.lens_mm)
            sigma = max(sigma, PRIOR_SIGMA)
        return Camera(
            width_px=self.width_px,
            height_px=self.height_px,
            fx_px=fx_px,
            fy_px=fx_px if self.fy_px is None else self.fy_px,
            cx_px=(self.width_px - 1) / 2 if self.cx_px is None else self.cx_px,
            cy_px=(self.height_px - 1) / 2 if self.cy_px is None else self.cy_px,
            distortion=tuple(self.distortion),
            focal_sigma=sigma,
        )


class PlatesConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[plates]` table."""

    expect: list[str] = msgspec.field(default_factory=lambda: ["auto"])  # ids of standards or countries; ["auto"]: among all
    region: list[str] = []  # where you drive, countries or continents: ["de"], ["europe"]; []: not known


class RecordConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[record]` table: the ring of drive logs, and the evidence of warnings."""

    enabled: bool = False  # the ring: everything, all the time
    folder: str = "/var/lib/tmde-edge/drives"  # of the ring; incidents and the odometer lie in it too
    segment_s: Annotated[float, Meta(ge=1)] = 300.0  # a new file this often
    max_mb: PositiveInt = 2000  # of the ring; the oldest files go first
    max_age_days: Positive = 30.0  # older files go
    min_free_mb: Annotated[int, Meta(ge=0)] = 200  # of the disk; files of the ring go to keep it free
    frames: bool = False  # JPEG frames in the ring too (incidents always have them)
    frames_hz: Positive = 10.0  # recorded frames a second
    jpeg_quality: Annotated[int, Meta(ge=10, le=100)] = 85  # of recorded frames
    blur: bool = True  # characters of plates are made unreadable in every recorded frame
    shadow: bool = True  # while can.transmit = false: keep the evidence of what would have been said
    incidents: bool = False  # while transmitting: keep the evidence of what was said
    incident_level: Literal["caution", "warning"] = "warning"  # from this level on with evidence; all are counted
    incident_before_s: Annotated[float, Meta(ge=0, le=60)] = 10.0  # kept before the alert
    incident_after_s: Annotated[float, Meta(ge=0, le=60)] = 10.0  # and after it
    incidents_max_mb: PositiveInt = 1000  # of all incidents; the oldest go first
    range_device: str = ""  # serial port of a laser or lidar rangefinder, recorded as truth
    range_baud: Annotated[int, Meta(gt=0)] = 9600  # of that port
    range_unit: Literal["m", "cm", "mm", "ft"] = "m"  # of its numbers where the line names none
    range_field: Annotated[int, Meta(ge=0)] = 0  # which comma-separated field holds the distance; 0: the first number


class PublishConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[publish]` table: the records of the service for local programs."""

    socket: str = "auto"  # unix stream socket; "auto": records.sock in the service's run folder; "": none


class ViewConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[view]` table: the web page of the service, and of `tmde-edge view`."""

    enabled: bool = False  # in the service; `tmde-edge view` needs no switch
    host: str = "127.0.0.1"  # this machine only; "0.0.0.0": everybody on its networks who has the token
    port: Annotated[int, Meta(ge=0, le=65535)] = 8470  # 0: any that is free; the journal names it
    token: str = ""  # asked for where set, and always where host is not this machine only; "": one is made at each start
    rate_hz: Annotated[float, Meta(gt=0, le=30)] = 8.0  # pictures a second at most, and only while somebody watches
    width_px: Annotated[int, Meta(ge=160, le=1920)] = 640  # of the pictures sent; half of what the camera gives is the cheapest
    quality: Annotated[int, Meta(ge=20, le=95)] = 70  # of their JPEG


class RuntimeConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `[runtime]` table."""

    threads: Annotated[int, Meta(ge=0)] = (
        0  # of every pool (OpenCV, ONNX Runtime); 0: one a core, at most 4
    )
    tick_hz: Positive = 20.0  # how often time passes although nothing arrives
    status_socket: str = ""  # of `tmde-edge status`; "": /run/tmde-edge/status.sock, or the user's own runtime folder
    shed: bool = True  # do less when the board is slow or hot: depth rate, then search rate, then frame rate
    hot_c: Annotated[float, Meta(ge=40, le=120)] = 80.0  # from this temperature on the board is hot
    cpu_affinity: list[Annotated[int, Meta(ge=0)]] = []  # the cores the service may use; []: all
    realtime_priority: Annotated[int, Meta(ge=0, le=50)] = 0  # of capture and decisions (SCHED_RR); 0: none


class Config(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole configuration; every value but the calibration has a default."""

    camera: CameraConfig = msgspec.field(default_factory=CameraConfig)
    plates: PlatesConfig = msgspec.field(default_factory=PlatesConfig)
    detector: DetectorSettings = msgspec.field(default_factory=DetectorSettings)
    segmenter: SegmenterSettings = msgspec.field(default_factory=SegmenterSettings)
    flow: FlowSettings = msgspec.field(default_factory=FlowSettings)
    ranging: RangingSettings = msgspec.field(default_factory=RangingSettings)
    depth: DepthSettings = msgspec.field(default_factory=DepthSettings)
    pose: PoseSettings = msgspec.field(default_factory=PoseSettings)
    tracker: TrackerSettings = msgspec.field(default_factory=TrackerSettings)
    alerts: AlertSettings = msgspec.field(default_factory=AlertSettings)
    can: CanSettings = msgspec.field(default_factory=CanSettings)
    record: RecordConfig = msgspec.field(default_factory=RecordConfig)
    publish: PublishConfig = msgspec.field(default_factory=PublishConfig)
    view: ViewConfig = msgspec.field(default_factory=ViewConfig)
    runtime: RuntimeConfig = msgspec.field(default_factory=RuntimeConfig)


def load(path: Path | None, overrides: typing.Sequence[str] = ()) -> Config:
    """Reads a TOML file (None: all defaults) and applies `table.key=value` overrides.

    Raises ConfigError: one line with what, where, the value and what to do.
    """
    return from_tree(read_tree(path, overrides), str(path) if path is not None else "defaults")


def merged(under: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """A tree with another laid over it, table by table."""
    out = dict(under)
    for key, value in over.items():
        below = out.get(key)
        out[key] = merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return out


def read_tree(path: Path | None, overrides: typing.Sequence[str] = ()) -> dict[str, Any]:
    """The unchecked tree of a TOML file (None: empty) with overrides. Raises ConfigError."""
    tree: dict[str, Any] = {}
    if path is not None:
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ConfigError(f"configuration {path}: no such file; check -c/--config") from None
        except IsADirectoryError:
            raise ConfigError(f"configuration {path}: is a folder; name the TOML file in it") from None
        except (OSError, UnicodeDecodeError) as e:
            raise ConfigError(
                f"configuration {path}: cannot be read ({e}); check its permissions and encoding"
            ) from None
        except tomllib.TOMLDecodeError as e:
            raise ConfigError(f"configuration {path}: not TOML: {e}") from None
    for text in overrides:
        _override(tree, text)
    return tree


def from_tree(tree: dict[str, Any], where: str) -> Config:
    """Checks a plain tree and makes the Config of it; `where` names its origin in errors."""
    _check(tree, Config, "", where)
    try:
        config: Config = msgspec.convert(tree, Config)
    except msgspec.ValidationError as e:
        raise ConfigError(f"{where}: {_explain(str(e), tree)}") from None
    camera = config.camera
    if camera.fx_px is None and camera.fy_px is not None:
        raise ConfigError(
            f"{where}: camera.fy_px = {camera.fy_px} without camera.fx_px; give both or run `tmde-edge calibrate`"
        )
    if len(camera.distortion) not in (0, 4, 5, 8):
        raise ConfigError(f"{where}: camera.distortion has {len(camera.distortion)} values; 4, 5 or 8 are known (OpenCV's order)")
    if camera.fx_px is None and camera.prior is not None:
        try:
            camera.camera()
        except ConfigError as e:
            raise ConfigError(f"{where}: camera.prior: {e}") from None
    detector = config.detector
    if len(detector.onnx_mean) not in (0, 3):
        raise ConfigError(f"{where}: detector.onnx_mean has {len(detector.onnx_mean)} values; give one a channel, or none")
    if detector.onnx_format == "yolo-corners" and detector.onnx_class >= detector.onnx_classes:
        raise ConfigError(
            f"{where}: detector.onnx_class = {detector.onnx_class} of detector.onnx_classes = {detector.onnx_classes}; "
            "classes count from 0"
        )
    _check_order(config, where)
    return config


def _check_order(config: Config, where: str) -> None:
    """Values that contradict each other are errors: one of them would silence alerts, or switch them on and off."""
    for low, high, why in _ORDERED:
        (table, low_key), high_key = low.split("."), high.split(".")[1]
        values = getattr(config, table)
        below, above = getattr(values, low_key), getattr(values, high_key)
        if below > above:
            raise ConfigError(f"{where}: {low} = {below} is above {high} = {above}; {why}")
    ids = {"can.alert_id": config.can.alert_id, "can.lead_id": config.can.lead_id, "can.status_id": config.can.status_id}
    for (name, can_id), (other, other_id) in itertools.combinations(ids.items(), 2):
        if can_id == other_id:
            raise ConfigError(f"{where}: {name} and {other} are both 0x{can_id:X}; give every message an id of its own")


def to_tree(config: Config) -> dict[str, Any]:
    """Plain dictionaries and lists of a Config, for logs and for check-config."""
    tree: dict[str, Any] = msgspec.to_builtins(config)
    return tree


def _override(tree: dict[str, Any], text: str) -> None:
    key, sep, value = text.partition("=")
    parts = [p.strip() for p in key.split(".")]
    if not sep or len(parts) < 2 or not all(parts):
        raise ConfigError(f"--set {text}: not of the form table.key=value; for example --set camera.fx_px=1200")
    try:
        parsed: Any = tomllib.loads(f"v = {value}")["v"]
    except tomllib.TOMLDecodeError:
        if re.search(r"[\"'\[\]{}\n]", value):
            raise ConfigError(f"--set {text}: {value!r} is not a TOML value; quote strings inside lists") from None
        parsed = value.strip()
    node = tree
    for part in parts[:-1]:
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise ConfigError(f"--set {text}: {part} is a value, not a table")
    node[parts[-1]] = parsed


def _struct_of(annotation: Any) -> type[Struct] | None:
    """The Struct in an annotation such as X, X | None, list[X]; None where there is none or more than one."""
    if isinstance(annotation, type) and issubclass(annotation, Struct):
        return annotation
    if typing.get_origin(annotation) in (typing.Union, types.UnionType, list, tuple, Annotated):
        found = [s for a in typing.get_args(annotation) if (s := _struct_of(a)) is not None]
        return found[0] if len(set(found)) == 1 else None
    return None


def _check(value: Any, struct: type[Struct] | None, at: str, where: str) -> None:
    """Unknown keys (with the nearest right one) and numbers that are not finite, at any depth."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where}: {at} = {value} is not a finite number; give a number in the key's unit")
    if isinstance(value, list):
        for i, item in enumerate(value):
            _check(item, struct, f"{at}[{i}]", where)
    if not isinstance(value, dict):
        return
    hints = typing.get_type_hints(struct, include_extras=True) if struct is not None else None
    for key, item in value.items():
        name = f"{at}.{key}" if at else key
        if hints is not None and key not in hints:
            near = difflib.get_close_matches(key, hints, n=1, cutoff=0.4)
            kind = "table" if not at else "key"
            hint = f"did you mean {at + '.' if at else ''}{near[0]}?" if near else f"known: {', '.join(sorted(hints))}"
            raise ConfigError(f"{where}: unknown {kind} {name}; {hint}")
        _check(item, _struct_of(hints[key]) if hints is not None else None, name, where)


def _explain(message: str, tree: dict[str, Any]) -> str:
    """msgspec's message with the key in our notation and the value that was given."""
    match = re.search(r"^(.*) - at `\$\.?(.*)`$", message)
    if match is None:
        return message
    what, path = match.groups()
    node: Any = tree
    for part in re.findall(r"[^.\[\]]+", path):
        try:
            node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return f"{path}: {what}"
    return f"{path} = {node!r}: {what[0].lower()}{what[1:]}"
