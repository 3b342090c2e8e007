"""Three small bodies in wind: what of them is run, and how a run is judged apart from what the package says of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import to_cloud, tube
from gaussian_swaying.scenes.procedural import ProceduralScene

SIZE = 0.4
"""Longest side of each body [m]."""


@dataclass(eq=False)
class RodScene(ProceduralScene):
    """An upright tube from the origin.

    Units: ``length``, ``radius``, ``spacing`` [m].
    """

    length: float = SIZE
    radius: float = 0.01
    spacing: float = 0.005

    def __post_init__(self) -> None:
        self.check("length", "radius", coarsest=0.5 * self.length)

    def generate(self) -> GaussianCloud:
        """Make the tube."""
        return to_cloud(tube([[0.0, 0.0, 0.0], [0.0, 0.0, self.length]], [self.radius, self.radius], self.spacing))


@dataclass(frozen=True)
class Body:
    """A body of the map.

    Attributes:
        scene: Its scene, as in a configuration.
        held: Upper corner of the region that is held [m], with null where it has no end.
        sizes: Grid spacings [m], from coarse to fine; the last is the reference of the others.
    """

    scene: dict[str, Any]
    held: tuple[float | None, float | None, float | None]
    sizes: tuple[float, ...]


def _made(name: str, **options: Any) -> dict[str, Any]:
    return {"generator": {"class_path": name, "init_args": options}, "metres_per_unit": 1.0}


BODIES = {
    "sheet": Body(_made("FlagScene", width=SIZE, height=0.5 * SIZE, spacing=0.00625),
                  (0.02, None, None), (0.16, 0.08, 0.04, 0.02, 0.01)),
    "rod": Body(_made(f"{__name__}.RodScene"), (None, None, 0.03), (0.16, 0.08, 0.04, 0.02, 0.01)),
    "block": Body(_made("gaussian_swaying.scenes.solid.SolidScene", shape="box", size=SIZE, spacing=0.025,
                        gaussians="shell") | {"filling": {}},
                  (None, None, -0.08), (0.3, 0.2, 0.12, 0.08, 0.035)),
}  # fmt: skip
"""A sheet of one layer held at an edge, an upright tube held at its foot, and a block held at its bottom."""

AXES: dict[str, list[Any]] = {
    "material.nu": [0.0, 0.3, 0.45],
    "material.density": [30.0, 300.0, 3000.0],
    "material.E": [1e2, 1e3, 1e4, 1e5, 1e6],
    "wind.flow": [[0.0, 0.0, 0.0], [6.0, 2.0, 0.0], [15.0, 5.0, 0.0], [30.0, 10.0, 0.0]],
}
"""What differs between the runs of a body on a grid, the first slowest."""


def configuration(body: Body, dx: float) -> dict[str, Any]:
    """The configuration that all runs of a body on a grid share: 0.2 s from rest, five frames after the first."""
    region = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": list(body.held)}}
    pin = {"class_path": "PinnedRegion", "init_args": {"kind": None, "region": region}}
    return {
        "frames": 6,
        "frame_dt": 0.04,
        "scene": body.scene,
        "material": {"thickness": 0.005},
        "solver": {"dx": dx, "boundaries": [pin]},
        "wind": {"modulations": []},
        "aero": {"C_D": 1.2, "C_F": 0.005, "C_L": 0.0, "law": "projected"},
        "recorder": {"images": False, "video": False, "trajectory": False, "nodes": False, "checkpoint_every": 0},
    }


ENERGY, GRID, SEEN = 0.05, 0.25, 0.01
"""How much energy may come from nowhere, and how far a run may be from that on the finest grid, both as shares; and
which difference of places, as a share of the body's size, is looked at."""


def energy_error(frames: Sequence[Mapping[str, float]]) -> float:
    """Largest energy that comes from nowhere in a run without damping, over the largest that is in it.

    The work of the wind and that of gravity are all that it can get. Held points do no work, as they do not move.
    """
    found, work = 0.0, 0.0
    first = sum(frames[0][name] for name in ("kinetic", "elastic", "potential"))
    most = max(frame["kinetic"] + frame["elastic"] for frame in frames)
    for frame in frames:
        work += frame["wind_work"]
        has = sum(frame[name] for name in ("kinetic", "elastic", "potential"))
        found = max(found, abs(has - first - work)) if math.isfinite(has) else math.inf
    return found / most if most > 0 else 0.0


def apart(frames: Sequence[Mapping[str, float]], reference: Sequence[Mapping[str, float]]) -> float:
    """Difference of the displacement from that on a finer grid, relative to it; means over the points and the frames.

    Zero if it is less than :data:`SEEN` of the size of the body.
    """
    here, there = (sum(frame["displacement_mean"] for frame in one) / len(one) for one in (frames, reference))
    return abs(here - there) / there if abs(here - there) > SEEN * SIZE else 0.0


def faults(frames: Sequence[Mapping[str, float]], reference: Sequence[Mapping[str, float]] | None) -> list[str]:
    """What is wrong with a run that has ended, found without the warnings of the package.

    Returns:
        Some of ``not a number``, ``inverted`` (material turned inside out), ``energy`` (:func:`energy_error`) and
        ``grid`` (:func:`apart`).
    """
    if not all(math.isfinite(value) for frame in frames for value in frame.values()):
        return ["not a number"]
    found = ["inverted"] if min(frame["J_min"] for frame in frames) <= 0 else []
    if energy_error(frames) > ENERGY:
        found.append("energy")
    if reference is not None and apart(frames, reference) > GRID:
        found.append("grid")
    return found
