"""Parts that lie closer to each other than a cell, with nodes of their own: sheets, and the beams of a comb."""

from __future__ import annotations

import math
import time

import torch

from bench.problems import beams
from bench.problems.settings import Axial, Result, Settings, follow
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState


def comb(
    settings: Settings,
    thickness: float,
    gap: float,
    base: bool = False,
    shared: bool = False,
    count: int = 10,
    shortest: float = 20.0,
) -> Result:
    r"""Cantilevers side by side, each a cell longer than the last, with gaps of less than a cell; plane strain, nu = 0.

    Each starts in its lowest mode, every second one in the other direction, and all bend towards each other. Their ends
    lie 2 cells deep in a :class:`PinnedRegion`.

    Units: ``thickness``, ``gap``, ``shortest`` [cells].

    Returns:
        ``lowest`` and ``highest`` of the ratios of frequency over that of Timoshenko's beam alone, ``error``, the
        largest distance from one, and the common quantities.
    """
    per_cell, depth = 4, 2.0
    strips = [beams.Strip.of(thickness, depth, shortest + k, per_cell) for k in range(count)]
    number = torch.cat([torch.full((len(strip.points),), k) for k, strip in enumerate(strips)])
    heights = 0.37 + (thickness + gap) * number.double()
    inside = torch.cat([strip.points for strip in strips])
    position = inside + torch.stack([torch.full_like(heights, 0.25), torch.zeros_like(heights), heights], -1)
    free = torch.cat([strip.free for strip in strips])
    like = torch.zeros((), dtype=settings.dtype, device=settings.device)
    attached = None if shared else number
    if base and not shared:
        # neighbours of a beam are at most half a cell apart, and beams are joined where they are held
        near = torch.cdist(position, position, p=math.inf) <= max(0.5, gap + thickness / per_cell) + 1e-6
        apart = (number[:, None] != number) & (free[:, None] | free)
        attached = (near & ~apart).nonzero()
    points = MaterialPoints.create(
        position.to(like),
        volume=torch.cat([strip.volume for strip in strips]).to(like),
        density=1.0,
        youngs_modulus=1.0,
        poisson_ratio=0.0,
        attached=attached,
    )
    pin = PinnedRegion(beams.Chosen(~free), "clamp")
    solver = settings.solver(1.0, boundaries=[Axial((1,)), pin])
    modes = [strip.mode() for strip in strips]
    shapes = []
    for k, (strip, (_, bent)) in enumerate(zip(strips, modes, strict=True)):
        shape = torch.stack([-bent[:, 1] * strip.points[:, 2], torch.zeros_like(bent[:, 0]), bent[:, 0]], -1)
        shapes.append((-1) ** k * shape)
    speed = torch.tensor([omega * strip.span for strip, (omega, _) in zip(strips, modes, strict=True)])
    shape = torch.cat(shapes)
    weight = points.mass.double().cpu()[:, None] * shape
    many, until = 160, 2.4 / min(omega for omega, _ in modes)

    def speeds(state: MPMState) -> torch.Tensor:
        along = (weight * state.velocity.double().cpu()).sum(-1)
        return along.new_zeros(count).index_add(0, number, along)

    start = solver.init_state(points, (1e-5 * speed[number][:, None] * shape).to(like))
    run = follow(solver, start, until / many, many, speeds)
    ratios = []
    for k, (omega, _) in enumerate(modes):
        crossing = beams.first_zero(run.time, run.series[:, k])
        ratios.append(0.0 if crossing is None else math.pi / 2 / (omega * crossing))
    error = max(abs(ratio - 1) for ratio in ratios)
    return run.result(error, lowest=min(ratios), highest=max(ratios), nodes=start.grid.node_count)


def sheets(settings: Settings, gap: float, layers: int = 3, cells: int = 24, repeats: int = 5) -> Result:
    """Two square sheets above each other, held at one edge and pushed apart, compared with each of them alone.

    Units: ``gap`` [cells].

    Returns:
        ``error``: the largest distance from a point of a sheet alone, over the largest displacement of that sheet;
        ``shared``: the same if they share nodes; ``cost``: time of a substep over that on shared nodes, the shortest of
        each; and the common quantities.
    """
    side = torch.arange(2 * cells, dtype=torch.float64) / 2 + 0.27
    heights = 0.05 * (torch.arange(layers, dtype=torch.float64) - 0.5 * (layers - 1))
    alone = [torch.cartesian_prod(side, side, 3.1 + lift + heights) for lift in (0.0, gap)]
    both, number = torch.cat(alone), torch.arange(2).repeat_interleave(len(alone[0]))
    push = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.6]], dtype=settings.dtype, device=settings.device) * 1e-4

    def body(position: torch.Tensor, attached: torch.Tensor | None) -> MaterialPoints:
        like = torch.zeros((), dtype=settings.dtype, device=settings.device)
        volume = 0.25 * 0.1 / layers
        return MaterialPoints.create(
            position.to(like), volume=volume, density=1.0, youngs_modulus=100.0, poisson_ratio=0.3, attached=attached
        )

    def solver() -> MPMSolver:
        return settings.solver(1.0, boundaries=[PinnedRegion(Box([None] * 3, [1.0, None, None]))])

    force = push[number.to(push.device)]
    runs = []
    for k, place in enumerate(alone):
        own, load = solver(), force[number.to(push.device) == k]
        runs.append(follow(own, own.init_state(body(place, None)), 1.0, 4, _middle, lambda _, load=load: load))
    found, times = {}, {}
    for name, attached in (("apart", number), ("shared", None)):
        own = solver()
        start = own.init_state(body(both, attached))
        found[name] = follow(own, start, 1.0, 4, _middle, lambda _: force)
        times[name] = min(_timed(own, start) for _ in range(repeats))
    errors = {}
    for name, run in found.items():
        worst = 0.0
        for k, other in enumerate(runs):
            end, rest = other.state.position.double().cpu(), alone[k]
            mine = run.state.position.double().cpu()[number == k]
            worst = max(worst, float((mine - end).norm(dim=-1).amax() / (end - rest).norm(dim=-1).amax()))
        errors[name] = worst
    cost = times["apart"] / times["shared"]
    return found["apart"].result(errors["apart"], shared=errors["shared"], cost=cost)


def _middle(state: MPMState) -> torch.Tensor:
    return state.position.mean(0)


def _timed(solver: MPMSolver, state: MPMState, steps: int = 50) -> float:
    dt = 0.5 * solver.stable_substep(state)
    begin = time.perf_counter()
    with torch.inference_mode():
        float(solver.rollout(state, dt, steps).position.sum())
    return time.perf_counter() - begin
