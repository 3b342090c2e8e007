"""Kernels of contact; the reference is :mod:`~gaussian_swaying.mpm.contact.solve`.

A place is a row of 27 weights on the nodes. Lists have room for more than they hold: an index of -1 stands for nothing.
Sums over places and nodes are atomic, so their order differs between runs.
"""

import triton
import triton.language as tl

from gaussian_swaying.mpm.triton.shared import VARIES

CHANGES = (*VARIES, "pairs", "round_")


@triton.jit
def _row(place, table, a, rows, BLOCK: tl.constexpr):
    """The row of a table (C, 27) for each listed place: where its entries are, and which of them exist."""
    p = tl.load(place + a, a < rows, -1)
    o = tl.arange(0, 32)[None, :]
    known = (p >= 0)[:, None] & (o < 27)
    return p, table + p[:, None] * 27 + o, known


@triton.jit(do_not_specialize=CHANGES)
def contact_places(
    place, rest, facing, node, weight, slope, fields, position, normal, moving, many_of, impulse, rows,
    NORMALS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Position, velocity and normal of each listed place now; no constraints and no impulse yet."""
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    p, at, known = _row(place, node, a, rows, BLOCK)
    mask = p >= 0
    row = fields + tl.load(at, known, 0) * 8
    o = tl.arange(0, 32)[None, :]
    w = tl.load(weight + p[:, None] * 27 + o, known, 0.0)
    u0 = tl.load(row, known, 0.0)
    u1 = tl.load(row + 1, known, 0.0)
    u2 = tl.load(row + 2, known, 0.0)
    tl.store(position + a * 3, tl.load(rest + p * 3, mask, 0.0) + tl.sum(w * u0, 1), mask)
    tl.store(position + a * 3 + 1, tl.load(rest + p * 3 + 1, mask, 0.0) + tl.sum(w * u1, 1), mask)
    tl.store(position + a * 3 + 2, tl.load(rest + p * 3 + 2, mask, 0.0) + tl.sum(w * u2, 1), mask)
    for c in tl.static_range(3):
        tl.store(moving + a * 3 + c, tl.sum(w * tl.load(row + 4 + c, known, 0.0), 1), mask)
        tl.store(impulse + a * 3 + c, tl.zeros([BLOCK], tl.float32), mask)
    tl.store(many_of + a, tl.zeros([BLOCK], tl.float32), mask)
    if NORMALS:
        s0 = tl.load(slope + p[:, None] * 81 + o, known, 0.0)
        s1 = tl.load(slope + p[:, None] * 81 + 27 + o, known, 0.0)
        s2 = tl.load(slope + p[:, None] * 81 + 54 + o, known, 0.0)
        a0 = 1 + tl.sum(s0 * u0, 1)
        a1 = tl.sum(s0 * u1, 1)
        a2 = tl.sum(s0 * u2, 1)
        b0 = tl.sum(s1 * u0, 1)
        b1 = 1 + tl.sum(s1 * u1, 1)
        b2 = tl.sum(s1 * u2, 1)
        c0 = tl.sum(s2 * u0, 1)
        c1 = tl.sum(s2 * u1, 1)
        c2 = 1 + tl.sum(s2 * u2, 1)
        x = tl.load(facing + p * 3, mask, 0.0)
        y = tl.load(facing + p * 3 + 1, mask, 0.0)
        z = tl.load(facing + p * 3 + 2, mask, 0.0)
        n0 = (b1 * c2 - b2 * c1) * x + (c1 * a2 - c2 * a1) * y + (a1 * b2 - a2 * b1) * z
        n1 = (b2 * c0 - b0 * c2) * x + (c2 * a0 - c0 * a2) * y + (a2 * b0 - a0 * b2) * z
        n2 = (b0 * c1 - b1 * c0) * x + (c0 * a1 - c1 * a0) * y + (a0 * b1 - a1 * b0) * z
        length = tl.maximum(tl.sqrt(n0 * n0 + n1 * n1 + n2 * n2), 1e-12)
        tl.store(normal + a * 3, n0 / length, mask)
        tl.store(normal + a * 3 + 1, n1 / length, mask)
        tl.store(normal + a * 3 + 2, n2 / length, mask)


@triton.jit
def _over(d0, d1, d2, squared, normal, radius, place, mine, mask):
    """The height of the other above a disc times its normal, zero beside the disc, and whether it is above."""
    p = tl.load(place + mine, mask, 0)
    r = tl.load(radius + p, mask, 0.0)
    n0 = tl.load(normal + mine * 3, mask, 0.0)
    n1 = tl.load(normal + mine * 3 + 1, mask, 0.0)
    n2 = tl.load(normal + mine * 3 + 2, mask, 0.0)
    height = d0 * n0 + d1 * n1 + d2 * n2
    over = squared - height * height < r * r
    height = tl.where(over, height, 0.0)
    return height * n0, height * n1, height * n2, over, p, n0, n1, n2


@triton.jit(do_not_specialize=CHANGES)
def contact_pairs(
    first, second, place, radius, thickness, position, normal, out_normal, out_gap, out_valid, pairs,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Normal and gap of each listed pair, as ``pair_gaps``."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    i = tl.load(first + k, k < pairs, -1)
    j = tl.load(second + k, k < pairs, -1)
    mask = i >= 0
    d0 = tl.load(position + i * 3, mask, 0.0) - tl.load(position + j * 3, mask, 0.0)
    d1 = tl.load(position + i * 3 + 1, mask, 0.0) - tl.load(position + j * 3 + 1, mask, 0.0)
    d2 = tl.load(position + i * 3 + 2, mask, 0.0) - tl.load(position + j * 3 + 2, mask, 0.0)
    squared = d0 * d0 + d1 * d1 + d2 * d2
    a0, a1, a2, over_a, pa, _x, _y, _z = _over(d0, d1, d2, squared, normal, radius, place, i, mask)
    b0, b1, b2, over_b, pb, f0, f1, f2 = _over(d0, d1, d2, squared, normal, radius, place, j, mask)
    a0 += b0
    a1 += b1
    a2 += b2
    length = tl.sqrt(tl.maximum(a0 * a0 + a1 * a1 + a2 * a2, 1.2e-38))
    real = length > 1.1e-19
    a0 = tl.where(real, a0 / length, f0)
    a1 = tl.where(real, a1 / length, f1)
    a2 = tl.where(real, a2 / length, f2)
    keep = 0.5 * (tl.load(thickness + pa, mask, 0.0) + tl.load(thickness + pb, mask, 0.0))
    tl.store(out_normal + k * 3, a0, mask)
    tl.store(out_normal + k * 3 + 1, a1, mask)
    tl.store(out_normal + k * 3 + 2, a2, mask)
    tl.store(out_gap + k, d0 * a0 + d1 * a1 + d2 * a2 - keep, mask)
    tl.store(out_valid + k, tl.where(over_a | over_b, 1.0, 0.0), mask)


@triton.jit
def _velocity(moving, drive, k, i, j, mask, c: tl.constexpr):
    """One component of the relative velocity of a constraint; an obstacle has -1 in place of the second place."""
    mine = tl.load(moving + i * 3 + c, mask, 0.0)
    other = tl.load(moving + j * 3 + c, mask & (j >= 0), 0.0)
    return mine - other - tl.load(drive + k * 3 + c, mask, 0.0)


@triton.jit(do_not_specialize=CHANGES)
def contact_acting(
    first, second, moving, drive, normal, gap, valid, applied, found, many_of, schedule, first_step, step_offset, slack,
    pairs, BLOCK: tl.constexpr,
):  # fmt: skip
    """Keep the constraints that this substep comes close to, and count those of each place."""
    dt = tl.load(schedule + (tl.load(first_step) + step_offset + 1) * 4 + 1)
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    i = tl.load(first + k, k < pairs, -1)
    j = tl.load(second + k, k < pairs, -1)
    mask = i >= 0
    along = tl.zeros([BLOCK], tl.float32)
    for c in tl.static_range(3):
        relative = _velocity(moving, drive, k, i, j, mask, c)
        along += relative * tl.load(normal + k * 3 + c, mask, 0.0)
        tl.store(applied + k * 3 + c, tl.zeros([BLOCK], tl.float32), mask)
        tl.store(found + k * 3 + c, tl.zeros([BLOCK], tl.float32), mask)
    g = tl.load(gap + k, mask, 0.0)
    acts = (tl.load(valid + k, mask, 0.0) > 0) & (tl.minimum(g, g + dt * along) < slack) & mask
    tl.store(valid + k, tl.where(acts, 1.0, 0.0), mask)
    one = tl.full([BLOCK], 1.0, tl.float32)
    tl.atomic_add(many_of + i, one, acts)
    tl.atomic_add(many_of + j, one, acts & (j >= 0))


@triton.jit(do_not_specialize=CHANGES)
def contact_spread(place, node, inverse, many_of, total, rows, BLOCK: tl.constexpr):
    """Sum the counts of the places to the nodes."""
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    p, at, known = _row(place, node, a, rows, BLOCK)
    many = tl.load(many_of + a, p >= 0, 0.0)
    known = known & (many > 0)[:, None]
    w = tl.load(inverse + p[:, None] * 27 + tl.arange(0, 32)[None, :], known, 0.0)
    tl.atomic_add(total + tl.load(at, known, 0), tl.abs(w) * many[:, None], known)


@triton.jit(do_not_specialize=CHANGES)
def contact_mobility(place, node, weight, many_of, total, mobility, rows, BLOCK: tl.constexpr):
    """Bound of how much unit impulses at all constraints move each place."""
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    p, at, known = _row(place, node, a, rows, BLOCK)
    mask = p >= 0
    known = known & (tl.load(many_of + a, mask, 0.0) > 0)[:, None]
    w = tl.load(weight + p[:, None] * 27 + tl.arange(0, 32)[None, :], known, 0.0)
    tl.store(mobility + a, tl.sum(tl.abs(w) * tl.load(total + tl.load(at, known, 0), known, 0.0), 1), mask)


@triton.jit(do_not_specialize=CHANGES)
def contact_read(place, node, weight, many_of, fields, moving, rows, BLOCK: tl.constexpr):
    """The velocity of each place that has a constraint."""
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    p, at, known = _row(place, node, a, rows, BLOCK)
    mask = (p >= 0) & (tl.load(many_of + a, p >= 0, 0.0) > 0)
    known = known & mask[:, None]
    row = fields + tl.load(at, known, 0) * 8 + 4
    w = tl.load(weight + p[:, None] * 27 + tl.arange(0, 32)[None, :], known, 0.0)
    for c in tl.static_range(3):
        tl.store(moving + a * 3 + c, tl.sum(w * tl.load(row + c, known, 0.0), 1), mask)


@triton.jit(do_not_specialize=CHANGES)
def contact_impulses(
    first, second, moving, drive, normal, gap, friction, valid, mobility, applied, found, impulse, theta, turned,
    schedule, first_step, step_offset, push, most, pairs, round_,
    LAST: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One iteration of ``resolve``: the impulse of each constraint, and its change summed at the places."""
    dt = tl.load(schedule + (tl.load(first_step) + step_offset + 1) * 4 + 1)
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    acts = (k < pairs) & (tl.load(valid + k, k < pairs, 0.0) > 0)
    i = tl.load(first + k, acts, 0)
    j = tl.load(second + k, acts, -1)
    other = acts & (j >= 0)
    n0 = tl.load(normal + k * 3, acts, 0.0)
    n1 = tl.load(normal + k * 3 + 1, acts, 0.0)
    n2 = tl.load(normal + k * 3 + 2, acts, 0.0)
    r0 = _velocity(moving, drive, k, i, j, acts, 0)
    r1 = _velocity(moving, drive, k, i, j, acts, 1)
    r2 = _velocity(moving, drive, k, i, j, acts, 2)
    along = r0 * n0 + r1 * n1 + r2 * n2
    both = tl.load(mobility + i, acts, 0.0) + tl.load(mobility + j, other, 0.0)
    step = tl.where(both > 0, 1 / tl.where(both > 0, both, 1.0), 0.0)
    g = tl.load(gap + k, acts, 0.0)
    target = tl.where(g > 0, -g, tl.minimum(-g * push, most)) / dt
    y0 = tl.load(applied + k * 3, acts, 0.0)
    y1 = tl.load(applied + k * 3 + 1, acts, 0.0)
    y2 = tl.load(applied + k * 3 + 2, acts, 0.0)
    ahead = y0 * n0 + y1 * n1 + y2 * n2
    press = tl.maximum(ahead + step * (target - along), 0.0)
    t0 = y0 - ahead * n0 - step * (r0 - along * n0)
    t1 = y1 - ahead * n1 - step * (r1 - along * n1)
    t2 = y2 - ahead * n2 - step * (r2 - along * n2)
    length = tl.sqrt(tl.maximum(t0 * t0 + t1 * t1 + t2 * t2, 1.2e-38))
    share = tl.minimum(tl.load(friction + k, acts, 0.0) * press / length, 1.0)
    t0 = press * n0 + share * t0
    t1 = press * n1 + share * t1
    t2 = press * n2 + share * t2
    old = found + k * 3
    g0 = t0 - tl.load(old, acts, 0.0)
    g1 = t1 - tl.load(old + 1, acts, 0.0)
    g2 = t2 - tl.load(old + 2, acts, 0.0)
    back = tl.where(acts, (y0 - t0) * g0 + (y1 - t1) * g1 + (y2 - t2) * g2, 0.0)
    tl.atomic_add(turned + round_ + 1, tl.sum(back))
    now = tl.load(theta + round_)
    following = 0.5 * (1 + tl.sqrt(1 + 4 * now * now))
    wrong = tl.load(turned + round_) > 0
    momentum = tl.where(wrong, 0.0, (now - 1) / following)
    if LAST:
        momentum = 0.0
    tl.store(theta + round_ + 1, tl.where(wrong, 1.0, following))
    tl.store(old, t0, acts)
    tl.store(old + 1, t1, acts)
    tl.store(old + 2, t2, acts)
    t0 += momentum * g0
    t1 += momentum * g1
    t2 += momentum * g2
    to = applied + k * 3
    tl.store(to, t0, acts)
    tl.store(to + 1, t1, acts)
    tl.store(to + 2, t2, acts)
    tl.atomic_add(impulse + i * 3, t0 - y0, acts)
    tl.atomic_add(impulse + i * 3 + 1, t1 - y1, acts)
    tl.atomic_add(impulse + i * 3 + 2, t2 - y2, acts)
    tl.atomic_add(impulse + j * 3, y0 - t0, other)
    tl.atomic_add(impulse + j * 3 + 1, y1 - t1, other)
    tl.atomic_add(impulse + j * 3 + 2, y2 - t2, other)


@triton.jit(do_not_specialize=CHANGES)
def contact_push(place, node, inverse, many_of, impulse, fields, rows, BLOCK: tl.constexpr):
    """Give the impulses of the places to the nodes, and clear them."""
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    p, at, known = _row(place, node, a, rows, BLOCK)
    mask = (p >= 0) & (tl.load(many_of + a, p >= 0, 0.0) > 0)
    known = known & mask[:, None]
    row = fields + tl.load(at, known, 0) * 8 + 4
    w = tl.load(inverse + p[:, None] * 27 + tl.arange(0, 32)[None, :], known, 0.0)
    for c in tl.static_range(3):
        j = tl.load(impulse + a * 3 + c, mask, 0.0)
        tl.atomic_add(row + c, w * j[:, None], known)
        tl.store(impulse + a * 3 + c, tl.zeros([BLOCK], tl.float32), mask)
