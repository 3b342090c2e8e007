"""Kernel that lists the contact samples that are close, without the host; it does nothing while the lists are good.

The programs of a kernel here run all at once and wait for each other (:func:`meet`), so a substep needs few launches.
Samples are sorted by the cells of a grid that is stored as a hash table, and each looks at the 27 cells around it. Sums
and lists have the same order in every run: the counts are atomic, but each cell is sorted afterwards.
"""

from gaussian_swaying.geometry.linalg_triton import load3
from gaussian_swaying.kernels.language import ON_GPU, tl, triton
from gaussian_swaying.mpm.triton.shared import VARIES, axis_weights, node_weight

CHANGES = (*VARIES, "places", "touched_nodes", "last", "chunk", "iterations")

MOST_PROGRAMS = tl.constexpr(1024 if ON_GPU else 8)
"""Most programs that meet; a row of ``peak`` has as many entries."""

LISTED, NEEDED_ROOM, NEEDED_SLOTS, MADE, ROUNDS, ACTING, WITHIN = (tl.constexpr(k) for k in range(7))
"""Entries of ``status``: candidates of all samples; room that is needed for the candidates of a sample, and for its
constraints; how often lists were made; iterations of all substeps; constraints of this substep; whether an obstacle is
within reach in it."""


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
    return (
        tl.sum(tl.where(column == 0, x, 0.0), 1),
        tl.sum(tl.where(column == 1, x, 0.0), 1),
        tl.sum(tl.where(column == 2, x, 0.0), 1),
    )


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
    x = load3(rest, places, p, mask)
    u0, u1, u2 = three(u)
    return (x[0] + u0, x[1] + u1, x[2] + u2), v, d0, d1, d2


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
    for c in tl.static_range(3):
        tl.store(position + p * 3 + c, x[c], mask)
    store_velocity(moving, p, mask, v)
    if tl.program_id(0) == 0:
        tl.store(status + ACTING, 0)
        tl.store(status + WITHIN, 0)


@triton.jit
def _cell(x, inverse_size):
    return tl.floor(x * inverse_size).to(tl.int32)


@triton.jit
def _bucket(x, y, z, last):
    """Return the hash of a grid cell: its index in a table of ``last + 1`` entries, a power of two."""
    return ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & last


@triton.jit
def _own_bucket(position, p, mask, inverse_size, last):
    x = _cell(tl.load(position + p * 4, mask, 0.0), inverse_size)
    y = _cell(tl.load(position + p * 4 + 1, mask, 0.0), inverse_size)
    z = _cell(tl.load(position + p * 4 + 2, mask, 0.0), inverse_size)
    return x, y, z, _bucket(x, y, z, last)


@triton.jit
def _sort_places(
    position, counts, start, rank, item, ordered, sorted_, places, sums, gate, inverse_size, last, chunk,
    programs, BLOCK: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Sort the samples by cell, and those of a cell by their number; ``chunk`` cells to a program."""
    pid = tl.program_id(0)
    lane = tl.arange(0, BLOCK)
    for first in range(pid * BLOCK, places, programs * BLOCK):
        p = first + lane
        mask = p < places
        _x, _y, _z, bucket = _own_bucket(position, p, mask, inverse_size, last)
        tl.store(rank + p, tl.atomic_add(counts + bucket, 1, mask, sem="relaxed"), mask)
    meet(gate, programs)
    own = tl.zeros([BLOCK], tl.int32)
    for first in range(0, chunk, BLOCK):
        b = pid * chunk + first + lane
        own += tl.load(counts + b, b <= last, 0)
    tl.store(sums + pid, tl.sum(own))
    meet(gate, programs)
    o = tl.arange(0, MOST_PROGRAMS)
    before = tl.sum(tl.load(sums + o, o < pid, 0))
    for first in range(0, chunk, BLOCK):
        b = pid * chunk + first + lane
        many = tl.load(counts + b, b <= last, 0)
        tl.store(start + b, before + tl.cumsum(many, 0) - many, b <= last)
        before += tl.sum(many)
    meet(gate, programs)
    for first in range(pid * BLOCK, places, programs * BLOCK):
        p = first + lane
        mask = p < places
        _x, _y, _z, bucket = _own_bucket(position, p, mask, inverse_size, last)
        tl.store(item + tl.load(start + bucket, mask, 0) + tl.load(rank + p, mask, 0), p, mask)
    meet(gate, programs)
    wide = tl.arange(0, WIDE)[None, :]
    for first in range(pid * BLOCK, places, programs * BLOCK):
        p = first + lane
        mask = p < places
        _x, _y, _z, bucket = _own_bucket(position, p, mask, inverse_size, last)
        begin = tl.load(start + bucket, mask, 0)
        many = tl.load(start + bucket + 1, mask, 0) - begin
        smaller = tl.zeros([BLOCK], tl.int32)
        for k in range(0, tl.max(many), WIDE):
            known = (k + wide) < many[:, None]
            q = tl.load(item + begin[:, None] + k + wide, known, 0)
            smaller += tl.sum((known & (q < p[:, None])).to(tl.int32), 1)
        to = begin + smaller
        tl.store(ordered + to, p, mask)
        for c in tl.static_range(3):
            tl.store(sorted_ + to * 4 + c, tl.load(position + p * 4 + c, mask, 0.0), mask)
    meet(gate, programs)


@triton.jit
def _search(
    position, rest, base, corner, start, ordered, sorted_, candidates, near, places, room, status, limit, apart, beside,
    inverse_size, last, programs, VIRTUAL: tl.constexpr, BLOCK: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """The samples closer than ``limit`` to each that were at least ``apart`` from it at rest.

    With VIRTUAL also those that were at least ``beside`` from it, and have another copy of a node that both reach.
    """
    lane = tl.arange(0, BLOCK)
    wide = tl.arange(0, WIDE)[None, :]
    for first in range(tl.program_id(0) * BLOCK, places, programs * BLOCK):
        p = first + lane
        mask = p < places
        x, y, z, _b = _own_bucket(position, p, mask, inverse_size, last)
        p0 = tl.load(position + p * 4, mask, 0.0)[:, None]
        p1 = tl.load(position + p * 4 + 1, mask, 0.0)[:, None]
        p2 = tl.load(position + p * 4 + 2, mask, 0.0)[:, None]
        r = load3(rest, places, p, mask)
        found = tl.zeros([BLOCK], tl.int32)
        for column in range(9):
            cx = x + column // 3 - 1
            cy = y + column % 3 - 1
            below = _bucket(cx, cy, z - 1, last)
            level = _bucket(cx, cy, z, last)
            above = _bucket(cx, cy, z + 1, last)
            s0 = tl.load(start + below, mask, 0)
            s1 = tl.load(start + level, mask, 0)
            s2 = tl.load(start + above, mask, 0)
            l0 = tl.load(start + below + 1, mask, 0) - s0
            l1 = tl.load(start + level + 1, mask, 0) - s1 + l0
            l2 = tl.load(start + above + 1, mask, 0) - s2 + l1
            for k in range(0, tl.max(l2), WIDE):
                e = k + wide
                known = e < l2[:, None]
                in0 = e < l0[:, None]
                in1 = e < l1[:, None]
                at = tl.where(in0, s0[:, None] + e, tl.where(in1, (s1 - l0)[:, None] + e, (s2 - l1)[:, None] + e))
                q0 = tl.load(sorted_ + at * 4, known, 0.0)
                q1 = tl.load(sorted_ + at * 4 + 1, known, 0.0)
                q2 = tl.load(sorted_ + at * 4 + 2, known, 0.0)
                # other cells may share the entry of the table
                cz = z[:, None] + tl.where(in0, -1, tl.where(in1, 0, 1))
                known = known & (_cell(q0, inverse_size) == cx[:, None]) & (_cell(q1, inverse_size) == cy[:, None])
                known = known & (_cell(q2, inverse_size) == cz)
                q0 -= p0
                q1 -= p1
                q2 -= p2
                known = known & (q0 * q0 + q1 * q1 + q2 * q2 < limit * limit)
                q = tl.load(ordered + at, known, 0)
                q0 = tl.load(rest + q, known, 0.0) - r[0][:, None]
                q1 = tl.load(rest + places + q, known, 0.0) - r[1][:, None]
                q2 = tl.load(rest + 2 * places + q, known, 0.0) - r[2][:, None]
                square = q0 * q0 + q1 * q1 + q2 * q2
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
        found = tl.where(mask, found, 0)
        tl.atomic_max(status + NEEDED_ROOM, tl.max(found), sem="relaxed")
        tl.atomic_add(status + LISTED, tl.sum(found), sem="relaxed")


@triton.jit(do_not_specialize=CHANGES)
def contact_lists(
    active, carries, before, nodes, fields, base, fraction, arm, rest, places, corner,
    position, counts, start, rank, item, ordered, sorted_, candidates, near, room, many, impulse,
    entry_start, entry_place, reached, touched_nodes, peak, sums, gate, status, margin,
    schedule, first_step, step_offset, sx, sy, inverse_dx, reach, apart, slack, least, ahead, last, chunk,
    ARMS: tl.constexpr, VIRTUAL: tl.constexpr, BLOCK: tl.constexpr, WIDE: tl.constexpr, TALL: tl.constexpr,
):  # fmt: skip
    """Make the lists again if a node may have moved too far since they were made.

    Samples that come close in this substep must be listed. No sample moves farther than the largest motion of a node
    times its entry of ``carries``, so lists of samples closer than the reach of a contact and a margin are complete
    while twice that, with the motion of this substep, is less than the margin.
    """
    dt = tl.load(schedule + (tl.load(first_step) + step_offset + 1) * 4 + 1)
    pid = tl.program_id(0)
    programs = tl.num_programs(0)
    lane = tl.arange(0, BLOCK)
    moved = tl.zeros([BLOCK], tl.float32)
    fast = tl.zeros([BLOCK], tl.float32)
    for first in range(pid * BLOCK, nodes, programs * BLOCK):
        k = first + lane
        mask = k < nodes
        at = fields + tl.load(active + k, mask, 0) * 8
        far = tl.zeros([BLOCK], tl.float32)
        speed = tl.zeros([BLOCK], tl.float32)
        for c in tl.static_range(3):
            u = tl.load(at + c, mask, 0.0) - tl.load(before + k * 4 + c, mask, 0.0)
            v = tl.load(at + 4 + c, mask, 0.0)
            far += u * u
            speed += v * v
        share = tl.load(carries + k, mask, 0.0)
        speed = share * dt * tl.sqrt(speed)
        moved = tl.maximum(moved, share * tl.sqrt(far) + speed)
        fast = tl.maximum(fast, speed)
    tl.store(peak + pid, tl.max(moved))
    tl.store(peak + MOST_PROGRAMS + pid, tl.max(fast))
    known = tl.load(margin)
    meet(gate, programs)
    farthest = largest_of(peak, programs)
    if (2 * farthest + slack > known) & (farthest < 1e9):  # a run that diverges keeps its lists
        step = 2 * largest_of(peak + MOST_PROGRAMS, programs)
        wider = slack + tl.maximum(least, tl.minimum(ahead * step, tl.maximum(reach, 2 * step)))
        if pid == 0:
            tl.store(margin, wider)
            tl.store(status + LISTED, 0)
            tl.store(status + MADE, tl.load(status + MADE) + 1)
        for first in range(pid * BLOCK, nodes, programs * BLOCK):
            k = first + lane
            mask = k < nodes
            at = fields + tl.load(active + k, mask, 0) * 8
            for c in tl.static_range(3):
                tl.store(before + k * 4 + c, tl.load(at + c, mask, 0.0), mask)
        for first in range(pid * BLOCK, last + 1, programs * BLOCK):
            tl.store(counts + first + lane, tl.zeros([BLOCK], tl.int32), first + lane <= last)
        for first in range(pid * BLOCK, places, programs * BLOCK):
            p = first + lane
            mask = p < places
            x, _v, _a, _b, _c = place_now(
                fields, base, fraction, arm, rest, places, p, mask, sx, sy, inverse_dx, False, False, ARMS, VIRTUAL,
                BLOCK,
            )  # fmt: skip
            tl.store(many + p, tl.zeros([BLOCK], tl.int32), mask)
            for c in tl.static_range(3):
                tl.store(position + p * 4 + c, x[c], mask)
            for c in tl.static_range(8):
                tl.store(impulse + p * 8 + c, tl.zeros([BLOCK], tl.float32), mask)
        meet(gate, programs)
        limit = reach + wider
        _sort_places(
            position, counts, start, rank, item, ordered, sorted_, places, sums, gate, 1 / limit, last, chunk,
            programs, BLOCK, WIDE,
        )  # fmt: skip
        _search(
            position, rest, base, corner, start, ordered, sorted_, candidates, near, places, room, status, limit, apart,
            reach, 1 / limit, last, programs, VIRTUAL, BLOCK, WIDE,
        )  # fmt: skip
        meet(gate, programs)
        tall = tl.arange(0, TALL)
        entry = tl.arange(0, 32)[None, :]
        for first in range(pid * TALL, touched_nodes, programs * TALL):
            n = first + tall
            mask = n < touched_nodes
            begin = tl.load(entry_start + n, mask, 0)
            length = tl.load(entry_start + n + 1, mask, 0) - begin
            found = tl.zeros([TALL], tl.int32)
            for k in range(0, tl.max(length), 32):
                real = (k + entry) < length[:, None]
                q = tl.load(entry_place + begin[:, None] + k + entry, real, 0)
                found += tl.sum(tl.load(near + q, real, 0), 1)
            tl.store(reached + n, found, mask)
