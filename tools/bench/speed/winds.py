"""Substeps of a sheet in winds that differ from place to place, and of many sheets in winds of their own."""

from __future__ import annotations

from functools import partial

import torch

from bench.runner import Row, study
from bench.speed.timing import CUBE, DT, STEPS, in_turns, load, sheet, timed, waves, wind
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.wind.effects import Obstacle, Profile, WindEffect
from gaussian_swaying.wind.field import UniformGust, WindField
from gaussian_swaying.wind.tables import Shelter
from gaussian_swaying.wind.turbulence import Turbulence


def effects() -> dict[str, list[WindEffect]]:
    """The effects of each wind; the first is that of the others' ratios."""
    air, profile = Turbulence(0.2, 0.5, cells=(256, 128, 128)), Profile([0.0, 0.0, -1.0], height=2.0)
    return {
        "uniform": [],
        "turbulence": [air],
        "profile, turbulence": [profile, air],
        "profile, turbulence, shelter": [profile, air, Shelter()],
        "cylinder": [Obstacle([-0.5, 0.0, 0.0], [0.1, None, 0.1])],
    }


def sizes(device: str) -> list[Row]:
    """Points of the sheets."""
    counts = (5_000, 20_000, 100_000) if device == "cpu" else (100_000, 1_000_000)
    return [{"asked": n, "formulation": name} for n in counts for name in ("total", "updated")]


@study("winds", sizes)
@torch.no_grad()
def winds(asked: int, formulation: str, device: str) -> Row:
    """Time of a substep in each wind, in turns, and its ratio to that in uniform gusts."""
    points, calls = sheet(asked, device), {}
    for name, own in effects().items():
        solver = MPMSolver(dx=CUBE.dx, formulation=formulation)
        state = solver.init_state(points, waves(points.position))
        state = state.replace(grid=CUBE) if formulation == "updated" else state
        force = load(points, WindField([2.0, 0.0, 1.0], modulations=[UniformGust()], effects=own).to(device))
        force.refresh(state)
        calls[name] = partial(solver.rollout, state, DT, STEPS, force)
    return {"particles": points.count, "winds": in_turns(calls, device, 9, STEPS)}


EACH = [("total", False), ("total", True), ("updated", False), ("updated", True)]


@study("batches", [{"case": "batch", "formulation": name, "gusts": gusts} for name, gusts in EACH])
@torch.inference_mode()
def batches(case: str, formulation: str, gusts: bool, device: str) -> Row:
    """Flags in winds of their own: all in one rollout, one after another, and one flag of as many points."""
    scenes, side = (4 if device == "cpu" else 64), 64
    one = sheet(side**2, device)
    many = one.map(lambda t: t.expand(scenes, *t.shape).contiguous())
    wide = sheet(one.count * scenes, device, 0.9 * scenes**0.5)
    blown = [wind(k, gusts, device) for k in range(scenes)]
    ends = {}

    def rolled(name: str, solver: MPMSolver, state: object, forces: list) -> None:
        ends[name] = [solver.rollout(state, DT, STEPS, force).position for force in forces]  # type: ignore[arg-type]

    took = {}
    for name, points, forces in (
        ("together", many, [load(many, WindField.together(blown))]),
        ("apart", one, [load(one, own) for own in blown]),
        ("large", wide, [load(wide, blown[0])]),
    ):
        solver = MPMSolver(dx=2 * 0.9 / side, formulation=formulation)
        call = partial(rolled, name, solver, solver.init_state(points, waves(points.position)), forces)
        took[name] = scenes * one.count * STEPS / (1e-3 * timed(call, device, 5)["median_ms"])
    apart = torch.stack(ends["apart"])
    off = (ends["together"][0] - apart).abs().amax() / (apart - one.position).abs().amax()
    row = {f"{name}_per_s": value for name, value in took.items()} | {"scenes": scenes, "particles": one.count}
    return row | {"ratio": took["together"] / took["apart"], "share": took["together"] / took["large"],
                  "difference": float(off)}  # fmt: skip
