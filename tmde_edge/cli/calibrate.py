"""`tmde-edge calibrate`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tmde_edge.cli.common import Verbs, base_dir, number, say
from tmde_edge.errors import UsageError


def add_calibrate(verbs: Verbs) -> None:
    sub = verbs.add("calibrate", _calibrate, "focal length and lens from a plate or a board at known distances")
    _calibrate_options(sub)


def _calibrate_options(sub: argparse.ArgumentParser) -> None:
    what = sub.add_argument_group("what to calibrate with (default: a plate before the live camera, with prompts)")
    what.add_argument("--images", nargs="+", metavar="FILE", default=[], help="stills, or folders of them")
    what.add_argument("--video", metavar="FILE", help="a video; its sharp frames are picked")
    what.add_argument("--at", nargs="+", type=number, metavar="SECONDS", default=[], help="--video: when each capture is")
    what.add_argument("--live", action="store_true", help="the camera of the configuration, also with --camera")
    what.add_argument("--distances", nargs="+", type=number, metavar="M", default=[], help="one a capture (default 2 5 10)")
    what.add_argument("--standard", metavar="ID", help="the plate; `tmde-edge plates list`")
    what.add_argument("--plate-mm", metavar="WxH", help="this plate's size by a ruler: surer than its standard")
    what.add_argument("--char-mm", type=number, metavar="MM", help="height of its characters by a ruler")
    what.add_argument("--straight", action="store_true", help="distances are from lens to plate, not along the road")
    what.add_argument("--fit-offset", action="store_true", help="the tape's beginning against the lens is a second unknown")
    what.add_argument("--tape-sigma-m", type=number, default=0.005, metavar="M", help="error of a distance (default 0.005)")
    what.add_argument("--chessboard", metavar="CxR", help="a board of so many inner corners instead of a plate")
    what.add_argument("--charuco", metavar="CxR", help="a ChArUco board of so many squares")
    what.add_argument("--dictionary", default="DICT_4X4_50", metavar="NAME", help="--charuco: its markers")
    what.add_argument("--marker-share", type=number, default=0.75, metavar="X", help="--charuco: marker side over square side")
    what.add_argument("--legacy-pattern", action="store_true", help="--charuco: a board of OpenCV before 4.6")
    other = sub.add_argument_group("other ways, and afterwards")
    other.add_argument("--camera", metavar="NAME", help="a known camera's prior until calibrated, 5 %%; `list` names them")
    other.add_argument("--lens-mm", type=number, metavar="MM", help="--camera: its exchangeable lens")
    other.add_argument("--import", dest="import_file", metavar="FILE", type=Path, help="ROS camera_info or OpenCV YAML")
    other.add_argument("--export", dest="export_file", metavar="FILE", type=Path, help="the configuration's calibration")
    other.add_argument("--format", choices=["ros", "opencv"], default="ros", help="--export: which YAML (default ros)")
    other.add_argument("--check", action="store_true", help="a plate at one known distance: pass or fail in one line")
    other.add_argument("--tolerance", type=number, default=0.03, metavar="X", help="--check: allowed error (default 0.03)")
    other.add_argument("--camera-id", default="", metavar="TEXT", help="which camera this is, for the record")


def _calibrate(args: argparse.Namespace) -> int:
    from tmde_edge.app.calibrate import CalibrateOptions, calibrate
    from tmde_edge.calibration.board import Board, parse_size
    from tmde_edge.calibration.plate import parse_mm
    from tmde_edge.config import load

    board = None
    if args.chessboard and args.charuco:
        raise UsageError("--chessboard and --charuco exclude each other")
    if args.chessboard or args.charuco:
        kind = "chessboard" if args.chessboard else "charuco"
        columns, rows = parse_size(args.chessboard or args.charuco, f"--{kind}")
        board = Board(kind=kind, columns=columns, rows=rows, dictionary=args.dictionary, marker_share=args.marker_share,
                      legacy=args.legacy_pattern)  # fmt: skip
    plate = parse_mm(args.plate_mm) if args.plate_mm else None
    options = CalibrateOptions(
        config_file=args.config, images=tuple(args.images), video=args.video, at_s=tuple(args.at), live=args.live,
        distances_m=tuple(args.distances), standard=args.standard, plate_mm=plate, char_mm=args.char_mm,
        straight=args.straight, fit_offset=args.fit_offset, tape_sigma_m=args.tape_sigma_m, camera=args.camera,
        lens_mm=args.lens_mm, board=board, import_file=args.import_file, export_file=args.export_file,
        export_kind=args.format, check=args.check, tolerance=args.tolerance, camera_id=args.camera_id,
    )  # fmt: skip
    there = args.config is not None and args.config.exists()  # a new file is made
    config = load(args.config if there else None, args.overrides)

    def ask(prompt: str) -> str | None:
        print(prompt, end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        return line if line else None

    return calibrate(config, base_dir(args), options, ask, lambda text: say(args, text), print)
