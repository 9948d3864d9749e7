"""The one table of names -> adapters: builds running parts from a configuration."""

from __future__ import annotations

import importlib.util
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec

from tmde_edge.adapters.cameras.disabled import DisabledCamera
from tmde_edge.adapters.cameras.live_camera import LiveCamera
from tmde_edge.adapters.cameras.played_file import PlayedFile
from tmde_edge.adapters.cameras.v4l2 import V4l2Camera, V4l2Settings
from tmde_edge.adapters.can_ports.dbc_files import load_vehicle_decoder, with_profile
from tmde_edge.adapters.depth.manifest import find_model, models_folder
from tmde_edge.adapters.depth.paced import Network, PacedDepth
from tmde_edge.adapters.depth.recorded import RecordedDepth
from tmde_edge.adapters.detectors.platenet import PlateNet
from tmde_edge.app import pose_state
from tmde_edge.app.dry_run import DepthSource
from tmde_edge.app.eyes import Eyes, Horizon, calibrated_prior
from tmde_edge.app.measure import measure_images
from tmde_edge.app.records import Record
from tmde_edge.app.replay import Outcome, replay
from tmde_edge.canbus.alert_tx import AlertTransmitter
from tmde_edge.canbus.ego_rx import EgoReceiver
from tmde_edge.config import Config, from_tree, merged, to_tree
from tmde_edge.errors import ConfigError, InputDataError
from tmde_edge.estimation import Estimation, Parts
from tmde_edge.messages import LaneSighting, Point, Pose
from tmde_edge.plates.region import expected
from tmde_edge.plates.standard import bolt_places, line_share, select
from tmde_edge.pose.attitude import AttitudeEstimator
from tmde_edge.pose.edges import Image
from tmde_edge.pose.resting import RestingPose
from tmde_edge.ranging.depth_scale import DepthAligner
from tmde_edge.ranging.ranger import Ranger
from tmde_edge.vision.detect.contour import ContourFinder
from tmde_edge.vision.perception import Perception
from tmde_edge.vision.protocols import PlateReader
from tmde_edge.vision.search import NetworkSearch, PlainSearch, PlateSearch
from tmde_edge.vision.segment.paper import PaperReader

MAX_THREADS = 4  # of a pool when the configuration leaves it open: more never helped networks this small


def threads(config: Config) -> int:
    """Bounds every pool of this process and returns the number."""
    count = config.runtime.threads or min(os.cpu_count() or 1, MAX_THREADS)
    cv2.setNumThreads(count)
    return count


def build_eyes(config: Config, clock_ns: Callable[[], int]) -> Eyes:
    """Finder, reader, flow and lanes as configured. Raises ModelError, ConfigError."""
    count = threads(config)
    d, c = config.detector, config.camera
    search: PlateSearch
    if d.kind == "contour":
        aspects = [o[0][0] / o[1][0] for s in select(config.plates.expect) if (o := s.outline_belief()) is not None]
        search = PlainSearch(ContourFinder(d, (min(aspects), max(aspects)) if aspects else None), d)
    elif d.kind == "onnx":
        from tmde_edge.adapters.detectors.onnx_plugin import OnnxFinder

        search = PlainSearch(OnnxFinder(d, count), d)
    else:
        search = NetworkSearch(PlateNet(threads=count), d)
    reader: PlateReader
    if config.segmenter.kind == "paper":
        reader = PaperReader(config.segmenter)
    else:
        from tmde_edge.adapters.detectors.glyphnet import GlyphNet
        from tmde_edge.vision.segment.bolts import BoltPlaces
        from tmde_edge.vision.segment.glyph_reader import GlyphReader

        standards = expected(config.plates.expect, config.plates.region)
        places = [BoltPlaces(spacing=spacing, aspect=aspect) for spacing, aspect in bolt_places(standards)]
        reader = GlyphReader(GlyphNet(threads=count), config.segmenter, line_share(standards), places)
    perception = Perception(
        search=search, reader=reader, detector=d, segmenter=config.segmenter, flow=config.flow, clock_ns=clock_ns
    )
    camera = c.camera()
    prior_px = calibrated_prior(camera, c.pitch_rad, c.roll_rad, c.yaw_rad)
    focal_px = None if camera is None else lambda w, h: camera.scaled_to(w, h).fx_px
    return Eyes(perception, config.pose, prior_px, clock_ns, build_horizon(config), focal_px)


def build_horizon(config: Config) -> Horizon | None:
    """The horizon network, where it is wanted and the camera is calibrated. Raises ModelError."""
    camera = config.camera.camera()
    if camera is None or not config.pose.network or config.pose.method == "none":
        return None
    from tmde_edge.adapters.detectors.horizonnet import HorizonNet

    net = HorizonNet()

    def see(image: Image, expected_px: Point | None) -> LaneSighting | None:
        return net.see(image, camera.scaled_to(image.shape[1], image.shape[0]).fx_px, expected_px)

    return see


def build_estimation(config: Config, base_dir: Path, resting: RestingPose | None = None) -> Estimation:
    """The deciding part; `resting` is what earlier drives taught about the mounting. Raises ConfigError (plates, DBC)."""
    camera = config.camera.camera()
    decoder = load_vehicle_decoder(config.can, base_dir) if config.can.enabled else None
    receiver = EgoReceiver(decoder, config.can) if decoder is not None else None
    return Estimation(
        Parts(
            camera=camera,
            to_bumper_m=config.camera.to_bumper_m,
            camera_height_m=config.camera.height_m,
            ranger=Ranger(config.ranging, expected(config.plates.expect, config.plates.region)),
            attitude=build_attitude(config, resting),
            depth=DepthAligner(config.depth, config.camera.height_m) if config.depth.kind != "none" else None,
            tracker=config.tracker,
            alerts=config.alerts,
            ego=receiver if receiver is not None and receiver.configured else None,
            transmitter=AlertTransmitter(config.can),
        )
    )


def build_attitude(config: Config, resting: RestingPose | None = None) -> AttitudeEstimator:
    """The attitude filter, from the pose at calibration."""
    c = config.camera
    return AttitudeEstimator(
        config.pose, c.camera(), pitch_rad=c.pitch_rad, roll_rad=c.roll_rad, yaw_rad=c.yaw_rad, resting=resting
    )  # fmt: skip


def check_parts(config: Config, base_dir: Path) -> list[str]:
    """Builds what can be wrong in a configuration beyond its values; returns notes for people. Opens no device, loads no network.

    Raises ConfigError, ModelError.
    """
    build_estimation(config, base_dir)
    build_camera(config, base_dir)
    if config.detector.kind == "onnx":
        from tmde_edge.adapters.detectors.onnx_plugin import detector_file

        detector_file(config.detector)
    notes = []
    if config.can.enabled:
        notes += [f"can.vehicle: {note}" for note in load_vehicle_decoder(config.can, base_dir).notes]
    if config.can.enabled and config.can.interface == "udp_multicast" and importlib.util.find_spec("msgpack") is None:
        raise ConfigError('can.interface "udp_multicast": needs the package msgpack; pip install "tmde-edge[udp]" installs it')
    command = config.alerts.command
    if command and shutil.which(command[0]) is None:
        raise ConfigError(f"alerts.command {command[0]!r}: no such program, or not executable; give its full path")
    camera = config.camera.camera()
    if camera is None:
        notes.append("camera.fx_px is not set: distances stay null (fault uncalibrated), TTC from scale works")
    elif config.camera.fx_px is None:
        notes.append(
            f"camera.prior = {config.camera.prior!r}: f = {camera.fx_px:.0f} px by its data sheet, +- {camera.focal_sigma:.0%} "
            "in every distance until `tmde-edge calibrate` measures it"
        )
    if not config.can.transmit:
        notes.append("can.transmit = false: silent, nothing is sent on the bus")
    if config.can.enabled and config.can.vehicle.speed is None and not config.can.vehicle.profile:
        notes.append("[can.vehicle] names no speed: own motion is not compensated")
    return notes


def measure_with(config: Config, paths: Sequence[Path]) -> Iterator[Record]:
    """Measures stills one by one."""
    c = config.camera
    eyes = build_eyes(config, time.perf_counter_ns)
    pose = Pose(pitch_rad=c.pitch_rad, roll_rad=c.roll_rad, yaw_rad=c.yaw_rad)
    ranger = Ranger(config.ranging, expected(config.plates.expect, config.plates.region))
    for record, _, _ in measure_images(paths, eyes, c.camera(), ranger, pose, config.tracker.path_half_width_m):
        yield record


def log_config(config: Config, base_dir: Path, resting: RestingPose | None = None) -> dict[str, object]:
    """What a drive log keeps: every value, the DBC, and the resting pose it began with, so that a replay needs nothing else."""
    can = with_profile(config.can, base_dir) if config.can.enabled else config.can
    files = {}
    if can.enabled and can.vehicle.dbc:
        files[can.vehicle.dbc] = (base_dir / can.vehicle.dbc).read_bytes().decode("utf-8", errors="surrogateescape")
    kept: dict[str, object] = {"values": to_tree(msgspec.structs.replace(config, can=can)), "files": files}
    if resting is not None:
        kept["resting"] = pose_state.to_tree(resting)
    return kept


def replay_log(path: Path) -> Outcome:
    """Replays a drive log with the configuration it carries."""
    with tempfile.TemporaryDirectory(prefix="tmde-replay-") as folder:
        return replay(path, lambda kept: estimation_of_log(path, kept, Path(folder)))


def estimation_of_log(path: Path, kept: dict[str, Any], folder: Path, over: dict[str, Any] | None = None) -> Estimation:
    """The estimation of a drive log's own configuration, its files laid into `folder`; `over`: a tree laid over it.

    Raises InputDataError, ConfigError.
    """
    values, files = kept.get("values"), kept.get("files", {})
    if not isinstance(values, dict) or not isinstance(files, dict):
        raise InputDataError(f"{path}: carries no configuration to decide with; was it made by `--record` or the service?")
    config = from_tree(merged(values, over or {}), f"configuration in {path}")
    # The file's own path may lie anywhere; inside the replay it is just a name.
    vehicle = config.can.vehicle
    renamed: dict[str, str] = {}
    for i, (name, text) in enumerate(files.items()):
        renamed[name] = f"{i}-{Path(name).name}"
        (folder / renamed[name]).write_bytes(text.encode("utf-8", errors="surrogateescape"))
    vehicle = msgspec.structs.replace(vehicle, dbc=renamed.get(vehicle.dbc or "", vehicle.dbc))
    config = msgspec.structs.replace(config, can=msgspec.structs.replace(config.can, vehicle=vehicle))
    try:
        resting = pose_state.from_tree(kept["resting"]) if "resting" in kept else None
    except ValueError as error:
        raise InputDataError(f"{path}: {error}") from None
    return build_estimation(config, folder, resting)


def build_depth(config: Config, base_dir: Path) -> DepthSource | None:
    """Relative depth on source time, or None where it is off. Raises ModelError, InputMissingError, InputDataError."""
    d = config.depth
    if d.kind == "none":
        return None
    if d.kind == "recorded":
        return RecordedDepth(base_dir / d.path, rate_hz=d.rate_hz, latency_s=d.latency_s)
    return PacedDepth(depth_network(config), rate_hz=d.rate_hz, latency_s=d.latency_s)


def depth_network(config: Config) -> Network:
    """The depth network of `[depth] model`. Raises ModelError."""
    from tmde_edge.adapters.depth.onnx_depth import OnnxDepth

    d = config.depth
    spec, path = find_model(d.model, models_folder(d.folder))
    return OnnxDepth(spec, path, threads=d.threads, grid=(d.grid_columns, d.grid_rows), providers=d.providers)


def build_camera(config: Config, base_dir: Path) -> LiveCamera:
    """The live source of frames. Raises ConfigError."""
    c = config.camera
    if c.kind == "video_file":
        return PlayedFile(str(base_dir / c.device), loop=c.loop, fps=c.rate_hz, threads=threads(config))
    if c.kind == "disabled":
        return DisabledCamera()
    if c.kind == "gstreamer":
        from tmde_edge.adapters.cameras.gstreamer import GstCamera

        return GstCamera(c.pipeline)
    settings = V4l2Settings(
        device=c.device, width_px=c.width_px, height_px=c.height_px, rate_hz=c.rate_hz, pixel_format=c.pixel_format,
        exposure_us=c.exposure_us, gain=c.gain, focus=c.focus,
    )  # fmt: skip
    if c.kind == "picamera2":
        from tmde_edge.adapters.cameras.pi_camera import PiCamera

        return PiCamera(settings)
    return V4l2Camera(settings)
