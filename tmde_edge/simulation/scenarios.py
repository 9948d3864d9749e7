"""The registry of scenarios: name -> a builder from a seed; `Look` holds what the seed decides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tmde_edge.errors import UsageError
from tmde_edge.simulation.camera import SimCamera, hd_camera
from tmde_edge.simulation.ground import Marking, RoadStyle
from tmde_edge.simulation.scenario import Expectation, Prop, Scenario
from tmde_edge.simulation.standard_face import StandardFace, standard_face
from tmde_edge.simulation.stills import COLOURS, TWO_LANES
from tmde_edge.simulation.vehicle import Body
from tmde_edge.simulation.world import Motion

Builder = Callable[["Look"], Scenario]
_REGISTRY: dict[str, tuple[str, Builder]] = {}

_USUAL_MM = 520.0  # the width of the plates for which the scenarios state their bars
BUMPER_M = 1.5  # from the lens to the own front bumper


@dataclass(slots=True)
class Look:
    """What a seed decides: colours, bodies, skylines, small changes of speed; and the plate standard."""

    seed: int
    plate: str | None
    name: str

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng((self.seed, *self.name.encode()))

    rng: np.random.Generator = None  # type: ignore[assignment]

    def near(self, value: float, relative: float) -> float:
        """A value within +-relative of this one; the nominal value for seed 0."""
        draw = float(self.rng.uniform(-relative, relative))
        return value if self.seed == 0 else value * (1.0 + draw)

    def face(self, standard: str = "de-mittel", text: str | None = None) -> StandardFace:
        """A plate of the scenario's standard, or of the one asked for."""
        return standard_face(self.plate or standard, None if self.plate else text)

    def body(self, *kinds: str) -> Body:
        """A body of one of these kinds in some colour."""
        kind = str(self.rng.choice(list(kinds or ("hatch", "sedan", "suv"))))
        b, g, r = COLOURS[int(self.rng.integers(len(COLOURS)))]
        return Body(kind=kind, colour_bgr=(float(b), float(g), float(r)), plate_up_m=float(self.rng.uniform(0.74, 0.9)))

    def road(self, skyline: str | None = None, sky: str | None = None, **more: object) -> RoadStyle:
        """A two-lane road."""
        line = skyline or str(self.rng.choice(["trees", "town", "hills"]))
        return RoadStyle(
            markings=TWO_LANES, skyline=line, kerb=line == "town", sky=sky or str(self.rng.choice(["day", "overcast"])),
            seed=int(self.rng.integers(4)), **more,  # type: ignore[arg-type]
        )

    def props(self, style: RoadStyle, length_m: float) -> tuple[Prop, ...]:
        """Trees, houses, posts and signs along a road."""
        out: list[Prop] = []
        for s in np.arange(10.0, length_m + 200.0, 11.0):
            for side in (-1.0, 1.0):
                if self.rng.random() > 0.65:
                    continue
                kind = "house" if style.skyline == "town" and self.rng.random() < 0.6 else "tree"
                edge = style.right_m if side > 0 else -style.left_m
                lateral = side * (edge + self.rng.uniform(3.0, 8.0) + (6.0 if kind == "house" else 0.0))
                out.append(Prop(kind=kind, variant=int(self.rng.integers(8)), s_m=float(s), lateral_m=float(lateral)))
        for s in np.arange(15.0, length_m + 150.0, 25.0):
            out.append(Prop(kind="post", variant=0, s_m=float(s), lateral_m=style.right_m + 0.8))
            out.append(Prop(kind="post", variant=0, s_m=float(s), lateral_m=style.left_m - 0.8))
        for s in np.arange(45.0, length_m + 100.0, 90.0):
            out.append(Prop(kind="sign", variant=int(self.rng.integers(9)), s_m=float(s), lateral_m=style.right_m + 1.4))
        return tuple(out)


def scenario(name: str, text: str) -> Callable[[Builder], Builder]:
    """Registers a builder."""

    def keep(build: Builder) -> Builder:
        _REGISTRY[name] = (text, build)
        return build

    return keep


def names() -> list[tuple[str, str]]:
    """(name, one line) of every scenario, in order of registration."""
    _load()
    return [(name, text) for name, (text, _) in _REGISTRY.items()]


def build(name: str, *, seed: int = 0, plate: str | None = None) -> Scenario:
    """The scenario of this name. Raises UsageError naming the known ones."""
    _load()
    if name not in _REGISTRY:
        raise UsageError(f"scenario {name!r}: unknown; there are {', '.join(_REGISTRY)}")
    made = _REGISTRY[name][1](Look(seed, plate, name))
    if plate is None:
        return made
    # a narrower plate is judged from the same distance on
    wide_px = made.expectation.wide_px * standard_face(plate).spec.width_mm / _USUAL_MM
    return replace(made, expectation=replace(made.expectation, wide_px=wide_px))


def _load() -> None:
    """The scenarios register themselves when their modules are imported."""
    from tmde_edge.simulation import scenarios_traffic, scenarios_warning  # noqa: F401


def car_camera() -> SimCamera:
    """A usual dash camera: 1280x720, f 1400 px, 1.3 m up, 1.5 m behind the bumper, pitched down by a degree."""
    return hd_camera(height_m=1.3, to_bumper_m=BUMPER_M, pitch_rad=0.02)


def base(look: Look, text_name: str, *, duration_s: float, ego: Motion, **more: object) -> Scenario:
    """A scenario with the usual camera, a two-lane road with scenery, and sensor offsets by the seed."""
    style = more.pop("style", None) or look.road()
    assert isinstance(style, RoadStyle)
    length = ego.state(duration_s)[0]
    values: dict[str, object] = {
        "camera": car_camera(), "props": look.props(style, length), "expect": (look.plate or "de-mittel",),
        "yaw_offset_radps": float(np.radians(look.rng.uniform(-0.15, 0.15))), "seed": look.seed,
    }
    values.update(more)
    return Scenario(
        name=text_name, text=_REGISTRY[text_name][0], duration_s=duration_s, ego=ego, style=style,
        **values,  # type: ignore[arg-type]
    )


__all__ = ["BUMPER_M", "Expectation", "Look", "Marking", "base", "build", "car_camera", "names", "scenario"]
