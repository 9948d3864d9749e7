"""Makes what the system test plays into its virtual machine: a rendered drive as raw camera buffers, its CAN traffic, and
what the desk says about the same pictures.

    prepare.py FOLDER      writes frames.yuyv, can.log, config.toml, expected.json
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

SCENARIO = "approach"
FPS = 5.0  # User-Mode Linux is two to four times slower than its host
WIDTH_PX, HEIGHT_PX = 640, 360
LEFT_PX, TOP_PX = 320, 250  # of the window that is cut out of the rendered picture: road and lead, full resolution
HOLD_S = 3.0  # the first picture stands this long before the drive begins


def main() -> None:
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        drive = Path(scratch, "drive")
        program("simulate", SCENARIO, "--out", str(drive))
        frames = yuyv_frames(drive / "video.mp4")
        frames.tofile(out / "frames.yuyv")
        (out / "can.log").write_text((drive / "can.log").read_text())
        (out / "config.toml").write_text(config((drive / "config.toml").read_text()))
        records = desk(frames, out, Path(scratch))
    alerts = [(r["t"] - HOLD_S, r["alert"]["level"]) for r in records if r["alert"]["level"] != "none"]
    warnings = [t for t, level in alerts if level == "warning"]
    lead = [r["lead"]["distance_m"] for r in records if r["lead"] is not None]
    if not warnings or not lead:
        sys.exit("prepare: the desk does not warn in this drive; the system test would test nothing")
    expected = {
        "fps": FPS, "width_px": WIDTH_PX, "height_px": HEIGHT_PX, "frames": len(frames),
        "first_alert_s": alerts[0][0], "first_warning_s": warnings[0], "last_distance_m": lead[-1],
    }  # fmt: skip
    (out / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")
    print(json.dumps(expected))


def program(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "tmde_edge.cli", "-q", *arguments], check=True)


def yuyv_frames(video: Path) -> np.ndarray:
    """(n, h, w, 2) uint8: every so manieth picture, cut and without colour, as a camera's YUYV buffers."""
    capture = cv2.VideoCapture(str(video))
    step = round(capture.get(cv2.CAP_PROP_FPS) / FPS)
    frames = []
    index = 0
    while True:
        ok, image = capture.read()
        if not ok:
            break
        if index % step == 0:
            grey = cv2.cvtColor(image[TOP_PX : TOP_PX + HEIGHT_PX, LEFT_PX : LEFT_PX + WIDTH_PX], cv2.COLOR_BGR2GRAY)
            buffer = np.full((HEIGHT_PX, WIDTH_PX, 2), 128, np.uint8)
            buffer[:, :, 0] = np.rint(16 + grey.astype(np.float32) * (219 / 255))
            frames.append(buffer)
        index += 1
    return np.stack(frames)


def config(rendered: str) -> str:
    """The rendered drive's configuration for the cut-out picture and the machine's devices."""
    lines = []
    for line in rendered.splitlines():
        key, _, value = line.partition("=")
        match key.strip():
            case "width_px":
                line = f"width_px = {WIDTH_PX}"
            case "height_px":
                line = f"height_px = {HEIGHT_PX}"
            case "rate_hz":
                line = f"rate_hz = {FPS}"
            case "cx_px":
                line = f"cx_px = {float(value) - LEFT_PX}"
            case "cy_px":
                line = f"cy_px = {float(value) - TOP_PX}"
        lines.append(line)
        if line == "[camera]":
            lines.append('device = "/dev/video0"')
        if line == "[can.vehicle]":
            lines[-1:] = ["[can]", 'channel = "vcan0"', "transmit = false  # silent at first", "", "[can.vehicle]"]
    lines += ["", "[record]", "enabled = true", "", "[runtime]", "threads = 1"]
    return "\n".join(lines) + "\n"


def desk(frames: np.ndarray, out: Path, scratch: Path) -> list[dict]:
    """What --dry-run says about the same pictures, with the first one held."""
    held = round(HOLD_S * FPS)
    folder = scratch / "pictures"
    folder.mkdir()
    for i in range(held + len(frames)):
        cv2.imwrite(str(folder / f"{i:04d}.png"), cv2.cvtColor(frames[max(i - held, 0)], cv2.COLOR_YUV2BGR_YUYV))
    log = (out / "can.log").read_text().splitlines()
    (scratch / "held.log").write_text("\n".join([*held_lines(log), *log]) + "\n")
    records = scratch / "records.jsonl"
    program(
        "--dry-run", str(folder), "-c", str(out / "config.toml"), "--fps", str(FPS), "--can-log", str(scratch / "held.log"),
        "--jsonl", str(records),
    )  # fmt: skip
    return [json.loads(line) for line in records.read_text().splitlines()]


def held_lines(log: list[str]) -> list[str]:
    """The first message of each id, at 50 Hz, for HOLD_S before the log."""
    start_s = float(log[0][1 : log[0].index(")")])
    firsts = {line.split()[2].split("#")[0]: line.split()[1:] for line in reversed(log)}
    stamps = [start_s - HOLD_S + i / 50 for i in range(round(HOLD_S * 50))]
    return [f"({stamp:.6f}) {channel} {frame}" for stamp in stamps for channel, frame in firsts.values()]


main()
