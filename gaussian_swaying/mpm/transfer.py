r"""Particle-grid transfers with quadratic B-splines: sums over the 27 nodes around each particle.

Both formulations of the solver use :func:`scatter` and :func:`gather`; they differ only in the positions for which
:func:`bspline_stencil` was called. This is the reference implementation: it works on any device and is differentiable.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying.geometry.groups import equal_rows
from gaussian_swaying.mpm.state import GridSpec


@dataclass(frozen=True)
class Stencil:
    """The 27 nodes around each of N particles.

    Attributes:
        first: Flat index, over all scenes of the batch, of the lowest node on the lattice, shape (N,).
        fraction: Place of the particles in cells from that node, shape (3, N).
        inside: Particles whose 27 nodes all lie in the grid, shape (..., P). The others have no weight.
        moments: Whether ``basis`` has the last three rows.
        deterministic: Whether sums over particles have the same order in every run on a GPU.
        nodes: Flat indices of the nodes, shape (27, N), where they are not those of the lattice (``virtual_nodes``).
    """

    first: Tensor
    fraction: Tensor
    inside: Tensor
    grid: GridSpec
    moments: bool
    deterministic: bool = False
    nodes: Tensor | None = None

    @cached_property
    def node(self) -> Tensor:
        """Flat indices of the nodes, shape (N, 27), x first."""
        if self.nodes is not None:
            return self.nodes.T
        return self.first[:, None] + _grid_constants(self.grid, self.first.device)[3]

    @cached_property
    def basis(self) -> Tensor:
        """The weights, their derivatives along x, y and z and, with moments, ``w (x_i - x_p)``, shape (N, rows, 27)."""
        with torch.inference_mode(False):  # kept for later
            inside, dx = self.inside.reshape(-1), self.grid.dx
            w, slope = bspline_weights(self.fraction)
            w = w * inside
            kinds = [slope / dx * inside]
            if self.moments:
                reach = torch.arange(3, device=w.device, dtype=w.dtype)
                kinds.append(w * ((reach[:, None] - self.fraction[:, None]) * dx))

            def product(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
                return (x[:, None, None] * (y[:, None] * z)).reshape(27, -1)

            rows = [product(*w)]
            rows += [product(*(k[a] if a == axis else w[a] for a in range(3))) for k in kinds for axis in range(3)]
            return torch.stack(rows).permute(2, 0, 1).contiguous()

    @property
    def cell(self) -> Tensor:
        """A number for each particle, shape (N,), the same for those of a cell that have the same nodes."""
        return self.first if self.nodes is None else equal_rows(torch.cat([self.first[:, None], self.node], 1))


def bspline_stencil(
    position: Tensor,
    grid: GridSpec,
    moments: bool = True,
    snap: float = 0.0,
    deterministic: bool = False,
    nodes: Tensor | None = None,
) -> Stencil:
    r"""Quadratic B-spline weights and their gradients (Jiang et al. 2016, "The material point method", eq. 123).

    A particle whose support reaches beyond the grid, or whose position is NaN or infinite, is never wrapped to the far
    side: its weights are zero and ``inside`` is False.

    Args:
        position: Particle position [m], shape (..., P, 3).
        snap: A particle within ``snap * dx`` of a plane where a weight vanishes is moved onto it for this stencil, so
            that no node is left with only a vanishing mass.

    Example:
        >>> stencil = bspline_stencil(torch.full((1, 3), 0.5), GridSpec(0.1, (0, 0, 0), (10, 10, 10)))
        >>> bool(stencil.inside.all()), stencil.basis.shape
        (True, torch.Size([1, 7, 27]))
    """
    check_shape("position", position, "P", 3)
    lattice = position.reshape(-1, 3).T / grid.dx
    base = torch.floor(lattice.detach() - 0.5)
    f = lattice - base
    offset, limit, strides, _ = _grid_constants(grid, position.device)
    low = base.long() - offset
    inside = ((low >= 0) & (low <= limit) & (f < 2)).all(0)  # NaN becomes an arbitrary integer; NaN < 2 is False
    f = torch.where(inside, f, 1.0)
    if snap > 0:
        f = torch.where(f - 0.5 < snap, 0.5, torch.where(1.5 - f < snap, 1.5, f))
    scene = torch.arange(inside.numel(), device=position.device) // max(position.shape[-2], 1)
    first = (torch.where(inside, low, 0) * strides).sum(0) + scene * grid.node_count
    return Stencil(first, f, inside.reshape(position.shape[:-1]), grid, moments, deterministic, nodes)


def bspline_weights(f: Tensor) -> tuple[Tensor, Tensor]:
    """The three weights of each axis, and their slopes per cell.

    Args:
        f: Position in cells from the first of the three nodes, shape (3 axes, N); from 0.5 to 1.5 between the borders
            of the stencil's cell. Beyond them the same polynomials extrapolate.

    Returns:
        Both of shape (3 axes, 3 nodes, N).
    """
    weight = torch.stack([0.5 * (1.5 - f).square(), 0.75 - (f - 1).square(), 0.5 * (f - 0.5).square()], dim=1)
    return weight, torch.stack([f - 1.5, 2 - 2 * f, f - 0.5], dim=1)


@lru_cache(maxsize=64)
def _grid_constants(grid: GridSpec, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Offset, largest first node, strides and the 27 shifts, kept on the device so that a step copies nothing to it."""
    nx, ny, nz = grid.resolution
    with torch.inference_mode(False):
        columns = torch.tensor([grid.offset, (nx - 3, ny - 3, nz - 3), (ny * nz, nz, 1)], device=device)
        offset, limit, strides = columns[:, :, None]
        reach = torch.arange(3, device=device)
        return offset, limit, strides, (torch.cartesian_prod(reach, reach, reach) * strides[:, 0]).sum(-1)


def shifts(grid: GridSpec) -> Tensor:
    """Offsets of the 27 nodes of a stencil from the first, shape (27,), on the CPU."""
    return _grid_constants(grid, torch.device("cpu"))[3]


@contextmanager
def in_fixed_order(wanted: bool) -> Iterator[None]:
    """Make PyTorch sum in a fixed order on a GPU, if wanted.

    ``torch.use_deterministic_algorithms`` would do the same, but it also imports all of torch's compiler.
    """
    before = torch.get_deterministic_debug_mode()
    if wanted:
        torch.set_deterministic_debug_mode("error")
    try:
        yield
    finally:
        if wanted:
            torch.set_deterministic_debug_mode(before)


def scatter(stencil: Stencil, coefficients: Tensor, fixed_order: bool = False) -> Tensor:
    r"""Sum over particles to the nodes: :math:`q_i = \sum_p \sum_a b_{a,ip}\, c_{a,p}`.

    With rows of ``basis`` for :math:`b`: the first coefficient multiplies :math:`w_{ip}`, the next three
    :math:`\nabla w_{ip}` and the last three (if the stencil has moments) :math:`w_{ip} (x_i - x_p)`. On CUDA the order
    of the sum is not fixed, so two runs may differ by round-off, unless the stencil is ``deterministic``.

    Args:
        fixed_order: As ``deterministic``, for this sum.

    Returns:
        Shape (..., G, K).
    """
    rows, columns = coefficients.shape[-2:]
    values = stencil.basis[:, :rows].mT @ coefficients.reshape(-1, rows, columns)
    batch, nodes = stencil.inside.shape[:-1], stencil.grid.node_count
    out = values.new_zeros(math.prod(batch) * nodes, columns)
    with in_fixed_order((fixed_order or stencil.deterministic) and out.is_cuda):
        out = out.index_add(0, stencil.node.reshape(-1), values.reshape(-1, columns))
    return out.reshape(*batch, nodes, columns)


def gather(field: Tensor, stencil: Stencil) -> Tensor:
    r"""Interpolate a nodal field at the particles: :math:`r_{a,p} = \sum_i b_{a,ip}\, q_i`, the adjoint of scatter.

    Args:
        field: Nodal field, shape (..., G, K).

    Returns:
        Shape (..., P, A, K): row 0 the value, rows 1 to 3 the derivative along x, y, z, rows 4 to 6 the moments if the
        stencil has them.
    """
    columns = field.shape[-1]
    values = field.reshape(-1, columns).index_select(0, stencil.node.reshape(-1)).reshape(-1, 27, columns)
    return (stencil.basis @ values).reshape(*stencil.inside.shape, -1, columns)


def scatter_momentum(
    mass: Tensor, velocity: Tensor, affine: Tensor, impulse: Tensor | None, stress_impulse: Tensor, stencil: Stencil
) -> Tensor:
    r"""One scatter of everything the ``updated`` grid update needs (paper, supplement, "MPM Algorithm"), with APIC.

    :math:`\sum_p w_{ip} m_p (v_p + C_p (x_i - x_p)) + w_{ip}\, j_p - S_p \nabla w_{ip}` and the mass, with
    :math:`j_p = \Delta t\, f_p` and :math:`S_p = \Delta t\, V^0_p \tau_p`. The first part (Jiang et al. 2015) conserves
    mass, linear and angular momentum to round-off.

    Args:
        mass: Particle mass [kg], shape (..., P).
        velocity: Particle velocity [m/s], shape (..., P, 3).
        affine: Affine velocity [1/s], shape (..., P, 3, 3).
        impulse: External impulse [N s], shape (..., P, 3), or None.
        stress_impulse: Stress times rest volume times time [N m s], shape (..., P, 3, 3).

    Returns:
        Momentum [kg m/s] in columns 0 to 2 and mass [kg] in column 3, shape (..., G, 4).
    """
    momentum = mass[..., None] * velocity
    value = momentum if impulse is None else momentum + impulse
    rows = torch.cat([value[..., None, :], -stress_impulse.mT, mass[..., None, None] * affine.mT], dim=-2)
    own = torch.nn.functional.pad(mass[..., None, None], (0, 0, 0, 6))
    return scatter(stencil, torch.cat([rows, own], dim=-1))


def g2p(node_velocity: Tensor, stencil: Stencil) -> tuple[Tensor, Tensor, Tensor]:
    r"""Gather velocity, affine velocity and velocity gradient from the grid.

    :math:`C_p = \frac{4}{\Delta x^2} \sum_i w_{ip} v_i (x_i - x_p)^T` is the paper's :math:`12 / (\Delta x^2 (b + 1))`
    for the degree b = 2.

    Args:
        node_velocity: Node velocity [m/s], shape (..., G, 3).

    Returns:
        Velocity [m/s] (..., P, 3), affine velocity [1/s] (..., P, 3, 3), velocity gradient [1/s] (..., P, 3, 3).
    """
    rows = gather(node_velocity, stencil)
    return rows[..., 0, :], (4.0 / stencil.grid.dx**2) * rows[..., -3:, :].mT, rows[..., 1:4, :].mT
