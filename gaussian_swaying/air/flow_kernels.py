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
def _weight(x, y, z):
    """36 times the weight of the velocity (x, y, z) of the lattice over its value at rest."""
    return (4.0 - 3.0 * x * x) * (4.0 - 3.0 * y * y) * (4.0 - 3.0 * z * z) * 0.027777777777777776


@triton.jit
def _population(m, cx, cy, cz):
    rho = 1.0 + m[0]
    x = m[1]
    y = m[2]
    z = m[3]
    xx = rho * x * x + m[4]
    yy = rho * y * y + m[5]
    zz = rho * z * z + m[6]
    hx = 4.5 * (cx * cx) - 1.5
    hy = 4.5 * (cy * cy) - 1.5
    hz = 4.5 * (cz * cz) - 1.5
    total = m[0] + hx * xx + hy * yy + hz * zz + 3.0 * rho * (cx * x + cy * y + cz * z)
    total += 3.0 * cx * (hy * (x * yy + 2.0 * y * m[7]) + hz * (x * zz + 2.0 * z * m[8]))
    total += 3.0 * cy * (hx * (y * xx + 2.0 * x * m[7]) + hz * (y * zz + 2.0 * z * m[9]))
    total += 3.0 * cz * (hx * (z * xx + 2.0 * x * m[8]) + hy * (z * yy + 2.0 * y * m[9]))
    total += 9.0 * (cx * cy * (rho * x * y + m[7]) + cx * cz * (rho * x * z + m[8]) + cy * cz * (rho * y * z + m[9]))
    total += 27.0 * (cx * cy * cz) * (rho * x * y * z + x * m[9] + y * m[8] + z * m[7])
    return 0.16666666666666666 * _weight(cx, cy, cz) * total


@triton.jit
def _pushed(wall, cx, cy, cz):
    return _weight(cx, cy, cz) * (cx * wall[1] + cy * wall[2] + cz * wall[3])


@triton.jit
def _interpolated(back, own, beyond, wall, gap, cx, cy, cz):
    """The population that comes back from a wall at a share of the way to its cell, see ``LatticeFlow._arrived``."""
    pushed = _pushed(wall, cx, cy, cz)
    near = 2.0 * gap * (back - pushed) + (1.0 - 2.0 * gap) * _population(beyond, -cx, -cy, -cz) + pushed
    far = (back + (2.0 * gap - 1.0) * _population(own, cx, cy, cz)) / (2.0 * tl.maximum(gap, 0.25))
    return tl.where(gap < 0.5, near, far)


@triton.jit
def _gather(s, f, cx, cy, cz):
    a, x, y, z, xx, yy, zz, xy, xz, yz = s
    fx = cx * f
    fy = cy * f
    fz = cz * f
    return (
        a + f, x + fx, y + fy, z + fz, xx + cx * fx, yy + cy * fy, zz + cz * fz, xy + cy * fx, xz + cz * fx,
        yz + cz * fy,
    )  # fmt: skip


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
    for i in range(3):  # only the last loop is unrolled: a kernel for all 27 directions compiles for minutes
        for j in range(3):
            for k in tl.static_range(3):
                source = at - ((i - 1) * sx + (j - 1) * sy + (k - 1) * sz)
                m = _load_moments(moments, source, count, mask & (source >= 0) & (source < count))
                cx = 1.0 * i - 1.0
                cy = 1.0 * j - 1.0
                cz = 1.0 * k - 1.0
                s = _gather(s, _population(m, cx, cy, cz), cx, cy, cz)
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
    for i in range(3):
        for j in range(3):
            for k in tl.static_range(3):
                cx = 1.0 * i - 1.0
                cy = 1.0 * j - 1.0
                cz = 1.0 * k - 1.0
                source = (_wrapped(x - (i - 1), nx) * ny + _wrapped(y - (j - 1), ny)) * nz + _wrapped(z - (k - 1), nz)
                wall = tl.load(kind + source, mask, 0) == 1
                m = _load_moments(moments, source, count, mask)
                back = _population(own, -cx, -cy, -cz) + _pushed(m, cx, cy, cz)
                if CURVED:
                    away = (_wrapped(x + (i - 1), nx) * ny + _wrapped(y + (j - 1), ny)) * nz + _wrapped(z + (k - 1), nz)
                    beyond = _load_moments(moments, away, count, mask)
                    row = 9 * ((i + 2) % 3) + 3 * ((j + 2) % 3) + (k + 2) % 3  # as in ``lattice.DIRECTIONS``
                    gap = tl.load(gaps + row * specials + lane, mask, 0.5)
                    back = _interpolated(back, own, beyond, m, gap, cx, cy, cz)
                f = tl.where(wall, back, _population(m, cx, cy, cz))
                s = _gather(s, f, cx, cy, cz)
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
            moments, out, flow.kind, flow.special, flow.gaps, len(flow.special), count, nx, ny, nz, *numbers,
            CURVED=len(flow.gaps) > 0, BLOCK=block,
        )  # fmt: skip
    if len(flow.held):
        launch(hold_faces, (triton.cdiv(len(flow.held), block),))(
            out, flow.held, flow.behind, flow.outward, wind, len(flow.held), count, BLOCK=block
        )
