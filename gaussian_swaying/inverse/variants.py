"""Variants of a simulation with other values of the unknowns, moved as batches, and how far they are from films."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gaussian_swaying._fixed import assign
from gaussian_swaying.inverse.least_squares import Block, beside
from gaussian_swaying.inverse.plan import FILM_START, Unknown, Values, of_simulation, values_at
from gaussian_swaying.inverse.tracks import Tracks
from gaussian_swaying.mpm.state import State
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.model import number
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.simulation.step import Stepper, why_not_batched
from gaussian_swaying.wind.force import with_added_mass

MOMENTS = 4  # parts of the time: clusters
NOISE = 0.5  # distance of a track that its own error explains [pixels]
FAST = -0.5  # correlation from one frame to the next of a motion with a third of their rate
HELD, LEAST_HELD = 7, 6  # one of so many tracks is not fitted, if there are at least so many of them


@dataclass
class _Group:
    """Variants that differ only in parameters that may differ within a batch."""

    members: list[int]
    stepper: Stepper
    state: State
    start: float
    diverged: bool = False

    def moves(self, begin: float, end: float) -> float:
        return max(end - self.start, 0.0) - max(begin - self.start, 0.0)


def check_variants(simulation: Simulation, unknowns: Sequence[Unknown]) -> None:
    """Raise ValueError if a simulation has parts that are no batch, such as timed edits, or no such unknown."""
    why = why_not_batched(simulation.model)
    if simulation.editor.edits:
        why = "`edits` change its material; put it into `material`"
    if simulation.stepper.copies is not None:
        why = "it has `copies`, and a video shows one object; remove them"
    if why is not None:
        raise ValueError(f"The base cannot be fitted through: {why}.")
    simulation.model.at(of_simulation({unknown.name: unknown.value(0.5) for unknown in unknowns}))


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
    models = [simulation.model.at(of_simulation(own)) for own in values]
    shared: dict[tuple[object, ...], list[int]] = {}
    for index, (own, model) in enumerate(zip(values, models, strict=True)):
        points = with_added_mass(model.points, model.scene.patches, model.aero)
        squared = float((points.youngs_modulus * points.volume / points.mass).amax())  # of the speed of sound, about
        apart = [pair for pair in sorted(own.items()) if pair[0] == FILM_START or not number(pair[0]).batched]
        shared.setdefault((*apart, 0 if alike else round(2 * math.log2(squared))), []).append(index)
    groups = []
    for members in shared.values():
        part = [models[k] for k in members]
        solver = simulation.solver.like(part[0].solver)
        assign(solver, substep=None)  # a stiffer variant may need a shorter one
        stepper = Stepper(solver, part, lenient=not alike)
        groups.append(_Group(members, stepper, stepper.bind(), values[members[0]].get(FILM_START, 0.0)))
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


def _advance(groups: Sequence[_Group], begin: float, end: float, alike: bool) -> None:
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


def compare(
    evidence: Sequence[Tracks],
    values: Sequence[dict[str, float]],
    times: Sequence[float],
    moving: bool = False,
    tick: Callable[[int], object] = int,
    starts: Sequence[float] = (),
) -> list[Block]:
    """Simulate variants of the evidence's simulation, and compare each with the videos at times [s].

    At 0 they are compared only if the videos begin in motion. They have the same substeps unless one diverges. With
    ``starts``, of a wind that does not depend on time, there is a block for each of them: what the residuals were if
    all had begun to move then, from one simulation.
    """
    wanted: dict[float, tuple[float, list[tuple[int, float]]]] = {}  # what is compared with a state, by its time
    for k, start in enumerate(starts or [0.0]):
        for time in times:
            _, what = wanted.setdefault(round(max(0.0, time - start), 6), (max(0.0, time - start), []))
            what += [(k, time)] if time > 0 or moving else []  # at rest all variants are alike
    own = [one | {FILM_START: 0.0} for one in values] if starts else values
    moments = [wanted[key] for key in sorted(wanted)]

    def compared(alike: bool) -> list[Block]:
        parts: list[list[tuple[Tensor, Tensor, Tensor]]] = [[] for _ in starts or [0.0]]
        runs = states_of(evidence[0].simulation, own, [moment for moment, _ in moments], alike)
        for k, ((_, what), states) in enumerate(zip(moments, runs, strict=True)):
            tick(len(values))
            for part in evidence if what else ():
                shown = part.shown(states)
                for block, time in what:
                    if (frame := part.video.frame_at(time)) is not None:
                        found, cluster = part.beside(shown, frame)
                        moment = torch.full_like(cluster, k * MOMENTS // len(moments))
                        parts[block].append((found, cluster, moment))
        joined = (zip(*own, strict=True) for own in parts)
        return [Block(torch.cat(list(r), 1), torch.cat(list(c)), torch.cat(list(m))) for r, c, m in joined]

    try:
        return compared(not starts)
    except SimulationDiverged:
        return compared(False)


def explained(parts: Sequence[Tracks], values: Values, times: Sequence[float]) -> dict[str, float]:
    """The share of the motion of tracks that were not fitted which their simulation explains, by camera, 0 to 1.

    A track that slipped off the object explains nothing, no less: one of them would decide the sum of all.
    """
    found = {}
    for part, pixel in zip(parts, pixels_of(parts, [values], times)[0], strict=True):
        there, seen = part.position[: len(pixel)], part.seen[: len(pixel)]
        left = ((pixel - there).square().sum(-1) - NOISE**2).clamp(min=0).nan_to_num(torch.inf)
        moved = (there - part.at_rest[: len(pixel)]).square().sum(-1)
        left, moved = (torch.where(seen, own, 0.0).sum(0) for own in (left, moved))
        if bool(moved.any()):
            found[part.video.name] = 1 - float(torch.minimum(left, moved).sum() / moved.sum())
    return found


def split(tracks: Tracks) -> tuple[Tracks, Tracks]:
    """The tracks that are fitted, and those that judge the fit; all of them for both if there are too few."""
    held = tracks.index % HELD == 0
    if int(held.sum()) < LEAST_HELD:
        return tracks, tracks
    return replace(tracks, seen=tracks.seen & ~held), replace(tracks, seen=tracks.seen & held)


def trusted(
    evidence: Sequence[Tracks], others: Sequence[Simulation], values: Values, times: Sequence[float]
) -> list[Tracks]:
    """Return evidence whose points count less where, and when, other grids move them otherwise.

    Such residuals would pull the values to where they make up for the grid. They are multiplied by
    :math:`(1 + d^2 / n^2)^{-1/2}`, with the root mean square distance d on the other grids, and the error n of a track.
    """
    if not others:
        return list(evidence)
    own, squares = pixels_of(evidence, [values], times)[0], [torch.zeros(part.seen.shape).double() for part in evidence]
    for other in others:
        (moved,) = pixels_of([replace(part, simulation=other) for part in evidence], [values], times)
        for square, pixel, here in zip(squares, moved, own, strict=True):
            off = torch.nan_to_num(pixel - here)  # NaN: it diverged
            square[: len(off)] += off.square().sum(-1) / (2 * len(others))
    return [replace(part, trust=(1 + q / NOISE**2).rsqrt()) for part, q in zip(evidence, squares, strict=True)]


def pixels_of(parts: Sequence[Tracks], values: Sequence[Values], times: Sequence[float]) -> list[list[Tensor]]:
    """Where each of some variants would have the Gaussians of each camera in its first frames [pixels], (F, T, 2)."""
    found: list[list[Tensor]] = [[] for _ in parts]
    for time, states in zip(times, states_of(parts[0].simulation, values, times, alike=False), strict=True):
        for part, own in zip(parts, found, strict=True):
            if part.video.frame_at(time) is not None:
                own.append(part.pixels(part.shown(states), len(own)))
    return [[torch.stack(own)[:, k] for own in found] for k in range(len(values))]


def turning(parts: Sequence[Tracks], unknowns: Sequence[Unknown], place: Tensor, times: Sequence[float]) -> list[str]:
    """A sentence on each unknown that moves things mostly to and fro from frame to frame, as of a motion too fast."""
    moved, found = pixels_of(parts, [values_at(unknowns, end) for end in beside(place)[0]], times), []
    for u, low, high in zip(unknowns, moved[len(unknowns) :], moved, strict=False):
        ways = [torch.where(p.seen[: len(a), :, None], b - a, 0.0) for p, a, b in zip(parts, low, high, strict=True)]
        if sum(float((way[1:] * way[:-1]).sum() - FAST * way.square().sum()) for way in ways) < 0:
            found.append(f"{u.name} acts on motion too fast for the film, as others may: film more frames a second.")
    return found
