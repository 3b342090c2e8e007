r"""Points of the material that boundaries hold exactly: hinges and clamps of the ``total`` formulation.

A held point is a constraint row of constant weights :math:`C` on the nodes: the quadratic B-splines at its rest place,
or their slopes for a clamp (:mod:`~gaussian_swaying.mpm.held_rows`). A clamped region is held on its face
(:mod:`~gaussian_swaying.mpm.held_faces`), and the nodes behind it by the boundary itself: no row moves them. The
velocity :math:`v` of the nodes, of mass :math:`M`, is changed as little as possible (Gauss's principle of least
constraint) so that the rows move with their target velocity :math:`g'`:

.. math:: v \leftarrow v - M^{-1} C^T \lambda, \qquad (C M^{-1} C^T)\, \lambda = C v - g'.

:math:`\lambda` is the reaction impulse: the momentum that each row takes from the body. The projection removes motions
and adds no stiffness, so the stable substep does not shrink. All rows of a body form one system, so pins that share
nodes agree.

Rows that nearly depend on others are left out (``independent_rows``). They are sorted by decreasing release time.
With :math:`C M^{-1} C^T = L L^T` and :math:`W = L^{-1}`, both lower triangular, the inverse for the first k rows is
:math:`W^T D W`, where :math:`D` keeps the first k: nothing is factorised during a run. For each time at which a
boundary starts there is a phase with its own rows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.mpm.boundary import CLOCK, Boundary
from gaussian_swaying.mpm.formulation import Formulation
from gaussian_swaying.mpm.held_faces import SHEET, face_patches, normals, thickness
from gaussian_swaying.mpm.held_rows import (
    LEAST_APART,
    LEAST_OWN,
    LEAST_OWN_ON_A_FACE,
    MOST_ROWS,
    Rows,
    cells_of_places,
    from_middle_plane,
    gram,
    groups,
    independent_rows,
    means,
    ranks,
    rows_at,
)
from gaussian_swaying.mpm.pins import PinnedPoints
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.transfer import Stencil
from gaussian_swaying.mpm.virtual_nodes import first_nodes, point_with_nodes

POINTS = ("hinge", "clamp")
"""Kinds of boundaries that hold points."""


@dataclass(frozen=True, slots=True)
class DenseHolds:
    """Points held all the time, as the kernels need them: R rows of all scenes, K in each scene.

    Attributes:
        node: Nodes of the rows over all scenes, int32, shape (27, R).
        weight: Their weights, shape (27, R).
        affected: Nodes that a row moves, over all scenes, int32, shape (A,).
        scene: The scene of each of them, int32, shape (A,).
        push: M^-1 C^T (C M^-1 C^T)^-1 of each of them, shape (A, K).
        share: Momentum that each boundary takes for the velocity of a row, float64, shape (scenes, B, K).
    """

    node: Tensor
    weight: Tensor
    affected: Tensor
    scene: Tensor
    push: Tensor
    share: Tensor


@contextmanager
def _one_thread() -> Iterator[None]:
    """Within the block torch uses one thread: products of matrices round in another way for each number of them."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True)
class _Site:
    """The particles of one scene on its nodes, where points are held; on the CPU.

    Attributes:
        points: Positions at rest [m], float64, shape (P, 3).
        cell: First node of the cell of each, shape (P,).
        node: Their nodes, shape (27, P); None for those of the lattice.
        grid: The nodes.
        massive: Which of them have mass, shape (G,).
    """

    points: Tensor
    cell: Tensor
    node: Tensor | None
    grid: GridSpec
    massive: Tensor

    def rows(self, body: Formulation, k: int, kind: str, on_face: bool, scene: int, piece: Tensor | None) -> Rows:
        """The rows of the ``k``-th boundary in a scene, on a piece of the body or on all of it (None)."""
        boundary, own, least = body.boundaries[k], body.held[k], LEAST_OWN
        count, dx = len(self.points), self.grid.dx
        clamped = torch.eye(3, dtype=torch.float64) if kind == "clamp" else torch.zeros(0, 3)
        whole = body.points.mass.reshape(-1, count)[scene].detach().cpu().double()
        points = self.points if piece is None else self.points[piece]
        whole = whole if piece is None else whole[piece]

        def of_piece(field: Tensor) -> Tensor:
            field = field.reshape(-1, count)[scene].cpu()
            return field if piece is None else field[piece]

        release = None
        if isinstance(boundary, PinnedPoints):
            place = boundary.at.detach().cpu().double()
            corner, node = self._cells(place, None)
            _require_material(boundary, corner)
            along = clamped.expand(len(place), -1, 3)
        elif on_face:
            assert own is not None
            place, along = face_patches(points, whole, of_piece(own.mass) > 0, dx)
            corner, node = self._cells(place, piece)
            some = (corner >= 0).nonzero()[:, 0]
            place, along, corner = place[some], along[some], corner[some]
            node, least = None if node is None else node[some], LEAST_OWN_ON_A_FACE
        else:
            assert own is not None
            mass = of_piece(own.mass).double()
            some = (mass > 0).nonzero()[:, 0]
            normal, held, place = None, points[some].detach(), points[some]
            if kind == "hinge" and thickness(points.detach(), whole, held, dx)[1] and len(some):
                normal = normals(points.detach(), whole, held, dx)
                off = from_middle_plane(held, mass[some], normal, LEAST_APART * dx, SHEET * dx)
                held, place = held - off, place - off
            cell = self.cell if piece is None else self.cell[piece]
            group = groups(held, mass[some], cell[some], LEAST_APART * dx, normal, SHEET * dx)
            place = means(place, mass[some], group)
            corner, node = self._cells(place.detach(), piece)
            along = clamped.expand(len(place), -1, 3)
            if own.release is not None:
                release = means(of_piece(own.release)[some][:, None], mass[some], group)[:, 0]
        if release is None:
            release = torch.full((len(corner),), boundary.end, dtype=torch.float64)
        at = (place, corner, self.grid, self.massive, along, least)
        return rows_at(*at, k, boundary.holds_from, release.detach(), node)

    def _cells(self, place: Tensor, piece: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """The cell of each place, -1 where there is none, and its nodes, shape (N, 27), if they are not the lattice's.

        With virtual nodes a place has those of the material point that is nearest to it, in the same cell if it can be.
        """
        if self.node is None:
            return cells_of_places(place, self.grid, self.massive), None
        points = self.points.detach() if piece is None else self.points[piece].detach()
        distance, index = (found[:, 0] for found in nearest_neighbours(points, 1, place.detach()))
        near = index if piece is None else piece[index]
        own = first_nodes(place.detach(), self.grid)
        host = point_with_nodes(own, near, self.cell, self.node, self.grid)
        host = torch.where(host < 0, near, host)
        return self.cell[host].where(distance < 2 * self.grid.dx, -1), self.node[:, host].T


class PointHolds:
    """All points that the boundaries of a body hold, bound to its grid.

    Args:
        body: The material and its boundaries.
        kinds: Kind of each boundary (``Boundary.hold_kind``).
        faces: Those that clamp a region, which is held on its face.
        still: Nodes that they hold themselves, bool, shape (..., G).
        stencil: The nodes of the particles.
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
        taken_by: Momentum that a boundary takes for a multiplier of one, shape (phases, scenes, boundaries, K): one for
            the value of a row of its own, and zero for a slope, but for rows that reach nodes which a clamp holds.
        affected: Nodes that a row moves, over all scenes, shape (A,).
        entry: The rows of all scenes that move each of them, shape (phases, A, most rows of a node).
        push: Entries of M^-1 C^T for these rows and nodes, same shape.

    Raises:
        ValueError: If there are too many rows, or a place has no material around it.
    """

    @_one_thread()
    def __init__(
        self,
        body: Formulation,
        kinds: Sequence[str],
        faces: Sequence[int],
        still: Tensor,
        stencil: Stencil,
        grid: GridSpec,
        inverse_mass: Tensor,
    ) -> None:
        self.boundaries = boundaries = body.boundaries
        position = body.points.position
        self.moving = tuple(k for k, b in enumerate(boundaries) if kinds[k] in POINTS and b.moves)
        device = position.device
        count, nodes = position.shape[-2], grid.node_count
        points = position.reshape(-1, count, 3).cpu().double()
        cell = stencil.first.reshape(-1, count).cpu() - nodes * torch.arange(len(points))[:, None]
        inverse = inverse_mass.reshape(-1, nodes).cpu().double()
        with_mass = inverse.detach() > 0
        inverse = inverse.where(~still.reshape(-1, nodes).cpu(), 0.0)
        scenes = []
        for s in range(len(points)):
            own_nodes = None
            if stencil.nodes is not None:
                own_nodes = stencil.nodes.reshape(27, -1, count)[:, s].cpu() - s * nodes
            site = _Site(points[s], cell[s], own_nodes, grid, with_mass[s])
            parts = [
                site.rows(body, k, kinds[k], k in faces, s, piece)
                for k in range(len(boundaries))
                if kinds[k] in POINTS
                for piece in _pieces(body, k, s)
            ]
            scenes.append(Rows.join(parts[::-1]))  # of two boundaries at the same place the last one counts
        later = torch.cat([rows.start for rows in scenes])
        starts = sorted(set(later[later > 0].tolist()))
        kept, factors = [], []
        for start in (0.0, *starts):
            for s, rows in enumerate(scenes):
                rows = rows.select(((rows.start <= start) & (rows.release > start)).nonzero()[:, 0])
                _require_few(rows, boundaries)
                product = gram(rows, inverse[s])
                chosen = independent_rows(product.detach(), ranks(rows), rows.least)
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
        shape = (len(kept) // scenes, scenes, most)

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
        free = inverse.detach().reshape(-1)[node] > 0
        moved = torch.where((weight.detach() != 0) & ~free, 1.0, 0.0).amax(-1) > 0
        momentum = torch.where(moved, (weight.detach() * free).sum(-1), (~slope).double())
        holds = (owner[..., None, :] == torch.arange(len(self.boundaries))[:, None]) * momentum[..., None, :]

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
        self.taken_by = holds.to(device)
        self.affected, self.entry, self.push = affected.to(device), (entry // 27).to(device), push.to(device)

    @_one_thread()
    def dense(self, dtype: torch.dtype) -> DenseHolds:
        """The same for the kernels, if the same points are at rest all the time."""
        weight, node = self.weight[0].reshape(-1, 27).to(dtype), self.node[0].reshape(-1, 27)
        inverse = self.whitening[0].mT @ self.whitening[0]
        padded = torch.cat([inverse.flatten(0, 1), inverse.new_zeros(1, self.rows)])
        push = (self.push[0][..., None] * padded[self.entry[0]]).sum(1)
        return DenseHolds(
            node=node.T.int().contiguous(),
            weight=weight.T.contiguous(),
            affected=self.affected.int(),
            scene=(self.affected // self.nodes).int(),
            push=push.to(dtype).contiguous(),
            share=self.taken_by[0] @ inverse,
        )

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
        flat = velocity.reshape(-1, 3).to(self.weight.device)

        def read(field: Tensor) -> Tensor:
            return (weight[..., None] * field[node].double()).sum(-2)

        rate = read(flat)
        if self.moving:
            moved = read(displacement.reshape(-1, 3).to(self.weight.device))
            rate = rate - self._targets(moved, phase, time, dt)
        active = self._at(self.release, phase) > now
        taken = W.mT @ torch.where(active[..., None], W @ rate, 0.0)
        entry, push = self._at(self.entry, phase), self._at(self.push, phase)
        pushed = (push[..., None] * torch.nn.functional.pad(taken.reshape(-1, 3), (0, 0, 0, 1))[entry]).sum(-2)
        own = flat.index_select(0, self.affected)
        flat = flat.index_copy(0, self.affected, own - pushed.to(own))
        return flat.reshape(velocity.shape).to(velocity.device), self._at(self.taken_by, phase) @ taken.detach()

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


def _pieces(body: Formulation, k: int, scene: int) -> list[Tensor | None]:
    """The pieces of which a boundary holds particles in a scene; one of None if all particles are one piece."""
    held = body.held[k]
    if held is None or len(body.pieces) == 1:
        return [None]
    own = held.mass.reshape(-1, held.mass.shape[-1])[scene].cpu() > 0
    return [piece for piece in body.pieces if piece is None or bool(own[piece].any())]


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
