"""Planes and obstacles as Triton functions; the references are in :mod:`~gaussian_swaying.mpm.boundaries`.

:class:`~gaussian_swaying.mpm.triton.obstacles.Solids` makes what they read. Each solid has :data:`NUMBERS` numbers:

- a plane: point (3), normal (3), kind (in ``plane.KINDS``), friction, number of its boundary;
- others: six unused, gap, friction, number of the boundary, and the shape: of a ball its radius; of a capsule its
  radius, half of its axis (3) and one over the square of that; of a box half of its sides (3) and its axes (9); of a
  half space its normal (3); of a grid of distances its first node (3), its axes (9) and its spacing;

and :data:`WHOLE` whole numbers: where its grid starts, the nodes of that along each axis, where its keys start, how
many there are, and two unused. A key has :data:`KEY` numbers: time, place (3), and turn (3). The pose of a substep has
:data:`POSE`: place of the centre (3), rotation (9), and the velocity of what is at an offset from the centre: a matrix
(9) and the velocity of the centre (3).
"""

import triton
import triton.language as tl

from gaussian_swaying.geometry.linalg_triton import dot3, matmul, matvec, read3, read9, transpose
from gaussian_swaying.mpm.triton.shared import VARIES

NUMBERS, WHOLE, KEY, POSE = tl.constexpr(24), tl.constexpr(8), tl.constexpr(7), tl.constexpr(24)
PLANE, BALL, CAPSULE, BOX, HALF_SPACE = (tl.constexpr(k) for k in range(5))
GRID = tl.constexpr(5)
LEAST = tl.constexpr(1.0842022e-19)
"""Length of a vector without a direction: the square root of the smallest normal number, as in the reference."""


@triton.jit
def _outwards(x):
    """Length and direction of a vector; z for one without a direction."""
    length = tl.sqrt(dot3(x, x))
    some = length > LEAST
    scale = 1 / tl.where(some, length, 1.0)
    return length, (
        tl.where(some, x[0] * scale, 0.0), tl.where(some, x[1] * scale, 0.0), tl.where(some, x[2] * scale, 1.0)
    )  # fmt: skip


@triton.jit
def ball_distance(x, row):
    """As ``geometry.distance.ball_distance``."""
    length, direction = _outwards(x)
    return length - tl.load(row + 9), direction


@triton.jit
def capsule_distance(x, row):
    """As ``geometry.distance.capsule_distance``."""
    half = read3(row + 10)
    along = dot3(x, half) * tl.load(row + 13)
    along = tl.minimum(tl.maximum(along, -1.0), 1.0)
    return ball_distance((x[0] - along * half[0], x[1] - along * half[1], x[2] - along * half[2]), row)


@triton.jit
def box_distance(x, row):
    """As ``geometry.distance.box_distance``, along the axes of the box."""
    axes = read9(row + 12)
    x = matvec(transpose(axes), x)
    b = (tl.abs(x[0]) - tl.load(row + 9), tl.abs(x[1]) - tl.load(row + 10), tl.abs(x[2]) - tl.load(row + 11))
    outside, away = _outwards((tl.maximum(b[0], 0.0), tl.maximum(b[1], 0.0), tl.maximum(b[2], 0.0)))
    deepest = tl.maximum(tl.maximum(b[0], b[1]), b[2])
    within = deepest <= 0
    first = b[0] == deepest
    second = (b[1] == deepest) & (b[0] != deepest)
    n0 = tl.where(within, tl.where(first, 1.0, 0.0), away[0])
    n1 = tl.where(within, tl.where(second, 1.0, 0.0), away[1])
    n2 = tl.where(within, tl.where(first | second, 0.0, 1.0), away[2])
    n = (tl.where(x[0] < 0, -n0, n0), tl.where(x[1] < 0, -n1, n1), tl.where(x[2] < 0, -n2, n2))
    return tl.where(within, deepest, outside), matvec(axes, n)


@triton.jit
def half_space_distance(x, row):
    """As ``HalfSpaceObstacle.distance``."""
    n = read3(row + 9)
    zero = x[0] * 0
    return dot3(x, n), (n[0] + zero, n[1] + zero, n[2] + zero)


@triton.jit
def _low(x, n):
    """Return the node below a place along an axis of n nodes, within the grid, and the distance beyond it."""
    inside = tl.minimum(tl.maximum(x, 0.0), (n - 1).to(tl.float32))
    first = tl.maximum(tl.minimum(tl.floor(inside), (n - 2).to(tl.float32)), 0.0)
    return first.to(tl.int32), inside - first, x - inside


@triton.jit
def grid_distance(x, row, whole, grids, mask):
    """As ``geometry.distance.grid_distance``, along the axes of the grid."""
    axes = read9(row + 12)
    corner = read3(row + 9)
    spacing = tl.load(row + 21)
    values = grids + tl.load(whole)
    ny = tl.load(whole + 2)
    nz = tl.load(whole + 3)
    x = matvec(transpose(axes), x)
    x0, f0, o0 = _low((x[0] - corner[0]) / spacing, tl.load(whole + 1))
    x1, f1, o1 = _low((x[1] - corner[1]) / spacing, ny)
    x2, f2, o2 = _low((x[2] - corner[2]) / spacing, nz)
    zero = f0 * 0
    distance, s0, s1, s2 = zero, zero, zero, zero
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            line = values + ((x0 + i) * ny + x1 + j) * nz + x2
            low = tl.load(line, mask, 0.0)
            high = tl.load(line + 1, mask, 0.0)
            if i == 0:
                w0 = 1 - f0
            else:
                w0 = f0
            if j == 0:
                w1 = 1 - f1
            else:
                w1 = f1
            between = low + f2 * (high - low)
            distance += w0 * w1 * between
            s0 += (2 * i - 1) * w1 * between
            s1 += (2 * j - 1) * w0 * between
            s2 += w0 * w1 * (high - low)
    far, away = _outwards((o0 * spacing, o1 * spacing, o2 * spacing))
    _length, n = _outwards((s0, s1, s2))
    out = far > 0
    n = (tl.where(out, away[0], n[0]), tl.where(out, away[1], n[1]), tl.where(out, away[2], n[2]))
    return distance + far, matvec(axes, n)


@triton.jit
def touch(x, row, whole, pose, grids, mask, KIND: tl.constexpr, MOVES: tl.constexpr):
    """Distance from an obstacle less its gap, its normal, and its velocity at places x: twin of ``Obstacle.touch``."""
    x = (x[0] - tl.load(pose), x[1] - tl.load(pose + 1), x[2] - tl.load(pose + 2))
    own = x
    if MOVES:
        own = matvec(transpose(read9(pose + 3)), x)
    if KIND == BALL:
        distance, normal = ball_distance(own, row)
    elif KIND == CAPSULE:
        distance, normal = capsule_distance(own, row)
    elif KIND == BOX:
        distance, normal = box_distance(own, row)
    elif KIND == HALF_SPACE:
        distance, normal = half_space_distance(own, row)
    else:
        distance, normal = grid_distance(own, row, whole, grids, mask)
    zero = x[0] * 0
    drive = (zero, zero, zero)
    if MOVES:
        normal = matvec(read9(pose + 3), normal)
        drive = matvec(read9(pose + 12), x)
        drive = (drive[0] + tl.load(pose + 21), drive[1] + tl.load(pose + 22), drive[2] + tl.load(pose + 23))
    return distance - tl.load(row + 6), normal, drive


@triton.jit
def stopped(v, n, kind, friction):
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
def stop_nodes(v, x, row, whole, pose, grids, mask, KIND: tl.constexpr, MOVES: tl.constexpr):
    """Velocity of nodes at x in contact with a solid, and which of them are."""
    friction = tl.load(row + 7)
    if KIND == PLANE:
        p = read3(row)
        n = read3(row + 3)
        held = stopped(v, n, tl.load(row + 6), friction)
        behind = ((x[0] - p[0]) * n[0] + (x[1] - p[1]) * n[1] + (x[2] - p[2]) * n[2]) <= 0
    else:
        distance, n, own = touch(x, row, whole, pose, grids, mask, KIND, MOVES)
        behind = distance <= 0
        held = stopped((v[0] - own[0], v[1] - own[1], v[2] - own[2]), n, 2, friction)
        held = (held[0] + own[0], held[1] + own[1], held[2] + own[2])
    return held, behind


@triton.jit
def _at(keys, count, time):
    """Return position and rotation at a time, interpolated between the keys."""
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
    """As ``geometry.keyed_path.rotation_of``."""
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
def obstacle_poses(keys, whole, time, dt, poses, solids):
    """Pose of each solid in each substep from ``time`` on: the second axis is the solids, the first the substeps."""
    step = tl.program_id(0)
    m = tl.program_id(1)
    count = tl.load(whole + m * WHOLE + 5)
    if count > 0:
        mine = keys + tl.load(whole + m * WHOLE + 4) * KEY
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
    position, moving, thickness, gap, facing, drive, valid, within, places, row, whole, window, pose, grids, time, dt,
    slack, KIND: tl.constexpr, MOVES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Constraints of all contact samples with one obstacle in ``total``: gap, normal, velocity, and whether it acts.

    ``within`` becomes one if a sample is closer than ``slack``, now or after a substep with its velocity ``moving``.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < places
    at = position + k * 3
    x = (tl.load(at, mask, 0.0), tl.load(at + 1, mask, 0.0), tl.load(at + 2, mask, 0.0))
    distance, normal, own = touch(x, row, whole, pose, grids, mask, KIND, MOVES)
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
