"""What a track has learned: which standard, and the plate's own proportions (design part 3, item 5).

The sizes of one plate are a Gaussian over log(true / nominal), one per standard. A near frame narrows their ratios (the
height of a character against the plate's height); the overall scale stays as uncertain as the standard leaves it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tmde_edge.messages import PlateColours
from tmde_edge.ranging.bolts import BoltsSay

Floats = NDArray[np.float64]

TOLD = 5  # frames after which what print says of a plate counts in full
LOOK_STEP = 0.15  # log size: by so much grown, a plate's edges fall anew into the pixels and blur matters less


@dataclass(frozen=True, slots=True)
class Sizes:
    """Mean (m,) and covariance (m, m) of log(true size / nominal): glyph classes, plate width, height, pitch."""

    mean: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a track's frames said for each standard, against the standards believed then.

    A plate that stays as large as it is in the image shows the same errors again and again: a thousand frames of it are one look.
    What it shows at another size is another look. looks: mean log evidence and number of frames, by size and standard.
    What is printed on it stays the same at all sizes. printed: the same by kind of print (printed.py) and standard; what is told
    of a followed plate later than in its first frame gains its full weight in a few frames, so that the belief does not jump.
    """

    prior: dict[str, float] = field(default_factory=dict)
    looks: dict[int, dict[str, tuple[float, int]]] = field(default_factory=dict)
    printed: dict[str, dict[str, tuple[float, int]]] = field(default_factory=dict)

    def with_frame(self, size_px: float, gained: dict[str, float], prior: dict[str, float]) -> Evidence:
        """After one more frame; `prior`: of standards that are looked at for the first time."""
        known = {k for look in self.looks.values() for k in look}
        place = int(math.log(max(size_px, 1.0)) // LOOK_STEP)
        fresh = {k: prior[k] for k in gained if k not in known}
        return replace(
            self, prior={**self.prior, **fresh}, looks={**self.looks, place: _with_values(self.looks.get(place, {}), gained)}
        )

    def with_print(self, said: dict[str, dict[str, float]], *, first: bool) -> Evidence:
        """After one more frame's print, by kind and standard; the first frame's counts in full at once."""
        new = {kind: _with_values(self.printed.get(kind, {}), values, TOLD if first else 1) for kind, values in said.items()}
        return replace(self, printed={**self.printed, **new})

    def log_belief(self) -> dict[str, float]:
        """Log probabilities of the standards; {} before the first frame."""
        total = dict(self.prior)
        for look in self.looks.values():
            for k, (mean, _) in look.items():
                total[k] += mean
        for kind in self.printed.values():
            for k, (mean, frames) in kind.items():
                total[k] += mean * min(1.0, frames / TOLD)
        return normalised(total) if total else {}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackScale:
    """One track's memory; immutable. Angles in the vehicle's axes, rad."""

    track_id: int
    t_ns: int
    evidence: Evidence = field(default_factory=Evidence)
    log_offsets: dict[str, float] = field(default_factory=dict)  # each standard's log distance against the mixture's
    sizes: dict[str, Sizes] = field(default_factory=dict)
    yaw_rad: float = 0.0
    yaw_sigma_rad: float = 1.0
    lean_rad: float = 0.0
    lean_sigma_rad: float = 1.0
    roll_rad: float = 0.0
    frames: int = 0
    bolts: dict[str, BoltsSay] = field(default_factory=dict)  # what bolts change, by standard
    colours: PlateColours | None = None  # as last seen
    misfits: int = 0  # frames in a row that contradict what was learned


def _with_values(
    means: dict[str, tuple[float, int]], values: dict[str, float], weight: int = 1
) -> dict[str, tuple[float, int]]:
    """Running means and their numbers of frames after one more of some, which counts as so many."""
    new = dict(means)
    for k, value in values.items():
        mean, frames = new.get(k, (0.0, 0))
        new[k] = mean + (value - mean) * weight / (frames + weight), frames + weight
    return new


def learn(known: Sizes, bias: Floats, fitted_mean: Floats, fitted_covariance: Floats, share: float) -> Sizes:
    """Sizes after one frame whose fit saw `known` blurred by a per-frame bias of covariance `bias` (m, m).

    Only `share` of the frame's information counts: neighbouring frames repeat the same errors. With S known, B the
    bias and C the fit's posterior of the blurred sizes: S' = S - G (S + B - C') G^T, G = S (S + B)^-1, where C' holds
    the shared information, C'^-1 = (S + B)^-1 + share (C^-1 - (S + B)^-1).
    """
    blurred = known.covariance + bias
    before = np.linalg.inv(blurred)
    # A frame whose fit was widened (residuals larger than stated) may know less than we do; it never takes knowledge away,
    # or the sizes would drift out of their legal tolerance. Whitened, every direction keeps at least the information 1.
    root = np.linalg.cholesky(blurred)
    worth, axes = np.linalg.eigh(root.T @ np.linalg.inv(fitted_covariance) @ root)
    extra = np.maximum(worth - 1.0, 0.0)
    back = np.linalg.inv(root).T @ axes
    gained = (back * extra) @ back.T
    after = np.linalg.inv(before + share * gained)
    # Directions without a gain say nothing new; in the others solve C^-1 m = before m0 + gained z for gained z.
    told = np.where(extra > 0, worth / np.maximum(extra, 1e-12), 0.0)
    pull = gained @ known.mean + (back * (extra * told)) @ back.T @ (fitted_mean - known.mean)
    mean = after @ (before @ known.mean + share * pull)
    gain = known.covariance @ before
    covariance = known.covariance - gain @ (blurred - after) @ gain.T
    return Sizes(known.mean + gain @ (mean - known.mean), (covariance + covariance.T) / 2)


def normalised(log_belief: dict[str, float], floor: float = -12.0) -> dict[str, float]:
    """Log probabilities that sum to one; nothing falls so low that it could not come back."""
    best = max(log_belief.values())
    kept = {k: max(v - best, floor) for k, v in log_belief.items()}
    norm = math.log(sum(math.exp(v) for v in kept.values()))
    return {k: v - norm for k, v in kept.items()}
