"""`tmde-edge shadow-report`: what would have been said, how often per 100 km and per hour, and what the driver did then.

Every warning that the driver did not answer by braking is a candidate for a false alarm; people look at the pictures and decide.
"""

from __future__ import annotations

import base64
import html
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tmde_edge.app.incident import incident_folders, warnings_of
from tmde_edge.app.odometer import Watched, read_odometer, read_verdicts
from tmde_edge.app.ring import readable
from tmde_edge.errors import InputMissingError

Json = dict[str, Any]
_Z = 1.96  # of a 95 % interval
_FIELDS = ("time", "level", "reason", "ttc_s", "speed_mps", "verdict", "why", "braking_mps2", "brake_pressed", "min_ttc_s",
           "min_distance_m", "transmitted", "complete", "faults", "note")  # fmt: skip


@dataclass(slots=True)
class ShadowReport:
    """Sums, and the incidents with their evidence."""

    folder: Path
    watched: Watched = field(default_factory=Watched)
    incidents: list[tuple[Path, Json]] = field(default_factory=list)
    judged: dict[str, tuple[str, int]] = field(default_factory=dict)  # verdict and warnings by incident, kept or not

    @property
    def candidates(self) -> int:
        """Warnings that the driver did not answer; those that followed one another in one incident are all counted."""
        return sum(warnings for verdict, warnings in self.judged.values() if verdict == "candidate")

    @property
    def not_judged(self) -> int:
        """Warnings of which nobody knows what the driver did: a power cut, a full disk, an incident of an old version."""
        return max(self.watched.began("warning") - sum(warnings for _, warnings in self.judged.values()), 0)


def read_shadow(folder: Path) -> ShadowReport:
    """Reads a recording folder. Raises InputMissingError where there is nothing to report on."""
    report = ShadowReport(readable(folder))
    for _, watched in read_odometer(folder):
        report.watched.add(watched)
    for path in incident_folders(folder):
        try:
            info = json.loads((path / "incident.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):  # torn by a power cut: the rest of the folder still tells
            info = {"level": path.name.rsplit("-", 1)[-1], "time": path.name[7:23], "complete": False}
        if isinstance(info, dict):
            report.incidents.append((path, info))
            if info.get("verdict"):
                report.judged[path.name] = info["verdict"], warnings_of(info)
    report.judged |= read_verdicts(folder)
    if report.watched.watched_s == 0 and not report.incidents:
        raise InputMissingError(f"{folder}: nothing was watched yet; set record.shadow = true and let the service run")
    return report


def rate(count: int, exposure: float) -> Json | None:
    """A rate with its 95 % interval (Poisson; Byar's approximation, Breslow and Day 1987, p. 69); None without exposure."""
    if exposure <= 0:
        return None
    low = count * (1 - 1 / (9 * count) - _Z / (3 * math.sqrt(count))) ** 3 if count else 0.0
    more = count + 1
    high = more * (1 - 1 / (9 * more) + _Z / (3 * math.sqrt(more))) ** 3
    return {"rate": round(count / exposure, 4), "low": round(low / exposure, 4), "high": round(high / exposure, 4)}


def _candidates(report: ShadowReport, exposure: float) -> Json | None:
    """As `rate`; where warnings were not judged no rate, and an interval from none of them counted to all."""
    least, most = rate(report.candidates, exposure), rate(report.candidates + report.not_judged, exposure)
    if least is None or most is None or report.not_judged == 0:
        return least
    return {"rate": None, "low": least["low"], "high": most["high"]}


def _rates(report: ShadowReport, exposure: float) -> dict[str, Json | None]:
    w = report.watched
    return {
        "cautions": rate(w.began("caution"), exposure), "warnings": rate(w.began("warning"), exposure),
        "false_alarm_candidates": _candidates(report, exposure),
    }  # fmt: skip


def as_json(report: ShadowReport) -> Json:
    """Everything as one object."""
    w = report.watched
    hundred_km, hours = w.distance_m / 100_000, w.watched_s / 3600
    counts = {
        "cautions": w.began("caution"), "warnings": w.began("warning"), "false_alarm_candidates": report.candidates,
    }  # fmt: skip
    return {
        "folder": str(report.folder),
        "hours": round(hours, 4), "moving_hours": round(w.moving_s / 3600, 4), "distance_km": round(w.distance_m / 1000, 3),
        "speed_known": round(w.speed_known_s / w.watched_s, 4) if w.watched_s else None,
        "blind": round(w.blind_s / w.watched_s, 4) if w.watched_s else None,
        "with_lead": round(w.lead_s / w.watched_s, 4) if w.watched_s else None,
        "counts": counts, "warnings_not_judged": report.not_judged, "by_reason": dict(sorted(w.alerts.items())),
        "per_100_km": _rates(report, hundred_km), "per_hour": _rates(report, hours),
        "incidents": [{"folder": path.name, **{k: info.get(k) for k in _FIELDS}} for path, info in report.incidents],
    }  # fmt: skip


def lines_of(report: ShadowReport) -> list[str]:
    """For the terminal."""
    j = as_json(report)
    out = [
        f"watched {j['hours']:.2f} h ({j['moving_hours']:.2f} h moving), {j['distance_km']:.1f} km; "
        f"blind {_percent(j['blind'])}, a lead in sight {_percent(j['with_lead'])} of the time"
    ]
    if j["speed_known"] is not None and j["speed_known"] < 0.95:
        out.append(f"speed was known {_percent(j['speed_known'])} of the time only: rates per 100 km stand on that part")
    for name, text in (("warnings", "warnings"), ("false_alarm_candidates", "  not answered"), ("cautions", "cautions")):
        rates = f"per 100 km {_rate(j['per_100_km'][name])}   per hour {_rate(j['per_hour'][name])}"
        out.append(f"{text:15} {j['counts'][name]:5}   {rates}")
    if report.not_judged:
        out.append(_missing(report))
    for path, info in report.incidents:
        ttc = f"TTC {info['ttc_s']:.1f} s" if isinstance(info.get("ttc_s"), (int, float)) else ""
        why = "; ".join(info.get("why") or [])
        out.append(f"{path.name}  {info.get('reason') or '':12} {ttc:10} {info.get('verdict') or 'not judged'}: {why}")
    return out


def write_html(report: ShadowReport, path: Path) -> None:
    """One page that needs nothing else: rates, and every incident with its three pictures. Raises OSError."""
    j = as_json(report)
    rows = "".join(
        f"<tr><td>{text}<td>{j['counts'][name]}<td>{_rate(j['per_100_km'][name])}<td>{_rate(j['per_hour'][name])}"
        for name, text in (("warnings", "Warnings"), ("false_alarm_candidates", "of these not answered by braking"),
                           ("cautions", "Cautions"))
    )  # fmt: skip
    reasons = ", ".join(f"{html.escape(k)}: {n}" for k, n in j["by_reason"].items()) or "none"
    order = sorted(report.incidents, key=lambda x: (x[1].get("verdict") != "candidate", x[0].name))
    cards = "".join(_card(p, i) for p, i in order)
    path.write_text(
        _PAGE.format(
            folder=html.escape(str(report.folder)), hours=f"{j['hours']:.2f}", moving=f"{j['moving_hours']:.2f}",
            km=f"{j['distance_km']:.1f}", blind=_percent(j["blind"]), lead=_percent(j["with_lead"]), rows=rows, reasons=reasons,
            missing=f"<p>{_missing(report)}." if report.not_judged else "", cards=cards or "<p>No warning left evidence.",
        ),
        encoding="utf-8",
    )  # fmt: skip


def _card(path: Path, info: Json) -> str:
    pictures = ""
    for name, text in (("before", "1 s before"), ("alert", "at the warning"), ("after", "1 s after")):
        try:
            data = base64.b64encode((path / f"{name}.jpg").read_bytes()).decode()
        except OSError:
            continue
        pictures += f'<figure><img alt="{text}" src="data:image/jpeg;base64,{data}"><figcaption>{text}</figcaption></figure>'
    verdict = info.get("verdict") or "not judged"
    facts = [f"reason {info.get('reason') or '-'}"]
    for key, text in (("ttc_s", "TTC {:.1f} s"), ("speed_mps", "speed {:.1f} m/s"), ("min_ttc_s", "least TTC {:.1f} s"),
                      ("braking_mps2", "hardest braking {:.1f} m/s²")):  # fmt: skip
        if isinstance(info.get(key), (int, float)):
            facts.append(text.format(info[key]))
    why = html.escape("; ".join(info.get("why") or []))
    kind = "candidate" if verdict == "candidate" else "other"
    return (
        f'<section class="{kind}"><h2>{html.escape(path.name)} <small>{html.escape(verdict)}</small></h2>'
        f"<p>{html.escape(', '.join(facts))}<br>{why}</p><div class=row>{pictures}</div></section>"
    )


def _missing(report: ShadowReport) -> str:
    return f"{report.not_judged} of the warnings were not judged (their seconds are lost): an interval instead of a rate"


def _rate(value: Json | None) -> str:
    if value is None:
        return "-"
    likely = f"{value['rate']:.2f} " if value["rate"] is not None else ""
    return f"{likely}({value['low']:.2f} to {value['high']:.2f})"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


_PAGE = """<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content="width=device-width, initial-scale=1">
<title>Shadow report</title><style>
body {{ font: 16px/1.45 system-ui, sans-serif; margin: 1rem auto; max-width: 70rem; padding: 0 1rem; color: #1c2126 }}
table {{ border-collapse: collapse }}
td, th {{ padding: .3rem .8rem .3rem 0; text-align: left; border-bottom: 1px solid #d5dade }}
section {{ border-left: 4px solid #9aa4ad; padding-left: .8rem; margin: 1.5rem 0 }} .candidate {{ border-color: #c62828 }}
h2 {{ font-size: 1.05rem; margin: 0; overflow-wrap: anywhere }} small {{ font-weight: normal; color: #59636c }}
.row {{ display: flex; flex-wrap: wrap; gap: .5rem }} figure {{ margin: 0; flex: 1 1 16rem; max-width: 32rem }}
img {{ width: 100%; height: auto; display: block }} figcaption {{ font-size: .85rem; color: #59636c }}
</style><h1>What would have been said</h1>
<p>{folder}: watched {hours} h ({moving} h moving), {km} km; blind {blind}, a lead in sight {lead} of the time.
<table><tr><th><th>count<th>per 100 km (95 %)<th>per hour (95 %)</tr>{rows}</table>
<p>By reason: {reasons}. A warning that the driver did not answer by braking is a candidate for a false alarm; whether it was one,
the pictures show. Plates in them are unreadable on purpose.
{missing}{cards}</html>
"""
