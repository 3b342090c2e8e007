r"""Particle-grid transfers with quadratic B-splines as batched gather and scatter.

Both formulations of the solver go through :func:`scatter` and :func:`gather`; they differ only in the positions at
which :func:`bspline_stencil` was built. This is the definition, on any device and differentiable.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying.mpm.state import GridSpec


@dataclass(frozen=True, slots=True)
class Stencil:
    """The 27 nodes around each particle.

    Attributes:
        node: Flat index of the nodes over all scenes of the batch, shape (N * 27,), N particles in all scenes.
        basis: For each particle the rows ``w``, then as asked for ``dw/dx``, ``dw/dy``, ``dw/dz`` and
            ``w (x_i - x_p)`` (3 rows), shape (N, 4 or 7, 27).
        inside: Particles whose 27 nodes all lie in the grid, shape (..., P). The others have no weight.
        batch: Leading batch shape.
        node_count: Nodes G of one scene.
        order: Order of the entries of ``node`` that sorts them, for sums that are the same in every run, or None.
        start: Where the entries of each node begin in that order, shape (all nodes + 1,), or None.
    """

    node: Tensor
    basis: Tensor
    inside: Tensor
    batch: tuple[int, ...]
    node_count: int
    order: Tensor | None = None
    start: Tensor | None = None


def bspline_stencil(
    position: Tensor,
    grid: GridSpec,
    moments: bool = True,
    snap: float = 0.0,
    gradients: bool = True,
    deterministic: bool = False,
) -> Stencil:
    r"""Quadratic B-spline weights and their gradients (Jiang et al. 2016, "The material point method", eq. 123).

    A particle whose support reaches out of the grid is never wrapped to the far side: its weights are zero and
    ``inside`` says so.

    Args:
        position: Particle position [m], shape (..., P, 3).
        grid: The nodes.
        moments: Also keep ``w (x_i - x_p)``, which APIC needs.
        snap: A particle within ``snap * dx`` of a plane where a weight vanishes is moved onto it for this stencil, so
            that no node hangs by a vanishing mass alone.
        gradients: Also keep the gradients of the weights; MLS-MPM does without.
        deterministic: Also sort the nodes, so that sums over particles take the same order in every run on a GPU.

    Returns:
        The support of each particle.

    Raises:
        ValueError: If ``position`` does not have the shape above.

    Example:
        >>> stencil = bspline_stencil(torch.full((1, 3), 0.5), GridSpec(0.1, (0, 0, 0), (10, 10, 10)))
        >>> bool(stencil.inside.all()), stencil.basis.shape
        (True, torch.Size([1, 7, 27]))
    """
    check_shape("position", position, "P", 3)
    dx = grid.dx
    batch = tuple(position.shape[:-2])
    lattice = position.reshape(-1, 3) / dx
    base = torch.floor(lattice.detach() - 0.5)
    f = lattice - base
    if snap > 0:
        f = torch.where(f - 0.5 < snap, 0.5, torch.where(1.5 - f < snap, 1.5, f))
    w = torch.stack([0.5 * (1.5 - f).square(), 0.75 - (f - 1).square(), 0.5 * (f - 0.5).square()], dim=1)
    dw = torch.stack([f - 1.5, 2 - 2 * f, f - 0.5], dim=1) / dx

    offset, limit, strides, shift = _grid_constants(grid, position.device)
    first = base.long() - offset
    inside = ((first >= 0) & (first <= limit)).all(-1)
    start = (torch.where(inside[:, None], first, 0) * strides).sum(-1)
    if batch:
        scene = torch.arange(inside.numel(), device=position.device) // max(position.shape[-2], 1)
        start = start + scene * grid.node_count
    node = (start[:, None] + shift).reshape(-1)

    w = w * inside[:, None, None]
    dw = dw * inside[:, None, None]
    (wx, wy, wz), (gx, gy, gz) = w.unbind(-1), dw.unbind(-1)

    def product(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return (a[:, :, None, None] * (b[:, :, None] * c[:, None, :])[:, None]).reshape(-1, 27)

    rows = [product(wx, wy, wz)]
    if gradients:
        rows += [product(gx, wy, wz), product(wx, gy, wz), product(wx, wy, gz)]
    if moments:
        reach = torch.arange(3, device=f.device, dtype=f.dtype)
        d = (reach[:, None] - f[:, None, :]) * dx
        mx, my, mz = (w * d).unbind(-1)
        rows += [product(mx, wy, wz), product(wx, my, wz), product(wx, wy, mz)]
    order = border = None
    if deterministic:
        ranked, order = torch.sort(node, stable=True)
        nodes = torch.arange(math.prod(batch) * grid.node_count + 1, device=node.device)
        border = torch.searchsorted(ranked, nodes)
    basis = torch.stack(rows, dim=1)
    return Stencil(node, basis, inside.reshape(position.shape[:-1]), batch, grid.node_count, order, border)


@lru_cache(maxsize=64)
def _grid_constants(grid: GridSpec, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Offset, largest first node, strides and the 27 shifts, kept on the device so that a step copies nothing to it."""
    nx, ny, nz = grid.resolution
    with torch.inference_mode(False):
        offset = torch.tensor(grid.offset, device=device)
        limit = torch.tensor([nx - 3, ny - 3, nz - 3], device=device)
        strides = torch.tensor([ny * nz, nz, 1], device=device)
        reach = torch.arange(3, device=device)
        shift = reach[:, None, None] * (ny * nz) + reach[:, None] * nz + reach
    return offset, limit, strides, shift.reshape(-1)


def scatter(stencil: Stencil, coefficients: Tensor) -> Tensor:
    r"""Sum over particles to the nodes: :math:`q_i = \sum_p \sum_a b_{a,ip}\, c_{a,p}`.

    With rows of ``basis`` for :math:`b`: the first coefficient multiplies :math:`w_{ip}`, the next three
    :math:`\nabla w_{ip}` and the last three (if the stencil has moments) :math:`w_{ip} (x_i - x_p)`. On CUDA the order
    of the sum is not fixed, so two runs may differ by round-off, unless the stencil is ``deterministic``.

    Args:
        stencil: Support of each particle.
        coefficients: Shape (..., P, A, K) with A at most the number of basis rows and K columns.

    Returns:
        Shape (..., G, K).
    """
    rows, columns = coefficients.shape[-2:]
    flat = coefficients.reshape(-1, rows, columns)
    values = torch.bmm(stencil.basis[:, :rows].mT, flat).reshape(-1, columns)
    if stencil.order is not None:
        ranked = values.index_select(0, stencil.order)
        out = torch.segment_reduce(ranked, "sum", offsets=stencil.start, unsafe=True, initial=0)
    else:
        out = values.new_zeros(math.prod(stencil.batch) * stencil.node_count, columns)
        # in place on a fresh tensor: differentiable, and half the memory traffic of the copying form
        out = out.index_add_(0, stencil.node, values)
    return out.reshape(*stencil.batch, stencil.node_count, columns)


def gather(field: Tensor, stencil: Stencil) -> Tensor:
    r"""Interpolate a nodal field at the particles: :math:`r_{a,p} = \sum_i b_{a,ip}\, q_i`, the adjoint of scatter.

    Args:
        field: Nodal field, shape (..., G, K).
        stencil: Support of each particle.

    Returns:
        Shape (..., P, A, K): row 0 the value, rows 1 to 3 the derivative along x, y, z, rows 4 to 6 the moments if the
        stencil has them.
    """
    columns = field.shape[-1]
    values = field.reshape(-1, columns).index_select(0, stencil.node).reshape(-1, 27, columns)
    return torch.bmm(stencil.basis, values).reshape(*stencil.inside.shape, -1, columns)


def p2g(mass: Tensor, velocity: Tensor, affine: Tensor, stencil: Stencil) -> tuple[Tensor, Tensor]:
    r"""Scatter particle mass and momentum to the grid with APIC (Jiang et al. 2015).

    .. math::
        m_i = \sum_p w_{ip} m_p, \qquad
        (m \mathbf{v})_i = \sum_p w_{ip} m_p \bigl(\mathbf{v}_p + \mathbf{C}_p (\mathbf{x}_i - \mathbf{x}_p)\bigr)

    Conserves mass, linear and angular momentum to round-off.

    Args:
        mass: Particle mass [kg], shape (..., P).
        velocity: Particle velocity [m/s], shape (..., P, 3).
        affine: Affine velocity [1/s], shape (..., P, 3, 3).
        stencil: Support of each particle, with moments.

    Returns:
        Node mass [kg], shape (..., G), and node momentum [kg m/s], shape (..., G, 3).

    Raises:
        ValueError: If a particle tensor does not have the shape above.
    """
    momentum = scatter_momentum(mass, velocity, affine, None, None, stencil)
    return momentum[..., 3], momentum[..., :3]


def scatter_momentum(
    mass: Tensor,
    velocity: Tensor,
    affine: Tensor,
    impulse: Tensor | None,
    stress_impulse: Tensor | None,
    stencil: Stencil,
    mls_scale: float | None = None,
) -> Tensor:
    r"""One scatter of everything the ``updated`` grid update needs (paper, supplement, "MPM Algorithm").

    :math:`\sum_p w_{ip} m_p (v_p + C_p (x_i - x_p)) + w_{ip}\, j_p - S_p \nabla w_{ip}` and the mass, with
    :math:`j_p = \Delta t\, f_p` and :math:`S_p = \Delta t\, V^0_p \tau_p`.

    Args:
        mass: Particle mass [kg], shape (..., P).
        velocity: Particle velocity [m/s], shape (..., P, 3).
        affine: Affine velocity [1/s], shape (..., P, 3, 3).
        impulse: External impulse [N s], shape (..., P, 3), or None.
        stress_impulse: Stress times rest volume times time [N m s], shape (..., P, 3, 3), or None.
        stencil: Support of each particle, with moments.
        mls_scale: 4 / dx² [1/m²] for the stress term of MLS-MPM (Hu et al. 2018), which puts
            :math:`w_{ip} (x_i - x_p)\, 4 / \Delta x^2` in the place of :math:`\nabla w_{ip}`; the stencil then needs no
            gradients. None for the gradient itself.

    Returns:
        Momentum [kg m/s] in columns 0 to 2 and mass [kg] in column 3, shape (..., G, 4).
    """
    count = mass.shape[-1]
    if (stencil.basis.shape[1] == 4) != (mls_scale is not None):
        raise ValueError(
            "Expected a `stencil` without gradients for `mls_scale`, and with gradients and moments otherwise."
        )
    check_shape("velocity", velocity, count, 3)
    check_shape("affine", affine, count, 3, 3)
    momentum = mass[..., None] * velocity
    if impulse is not None:
        check_shape("impulse", impulse, count, 3)
        momentum = momentum + impulse
    value = torch.cat([momentum, mass[..., None]], dim=-1)[..., None, :]
    gradient = torch.zeros_like(affine) if stress_impulse is None else -stress_impulse.mT
    moment = mass[..., None, None] * affine.mT
    matrix = torch.cat([gradient, moment], dim=-2) if mls_scale is None else moment + mls_scale * gradient
    matrix = torch.cat([matrix, matrix.new_zeros(*matrix.shape[:-1], 1)], dim=-1)
    return scatter(stencil, torch.cat([value, matrix], dim=-2))


def g2p(node_velocity: Tensor, stencil: Stencil, dx: float) -> tuple[Tensor, Tensor, Tensor]:
    r"""Gather velocity, affine velocity and velocity gradient from the grid.

    :math:`C_p = \frac{4}{\Delta x^2} \sum_i w_{ip} v_i (x_i - x_p)^T` is the paper's
    :math:`12 / (\Delta x^2 (b + 1))` for the degree b = 2. Where the stencil has no gradients, C_p is the velocity
    gradient too (MLS-MPM).

    Args:
        node_velocity: Node velocity [m/s], shape (..., G, 3).
        stencil: Support of each particle, with moments.
        dx: Grid spacing [m].

    Returns:
        Velocity [m/s] (..., P, 3), affine velocity [1/s] (..., P, 3, 3), velocity gradient [1/s] (..., P, 3, 3).
    """
    rows = gather(node_velocity, stencil)
    affine = (4.0 / dx**2) * rows[..., -3:, :].mT
    return rows[..., 0, :], affine, affine if rows.shape[-2] == 4 else rows[..., 1:4, :].mT
