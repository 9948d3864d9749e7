"""The records on a local unix stream socket: one JSON line a frame, a service line a second. It never blocks the decisions.

A thread of its own accepts readers and writes to them; one that does not keep up is dropped. Nothing is read from them.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import selectors
import socket
import threading
from collections import deque
from pathlib import Path
from typing import Any

import msgspec

from tmde_edge.app.records import frame_record
from tmde_edge.errors import DeviceError
from tmde_edge.messages import FrameResult, Sighting

_log = logging.getLogger(__name__)
NAME = "records.sock"
MAX_READERS = 16
READER_BYTES = 1 << 20  # what may wait for one reader: some ten seconds of records
_QUEUE = 256  # lines between the deciding thread and this one
_SOCKET_MODE = 0o660  # the service's own group may read


def default_socket() -> Path | None:
    """Where the service's socket lies: systemd's RuntimeDirectory, else /run/tmde-edge, else the user's own run folder."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given) / NAME
    if os.access("/run/tmde-edge", os.W_OK | os.X_OK):
        return Path("/run/tmde-edge") / NAME
    user = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(user) / "tmde-edge" / NAME if user and os.path.isdir(user) else None


def socket_path(configured: str) -> Path | None:
    """The socket of `[publish] socket`: a path, "auto" for default_socket(), or "" for none."""
    return default_socket() if configured == "auto" else Path(configured) if configured else None


class Publisher:
    """Construct before the loop starts, `frame` and `service` from the deciding thread, `close` at the end."""

    def __init__(self, path: Path) -> None:
        """Listens at `path`. Raises DeviceError where that cannot be."""
        self.path = path
        self.dropped_readers = 0
        self._queue: deque[tuple[FrameResult, Sighting | None] | dict[str, Any]] = deque(maxlen=_QUEUE)
        self._readers: dict[socket.socket, bytearray] = {}
        self._encoder = msgspec.json.Encoder()
        self._server = _listen(path)
        self._inode = path.stat().st_ino
        self._wake_in, self._wake_out = socket.socketpair()
        for s in (self._server, self._wake_in, self._wake_out):
            s.setblocking(False)
        self._closing = False
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)
        self._selector.register(self._wake_out, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="publish", daemon=True)
        self._thread.start()

    @property
    def readers(self) -> int:
        """How many read at the moment."""
        return len(self._readers)

    def frame(self, result: FrameResult, sighting: Sighting | None) -> None:
        """A frame (or that none came) as a record of the contract. Returns at once; costs nothing while nobody reads."""
        self._put((result, sighting))

    def service(self, values: dict[str, Any]) -> None:
        """What the service knows of itself: goes out as {"service": values}."""
        self._put({"service": values})

    def close(self) -> None:
        """Ends all connections and removes the socket."""
        self._closing = True
        self._wake()
        self._thread.join(2.0)
        for s in (*self._readers, self._server, self._wake_in, self._wake_out):
            s.close()
        self._selector.close()
        with contextlib.suppress(OSError):  # unless another service has taken the place meanwhile
            if self.path.stat().st_ino == self._inode:
                self.path.unlink()

    def _put(self, item: tuple[FrameResult, Sighting | None] | dict[str, Any]) -> None:
        if self._readers:
            self._queue.append(item)
            self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):  # it is awake already
            self._wake_in.send(b"\0")

    # -- its own thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._closing:
                for key, events in self._selector.select():
                    sock = key.fileobj
                    assert isinstance(sock, socket.socket)
                    if sock is self._server:
                        self._accept()
                    elif sock is self._wake_out:
                        self._drain()
                    elif sock in self._readers:
                        self._serve(sock, events)
        except Exception:  # the thread's top: without it the service goes on, only nobody can look in
            _log.exception("publishing records stopped")

    def _accept(self) -> None:
        try:
            reader, _ = self._server.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                _log.warning("a reader of the records cannot be let in: %s", error.strerror)
                threading.Event().wait(0.2)  # it stays ready to be accepted: do not spin on it
            return
        if len(self._readers) >= MAX_READERS:
            reader.close()
            return
        reader.setblocking(False)
        self._readers[reader] = bytearray()
        self._selector.register(reader, selectors.EVENT_READ)

    def _drain(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while self._wake_out.recv(4096):
                pass
        while self._queue:
            item = self._queue.popleft()
            record = item if isinstance(item, dict) else frame_record(*item, item[1].timing_ms if item[1] is not None else {})
            line = self._encoder.encode(record) + b"\n"
            for reader, waiting in list(self._readers.items()):
                if len(waiting) + len(line) > READER_BYTES:
                    self.dropped_readers += 1
                    self._end(reader)
                    continue
                waiting += line
                self._write(reader)

    def _serve(self, reader: socket.socket, events: int) -> None:
        if events & selectors.EVENT_READ:
            try:
                if not reader.recv(4096):  # it hung up; what it says is not for us
                    self._end(reader)
                    return
            except BlockingIOError:
                pass
            except OSError:
                self._end(reader)
                return
        if events & selectors.EVENT_WRITE:
            self._write(reader)

    def _write(self, reader: socket.socket) -> None:
        waiting = self._readers[reader]
        try:
            while waiting:
                del waiting[: reader.send(waiting)]
        except BlockingIOError:
            pass
        except OSError:
            self._end(reader)
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if waiting else 0)
        if self._selector.get_key(reader).events != wanted:
            self._selector.modify(reader, wanted)

    def _end(self, reader: socket.socket) -> None:
        self._selector.unregister(reader)
        del self._readers[reader]
        reader.close()


def _listen(path: Path) -> socket.socket:
    """A listening socket; a file left by a service that died is taken over, a living one is not."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                probe.settimeout(1.0)
                alive = probe.connect_ex(str(path)) != errno.ECONNREFUSED
            if alive:
                raise DeviceError(f"publish.socket {path}: another service listens there; name another path")
            path.unlink()
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            server.bind(str(path))
            os.chmod(path, _SOCKET_MODE)
            server.listen(MAX_READERS)
        except OSError:
            server.close()
            raise
    except OSError as error:  # a path too long for a unix socket is one too
        raise DeviceError(f"publish.socket {path}: cannot listen ({error.strerror or error}); name another path") from None
    return server
