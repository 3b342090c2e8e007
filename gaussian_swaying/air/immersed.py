r"""Thin surfaces in a lattice Boltzmann flow: immersed boundaries by direct forcing, with an exchange of momentum.

A surface is a set of points with an area. In a step of the air each of them takes from the air around it, and the air
loses, the momentum

.. math:: \mathbf J_p = \beta_p (\mathbf u(\mathbf x_p) - \bar{\mathbf v}_p), \qquad \beta_p = \frac{\rho h A_p}{c_p}

where :math:`\bar v` is the mean velocity of the point in the step and :math:`\beta` the mass of the layer of air at it
(h is the side of a cell). Air is read, and momentum given, with the quadratic B-spline of three cells along each axis,
a regularised delta (Peskin 2002, Acta Numerica 11); :math:`c_p = \sum_q \sum_n w_{pn} w_{qn} A_q / h^2` is how thickly
the surface covers the cells at p. With it, what the points together give to a cell never moves the air beyond them,
however many layers lie in a cell, and the air has the velocity of the surface after each step (direct forcing, Uhlmann
2005, J. Comput. Phys. 209). Momentum is kept to rounding, as the weights of a point add up to one.

The force on the point is :math:`\beta (\mathbf u - \mathbf v) / \Delta t` in each substep of the body, with the air at
the start of the step. So it is a drag, and air and point together lose the energy
:math:`\tfrac12\beta(u - \bar v)^2` or more. A force that stayed the same in all substeps would feed vibrations that are
faster than the step.

Sums over points are atomic on a GPU, so their order is not fixed. On a CPU one program adds point after point.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg_triton import add3, load3, scale3, store3
from gaussian_swaying.kernels.language import INTERPRETED, tl, triton
from gaussian_swaying.kernels.launch import lanes, launch

BLOCK = 64
CPU_BLOCK = 16


@triton.jit
def _axis(x):
    low = tl.floor(x - 0.5)
    f = x - low
    return low.to(tl.int32), (0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5))


@triton.jit
def _inside(x, n):
    return ((x >= 0) & (x < n)) | (n == 1)


@triton.jit
def _clamped(x, n):
    return tl.minimum(tl.maximum(x, 0), n - 1)


@triton.jit
def _cell(reach, kind, nx, ny, nz, mask, Q: tl.constexpr):
    """Index of one of the 27 cells, and its weight before they are made to add up to one."""
    X: tl.constexpr = Q // 9
    Y: tl.constexpr = Q // 3 % 3
    Z: tl.constexpr = Q % 3
    bx, wx, by, wy, bz, wz = reach
    at = (_clamped(bx + X, nx) * ny + _clamped(by + Y, ny)) * nz + _clamped(bz + Z, nz)
    ok = mask & _inside(bx + X, nx) & _inside(by + Y, ny) & _inside(bz + Z, nz)
    air = tl.load(kind + at, mask, 1) == 0
    return at, tl.where(ok & air, wx[X] * wy[Y] * wz[Z], 0.0)


@triton.jit
def _reach(place, p, kind, nx, ny, nz, mask):
    x, y, z = load3(place, 1, 3 * p, mask)
    bx, wx = _axis(x)
    by, wy = _axis(y)
    bz, wz = _axis(z)
    reach = (bx, wx, by, wy, bz, wz)
    total = wx[0] * 0.0
    for q in tl.static_range(27):
        _at, w = _cell(reach, kind, nx, ny, nz, mask, q)
        total += w
    return reach, tl.where(total > 0, 1.0 / tl.maximum(total, 1e-30), 0.0)


@triton.jit
def _add(pointer, value, mask, ATOMIC: tl.constexpr):
    if ATOMIC:
        tl.atomic_add(pointer, value, mask, sem="relaxed")
    else:
        tl.store(pointer, tl.load(pointer, mask, 0.0) + value, mask)


@triton.jit
def cover(place, area, sums, kind, nx, ny, nz, count, rounds, ATOMIC: tl.constexpr, BLOCK: tl.constexpr):
    """The area of points shared among the cells."""
    for turn in range(rounds):
        p = (tl.program_id(0) * rounds + turn) * BLOCK + tl.arange(0, BLOCK)
        mask = p < count
        reach, scale = _reach(place, p, kind, nx, ny, nz, mask)
        share = scale * tl.load(area + p, mask, 0.0)
        for q in tl.static_range(27):
            at, w = _cell(reach, kind, nx, ny, nz, mask, q)
            _add(sums + at, w * share, mask, ATOMIC)


@triton.jit
def read(place, area, field, sums, values, layer, kind, nx, ny, nz, cells, count, BLOCK: tl.constexpr):
    """Three values of the air at points, and the mass of the layer at each."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = p < count
    reach, scale = _reach(place, p, kind, nx, ny, nz, mask)
    covered = scale * 0.0
    found = (covered, covered, covered)
    for q in tl.static_range(27):
        at, w = _cell(reach, kind, nx, ny, nz, mask, q)
        covered += w * tl.load(sums + at, mask, 0.0)
        found = add3(found, w, load3(field, cells, at, mask))
    covered = covered * scale
    mass = tl.where(covered > 0, tl.load(area + p, mask, 0.0) / tl.maximum(covered, 1e-30), 0.0)
    tl.store(layer + p, mass, mask)
    store3(values, 1, 3 * p, scale3(scale, found), mask)


@triton.jit
def subtract(place, taken, moments, kind, nx, ny, nz, cells, count, rounds, ATOMIC: tl.constexpr, BLOCK: tl.constexpr):
    """Take the momentum of points out of the air."""
    for turn in range(rounds):
        p = (tl.program_id(0) * rounds + turn) * BLOCK + tl.arange(0, BLOCK)
        mask = p < count
        reach, scale = _reach(place, p, kind, nx, ny, nz, mask)
        share = scale3(scale, load3(taken, 1, 3 * p, mask))
        for q in tl.static_range(27):
            at, w = _cell(reach, kind, nx, ny, nz, mask, q)
            w = -w / (1.0 + tl.load(moments + at, mask, 0.0))
            for k in tl.static_range(3):
                _add(moments + (k + 1) * cells + at, w * share[k], mask, ATOMIC)


def look(moments: Tensor, area: Tensor, place: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
    r"""Velocity of the air at points, and the mass of the layer of air at each, :math:`A_p / c_p`.

    Args:
        moments: Of the flow, shape (10, X, Y, Z).
        area: Area of the points in faces of a cell, shape (P,).
        place: In cells from the centre of the first cell, shape (P, 3).
        kind: What the cells are, see ``LatticeFlow``, shape (X, Y, Z).

    Returns:
        Shape (P, 3) [cells per step], and shape (P,) in units of the air in a cell; 0 for points without air.
    """
    sums, (programs, options) = moments.new_zeros(kind.numel()), _scatter(place)
    launch(cover, (programs,))(place.contiguous(), area, sums, kind, *kind.shape, len(place), **options)
    return _read(moments[1:4], area, sums, place, kind)


def values_at(field: Tensor, place: Tensor, kind: Tensor) -> Tensor:
    """Interpolate a vector field (3, X, Y, Z) at points, as :func:`look` does the velocity; shape (P, 3)."""
    return _read(field, field.new_zeros(len(place)), field.new_zeros(kind.numel()), place, kind)[0]


def _read(field: Tensor, area: Tensor, sums: Tensor, place: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
    place, block = place.contiguous(), lanes(place.device, BLOCK, CPU_BLOCK)
    values, layer = torch.empty_like(place), torch.empty_like(area)
    launch(read, (triton.cdiv(len(place), block),))(
        place, area, field, sums, values, layer, kind, *kind.shape, kind.numel(), len(place), BLOCK=block
    )
    return values, layer


def give(moments: Tensor, taken: Tensor, place: Tensor, kind: Tensor) -> None:
    """Take momentum of points out of the air, in place.

    Args:
        moments: Of the flow, shape (10, X, Y, Z).
        taken: What the points take, in units of the air in a cell at one cell per step, shape (P, 3).
    """
    programs, options = _scatter(place)
    launch(subtract, (programs,))(
        place.contiguous(), taken.contiguous(), moments, kind, *kind.shape, kind.numel(), len(place), **options
    )


def _scatter(place: Tensor) -> tuple[int, dict[str, Any]]:
    atomic = place.device.type == "cuda" or INTERPRETED
    block = BLOCK if atomic else 1
    blocks = triton.cdiv(len(place), block)
    programs = blocks if atomic else 1
    return programs, {"rounds": blocks // max(programs, 1), "ATOMIC": atomic, "BLOCK": block}


def together(mass: Tensor, layer: Tensor) -> Tensor:
    r"""The reduced mass :math:`1 / (1/m + 1/\beta)` of two masses; 0 where one of them is 0."""
    return mass * layer / (mass + layer).clamp(min=1e-30)


def exchange(moments: Tensor, velocity: Tensor, area: Tensor, mass: Tensor, place: Tensor, kind: Tensor) -> Tensor:
    """The momentum that free points take from the air in a step without substeps; the air loses it, in ``moments``.

    As in an inelastic collision of each point with the layer of air at it, so that any ratio of masses is stable.

    Args:
        moments: Of the flow, changed in place, shape (10, X, Y, Z).
        velocity: Of the points [cells per step], shape (P, 3).
        area: Their area in faces of a cell, shape (P,).
        mass: Their mass in units of the air in a cell, shape (P,); infinite for still ones is given as a large number.

    Returns:
        Momentum in units of the air in a cell at one cell per step, shape (P, 3).
    """
    air, layer = look(moments, area, place, kind)
    taken = together(mass, layer)[:, None] * (air - velocity)
    give(moments, taken, place, kind)
    return taken
