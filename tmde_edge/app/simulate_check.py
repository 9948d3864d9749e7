"""`simulate --all --check`: scenarios rendered, run on the desk, and judged against what was expected of them."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from tmde_edge import config
from tmde_edge.adapters.cameras.sources import SourceItem
from tmde_edge.app.can_times import CanTimeline
from tmde_edge.app.desk import DeskOptions, run_desk
from tmde_edge.app.dry_run import dry_run
from tmde_edge.app.records import Record, frame_record
from tmde_edge.app.simulate import Made, Progress, can_frames, config_text, list_scenarios, simulate
from tmde_edge.app.wiring import build_estimation, build_eyes
from tmde_edge.errors import InputMissingError, writing
from tmde_edge.messages import CanFrame, Frame, FrameResult, Tick
from tmde_edge.simulation.check import check
from tmde_edge.simulation.drive import frame_truth, picture
from tmde_edge.simulation.scenario import Expectation, Scenario
from tmde_edge.simulation.scenarios import build
from tmde_edge.simulation.sightings import sightings

T = TypeVar("T")
SETTLED_S = 0.5  # after the first warning nothing more is judged of it


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One scenario with one seed: what is wrong with it, and what happened."""

    name: str
    seed: int
    faults: tuple[str, ...]
    skipped: str = ""  # why it could not be run here
    first_warning_s: float | None = None
    first_warning_ttc_s: float | None = None  # true TTC then, the lead's braking counted
    median_error: float | None = None  # of the lead's distance, relative, all frames that report one


def check_scenarios(
    folder: Path, *, names: Sequence[str] = (), seeds: Sequence[int] = (0,), plate: str | None = None,
    overrides: Sequence[str] = (), keep: bool = False, progress: Progress | None = None,
) -> Iterator[Outcome]:
    """Renders into folder/NAME-SEED and judges, one by one; names empty: all. Without keep only what failed stays."""

    def make(name: str, seed: int) -> Made:
        return simulate(name, folder / f"{name}-{seed}", seed=seed, plate=plate, progress=progress)

    def judged(made: Made) -> Outcome:
        outcome = judge(made, list(desk_records(made, overrides)))
        if not keep and not outcome.faults:
            shutil.rmtree(made.folder)
        return outcome

    return _each(names, seeds, make, judged)


def check_without_video(
    folder: Path, *, names: Sequence[str] = (), seeds: Sequence[int] = (0,), plate: str | None = None,
    overrides: Sequence[str] = (),
) -> Iterator[Outcome]:
    """The same judgement on the rendered pictures themselves, as a camera would give them: no H.264 between, half the work.

    A drive in which only the warning is judged ends SETTLED_S after the first one.
    """

    def judged(scenario: Scenario) -> Outcome:
        made = _without_pictures(scenario, folder)
        records = list(rendered_records(made, overrides))
        if _settled(scenario.expectation, records):  # a run that ended for another reason is judged whole
            made = replace(made, frame_count=len(records), truth=made.truth[: len(records)])
        return judge(made, records)

    return _each(names, seeds, lambda name, seed: build(name, seed=seed, plate=plate), judged)


def check_without_pictures(
    folder: Path, *, names: Sequence[str] = (), seeds: Sequence[int] = (0,), plate: str | None = None,
    overrides: Sequence[str] = (),
) -> Iterator[Outcome]:
    """The same judgement on sightings drawn from the truth (simulation/sightings.py): tracking and warnings, not perception."""

    def judged(scenario: Scenario) -> Outcome:
        made = _without_pictures(scenario, folder)
        return judge(made, list(sighting_records(made, overrides)))

    return _each(names, seeds, lambda name, seed: build(name, seed=seed, plate=plate), judged)


def _each(
    names: Sequence[str], seeds: Sequence[int], make: Callable[[str, int], T], judged: Callable[[T], Outcome]
) -> Iterator[Outcome]:
    """Every scenario (names empty: all) with every seed. Of all, one that needs recordings which are not here is skipped.

    Raises InputMissingError where one that was named needs them.
    """
    for name in names or [name for name, _ in list_scenarios()]:
        for seed in seeds:
            try:
                made = make(name, seed)
            except InputMissingError as error:
                if names:
                    raise
                yield Outcome(name=name, seed=seed, faults=(), skipped=str(error))
                continue
            yield judged(made)


def _without_pictures(scenario: Scenario, folder: Path) -> Made:
    """The scenario's truth, and its configuration in the folder."""
    truth = tuple(frame_truth(scenario, frame) for frame in range(scenario.frame_count))
    made = Made(scenario=scenario, folder=folder, frame_count=len(truth), truth=truth)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        made.config.write_text(config_text(scenario), encoding="utf-8")
    return made


def rendered_records(made: Made, overrides: Sequence[str] = ()) -> Iterator[Record]:
    """The records of a dry run on the pictures as they are rendered."""
    scenario = made.scenario
    loaded = config.load(made.config, overrides)
    run = dry_run(
        RenderedFrames(scenario), build_eyes(loaded, time.perf_counter_ns), build_estimation(loaded, made.folder),
        camera=loaded.camera.camera(), can=_can(scenario), tick_hz=loaded.runtime.tick_hz,
    )  # fmt: skip
    records: list[Record] = []
    for step in run:
        yield step.record
        records.append(step.record)
        if _settled(scenario.expectation, records):
            return


def _settled(wanted: Expectation, records: Sequence[Record]) -> bool:
    """Only the warning is judged, and SETTLED_S have passed since the first one."""
    if not records or wanted.warn_ttc_min_s is None or wanted.max_relative_error is not None:
        return False
    warned_s = next((r["t"] for r in records if "error" not in r and r["alert"]["level"] == "warning"), None)
    return warned_s is not None and bool(records[-1]["t"] >= warned_s + SETTLED_S)


class RenderedFrames:
    """A scenario's pictures as a source of frames, rendered when they are asked for."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario

    @property
    def name(self) -> str:
        """The scenario's."""
        return self._scenario.name

    @property
    def frame_count(self) -> int | None:
        """All of the scenario's."""
        return self._scenario.frame_count

    def __iter__(self) -> Iterator[SourceItem]:
        for index in range(self._scenario.frame_count):
            yield Frame(t_ns=round(index / self._scenario.rate_hz * 1e9), index=index, image=picture(self._scenario, index))


def _can(scenario: Scenario) -> CanTimeline:
    """The scenario's bus on source time."""
    frames = can_frames(scenario)
    return CanTimeline((CanFrame(t_ns=round(t_s * 1e9), can_id=i, data=data, channel="can0") for t_s, i, data in frames), 0.0)


def sighting_records(made: Made, overrides: Sequence[str] = ()) -> Iterator[Record]:
    """The records of an estimation fed with the scenario's CAN frames, ticks and sightings."""
    scenario = made.scenario
    loaded = config.load(made.config, overrides)
    estimation = build_estimation(loaded, made.folder)
    can = _can(scenario)
    tick_ns = round(1e9 / loaded.runtime.tick_hz)
    next_tick_ns = 0
    for sighting in sightings(scenario):
        while next_tick_ns < sighting.t_ns:
            for received in can.until(next_tick_ns):
                estimation.step(received)
            estimation.step(Tick(t_ns=next_tick_ns))
            next_tick_ns += tick_ns
        for received in can.until(sighting.t_ns):
            estimation.step(received)
        result = next(o for o in estimation.step(sighting) if isinstance(o, FrameResult))
        yield frame_record(result, sighting, {})


def desk_records(made: Made, overrides: Sequence[str] = ()) -> Iterator[Record]:
    """The records of a dry run of what `simulate` made."""
    loaded = config.load(made.config, overrides)
    with run_desk(loaded, made.folder, DeskOptions(source=str(made.video), can_log=made.can_log)) as desk:
        yield from desk


def judge(made: Made, records: Sequence[Record]) -> Outcome:
    """Faults of the records, and when the first warning came."""
    scenario = made.scenario
    faults = check(records, made.truth, scenario.expectation)
    pairs = list(zip(records, made.truth, strict=False))
    first = next((t for r, t in pairs if "error" not in r and r["alert"]["level"] == "warning"), None)
    errors = [
        abs(r["lead"]["distance_m"] / t.lead.distance_m - 1.0) for r, t in pairs
        if "error" not in r and t.lead is not None and r["lead"] is not None and r["lead"]["distance_m"] is not None
    ]
    return Outcome(
        name=scenario.name, seed=scenario.seed, faults=tuple(faults),
        first_warning_s=None if first is None else first.t_s,
        first_warning_ttc_s=None if first is None or first.lead is None else first.lead.ttc_braking_s,
        median_error=float(np.median(errors)) if errors else None,
    )
