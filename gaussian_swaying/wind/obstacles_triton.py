"""Flow round bodies in the wind as Triton functions, for the fused substep.

The references are ``aero.obstacle_flow`` and ``aero.obstacles``. They compute in float32.
"""

from gaussian_swaying.geometry.linalg_triton import add3, chosen, cross3, dot3, matvec, scale3, transpose
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.wind import obstacle_flow

PLANE_GROWTH = tl.constexpr(obstacle_flow.PLANE_GROWTH)
ROUND_GROWTH = tl.constexpr(obstacle_flow.ROUND_GROWTH)
NEWTON = tl.constexpr(7)  # steps to the root for an ellipsoid: from two thirds of its distance to float32
DUPLICATIONS = tl.constexpr(5)  # of Carlson's integral, to float32


@triton.jit
def _direction(flow):
    """Unit vector of a flow, zero in still air, and its speed."""
    speed = tl.sqrt(dot3(flow, flow))
    scale = 1 / tl.maximum(speed, 1e-12)
    return (flow[0] * scale, flow[1] * scale, flow[2] * scale), speed


@triton.jit
def _only(where, v):
    return tl.where(where, v[0], 0.0), tl.where(where, v[1], 0.0), tl.where(where, v[2], 0.0)


@triton.jit
def round_wake(behind, aside, width, drag, start):
    """As ``obstacle_flow.round_wake``; ``start`` is its width at the body, per ``width``."""
    sigma = ROUND_GROWTH * tl.maximum(behind, 0.0) / width + start
    depth = 1 - tl.sqrt(tl.maximum(1 - drag / (8 * sigma * sigma), 0.0))
    far = aside / (width * sigma)
    return tl.where(behind > 0, depth * tl.exp(-0.5 * far * far), 0.0)


@triton.jit
def plane_wake(behind, aside, width, drag):
    """As ``obstacle_flow.plane_wake``."""
    thickness = 0.5 * drag * width
    least = 2 * thickness / 1.7724538509055159  # the square root of pi
    sigma = tl.maximum(tl.sqrt(thickness * tl.maximum(behind, 0.0)) * PLANE_GROWTH, least)
    depth = (1 - tl.sqrt(tl.maximum(1 - least / sigma, 0.0))) * 0.7071067811865476
    far = aside / sigma
    return tl.where(behind > 0, depth * tl.exp(-0.5 * far * far), 0.0)


@triton.jit
def past_cylinder(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``CylinderObstacle``; ``numbers``: middle (3), axis (3), radius, drag; ``now``: the mean flow.

    ``OPTIONS``: whether it has a wake.
    """
    radius = numbers[6]
    axis = (numbers[3], numbers[4], numbers[5])
    p = add3(x, -1.0, numbers)
    height = dot3(p, axis)
    away = add3(p, -height, axis)
    rising = dot3(v, axis)
    across = add3(v, -rising, axis)
    square = dot3(away, away)
    outside = square >= radius * radius
    square = tl.maximum(square, radius * radius)
    along = 2 * dot3(across, away) / square
    share = radius * radius / square
    v = add3(v, share, add3(across, -along, away))
    v = _only(outside, v)
    if OPTIONS[0]:
        rising = dot3(now, axis)
        direction, _ = _direction(add3(now, -rising, axis))
        left = cross3(axis, direction)
        behind = dot3(p, direction)
        aside = dot3(p, left)
        v = scale3(1 - plane_wake(behind, aside, 2 * radius, numbers[7]), v)
    return v


@triton.jit
def carlson_rd(x, y, z):
    """As ``obstacle_flow.carlson_rd``, to float32."""
    total = x * 0
    factor = 1.0
    for _step in range(DUPLICATIONS):
        rx = tl.sqrt(x)
        ry = tl.sqrt(y)
        rz = tl.sqrt(z)
        step = rx * ry + ry * rz + rz * rx
        total += factor / (rz * (z + step))
        factor *= 0.25
        x = 0.25 * (x + step)
        y = 0.25 * (y + step)
        z = 0.25 * (z + step)
    mean = (x + y + 3 * z) / 5
    a = 1 - x / mean
    b = 1 - y / mean
    c = 1 - z / mean
    e2 = a * b - 6 * c * c
    e3 = (3 * a * b - 8 * c * c) * c
    return 3 * total + factor * (1 - 3 / 14 * e2 + e3 / 6) / (mean * tl.sqrt(mean))


@triton.jit
def _over(x, a, root):
    return x[0] / (a[0] + root), x[1] / (a[1] + root), x[2] / (a[2] + root)


@triton.jit
def past_ellipsoid(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``EllipsoidObstacle``; ``now``: the mean flow; ``OPTIONS``: whether it has a wake.

    ``numbers``: middle (3), axes (9), size (its longest half axis), drag, start of the wake, the half axes per size
    (3), and ``ellipsoid_strength`` along each axis (3).
    """
    axes = chosen(numbers, 3, 9)
    size = numbers[12]
    r = chosen(numbers, 15, 3)
    p = add3(x, -1.0, numbers)
    q = matvec(axes, p)
    q = (q[0] / size, q[1] / size, q[2] / size)
    w = matvec(axes, v)
    a = (r[0] * r[0], r[1] * r[1], r[2] * r[2])
    outside = q[0] * q[0] / a[0] + q[1] * q[1] / a[1] + q[2] * q[2] / a[2] >= 1
    q = (tl.where(outside, q[0], r[0]), tl.where(outside, q[1], r[1]), tl.where(outside, q[2], r[2]))
    sides = tl.maximum(tl.maximum(q[0] * q[0] - a[0], q[1] * q[1] - a[1]), q[2] * q[2] - a[2])
    root = tl.maximum(tl.maximum(sides, dot3(q, q) - 1), 0.0)
    for _step in range(NEWTON):
        n = _over(q, a, root)
        root = tl.maximum(root + (dot3(q, n) - 1) / dot3(n, n), 0.0)
    s = (a[0] + root, a[1] + root, a[2] + root)
    n = _over(q, a, root)
    volume = r[0] * r[1] * r[2]
    third_of = 2 / 3 * volume
    strong = (numbers[18] * w[0], numbers[19] * w[1], numbers[20] * w[2])
    along = strong[0] * q[0] / s[0] + strong[1] * q[1] / s[1] + strong[2] * q[2] / s[2]
    steep = -2 * volume / tl.sqrt(s[0] * s[1] * s[2]) * along / dot3(n, n)
    w = (
        w[0] + strong[0] * third_of * carlson_rd(s[1], s[2], s[0]) + steep * n[0],
        w[1] + strong[1] * third_of * carlson_rd(s[2], s[0], s[1]) + steep * n[1],
        w[2] + strong[2] * third_of * carlson_rd(s[0], s[1], s[2]) + steep * n[2],
    )
    v = matvec(transpose(axes), _only(outside, w))
    if OPTIONS[0]:
        direction, _speed = _direction(now)
        flat = tl.maximum(tl.sqrt(direction[0] * direction[0] + direction[1] * direction[1]), 1e-12)
        side = (-direction[1] / flat, direction[0] / flat, 0.0)
        up = cross3(direction, side)
        wide = _across(side, axes, r) * size
        high = _across(up, axes, r) * size
        mean = tl.sqrt(tl.maximum(wide * high, 1e-12))
        left = dot3(p, side) * (mean / tl.maximum(wide, 1e-12))
        above = dot3(p, up) * (mean / tl.maximum(high, 1e-12))
        behind = dot3(p, direction) / mean
        aside = tl.sqrt(left * left + above * above) / mean
        v = scale3(1 - round_wake(behind, aside, 1.0, numbers[13], numbers[14]), v)
    return v


@triton.jit
def _across(direction, axes, r):
    along = matvec(axes, direction)
    half = (along[0] * r[0], along[1] * r[1], along[2] * r[2])
    return 2 * tl.sqrt(dot3(half, half))
