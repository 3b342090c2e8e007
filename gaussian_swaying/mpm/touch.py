"""Planes and obstacles as device functions.

The numbers of each solid begin with its gap, its friction and the place of its centre (3). One that moves has
:data:`POSE` numbers of each substep: place of the centre (3), rotation (9), and the velocity of what is at an offset
from the centre: a matrix (9) and the velocity of the centre (3).
"""

from gaussian_swaying.geometry.linalg_triton import add3, dot3, matvec, read, transpose
from gaussian_swaying.kernels.language import tl, triton

POSE = tl.constexpr(24)


@triton.jit
def touch(x, numbers, rows, step, mask, SOLIDS: tl.constexpr, w: tl.constexpr):
    """Distance from solid w less its gap, its normal, and its velocity at places x."""
    MOVES: tl.constexpr = SOLIDS.per_substep[w][1] > 0
    own_numbers = numbers + SOLIDS.numbers[w][0]
    pose = own_numbers + 2
    if MOVES:
        pose = rows + step * SOLIDS.width + SOLIDS.per_substep[w][0]
    x = (x[0] - tl.load(pose), x[1] - tl.load(pose + 1), x[2] - tl.load(pose + 2))
    own = x
    if MOVES:
        own = matvec(transpose(read(pose, 3, 9)), x)
    shape = read(own_numbers, 5, SOLIDS.numbers[w][1] - 5)
    OPTIONS: tl.constexpr = SOLIDS.options[w]
    distance, normal = SOLIDS.functions[w](own, shape, numbers + SOLIDS.tables[w], mask, OPTIONS)
    zero = x[0] * 0
    drive = (zero, zero, zero)
    if MOVES:
        normal = matvec(read(pose, 3, 9), normal)
        drive = matvec(read(pose, 12, 9), x)
        drive = (drive[0] + tl.load(pose + 21), drive[1] + tl.load(pose + 22), drive[2] + tl.load(pose + 23))
    return distance - tl.load(own_numbers), normal, drive


@triton.jit
def stopped(v, n, kind: tl.constexpr, friction):
    """Velocity in contact with a plane at rest; ``kind`` is a number of ``colliders.KINDS``."""
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
    v, x, numbers, rows, step, mask, SOLIDS: tl.constexpr, w: tl.constexpr, KIND: tl.constexpr
):  # fmt: skip
    """Velocity of nodes at x in contact with solid w, and which of them are; KIND of ``colliders.KINDS``."""
    friction = tl.load(numbers + SOLIDS.numbers[w][0] + 1)
    distance, n, own = touch(x, numbers, rows, step, mask, SOLIDS, w)
    if SOLIDS.per_substep[w][1] > 0:
        held = stopped(add3(v, -1.0, own), n, KIND, friction)
        held = add3(held, 1.0, own)
    else:
        held = stopped(v, n, KIND, friction)
    return held, distance <= 0


@triton.jit
def acts(window, now):
    """True if a solid acts at a time, from its first and last time."""
    now = now + 1e-9  # boundary.CLOCK
    return (now >= tl.load(window)) & (now < tl.load(window + 1))
