r"""Particle-grid transfers with quadratic B-splines as batched gather and scatter.

Both formulations of the solver use :func:`scatter` and :func:`gather`; they differ only in the positions for which
:func:`bspline_stencil` was called. This is the reference implementation: it works on any device and is differentiable.

A weight is a product of three factors, one for each axis, and so are the terms of a gradient or a moment. The sums over
the 27 nodes are therefore taken axis by axis, in three layers of nine nodes with the same x.
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying.mpm.state import GridSpec


@dataclass(frozen=True, slots=True)
class Stencil:
    """The 27 nodes around each particle, kept as the factors of their weights along the three axes.

    Attributes:
        first: Flat index, over all scenes of the batch, of the lowest of the nodes, shape (N,), N particles in all.
        shift: Offsets from it to the 27 nodes, shape (3, 3, 3), x first.
        factors: For each axis and each of its three nodes: the weight, then, if requested, the derivative of the weight
            and ``w (x_i - x_p)``, shape (1 to 3, 3 axes, 3 nodes, N).
        inside: Particles whose 27 nodes all lie in the grid, shape (..., P). The others have no weight.
        batch: Leading batch shape.
        node_count: Nodes G of one scene.
        order: Permutation that sorts the joined entries of the three layers, for sums that are the same in every run,
            or None.
        start: Index of the first entry of each node in that order, shape (all nodes + 1,), or None.
        matrices: ``basis`` as a sparse matrix from all nodes to the rows of all particles, and its transpose, for a
            stencil that is used many times, or None.
        nodes: Flat indices of the nodes, shape (27, N), where they are not those of the lattice (``virtual_nodes``).
    """

    first: Tensor
    shift: Tensor
    factors: Tensor
    inside: Tensor
    batch: tuple[int, ...]
    node_count: int
    order: Tensor | None = None
    start: Tensor | None = None
    matrices: tuple[Tensor, Tensor] | None = None
    nodes: Tensor | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> "Stencil":
        """Return itself: a stencil is never modified, and PyTorch cannot deep-copy a sparse matrix."""
        return self

    def layer(self, i: int) -> Tensor:
        """Flat index of the nine nodes with the ``i``-th x, shape (9 * N,), particles last."""
        if self.nodes is not None:
            return self.nodes[9 * i : 9 * i + 9].reshape(-1)
        return (self.first + self.shift[i, :, :, None]).reshape(-1)

    @property
    def rows(self) -> int:
        """Rows of ``basis``: ``w``, then, if requested, ``dw/dx, dw/dy, dw/dz`` and ``w (x_i - x_p)`` (3 rows)."""
        return 3 * len(self.factors) - 2

    @property
    def node(self) -> Tensor:
        """Flat index of the nodes of each particle, shape (N * 27,)."""
        if self.nodes is not None:
            return self.nodes.T.reshape(-1)
        return (self.first[:, None] + self.shift.reshape(-1)).reshape(-1)

    @property
    def basis(self) -> Tensor:
        """The products of the factors, shape (N, rows, 27); transfers never compute them."""
        products = []
        for q, axis in [(0, 0), *((q, axis) for q in range(1, len(self.factors)) for axis in range(3))]:
            x, y, z = (self.factors[q if axis == other else 0, other] for other in range(3))
            products.append((x[:, None, None] * (y[:, None] * z)).reshape(27, -1))
        return torch.stack(products).permute(2, 0, 1)


def bspline_stencil(
    position: Tensor,
    grid: GridSpec,
    moments: bool = True,
    snap: float = 0.0,
    deterministic: bool = False,
    fixed: bool = False,
    nodes: Tensor | None = None,
) -> Stencil:
    r"""Quadratic B-spline weights and their gradients (Jiang et al. 2016, "The material point method", eq. 123).

    A particle whose support reaches beyond the grid, or whose position is NaN or infinite, is never wrapped to the far
    side: its weights are zero and ``inside`` is False.

    Args:
        position: Particle position [m], shape (..., P, 3).
        grid: The nodes.
        moments: Also keep ``w (x_i - x_p)``, which APIC needs.
        snap: A particle within ``snap * dx`` of a plane where a weight vanishes is moved onto it for this stencil, so
            that no node is left with only a vanishing mass.
        deterministic: Also sort the nodes, so that sums over particles have the same order in every run on a GPU.
        fixed: The stencil will be used many times: on a CPU, and without a gradient in ``position``, also keep
            ``matrices``. They take 432 bytes for each row of each particle in float32, and transfers then take a third
            of the time.
        nodes: See :class:`Stencil`.

    Returns:
        The support of each particle.

    Example:
        >>> stencil = bspline_stencil(torch.full((1, 3), 0.5), GridSpec(0.1, (0, 0, 0), (10, 10, 10)))
        >>> bool(stencil.inside.all()), stencil.basis.shape
        (True, torch.Size([1, 7, 27]))
    """
    check_shape("position", position, "P", 3)
    dx = grid.dx
    batch = tuple(position.shape[:-2])
    lattice = position.reshape(-1, 3).T / dx
    base = torch.floor(lattice.detach() - 0.5)
    f = lattice - base
    offset, limit, strides, shift = _grid_constants(grid, position.device)
    low = base.long() - offset
    inside = ((low >= 0) & (low <= limit) & (f < 2)).all(0)  # NaN becomes an arbitrary integer; NaN < 2 is False
    f = torch.where(inside, f, 1.0)
    if snap > 0:
        f = torch.where(f - 0.5 < snap, 0.5, torch.where(1.5 - f < snap, 1.5, f))
    w, slope = bspline_weights(f)

    first = (torch.where(inside, low, 0) * strides).sum(0)
    if batch:
        scene = torch.arange(inside.numel(), device=position.device) // max(position.shape[-2], 1)
        first = first + scene * grid.node_count

    w = w * inside
    factors = [w, slope / dx * inside]
    if moments:
        reach = torch.arange(3, device=f.device, dtype=f.dtype)
        factors.append(w * ((reach[:, None] - f[:, None]) * dx))
    stencil = Stencil(first, shift, torch.stack(factors), inside.reshape(position.shape[:-1]), batch, grid.node_count)
    if nodes is not None:
        stencil = replace(stencil, nodes=nodes)
    if fixed and _sparse_products(stencil.factors):
        return replace(stencil, matrices=_matrices(stencil))
    if not deterministic:
        return stencil
    ranked, order = torch.sort(torch.cat([stencil.layer(i) for i in range(3)]), stable=True)
    return replace(stencil, order=order, start=_borders(ranked, math.prod(batch) * grid.node_count))


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


def _borders(ranked: Tensor, count: int) -> Tensor:
    """Return the start of each of ``count`` nodes in a sorted list, and the end of the list; shape (count + 1,)."""
    return torch.searchsorted(ranked, torch.arange(count + 1, device=ranked.device))


def _sparse_products(factors: Tensor) -> bool:
    """True if MKL's sparse products can be used: fast with 32-bit indices, and without a gradient of the matrix."""
    few = 9 * factors.numel() < 2**31  # upper bound on the number of entries
    return factors.device.type == "cpu" and few and not factors.requires_grad and torch.backends.mkl.is_available()


def _matrices(stencil: Stencil) -> tuple[Tensor, Tensor]:
    rows, nodes = stencil.rows, math.prod(stencil.batch) * stencil.node_count
    basis = stencil.basis.mT.reshape(-1, rows)  # one row per entry of ``node``
    ranked, order = torch.sort(stencil.node, stable=True)
    lines = len(stencil.first) * rows
    column = stencil.node.reshape(-1, 1, 27).expand(-1, rows, 27)
    particle_row = order[:, None] // 27 * rows + torch.arange(rows)
    parts = (
        (27 * torch.arange(lines + 1), column, basis.reshape(-1, 27, rows).mT, (lines, nodes)),
        (rows * _borders(ranked, nodes), particle_row, basis[order], (nodes, lines)),
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta", UserWarning)
        first, second = (
            torch.sparse_csr_tensor(start.int(), index.flatten().int(), values.flatten(), size, check_invariants=False)
            for start, index, values, size in parts
        )
    return first, second


@lru_cache(maxsize=64)
def _grid_constants(grid: GridSpec, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Offset, largest first node, strides and the 27 shifts, kept on the device so that a step copies nothing to it."""
    nx, ny, nz = grid.resolution
    with torch.inference_mode(False):
        offset = torch.tensor(grid.offset, device=device)[:, None]
        limit = torch.tensor([nx - 3, ny - 3, nz - 3], device=device)[:, None]
        strides = torch.tensor([ny * nz, nz, 1], device=device)[:, None]
        reach = torch.arange(3, device=device)
        shift = reach[:, None, None] * (ny * nz) + reach[:, None] * nz + reach
    return offset, limit, strides, shift


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
    flat, nodes = coefficients.reshape(-1, rows, columns), math.prod(stencil.batch) * stencil.node_count
    if stencil.matrices is not None:
        if rows < stencil.rows:
            flat = torch.nn.functional.pad(flat, (0, 0, 0, stencil.rows - rows))
        out = _Product.apply(*reversed(stencil.matrices), flat.reshape(-1, columns))
        return out.reshape(*stencil.batch, stencil.node_count, columns)
    c = flat.permute(1, 2, 0).contiguous()  # particles last: every operation runs along them
    (wx, wy, wz), kinds = stencil.factors[0], (rows - 1) // 3
    z = wz[:, None] * c[0]
    if kinds:
        x, y, more = _products(stencil.factors[1 : 1 + kinds, :, :, None], c[1:].reshape(kinds, 3, 1, columns, -1))
        z = z + more
    layers, out = [], c.new_zeros(nodes, columns)
    for i in range(3):
        values = (wx[i] * wy)[:, None, None] * z
        if kinds:
            values = torch.addcmul(values, (wx[i] * y + x[i] * wy[:, None])[:, None], wz[:, None])
        values = values.transpose(-1, -2).reshape(-1, columns)
        if stencil.order is not None:
            layers.append(values)
        else:
            # in place on a fresh tensor: differentiable, and half the memory traffic of the copying form
            out = out.index_add_(0, stencil.layer(i), values)
    if stencil.order is not None:
        ranked = torch.cat(layers).index_select(0, stencil.order)
        out = torch.segment_reduce(ranked, "sum", offsets=stencil.start, unsafe=True, initial=0)
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
    flat = field.reshape(-1, columns)
    if stencil.matrices is not None:
        return _Product.apply(*stencil.matrices, flat).reshape(*stencil.inside.shape, -1, columns)
    x, y, z = stencil.factors.transpose(0, 2)[:, :, :, None].unbind(1)  # node, kind, 1, particle
    value, along = [], []
    for i in range(3):
        values = flat.index_select(0, stencil.layer(i)).reshape(3, 3, -1, columns).transpose(-1, -2).contiguous()
        columned = _products(z[:, :, None], values.transpose(0, 1))
        value.append(_products(y, columned[0]))
        along.append(_products(y[:, 0], columned[1:].transpose(0, 1)))
    w = x[:, 0]
    rows = [_products(w, [v[0] for v in value])[None]]
    if stencil.rows > 1:
        own = [_products(x[:, 1:], [v[0] for v in value]), _products(w, [v[1:] for v in value]), _products(w, along)]
        rows.append(torch.stack(own, dim=1).flatten(0, 1))
    return torch.cat(rows).permute(2, 0, 1).reshape(*stencil.inside.shape, -1, columns)


def _products(a: Sequence[Tensor] | Tensor, b: Sequence[Tensor] | Tensor) -> Tensor:
    """Sum of products over the first dimension, added one by one, so that no product is stored."""
    total = a[0] * b[0]
    for k in range(1, len(a)):
        total = torch.addcmul(total, a[k], b[k])
    return total


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrix: Tensor, transpose: Tensor, dense: Tensor) -> Tensor:
        ctx.pair = (transpose, matrix)
        return matrix @ dense

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, Tensor]:
        return None, None, _Product.apply(*ctx.pair, grad.contiguous())


def scatter_momentum(
    mass: Tensor,
    velocity: Tensor,
    affine: Tensor,
    impulse: Tensor | None,
    stress_impulse: Tensor | None,
    stencil: Stencil,
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
        stress_impulse: Stress times rest volume times time [N m s], shape (..., P, 3, 3), or None.
        stencil: Support of each particle, with moments.

    Returns:
        Momentum [kg m/s] in columns 0 to 2 and mass [kg] in column 3, shape (..., G, 4).
    """
    count = mass.shape[-1]
    check_shape("velocity", velocity, count, 3)
    check_shape("affine", affine, count, 3, 3)
    momentum = mass[..., None] * velocity
    if impulse is not None:
        check_shape("impulse", impulse, count, 3)
        momentum = momentum + impulse
    value = torch.cat([momentum, mass[..., None]], dim=-1)[..., None, :]
    gradient = torch.zeros_like(affine) if stress_impulse is None else -stress_impulse.mT
    moment = mass[..., None, None] * affine.mT
    matrix = torch.cat([gradient, moment], dim=-2)
    matrix = torch.cat([matrix, matrix.new_zeros(*matrix.shape[:-1], 1)], dim=-1)
    return scatter(stencil, torch.cat([value, matrix], dim=-2))


def g2p(node_velocity: Tensor, stencil: Stencil, dx: float) -> tuple[Tensor, Tensor, Tensor]:
    r"""Gather velocity, affine velocity and velocity gradient from the grid.

    :math:`C_p = \frac{4}{\Delta x^2} \sum_i w_{ip} v_i (x_i - x_p)^T` is the paper's :math:`12 / (\Delta x^2 (b + 1))`
    for the degree b = 2.

    Args:
        node_velocity: Node velocity [m/s], shape (..., G, 3).
        stencil: Support of each particle, with moments.
        dx: Grid spacing [m].

    Returns:
        Velocity [m/s] (..., P, 3), affine velocity [1/s] (..., P, 3, 3), velocity gradient [1/s] (..., P, 3, 3).
    """
    rows = gather(node_velocity, stencil)
    affine = (4.0 / dx**2) * rows[..., -3:, :].mT
    return rows[..., 0, :], affine, rows[..., 1:4, :].mT
