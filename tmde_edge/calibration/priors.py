"""What known cameras should have as focal length, until they are calibrated: sensor, lens and readout as data."""

from __future__ import annotations

import difflib
from functools import lru_cache
from importlib import resources

import msgspec

from tmde_edge.errors import ConfigError

PRIOR_SIGMA = 0.05  # relative: lenses of one type, focus, the readout of a mode


class Mode(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An image size that is read from a part of the sensor: `columns` of it give the image's width."""

    width_px: int
    height_px: int
    columns: int


class CameraPrior(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One camera: sensor size in pixels, and either pixel pitch (and lens) or the focal length of the whole sensor."""

    name: str
    columns: int
    rows: int
    pixel_um: float | None = None
    lens_mm: float | None = None  # None: exchangeable
    fx_px: float | None = None
    note: str = ""
    mode: tuple[Mode, ...] = ()

    def focal_px(self, width_px: int, height_px: int, lens_mm: float | None = None) -> float:
        """Focal length of an image of this size: its known mode, else the sensor's whole width (or height where narrower).

        Raises ConfigError without a lens.
        """
        lens = lens_mm if lens_mm is not None else self.lens_mm
        whole = self.fx_px
        if self.pixel_um is not None and lens is not None:
            whole = 1000 * lens / self.pixel_um
        if whole is None:
            raise ConfigError(f"{self.name} has no lens of its own: give its focal length, --lens-mm (camera.lens_mm)")
        if self.pixel_um is None and lens_mm is not None:
            raise ConfigError(f"{self.name} has a fixed lens: leave --lens-mm (camera.lens_mm) out")
        for mode in self.mode:
            if (mode.width_px, mode.height_px) == (width_px, height_px):
                return whole * width_px / mode.columns
        return whole * max(width_px / self.columns, height_px / self.rows)


@lru_cache(maxsize=1)
def camera_priors() -> dict[str, CameraPrior]:
    """Every known camera by name."""
    folder = resources.files("tmde_edge.calibration") / "data"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {f.name[:-5]: msgspec.toml.decode(f.read_text(encoding="utf-8"), type=CameraPrior) for f in files}


def camera_prior(name: str) -> CameraPrior:
    """One camera. Raises ConfigError that names the nearest known one."""
    known = camera_priors()
    if name not in known:
        near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        raise ConfigError(f"unknown camera {name!r}; {hint}")
    return known[name]
