"""The cost of a gradient through a rollout."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from bench.runner import Row, study
from bench.speed.timing import load, seconds, sheet, timed, waves, wind
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState


@study(
    "backward",
    lambda device: [{"asked": 10_000 if device == "cpu" else 100_000, "by": by} for by in ("auto", "torch")],
)
def backward(asked: int, by: str, device: str, steps: int = 480, long: int = 2000) -> Row:
    """Time of a substep of a sheet in gusts, held at an edge: plain, with a gradient wanted, and backward.

    Gradients of the mean square displacement by E, density and flow. ``memory_bytes`` is that of a rollout over
    ``long`` substeps, by the kernels on a GPU.
    """
    made = sheet(asked, device)
    dx = 2.2 * 0.9 / round(asked**0.5)
    leaves = {"E": torch.tensor(5e3, device=device), "density": torch.tensor(50.0, device=device)}
    blown = wind(0, True, device)
    leaves["flow"] = blown.flows
    edge = PinnedRegion(Box([None] * 3, [0.05 + 0.9 * dx, None, None]), kind="hinge")
    force = load(made, blown)
    solver = MPMSolver(dx=dx, damping=0.1, transfer=by, boundaries=[edge])

    def begun(wanted: bool) -> MPMState:
        for leaf in leaves.values():
            leaf.requires_grad_(wanted)
        stiff, heavy = leaves["E"].expand(made.count), leaves["density"] * made.volume
        return solver.init_state(dataclasses.replace(made, youngs_modulus=stiff, mass=heavy), waves(made.position))

    def loss(state: MPMState, count: int = steps) -> Tensor:
        end = solver.rollout(state, 5e-5, count, [force])
        return ((end.position - made.position) ** 2).sum() / made.count

    def grad(state: MPMState, count: int = steps) -> None:
        torch.autograd.grad(loss(state, count), list(leaves.values()), retain_graph=True)

    with torch.no_grad():
        state = begun(False)
        plain = timed(lambda: loss(state), device, 5, steps)["median_ms"]
    state = begun(True)
    forward = timed(lambda: loss(state), device, 5, steps)["median_ms"]
    both = timed(lambda: grad(state), device, 5, steps)["median_ms"]
    row: Row = {
        "points": made.count,
        "plain_ms": plain,
        "forward_ms": forward,
        "backward_ms": both - forward,
        "ratio": (both - forward) / plain,
    }
    if device == "cuda" and by == "auto":
        torch.cuda.reset_peak_memory_stats()
        row |= {"seconds": seconds(lambda: grad(state, long), device)}
        row["memory_bytes"] = torch.cuda.max_memory_allocated()
    return row
