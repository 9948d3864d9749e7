"""Is a tracked plate still seen, or something dark in its place? A covered plate keeps an outline, and its reader finds
"characters" in noise; what gives it away is that characters that were sure are all unsure at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tmde_edge.messages import PlateSighting

TAU_S = 4.0  # how fast a track's usual sureness follows: a change that lasts is a change of light, not a cover
SURE = 0.6  # mean score of characters that are read with ease
UNSURE_SHARE = 0.6  # below this share of the usual ...
UNSURE = 0.45  # ... and below this, nothing is read
LASTS_S = 1.0  # so long a cover is believed in without characters that say so: one bad reading must not end a plate


@dataclass(slots=True)
class _Usual:
    score: float
    t_ns: int
    odd: bool = False  # the last sighting with characters was of a cover


class CoverCheck:
    """One object for all tracks; feed it every sighting in time order."""

    def __init__(self) -> None:
        self._usual: dict[int, _Usual] = {}

    def covered(self, plate: PlateSighting, t_ns: int) -> bool:
        """True where this sighting should not be measured. One without characters is for a while as the last one with some."""
        usual = self._usual.get(plate.track_id)
        if not plate.glyphs:
            return usual is not None and usual.odd and (t_ns - usual.t_ns) * 1e-9 <= LASTS_S
        score = math.fsum(g.score for g in plate.glyphs) / len(plate.glyphs)
        if usual is None:
            self._usual[plate.track_id] = _Usual(score, t_ns)
            return False
        keep = math.exp(-max(t_ns - usual.t_ns, 0) * 1e-9 / TAU_S)
        usual.odd = usual.score >= SURE and score < UNSURE and score < UNSURE_SHARE * usual.score
        usual.score, usual.t_ns = score + keep * (usual.score - score), t_ns
        return usual.odd

    def keep(self, tracks: set[int]) -> None:
        """Forgets all other tracks."""
        self._usual = {k: v for k, v in self._usual.items() if k in tracks}
