"""The verb `models`: list, fetch and verify the depth networks. Returns results and raises errors; prints nothing.

Quantizing lies in quantize.py. Nothing here runs unless the user asked for it: the service itself never goes online.
"""

from __future__ import annotations

import errno
import fcntl
import http.client
import os
import shutil
import socket
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

from tmde_edge.adapters.depth.manifest import ModelSpec, find_model, known_models, sha256_of
from tmde_edge.adapters.depth.onnx_depth import OnnxDepth
from tmde_edge.errors import InputMissingError, ModelError

Progress = Callable[[int, int], None]  # bytes so far, bytes in all (0: not known)
TIMEOUT_S = 30.0
BLOCK = 1 << 18


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelState:
    """One line of `models list` and `models verify`."""

    spec: ModelSpec
    path: Path
    state: Literal["present", "missing", "broken"]
    bytes: int = 0
    detail: str = ""  # why it is broken, or the execution providers it would run on


@dataclass(frozen=True, slots=True, kw_only=True)
class Fetched:
    """What a fetch did."""

    spec: ModelSpec
    path: Path
    bytes: int
    resumed_from: int = 0
    already_there: bool = False


def list_models(folder: Path) -> list[ModelState]:
    """All known networks and whether their files are there (sizes only; `verify` reads them). Raises ModelError."""
    states = []
    for spec in known_models(folder).values():
        path = folder / spec.file
        if not path.is_file():
            states.append(ModelState(spec=spec, path=path, state="missing"))
            continue
        size = path.stat().st_size
        wrong = bool(spec.bytes) and size != spec.bytes
        detail = f"{size} bytes instead of {spec.bytes}" if wrong else ""
        states.append(ModelState(spec=spec, path=path, state="broken" if wrong else "present", bytes=size, detail=detail))
    return states


def verify_models(folder: Path, names: list[str] | None = None) -> list[ModelState]:
    """Checksum and graph contract of the named networks (default: those that are there). Raises ModelError (name)."""
    states = []
    specs = known_models(folder)
    wanted = names if names else [n for n, s in specs.items() if (folder / s.file).is_file()]
    for name in wanted:
        spec, path = find_model(name, folder)
        if not path.is_file():
            states.append(ModelState(spec=spec, path=path, state="missing", detail=f"{path} is not there"))
            continue
        size = path.stat().st_size
        try:
            providers = OnnxDepth(spec, path).providers
        except ModelError as error:
            states.append(ModelState(spec=spec, path=path, state="broken", bytes=size, detail=str(error)))
        else:
            states.append(ModelState(spec=spec, path=path, state="present", bytes=size, detail=", ".join(providers)))
    return states


def fetch_model(
    name: str, folder: Path, *, from_file: Path | None = None, progress: Progress | None = None, url: str | None = None
) -> Fetched:
    """Brings one network into the folder, whole and right or not at all; an older file stays until then.

    `url` overrides the manifest's (a mirror); the checksum does not change with it. A cut download is kept as FILE.part and
    goes on with the next call. Raises ModelError, InputMissingError (from_file).
    """
    spec, path = find_model(name, folder)
    if path.parent != folder:
        raise ModelError(f"model {name!r} is a file of yours: nothing to fetch; known: {', '.join(known_models(folder))}")
    if path.is_file() and spec.sha256 is not None and sha256_of(path) == spec.sha256:
        return Fetched(spec=spec, path=path, bytes=path.stat().st_size, already_there=True)
    source = url or spec.url
    if from_file is None and not source:
        raise ModelError(f"model {name}: was made on this machine and has no address; run `tmde-edge models quantize` again")
    if from_file is not None and not from_file.is_file():
        raise InputMissingError(f"--from {from_file}: no such file")
    part = path.with_name(path.name + ".part")
    with _place_errors(folder, spec.bytes):
        folder.mkdir(parents=True, exist_ok=True)
        with part.open("ab") as out:
            _lock(out, part)
            if from_file is not None:
                resumed = 0
                _copy(from_file, out, progress)
            else:
                resumed = _download(source, spec, part, out, progress)
                out.flush()
                if resumed and spec.sha256 is not None and sha256_of(part) != spec.sha256:
                    out.truncate(0)  # the kept piece was of another file: once more from the start
                    resumed = _download(source, spec, part, out, progress)
            out.flush()
            os.fsync(out.fileno())
        _check(spec, part, from_file or source)
        os.replace(part, path)
        _sync_folder(folder)
    return Fetched(spec=spec, path=path, bytes=path.stat().st_size, resumed_from=resumed)


def _check(spec: ModelSpec, part: Path, source: Path | str) -> None:
    """Raises ModelError and removes the file where it is not what the manifest says."""
    found, size = sha256_of(part), part.stat().st_size
    if spec.sha256 is None or found == spec.sha256:
        return
    with part.open("rb") as f:
        head = f.read(64)
    what = "a web page" if head.lstrip()[:1] == b"<" else "a Git LFS pointer" if head.startswith(b"version https:") else "a file"
    part.unlink()
    raise ModelError(
        f"{source}: gave {what} of {size} bytes with SHA-256 {found}; {spec.name} has {spec.bytes} bytes and {spec.sha256}; "
        "nothing was installed"
    )


def _copy(source: Path, out: IO[bytes], progress: Progress | None) -> None:
    out.truncate(0)
    total, done = source.stat().st_size, 0
    try:
        with source.open("rb") as f:
            while block := f.read(BLOCK):
                out.write(block)
                done += len(block)
                if progress is not None:
                    progress(done, total)
        out.flush()
    except OSError:
        out.truncate(0)  # half a copy is no start for a download
        raise


def _download(url: str, spec: ModelSpec, part: Path, out: IO[bytes], progress: Progress | None) -> int:
    """Appends what is missing to the part file; returns where it went on. Raises ModelError."""
    start = part.stat().st_size
    if spec.bytes and start >= spec.bytes:  # whole or too long: what it is decides the checksum
        if start == spec.bytes and sha256_of(part) == spec.sha256:
            return start
        out.truncate(0)
        start = 0
    with _network_errors(url, part):
        request = urllib.request.Request(url, headers={"User-Agent": "tmde-edge", "Accept-Encoding": "identity"})
        if start:
            request.add_header("Range", f"bytes={start}-")
        try:
            response = urllib.request.urlopen(request, timeout=TIMEOUT_S)
        except urllib.error.HTTPError as error:
            if error.code != 416 or not start:
                raise
            out.truncate(0)  # the part does not belong to what lies there now
            return _download(url, spec, part, out, progress)
        with response:
            if response.status != 206 or not str(response.headers.get("Content-Range", "")).startswith(f"bytes {start}-"):
                out.truncate(0)
                start = 0
            done = start
            length = response.headers.get("Content-Length")
            total = start + int(length) if length and length.isdigit() else spec.bytes
            while block := response.read(BLOCK):
                done += len(block)
                if spec.bytes and done > spec.bytes:
                    out.truncate(0)
                    raise ModelError(f"{url}: sends more than the {spec.bytes} bytes of {spec.name}; another file lies there now")
                out.write(block)
                if progress is not None:
                    progress(done, total)
            if total and done < total:
                raise http.client.IncompleteRead(b"", total - done)
    return start


def _lock(out: IO[bytes], part: Path) -> None:
    try:
        fcntl.flock(out, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ModelError(f"{part}: another fetch is writing it; wait for that one") from None


@contextmanager
def _network_errors(url: str, part: Path) -> Iterator[None]:
    """What can go wrong on the way, as one line that says what to do."""
    try:
        yield
    except urllib.error.HTTPError as e:
        raise ModelError(f"{url}: the server says {e.code} {e.reason}; get the file elsewhere and use --from FILE") from None
    except (http.client.IncompleteRead, ConnectionResetError, BrokenPipeError, TimeoutError) as e:
        kept = part.stat().st_size if part.exists() else 0
        why = "too slow" if isinstance(e, TimeoutError) else "the connection was cut"
        raise ModelError(f"{url}: {why} after {kept} bytes, which are kept; run the same command again to go on") from None
    except urllib.error.URLError as e:
        reason = e.reason.strerror if isinstance(e.reason, OSError) and e.reason.strerror else e.reason
        raise ModelError(f"{url}: cannot be reached ({reason}); without a network bring the file and use --from FILE") from None
    except (http.client.HTTPException, socket.gaierror, ValueError) as e:
        raise ModelError(f"{url}: no usable answer ({e}); use --from FILE") from None


@contextmanager
def _place_errors(folder: Path, needed: int) -> Iterator[None]:
    """Full, read-only or forbidden folders, as one line; what was there stays."""
    try:
        yield
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.EDQUOT):
            free = shutil.disk_usage(folder).free if folder.exists() else 0
            why = f"the disk is full ({free} bytes free, {needed} needed); the old file is untouched"
            raise ModelError(f"{folder}: {why}") from None
        if e.errno in (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST):
            why = f"cannot be written ({e.strerror}); run as the service's user or set depth.folder"
            raise ModelError(f"{folder}: {why}") from None
        raise ModelError(f"{folder}: {e.strerror or e}") from None


def _sync_folder(folder: Path) -> None:
    """The new name survives a power cut."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)

