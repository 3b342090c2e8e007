"""The step of a lattice Boltzmann flow as kernels; the definitions are in ``flow`` and ``collision``.

A cell reads ten moments of each neighbour and makes of them the population that arrives, so that 40 bytes are kept for
a cell instead of 108 for its populations.
"""

from __future__ import annotations

from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch

BLOCK = 128
CPU_BLOCK = 16


@triton.jit
def _load_moments(moments, at, count, mask):
    return (
        tl.load(moments + at, mask, 0.0),
        tl.load(moments + count + at, mask, 0.0),
        tl.load(moments + 2 * count + at, mask, 0.0),
        tl.load(moments + 3 * count + at, mask, 0.0),
        tl.load(moments + 4 * count + at, mask, 0.0),
        tl.load(moments + 5 * count + at, mask, 0.0),
        tl.load(moments + 6 * count + at, mask, 0.0),
        tl.load(moments + 7 * count + at, mask, 0.0),
        tl.load(moments + 8 * count + at, mask, 0.0),
        tl.load(moments + 9 * count + at, mask, 0.0),
    )


@triton.jit
def _population(m, CX: tl.constexpr, CY: tl.constexpr, CZ: tl.constexpr):
    """``collision.population`` of the velocity (CX, CY, CZ)."""
    rho = 1.0 + m[0]
    x = m[1]
    y = m[2]
    z = m[3]
    xx = rho * x * x + m[4]
    yy = rho * y * y + m[5]
    zz = rho * z * z + m[6]
    third = 0.3333333333333333
    total = m[0] + 4.5 * ((CX * CX - third) * xx + (CY * CY - third) * yy + (CZ * CZ - third) * zz)
    if CX != 0:
        total += CX * (3.0 * rho * x)
        total += (13.5 * CX * (CY * CY - third)) * (x * yy + 2.0 * y * m[7])
        total += (13.5 * CX * (CZ * CZ - third)) * (x * zz + 2.0 * z * m[8])
    if CY != 0:
        total += CY * (3.0 * rho * y)
        total += (13.5 * CY * (CX * CX - third)) * (y * xx + 2.0 * x * m[7])
        total += (13.5 * CY * (CZ * CZ - third)) * (y * zz + 2.0 * z * m[9])
    if CZ != 0:
        total += CZ * (3.0 * rho * z)
        total += (13.5 * CZ * (CX * CX - third)) * (z * xx + 2.0 * x * m[8])
        total += (13.5 * CZ * (CY * CY - third)) * (z * yy + 2.0 * y * m[9])
    if CX * CY != 0:
        total += (9.0 * CX * CY) * (rho * x * y + m[7])
    if CX * CZ != 0:
        total += (9.0 * CX * CZ) * (rho * x * z + m[8])
    if CY * CZ != 0:
        total += (9.0 * CY * CZ) * (rho * y * z + m[9])
    if CX * CY * CZ != 0:
        total += (27.0 * CX * CY * CZ) * (rho * x * y * z + x * m[9] + y * m[8] + z * m[7])
    return ((4 - 3 * CX * CX) * (4 - 3 * CY * CY) * (4 - 3 * CZ * CZ) / 216) * total


@triton.jit
def _pushed(wall, CX: tl.constexpr, CY: tl.constexpr, CZ: tl.constexpr):
    """Population that a moving wall adds."""
    weight = (4 - 3 * CX * CX) * (4 - 3 * CY * CY) * (4 - 3 * CZ * CZ) / 36
    return weight * (CX * wall[1] + CY * wall[2] + CZ * wall[3])


@triton.jit
def _returned(own, wall, CX: tl.constexpr, CY: tl.constexpr, CZ: tl.constexpr):
    """The population that comes back along (CX, CY, CZ) from a wall that may move."""
    return _population(own, -CX, -CY, -CZ) + _pushed(wall, CX, CY, CZ)


@triton.jit
def _row(i: tl.constexpr):
    """Place of the component i - 1 in (0, 1, -1), as ``lattice.DIRECTIONS`` has them."""
    return (i + 2) % 3


@triton.jit
def _interpolated(back, own, beyond, wall, gap, CX: tl.constexpr, CY: tl.constexpr, CZ: tl.constexpr):
    """The population that comes back from a wall at a share of the way to its cell, see ``LatticeFlow._arrived``."""
    pushed = _pushed(wall, CX, CY, CZ)
    near = 2.0 * gap * (back - pushed) + (1.0 - 2.0 * gap) * _population(beyond, -CX, -CY, -CZ) + pushed
    far = (back + (2.0 * gap - 1.0) * _population(own, CX, CY, CZ)) / (2.0 * tl.maximum(gap, 0.25))
    return tl.where(gap < 0.5, near, far)


@triton.jit
def _gather(s, f, CX: tl.constexpr, CY: tl.constexpr, CZ: tl.constexpr):
    """Add a population to the ten sums."""
    a, x, y, z, xx, yy, zz, xy, xz, yz = s
    a += f
    if CX != 0:
        x += CX * f
        xx += f
    if CY != 0:
        y += CY * f
        yy += f
    if CZ != 0:
        z += CZ * f
        zz += f
    if CX * CY != 0:
        xy += (CX * CY) * f
    if CX * CZ != 0:
        xz += (CX * CZ) * f
    if CY * CZ != 0:
        yz += (CY * CZ) * f
    return a, x, y, z, xx, yy, zz, xy, xz, yz


@triton.jit
def _collide(s, relaxation, smagorinsky, px, py, pz):
    """``collision.collide``; ``smagorinsky`` is 18 sqrt(2) C²."""
    rho = 1.0 + s[0]
    x = s[1] / rho
    y = s[2] / rho
    z = s[3] / rho
    rest = s[0] * 0.3333333333333333
    xx = s[4] - rho * x * x - rest
    yy = s[5] - rho * y * y - rest
    zz = s[6] - rho * z * z - rest
    xy = s[7] - rho * x * y
    xz = s[8] - rho * x * z
    yz = s[9] - rho * y * z
    square = xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)
    time = 0.5 * (relaxation + tl.sqrt(relaxation * relaxation + smagorinsky * tl.sqrt(square) / rho))
    kept = 1.0 - 1.0 / time
    return (s[0], x + px, y + py, z + pz, kept * xx, kept * yy, kept * zz, kept * xy, kept * xz, kept * yz)


@triton.jit
def flow_step(
    moments, out, kind, count, sx, sy, sz, relaxation, smagorinsky, px, py, pz, BLOCK: tl.constexpr,
):  # fmt: skip
    """Stream and collide, one cell per lane. Cells at faces and beside walls get wrong numbers, to be replaced."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < count
    zero = tl.zeros((BLOCK,), tl.float32)
    s = (zero, zero, zero, zero, zero, zero, zero, zero, zero, zero)
    for i in tl.static_range(3):
        for j in tl.static_range(3):
            for k in tl.static_range(3):
                source = at - ((i - 1) * sx + (j - 1) * sy + (k - 1) * sz)
                m = _load_moments(moments, source, count, mask & (source >= 0) & (source < count))
                s = _gather(s, _population(m, i - 1, j - 1, k - 1), i - 1, j - 1, k - 1)
    s = _collide(s, relaxation, smagorinsky, px, py, pz)
    own = _load_moments(moments, at, count, mask)
    wall = tl.load(kind + at, mask, 1) == 1
    for q in tl.static_range(10):
        tl.store(out + q * count + at, tl.where(wall, own[q], s[q]), mask)


@triton.jit
def _wrapped(x, n):
    return tl.where(x < 0, x + n, tl.where(x >= n, x - n, x))


@triton.jit
def special_step(
    moments, out, kind, special, gaps, specials, count, nx, ny, nz, relaxation, smagorinsky, px, py, pz,
    CURVED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """As :func:`flow_step`, for cells with a neighbour that is a wall or lies behind a periodic face."""
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = lane < specials
    at = tl.load(special + lane, mask, 0)
    x = at // (ny * nz)
    y = (at // nz) % ny
    z = at % nz
    own = _load_moments(moments, at, count, mask)
    zero = tl.zeros((BLOCK,), tl.float32)
    s = (zero, zero, zero, zero, zero, zero, zero, zero, zero, zero)
    for i in tl.static_range(3):
        for j in tl.static_range(3):
            for k in tl.static_range(3):
                source = (_wrapped(x - (i - 1), nx) * ny + _wrapped(y - (j - 1), ny)) * nz + _wrapped(z - (k - 1), nz)
                wall = tl.load(kind + source, mask, 0) == 1
                m = _load_moments(moments, source, count, mask)
                back = _returned(own, m, i - 1, j - 1, k - 1)
                if CURVED:
                    away = (_wrapped(x + (i - 1), nx) * ny + _wrapped(y + (j - 1), ny)) * nz + _wrapped(z + (k - 1), nz)
                    beyond = _load_moments(moments, away, count, mask)
                    gap = tl.load(gaps + (9 * _row(i) + 3 * _row(j) + _row(k)) * specials + lane, mask, 0.5)
                    back = _interpolated(back, own, beyond, m, gap, i - 1, j - 1, k - 1)
                f = tl.where(wall, back, _population(m, i - 1, j - 1, k - 1))
                s = _gather(s, f, i - 1, j - 1, k - 1)
    s = _collide(s, relaxation, smagorinsky, px, py, pz)
    for q in tl.static_range(10):
        tl.store(out + q * count + at, s[q], mask)


@triton.jit
def hold_faces(moments, held, behind, outward, wind, cells, count, BLOCK: tl.constexpr):
    """``flow.hold``, one cell of an open face per lane."""
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = lane < cells
    at = tl.load(held + lane, mask, 0)
    near = _load_moments(moments, tl.load(behind + lane, mask, 0), count, mask)
    ox = tl.load(outward + 3 * lane, mask, 1.0)
    oy = tl.load(outward + 3 * lane + 1, mask, 0.0)
    oz = tl.load(outward + 3 * lane + 2, mask, 0.0)
    x = tl.load(wind + 3 * lane, mask, 0.0)
    y = tl.load(wind + 3 * lane + 1, mask, 0.0)
    z = tl.load(wind + 3 * lane + 2, mask, 0.0)
    out = x * ox + y * oy + z * oz > 1e-6
    into = tl.minimum(near[1] * ox + near[2] * oy + near[3] * oz, 0.0) / (ox * ox + oy * oy + oz * oz)
    tl.store(moments + at, tl.where(out, 0.0, near[0]), mask)
    sound = 0.5773502691896258 * near[0] / tl.sqrt(ox * ox + oy * oy + oz * oz)
    tl.store(moments + count + at, tl.where(out, near[1] - into * ox, x + sound * ox), mask)
    tl.store(moments + 2 * count + at, tl.where(out, near[2] - into * oy, y + sound * oy), mask)
    tl.store(moments + 3 * count + at, tl.where(out, near[3] - into * oz, z + sound * oz), mask)
    for q in tl.static_range(4, 10):
        tl.store(moments + q * count + at, near[q], mask)


def step(flow, moments, out, wind, push):
    """See ``LatticeFlow.advance``; ``wind`` and ``push`` in units of the lattice."""
    block = lanes(moments.device, BLOCK, CPU_BLOCK)
    nx, ny, nz = flow.cells
    count = nx * ny * nz
    numbers = (flow.units.relaxation, 18 * 2**0.5 * flow.smagorinsky**2, *push)
    strides = (ny * nz if nx > 1 else 0, nz if ny > 1 else 0, 1 if nz > 1 else 0)
    launch(flow_step, (triton.cdiv(count, block),))(moments, out, flow.kind, count, *strides, *numbers, BLOCK=block)
    if len(flow.special):
        launch(special_step, (triton.cdiv(len(flow.special), block),))(
            moments,
            out,
            flow.kind,
            flow.special,
            flow.gaps,
            len(flow.special),
            count,
            nx,
            ny,
            nz,
            *numbers,
            CURVED=len(flow.gaps) > 0,
            BLOCK=block,
        )
    if len(flow.held):
        launch(hold_faces, (triton.cdiv(len(flow.held), block),))(
            out, flow.held, flow.behind, flow.outward, wind, len(flow.held), count, BLOCK=block
        )
