"""Variants of a simulation with other values of the unknowns, moved as batches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from gaussian_swaying._fixed import assign
from gaussian_swaying.inverse.plan import FILM_START, OF_FILM, Values, model_of
from gaussian_swaying.mpm.state import State
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.model import Model, number
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.simulation.step import Stepper, why_not_batched
from gaussian_swaying.wind.force import with_added_mass


@dataclass
class _Group:
    """Variants that differ only in parameters that may differ within a batch."""

    members: list[int]
    stepper: Stepper
    state: State
    start: float
    diverged: bool = False

    def moves(self, begin: float, end: float) -> float:
        """The time for which they move between two times of the film [s]."""
        return max(end - self.start, 0.0) - max(begin - self.start, 0.0)


def check_variants(simulation: Simulation) -> None:
    """Raise ValueError if a simulation has parts that cannot be a batch: timed edits, contact, shelter, copies."""
    why = why_not_batched(simulation.model)
    if simulation.editor.edits:
        why = "`edits` change its material; put it into `material`"
    if simulation.stepper.copies is not None:
        why = "it has `copies`, and a video shows one object; remove them"
    if why is not None:
        raise ValueError(f"The base cannot be fitted through: {why}.")


@torch.no_grad()
def states_of(
    simulation: Simulation, values: Sequence[Values], times: Sequence[float], alike: bool = True
) -> Iterator[list[State]]:
    """The states of all variants at each time, in the order of ``values``.

    Args:
        simulation: The base. Its motion starts from rest at time zero.
        values: For each variant the values that replace those of the base; with ``film.start``, it is at rest until
            then, or has moved since then if that is below zero.
        times: Times [s], ascending, from 0 on.
        alike: Take the same substeps for all, those of the stiffest, so that differences come from the values alone. If
            not, variants that need more substeps are batches of their own, and a variant may end in NaN.
    """
    groups = _groups(simulation, values, alike)
    before = math.ceil(max(0.0, -min(group.start for group in groups)) / simulation.frame_dt)
    for k in range(-before, 0):  # the run-up, frame by frame
        _advance(groups, k * simulation.frame_dt, (k + 1) * simulation.frame_dt, alike)
    now = 0.0
    for time in times:
        if time > now:
            _advance(groups, now, time, alike)
            now = time
        found = [(member, group.state.scene(k)) for group in groups for k, member in enumerate(group.members)]
        yield [state for _, state in sorted(found, key=lambda pair: pair[0])]


def _groups(simulation: Simulation, values: Sequence[Values], alike: bool) -> list[_Group]:
    models = [model_of(simulation.model, own) for own in values]
    shared: dict[tuple[object, ...], list[int]] = {}
    for index, (own, model) in enumerate(zip(values, models, strict=True)):
        apart = [pair for pair in sorted(own.items()) if pair[0] in OF_FILM or not number(pair[0]).batched]
        shared.setdefault((*apart, 0 if alike else _stiffness_class(model)), []).append(index)
    found = []
    for members in shared.values():
        part = [models[k] for k in members]
        solver = simulation.solver.like(part[0].solver)
        assign(solver, substep=None)  # a stiffer variant may need a shorter one
        stepper = Stepper(solver, part, lenient=not alike)
        found.append(_Group(members, stepper, stepper.bind(), values[members[0]].get(FILM_START, 0.0)))
    return found


def _advance(groups: Sequence[_Group], begin: float, end: float, alike: bool) -> None:
    """Advance all groups that move from one time of the film to another [s]."""
    groups = [group for group in groups if group.moves(begin, end) > 0]
    for group in groups:
        group.stepper.model = group.stepper.model.replace(frame_dt=group.moves(begin, end))
    if not alike:
        for group in groups:
            try:
                if not group.diverged:
                    group.state, _ = group.stepper.advance(group.state)
            except SimulationDiverged:
                lost = {name: torch.nan * getattr(group.state, name) for name in ("position", "velocity", "F_total")}
                group.state, group.diverged = group.state.replace(**lost), True
    elif groups:
        steps, most = 0, max(group.stepper.substeps(group.state) for group in groups)
        while steps != most:
            steps = most
            launched = [group.stepper.launch(group.state, steps) for group in groups]
            ends = [one.finish()[0] for one in launched]
            most = max(one.steps for one in launched)
        for group, state in zip(groups, ends, strict=True):
            group.state = state


def _stiffness_class(model: Model) -> int:
    """A number that is equal for materials whose fastest waves differ by less than a fifth or so."""
    points = with_added_mass(model.points, model.scene.patches, model.aero)
    squared = (points.youngs_modulus * points.volume / points.mass).amax()
    return round(2 * math.log2(float(squared)))
