"""The substep as Triton kernels: particle-grid transfers with everything between them fused in.

The definitions are :mod:`~gaussian_swaying.mpm.transfer` and ``MPMSolver.step``; these kernels follow them and are
tested against them. :mod:`~gaussian_swaying.mpm.fused` prepares the buffers and launches them.

``total``: stencils rest, so particles are sorted by cell once. A program takes some cells with up to ``LANES``
particles at a time, reads nodal displacements and velocities, and writes 27 sums per cell; each node then gathers the
sums of its 27 cells. No atomics: the result is the same in every run.

``updated``: one kernel gathers the end of a substep and scatters the start of the next, so a particle is read and
written once. Particles are sorted by cell now and then; neighbours in that order that share a cell are summed by a
segmented scan, and only the last of each segment goes to the grid, atomically.

Rows of node arrays: in ``total`` displacement and velocity, each in four columns of eight, a sector of memory; in
``updated`` velocity, or momentum and mass, in four. What is summed has four columns too, or eight with implicit drag in
``updated`` and where boundaries ask for positions in ``total``.
"""

import triton
import triton.language as tl

from gaussian_swaying.geometry.linalg_triton import axpy9, largest, largest_eigenvalue, matmul, scale9, transpose
from gaussian_swaying.mpm.damping_triton import kelvin_voigt_pk1
from gaussian_swaying.mpm.laws.triton.body import ROW, kirchhoff, pk1

SCHEDULE = 4
"""Columns of the schedule, a row per substep: how long forces act [s], the substep [s], the decay of velocities."""

# Numbers that differ from body to body and from grid to grid. Triton would compile a kernel again for each of them that
# becomes one or a multiple of 16, in the middle of a run, and even while a graph is recorded.
VARIES = (
    "count", "cells", "pieces", "nodes", "scenes", "scene_size", "step_offset", "sx", "sy", "ox", "oy", "oz",
    "nx", "ny", "nz",
)  # fmt: skip


# Loops over i and j stay loops in Triton's intermediate code: unrolled, its passes take minutes.


@triton.jit
def _weight(f, i, inverse_dx):
    """Quadratic B-spline weight of node i of one axis and its slope; f in [0.5, 1.5)."""
    t = f - (1.5 - 0.5 * i)
    a = tl.where(i == 1, -1.0, 0.5) * t
    return a * t + tl.where(i == 1, 0.75, 0.0), 2 * inverse_dx * a


@triton.jit
def _weights(f, inverse_dx):
    """The three weights of one axis and their slopes."""
    w0, g0 = _weight(f, 0, inverse_dx)
    w1, g1 = _weight(f, 1, inverse_dx)
    w2, g2 = _weight(f, 2, inverse_dx)
    return (w0, w1, w2), (g0, g1, g2)


@triton.jit
def _gather(field, node, sx, sy, f, wz, gz, inverse_dx, mask, BOTH: tl.constexpr):
    """Columns 0 to 2 of rows of eight interpolated, their derivatives [component, axis], and (BOTH) columns 4 to 6."""
    zero = wz[0] * 0
    u0, u1, u2, v0, v1, v2 = zero, zero, zero, zero, zero, zero
    g00, g01, g02, g10, g11, g12, g20, g21, g22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for i in range(3):
        wx, gx = _weight(f[0], i, inverse_dx)
        for j in range(3):
            wy, gy = _weight(f[1], j, inverse_dx)
            row = field + (node + i * sx + j * sy) * 8
            s0, s1, s2, t0, t1, t2, r0, r1, r2 = zero, zero, zero, zero, zero, zero, zero, zero, zero
            for k in tl.static_range(3):
                q0 = tl.load(row + k * 8, mask, 0.0)
                q1 = tl.load(row + k * 8 + 1, mask, 0.0)
                q2 = tl.load(row + k * 8 + 2, mask, 0.0)
                s0 += wz[k] * q0
                s1 += wz[k] * q1
                s2 += wz[k] * q2
                t0 += gz[k] * q0
                t1 += gz[k] * q1
                t2 += gz[k] * q2
                if BOTH:
                    r0 += wz[k] * tl.load(row + k * 8 + 4, mask, 0.0)
                    r1 += wz[k] * tl.load(row + k * 8 + 5, mask, 0.0)
                    r2 += wz[k] * tl.load(row + k * 8 + 6, mask, 0.0)
            w = wx * wy
            dx = gx * wy
            dy = wx * gy
            u0 += w * s0
            u1 += w * s1
            u2 += w * s2
            if BOTH:
                v0 += w * r0
                v1 += w * r1
                v2 += w * r2
            g00 += dx * s0
            g01 += dy * s0
            g02 += w * t0
            g10 += dx * s1
            g11 += dy * s1
            g12 += w * t1
            g20 += dx * s2
            g21 += dy * s2
            g22 += w * t2
    return (u0, u1, u2), (g00, g01, g02, g10, g11, g12, g20, g21, g22), (v0, v1, v2)


@triton.jit
def _gather_affine(field, node, sx, sy, f, wz, gz, mz, inverse_dx, dx, mask, SLOPES: tl.constexpr):
    """Interpolated vector, its moments about the particle and (SLOPES) its derivatives [component, axis]."""
    zero = wz[0] * 0
    v0, v1, v2 = zero, zero, zero
    g00, g01, g02, g10, g11, g12, g20, g21, g22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for i in range(3):
        wx, gx = _weight(f[0], i, inverse_dx)
        mx = wx * (i - f[0]) * dx
        for j in range(3):
            wy, gy = _weight(f[1], j, inverse_dx)
            row = field + (node + i * sx + j * sy) * 4
            s0, s1, s2, t0, t1, t2, r0, r1, r2 = zero, zero, zero, zero, zero, zero, zero, zero, zero
            for k in tl.static_range(3):
                q0 = tl.load(row + k * 4, mask, 0.0)
                q1 = tl.load(row + k * 4 + 1, mask, 0.0)
                q2 = tl.load(row + k * 4 + 2, mask, 0.0)
                s0 += wz[k] * q0
                s1 += wz[k] * q1
                s2 += wz[k] * q2
                r0 += mz[k] * q0
                r1 += mz[k] * q1
                r2 += mz[k] * q2
                if SLOPES:
                    t0 += gz[k] * q0
                    t1 += gz[k] * q1
                    t2 += gz[k] * q2
            w = wx * wy
            ex = mx * wy
            ey = wx * (wy * (j - f[1]) * dx)
            v0 += w * s0
            v1 += w * s1
            v2 += w * s2
            c00 += ex * s0
            c01 += ey * s0
            c02 += w * r0
            c10 += ex * s1
            c11 += ey * s1
            c12 += w * r1
            c20 += ex * s2
            c21 += ey * s2
            c22 += w * r2
            if SLOPES:
                ax = gx * wy
                ay = wx * gy
                g00 += ax * s0
                g01 += ay * s0
                g02 += w * t0
                g10 += ax * s1
                g11 += ay * s1
                g12 += w * t1
                g20 += ax * s2
                g21 += ay * s2
                g22 += w * t2
    return (v0, v1, v2), (c00, c01, c02, c10, c11, c12, c20, c21, c22), (g00, g01, g02, g10, g11, g12, g20, g21, g22)


@triton.jit
def _load3(pointer, stride, index, mask):
    return (
        tl.load(pointer + index, mask, 0.0),
        tl.load(pointer + stride + index, mask, 0.0),
        tl.load(pointer + 2 * stride + index, mask, 0.0),
    )


@triton.jit
def _load9(pointer, stride, index, mask):
    return (
        tl.load(pointer + index, mask, 0.0),
        tl.load(pointer + stride + index, mask, 0.0),
        tl.load(pointer + 2 * stride + index, mask, 0.0),
        tl.load(pointer + 3 * stride + index, mask, 0.0),
        tl.load(pointer + 4 * stride + index, mask, 0.0),
        tl.load(pointer + 5 * stride + index, mask, 0.0),
        tl.load(pointer + 6 * stride + index, mask, 0.0),
        tl.load(pointer + 7 * stride + index, mask, 0.0),
        tl.load(pointer + 8 * stride + index, mask, 0.0),
    )


@triton.jit
def _store3(pointer, stride, index, value, mask):
    for k in tl.static_range(3):
        tl.store(pointer + k * stride + index, value[k], mask)


@triton.jit
def _store9(pointer, stride, index, value, mask):
    for k in tl.static_range(9):
        tl.store(pointer + k * stride + index, value[k], mask)


@triton.jit
def _twin_force(
    TWIN: tl.constexpr, OPTIONS: tl.constexpr, F, velocity, index, mask, scene, values, count, vectors, scenes, step,
    numbers,
):  # fmt: skip
    """Force of a ``forces.ForceTwin`` on some particles [N] and their resistance [kg/s]."""
    first = _load3(values, count, index, mask)
    last = tl.load(values + 3 * count + index, mask, 0.0)
    vector = vectors + (step * scenes + scene) * 3
    return TWIN(F, velocity, (first[0], first[1], first[2], last), vector, numbers, OPTIONS)


@triton.jit
def _add_given(force, resistance, force_in, where, mask):
    """Add the force and the resistance in the rows of ``force_in``."""
    more = _load3(force_in, 1, where * 4, mask)
    resistance += tl.load(force_in + where * 4 + 3, mask, 0.0)
    return (force[0] + more[0], force[1] + more[1], force[2] + more[2]), resistance


@triton.jit
def _account(force, resistance, velocity, kick, before, IMPLICIT: tl.constexpr, load, count, index, mask):
    """Work of the external force: what ended with this velocity is added, what begins with it is kept.

    ``load`` has the rows work, force (with implicit drag force + D v, D and v, eight rows in all).
    """
    work = tl.load(load + index, mask, 0.0)
    last = _load3(load + count, count, index, mask)
    if IMPLICIT:
        held = tl.load(load + 4 * count + index, mask, 0.0)
        was = _load3(load + 5 * count, count, index, mask)
        for k in tl.static_range(3):
            work += 0.5 * before * (last[k] - held * velocity[k]) * (was[k] + velocity[k])
            tl.store(load + (1 + k) * count + index, force[k] + resistance * velocity[k], mask)
            tl.store(load + (5 + k) * count + index, velocity[k], mask)
        tl.store(load + 4 * count + index, resistance, mask)
    else:
        for k in tl.static_range(3):
            work += 0.5 * velocity[k] * (before * last[k] + kick * force[k])
            tl.store(load + (1 + k) * count + index, force[k], mask)
    tl.store(load + index, work, mask)


@triton.jit(do_not_specialize=VARIES)
def total_particles(
    fraction, material, law, law_table, values, force_in, load, order, count,
    cell_start, cell_node, cell_scene, cells,
    fields, partial,
    schedule, vectors, scenes, numbers, first_step, step_offset,
    sx, sy, inverse_dx, viscous_time,
    LAWS: tl.constexpr, MULTI: tl.constexpr, TWIN: tl.constexpr, OPTIONS: tl.constexpr, FORCE: tl.constexpr,
    IMPLICIT: tl.constexpr, VISCOUS: tl.constexpr, POSITION: tl.constexpr, WIDTH: tl.constexpr,
    CELLS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """``total``: forces of the particles of some cells, summed into 27 rows of ``partial`` per cell.

    Lanes without a particle have no volume, values of a twin or mass, so they add nothing. A step of index zero of a
    rollout takes what came before it from row 0 of the schedule.
    """
    LOADED: tl.constexpr = (TWIN is not None) or FORCE
    step = tl.load(first_step) + step_offset
    kick = tl.load(schedule + (step + 1) * 4)
    before = tl.load(schedule + step * 4)
    cell = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    real = cell < cells
    start = tl.load(cell_start + cell, real, 0)
    end = tl.load(cell_start + cell + 1, real, 0)
    node = tl.load(cell_node + cell, real, 0)[:, None]
    scene = tl.load(cell_scene + cell, real, 0)[:, None]
    longest = tl.max(end - start)
    lane = tl.arange(0, LANES)[None, :]
    known = real[:, None]
    for chunk in range(0, longest, LANES):
        index = start[:, None] + chunk + lane
        mask = index < end[:, None]
        # a lane without a particle stands in the middle of the cell: outside it F might be inverted, which takes long
        f = (
            tl.load(fraction + index, mask, 1.0),
            tl.load(fraction + count + index, mask, 1.0),
            tl.load(fraction + 2 * count + index, mask, 1.0),
        )
        volume = tl.load(material + index, mask, 0.0)
        mu = tl.load(material + count + index, mask, 0.0)
        lam = tl.load(material + 2 * count + index, mask, 0.0)
        wz, gz = _weights(f[2], inverse_dx)
        if VISCOUS:
            u, F, _v = _gather(fields, node, sx, sy, f, wz, gz, inverse_dx, known, False)
            v, rate, _v = _gather(fields + 4, node, sx, sy, f, wz, gz, inverse_dx, known, False)
        elif LOADED:
            u, F, v = _gather(fields, node, sx, sy, f, wz, gz, inverse_dx, known, True)
        else:
            u, F, _v = _gather(fields, node, sx, sy, f, wz, gz, inverse_dx, known, False)
        F = (F[0] + 1, F[1], F[2], F[3], F[4] + 1, F[5], F[6], F[7], F[8] + 1)
        if MULTI:
            row = law_table + ROW * tl.load(law + index, mask, 0)
        else:
            row = law_table
        stress = pk1(F, mu, lam, row, LAWS)
        if VISCOUS:
            stress = axpy9(1.0, stress, 1.0, kelvin_voigt_pk1(F, rate, mu, lam, viscous_time))
        stress = scale9(-volume, stress)
        zero = volume * 0
        value = (zero, zero, zero)
        resistance = zero
        if TWIN is not None:
            value, resistance = _twin_force(
                TWIN, OPTIONS, F, v, index, mask, scene, values, count, vectors, scenes, step, numbers
            )
        if FORCE:
            where = tl.load(order + index, mask, 0)
            value, resistance = _add_given(value, resistance, force_in, where, mask)
        if LOADED:
            _account(value, resistance, v, kick, before, IMPLICIT, load, count, index, mask)
        if POSITION:
            mass = tl.load(material + 3 * count + index, mask, 0.0)
            moved = (mass * u[0], mass * u[1], mass * u[2])
        for i in range(3):
            wx, gx = _weight(f[0], i, inverse_dx)
            for j in range(3):
                wy, gy = _weight(f[1], j, inverse_dx)
                w = wx * wy
                ax = gx * wy
                ay = wx * gy
                a0 = value[0] * w + stress[0] * ax + stress[1] * ay
                a1 = value[1] * w + stress[3] * ax + stress[4] * ay
                a2 = value[2] * w + stress[6] * ax + stress[7] * ay
                for k in tl.static_range(3):
                    out = partial + (((i * 3 + j) * 3 + k) * (cells + 1) + cell) * WIDTH
                    gw = gz[k] * w
                    s0 = tl.sum(wz[k] * a0 + gw * stress[2], 1)
                    s1 = tl.sum(wz[k] * a1 + gw * stress[5], 1)
                    s2 = tl.sum(wz[k] * a2 + gw * stress[8], 1)
                    if chunk > 0:
                        s0 += tl.load(out, real, 0.0)
                        s1 += tl.load(out + 1, real, 0.0)
                        s2 += tl.load(out + 2, real, 0.0)
                    tl.store(out, s0, real)
                    tl.store(out + 1, s1, real)
                    tl.store(out + 2, s2, real)
                    if IMPLICIT:
                        s3 = tl.sum(wz[k] * (w * resistance), 1)
                        if chunk > 0:
                            s3 += tl.load(out + 3, real, 0.0)
                        tl.store(out + 3, s3, real)
                    if POSITION:
                        for c in tl.static_range(3):
                            s4 = tl.sum(wz[k] * (w * moved[c]), 1)
                            if chunk > 0:
                                s4 += tl.load(out + 4 + c, real, 0.0)
                            tl.store(out + 4 + c, s4, real)


@triton.jit(do_not_specialize=VARIES)
def total_pieces(pieces_in, partial, first_piece, cells, pieces, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    """``total``: the sums of each cell from those of its pieces, always in the same order."""
    o = tl.program_id(1)
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = cell < cells
    first = tl.load(first_piece + cell, mask, 0)
    many = tl.load(first_piece + cell + 1, mask, 0) - first
    column = tl.arange(0, WIDTH)[None, :]
    total = tl.zeros([BLOCK, WIDTH], tl.float32)
    for k in range(0, tl.max(many)):
        row = (o * (pieces + 1) + first + k) * WIDTH
        total += tl.load(pieces_in + row[:, None] + column, (k < many)[:, None], 0.0)
    out = (o * (cells + 1) + cell) * WIDTH
    tl.store(partial + out[:, None] + column, total, mask[:, None])


@triton.jit(do_not_specialize=VARIES)
def total_nodes(
    active, source, inverse_mass, held, nodes, cells, partial, fields, shift,
    schedule, first_step, step_offset, gravity_x, gravity_y, gravity_z,
    IMPLICIT: tl.constexpr, POSITION: tl.constexpr, WIDTH: tl.constexpr, HELD: tl.constexpr, MOVE: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """``total``: nodal velocities and displacements from the sums of the cells around each node."""
    step = tl.load(first_step) + step_offset
    kick = tl.load(schedule + (step + 1) * 4)
    dt = tl.load(schedule + (step + 1) * 4 + 1)
    decay = tl.load(schedule + (step + 1) * 4 + 2)
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < nodes
    node = tl.load(active + k, mask, 0)
    inverse = tl.load(inverse_mass + k, mask, 0.0)
    f0 = tl.zeros([BLOCK], tl.float32)
    f1 = tl.zeros([BLOCK], tl.float32)
    f2 = tl.zeros([BLOCK], tl.float32)
    drag = tl.zeros([BLOCK], tl.float32)
    m0 = tl.zeros([BLOCK], tl.float32)
    m1 = tl.zeros([BLOCK], tl.float32)
    m2 = tl.zeros([BLOCK], tl.float32)
    for o in tl.static_range(27):
        row = partial + (o * (cells + 1) + tl.load(source + o * nodes + k, mask, cells)) * WIDTH
        f0 += tl.load(row, mask, 0.0)
        f1 += tl.load(row + 1, mask, 0.0)
        f2 += tl.load(row + 2, mask, 0.0)
        if IMPLICIT:
            drag += tl.load(row + 3, mask, 0.0)
        if POSITION:
            m0 += tl.load(row + 4, mask, 0.0)
            m1 += tl.load(row + 5, mask, 0.0)
            m2 += tl.load(row + 6, mask, 0.0)
    if IMPLICIT:
        push = kick / (1 + kick * drag * inverse)
    else:
        push = kick
    place = fields + node * 8 + 4
    v0 = (tl.load(place, mask, 0.0) + push * (f0 * inverse + gravity_x)) * decay
    v1 = (tl.load(place + 1, mask, 0.0) + push * (f1 * inverse + gravity_y)) * decay
    v2 = (tl.load(place + 2, mask, 0.0) + push * (f2 * inverse + gravity_z)) * decay
    if HELD:
        free = tl.load(held + k, mask, 0) == 0
        v0 = tl.where(free, v0, 0.0)
        v1 = tl.where(free, v1, 0.0)
        v2 = tl.where(free, v2, 0.0)
    tl.store(place, v0, mask)
    tl.store(place + 1, v1, mask)
    tl.store(place + 2, v2, mask)
    if MOVE:
        to = fields + node * 8
        tl.store(to, tl.load(to, mask, 0.0) + dt * v0, mask)
        tl.store(to + 1, tl.load(to + 1, mask, 0.0) + dt * v1, mask)
        tl.store(to + 2, tl.load(to + 2, mask, 0.0) + dt * v2, mask)
    if POSITION:
        out = shift + node * 4
        tl.store(out, m0 * inverse, mask)
        tl.store(out + 1, m1 * inverse, mask)
        tl.store(out + 2, m2 * inverse, mask)


@triton.jit(do_not_specialize=VARIES)
def total_read(
    fraction, load, order, rest, count, particle_cell, cell_node, fields, kick_before,
    position_out, velocity_out, affine_out, F_out, sx, sy, inverse_dx,
    WORK: tl.constexpr, IMPLICIT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``total``: the particle fields, in the order in which they were given."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    f = _load3(fraction, count, index, mask)
    node = tl.load(cell_node + tl.load(particle_cell + index, mask, 0), mask, 0)
    where = tl.load(order + index, mask, 0)
    wz, gz = _weights(f[2], inverse_dx)
    u, F, _v = _gather(fields, node, sx, sy, f, wz, gz, inverse_dx, mask, False)
    v, rate, _v = _gather(fields + 4, node, sx, sy, f, wz, gz, inverse_dx, mask, False)
    if WORK:
        zero = f[0] * 0
        _account((zero, zero, zero), zero, v, 0.0, tl.load(kick_before), IMPLICIT, load, count, index, mask)
    F = (F[0] + 1, F[1], F[2], F[3], F[4] + 1, F[5], F[6], F[7], F[8] + 1)
    for k in tl.static_range(3):
        tl.store(position_out + where * 3 + k, tl.load(rest + where * 3 + k, mask, 0.0) + u[k], mask)
        tl.store(velocity_out + where * 3 + k, v[k], mask)
    for k in tl.static_range(9):
        tl.store(F_out + where * 9 + k, F[k], mask)
        tl.store(affine_out + where * 9 + k, rate[k], mask)


@triton.jit
def _larger(a, b):
    return tl.maximum(a, b)


@triton.jit
def _sum_segments(a, l1, l2, l4, l8, l16, s1, s2, s4, s8, s16):
    """Sum of each segment of 32 lanes, in its last lane: five shuffles, each from a lane of the same segment."""
    a += tl.where(s1, tl.gather(a, l1, 0), 0.0)
    a += tl.where(s2, tl.gather(a, l2, 0), 0.0)
    a += tl.where(s4, tl.gather(a, l4, 0), 0.0)
    a += tl.where(s8, tl.gather(a, l8, 0), 0.0)
    a += tl.where(s16, tl.gather(a, l16, 0), 0.0)
    return a


@triton.jit
def _locate(x, dx, o, n):
    """First node of the stencil on one axis within the grid, the place in it, and whether the stencil fits."""
    lattice = tl.div_rn(x, dx + x * 0)
    base = tl.floor(lattice - 0.5)
    first = base.to(tl.int32) - o
    f = lattice - base
    fits = (first >= 0) & (first <= n - 3) & (f < 2)  # NaN becomes any integer, and is not below anything
    return first, tl.where(fits, f, 1.0), fits


@triton.jit(do_not_specialize=VARIES)
def updated_particles(
    moving, order, load, count,
    momentum, velocity, schedule, vectors, scenes, numbers, first_step, step_offset, law_table, force_in,
    ox, oy, oz, nx, ny, nz, dx, inverse_dx, viscous_time, scene_size,
    LAWS: tl.constexpr, PLASTIC: tl.constexpr, MULTI: tl.constexpr, TWIN: tl.constexpr, OPTIONS: tl.constexpr,
    FORCE: tl.constexpr, IMPLICIT: tl.constexpr, VISCOUS: tl.constexpr, MLS: tl.constexpr, WIDTH: tl.constexpr,
    GATHER: tl.constexpr, SCATTER: tl.constexpr,
):  # fmt: skip
    """``updated``: the end of substep ``step`` - 1 (GATHER) and the start of substep ``step`` (SCATTER).

    Rows of ``moving``: position 0, F 3, velocity 12, affine 15, lost 24, internal 25, mass 26, volume 27, mu 28,
    lam 29, law 30, the four values of a twin 31, and total F 35 where a law is plastic.
    """
    LOADED: tl.constexpr = (TWIN is not None) or FORCE
    step = tl.load(first_step) + step_offset
    kick = tl.load(schedule + (step + 1) * 4)
    before = tl.load(schedule + step * 4)
    dt = tl.load(schedule + step * 4 + 1)
    index = tl.program_id(0) * 32 + tl.arange(0, 32)  # one warp, for its shuffles
    mask = index < count
    x = _load3(moving, count, index, mask)
    F = _load9(moving + 3 * count, count, index, mask)
    internal = tl.load(moving + 25 * count + index, mask, 0.0)
    mu = tl.load(moving + 28 * count + index, mask, 0.0)
    lam = tl.load(moving + 29 * count + index, mask, 0.0)
    where = tl.load(order + index, mask, 0)
    scene = where // scene_size
    if MULTI:
        law = law_table + ROW * tl.load(moving + 30 * count + index, mask, 0.0).to(tl.int32)
    else:
        law = law_table
    sy = nz
    sx = ny * nz
    if PLASTIC:
        F_total = _load9(moving + 35 * count, count, index, mask)
    else:
        F_total = F
    stress = F
    if GATHER:
        bx, fx, okx = _locate(x[0], dx, ox, nx)
        by, fy, oky = _locate(x[1], dx, oy, ny)
        bz, fz, okz = _locate(x[2], dx, oz, nz)
        inside = mask & okx & oky & okz
        node = tl.where(inside, (bx * ny + by) * nz + bz, 0) + scene * (nx * ny * nz)
        wz, gz = _weights(fz, inverse_dx)
        mz = (-fz * wz[0] * dx, (1 - fz) * wz[1] * dx, (2 - fz) * wz[2] * dx)
        v, C, L = _gather_affine(
            velocity, node, sx, sy, (fx, fy, fz), wz, gz, mz, inverse_dx, dx, inside, SLOPES=not MLS
        )
        C = scale9(4 * inverse_dx * inverse_dx, C)
        if MLS:
            L = C
        U = (1 + dt * L[0], dt * L[1], dt * L[2], dt * L[3], 1 + dt * L[4], dt * L[5], dt * L[6], dt * L[7],
             1 + dt * L[8])  # fmt: skip
        F = matmul(U, F)
        if PLASTIC:
            F_total = matmul(U, F_total)
        else:
            F_total = F
        x = (x[0] + dt * v[0], x[1] + dt * v[1], x[2] + dt * v[2])
        lost = tl.load(moving + 24 * count + index, mask, 0.0)
        tl.store(moving + 24 * count + index, tl.where(inside, lost, 1.0), mask)
        if PLASTIC or SCATTER:
            F, internal, stress = kirchhoff(F, mu, lam, internal, law, dt, LAWS, True)
        _store3(moving, count, index, x, mask)
        _store9(moving + 3 * count, count, index, F, mask)
        _store3(moving + 12 * count, count, index, v, mask)
        if PLASTIC:
            _store9(moving + 35 * count, count, index, F_total, mask)
            tl.store(moving + 25 * count + index, internal, mask)
    else:
        v = _load3(moving + 12 * count, count, index, mask)
        C = _load9(moving + 15 * count, count, index, mask)
        F, internal, stress = kirchhoff(F, mu, lam, internal, law, dt, LAWS, False)
    zero = mu * 0
    force = (zero, zero, zero)
    resistance = zero
    if SCATTER:
        if TWIN is not None:
            force, resistance = _twin_force(
                TWIN, OPTIONS, F_total, v, index, mask, scene, moving + 31 * count, count, vectors, scenes, step,
                numbers,
            )  # fmt: skip
        if FORCE:
            force, resistance = _add_given(force, resistance, force_in, where, mask)
    if LOADED:
        _account(force, resistance, v, kick, before, IMPLICIT, load, count, index, mask)
    if SCATTER:
        mass = tl.load(moving + 26 * count + index, mask, 0.0)
        volume = tl.load(moving + 27 * count + index, mask, 0.0)
        if VISCOUS:
            viscous = kelvin_voigt_pk1(F, matmul(C, F), mu, lam, viscous_time)
            stress = axpy9(1.0, stress, 1.0, matmul(viscous, transpose(F)))
        bx, fx, okx = _locate(x[0], dx, ox, nx)
        by, fy, oky = _locate(x[1], dx, oy, ny)
        bz, fz, okz = _locate(x[2], dx, oz, nz)
        inside = mask & okx & oky & okz
        node = tl.where(inside, (bx * ny + by) * nz + bz + scene * (nx * ny * nz), -1)
        wz, gz = _weights(fz, inverse_dx)
        pull = -kick * volume
        if IMPLICIT:
            value = (
                mass * v[0] + kick * (force[0] + resistance * v[0]),
                mass * v[1] + kick * (force[1] + resistance * v[1]),
                mass * v[2] + kick * (force[2] + resistance * v[2]),
                mass,
            )
        else:
            value = (mass * v[0] + kick * force[0], mass * v[1] + kick * force[1], mass * v[2] + kick * force[2], mass)
        # what multiplies w (x_i - x_p), and what multiplies the gradient of w
        if MLS:
            moment = axpy9(mass, C, 4 * inverse_dx * inverse_dx * pull, stress)
            slope = moment
        else:
            moment = scale9(mass, C)
            slope = scale9(pull, stress)
        # neighbours in the order that share a cell form a segment
        lane = tl.arange(0, 32)
        following = tl.gather(node, tl.minimum(lane + 1, 31), 0)
        last = ((node != following) | (lane == 31)) & (node >= 0)
        l1 = tl.maximum(lane - 1, 0)
        l2 = tl.maximum(lane - 2, 0)
        l4 = tl.maximum(lane - 4, 0)
        l8 = tl.maximum(lane - 8, 0)
        l16 = tl.maximum(lane - 16, 0)
        head = (node != tl.gather(node, l1, 0)) | (lane == 0)
        first = tl.associative_scan(tl.where(head, lane, 0), 0, _larger)
        s1 = lane - 1 >= first
        s2 = lane - 2 >= first
        s4 = lane - 4 >= first
        s8 = lane - 8 >= first
        s16 = lane - 16 >= first
        for i in range(3):
            wx, gx = _weight(fx, i, inverse_dx)
            rx = (i - fx) * dx
            for j in range(3):
                wy, gy = _weight(fy, j, inverse_dx)
                ry = (j - fy) * dx
                w = wx * wy
                c0 = (value[0] + moment[0] * rx + moment[1] * ry) * w
                c1 = (value[1] + moment[3] * rx + moment[4] * ry) * w
                c2 = (value[2] + moment[6] * rx + moment[7] * ry) * w
                if not MLS:
                    gw = gx * wy
                    wg = wx * gy
                    c0 += slope[0] * gw + slope[1] * wg
                    c1 += slope[3] * gw + slope[4] * wg
                    c2 += slope[6] * gw + slope[7] * wg
                for k in tl.static_range(3):
                    wr = wz[k] * w * ((k - fz) * dx)
                    a0 = wz[k] * c0 + wr * moment[2]
                    a1 = wz[k] * c1 + wr * moment[5]
                    a2 = wz[k] * c2 + wr * moment[8]
                    a3 = wz[k] * (w * mass)
                    if not MLS:
                        sw = gz[k] * w
                        a0 += sw * slope[2]
                        a1 += sw * slope[5]
                        a2 += sw * slope[8]
                    a0 = _sum_segments(a0, l1, l2, l4, l8, l16, s1, s2, s4, s8, s16)
                    a1 = _sum_segments(a1, l1, l2, l4, l8, l16, s1, s2, s4, s8, s16)
                    a2 = _sum_segments(a2, l1, l2, l4, l8, l16, s1, s2, s4, s8, s16)
                    a3 = _sum_segments(a3, l1, l2, l4, l8, l16, s1, s2, s4, s8, s16)
                    row = momentum + (node + i * sx + j * sy + k) * WIDTH
                    tl.atomic_add(row, a0, last, sem="relaxed")
                    tl.atomic_add(row + 1, a1, last, sem="relaxed")
                    tl.atomic_add(row + 2, a2, last, sem="relaxed")
                    tl.atomic_add(row + 3, a3, last, sem="relaxed")
                    if IMPLICIT:
                        a4 = _sum_segments(wz[k] * (w * resistance), l1, l2, l4, l8, l16, s1, s2, s4, s8, s16)
                        tl.atomic_add(row + 4, a4, last, sem="relaxed")
    else:
        _store9(moving + 15 * count, count, index, C, mask)


@triton.jit(do_not_specialize=VARIES)
def updated_nodes(
    momentum, velocity, inverse_mass, nodes, schedule, first_step, step_offset,
    gravity_x, gravity_y, gravity_z,
    IMPLICIT: tl.constexpr, WIDTH: tl.constexpr, KEEP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: nodal velocities from momenta and masses, which are set back to zero; KEEP for boundaries."""
    step = tl.load(first_step) + step_offset
    kick = tl.load(schedule + (step + 1) * 4)
    decay = tl.load(schedule + (step + 1) * 4 + 2)
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < nodes
    row = momentum + k * WIDTH
    mass = tl.load(row + 3, mask, 0.0)
    some = mass > 1.0842022e-19  # the square root of the smallest normal number, as in the definition
    inverse = tl.where(some, 1.0 / tl.maximum(mass, 1.0842022e-19), 0.0)
    push = tl.where(some, kick, 0.0)
    share = inverse
    if IMPLICIT:
        yielding = 1.0 / (1 + kick * tl.load(row + 4, mask, 0.0) * inverse)
        push = push * yielding
        share = inverse * yielding
    place = velocity + k * 4
    tl.store(place, (tl.load(row, mask, 0.0) * share + push * gravity_x) * decay, mask)
    tl.store(place + 1, (tl.load(row + 1, mask, 0.0) * share + push * gravity_y) * decay, mask)
    tl.store(place + 2, (tl.load(row + 2, mask, 0.0) * share + push * gravity_z) * decay, mask)
    if KEEP:
        tl.store(inverse_mass + k, inverse, mask)
    zero = mass * 0
    used = mask & (mass != 0)
    for c in tl.static_range(WIDTH):
        tl.store(row + c, zero, used)


@triton.jit(do_not_specialize=VARIES)
def updated_load(
    order, position, velocity, affine, F_elastic, F_total, lost, internal, constants, moving, count,
    PLASTIC: tl.constexpr, INTERNAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: particle fields, and the ``constants`` (P, 9) of rows 26 to 34, into the rows of ``moving``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    where = tl.load(order + index, mask, 0)
    _store3(moving, count, index, _load3(position, 1, where * 3, mask), mask)
    _store9(moving + 3 * count, count, index, _load9(F_elastic, 1, where * 9, mask), mask)
    _store3(moving + 12 * count, count, index, _load3(velocity, 1, where * 3, mask), mask)
    _store9(moving + 15 * count, count, index, _load9(affine, 1, where * 9, mask), mask)
    tl.store(moving + 24 * count + index, tl.load(lost + where, mask, 0).to(tl.float32), mask)
    if INTERNAL:
        tl.store(moving + 25 * count + index, tl.load(internal + where, mask, 0.0), mask)
    _store9(moving + 26 * count, count, index, _load9(constants, 1, where * 9, mask), mask)
    if PLASTIC:
        _store9(moving + 35 * count, count, index, _load9(F_total, 1, where * 9, mask), mask)


@triton.jit(do_not_specialize=VARIES)
def updated_read(
    order, moving, count, position, velocity, affine, F_elastic, F_total, lost, internal,
    PLASTIC: tl.constexpr, INTERNAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: the rows of ``moving`` back to particle fields in the order in which they were given."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    where = tl.load(order + index, mask, 0)
    _store3(position, 1, where * 3, _load3(moving, count, index, mask), mask)
    _store9(F_elastic, 1, where * 9, _load9(moving + 3 * count, count, index, mask), mask)
    _store3(velocity, 1, where * 3, _load3(moving + 12 * count, count, index, mask), mask)
    _store9(affine, 1, where * 9, _load9(moving + 15 * count, count, index, mask), mask)
    tl.store(lost + where, tl.load(moving + 24 * count + index, mask, 0.0) != 0, mask)
    if INTERNAL:
        tl.store(internal + where, tl.load(moving + 25 * count + index, mask, 0.0), mask)
    if PLASTIC:
        _store9(F_total, 1, where * 9, _load9(moving + 35 * count, count, index, mask), mask)


@triton.jit(do_not_specialize=VARIES)
def pin_mass(moving, order, pinned, weight, count, ox, oy, oz, nx, ny, nz, dx, scene_size, BLOCK: tl.constexpr):
    """``updated``: mass that the particles of a boundary bring to each node."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    where = tl.load(order + index, mask, 0)
    mass = tl.load(pinned + where, mask, 0.0)
    bx, fx, okx = _locate(tl.load(moving + index, mask, 0.0), dx, ox, nx)
    by, fy, oky = _locate(tl.load(moving + count + index, mask, 0.0), dx, oy, ny)
    bz, fz, okz = _locate(tl.load(moving + 2 * count + index, mask, 0.0), dx, oz, nz)
    inside = mask & okx & oky & okz & (mass > 0)
    node = tl.where(inside, (bx * ny + by) * nz + bz, 0) + (where // scene_size) * (nx * ny * nz)
    wz, _gz = _weights(fz, 1.0)
    for i in range(3):
        wx, _gx = _weight(fx, i, 1.0)
        for j in range(3):
            wy, _gy = _weight(fy, j, 1.0)
            row = weight + node + (i * ny + j) * nz
            for k in tl.static_range(3):
                tl.atomic_add(row + k, mass * (wx * wy * wz[k]), inside, sem="relaxed")


@triton.jit
def _wave_speed(F, density, mu, lam, WAVE: tl.constexpr, SPATIAL: tl.constexpr):
    """Speed of a wave [m/s], as ``timestep.wave_speed``."""
    squared = WAVE(F, mu, lam) / density
    if SPATIAL:
        stretch = largest_eigenvalue(matmul(transpose(F), F))
        squared = squared * largest(stretch, 1.0)
    return tl.sqrt(squared)


@triton.jit(do_not_specialize=VARIES)
def elastic_energy(F_in, mu_in, lam_in, out, count, ENERGY: tl.constexpr, BLOCK: tl.constexpr):
    """Energy density of particles [J/m³], as ``ConstitutiveLaw.energy``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    F = _load9(F_in, 1, index * 9, mask)
    mu = tl.load(mu_in + index, mask, 0.0)
    lam = tl.load(lam_in + index, mask, 0.0)
    tl.store(out + index, ENERGY(F, mu, lam), mask)


@triton.jit
def _keep_largest(out, speed, mask):
    """The largest value into ``out``; infinity for NaN, which an atomic maximum would lose."""
    speed = tl.where(mask, tl.where(speed == speed, speed, float("inf")), 0.0)
    tl.atomic_max(out, tl.max(speed))


@triton.jit(do_not_specialize=VARIES)
def largest_speed(
    F_in, density, mu_in, lam_in, velocity, out, count, WAVE: tl.constexpr, SPATIAL: tl.constexpr, BLOCK: tl.constexpr
):
    """Largest speed of a wave [m/s] (and of its particle, SPATIAL), into ``out``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    F = _load9(F_in, 1, index * 9, mask)
    mu = tl.load(mu_in + index, mask, 0.0)
    lam = tl.load(lam_in + index, mask, 0.0)
    speed = _wave_speed(F, tl.load(density + index, mask, 1.0), mu, lam, WAVE, SPATIAL)
    if SPATIAL:
        v = _load3(velocity, 1, index * 3, mask)
        speed += tl.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    _keep_largest(out, speed, mask)


@triton.jit(do_not_specialize=VARIES)
def total_look(
    fraction, material, count, particle_cell, cell_node, fields, out, sx, sy, inverse_dx,
    WAVE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``total``: as ``largest_speed``, from the nodal displacements."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    f = _load3(fraction, count, index, mask)
    node = tl.load(cell_node + tl.load(particle_cell + index, mask, 0), mask, 0)
    wz, gz = _weights(f[2], inverse_dx)
    _u, F, _v = _gather(fields, node, sx, sy, f, wz, gz, inverse_dx, mask, False)
    F = (F[0] + 1, F[1], F[2], F[3], F[4] + 1, F[5], F[6], F[7], F[8] + 1)
    mu = tl.load(material + count + index, mask, 0.0)
    lam = tl.load(material + 2 * count + index, mask, 0.0)
    density = tl.load(material + 3 * count + index, mask, 1.0) / tl.load(material + index, mask, 1.0)
    _keep_largest(out, _wave_speed(F, density, mu, lam, WAVE, False), mask)


@triton.jit(do_not_specialize=VARIES)
def updated_look(moving, count, out, WAVE: tl.constexpr, BLOCK: tl.constexpr):
    """``updated``: as ``largest_speed``, from the rows of ``moving``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    F = _load9(moving + 3 * count, count, index, mask)
    mu = tl.load(moving + 28 * count + index, mask, 0.0)
    lam = tl.load(moving + 29 * count + index, mask, 0.0)
    density = tl.load(moving + 26 * count + index, mask, 1.0) / tl.load(moving + 27 * count + index, mask, 1.0)
    v = _load3(moving + 12 * count, count, index, mask)
    speed = _wave_speed(F, density, mu, lam, WAVE, True) + tl.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    _keep_largest(out, speed, mask)
