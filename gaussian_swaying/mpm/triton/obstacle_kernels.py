"""Planes and obstacles as Triton functions; the references are in :mod:`~gaussian_swaying.mpm.boundaries`.

:class:`~gaussian_swaying.mpm.triton.obstacles.Solids` makes what they read: the numbers and tables of the twins; for
each solid a row of :data:`ROW` numbers, gap, friction and the number of its boundary; its time window; and, if it
moves, keys. A key has :data:`KEY` numbers: time, place (3), and turn (3). The pose of a substep has :data:`POSE`: place
of the centre (3), rotation (9), and the velocity of what is at an offset from the centre: a matrix (9) and the velocity
of the centre (3).
"""

from gaussian_swaying.geometry.linalg_triton import add3, dot3, matmul, matvec, read, transpose
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.triton.shared import VARIES

ROW, KEY, POSE = tl.constexpr(4), tl.constexpr(7), tl.constexpr(24)


@triton.jit
def touch(x, row, pose, numbers, mask, SOLIDS: tl.constexpr, w: tl.constexpr, MOVES: tl.constexpr):
    """Distance from solid w less its gap, its normal, and its velocity at places x: twin of ``Obstacle.touch``."""
    x = (x[0] - tl.load(pose), x[1] - tl.load(pose + 1), x[2] - tl.load(pose + 2))
    own = x
    if MOVES:
        own = matvec(transpose(read(pose, 3, 9)), x)
    shape = read(numbers, SOLIDS.numbers[w][0], SOLIDS.numbers[w][1])
    OPTIONS: tl.constexpr = SOLIDS.options[w]
    distance, normal = SOLIDS.functions[w](own, shape, numbers + SOLIDS.tables[w], mask, OPTIONS)
    zero = x[0] * 0
    drive = (zero, zero, zero)
    if MOVES:
        normal = matvec(read(pose, 3, 9), normal)
        drive = matvec(read(pose, 12, 9), x)
        drive = (drive[0] + tl.load(pose + 21), drive[1] + tl.load(pose + 22), drive[2] + tl.load(pose + 23))
    return distance - tl.load(row), normal, drive


@triton.jit
def stopped(v, n, kind: tl.constexpr, friction):
    """Velocity in contact with a plane, as :func:`boundaries.plane.plane_velocity`; ``kind`` in ``plane.KINDS``."""
    along = dot3(v, n)
    removed = tl.where(kind == 2, tl.minimum(along, 0.0), along)
    t = (v[0] - along * n[0], v[1] - along * n[1], v[2] - along * n[2])
    speed = tl.maximum(tl.sqrt(dot3(t, t)), 1.1754944e-38)
    left = tl.where(friction > 0, tl.maximum(1 - friction * tl.abs(removed) / speed, 0.0), 1.0)
    left = tl.where(kind == 0, 0.0, left)
    rest = tl.where(kind == 0, 0.0, along - removed)
    return left * t[0] + rest * n[0], left * t[1] + rest * n[1], left * t[2] + rest * n[2]


@triton.jit
def stop_nodes(
    v, x, row, pose, numbers, mask, SOLIDS: tl.constexpr, w: tl.constexpr, KIND: tl.constexpr, MOVES: tl.constexpr
):  # fmt: skip
    """Velocity of nodes at x in contact with solid w, and which of them are; KIND in ``plane.KINDS``."""
    friction = tl.load(row + 1)
    distance, n, own = touch(x, row, pose, numbers, mask, SOLIDS, w, MOVES)
    if MOVES:
        held = stopped(add3(v, -1.0, own), n, KIND, friction)
        held = add3(held, 1.0, own)
    else:
        held = stopped(v, n, KIND, friction)
    return held, distance <= 0


@triton.jit
def _at(keys, count, time):
    last = 0
    for k in range(1, count):
        last += (tl.load(keys + k * KEY) <= time).to(tl.int32)
    last = tl.maximum(tl.minimum(last, count - 2), 0)
    a = keys + last * KEY
    b = a + tl.where(count > 1, KEY, 0)
    span = tl.load(b) - tl.load(a)
    f = tl.where(span > 0, (time - tl.load(a)) / tl.where(span > 0, span, 1.0), 0.0)
    f = tl.minimum(tl.maximum(f, 0.0), 1.0)
    p0 = tl.load(a + 1)
    p1 = tl.load(a + 2)
    p2 = tl.load(a + 3)
    r0 = tl.load(a + 4)
    r1 = tl.load(a + 5)
    r2 = tl.load(a + 6)
    place = (p0 + f * (tl.load(b + 1) - p0), p1 + f * (tl.load(b + 2) - p1), p2 + f * (tl.load(b + 3) - p2))
    turn = (r0 + f * (tl.load(b + 4) - r0), r1 + f * (tl.load(b + 5) - r1), r2 + f * (tl.load(b + 6) - r2))
    return place, turn


@triton.jit
def _rotation(turn):
    angle = tl.sqrt(dot3(turn, turn))
    scale = 1 / tl.where(angle > 0, angle, 1.0)
    x = turn[0] * scale
    y = turn[1] * scale
    z = turn[2] * scale
    s = tl.sin(angle)
    c = 1 - tl.cos(angle)
    return (
        1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
        c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
        c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def _store9(to, m):
    for k in tl.static_range(9):
        tl.store(to + k, m[k].to(tl.float32))


@triton.jit(do_not_specialize=("solids",))
def obstacle_poses(keys, spans, time, dt, poses, solids):
    """Pose of each solid in each substep from ``time`` on: the second axis is the solids, the first the substeps."""
    step = tl.program_id(0)
    m = tl.program_id(1)
    count = tl.load(spans + m * 2 + 1)
    if count > 0:
        mine = keys + tl.load(spans + m * 2) * KEY
        h = tl.load(dt)
        now = tl.load(time) + step * h
        here, turn = _at(mine, count, now)
        there, turned = _at(mine, count, now + h)
        out = poses + (step * solids + m) * POSE
        first = _rotation(turn)
        both = matmul(_rotation(turned), transpose(first))
        for k in tl.static_range(3):
            tl.store(out + k, here[k].to(tl.float32))
            tl.store(out + 21 + k, ((there[k] - here[k]) / h).to(tl.float32))
        _store9(out + 3, first)
        tl.store(out + 12, ((both[0] - 1) / h).to(tl.float32))
        tl.store(out + 13, (both[1] / h).to(tl.float32))
        tl.store(out + 14, (both[2] / h).to(tl.float32))
        tl.store(out + 15, (both[3] / h).to(tl.float32))
        tl.store(out + 16, ((both[4] - 1) / h).to(tl.float32))
        tl.store(out + 17, (both[5] / h).to(tl.float32))
        tl.store(out + 18, (both[6] / h).to(tl.float32))
        tl.store(out + 19, (both[7] / h).to(tl.float32))
        tl.store(out + 20, ((both[8] - 1) / h).to(tl.float32))


@triton.jit
def acts(window, now):
    """True if a solid acts at a time, from its first and last time."""
    now = now + 1e-9  # boundary.CLOCK
    return (now >= tl.load(window)) & (now < tl.load(window + 1))


@triton.jit(do_not_specialize=VARIES)
def obstacle_places(
    position, moving, thickness, gap, facing, drive, valid, within, places, row, window, pose, numbers, time, dt, slack,
    SOLIDS: tl.constexpr, MOVES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Constraints of all contact samples with the first obstacle in ``total``: gap, normal, velocity, and if it acts.

    ``within`` becomes one if a sample is closer than ``slack``, now or after a substep with its velocity ``moving``.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < places
    at = position + k * 3
    x = (tl.load(at, mask, 0.0), tl.load(at + 1, mask, 0.0), tl.load(at + 2, mask, 0.0))
    distance, normal, own = touch(x, row, pose, numbers, mask, SOLIDS, 0, MOVES)
    distance -= 0.5 * tl.load(thickness + k, mask, 0.0)
    on = tl.where(acts(window, tl.load(time)), 1.0, 0.0) + tl.zeros_like(distance)
    v = moving + k * 4
    v0 = tl.load(v, mask, 0.0) - own[0]
    v1 = tl.load(v + 1, mask, 0.0) - own[1]
    v2 = tl.load(v + 2, mask, 0.0) - own[2]
    ahead = distance + tl.load(dt).to(tl.float32) * (v0 * normal[0] + v1 * normal[1] + v2 * normal[2])
    close = mask & (tl.minimum(distance, ahead) < slack)
    if tl.max(tl.where(close, on, 0.0)) > 0:
        tl.store(within, 1)
    tl.store(gap + k, distance, mask)
    tl.store(valid + k, on, mask)
    for c in tl.static_range(3):
        tl.store(facing + k * 3 + c, normal[c], mask)
        tl.store(drive + k * 3 + c, own[c], mask)
