"""How is the service: one JSON answer a request over a local socket, and its words for people."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import struct
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tmde_edge.errors import InputDataError, InputMissingError

_log = logging.getLogger(__name__)
Json = dict[str, Any]
Answer = Callable[[Json], Json]
NOT_OURS = "{}: no permission; use sudo, or join the group of the service (tmde-edge)"
RUN_FOLDER = Path("/run/tmde-edge")
_NAME = "status.sock"
_LONGEST = 4096  # bytes of a request
_PATIENCE_S = 2.0
_ACCEPT_S = 0.5


def socket_path(configured: str = "", run_folder: Path = RUN_FOLDER) -> Path:
    """Where service and client meet: as configured, else systemd's runtime folder, else the user's own."""
    if configured:
        return Path(configured)
    systemd = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if systemd:
        return Path(systemd) / _NAME
    if run_folder.is_dir():
        return run_folder / _NAME
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(own) / "tmde-edge" / _NAME if own else Path(tempfile.gettempdir()) / f"tmde-edge-{os.getuid()}" / _NAME


class StatusServer:
    """Answers requests, one JSON object a line, one connection at a time; a silent client is hung up on."""

    def __init__(self, path: Path, answer: Answer) -> None:
        self._path, self._answer = path, answer
        self._socket: socket.socket | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="status", daemon=True)

    def start(self) -> bool:
        """Binds the socket; False, with a line in the log, where that is not possible: the service runs on without."""
        try:
            self._path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
            if self._taken():
                _log.warning("status socket %s: another service answers there; set runtime.status_socket", self._path)
                return False
            self._path.unlink(missing_ok=True)
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
            self._socket.bind(str(self._path))
            self._path.chmod(0o660)
            self._socket.listen(4)
            self._socket.settimeout(_ACCEPT_S)
        except OSError as error:
            _log.warning("status socket %s: not possible (%s); set runtime.status_socket", self._path, error)
            return False
        self._thread.start()
        return True

    def close(self) -> None:
        """Ends the thread and removes the socket."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(2 * _ACCEPT_S)
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)
        if self._socket is not None:
            self._socket.close()

    def _taken(self) -> bool:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(0.2)
            return probe.connect_ex(str(self._path)) == 0

    def _serve(self) -> None:
        try:
            while not self._stop.is_set() and self._socket is not None:
                try:
                    connection, _ = self._socket.accept()
                except TimeoutError:
                    continue
                except OSError:  # out of descriptors: the client goes, we stay
                    self._stop.wait(_ACCEPT_S)
                    continue
                with connection, contextlib.suppress(OSError):
                    connection.settimeout(_PATIENCE_S)
                    self._talk(connection)
        except Exception:  # a thread's top; the service does not need its status to warn
            _log.exception("the status socket stopped")

    def _talk(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as lines:
            while not self._stop.is_set() and (line := lines.readline(_LONGEST)):
                try:
                    request = json.loads(line)
                except ValueError:
                    request = None
                known = isinstance(request, dict)
                answer = self._answer(request) if known else {"error": 'not a request; try {"request": "status"}'}
                connection.sendall(json.dumps(answer, allow_nan=False).encode() + b"\n")
                if not line.endswith(b"\n"):  # the rest of an overlong line is no request
                    return


def ask(path: Path, request: Json, timeout_s: float = 5.0) -> Json:
    """One question to the service. Raises InputMissingError (nobody there) or InputDataError (no sensible answer)."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        # Only a blocking connect waits while the service's queue of callers is full; its limit is the one for sending.
        connection.setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", *divmod(round(timeout_s * 1e6), 1_000_000))
        )
        try:
            connection.connect(str(path))
            connection.settimeout(timeout_s)
            connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as lines:
                answer = json.loads(lines.readline())
        except PermissionError:
            raise InputMissingError(NOT_OURS.format(path)) from None
        except (TimeoutError, BlockingIOError):
            raise InputDataError(f"{path}: the service did not answer within {timeout_s:g} s") from None
        except OSError as error:
            why = f"{path}: no service answers there ({error.strerror or error})"
            raise InputMissingError(f"{why}; is it running? try: systemctl status tmde-edge") from None
        except ValueError:
            raise InputDataError(f"{path}: the answer is not JSON; does something else listen there?") from None
    if not isinstance(answer, dict):
        raise InputDataError(f"{path}: the answer is no JSON object; does something else listen there?")
    if "error" in answer:
        raise InputDataError(f"{path}: the service says: {answer['error']}")
    return answer


def lines_of(status: Json) -> list[str]:
    """A status in words, a line a subject; parts that are missing are left out."""
    camera, can, frames = status.get("camera") or {}, status.get("can") or {}, status.get("frames") or {}
    faults = ", ".join(status.get("faults") or []) or "none"
    up = _duration(status.get("uptime_s"))
    out = [f"state     {status.get('state', '?')}; faults {faults}; up {up}, {status.get('version', '')}"]
    late = f"p50 {_n(frames.get('latency_p50_ms'))} p99 {_n(frames.get('latency_p99_ms'))} ms"
    out.append(
        f"frames    {_n(frames.get('rate_hz'))}/s; {frames.get('decided', 0)} decided, {frames.get('skipped', 0)} skipped, "
        f"{frames.get('shed', 0)} shed; shutter to decision {late}; perception busy {_percent(frames.get('busy'))}"
    )
    out.append(
        f"camera    {camera.get('name', '?')}: {camera.get('fault') or 'works'}; opened {camera.get('opened', 0)} times, lost "
        f"{camera.get('lost', 0)}, garbled {camera.get('garbled', 0)}, frozen {camera.get('frozen', 0)}"
    )
    if can:
        talk = "silent" if not can.get("transmit") else f"sent {can.get('sent', 0)}, failed {can.get('failed', 0)}"
        link = "connected" if can.get("connected") else "not connected"
        out.append(f"CAN       {can.get('name', '?')}: {link}; received {can.get('received', 0)}; {talk}")
    if (depth := status.get("depth")) is not None:
        where = f" on {', '.join(depth['providers'])}" if depth.get("providers") else ""
        counts = f"{depth.get('readings', 0)} readings, restarted {depth.get('restarts', 0)} times"
        out.append(f"depth     {depth.get('state', '?')}{where}; {counts}")
    queues = status.get("queues") or {}
    out.append(f"queues    inbox {queues.get('inbox', 0)} (dropped {queues.get('inbox_dropped', 0)}), log {queues.get('log', 0)}")
    board = status.get("board") or {}
    throttled = ", ".join(board.get("throttled") or []) or "not throttled"
    out.append(
        f"board     {_n(board.get('temperature_c'))} °C, {throttled}; memory {_n(board.get('memory_mb'), 0)} MB; load shed: "
        f"{status.get('shedding', 'none')}"
    )
    if (record := status.get("record")) is not None:
        words = [f"ring {record.get('ring', 'off')}", f"incidents {record.get('incidents', 'off')}"]
        out.append(f"record    {'; '.join(words)}" + (f"; {record['problem']}" if record.get("problem") else ""))
    lead = status.get("lead")
    if lead and lead.get("distance_m") is not None:
        ttc = f", TTC {lead['ttc_s']:.1f} s" if lead.get("ttc_s") is not None else ""
        out.append(f"lead      {lead['distance_m']:.1f} m ± {lead['sigma_m']:.1f}, {lead['range_rate_mps']:+.1f} m/s{ttc}")
    out.append(f"alert     {(status.get('alert') or {}).get('level', 'none')}")
    for alert in status.get("last_alerts") or []:
        ttc = f", TTC {alert['ttc_s']:.1f} s" if alert.get("ttc_s") is not None else ""
        out.append(f"          {alert.get('time', '?')}  {alert.get('level')} ({alert.get('reason')}){ttc}")
    return out


def _n(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "?"
    minutes, s = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {s} s"
