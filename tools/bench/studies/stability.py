"""Runs that are right, and what is said of the others: three small bodies over grid, material and wind."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from itertools import product
from typing import Any

from bench.runner import Row, study
from gaussian_swaying import Box, Material, MPMSolver, PinnedRegion, Scene, Simulation, SimulationDiverged
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.scenes.patches import to_cloud, tube
from gaussian_swaying.scenes.procedural import ProceduralScene
from gaussian_swaying.scenes.solid import SolidScene

SIZE, ENERGY, GRID, SEEN = 0.4, 0.05, 0.25, 0.01
"""Longest side of each body [m]; shares: energy that may come from nowhere, difference from the finest grid that may
be, and one that is too little to be seen."""


class Rod(ProceduralScene):
    """An upright tube from the origin."""

    def generate(self) -> GaussianCloud:
        """Make the tube."""
        return to_cloud(tube([[0.0, 0.0, 0.0], [0.0, 0.0, SIZE]], [0.01, 0.01], 0.005))


BODIES: dict[str, tuple[Any, list[float | None], tuple[float, ...]]] = {
    "sheet": (lambda: Scene(generator=FlagScene(width=SIZE, height=0.5 * SIZE, spacing=0.00625), metres_per_unit=1.0),
              [0.02, None, None], (0.01, 0.02, 0.04, 0.08, 0.16)),
    "rod": (lambda: Scene(generator=Rod(), metres_per_unit=1.0), [None, None, 0.03], (0.01, 0.02, 0.04, 0.08, 0.16)),
    "block": (lambda: Scene(generator=SolidScene(shape="box", size=SIZE, spacing=0.025, gaussians="shell"),
                            metres_per_unit=1.0, filling=InteriorFilling()),
              [None, None, -0.08], (0.035, 0.08, 0.12, 0.2, 0.3)),
}  # fmt: skip
"""Scene, upper corner of what is held, and grid spacings from fine to coarse; the finest is the reference."""
FLOW = ([0.0, 0.0, 0.0], [6.0, 2.0, 0.0], [15.0, 5.0, 0.0], [30.0, 10.0, 0.0])
MAP = list(product((0.0, 0.3, 0.45), (30.0, 300.0, 3000.0), (1e2, 1e3, 1e4, 1e5, 1e6), FLOW))
Frames = list[dict[str, float]]


def ran(body: str, dx: float, choice: tuple[Any, ...]) -> tuple[Frames | None, bool]:
    """Health of each frame of 0.2 s from rest, None if it was refused or ended early, and whether it was warned of."""
    nu, density, stiffness, flow = choice
    scene, held, _ = BODIES[body]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            simulation = Simulation(
                scene(), Material(E=stiffness, nu=nu, density=density, thickness=0.005), wind=flow, device="cpu",
                solver=MPMSolver(dx=dx, boundaries=[PinnedRegion(Box([None] * 3, held))]),
            )  # fmt: skip
            return [vars(frame.health) for frame in simulation.frames(6)], bool(said)
        except (ValueError, SimulationDiverged):
            return None, True


def wrong(frames: Frames, reference: Frames | None) -> bool:
    """Whether a run has numbers that are none, turned inside out, got energy from nowhere, or differs from a finer."""
    energies = [frame[name] for frame in frames for name in ("kinetic", "elastic", "potential", "displacement_mean")]
    if not all(map(math.isfinite, energies)) or min(frame["J_min"] for frame in frames) <= 0:
        return True
    has = [frame["kinetic"] + frame["elastic"] + frame["potential"] for frame in frames]
    work = [sum(frame["wind_work"] for frame in frames[: k + 1]) for k in range(len(frames))]
    most = max(frame["kinetic"] + frame["elastic"] for frame in frames)
    if max(abs(own - has[0] - done) for own, done in zip(has, work, strict=True)) > ENERGY * most:
        return True
    here, there = (sum(f["displacement_mean"] for f in one) / len(one) for one in (frames, reference or frames))
    return abs(here - there) > max(GRID * there, SEEN * SIZE)


@study("stability", [{"body": body} for body in BODIES])
def stability(body: str) -> Row:
    """For each grid how many runs are right, right and warned, wrong and warned, refused, and wrong without a word."""
    sizes, rows = BODIES[body][2], {}
    reference = [ran(body, sizes[0], choice)[0] for choice in MAP]
    for dx in sizes:
        counts: Counter[str] = Counter()
        for choice, finest in zip(MAP, reference, strict=True):
            frames, said = ran(body, dx, choice)
            fault = frames is not None and wrong(frames, finest)
            counts["refused" if frames is None else ("wrong" if fault else "right") + " and warned" * said] += 1
        rows[f"{dx:g}"] = dict(counts)
    return {"grids": rows}
