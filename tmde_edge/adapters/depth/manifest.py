"""What is known of each depth network: origin, checksum, licence and graph contract; and the folder they lie in."""

from __future__ import annotations

import difflib
import hashlib
import os
import sys
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from tmde_edge.errors import ModelError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

INSTALLED_STATE = Path("/var/lib/tmde-edge")
PACKAGED = Path(__file__).resolve().parents[2] / "models" / "manifest.toml"
SIDECAR_SUFFIX = ".toml"  # beside an .onnx file that is in no manifest: its contract
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


class ModelSpec(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One network: where it comes from and how its graph is to be fed."""

    name: str
    file: str  # its name in the models folder
    url: str = ""  # "": made here (int8) or brought by the user
    sha256: Sha256 | None = None
    bytes: Annotated[int, Meta(ge=0)] = 0  # 0: not known
    licence: str = ""
    input: str = "0"
    output: str = "797"
    width_px: Annotated[int, Meta(ge=32)] = 256
    height_px: Annotated[int, Meta(ge=32)] = 256
    normalisation: Literal["inside", "imagenet", "none"] = "inside"  # where mean and std are applied
    kind: Literal["inverse", "metric"] = "inverse"  # bigger is nearer, or metres
    base: str = ""  # of an int8 model: the name it was made from
    note: str = ""


class Manifest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The file: an array of tables `[[model]]`."""

    model: list[ModelSpec] = []


def models_folder(configured: str = "") -> Path:
    """The configured folder, else the service's (as systemd names it, or as installed and open to us), else the user's own."""
    if configured:
        return Path(configured).expanduser()
    state = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if state:
        return Path(state) / "models"
    if os.access(INSTALLED_STATE, os.R_OK | os.X_OK):
        return INSTALLED_STATE / "models"
    home = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return Path(home).expanduser() / "tmde-edge" / "models"


def known_models(folder: Path) -> dict[str, ModelSpec]:
    """The packaged manifest, and what lies in the folder with a contract beside it. Raises ModelError."""
    specs = {spec.name: spec for spec in _read_manifest(PACKAGED).model}
    if folder.is_dir():
        for sidecar in sorted(folder.glob("*.onnx" + SIDECAR_SUFFIX)):
            spec = _read_spec(sidecar)
            specs[spec.name] = spec
    return specs


def find_model(name_or_path: str, folder: Path) -> tuple[ModelSpec, Path]:
    """The network of `depth.model`: a known name, or the path of an .onnx file. Raises ModelError."""
    if name_or_path.endswith(".onnx") or "/" in name_or_path:
        path = Path(name_or_path).expanduser()
        sidecar = path.with_name(path.name + SIDECAR_SUFFIX)
        spec = _read_spec(sidecar) if sidecar.is_file() else ModelSpec(name=path.stem, file=path.name)
        return spec, path
    specs = known_models(folder)
    if name_or_path not in specs:
        near = difflib.get_close_matches(name_or_path, specs, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(specs)}"
        raise ModelError(f"model {name_or_path!r} is not known; {hint}")
    spec = specs[name_or_path]
    return spec, folder / spec.file


def write_sidecar(spec: ModelSpec, model_path: Path) -> None:
    """Writes the contract beside a model file."""
    path = model_path.with_name(model_path.name + SIDECAR_SUFFIX)
    part = path.with_name(path.name + ".part")
    lines = [f"{key} = {_toml(value)}" for key, value in msgspec.to_builtins(spec).items() if value is not None]
    part.write_text("\n".join(lines) + "\n", encoding="utf-8")
    os.replace(part, path)


def sha256_of(path: Path) -> str:
    """Hex SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as f:
        while block := f.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _toml(value: object) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return str(value)


def _read_manifest(path: Path) -> Manifest:
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Manifest)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, msgspec.ValidationError) as e:
        raise ModelError(f"{path}: the list of models cannot be read ({e}); install the package again") from None


def _read_spec(path: Path) -> ModelSpec:
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), ModelSpec)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, msgspec.ValidationError) as e:
        raise ModelError(f"{path}: not a model's contract ({e}); correct or remove it") from None
