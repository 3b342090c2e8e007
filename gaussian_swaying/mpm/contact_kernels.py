"""Kernels of contact; :mod:`~gaussian_swaying.mpm.contact` has the equations.

One launch does a whole substep: its programs run all at once and wait for each other between the parts (:func:`meet`),
so that the number of iterations is not fixed when it is recorded. Each contact sample has its own constraints, so a
pair is kept at both of its samples; the sums at samples and nodes have the same order in every run. Between substeps
``contact_lists`` lists the samples that may touch in the next ones.
"""

from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    cofactor,
    dot3,
    load3,
    matvec,
    plus_identity,
    scale3,
    store3,
    transpose,
    where3,
)
from gaussian_swaying.kernels.language import ON_GPU, tl, triton
from gaussian_swaying.mpm.colliders import acts, touch
from gaussian_swaying.mpm.shared_kernels import VARIES, axis_weights, node_weight, vector

CHANGES = (*VARIES, "places", "touched_nodes", "active_nodes", "last", "iterations")

MOST_PROGRAMS = tl.constexpr(1024 if ON_GPU else 8)
"""Most programs that meet; a row of ``peak`` has as many entries."""

LISTED, NEEDED_ROOM, NEEDED_SLOTS, ROUNDS, ACTING, WITHIN = (tl.constexpr(k) for k in range(6))
"""Entries of ``status``: candidates of all samples; room that is needed for the candidates of a sample, and for its
constraints; iterations of all substeps; constraints of this substep; whether an obstacle is within reach in it."""


@triton.jit
def meet(gate, programs):
    """Barrier: wait until all programs arrive, and make their writes visible.

    Each adds one and the first one adds what is missing to 2^31, so that the sign changes when all have come.
    """
    tl.debug_barrier()
    if programs > 1:
        mine = tl.where(tl.program_id(0) == 0, 2147483647 - (programs - 2), 1)
        before = tl.atomic_add(gate, mine, sem="release", scope="gpu")
        now = before
        while (before ^ now) >= 0:
            now = tl.atomic_add(gate, 0, sem="acquire", scope="gpu")
        tl.debug_barrier()


@triton.jit
def largest_of(peak, programs):
    """The largest of the entries that the programs wrote."""
    o = tl.arange(0, MOST_PROGRAMS)
    return tl.max(tl.load(peak + o, o < programs, 0.0))


@triton.jit
def node_at(base, node, p, mask, places, i, j, k, sx, sy, VIRTUAL: tl.constexpr):
    """One of the 27 nodes of samples, whose first node on the lattice is ``node``."""
    if VIRTUAL:
        found = tl.load(base + ((i * 3 + j) * 3 + k) * places + p, mask, 0)
    else:
        found = node + i * sx + j * sy + k
    return found


@triton.jit
def interpolate(
    field, base, fraction, arm, places, p, mask, sx, sy, inverse_dx, DERIVATIVES: tl.constexpr, BOTH: tl.constexpr,
    ARMS: tl.constexpr, VIRTUAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Four columns of the nodes at samples, of shape (BLOCK, 4), with BOTH also the next four; with ARMS at their ends.

    Then the derivatives of the first four along the axes [1/m], of the same shape, zero without DERIVATIVES. As
    ``total_kernels.gather``, but a row of four columns is one load. ``base`` is the first node of each sample, or
    with VIRTUAL the table of their nodes, shape (27, places).
    """
    column = tl.arange(0, 4)[None, :]
    f = load3(fraction, places, p, mask)
    a = f
    if ARMS:
        a = load3(arm, places, p, mask)
    node = tl.load(base + p, mask, 0)
    wz, gz = axis_weights(f[2], inverse_dx)
    value = tl.zeros([BLOCK, 4], tl.float32)
    following, d0, d1, d2 = value, value, value, value
    for i in range(3):
        wx, gx = node_weight(f[0], i, inverse_dx)
        for j in tl.static_range(3):
            wy, gy = node_weight(f[1], j, inverse_dx)
            s = tl.zeros([BLOCK, 4], tl.float32)
            t, m, n = s, s, s
            for k in tl.static_range(3):
                at = field + node_at(base, node, p, mask, places, i, j, k, sx, sy, VIRTUAL)[:, None] * 8 + column
                q = tl.load(at, mask[:, None], 0.0)
                s += wz[k][:, None] * q
                if DERIVATIVES or ARMS:
                    t += gz[k][:, None] * q
                if BOTH:
                    q = tl.load(at + 4, mask[:, None], 0.0)
                    m += wz[k][:, None] * q
                    if ARMS:
                        n += gz[k][:, None] * q
            w = wx * wy
            e = w
            if ARMS:
                e += gx * wy * a[0] + wx * gy * a[1]
                value += (w * a[2])[:, None] * t
                following += (w * a[2])[:, None] * n
            value += e[:, None] * s
            following += e[:, None] * m
            if DERIVATIVES:
                d0 += (gx * wy)[:, None] * s
                d1 += (wx * gy)[:, None] * s
                d2 += w[:, None] * t
    return value, following, d0, d1, d2


@triton.jit
def three(x):
    """The first three columns of a tile of four."""
    column = tl.arange(0, 4)[None, :]
    found = ()
    for k in tl.static_range(3):
        found = found + (tl.sum(tl.where(column == k, x, 0.0), 1),)
    return found


@triton.jit
def store_velocity(moving, p, mask, v):
    """Write the velocities of samples, the first three columns of a tile."""
    column = tl.arange(0, 4)[None, :]
    tl.store(moving + p[:, None] * 4 + column, v, mask[:, None] & (column < 3))


@triton.jit
def place_now(
    fields, base, fraction, arm, rest, places, p, mask, sx, sy, inverse_dx, DERIVATIVES: tl.constexpr,
    BOTH: tl.constexpr, ARMS: tl.constexpr, VIRTUAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Return the positions of contact samples now, with BOTH their velocities, and the slopes of the displacement."""
    u, v, d0, d1, d2 = interpolate(
        fields, base, fraction, arm, places, p, mask, sx, sy, inverse_dx, DERIVATIVES, BOTH, ARMS, VIRTUAL, BLOCK
    )
    return add3(load3(rest, places, p, mask), 1.0, three(u)), v, d0, d1, d2


@triton.jit
def velocity_now(
    fields, base, fraction, arm, moving, places, p, mask, sx, sy, inverse_dx, ARMS: tl.constexpr,
    VIRTUAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Read the velocity of places."""
    v, _n, _a, _b, _c = interpolate(
        fields + 4, base, fraction, arm, places, p, mask, sx, sy, inverse_dx, False, False, ARMS, VIRTUAL, BLOCK
    )
    store_velocity(moving, p, mask, v)


@triton.jit(do_not_specialize=CHANGES)
def contact_positions(
    fields, base, fraction, arm, rest, places, position, moving, status, sx, sy, inverse_dx, ARMS: tl.constexpr,
    VIRTUAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write positions (C, 3) and velocities of all contact samples; reset the flag that something is in reach."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = p < places
    x, v, _a, _b, _c = place_now(
        fields, base, fraction, arm, rest, places, p, mask, sx, sy, inverse_dx, False, True, ARMS, VIRTUAL, BLOCK
    )
    store3(position, 1, p * 3, x, mask)
    store_velocity(moving, p, mask, v)
    if tl.program_id(0) == 0:
        tl.store(status + ACTING, 0)
        tl.store(status + WITHIN, 0)


COLUMNS = tl.constexpr(1024)
"""Most cells of the grid along an axis; farther samples count to the last one."""


@triton.jit
def cell_of(x, low, inverse):
    """Cell numbers of places along an axis, from 1 on; NaN goes to the last one."""
    t = (x - low) * inverse
    return tl.where(t < COLUMNS - 3, t, COLUMNS - 3).to(tl.int32) + 1


@triton.jit
def column_of(cx, cy):
    """The number of a column of cells, exact in single precision."""
    return (cx * COLUMNS + cy).to(tl.float32)


@triton.jit
def hashed(cx, cy, last):
    """Entry of a column of cells."""
    return ((cx * 73856093) ^ (cy * 19349663)) & last


@triton.jit(do_not_specialize=CHANGES)
def contact_cells(
    fields, active, active_nodes, before, position, low, limit, cells, hashes, places, last, BLOCK: tl.constexpr
):
    """Write places with their hashed columns, sort keys, and the current node positions."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = p < active_nodes
    at = fields + tl.load(active + p, mask, 0) * 8
    store3(before, 1, p * 3, vector(at, mask), mask)
    mask = p < places
    inverse = 1 / tl.load(limit)
    x = vector(position + p * 3, mask)
    cx = cell_of(x[0], tl.load(low), inverse)
    cy = cell_of(x[1], tl.load(low + 1), inverse)
    store3(cells, places, p, x, mask)
    tl.store(cells + 3 * places + p, column_of(cx, cy), mask)
    tl.store(hashes + p, hashed(cx, cy, last) + cell_of(x[2], tl.load(low + 2), inverse), mask)


@triton.jit
def _squared(field, places, at, known, x):
    """Squared distances of several places from each x."""
    d = add3(load3(field, places, at, known), -1.0, (x[0][:, None], x[1][:, None], x[2][:, None]))
    return dot3(d, d)


@triton.jit(do_not_specialize=CHANGES)
def contact_lists(
    position, rest, base, corner, low, limit, start, order, ordered, candidates, near, many, impulse, status, places,
    room, apart, beside, last, VIRTUAL: tl.constexpr, BLOCK: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """For each sample, list those closer than ``limit`` now and farther than ``apart`` at rest.

    ``start`` is where the samples of a cell begin in their ``order``, in a table of hashed columns of cells: the three
    cells of a column around a sample follow each other. Another column may have the same entry. With VIRTUAL also those
    that were at least ``beside`` from it, and have another copy of a node that both reach. Nothing acts on them.
    """
    wide = tl.arange(0, WIDE)[None, :]
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = p < places
    x = vector(position + p * 3, mask)
    r = load3(rest, places, p, mask)
    size = tl.load(limit)
    inverse = 1 / size
    x_cell = cell_of(x[0], tl.load(low), inverse)
    y_cell = cell_of(x[1], tl.load(low + 1), inverse)
    z_cell = cell_of(x[2], tl.load(low + 2), inverse)
    found = tl.zeros([BLOCK], tl.int32)
    for beside_it in range(9):
        cx = x_cell + (beside_it // 3 - 1)
        cy = y_cell + (beside_it % 3 - 1)
        at = start + hashed(cx, cy, last) + z_cell
        begin = tl.load(at - 1, mask, 0)
        length = tl.load(at + 2, mask, 0) - begin
        for k in range(0, tl.max(length), WIDE):
            known = (k + wide) < length[:, None]
            e = begin[:, None] + k + wide
            known = known & (tl.load(ordered + 3 * places + e, known, 0.0) == column_of(cx, cy)[:, None])
            known = known & (_squared(ordered, places, e, known, x) < size * size)
            q = tl.load(order + e, known, 0)
            square = _squared(rest, places, q, known, r)
            far = square >= apart * apart
            if VIRTUAL:
                c0 = tl.load(corner + q, known, 0) - tl.load(corner + p, mask, 0)[:, None]
                c1 = tl.load(corner + places + q, known, 0) - tl.load(corner + places + p, mask, 0)[:, None]
                c2 = tl.load(corner + 2 * places + q, known, 0) - tl.load(corner + 2 * places + p, mask, 0)[:, None]
                both = known & (c0 >= -2) & (c0 <= 2) & (c1 >= -2) & (c1 <= 2) & (c2 >= -2) & (c2 <= 2)
                one = (tl.maximum(c0, 0) * 3 + tl.maximum(c1, 0)) * 3 + tl.maximum(c2, 0)
                other = (tl.maximum(-c0, 0) * 3 + tl.maximum(-c1, 0)) * 3 + tl.maximum(-c2, 0)
                mine = tl.load(base + one * places + p[:, None], both, 0)
                theirs = tl.load(base + other * places + q, both, 1)
                far = far | ((square >= beside * beside) & (mine != theirs))
            known = known & (q != p[:, None]) & far
            hit = known.to(tl.int32)
            to = found[:, None] + tl.cumsum(hit, 1) - hit
            tl.store(candidates + p[:, None] * room + to, q, known & (to < room))
            found += tl.sum(hit, 1)
    tl.store(near + p, tl.minimum(found, room), mask)
    tl.store(many + p, tl.zeros([BLOCK], tl.int32), mask)
    for c in tl.static_range(8):
        tl.store(impulse + p * 8 + c, tl.zeros([BLOCK], tl.float32), mask)
    found = tl.where(mask, found, 0)
    tl.atomic_add(status + LISTED, tl.sum(found), sem="relaxed")
    tl.atomic_max(status + NEEDED_ROOM, tl.max(found), sem="relaxed")


PLANES = tl.constexpr(10)
"""Numbers of a constraint: normal, wanted velocity, and its impulse with and without the momentum of the iteration."""

KEPT = tl.constexpr(0.99)
"""Share of sticking friction that stays in an iteration; the rest is CREEP: the share of the free slip of a substep
that a single contact sample keeps."""


@triton.jit
def _place(
    fields, base, fraction, arm, rest, facing, radius, thickness, places, row, moving, p, mask, sx, sy, inverse_dx,
    BOTH: tl.constexpr, ARMS: tl.constexpr, VIRTUAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    x, v, d0, d1, d2 = place_now(
        fields, base, fraction, arm, rest, places, p, mask, sx, sy, inverse_dx, True, BOTH, ARMS, VIRTUAL, BLOCK
    )
    if BOTH:
        store_velocity(moving, p, mask, v)
    a = three(d0)
    b = three(d1)
    c = three(d2)
    n = matvec(transpose(cofactor(plus_identity(a + b + c))), load3(facing, places, p, mask))
    length = tl.maximum(tl.sqrt(dot3(n, n)), 1e-12)
    to = row + p * 8
    store3(to, 1, 0, x, mask)
    tl.store(to + 3, tl.load(thickness + p, mask, 0.0), mask)
    store3(to + 4, 1, 0, (n[0] / length, n[1] / length, n[2] / length), mask)
    tl.store(to + 7, tl.load(radius + p, mask, 0.0), mask)


@triton.jit
def discs(d, a, ra, b, rb):
    """Normal between two discs, and whether one lies above the other: with normals a and b, d from b to a."""
    squared = dot3(d, d)
    p = dot3(d, a)
    q = dot3(d, b)
    over = squared - p * p < ra * ra
    also = squared - q * q < rb * rb
    p = tl.where(over, p, 0.0)
    q = tl.where(also, q, 0.0)
    n = axpy3(p, a, q, b)
    size = tl.sqrt(tl.maximum(dot3(n, n), 1.2e-38))
    n = where3(size > 1.1e-19, (n[0] / size, n[1] / size, n[2] / size), b)
    return n, over | also


@triton.jit
def _keep(data, other, slots, places, p, many, acts, q, n, target):
    at = many * places + p
    acts = acts & (many < slots)
    tl.store(other + at, q, acts)
    plane = slots * places
    store3(data, plane, at, n, acts)
    tl.store(data + 3 * plane + at, target, acts)
    return many + acts.to(tl.int32)


@triton.jit
def _target(gap, push, most, dt):
    return tl.where(gap > 0, -gap, tl.minimum(-gap * push, most)) / dt


@triton.jit
def _constrain_pairs(
    row, moving, candidates, near, room, data, other, slots, places, p, mask, dt, limit, slack, push, most,
    BLOCK: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Write the constraints of pairs of samples that come close in this substep, as the discs say (``mpm.contact``).

    Returns how many there are for each sample, and how many slots it needed.
    """
    length = tl.load(near + p, mask, 0)
    wide = tl.arange(0, WIDE)[None, :]
    x = vector(row + p * 8, mask)
    close = tl.zeros([BLOCK], tl.int32)
    for k in range(0, tl.max(length), WIDE):  # first those that are close
        known = (k + wide) < length[:, None]
        q = tl.load(candidates + p[:, None] * room + k + wide, known, 0)
        known = known & (_squared(row, 1, q * 8, known, x) < limit * limit)
        hit = known.to(tl.int32)
        slot = close[:, None] + tl.cumsum(hit, 1) - hit
        tl.store(other + slot * places + p[:, None], q, known & (slot < slots))
        close += tl.sum(hit, 1)
    tl.debug_barrier()  # another thread of this program may have written what is read next
    many = tl.zeros([BLOCK], tl.int32)
    for s in range(0, tl.max(tl.minimum(close, slots))):
        real = (s < close) & mask
        q = tl.load(other + s * places + p, real, 0)
        # in the order of their numbers, so that both samples of a pair find the same, to the last bit
        low = row + tl.minimum(p, q) * 8
        high = row + tl.maximum(p, q) * 8
        d = add3(vector(low, real), -1.0, vector(high, real))
        a = vector(low + 4, real)
        b = vector(high + 4, real)
        n, above = discs(d, a, tl.load(low + 7, real, 0.0), b, tl.load(high + 7, real, 0.0))
        keep = 0.5 * (tl.load(low + 3, real, 0.0) + tl.load(high + 3, real, 0.0))
        gap = dot3(d, n) - keep
        low = moving + tl.minimum(p, q) * 4
        high = moving + tl.maximum(p, q) * 4
        along = dot3(add3(vector(low, real), -1.0, vector(high, real)), n)
        acts = real & above & (tl.minimum(gap, gap + dt * along) < slack)
        many = _keep(data, other, slots, places, p, many, acts, q, n, _target(gap, push, most, dt))
    return many, close


@triton.jit
def _constrain_walls(
    moving, wall_gap, wall_normal, wall_drive, wall_valid, pressed, data, other, slots, places, p, mask, many, dt,
    slack, push, most, WALLS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the constraints of samples close to an obstacle k in this substep; -1 - k stands for the other sample."""
    for wall in range(WALLS):
        at = wall * places + p
        n = vector(wall_normal + at * 3, mask)
        along = dot3(add3(vector(moving + p * 4, mask), -1.0, vector(wall_drive + at * 3, mask)), n)
        gap = tl.load(wall_gap + at, mask, 0.0)
        acts = mask & (tl.load(wall_valid + at, mask, 0.0) > 0) & (tl.minimum(gap, gap + dt * along) < slack)
        number = tl.full([BLOCK], -1, tl.int32) - wall
        many = _keep(data, other, slots, places, p, many, acts, number, n, _target(gap, push, most, dt))
        zero = tl.zeros([BLOCK], tl.float32)
        store3(pressed, 1, at * 3, (zero, zero, zero), mask)
    return many


@triton.jit
def _mark_nodes(base, marked, places, p, mask, sx, sy, VIRTUAL: tl.constexpr):
    one = tl.full(p.shape, 1, tl.int32)
    node = tl.load(base + p, mask, 0)
    for i in range(3):
        for j in range(3):
            for k in tl.static_range(3):
                tl.store(marked + node_at(base, node, p, mask, places, i, j, k, sx, sy, VIRTUAL), one, mask)


@triton.jit
def _mobility(
    base, fraction, arm, total, moving, places, p, mask, sx, sy, inverse_dx, ARMS: tl.constexpr, VIRTUAL: tl.constexpr
):
    f = load3(fraction, places, p, mask)
    node = tl.load(base + p, mask, 0)
    wz, gz = axis_weights(f[2], inverse_dx)
    a = (f[0] * 0, f[0] * 0, f[0] * 0)
    if ARMS:
        a = load3(arm, places, p, mask)
    found = f[0] * 0
    for i in range(3):
        wx, gx = node_weight(f[0], i, inverse_dx)
        for j in tl.static_range(3):
            wy, gy = node_weight(f[1], j, inverse_dx)
            w = wx * wy
            g = gx * wy * a[0] + wx * gy * a[1]
            for k in tl.static_range(3):
                at = total + node_at(base, node, p, mask, places, i, j, k, sx, sy, VIRTUAL)
                found += tl.abs((w + g) * wz[k] + w * gz[k] * a[2]) * tl.load(at, mask, 0.0)
    tl.store(moving + p * 4 + 3, found, mask)


@triton.jit
def _impulses(
    moving, many, other, data, slots, impulse, wall_drive, wall_friction, pressed, places, p, mask, count, momentum,
    friction, later, final,
    WALLS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One iteration: the impulses of the constraints of each sample, and their change summed there.

    It also sums the change that applies if the iterations end here: from the point extrapolated by the momentum back to
    the last iterate.

    Returns the largest violation of each sample's constraints as a velocity, and its part of the sum whose sign tells
    whether to restart the momentum.
    """
    plane = slots * places
    v = vector(moving + p * 4, mask)
    own = tl.load(moving + p * 4 + 3, mask, 0.0)
    zero = tl.zeros([BLOCK], tl.float32)
    nothing = (zero, zero, zero)
    d, e, worst, back = nothing, nothing, zero, zero
    for s in range(0, tl.max(count)):
        acts = s < count
        at = s * places + p
        q = tl.load(other + at, acts, 0)
        pair = acts & (q >= 0)
        to = moving + tl.maximum(q, 0) * 4
        sign = tl.where((q >= 0) & (p > q), -1.0, 1.0)
        n = load3(data, plane, at, acts)
        r = scale3(sign, add3(v, -1.0, vector(to, pair)))
        both = own + tl.load(to + 3, pair, 0.0)
        mu = friction
        if WALLS > 0:
            held = acts & (q < 0)
            wall = tl.where(held, -1 - q, 0)
            drive = wall_drive + (wall * places + p) * 3
            r = (
                r[0] - tl.load(drive, held, 0.0),
                r[1] - tl.load(drive + 1, held, 0.0),
                r[2] - tl.load(drive + 2, held, 0.0),
            )
            mu = tl.where(held, tl.load(wall_friction + wall, held, 0.0), friction)
        along = dot3(r, n)
        step = tl.where(both > 0, 1 / tl.where(both > 0, both, 1.0), 0.0)
        lacking = tl.where(acts, tl.load(data + 3 * plane + at, acts, 0.0) - along, 0.0)
        worst = tl.maximum(worst, lacking)
        y = load3(data + 4 * plane, plane, at, acts & later)
        o = load3(data + 7 * plane, plane, at, acts & later)
        ahead = dot3(y, n)
        press = tl.maximum(ahead + step * lacking, 0.0)
        t = axpy3(KEPT, add3(y, -ahead, n), -step, add3(r, -along, n))
        share = tl.minimum(mu * press / tl.sqrt(tl.maximum(dot3(t, t), 1.2e-38)), 1.0)
        t = axpy3(press, n, share, t)
        turned = dot3(add3(y, -1.0, t), add3(t, -1.0, o))
        back += tl.where(acts & (sign > 0), turned, 0.0)  # a pair once
        store3(data + 7 * plane, plane, at, t, acts)
        if WALLS > 0:
            store3(pressed, 1, (wall * places + p) * 3, where3(final, t, o), held)
        sign = tl.where(acts, sign, 0.0)
        e = add3(e, sign, add3(o, -1.0, y))
        t = add3(t, momentum, add3(t, -1.0, o))
        store3(data + 4 * plane, plane, at, t, acts)
        d = add3(d, sign, add3(t, -1.0, y))
    store3(impulse, 1, p * 8, d, mask)
    store3(impulse, 1, p * 8 + 4, e, mask)
    return worst, back


@triton.jit
def _count_nodes(
    entry_start, entry_place, entry_weight, marked, total, touched, nodes, many, programs, TALL: tl.constexpr,
):  # fmt: skip
    """Sum the weights of all constraints at each node: the most that unit impulses at them move it; zero without any.

    Nodes far from all constraints are not marked.
    """
    ENTRIES: tl.constexpr = 32 if TALL > 1 else 1  # at a time
    entry = tl.arange(0, ENTRIES)[None, :]
    for first in range(tl.program_id(0) * TALL, nodes, programs * TALL):
        n = first + tl.arange(0, TALL)
        mask = n < nodes
        begin = tl.load(entry_start + n, mask, 0)
        length = tl.load(entry_start + n + 1, mask, 0) - begin
        node = tl.load(touched + n, mask, 0)
        length = tl.where(tl.load(marked + node, mask, 0) > 0, length, 0)
        tl.debug_barrier()  # several threads have read it
        tl.store(marked + node, tl.zeros([TALL], tl.int32), mask)
        found = tl.zeros([TALL, ENTRIES], tl.float32)
        for k in range(0, tl.max(length), ENTRIES):
            real = (k + entry) < length[:, None]
            e = begin[:, None] + k + entry
            count = tl.load(many + tl.load(entry_place + e, real, 0), real, 0)
            found += tl.abs(tl.load(entry_weight + e, real, 0.0)) * count.to(tl.float32)
        tl.store(total + node, tl.sum(found, 1), mask)


@triton.jit
def _push_nodes(
    entry_start, entry_place, entry_weight, total, touched, nodes, impulse, fields, programs,
    TALL: tl.constexpr,
):  # fmt: skip
    ENTRIES: tl.constexpr = 32 if TALL > 1 else 1  # at a time
    entry = tl.arange(0, ENTRIES)[None, :]
    for first in range(tl.program_id(0) * TALL, nodes, programs * TALL):
        n = first + tl.arange(0, TALL)
        node = tl.load(touched + n, n < nodes, 0)
        mask = (n < nodes) & (tl.load(total + node, n < nodes, 0.0) > 0)
        begin = tl.load(entry_start + n, mask, 0)
        length = tl.load(entry_start + n + 1, mask, 0) - begin
        found = tl.zeros([TALL, ENTRIES, 4], tl.float32)
        for k in range(0, tl.max(length), ENTRIES):
            real = (k + entry) < length[:, None]
            e = begin[:, None] + k + entry
            at = impulse + tl.load(entry_place + e, real, 0) * 8
            w = tl.load(entry_weight + e, real, 0.0)
            found += w[:, :, None] * tl.load(at[:, :, None] + tl.arange(0, 4)[None, None, :], real[:, :, None], 0.0)
        to = fields + node[:, None] * 8 + 4 + tl.arange(0, 4)[None, :]
        tl.store(to, tl.load(to, mask[:, None], 0.0) + tl.sum(found, 1), mask[:, None])


@triton.jit(do_not_specialize=CHANGES)
def contact_solve(
    fields, base, fraction, arm, rest, facing, radius, thickness, places, candidates, near, room,
    wall_gap, wall_normal, wall_drive, wall_valid, wall_friction, pressed,
    pressed_sum, row, moving, many, other, data, slots, impulse,
    touched, entry_start, entry_place, entry_weight, marked, total, touched_nodes,
    active, carries, before, active_nodes, motion, peak, gate, status,
    schedule, first_step, step_offset, sx, sy, inverse_dx, reach, slack, push, most, tolerance, friction,
    iterations,
    PAIRS: tl.constexpr, WALLS: tl.constexpr, ARMS: tl.constexpr, VIRTUAL: tl.constexpr, BLOCK: tl.constexpr,
    WIDE: tl.constexpr, TALL: tl.constexpr,
):  # fmt: skip
    """The impulses of a substep, added to the velocities of the nodes.

    Nothing is done if no pairs are listed and no obstacle is within reach. ``contact_positions`` has read the
    velocities if there are obstacles. The reaction impulse on them is added to ``pressed_sum``, float64.

    Samples that come close in this substep must be listed. No sample moves farther than the largest motion of a node
    times its entry of ``carries``, so lists of samples closer than the reach of a contact, ``slack`` and a margin are
    complete while twice that, with the motion of this substep, is less than the margin: ``motion`` is the most of it.
    """
    pid = tl.program_id(0)
    programs = tl.num_programs(0)
    lane = tl.arange(0, BLOCK)
    dt = tl.load(schedule + (tl.load(first_step) + step_offset + 1) * 4 + 1)
    listed = 0
    limit = reach + slack
    if WALLS > 0:
        listed = tl.load(status + WITHIN)
    if PAIRS:
        listed += tl.load(status + LISTED)
        moved = tl.zeros([BLOCK], tl.float32)
        fast = tl.zeros([BLOCK], tl.float32)
        for first in range(pid * BLOCK, active_nodes, programs * BLOCK):
            n = first + lane
            mask = n < active_nodes
            at = fields + tl.load(active + n, mask, 0) * 8
            moved_by = add3(vector(at, mask), -1.0, vector(before + n * 3, mask))
            v = vector(at + 4, mask)
            share = tl.load(carries + n, mask, 0.0)
            speed = share * dt * tl.sqrt(dot3(v, v))
            moved = tl.maximum(moved, share * tl.sqrt(dot3(moved_by, moved_by)) + speed)
            fast = tl.maximum(fast, speed)
        tl.store(peak + pid, tl.max(moved))
        tl.store(peak + MOST_PROGRAMS + pid, tl.max(fast))
        meet(gate, programs)
        limit += 2 * largest_of(peak + MOST_PROGRAMS, programs)
        if pid == 0:
            tl.store(motion, tl.maximum(tl.load(motion), 2 * largest_of(peak, programs)))
    if listed > 0:
        if PAIRS:
            if pid == 0:
                tl.store(status + ACTING, 0)
            for first in range(pid * BLOCK, places, programs * BLOCK):
                p = first + lane
                mask = p < places
                if tl.max(tl.load(near + p, mask, 0)) > 0:
                    _place(
                        fields, base, fraction, arm, rest, facing, radius, thickness, places, row, moving, p, mask, sx,
                        sy, inverse_dx, WALLS == 0, ARMS, VIRTUAL, BLOCK,
                    )  # fmt: skip
            meet(gate, programs)
        for first in range(pid * BLOCK, places, programs * BLOCK):
            p = first + lane
            mask = p < places
            some = 1
            if WALLS == 0:
                some = tl.max(tl.load(near + p, mask, 0))
            if some > 0:
                count = tl.zeros([BLOCK], tl.int32)
                needed = tl.zeros([BLOCK], tl.int32)
                if PAIRS:
                    count, needed = _constrain_pairs(
                        row, moving, candidates, near, room, data, other, slots, places, p, mask, dt, limit, slack,
                        push, most, BLOCK, WIDE,
                    )  # fmt: skip
                if WALLS > 0:
                    count = _constrain_walls(
                        moving, wall_gap, wall_normal, wall_drive, wall_valid, pressed, data, other, slots, places, p,
                        mask, count, dt, slack, push, most, WALLS, BLOCK,
                    )  # fmt: skip
                if tl.max(count) > 0:
                    _mark_nodes(base, marked, places, p, mask & (count > 0), sx, sy, VIRTUAL)
                tl.store(many + p, count, mask)
                for c in tl.static_range(8):
                    tl.store(impulse + p * 8 + c, tl.zeros([BLOCK], tl.float32), mask)
                tl.atomic_add(status + ACTING, tl.sum(count), sem="relaxed")
                tl.atomic_max(status + NEEDED_SLOTS, tl.max(needed) + WALLS, sem="relaxed")
        meet(gate, programs)
        if tl.load(status + ACTING) > 0:
            _count_nodes(
                entry_start, entry_place, entry_weight, marked, total, touched, touched_nodes, many, programs, TALL
            )
            meet(gate, programs)
            for first in range(pid * BLOCK, places, programs * BLOCK):
                p = first + lane
                mask = p < places
                mask = mask & (tl.load(many + p, mask, 0) > 0)
                if tl.max(mask.to(tl.int32)) > 0:
                    _mobility(base, fraction, arm, total, moving, places, p, mask, sx, sy, inverse_dx, ARMS, VIRTUAL)
            meet(gate, programs)
            k = 0
            going = 1
            theta = dt * 0 + 1.0
            wrong = 0
            jumped = 0
            while going > 0:
                last = k + 1 >= iterations
                following = 0.5 * (1 + tl.sqrt(1 + 4 * theta * theta))
                momentum = tl.where(wrong > 0, 0.0, (theta - 1) / following)
                momentum = tl.where(last, 0.0, momentum)
                theta = tl.where(wrong > 0, 1.0, following)
                worst = tl.zeros([BLOCK], tl.float32)
                back = tl.zeros([BLOCK], tl.float32)
                for first in range(pid * BLOCK, places, programs * BLOCK):
                    p = first + lane
                    mask = p < places
                    count = tl.load(many + p, mask, 0)
                    if tl.max(count) > 0:
                        lacking, turned = _impulses(
                            moving, many, other, data, slots, impulse, wall_drive, wall_friction, pressed, places, p,
                            mask, count, momentum, friction, k > 0, last, WALLS, BLOCK,
                        )  # fmt: skip
                        worst = tl.maximum(worst, lacking)
                        back += turned
                tl.store(peak + 2 * MOST_PROGRAMS + pid, tl.max(worst))
                tl.store(peak + 3 * MOST_PROGRAMS + pid, tl.sum(back))
                meet(gate, programs)
                done = (
                    (k > 0) & (dt * largest_of(peak + 2 * MOST_PROGRAMS, programs) < tolerance) & (k + 1 < iterations)
                )
                o = tl.arange(0, MOST_PROGRAMS)
                turned_all = tl.sum(tl.load(peak + 3 * MOST_PROGRAMS + o, o < programs, 0.0))
                wrong = tl.where(turned_all > 0, 1, 0)
                if (done == 0) | (jumped > 0):  # without momentum there is nothing to take back
                    shift = tl.where(done, 4, 0)
                    _push_nodes(
                        entry_start, entry_place, entry_weight, total, touched, touched_nodes, impulse + shift, fields,
                        programs, TALL,
                    )  # fmt: skip
                jumped = tl.where(momentum != 0, 1, 0)
                going = tl.where(done | last, 0, 1)
                k += 1
                if going > 0:
                    meet(gate, programs)
                    for first in range(pid * BLOCK, places, programs * BLOCK):
                        p = first + lane
                        mask = p < places
                        mask = mask & (tl.load(many + p, mask, 0) > 0)
                        if tl.max(mask.to(tl.int32)) > 0:
                            velocity_now(
                                fields, base, fraction, arm, moving, places, p, mask, sx, sy, inverse_dx, ARMS,
                                VIRTUAL, BLOCK,
                            )  # fmt: skip
                    meet(gate, programs)
            if WALLS > 0:
                tl.debug_barrier()  # another thread of this program may have written what is read next
                for first in range(pid * BLOCK, places, programs * BLOCK):
                    p = first + lane
                    mask = p < places
                    mask = mask & (tl.load(many + p, mask, 0) > 0)
                    if tl.max(mask.to(tl.int32)) > 0:
                        for wall in range(WALLS):
                            at = (wall * places + p) * 3
                            total_now = add3(vector(pressed_sum + at, mask), 1.0, vector(pressed + at, mask))
                            store3(pressed_sum, 1, at, total_now, mask)
            if pid == 0:
                tl.store(status + ROUNDS, tl.load(status + ROUNDS) + k)


@triton.jit(do_not_specialize=VARIES)
def obstacle_places(
    position, moving, thickness, gap, facing, drive, valid, within, places, window, numbers, rows, time, dt, slack,
    first_step, step_offset, SOLIDS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Constraints of all contact samples with the first obstacle in ``total``: gap, normal, velocity, and if it acts.

    ``within`` becomes one if a sample is closer than ``slack``, now or after a substep with its velocity ``moving``.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < places
    x = vector(position + k * 3, mask)
    step = tl.load(first_step) + step_offset
    distance, normal, own = touch(x, numbers, rows, step, mask, SOLIDS, 0)
    distance -= 0.5 * tl.load(thickness + k, mask, 0.0)
    on = tl.where(acts(window, tl.load(time)), 1.0, 0.0) + tl.zeros_like(distance)
    v = add3(vector(moving + k * 4, mask), -1.0, own)
    ahead = distance + tl.load(dt).to(tl.float32) * dot3(v, normal)
    close = mask & (tl.minimum(distance, ahead) < slack)
    if tl.max(tl.where(close, on, 0.0)) > 0:
        tl.store(within, 1)
    tl.store(gap + k, distance, mask)
    tl.store(valid + k, on, mask)
    store3(facing, 1, k * 3, normal, mask)
    store3(drive, 1, k * 3, own, mask)
