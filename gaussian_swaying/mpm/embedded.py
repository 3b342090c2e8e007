"""Motion of the Gaussians with the material: each takes displacement and deformation at its own rest position."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.linalg_triton import add3, load3, load9, matmul, matvec, plus_identity, store3, transpose
from gaussian_swaying.geometry.patches import deform_and_store
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch, replaces
from gaussian_swaying.mpm.shared_kernels import VARIES, axis_weights
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState, State, bounding_grid
from gaussian_swaying.mpm.total_kernels import gather as gather_nodes
from gaussian_swaying.mpm.transfer import Stencil, bspline_stencil, gather, scatter
from gaussian_swaying.mpm.virtual_nodes import first_nodes, point_with_nodes, virtual_nodes

EXTRAPOLATED = 3.0
"""Largest weight of a node at a place, over that at any material point; a node of small weights may swing far."""


@triton.jit(do_not_specialize=VARIES)
def follow(
    fields, first, table, fraction, arm, axes, means, covariance, normal, solid,
    means_out, covariance_out, normal_out, rotation_out, square, per_metre, count, sx, sy, inverse_dx,
    ARM: tl.constexpr, TURN: tl.constexpr, LIMIT: tl.constexpr, BLOCK: tl.constexpr, VIRTUAL: tl.constexpr,
):  # fmt: skip
    """One Gaussian per lane: its displacement and F from the nodes, in the axes of the scene."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    if VIRTUAL:
        node = tl.minimum(index, count - 1)
    else:
        node = tl.load(first + index, mask, 0)
    f = load3(fraction, count, index, mask)
    wz, gz = axis_weights(f[2], inverse_dx)
    u, G, _v = gather_nodes(fields, node, sx, sy, f, wz, gz, inverse_dx, mask, False, table, count, VIRTUAL)
    if ARM:
        u = add3(matvec(G, load3(arm, 1, 3 * index, mask)), 1.0, u)
    zero = 0 * index
    R = load9(axes, 1, zero, mask)
    F = plus_identity(matmul(matmul(transpose(R), G), R))  # G is zero at rest, so that nothing moves there
    x = add3(load3(means, 1, 3 * index, mask), per_metre, matvec(transpose(R), u))
    store3(means_out, 1, 3 * index, x, mask)
    deform_and_store(
        F, covariance, normal, solid, covariance_out, normal_out, rotation_out, square, index, mask, TURN, LIMIT
    )


class EmbeddedPoints(nn.Module, ABC):
    """Points embedded in the material: their motion is interpolated from a state.

    Args:
        arm: From the place that is read to the place that follows, at rest [m], shape (M, 3); it turns and stretches
            with the material. None if they are the same.
    """

    reads: ClassVar[tuple[str, ...]]
    """The fields of a state that the motion depends on."""

    def __init__(self, arm: Tensor | None) -> None:
        super().__init__()
        self.register_buffer("arm", arm, persistent=False)
        self._nodes: tuple[GridSpec, Tensor] | None = None
        self.arm: Tensor | None

    def motion(self, state: Any) -> tuple[Tensor, Tensor]:
        """Displacement [m], shape (M, 3), and deformation gradient, shape (M, 3, 3), in a state of one scene."""
        move, F = self._read(state)
        if self.arm is not None:
            eye = torch.eye(3, dtype=F.dtype, device=F.device)
            move = move + ((F - eye) * self.arm.to(F)[..., None, :]).sum(-1)
        return move, F

    @property
    @abstractmethod
    def places(self) -> Tensor:
        """Rest positions that are read [m], shape (M, 3)."""

    def stencil(self, grid: GridSpec) -> Stencil:
        """The 27 nodes of each place."""
        return embedded_stencil(self.places, grid, self.table(grid))

    def table(self, grid: GridSpec) -> Tensor | None:
        """Nodes of the points, shape (27, M), if the grid has virtual ones."""
        return None

    @abstractmethod
    def some(self, index: Tensor) -> EmbeddedPoints:
        """A subset, by indices (K,)."""

    def nodes(self, state: Any) -> Tensor | None:
        """The nodes that the stencils of the places reach: flat indices in rising order, shape (N,).

        None if the state has no nodes. Their order is the same in every grid that contains them.
        """
        if getattr(state, "node_displacement", None) is None:
            return None
        if self._nodes is None or self._nodes[0] != state.grid:
            self._nodes = (state.grid, self.stencil(state.grid).node.unique())
        return self._nodes[1]

    def nodal(self, state: Any) -> Tensor | None:
        """Displacement of :meth:`nodes` [m], shape (N, 3); None without nodes."""
        nodes = self.nodes(state)
        return None if nodes is None else _nodal(state.node_displacement)[nodes]

    def layout(self, state: Any) -> object:
        """Key of a recording of :meth:`motion`, besides the fields that it reads."""
        return None

    def drawn(
        self,
        state: Any,
        frame: SimFrame,
        means: Tensor,
        covariances: Tensor,
        normals: Tensor,
        rotations: bool,
        max_stretch: float | None,
        solid: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None] | None:
        """Means, covariances, normals and rotations in scene units, in one kernel; None where it cannot run.

        The definition is :meth:`motion` with :func:`~gaussian_swaying.geometry.patches.deform_all`.
        """
        return None

    @abstractmethod
    def velocity(self, state: Any) -> Tensor:
        """Velocity of the places that are read [m/s], shape (M, 3)."""

    @abstractmethod
    def _read(self, state: Any) -> tuple[Tensor, Tensor]:
        """Displacement and deformation gradient of the places that are read."""


class EmbeddedAtPoints(EmbeddedPoints):
    """Embedded points that follow material points.

    Args:
        source: The point that each follows, shape (M,).
        arm: See :class:`EmbeddedPoints`.
        rest: Rest positions of the points [m], shape (P, 3).
        attached: See :class:`~gaussian_swaying.mpm.state.MaterialPoints`; it decides which nodes they reach.
    """

    reads = ("position", "F_total")
    source: Tensor
    rest: Tensor

    def __init__(self, source: Tensor, arm: Tensor | None, rest: Tensor, attached: Tensor | None = None) -> None:
        super().__init__(arm)
        self._attached = attached
        self.register_buffer("source", source, persistent=False)
        self.register_buffer("rest", rest, persistent=False)

    @property
    def places(self) -> Tensor:
        """Rest positions of the points that are followed [m], shape (M, 3)."""
        return self.rest[self.source]

    def some(self, index: Tensor) -> EmbeddedAtPoints:
        arm = None if self.arm is None else self.arm[index]
        return EmbeddedAtPoints(self.source[index], arm, self.rest, self._attached)

    def table(self, grid: GridSpec) -> Tensor | None:
        virtual = virtual_nodes(first_nodes(self.rest, grid), grid, self._attached if grid.virtual else None)
        return None if virtual is None else virtual.node[:, self.source]

    def _read(self, state: State) -> tuple[Tensor, Tensor]:
        return (state.position - self.rest)[self.source], state.F_total[self.source]

    def velocity(self, state: State) -> Tensor:
        """Velocity of the points [m/s], shape (M, 3)."""
        return state.velocity[self.source]


class EmbeddedInGrid(EmbeddedPoints):
    """Embedded points that read the nodal fields of ``total``, each with its own stencil.

    Args:
        place: Rest positions that are read [m], shape (M, 3).
        arm: See :class:`EmbeddedPoints`.
        nodes: The nodes of each, shape (27, M), if they are not those of the lattice (``virtual_nodes``).
    """

    reads = ("node_displacement",)
    place: Tensor

    def __init__(self, place: Tensor, arm: Tensor | None, nodes: Tensor | None = None) -> None:
        super().__init__(arm)
        self.register_buffer("place", place, persistent=False)
        self.register_buffer("own_nodes", nodes, persistent=False)
        self.own_nodes: Tensor | None
        self._known: tuple[GridSpec, torch.device, Stencil] | None = None

    @property
    def places(self) -> Tensor:
        """Rest positions that are read [m], shape (M, 3)."""
        return self.place

    def some(self, index: Tensor) -> EmbeddedInGrid:
        nodes = None if self.own_nodes is None else self.own_nodes[:, index]
        return EmbeddedInGrid(self.place[index], None if self.arm is None else self.arm[index], nodes)

    def table(self, grid: GridSpec) -> Tensor | None:
        return self.own_nodes

    def stencil(self, grid: GridSpec) -> Stencil:
        """The 27 nodes of each follower."""
        known = self._known
        if known is None or known[0] != grid or known[1] != self.place.device:
            with torch.inference_mode(False):  # it outlives the call
                known = (grid, self.place.device, embedded_stencil(self.place, grid, self.own_nodes))
            self._known = known
        return known[2]

    def layout(self, state: MPMState) -> object:
        return state.grid

    def _read(self, state: MPMState) -> tuple[Tensor, Tensor]:
        rows = gather(_nodal(state.node_displacement), self.stencil(state.grid))
        return rows[..., 0, :], rows[..., 1:4, :].mT + torch.eye(3, dtype=rows.dtype, device=rows.device)

    def drawn(
        self,
        state: MPMState,
        frame: SimFrame,
        means: Tensor,
        covariances: Tensor,
        normals: Tensor,
        rotations: bool,
        max_stretch: float | None,
        solid: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None] | None:
        """See :meth:`EmbeddedPoints.drawn`; the kernel runs in float32, without gradients."""
        displacement = _nodal(state.node_displacement)
        if not replaces((displacement, means, covariances, normals, self.place)):
            return None
        fields = displacement.new_zeros(len(displacement), 8)
        fields[:, :3] = displacement
        axes = frame.direction_to_sim(torch.eye(3, device=means.device)).mT  # from those of the scene to z up
        given = [tensor.detach().contiguous() for tensor in (means, covariances, normals)]
        made = [torch.empty_like(tensor) for tensor in given]
        turns = torch.empty_like(given[1]) if rotations else given[1]
        limit = max_stretch is not None and solid is not None
        keeps = fields if solid is None or not limit else solid.contiguous().view(torch.int8)
        stencil, (_, ny, nz) = self.stencil(state.grid), state.grid.resolution
        table = stencil.first if stencil.nodes is None else stencil.nodes.contiguous()
        count, block = len(means), lanes(fields.device, 128)
        if count > 0:
            with torch.cuda.device_of(fields):
                launch(follow, (-(-count // block),))(
                    fields, stencil.first, table, stencil.fraction.contiguous(),
                    fields if self.arm is None else self.arm.contiguous(), axes.contiguous(), *given, keeps, *made,
                    turns, float(max_stretch or 1) ** 2, 1 / frame.metres_per_unit, count, ny * nz, nz,
                    1 / state.grid.dx, ARM=self.arm is not None, TURN=rotations, LIMIT=limit, BLOCK=block,
                    VIRTUAL=stencil.nodes is not None,
                )  # fmt: skip
        return made[0], made[1], made[2], turns if rotations else None

    def velocity(self, state: MPMState) -> Tensor:
        """Velocity of the material [m/s], shape (M, 3)."""
        return gather(_nodal(state.node_velocity), self.stencil(state.grid))[..., 0, :]


def embedded_stencil(place: Tensor, grid: GridSpec, nodes: Tensor | None = None) -> Stencil:
    """The interpolation stencil of embedded points at places (M, 3) [m]."""
    return bspline_stencil(place, grid, moments=False, snap=torch.finfo(place.dtype).eps ** 0.5, nodes=nodes)


def _nodal(field: Tensor | None) -> Tensor:
    if field is None:
        raise ValueError(
            "The Gaussians follow grid nodes, which only the total formulation keeps: set `scene.points` to gaussian."
        )
    return field


@torch.no_grad()
def on_material(place: Tensor, nearest: Tensor, points: MaterialPoints, dx: float) -> tuple[Tensor, Tensor | None]:
    """Readable places: the given ones if all their nodes have mass, otherwise a nearby material point.

    A group's nodes are those of all its members, except where the centre of mass lies on the border of its cell.

    Args:
        place: Rest positions [m], shape (M, 3), float64.
        nearest: A material point close to each, shape (M,); with ``attached`` parts, one of the part that it follows.

    Returns:
        The places, shape (M, 3), and the nodes of each, shape (27, M), or None if they are those of the lattice.
    """
    position = points.position
    grid = bounding_grid(position.amin(0), position.amax(0), dx, margin=0)
    rest = embedded_stencil(position, grid)
    virtual = virtual_nodes(rest.first, grid, points.attached)
    own = embedded_stencil(place.to(position), grid)
    if virtual is None:
        mass = scatter(rest, points.mass[:, None, None])[:, 0]
        empty = gather((mass <= 0).to(mass)[:, None], own)[:, 0, 0]
        return torch.where((own.inside & (empty == 0))[:, None], place, position[nearest]), None
    first, node = rest.first.cpu(), virtual.node.cpu()
    near = nearest.cpu()
    host = point_with_nodes(own.first.cpu(), near, first, node, grid).where(own.inside.cpu(), -1)
    most = torch.zeros(int(node.max()) + 1, dtype=position.dtype)  # largest weight of each node at any material point
    most.scatter_reduce_(0, node.T.reshape(-1), rest.basis[:, 0].cpu().reshape(-1), "amax")
    far = own.basis[:, 0].cpu() > EXTRAPOLATED * most[node.T[host.clamp(min=0)]]
    host = host.where(~far.any(1), -1)
    read = torch.where((host >= 0)[:, None].to(place.device), place, position[nearest])
    return read, virtual.node[:, torch.where(host >= 0, host, near).to(nearest.device)]
