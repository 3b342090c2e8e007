r"""Points of the material that boundaries hold exactly: hinges and clamps of the ``total`` formulation.

A held point is a row of constant weights :math:`C` on the nodes: the quadratic B-splines at its rest place, or their
slopes for a clamp. The velocity :math:`v` of the nodes, of mass :math:`M`, is changed as little as possible (Gauss's
principle of least constraint) so that the rows move with their target velocity :math:`g'`:

.. math:: v \leftarrow v - M^{-1} C^T \lambda, \qquad (C M^{-1} C^T)\, \lambda = C v - g'.

:math:`\lambda` is the momentum that each row takes from the body. The projection removes motions and adds no stiffness,
so the stable substep does not shrink. All rows of a body form one system, so pins that share nodes agree.

Rows that nearly depend on others are left out (:func:`independent_rows`). They are sorted by decreasing release time.
With :math:`C M^{-1} C^T = L L^T` and :math:`W = L^{-1}`, both lower triangular, the inverse for the first k rows is
:math:`W^T D W`, where :math:`D` keeps the first k: nothing is factorised during a run. For each time at which a
boundary starts there is a phase with its own rows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gaussian_swaying.geometry.groups import sums
from gaussian_swaying.mpm.body import Body
from gaussian_swaying.mpm.boundaries.boundary import CLOCK, Boundary
from gaussian_swaying.mpm.boundaries.pinned_points import PinnedPoints
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.transfer import bspline_weights

POINTS = ("hinge", "clamp")
"""Kinds of boundaries that hold points."""

MOST_ROWS = 2000
"""Most rows of one scene: its inverse is dense."""

LEAST_OWN = 0.2
"""Least share of a row, in the norm of the inverse mass, that the rows chosen before it must leave over.

The condition of the chosen rows grows with its inverse. Rows at the centres of full cells of uniform mass keep 0.79 of
themselves in a line, 0.63 in a plane and 0.5 in a solid (one over the mean of the inverse of the spectrum
(3/4 + cos(k)/4)² of a line, to the power of one, two and three). Less than a fifth has a second row at nearly the same
place, or a slope along a held line. The condition is then below 50 for hinges and below 200 for clamps, for lines at
any angle and for patches (tested).
"""

LEAST_APART = 0.6
"""Least distance between the points that a region holds [cells].

Two halves of a strip one cell wide are half a cell apart: such a strip is one line, wherever it lies on the grid.
"""

_NO_WEIGHT = 1e-6  # of a node that a particle on the border of its cell does not reach


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of one scene, K in all, on the CPU in float64.

    Attributes:
        node: Nodes of each row, shape (K, 27).
        weight: Their weights, shape (K, 27).
        place: The point at rest [m], or for a slope the step of one cell along its axis [m], shape (K, 3).
        slope: Whether the row is a slope, shape (K,).
        owner: Boundary that holds it, shape (K,).
        start: Time from which it is held [s], shape (K,).
        release: Time at which it is released [s], shape (K,).
    """

    node: Tensor
    weight: Tensor
    place: Tensor
    slope: Tensor
    owner: Tensor
    start: Tensor
    release: Tensor

    def select(self, index: Tensor) -> Rows:
        """Some of the rows."""
        return Rows(*(getattr(self, f.name)[index] for f in fields(self)))

    @staticmethod
    def join(parts: Sequence[Rows]) -> Rows:
        """Rows one after the other."""
        return Rows(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Rows)))


def means(values: Tensor, mass: Tensor, group: Tensor) -> Tensor:
    """The mean of values (P, n) over each group, weighted with masses (P,); groups are numbered from 0, shape (P,)."""
    weighted = torch.cat([mass[:, None] * values, mass[:, None]], dim=-1)
    total = sums(weighted, group)
    return total[:, :-1] / total[:, -1:]


@torch.no_grad()
def groups(position: Tensor, mass: Tensor, cell: Tensor, apart: float) -> Tensor:
    """Group particles by cell, and join groups with close centres until all are some distance apart.

    A strip or a sheet that is thinner than a cell may cross the border of two. Two rows so close together would hold
    its slope; joined they are the line, or the middle plane, that is meant.

    Args:
        position: Positions [m], shape (P, 3).
        mass: Masses [kg], shape (P,).
        cell: A number for the cell of each, shape (P,).
        apart: Least distance between centres [m].

    Returns:
        The number of the group of each particle, shape (P,).
    """
    group = torch.unique(cell, return_inverse=True)[1]
    while len(group):
        centre = means(position, mass, group)
        distance = torch.cdist(centre, centre, compute_mode="donot_use_mm_for_euclid_dist").fill_diagonal_(math.inf)
        own = torch.arange(len(centre))
        least, nearest = distance.min(-1)
        # pairs that are nearest to each other; the first of equals, so that there always is one
        pair = (nearest[nearest] == own) & (least < apart)
        if not bool(pair.any()):
            break
        group = torch.unique(torch.where(pair, own.minimum(nearest), own)[group], return_inverse=True)[1]
    return group


def cells_of_places(place: Tensor, grid: GridSpec, massive: Tensor) -> Tensor:
    """The cell whose nodes all have mass, in or next to each place; the weights of another one would not add up to one.

    Args:
        place: Places at rest [m], shape (N, 3).
        grid: The nodes.
        massive: Whether each node has mass, shape (G,).

    Returns:
        Flat index of the first node of each cell, shape (N,); -1 where there is none.
    """
    lattice = place / grid.dx - torch.tensor(grid.offset, dtype=place.dtype)
    size = torch.tensor(grid.resolution)
    steps = torch.tensor(list(itertools.product((0, -1, 1), repeat=3)))
    first = torch.floor(lattice - 0.5).long()[:, None] + steps  # (N, 27, 3)
    fits = ((first >= 0) & (first <= size - 3)).all(-1)
    flat = flat_index(first.clamp(min=0).minimum(size - 3), grid)
    f = (lattice[:, None] - first).reshape(-1, 3)
    nodes = flat.reshape(-1, 1) + shifts(grid)
    needed = products(bspline_weights(f.T)[0]).abs() > _NO_WEIGHT
    fits &= (massive[nodes] | ~needed).all(-1).reshape(fits.shape)
    beyond = ((f - 1).abs() - 0.5).clamp(min=0).square().sum(-1).reshape(fits.shape)
    best = beyond.where(fits, math.inf).argmin(-1, keepdim=True)
    return flat.where(fits, -1).gather(1, best)[:, 0]


def shifts(grid: GridSpec) -> Tensor:
    """Offsets of the 27 nodes of a stencil from the first, shape (27,)."""
    _, ny, nz = grid.resolution
    return torch.tensor([(i * ny + j) * nz + k for i, j, k in itertools.product(range(3), repeat=3)])


def flat_index(node: Tensor, grid: GridSpec) -> Tensor:
    """Flat index of nodes (..., 3) of a grid."""
    _, ny, nz = grid.resolution
    return (node[..., 0] * ny + node[..., 1]) * nz + node[..., 2]


def products(factors: Tensor) -> Tensor:
    """The 27 products of factors (3 axes, 3 nodes, N) along the axes, shape (N, 27)."""
    x, y, z = factors
    return (x[:, None, None] * (y[:, None] * z)).reshape(27, -1).T


def rows_at(
    place: Tensor,
    first: Tensor,
    grid: GridSpec,
    massive: Tensor,
    clamp: bool,
    owner: int,
    start: float,
    release: Tensor,
) -> Rows:
    """The rows of some points: their values and, for a clamp, their three slopes in units of one cell.

    Args:
        place: The points at rest [m], shape (N, 3).
        first: First node of the cell of each, shape (N,).
        grid: The nodes.
        massive: Whether each node has mass, shape (G,).
        clamp: Whether slopes are held too.
        owner: The boundary.
        start: Time from which they are held [s].
        release: Times of their release [s], shape (N,).
    """
    _, ny, nz = grid.resolution
    corner = torch.stack([first // (ny * nz), first // nz % ny, first % nz], dim=-1) + torch.tensor(grid.offset)
    value, slope = bspline_weights((place / grid.dx - corner).T)
    node = first[:, None] + shifts(grid)
    many = len(place)
    parts = [products(value)]
    places = [place]
    for axis in range(3) if clamp else ():
        chosen = torch.arange(3)[:, None, None] == axis
        parts.append(products(torch.where(chosen, slope, value)))
        places.append(grid.dx * torch.eye(3, dtype=place.dtype)[axis].expand(many, 3))
    copies = len(parts)
    return Rows(
        node.repeat(copies, 1),
        torch.cat(parts) * massive[node].repeat(copies, 1),
        torch.cat(places),
        torch.arange(copies * many) >= many,
        torch.full((copies * many,), owner),
        torch.full((copies * many,), start, dtype=torch.float64),
        release.repeat(copies),
    )


def gram(rows: Rows, inverse_mass: Tensor) -> Tensor:
    """C M^-1 C^T of some rows, shape (K, K), from the inverse masses of the nodes (G,)."""
    nodes, place = torch.unique(rows.node, return_inverse=True)
    dense = rows.weight.new_zeros(len(place), len(nodes)).scatter(1, place, rows.weight)
    return (dense * inverse_mass[nodes]) @ dense.T


@torch.no_grad()
def independent_rows(product: Tensor, rank: Sequence[Tensor], least: float = LEAST_OWN) -> Tensor:
    """Choose rows by a pivoted Cholesky factorisation of their normalised products.

    Args:
        product: Products of the rows, shape (K, K), float64.
        rank: Groups of rows, bool (K,) each. The rows of a group come before those of the next; within a group, the one
            comes first that depends least on those already chosen.
        least: Least remainder of a row, as a share of its own product.

    Returns:
        Indices of the chosen rows in their order, shape (k,).
    """
    own = product.diagonal()
    scale = torch.where(own > 0, own, 1.0).rsqrt()
    normal = scale[:, None] * product * scale
    rest = normal.diagonal().clone()
    factor = torch.zeros_like(normal)
    chosen: list[int] = []
    for group in rank:
        left = torch.where(group, rest, -1.0)
        while True:
            k = int(left.argmax())
            if float(left[k]) <= least:
                break
            n = len(chosen)
            column = (normal[:, k] - factor[:, :n] @ factor[k, :n]) * rest[k].rsqrt()
            factor[:, n] = column
            chosen.append(k)
            rest -= column.square()
            left = torch.where(group, rest, -1.0)
            left[chosen] = -1.0
    return torch.tensor(chosen, dtype=torch.long)


def ranks(rows: Rows) -> list[Tensor]:
    """The groups of :func:`independent_rows`: those released last come first, and values before slopes."""
    times = sorted(set(rows.release.tolist()), reverse=True)
    return [(rows.release == time) & (rows.slope == slope) for time in times for slope in (False, True)]


@dataclass(frozen=True, slots=True)
class DenseHolds:
    """Points held all the time, as the kernels need them: R rows of all scenes, K in each scene.

    Attributes:
        node: Nodes of the rows over all scenes, int32, shape (27, R).
        weight: Their weights, float32, shape (27, R).
        affected: Nodes that a row moves, over all scenes, int32, shape (A,).
        scene: The scene of each of them, int32, shape (A,).
        push: M^-1 C^T (C M^-1 C^T)^-1 of each of them, float32, shape (A, K).
        share: Momentum that each boundary takes for the velocity of a row, float64, shape (scenes, B, K).
    """

    node: Tensor
    weight: Tensor
    affected: Tensor
    scene: Tensor
    push: Tensor
    share: Tensor


class PointHolds:
    """All points that the boundaries of a body hold, bound to its grid.

    Args:
        body: The material and its boundaries.
        kinds: What each of the boundaries holds (``Boundary.hold_kind``).
        first: First node of the cell of each particle, over all scenes, shape (N,).
        grid: The nodes.
        inverse_mass: Their inverse mass [1/kg], 0 for a node without mass, shape (..., G).

    Attributes:
        starts: Times at which a later phase begins [s], shape (phases - 1,).
        node: Nodes of the rows over all scenes, shape (phases, scenes, K, 27).
        weight: Their weights, float64, same shape.
        place: See :class:`Rows`, shape (phases, scenes, K, 3).
        slope: See :class:`Rows`, shape (phases, scenes, K).
        release: Times of release [s], shape (phases, scenes, K); rows that only fill up the shape are never held.
        whitening: W, shape (phases, scenes, K, K), float64.
        taken_by: One where a boundary holds the value of a row, else zero, shape (phases, scenes, boundaries, K).
        affected: Nodes that a row moves, over all scenes, shape (A,).
        entry: The rows of all scenes that move each of them, shape (phases, A, most rows of a node).
        push: How much they move it: M^-1 C^T, same shape.

    Raises:
        ValueError: If there are too many rows, or a place has no material around it.
    """

    def __init__(
        self,
        body: Body,
        kinds: Sequence[str],
        first: Tensor,
        grid: GridSpec,
        inverse_mass: Tensor,
    ) -> None:
        self.boundaries = boundaries = body.boundaries
        position = body.points.position
        self.moving = tuple(k for k, b in enumerate(boundaries) if kinds[k] in POINTS and b.moves)
        device = position.device
        count, nodes = position.shape[-2], grid.node_count
        points = position.reshape(-1, count, 3).cpu().double()
        cell = first.reshape(-1, count).cpu() - nodes * torch.arange(len(points))[:, None]
        inverse = inverse_mass.reshape(-1, nodes).cpu().double()
        scenes = []
        for s in range(len(points)):
            massive = inverse[s].detach() > 0
            parts = []
            for k, boundary in enumerate(boundaries):
                if kinds[k] not in POINTS:
                    continue
                own = body.held[k]
                if isinstance(boundary, PinnedPoints):
                    place = boundary.at.detach().cpu().double()
                    corner = cells_of_places(place, grid, massive)
                    _require_material(boundary, corner)
                    release = None
                else:
                    assert own is not None
                    mass = own.mass.reshape(-1, count)[s].cpu().double()
                    some = (mass > 0).nonzero()[:, 0]
                    group = groups(points[s][some], mass[some], cell[s][some], LEAST_APART * grid.dx)
                    place = means(points[s][some], mass[some], group)
                    corner = cells_of_places(place.detach(), grid, massive)
                    release = None
                    if own.release is not None:
                        when = own.release.reshape(-1, count)[s, :, None].cpu()
                        release = means(when[some], mass[some], group)[:, 0]
                if release is None:
                    release = torch.full((len(corner),), boundary.end, dtype=torch.float64)
                clamp = kinds[k] == "clamp"
                start, release = boundary.holds_from, release.detach()
                parts.append(rows_at(place, corner, grid, massive, clamp, k, start, release))
            scenes.append(Rows.join(parts[::-1]))  # of two boundaries at the same place the last one counts
        later = torch.cat([rows.start for rows in scenes])
        starts = sorted(set(later[later > 0].tolist()))
        kept, factors = [], []
        for start in (0.0, *starts):
            for s, rows in enumerate(scenes):
                rows = rows.select(((rows.start <= start) & (rows.release > start)).nonzero()[:, 0])
                _require_few(rows, boundaries)
                product = gram(rows, inverse[s])
                chosen = independent_rows(product.detach(), ranks(rows))
                kept.append(rows.select(chosen))
                factors.append(torch.linalg.cholesky(product[chosen][:, chosen]))
        self.starts = torch.tensor(starts, dtype=torch.float64, device=device)
        self._stack(kept, factors, len(points), inverse, device)

    def _stack(
        self, kept: list[Rows], factors: list[Tensor], scenes: int, inverse: Tensor, device: torch.device
    ) -> None:
        """Fill up the rows of all phases and scenes to the same number, and find the rows of each node."""
        most = max(len(rows.owner) for rows in kept)
        nodes = inverse.shape[1]
        shape = (-1, scenes, most)

        def full(name: str, nothing: float) -> Tensor:
            values = [getattr(rows, name) for rows in kept]
            filled = [torch.cat([v, v.new_full((most - len(v), *v.shape[1:]), nothing)]) for v in values]
            return torch.stack(filled).reshape(*shape, *values[0].shape[1:])

        weight, slope, release, owner = (
            full("weight", 0),
            full("slope", True),
            full("release", -math.inf),
            full("owner", 0),
        )
        node = full("node", 0) + nodes * torch.arange(scenes)[:, None, None]
        whitening = [torch.linalg.solve_triangular(f, torch.eye(len(f), dtype=f.dtype), upper=False) for f in factors]
        padded = [torch.nn.functional.pad(w, (0, most - len(w), 0, most - len(w))) for w in whitening]
        holds = (owner[..., None, :] == torch.arange(len(self.boundaries))[:, None]) & ~slope[..., None, :]

        affected = torch.unique(node[weight.detach() != 0])
        flat_inverse = inverse.reshape(-1)[affected]
        entries = []
        for own, w in zip(node, weight.detach(), strict=True):
            used = (w.reshape(-1) != 0).nonzero()[:, 0]
            place = torch.searchsorted(affected, own.reshape(-1)[used])
            order = torch.argsort(place, stable=True)
            many = torch.bincount(place, minlength=len(affected))
            within = torch.arange(len(order)) - (many.cumsum(0) - many)[place[order]]
            table = torch.full((len(affected), int(many.max()) if len(many) else 0), w.numel())
            table[place[order], within] = used[order]
            entries.append(table)
        width = max(table.shape[1] for table in entries)
        entry = torch.stack(
            [torch.nn.functional.pad(table, (0, width - table.shape[1]), value=weight[0].numel()) for table in entries]
        )
        flat = torch.nn.functional.pad(weight.reshape(len(kept) // scenes, -1), (0, 1))
        push = torch.stack([w[e] for w, e in zip(flat, entry, strict=True)]) * flat_inverse[:, None]

        self.rows, self.scenes, self.nodes = most, scenes, nodes
        self.node, self.weight, self.place = node.to(device), weight.to(device), full("place", 0).to(device)
        self.slope, self.release, self.owner = slope.to(device), release.to(device), owner.to(device)
        self.whitening = torch.stack(padded).reshape(*shape, most).to(device)
        self.taken_by = holds.double().to(device)
        self.affected, self.entry, self.push = affected.to(device), (entry // 27).to(device), push.to(device)

    def dense(self) -> DenseHolds:
        """The same for the kernels, if the same points are at rest all the time."""
        weight, node = self.weight[0].reshape(-1, 27).float(), self.node[0].reshape(-1, 27)
        inverse = self.whitening[0].mT @ self.whitening[0]
        padded = torch.cat([inverse.flatten(0, 1), inverse.new_zeros(1, self.rows)])
        push = (self.push[0][..., None] * padded[self.entry[0]]).sum(1)
        return DenseHolds(
            node=node.T.int().contiguous(),
            weight=weight.T.contiguous(),
            affected=self.affected.int(),
            scene=(self.affected // self.nodes).int(),
            push=push.float().contiguous(),
            share=self.taken_by[0] @ inverse,
        )

    def condition(self) -> float:
        """The largest condition number of the normalised products of the kept rows, over phases and scenes."""
        worst = 1.0
        for w in self.whitening.detach().cpu().flatten(0, 1):
            w = w[: int((w.diagonal() != 0).sum())]
            w = w[:, : len(w)]
            if len(w):
                inverse = w.T @ w
                factor = torch.linalg.inv(w)
                scale = factor.square().sum(-1).rsqrt()
                values = torch.linalg.eigvalsh(scale[:, None] * torch.linalg.inv(inverse) * scale)
                worst = max(worst, float(values[-1] / values[0]))
        return worst

    def _at(self, field: Tensor, phase: Tensor) -> Tensor:
        """A field of the current phase; the host does not wait."""
        return field[0] if len(self.starts) == 0 else field.index_select(0, phase)[0]

    def hold(self, velocity: Tensor, displacement: Tensor, time: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """Give the held points their target velocity.

        Args:
            velocity: Node velocity [m/s], shape (..., G, 3).
            displacement: Node displacement at the start of the substep [m], shape (..., G, 3).
            time: Time at the start of the substep [s], scalar float64 tensor.
            dt: Substep [s], a number or a scalar float64 tensor.

        Returns:
            The velocity, and the momentum that each boundary took from the body [N s], shape (scenes, boundaries, 3),
            float64.
        """
        now = time + CLOCK
        phase = (now >= self.starts).sum().reshape(1)
        node, weight, W = (self._at(field, phase) for field in (self.node, self.weight, self.whitening))
        flat = velocity.reshape(-1, 3)

        def read(field: Tensor) -> Tensor:
            return (weight[..., None] * field[node].double()).sum(-2)

        rate = read(flat)
        if self.moving:
            rate = rate - self._targets(read(displacement.reshape(-1, 3)), phase, time, dt)
        active = self._at(self.release, phase) > now
        taken = W.mT @ torch.where(active[..., None], W @ rate, 0.0)
        entry, push = self._at(self.entry, phase), self._at(self.push, phase)
        pushed = (push[..., None] * torch.nn.functional.pad(taken.reshape(-1, 3), (0, 0, 0, 1))[entry]).sum(-2)
        own = flat.index_select(0, self.affected)
        flat = flat.index_copy(0, self.affected, own - pushed.to(own))
        return flat.reshape(velocity.shape), self._at(self.taken_by, phase) @ taken.detach()

    def _targets(self, moved: Tensor, phase: Tensor, time: Tensor, dt: float | Tensor) -> Tensor:
        """Target velocity of each row, from how far it moved (scenes, K, 3)."""
        place, slope = self._at(self.place, phase) + moved, self._at(self.slope, phase)[..., None]
        owner = self._at(self.owner, phase)[..., None]
        goal = torch.zeros_like(place)
        for k in self.moving:
            boundary = self.boundaries[k]
            wanted = torch.where(slope, boundary.turning(place, dt), boundary.target(place, time, dt))
            goal = torch.where(owner == k, wanted, goal)
        return goal


def _require_few(rows: Rows, boundaries: Sequence[Boundary]) -> None:
    if len(rows.owner) > MOST_ROWS:
        most = type(boundaries[int(rows.owner.mode().values)]).__name__
        raise ValueError(
            f"The boundaries hold {len(rows.owner):,} points and slopes, more than the {MOST_ROWS:,} that can be held "
            f"exactly: set `kind` of the {most} to nodes."
        )


def _require_material(boundary: Boundary, corner: Tensor) -> None:
    if bool((corner < 0).any()):
        k = int((corner < 0).int().argmax())
        raise ValueError(
            f"The place {k} of `at` of the {type(boundary).__name__} has no material around it: move it to within less "
            "than a cell of the simulated particles."
        )
