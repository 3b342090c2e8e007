"""Kernels of the ``updated`` substep; the reference is :mod:`~gaussian_swaying.mpm.updated`.

One kernel gathers the end of a substep and scatters the start of the next, so a particle is read and written once.
Particles are sorted by cell from time to time; up to eight neighbours in that order that share a cell are summed by a
segmented scan, and only the last one of each segment is added to the grid, atomically.

Rows of node arrays: velocity, or momentum and mass, in four columns. The sums also have four, or eight with implicit
drag.
"""

from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    axpy9,
    columns9,
    dot3,
    load3,
    load9,
    matmul,
    plus_identity,
    scale3,
    scale9,
    store3,
    store9,
    transpose,
    where3,
)
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.colliders import acts, stop_nodes
from gaussian_swaying.mpm.damping import kelvin_voigt
from gaussian_swaying.mpm.dispatch import ROW, kirchhoff
from gaussian_swaying.mpm.shared_kernels import (
    VARIES,
    account,
    add_four,
    add_given,
    axis_weights,
    keep_largest,
    load_four,
    node_weight,
    sum_of_forces,
    vector,
    wave_speed,
)

REACH = tl.constexpr(3)
"""Shuffles of a sum over neighbours: 2^REACH of them at most are added up before they are added to the grid."""

PART = tl.constexpr(32)
"""Numbers that a particle adds to the grid, on a CPU."""


@triton.jit
def _gather_affine(
    field, node, sx, sy, f, wz, gz, mz, inverse_dx, dx, mask, WIDE: tl.constexpr
):  # fmt: skip
    """Interpolated vector, its moments about the particle and its derivatives [component, axis]."""
    zero = (wz[0] * 0, wz[0] * 0, wz[0] * 0)
    v, by_x, by_y, by_z, about_x, about_y, about_z = zero, zero, zero, zero, zero, zero, zero
    for i in range(3):
        wx, gx = node_weight(f[0], i, inverse_dx)
        mx = wx * (i - f[0]) * dx
        for j in range(3):
            wy, gy = node_weight(f[1], j, inverse_dx)
            row = field + (node + i * sx + j * sy) * 4
            s, t, r = zero, zero, zero
            for k in tl.static_range(3):
                q = load_four(row + k * 4) if WIDE else vector(row + k * 4, mask)
                s = add3(s, wz[k], q)
                r = add3(r, mz[k], q)
                t = add3(t, gz[k], q)
            w = wx * wy
            v = add3(v, w, s)
            about_x = add3(about_x, mx * wy, s)
            about_y = add3(about_y, wx * (wy * (j - f[1]) * dx), s)
            about_z = add3(about_z, w, r)
            by_x = add3(by_x, gx * wy, s)
            by_y = add3(by_y, wx * gy, s)
            by_z = add3(by_z, w, t)
    return v, columns9(about_x, about_y, about_z), columns9(by_x, by_y, by_z)


@triton.jit
def _larger(a, b):
    return tl.maximum(a, b)


@triton.jit
def _sum_segments(a, lane, first):
    """Sum of each segment of 32 lanes, in its last lane: REACH shuffles, each from a lane of the same segment.

    ``first`` is the first lane of a lane's segment. A segment has at most 2^REACH lanes.
    """
    for k in tl.static_range(REACH):
        from_lane = lane - (1 << k)
        a += tl.where(from_lane >= first, tl.gather(a, tl.maximum(from_lane, 0), 0), 0.0)
    return a


@triton.jit
def _locate(x, dx, o, n):
    lattice = tl.div_rn(x, dx + x * 0)
    base = tl.floor(lattice - 0.5)
    first = base.to(tl.int32) - o
    f = lattice - base
    fits = (first >= 0) & (first <= n - 3) & (f < 2)  # NaN becomes an arbitrary integer; NaN < 2 is False
    return first, tl.where(fits, f, 1.0), fits


@triton.jit
def _stencil(x, mask, scene, ox, oy, oz, nx, ny, nz, dx):
    bx, fx, okx = _locate(x[0], dx, ox, nx)
    by, fy, oky = _locate(x[1], dx, oy, ny)
    bz, fz, okz = _locate(x[2], dx, oz, nz)
    inside = mask & okx & oky & okz
    return tl.where(inside, (bx * ny + by) * nz + bz, 0) + scene * (nx * ny * nz), fx, fy, fz, inside


@triton.jit(do_not_specialize=VARIES)
def updated_particles(
    moving, order, load, count,
    momentum, velocity, schedule, vectors, scenes, numbers, first_step, step_offset, law_table, force_in,
    ox, oy, oz, nx, ny, nz, dx, inverse_dx, viscous_time, scene_size, parts, part_node,
    LAWS: tl.constexpr, PLASTIC: tl.constexpr, MULTI: tl.constexpr, FORCES: tl.constexpr, FORCE: tl.constexpr,
    IMPLICIT: tl.constexpr, VISCOUS: tl.constexpr, WIDTH: tl.constexpr, GATHER: tl.constexpr,
    SCATTER: tl.constexpr, ATOMIC: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: the end of substep ``step`` - 1 (GATHER) and the start of substep ``step`` (SCATTER).

    Without ATOMIC what each particle adds to the grid goes to a row of ``parts`` (see :func:`updated_scatter`), and
    its node to ``part_node``. With it, BLOCK is 32.

    Rows of ``moving``: position 0, F 3, velocity 12, affine 15, lost 24, internal 25, mass 26, volume 27, mu 28,
    lam 29, law 30, total F 31 where a law is plastic, and then the numbers that forces have for each point.
    """
    LOADED: tl.constexpr = (len(FORCES.functions) > 0) or FORCE
    step = tl.load(first_step) + step_offset
    kick = tl.load(schedule + (step + 1) * 4)
    before = tl.load(schedule + step * 4)
    dt = tl.load(schedule + step * 4 + 1)
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)  # one warp, for its shuffles
    mask = index < count
    x = load3(moving, count, index, mask)
    F = load9(moving + 3 * count, count, index, mask)
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
        F_total = load9(moving + 31 * count, count, index, mask)
    else:
        F_total = F
    stress = F
    if GATHER:
        node, fx, fy, fz, inside = _stencil(x, mask, scene, ox, oy, oz, nx, ny, nz, dx)
        wz, gz = axis_weights(fz, inverse_dx)
        if WIDE:  # it reads under no mask
            wz = (tl.where(inside, wz[0], 0.0), tl.where(inside, wz[1], 0.0), tl.where(inside, wz[2], 0.0))
            gz = (tl.where(inside, gz[0], 0.0), tl.where(inside, gz[1], 0.0), tl.where(inside, gz[2], 0.0))
        mz = (-fz * wz[0] * dx, (1 - fz) * wz[1] * dx, (2 - fz) * wz[2] * dx)
        v, C, L = _gather_affine(velocity, node, sx, sy, (fx, fy, fz), wz, gz, mz, inverse_dx, dx, inside, WIDE=WIDE)
        C = scale9(4 * inverse_dx * inverse_dx, C)
        U = plus_identity(scale9(dt, L))
        F = matmul(U, F)
        if PLASTIC:
            F_total = matmul(U, F_total)
        else:
            F_total = F
        x = add3(x, dt, v)
        lost = tl.load(moving + 24 * count + index, mask, 0.0)
        tl.store(moving + 24 * count + index, tl.where(inside, lost, 1.0), mask)
        if PLASTIC or SCATTER:
            F, internal, stress = kirchhoff(F, mu, lam, internal, law, dt, LAWS, True)
        store3(moving, count, index, x, mask)
        store9(moving + 3 * count, count, index, F, mask)
        store3(moving + 12 * count, count, index, v, mask)
        if PLASTIC:
            store9(moving + 31 * count, count, index, F_total, mask)
            tl.store(moving + 25 * count + index, internal, mask)
    else:
        v = load3(moving + 12 * count, count, index, mask)
        C = load9(moving + 15 * count, count, index, mask)
        F, internal, stress = kirchhoff(F, mu, lam, internal, law, dt, LAWS, False)
    zero = mu * 0
    force = (zero, zero, zero)
    resistance = zero
    if SCATTER:
        if len(FORCES.functions) > 0:
            values = moving + (40 if PLASTIC else 31) * count
            force, resistance = sum_of_forces(
                FORCES, F_total, v, x, index, mask, scene, values, count, vectors, scenes, step, numbers
            )
        if FORCE:
            force, resistance = add_given(force, resistance, force_in, where, mask)
    if LOADED:
        account(force, resistance, v, kick, before, IMPLICIT, load, count, index, mask)
    if SCATTER:
        mass = tl.load(moving + 26 * count + index, mask, 0.0)
        volume = tl.load(moving + 27 * count + index, mask, 0.0)
        if VISCOUS:
            viscous = kelvin_voigt(F, matmul(C, F), mu, lam, viscous_time)
            stress = axpy9(1.0, stress, 1.0, matmul(viscous, transpose(F)))
        first, fx, fy, fz, inside = _stencil(x, mask, scene, ox, oy, oz, nx, ny, nz, dx)
        node = tl.where(inside, first, -1)
        wz, gz = axis_weights(fz, inverse_dx)
        pull = -kick * volume
        push = force
        if IMPLICIT:
            push = add3(force, resistance, v)
        value = axpy3(mass, v, kick, push) + (mass,)
        # factor of w (x_i - x_p), and factor of the gradient of w
        moment = scale9(mass, C)
        slope = scale9(pull, stress)
        if ATOMIC:
            # neighbours in the order that share a cell form a segment
            lane = tl.arange(0, 32)
            head = (node != tl.gather(node, tl.maximum(lane - 1, 0), 0)) | (lane == 0)
            first = tl.associative_scan(tl.where(head, lane, 0), 0, _larger)
            first += ((lane - first) >> REACH) << REACH  # longer segments are cut
            following = tl.gather(first, tl.minimum(lane + 1, 31), 0)
            last = ((first != following) | (lane == 31)) & (node >= 0)
            for i in range(3):
                wx, gx = node_weight(fx, i, inverse_dx)
                rx = (i - fx) * dx
                for j in range(3):
                    wy, gy = node_weight(fy, j, inverse_dx)
                    ry = (j - fy) * dx
                    w = wx * wy
                    c0 = (value[0] + moment[0] * rx + moment[1] * ry) * w
                    c1 = (value[1] + moment[3] * rx + moment[4] * ry) * w
                    c2 = (value[2] + moment[6] * rx + moment[7] * ry) * w
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
                        sw = gz[k] * w
                        a0 += sw * slope[2]
                        a1 += sw * slope[5]
                        a2 += sw * slope[8]
                        a0 = _sum_segments(a0, lane, first)
                        a1 = _sum_segments(a1, lane, first)
                        a2 = _sum_segments(a2, lane, first)
                        a3 = _sum_segments(a3, lane, first)
                        row = momentum + (node + i * sx + j * sy + k) * WIDTH
                        if WIDE:
                            add_four(row, (a0, a1, a2, a3), last)
                        else:
                            tl.atomic_add(row, a0, last, sem="relaxed")
                            tl.atomic_add(row + 1, a1, last, sem="relaxed")
                            tl.atomic_add(row + 2, a2, last, sem="relaxed")
                            tl.atomic_add(row + 3, a3, last, sem="relaxed")
                        if IMPLICIT:
                            a4 = _sum_segments(wz[k] * (w * resistance), lane, first)
                            tl.atomic_add(row + 4, a4, last, sem="relaxed")
        else:
            tl.store(part_node + index, node, mask)
            row = parts + index * PART
            for c in tl.static_range(4):
                tl.store(row + c, value[c], mask)
            for c in tl.static_range(3):
                for axis in tl.static_range(3):
                    tl.store(row + 4 + 4 * axis + c, moment[3 * c + axis], mask)
                    tl.store(row + 16 + 4 * axis + c, slope[3 * c + axis], mask)
            tl.store(row + 28, resistance, mask)
            tl.store(row + 29, fx, mask)
            tl.store(row + 30, fy, mask)
            tl.store(row + 31, fz, mask)
    else:
        store9(moving + 15 * count, count, index, C, mask)


@triton.jit(do_not_specialize=VARIES)
def updated_scatter(
    parts, part_node, windows, marks, count, spans, sx, sy, dx, inverse_dx,
    SHARES: tl.constexpr, SPAN: tl.constexpr, IMPLICIT: tl.constexpr, WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``, on a CPU: the sums of a share of the particles, in their order, on a grid of the share's own.

    A row of ``parts``: momentum and mass (4), three columns of the factor of w (x_i - x_p) and three of that of the
    gradient of w, each filled up to four; resistance, and the place of the particle in its cell (3). ``marks``
    (spans, SHARES) become 1 where a share adds to one of the SPAN nodes of a span, which are then set to zero before.
    """
    share = tl.program_id(0)
    begin = share * count // SHARES
    end = (share + 1) * count // SHARES
    lane = tl.arange(0, BLOCK)
    window = windows + share.to(tl.int64) * spans * SPAN * WIDTH
    column = tl.arange(0, 4)
    before = -1
    for p in range(begin, end):
        node = tl.load(part_node + p)
        if node >= 0:
            if node != before:
                for i in range(3):
                    for j in range(3):
                        for side in tl.static_range(2):
                            span = (node + i * sx + j * sy + 2 * side) // SPAN
                            if tl.load(marks + span * SHARES + share) == 0:
                                tl.store(marks + span * SHARES + share, 1)
                                for first in range(span * SPAN * WIDTH, (span + 1) * SPAN * WIDTH, BLOCK):
                                    tl.store(window + first + lane, tl.zeros([BLOCK], tl.float32))
            before = node
            row = parts + p * PART
            value = tl.load(row + column)
            m0 = tl.load(row + 4 + column)
            m1 = tl.load(row + 8 + column)
            m2 = tl.load(row + 12 + column)
            fx = tl.load(row + 29)
            fy = tl.load(row + 30)
            fz = tl.load(row + 31)
            wz, gz = axis_weights(fz, inverse_dx)
            s0 = tl.load(row + 16 + column)
            s1 = tl.load(row + 20 + column)
            s2 = tl.load(row + 24 + column)
            if IMPLICIT:
                resistance = tl.load(row + 28)
            for i in range(3):
                wx, gx = node_weight(fx, i, inverse_dx)
                for j in range(3):
                    wy, gy = node_weight(fy, j, inverse_dx)
                    w = wx * wy
                    c = w * (value + ((i - fx) * dx) * m0 + ((j - fy) * dx) * m1)
                    c += (gx * wy) * s0 + (wx * gy) * s1
                    for k in tl.static_range(3):
                        a = wz[k] * c + (wz[k] * w * ((k - fz) * dx)) * m2
                        a += (gz[k] * w) * s2
                        to = window + (node + i * sx + j * sy + k) * WIDTH
                        tl.store(to + column, tl.load(to + column) + a)
                        if IMPLICIT:
                            tl.store(to + 4, tl.load(to + 4) + wz[k] * w * resistance)


@triton.jit(do_not_specialize=VARIES)
def updated_join(
    windows, marks, occupied, momentum, nodes, spans,
    SHARES: tl.constexpr, SPAN: tl.constexpr, CHUNK: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """``updated``, on a CPU: the sums of all shares, in order, on the nodes of CHUNK spans.

    ``occupied`` (spans,) becomes 1 where there are any; ``marks`` are set back to zero.
    """
    first = tl.program_id(0) * CHUNK
    lane = tl.arange(0, SPAN * WIDTH)
    every = tl.arange(0, SHARES)
    for span in range(first, tl.minimum(first + CHUNK, spans)):
        own = marks + span * SHARES
        some = tl.max(tl.load(own + every))
        tl.store(occupied + span, some)
        if some > 0:
            at = span * SPAN * WIDTH + lane
            total = tl.zeros([SPAN * WIDTH], tl.float32)
            for share in range(0, SHARES):
                if tl.load(own + share) > 0:
                    total += tl.load(windows + share.to(tl.int64) * spans * SPAN * WIDTH + at)
            tl.store(momentum + at, total, at < nodes * WIDTH)
            tl.store(own + every, tl.zeros([SHARES], tl.int8))


@triton.jit
def _stop(
    v, x, k, mask, step, windows, numbers, rows, marks, room,
    SOLIDS: tl.constexpr, w: tl.constexpr, KINDS: tl.constexpr,
):  # fmt: skip
    """Velocity of nodes k at x held by solid w, or by pin -1 - w; which nodes it holds, and its time window."""
    if w < 0:
        held = (v[0] * 0, v[0] * 0, v[0] * 0)
        behind = tl.load(marks + (-1 - w) * room + k, mask, 0) == step + 1
        window = windows + 2 * (len(SOLIDS.functions) - 1 - w)
    else:
        held, behind = stop_nodes(v, x, numbers, rows, step, mask, SOLIDS, w, KINDS[w])
        window = windows + 2 * w
    return held, behind, window


@triton.jit(do_not_specialize=VARIES)
def updated_nodes(
    momentum, velocity, inverse_mass, occupied, nodes, schedule, first_step, step_offset,
    gravity_x, gravity_y, gravity_z, windows, numbers, rows, clock, impulse, slots, marks, room,
    ox, oy, oz, ny, nz, scene_nodes, dx,
    IMPLICIT: tl.constexpr, WIDTH: tl.constexpr, KEEP: tl.constexpr, TURNS: tl.constexpr, BOUNDARIES: tl.constexpr,
    SOLIDS: tl.constexpr, KINDS: tl.constexpr, SCENES: tl.constexpr, SPARSE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: nodal velocities from momenta and masses, set back to zero unless SPARSE; KEEP for boundaries.

    All TURNS are applied here, in order: each is the number of a boundary, and that of one of the SOLIDS (see
    :mod:`~gaussian_swaying.mpm.colliders`), or -1 less that of a pin. KINDS says of each solid how it stops. ``marks``
    (pins, room) is the last substep in which each pin held a node, counted from 1. ``clock`` has the time at step 0 and
    the substep [s], float64; ``impulse`` (programs, slots, B, 3), float64, collects the reaction impulses on nodes of
    the first scene of a program, and of those after it. With SPARSE the velocities of programs that are not
    ``occupied`` stay as they are: no particle is near.
    """
    if SPARSE:  # noqa: SIM102  (Triton leaves out what is under a constant that is false)
        if tl.load(occupied + tl.program_id(0)) == 0:
            return
    step = tl.load(first_step) + step_offset
    kick = tl.load(schedule + (step + 1) * 4)
    decay = tl.load(schedule + (step + 1) * 4 + 2)
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < nodes
    row = momentum + k * WIDTH
    mass = tl.load(row + 3, mask, 0.0)
    some = mass > 1.0842022e-19  # the square root of the smallest normal number, as in the reference
    inverse = tl.where(some, 1.0 / tl.maximum(mass, 1.0842022e-19), 0.0)
    push = tl.where(some, kick, 0.0)
    share = inverse
    if IMPLICIT:
        yielding = 1.0 / (1 + kick * tl.load(row + 4, mask, 0.0) * inverse)
        push = push * yielding
        share = inverse * yielding
    v = scale3(decay, axpy3(share, vector(row, mask), push, (gravity_x, gravity_y, gravity_z)))
    if len(TURNS) > 0:
        now = tl.load(clock) + step * tl.load(clock + 1)
        own = k
        if SCENES:
            own = k % scene_nodes
        x = (
            (own // (ny * nz) + ox).to(tl.float32) * dx,
            (own // nz % ny + oy).to(tl.float32) * dx,
            (own % nz + oz).to(tl.float32) * dx,
        )
        for n in tl.static_range(len(TURNS)):
            held, behind, window = _stop(
                v, x, k, some & mask, step, windows, numbers, rows, marks, room,
                SOLIDS, TURNS[n][1], KINDS,
            )  # fmt: skip
            hit = tl.where(acts(window, now), behind & some & mask, False)
            u = where3(hit, held, v)
            if tl.sum(hit.to(tl.int32)) > 0:  # few blocks touch a solid
                first = tl.program_id(0) * BLOCK // scene_nodes
                last = first
                if SCENES:
                    last = tl.minimum((tl.program_id(0) + 1) * BLOCK, nodes) // scene_nodes
                for scene in range(first, last + 1):
                    to = impulse + 3 * ((tl.program_id(0) * slots + scene - first) * BOUNDARIES + TURNS[n][0])
                    there = hit
                    if SCENES:
                        there = hit & (k // scene_nodes == scene)
                    for c in tl.static_range(3):
                        taken = tl.where(there, (mass * (v[c] - u[c])).to(tl.float64), 0.0)
                        tl.store(to + c, tl.load(to + c) + tl.sum(taken))
            v = u
    store3(velocity, 1, k * 4, v, mask)
    if KEEP:
        tl.store(inverse_mass + k, inverse, mask)
    if not SPARSE:
        zero = mass * 0
        used = mask & (mass != 0)
        for c in tl.static_range(WIDTH):
            tl.store(row + c, zero, used)


@triton.jit(do_not_specialize=VARIES)
def updated_pin(
    moving, order, pinned, marks, count, ox, oy, oz, nx, ny, nz, dx, scene_size, first_step, step_offset,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: write the number of the substep, counted from 1, to the nodes of the particles that a pin holds."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    where = tl.load(order + index, mask, 0)
    held = mask & (tl.load(pinned + where, mask, 0) > 0)
    if tl.sum(held.to(tl.int32)) > 0:
        x = load3(moving, count, index, held)
        node, fx, fy, fz, inside = _stencil(x, held, where // scene_size, ox, oy, oz, nx, ny, nz, dx)
        number = tl.zeros([BLOCK], tl.int32) + tl.load(first_step) + step_offset + 1
        wz, _gz = axis_weights(fz, 1.0)
        for i in range(3):
            wx, _gx = node_weight(fx, i, 1.0)
            for j in range(3):
                wy, _gy = node_weight(fy, j, 1.0)
                to = marks + node + (i * ny + j) * nz
                for k in tl.static_range(3):
                    tl.store(to + k, number, inside & (wx * wy * wz[k] > 0))


@triton.jit(do_not_specialize=VARIES)
def updated_load(
    order, position, velocity, affine, F_elastic, F_total, lost, internal, constants, moving, count,
    PLASTIC: tl.constexpr, INTERNAL: tl.constexpr, VALUES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: copy particle fields and ``constants`` (P, 5 + VALUES) to the rows of ``moving``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    where = tl.load(order + index, mask, 0)
    store3(moving, count, index, load3(position, 1, where * 3, mask), mask)
    store9(moving + 3 * count, count, index, load9(F_elastic, 1, where * 9, mask), mask)
    store3(moving + 12 * count, count, index, load3(velocity, 1, where * 3, mask), mask)
    store9(moving + 15 * count, count, index, load9(affine, 1, where * 9, mask), mask)
    tl.store(moving + 24 * count + index, tl.load(lost + where, mask, 0).to(tl.float32), mask)
    if INTERNAL:
        tl.store(moving + 25 * count + index, tl.load(internal + where, mask, 0.0), mask)
    first = constants + where * (5 + VALUES)
    for row in tl.static_range(5):
        tl.store(moving + (26 + row) * count + index, tl.load(first + row, mask, 0.0), mask)
    for row in tl.static_range(VALUES):
        to = moving + ((40 if PLASTIC else 31) + row) * count
        tl.store(to + index, tl.load(first + 5 + row, mask, 0.0), mask)
    if PLASTIC:
        store9(moving + 31 * count, count, index, load9(F_total, 1, where * 9, mask), mask)


@triton.jit(do_not_specialize=VARIES)
def updated_count(
    moving, order, count, ox, oy, oz, nx, ny, nz, dx, scene_size, filled, cell, rank, BLOCK: tl.constexpr
):  # fmt: skip
    """``updated``: the cell of each particle and its rank in it; ``filled`` counts them."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    first = (tl.load(order + index, mask, 0) // scene_size) * (nx + 1)
    x = load3(moving, count, index, mask)
    key = first + _cell(x[0], dx, ox, nx)
    key = key * (ny + 1) + _cell(x[1], dx, oy, ny)
    key = key * (nz + 1) + _cell(x[2], dx, oz, nz)
    tl.store(cell + index, key, mask)
    tl.store(rank + index, tl.atomic_add(filled + key, 1, mask, sem="relaxed"), mask)


@triton.jit
def _cell(x, dx, o, n):
    first = tl.floor(tl.div_rn(x, dx + x * 0) - 0.5).to(tl.int32) - o
    return tl.minimum(tl.maximum(first, 0), n)


@triton.jit(do_not_specialize=VARIES)
def updated_sort(
    moving, order, work, count, cell, rank, ends, sorted_moving, sorted_order, sorted_work,
    ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: the rows of ``moving`` in the order of the cells, which end at ``ends``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    place = tl.load(ends + tl.load(cell + index, mask, 0), mask, 0) - 1 - tl.load(rank + index, mask, 0)
    tl.store(sorted_order + place, tl.load(order + index, mask, 0), mask)
    tl.store(sorted_work + place, tl.load(work + index, mask, 0.0), mask)
    for row in tl.static_range(ROWS):
        tl.store(sorted_moving + row * count + place, tl.load(moving + row * count + index, mask, 0.0), mask)


@triton.jit(do_not_specialize=VARIES)
def updated_read(
    order, moving, count, position, velocity, affine, F_elastic, F_total, lost, internal,
    PLASTIC: tl.constexpr, INTERNAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``updated``: the rows of ``moving`` back to particle fields in the order in which they were given."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    where = tl.load(order + index, mask, 0)
    store3(position, 1, where * 3, load3(moving, count, index, mask), mask)
    store9(F_elastic, 1, where * 9, load9(moving + 3 * count, count, index, mask), mask)
    store3(velocity, 1, where * 3, load3(moving + 12 * count, count, index, mask), mask)
    store9(affine, 1, where * 9, load9(moving + 15 * count, count, index, mask), mask)
    tl.store(lost + where, tl.load(moving + 24 * count + index, mask, 0.0) != 0, mask)
    if INTERNAL:
        tl.store(internal + where, tl.load(moving + 25 * count + index, mask, 0.0), mask)
    if PLASTIC:
        store9(F_total, 1, where * 9, load9(moving + 31 * count, count, index, mask), mask)


@triton.jit(do_not_specialize=VARIES)
def pin_mass(moving, order, pinned, weight, count, ox, oy, oz, nx, ny, nz, dx, scene_size, BLOCK: tl.constexpr):
    """``updated``: mass of the particles of a boundary at each node; one program alone adds in a fixed order."""
    for begin in range(tl.program_id(0) * BLOCK, count, tl.num_programs(0) * BLOCK):
        index = begin + tl.arange(0, BLOCK)
        mask = index < count
        where = tl.load(order + index, mask, 0)
        mass = tl.load(pinned + where, mask, 0.0)
        mask = mask & (mass > 0)
        x = load3(moving, count, index, mask)
        node, fx, fy, fz, inside = _stencil(x, mask, where // scene_size, ox, oy, oz, nx, ny, nz, dx)
        wz, _gz = axis_weights(fz, 1.0)
        for i in range(3):
            wx, _gx = node_weight(fx, i, 1.0)
            for j in range(3):
                wy, _gy = node_weight(fy, j, 1.0)
                row = weight + node + (i * ny + j) * nz
                for k in tl.static_range(3):
                    tl.atomic_add(row + k, mass * (wx * wy * wz[k]), inside, sem="relaxed")


@triton.jit(do_not_specialize=VARIES)
def updated_look(moving, count, out, WAVE: tl.constexpr, BLOCK: tl.constexpr):
    """``updated``: as ``largest_speed``, from the rows of ``moving``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    F = load9(moving + 3 * count, count, index, mask)
    mu = tl.load(moving + 28 * count + index, mask, 0.0)
    lam = tl.load(moving + 29 * count + index, mask, 0.0)
    density = tl.load(moving + 26 * count + index, mask, 1.0) / tl.load(moving + 27 * count + index, mask, 1.0)
    v = load3(moving + 12 * count, count, index, mask)
    speed = wave_speed(F, density, mu, lam, WAVE, True) + tl.sqrt(dot3(v, v))
    keep_largest(out, speed, mask)
