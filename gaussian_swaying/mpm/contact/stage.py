"""Contact of a body in ``total``: lists of samples that may touch, and the impulses of a substep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.mpm.boundaries.boundary import Boundary
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.contact.pairs import close_pairs
from gaussian_swaying.mpm.contact.solve import SLACK, Constraints, Rows, acting, pair_gaps, resolve, weighted
from gaussian_swaying.mpm.contact.surface import Contact, Surface
from gaussian_swaying.mpm.state import GridSpec, MPMState
from gaussian_swaying.mpm.transfer import bspline_stencil, in_fixed_order
from gaussian_swaying.mpm.virtual_nodes import coordinates, point_with_nodes

LEAST_MARGIN = 0.5
"""Least distance beyond contact within which pairs are listed [cells]."""

ARM = 1.2
"""Bound on the motion of a contact sample, relative to the largest motion of the material points."""

TOLERANCE = 5e-5
"""Violation of a constraint within a substep at which the impulses are good enough [cells]."""

AHEAD = 3.0
"""Substeps by which the motion of points is extrapolated, to make the lists again before they are incomplete."""

APART = 2.0
"""Samples closer than this at rest [cells] are neighbours: they share nodes, and a fold cannot be sharper."""


@dataclass(frozen=True, slots=True)
class Lists:
    """Candidates for contact: all pairs that may touch before the nodes have moved half the margin.

    Attributes:
        place: The samples that occur, shape (A,).
        touched: The nodes around them, shape (T,).
        rows: Those samples on those nodes.
        slope: Derivatives of their weights along the axes [1/m], shape (3, A, 27), or none without pairs.
        walls: For each obstacle, the rows of the samples near it, shape (N,).
        first: Rows of the first sample of each pair, shape (M,).
        second: Rows of the second.
        before: Positions of the material points when the lists were made [m], shape (P, 3).
        time: That time [s].
        margin: Distance beyond contact up to which pairs are listed [m].
        fastest: Bound of the speed of the obstacles [m/s].
    """

    place: Tensor
    touched: Tensor
    rows: Rows
    slope: Tensor
    walls: list[Tensor]
    first: Tensor
    second: Tensor
    before: Tensor
    time: float
    margin: float
    fastest: float


class ContactStage:
    """Contact of a body with obstacles and with itself, bound to its grid.

    The lists of what may touch are only a cache: the result of a substep depends on its state, not on earlier substeps.

    Args:
        surface: The contact samples.
        boundaries: The boundaries of the body; those that are obstacles act here.
        kinds: Kind of each boundary (``Boundary.hold_kind``).
        grid: The nodes.
        inverse_mass: Their inverse mass [1/kg], 0 for a node without mass, shape (..., G).
        deterministic: Whether sums on a GPU have a fixed order.
        points: With virtual nodes, the first node of the cell of each material point and its nodes, over all scenes.

    Raises:
        ValueError: If a sample has no material.
    """

    def __init__(
        self,
        surface: Surface,
        boundaries: Sequence[Boundary],
        kinds: Sequence[str],
        grid: GridSpec,
        inverse_mass: Tensor,
        deterministic: bool = False,
        points: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        self.deterministic = deterministic
        self.surface, self.contact, self.grid, self.dx = surface, surface.contact, grid, grid.dx
        self.count = len(boundaries)
        self.obstacles = [(k, b) for k, b in enumerate(boundaries) if kinds[k] == "surface" and isinstance(b, Obstacle)]
        self.iterations = Contact.iterations if self.contact is None else self.contact.iterations
        self.inverse_mass = inverse_mass.reshape(-1)
        self.scenes = len(self.inverse_mass) // grid.node_count
        each = len(surface.place) // self.scenes
        read = surface.read.reshape(self.scenes, each, 3) if self.scenes > 1 else surface.read
        snap = torch.finfo(read.dtype).eps ** 0.5
        stencil = bspline_stencil(read, grid, False, snap)
        if not bool(stencil.inside.all()):
            raise ValueError("A contact sample lies outside the material: give samples on the simulated points.")
        basis = stencil.basis  # (C, 4, 27)
        arm = surface.place - surface.read
        self.node = stencil.node.reshape(-1, 27)
        self.corner: Tensor | None = None
        if points is not None:
            self.node = self._nodes(stencil.first, *points)
            self.corner = coordinates(stencil.first % grid.node_count, grid)
        self.first, self.fraction = stencil.first, 1.5 + stencil.factors[1, :, 0] * grid.dx  # position in its cell
        self.slope = basis[:, 1:4]
        self.weight = basis[:, 0] + (arm[:, :, None] * self.slope).sum(1)
        self.scene = torch.arange(len(self.weight), device=read.device) // max(each, 1)
        self.reach = self.apart = 0.0
        if self.contact is not None:
            widest, thickest = float(surface.radius.amax()), float(surface.thickness.amax())
            self.reach = math.hypot(widest, thickest)
            self.apart = max(APART * self.dx, 3 * thickest)
        self.lists: Lists | None = None
        self.made = 0
        """Number of times that the lists were made."""

    def _nodes(self, first: Tensor, point_first: Tensor, point_node: Tensor) -> Tensor:
        """The nodes of the samples, with virtual ones: those of the material point that each belongs to."""
        near, many = self.surface.near, len(point_first) // self.scenes
        if near is None:
            raise ValueError("Contact of a body with `attached` parts needs `near` in its Surface.")
        number = torch.arange(self.scenes).repeat_interleave(len(first) // self.scenes)
        belongs = near.cpu() + many * number
        host = point_with_nodes(first.cpu(), belongs, point_first.cpu(), point_node.cpu(), self.grid)
        if bool((host < 0).any()):
            k = int((host < 0).int().argmax())
            raise ValueError(f"The contact sample {k} lies in a cell without material of its piece: move its `read`.")
        return point_node.T[host.to(point_node.device)]

    def unconnected(self, first: Tensor, second: Tensor) -> Tensor:
        """A mask of pairs of samples, by their indices (M,), that have different copies of a node that both reach."""
        assert self.corner is not None
        away = self.corner[second] - self.corner[first]
        place = away.new_tensor([9, 3, 1])
        one, other = ((place * (sign * away).clamp(0, 2)).sum(-1) for sign in (1, -1))
        return (away.abs() > 2).any(-1) | (self.node[first, one] != self.node[second, other])

    # ---- lists

    @torch.no_grad()
    def update(self, state: MPMState, dt: float) -> None:
        """Make the lists again if something may have come close since they were made; the host waits.

        Args:
            state: The state at the start of a substep.
            dt: Substep [s].
        """
        position, velocity = state.position.reshape(-1, 3), state.velocity.reshape(-1, 3)
        known, now = self.lists, float(state.time)
        if known is not None:
            far = float((position + AHEAD * dt * velocity - known.before).square().sum(-1).amax()) ** 0.5
            if 2 * ARM * far + known.fastest * abs(now + AHEAD * dt - known.time) < known.margin:
                return
        step = dt * float(velocity.square().sum(-1).amax()) ** 0.5
        assert state.node_displacement is not None
        moved = state.node_displacement.reshape(-1, 3)
        if not math.isfinite(step):
            return  # the run is about to end with an error that says why
        with torch.inference_mode(False):
            self.lists = self._make(position.clone(), moved, state.time, dt, step)
        self.made += 1

    def _make(self, before: Tensor, displacement: Tensor, time: Tensor, dt: float, step: float) -> Lists:
        position = self.positions(displacement)
        farthest = [float((position - b.pose(time)[0].to(position)).norm(dim=-1).amax()) for _, b in self.obstacles]
        fastest = max([0.0, *(b.fastest(far) for (_, b), far in zip(self.obstacles, farthest, strict=True))])
        thickest = float(self.surface.thickness.amax())
        margin = max(LEAST_MARGIN * self.dx, thickest, 4 * (1 + AHEAD) * ARM * step + 4 * fastest * dt)
        none = torch.zeros(0, dtype=torch.long, device=position.device)
        first = second = none
        if self.contact is not None:
            which = None if self.corner is None else self.unconnected
            place, reach = self.surface.place, self.reach + margin
            first, second = close_pairs(position, reach, place, self.apart, which, self.reach)
        near = []
        for _, obstacle in self.obstacles:
            distance = obstacle.touch(position, time, dt)[0] - 0.5 * self.surface.thickness
            near.append((distance < margin).nonzero()[:, 0])
        place = torch.cat([first, second, *near]).unique()
        rank = torch.zeros(len(position), dtype=torch.long, device=position.device)
        rank[place] = torch.arange(len(place), device=position.device)
        known = torch.zeros(len(self.inverse_mass), dtype=torch.bool, device=position.device)
        node = self.node[place]
        known[node.reshape(-1)] = True
        touched = known.nonzero()[:, 0]
        rows = Rows.of((known.cumsum(0) - 1)[node], self.weight[place], self.inverse_mass[touched])
        slope = self.slope[place[: len(place) if len(first) else 0]].transpose(0, 1).contiguous()
        return Lists(
            place,
            touched,
            rows,
            slope,
            [rank[index] for index in near],
            rank[first],
            rank[second],
            before,
            float(time),
            margin,
            fastest,
        )

    # ---- a substep

    def apply(self, velocity: Tensor, displacement: Tensor, time: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """The velocity of the nodes after the impulses of all contacts.

        Args:
            velocity: Node velocity after all forces [m/s], shape (..., G, 3).
            displacement: Node displacement at the start of the substep [m], shape (..., G, 3).
            time: Time at the start of the substep [s], scalar float64 tensor.
            dt: Substep [s].

        Returns:
            The velocity, and the momentum that each boundary took from the body [N s], shape (scenes, boundaries, 3),
            float64.
        """
        lists = self.lists
        taken = torch.zeros(self.scenes, self.count, 3, dtype=torch.float64, device=velocity.device)
        if lists is None or len(lists.place) == 0:
            return velocity, taken
        flat, rows = velocity.reshape(-1, 3), lists.rows
        if self.inverse_mass.requires_grad:
            rows = replace(rows, inverse_mass=self.inverse_mass[lists.touched])
        local = flat[lists.touched]
        moving = rows.read(local.detach())
        held, owner = self._constraints(lists, displacement.reshape(-1, 3)[lists.touched], moving, time, dt)
        index = acting(moving, held, dt, self.dx).nonzero()[:, 0]
        if len(index) == 0:
            return velocity, taken
        held, owner = held.select(index), owner[index]
        with in_fixed_order(self.deterministic and flat.is_cuda):
            local, impulse = resolve(local, rows, held, dt, self.dx, self.iterations, TOLERANCE * self.dx)
            flat = flat.index_copy(0, lists.touched, local)
        if self.obstacles:
            with torch.no_grad(), in_fixed_order(self.deterministic and flat.is_cuda):
                flat_owner = self.scene[lists.place[held.first]] * (self.count + 1) + owner  # the last one for pairs
                sums = taken.new_zeros(self.scenes * (self.count + 1), 3)
                sums.index_add_(0, flat_owner.to(sums.device), -in_double(impulse))
                taken = sums.reshape(self.scenes, -1, 3)[:, :-1]
        return flat.reshape(velocity.shape), taken

    def _constraints(
        self, lists: Lists, displacement: Tensor, moving: Tensor, time: Tensor, dt: float | Tensor
    ) -> tuple[Constraints, Tensor]:
        """Listed constraints as they are now, and the boundary of each; the number of boundaries for a pair.

        Pairs are left out that are too far from each other to touch in this substep.

        Args:
            lists: The candidates.
            displacement: Of the nodes around the listed samples [m], shape (T, 3).
            moving: Velocity of the listed samples [m/s], shape (A + 1, 3).
            time: Time now [s].
            dt: Substep [s].
        """
        surface = self.surface
        position = surface.place[lists.place] + lists.rows.read(displacement)[:-1]
        thickness = surface.thickness[lists.place]
        obstacle_row = len(lists.place)
        parts: list[tuple[Tensor, ...]] = []
        for (k, obstacle), near in zip(self.obstacles, lists.walls, strict=True):
            gap, normal, drive = obstacle.touch(position[near], time, dt)
            valid = obstacle.active(time).to(near.device).expand(len(near))
            friction = gap.new_full((len(near),), obstacle.friction)
            owner = torch.full_like(near, k)
            parts.append(
                (
                    near,
                    torch.full_like(near, obstacle_row),
                    normal,
                    gap - 0.5 * thickness[near],
                    drive,
                    friction,
                    valid,
                    owner,
                )
            )
        if self.contact is not None and len(lists.first):
            with torch.no_grad():
                fastest = moving.square().sum(-1).amax().sqrt()
                limit = self.reach + SLACK * self.dx + 2 * dt * fastest
                far = position[lists.first] - position[lists.second]
                close = (far.square().sum(-1) < limit * limit).nonzero()[:, 0]
            first, second = lists.first[close], lists.second[close]
            normals = self._normals(lists.rows.node[:-1], lists.slope, lists.place, displacement)
            radius = surface.radius[lists.place]
            normal, gap, above = pair_gaps(
                position[first] - position[second],
                (normals[first], normals[second]),
                (radius[first], radius[second]),
                0.5 * (thickness[first] + thickness[second]),
            )
            friction = gap.new_full((len(first),), self.contact.friction)
            owner = torch.full_like(first, self.count)
            parts.append((first, second, normal, gap, torch.zeros_like(normal), friction, above, owner))
        *fields, owner = (torch.cat(column) for column in zip(*parts, strict=True))
        return Constraints(*fields), owner

    def positions(self, displacement: Tensor) -> Tensor:
        """Return the positions of the contact samples [m], shape (C, 3), from the node displacement (..., G, 3)."""
        return self.surface.place + weighted(displacement.reshape(-1, 3), self.node, self.weight)

    def normals(self, place: Tensor, displacement: Tensor) -> Tensor:
        """Unit normals of some samples (A,) now, shape (A, 3), from the node displacement (G, 3)."""
        return self._normals(self.node[place], self.slope[place].transpose(0, 1), place, displacement)

    def _normals(self, node: Tensor, slope: Tensor, place: Tensor, displacement: Tensor) -> Tensor:
        gradient = torch.stack([weighted(displacement, node, part) for part in slope.unbind(0)], dim=1)
        F = gradient.mT + torch.eye(3, dtype=gradient.dtype, device=gradient.device)  # gradient: [axis, component]
        a, b, c = F.unbind(-1)
        cofactor = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1)
        return torch.nn.functional.normalize((cofactor * self.surface.normal[place][:, None]).sum(-1), dim=-1)
