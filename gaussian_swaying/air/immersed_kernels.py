"""The exchange of momentum between points and the air as kernels; the definitions are in ``immersed``.

Sums over points are atomic on a GPU. On a CPU one program adds point after point, so that they have a fixed order.
"""

from __future__ import annotations

import torch

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
def _cell(reach, kind, nx, ny, nz, mask, X: tl.constexpr, Y: tl.constexpr, Z: tl.constexpr):
    """Index of one of the 27 cells, and its weight before they are made to add up to one."""
    bx, wx, by, wy, bz, wz = reach
    at = (_clamped(bx + X, nx) * ny + _clamped(by + Y, ny)) * nz + _clamped(bz + Z, nz)
    ok = mask & _inside(bx + X, nx) & _inside(by + Y, ny) & _inside(bz + Z, nz)
    air = tl.load(kind + at, mask, 1) == 0
    return at, tl.where(ok & air, wx[X] * wy[Y] * wz[Z], 0.0)


@triton.jit
def _reach(place, p, kind, nx, ny, nz, mask):
    bx, wx = _axis(tl.load(place + 3 * p, mask, 0.0))
    by, wy = _axis(tl.load(place + 3 * p + 1, mask, 0.0))
    bz, wz = _axis(tl.load(place + 3 * p + 2, mask, 0.0))
    reach = (bx, wx, by, wy, bz, wz)
    total = wx[0] * 0.0
    for i in tl.static_range(3):
        for j in tl.static_range(3):
            for k in tl.static_range(3):
                _at, w = _cell(reach, kind, nx, ny, nz, mask, i, j, k)
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
        for i in tl.static_range(3):
            for j in tl.static_range(3):
                for k in tl.static_range(3):
                    at, w = _cell(reach, kind, nx, ny, nz, mask, i, j, k)
                    _add(sums + at, w * share, mask, ATOMIC)


@triton.jit
def read(place, area, moments, sums, velocity, layer, kind, nx, ny, nz, cells, count, BLOCK: tl.constexpr):
    """Velocity of the air at points, and the mass of the layer at each."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = p < count
    reach, scale = _reach(place, p, kind, nx, ny, nz, mask)
    covered = scale * 0.0
    x = scale * 0.0
    y = scale * 0.0
    z = scale * 0.0
    for i in tl.static_range(3):
        for j in tl.static_range(3):
            for k in tl.static_range(3):
                at, w = _cell(reach, kind, nx, ny, nz, mask, i, j, k)
                covered += w * tl.load(sums + at, mask, 0.0)
                x += w * tl.load(moments + cells + at, mask, 0.0)
                y += w * tl.load(moments + 2 * cells + at, mask, 0.0)
                z += w * tl.load(moments + 3 * cells + at, mask, 0.0)
    covered = covered * scale
    mass = tl.where(covered > 0, tl.load(area + p, mask, 0.0) / tl.maximum(covered, 1e-30), 0.0)
    tl.store(layer + p, mass, mask)
    tl.store(velocity + 3 * p, x * scale, mask)
    tl.store(velocity + 3 * p + 1, y * scale, mask)
    tl.store(velocity + 3 * p + 2, z * scale, mask)


@triton.jit
def subtract(place, taken, moments, kind, nx, ny, nz, cells, count, rounds, ATOMIC: tl.constexpr, BLOCK: tl.constexpr):
    """Take the momentum of points out of the air."""
    for turn in range(rounds):
        p = (tl.program_id(0) * rounds + turn) * BLOCK + tl.arange(0, BLOCK)
        mask = p < count
        reach, scale = _reach(place, p, kind, nx, ny, nz, mask)
        x = scale * tl.load(taken + 3 * p, mask, 0.0)
        y = scale * tl.load(taken + 3 * p + 1, mask, 0.0)
        z = scale * tl.load(taken + 3 * p + 2, mask, 0.0)
        for i in tl.static_range(3):
            for j in tl.static_range(3):
                for k in tl.static_range(3):
                    at, w = _cell(reach, kind, nx, ny, nz, mask, i, j, k)
                    w = -w / (1.0 + tl.load(moments + at, mask, 0.0))
                    _add(moments + cells + at, w * x, mask, ATOMIC)
                    _add(moments + 2 * cells + at, w * y, mask, ATOMIC)
                    _add(moments + 3 * cells + at, w * z, mask, ATOMIC)


def look(moments, area, place, kind):
    """See ``immersed.look``; float32."""
    place, (nx, ny, nz), cells, count = place.contiguous(), kind.shape, kind.numel(), len(place)
    sums, layer = moments.new_zeros(cells), torch.empty_like(area)
    velocity = torch.empty_like(place)
    programs, rounds, scatter = _scatter(place)
    launch(cover, (programs,))(place, area, sums, kind, nx, ny, nz, count, rounds, **scatter)
    wide = lanes(place.device, BLOCK, CPU_BLOCK)
    launch(read, (triton.cdiv(count, wide),))(
        place, area, moments, sums, velocity, layer, kind, nx, ny, nz, cells, count, BLOCK=wide
    )
    return velocity, layer


def give(moments, taken, place, kind):
    """See ``immersed.give``; float32."""
    (nx, ny, nz), cells = kind.shape, kind.numel()
    programs, rounds, scatter = _scatter(place)
    launch(subtract, (programs,))(
        place.contiguous(), taken.contiguous(), moments, kind, nx, ny, nz, cells, len(place), rounds, **scatter
    )


def _scatter(place):
    atomic = place.device.type == "cuda" or INTERPRETED
    count, block = len(place), BLOCK if atomic else 1
    programs, rounds = (triton.cdiv(count, block), 1) if atomic else (1, count)
    return programs, rounds, {"ATOMIC": atomic, "BLOCK": block}
