"""``bench.py backward``: what a gradient through substeps of ``total`` costs, beside the substeps themselves."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from bench.case import Case, Measurement, option
from bench.clock import Clock, Peak, clear, safely, spread, timed
from bench.record import Row
from bench.scenes import sheet, waves, wind_load
from gaussian_swaying.aero.wind import UniformGust, WindField
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.laws.spring_network import SpringNetwork
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState

PER_CELL = 2.2
LONG = 2000
"""Substeps of the rollout whose memory is measured."""

SOUGHT = ("E", "density", "flow", "C_D")
"""What the gradients are by."""

LAWS: dict[str, ConstitutiveLaw] = {"fixed corotated": FixedCorotated(), "springs": SpringNetwork()}
DT = 5e-5


class Sheet:
    """A square sheet in gusts, whose unknowns are leaves; held along one edge by nodes, by a hinge or not at all."""

    def __init__(
        self,
        points: int,
        device: torch.device,
        pin: str | None = None,
        law: str = "fixed corotated",
        transfer: str = "auto",
        dtype: torch.dtype = torch.float32,
        wanted: bool = True,
    ) -> None:
        made = dataclasses.replace(sheet(points, device).map(lambda t: t.to(dtype)), laws=(LAWS[law],))
        dx = PER_CELL * 0.9 / round(points**0.5)
        wind = WindField([2.0, 0.0, 1.0], modulations=[UniformGust()], seed=0).to(device)
        self.force = wind_load(sheet(points, device), wind)
        self.force.normal, self.force.area = self.force.normal.to(dtype), self.force.area.to(dtype)
        own = {"E": 5e3, "density": 50.0}
        leaves = {name: torch.tensor(value, dtype=dtype, device=device) for name, value in own.items()}
        leaves |= {"flow": wind.flows, "C_D": self.force.aero.C_D}
        self.leaves = {name: leaf.requires_grad_(wanted) for name, leaf in leaves.items()}
        made = dataclasses.replace(
            made,
            youngs_modulus=leaves["E"].expand(made.count),
            mass=leaves["density"] * made.volume,
        )
        edge = Box([None] * 3, [0.05 + 1.5 * dx, None, None])
        boundaries = [] if pin is None else [PinnedRegion(edge, kind=pin)]
        self.solver = MPMSolver(dx=dx, damping=0.1, transfer=transfer, boundaries=boundaries)
        self.state = self.solver.init_state(made, waves(made.position))
        self.points, self.nodes = made.count, int((self.solver.bound.node_mass > 0).sum())  # type: ignore[attr-defined]

    @property
    def by(self) -> str:
        """What computes the gradients."""
        return "kernels" if self.solver.has_kernels else "torch"

    def run(self, steps: int, checkpoint: int = 0) -> MPMState:
        """A rollout."""
        forces: list[Force] = [self.force]
        return self.solver.rollout(self.state, DT, steps, forces, checkpoint)

    def loss(self, state: MPMState) -> Tensor:
        """A number that depends on all of the motion."""
        return ((state.position - self.solver.points.position) ** 2).sum() / self.points * 1e4

    def gradients(self, steps: int, checkpoint: int = 0) -> list[Tensor]:
        """Gradients of the loss by the unknowns."""
        found = torch.autograd.grad(
            self.loss(self.run(steps, checkpoint)), list(self.leaves.values()), retain_graph=True
        )
        return [g.detach().cpu().double() for g in found]


def cost(
    points: int, device: torch.device, steps: int, repeats: int, pin: str | None, law: str, transfer: str = "auto"
) -> Row:
    """Milliseconds of a substep without a gradient, with one, and backward."""
    still = Sheet(points, device, pin, law, transfer, wanted=False)
    with torch.no_grad():
        plain = timed(partial(still.run, steps), device, repeats, 2, 1 / steps)
    clear()
    case = Sheet(points, device, pin, law, transfer)
    forward, backward = [], []
    for n in range(repeats + 2):
        clock = Clock(device)
        clock.mark()
        loss = case.loss(case.run(steps))
        clock.mark()
        torch.autograd.grad(loss, list(case.leaves.values()), retain_graph=True)
        clock.mark()
        times = clock.read()
        if n >= 2:
            forward.append(times[0] / steps)
            backward.append(times[1] / steps)
    row = {"points": case.points, "nodes": case.nodes, "steps": steps, "pin": pin, "law": law, "by": case.by}
    row |= {"plain": plain, "forward": spread(forward), "backward": spread(backward)}
    return row | {"ratio": row["backward"]["median_ms"] / plain["median_ms"]}


def memory(points: int, device: torch.device, steps: int, transfer: str, checkpoint: int) -> Row:
    """Most memory of the gradient through one long rollout, and how long it takes."""
    case = Sheet(points, device, "hinge", transfer=transfer)
    peak = Peak(device)
    clock = Clock(device)
    clock.mark()
    case.gradients(steps, checkpoint)
    clock.mark()
    row = {"points": case.points, "steps": steps, "by": case.by, "checkpoint": checkpoint}
    return row | {"memory_bytes": peak.read(), "seconds": 1e-3 * sum(clock.read())}


def agreement(points: int, device: torch.device, steps: int, pin: str | None) -> Row:
    """Relative difference of each gradient from that of torch in float64, for the kernels and for torch in float32."""
    exact = Sheet(points, device, pin, transfer="torch", dtype=torch.float64).gradients(steps, 10)
    row: Row = {"points": points, "steps": steps, "pin": pin}
    for transfer in ("auto", "torch"):
        case = Sheet(points, device, pin, transfer=transfer)
        found = case.gradients(steps, 10)
        errors = [float((a - b).norm() / b.norm()) for a, b in zip(found, exact, strict=True)]
        row[case.by] = dict(zip(SOUGHT, errors, strict=True))
    return row


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Times, most memory and agreement with torch; what fails says why."""
    result |= {"rows": [], "memory": [], "agreement": []}
    device, middle = torch.device(options.device), sorted(options.points)[len(options.points) // 2]

    def row(
        points: int, pin: str | None, law: str = "fixed corotated", transfer: str = "auto", few: bool = False
    ) -> Measurement:
        known = {"points": points, "pin": pin, "law": law, "transfer": transfer}
        steps, repeats = (20, 2) if few else (options.steps, options.repeats)
        return ("rows", known), safely(cost, points, device, steps, repeats, pin, law, transfer)

    yield row(middle, "hinge")
    for transfer, steps, checkpoint in (("auto", options.long, 0), ("torch", max(options.long // 20, 1), 10)):
        known = {"points": middle, "steps": steps, "transfer": transfer, "checkpoint": checkpoint}
        yield ("memory", known), safely(memory, middle, device, steps, transfer, checkpoint)
    for pin in ("hinge", "nodes"):
        checked = min(middle, 10_000)
        known = {"points": checked, "pin": pin}
        yield ("agreement", known), safely(agreement, checked, device, 60, pin)
    if device.type == "cuda":
        yield row(middle, "hinge", transfer="torch", few=True)
    yield from (row(middle, pin) for pin in (None, "nodes"))
    yield row(middle, "hinge", "springs")
    yield from (row(points, "hinge") for points in options.points if points != middle)


CASE = Case(
    "Measure the gradient through substeps of total: time, memory and agreement with torch.",
    rows,
    (
        option("--points", "of the sheets", type=int, nargs="+", default=[10_000, 100_000, 1_000_000]),
        option("--steps", "substeps of a timed rollout", type=int, default=480),
        option("--repeats", "timed rollouts", type=int, default=7),
        option("--long", "substeps of the rollout whose memory is measured", type=int, default=LONG),
    ),
    page="validation.md",
    keeps="none",
)
