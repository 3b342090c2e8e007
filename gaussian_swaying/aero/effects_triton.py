"""Effects of the wind as Triton functions, for the fused substep.

The references are in ``aero.effects``, ``carried``, ``shelter`` and ``obstacles``; ``aero.effects_twin`` says what they
read.
"""

import triton
import triton.language as tl

from gaussian_swaying.aero.force_triton import force_on_group, force_on_patch
from gaussian_swaying.aero.obstacles_triton import past_cylinder, past_ellipsoid, past_sphere

HEADER = tl.constexpr(32)  # numbers of an effect
LOG, POWER, CARRIED, SHELTER = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2), tl.constexpr(3)
SPHERE, CYLINDER = tl.constexpr(4), tl.constexpr(5)


@triton.jit
def _corners(x, n, WRAPS: tl.constexpr):
    """The two rows of a table around a place on one axis, and the share of the second; n is a whole number.

    They lie in the table even if the place is NaN or infinite, as where a simulation diverges.
    """
    if not WRAPS:
        x = tl.minimum(tl.maximum(x, 0.0), n - 1)
    first = tl.floor(x)
    share = x - first
    if WRAPS:
        low = first - n * tl.floor(first / n)
        low = tl.where(low >= n, 0.0, low)
        high = tl.where(low + 1 >= n, 0.0, low + 1)
    else:
        low = first
        high = tl.minimum(first + 1, n - 1)
    last = n.to(tl.int32) - 1
    row = tl.minimum(tl.maximum(low.to(tl.int32), 0), last)
    return row, tl.minimum(tl.maximum(high.to(tl.int32), 0), last), share


@triton.jit
def _look_up(table, head, place, X: tl.constexpr, Y: tl.constexpr, Z: tl.constexpr, WIDTH: tl.constexpr):
    """Three values (or one and two zeros, for a WIDTH of one) of a table; ``head`` contains its three sizes.

    X, Y, Z: whether it repeats along each axis.
    """
    nx = tl.load(head)
    ny = tl.load(head + 1)
    nz = tl.load(head + 2)
    x0, x1, fx = _corners(place[0], nx, X)
    y0, y1, fy = _corners(place[1], ny, Y)
    z0, z1, fz = _corners(place[2], nz, Z)
    my = ny.to(tl.int32)
    mz = nz.to(tl.int32)
    zero = fx * 0
    a, b, c = zero, zero, zero
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            if i == 0:
                x = x0
                wx = 1 - fx
            else:
                x = x1
                wx = fx
            if j == 0:
                y = y0
                w = wx * (1 - fy)
            else:
                y = y1
                w = wx * fy
            line = (x * my + y) * mz
            low = table + (line + z0) * WIDTH
            high = table + (line + z1) * WIDTH
            w0 = w * (1 - fz)
            w1 = w * fz
            a += w0 * tl.load(low) + w1 * tl.load(high)
            if WIDTH == 3:
                b += w0 * tl.load(low + 1) + w1 * tl.load(high + 1)
                c += w0 * tl.load(low + 2) + w1 * tl.load(high + 2)
    return a, b, c


@triton.jit
def _turned(head, x):
    """A matrix of nine numbers times a vector."""
    return (
        tl.load(head) * x[0] + tl.load(head + 1) * x[1] + tl.load(head + 2) * x[2],
        tl.load(head + 3) * x[0] + tl.load(head + 4) * x[1] + tl.load(head + 5) * x[2],
        tl.load(head + 6) * x[0] + tl.load(head + 7) * x[1] + tl.load(head + 8) * x[2],
    )


@triton.jit
def shaped_wind(position, vector, space, OPTIONS: tl.constexpr):
    """Velocity of the air at some places: twin of ``WindField.shaped``.

    ``vector``: velocity without effects (3), place of the object's centre in a carried field [cells] (3), its strength,
    the mean flow (3), and the phases of the vortex streets (one each).

    ``OPTIONS`` after four others: number of effects, and five for each: its kind, where its table starts in ``space``,
    and whether that repeats along each axis; of an obstacle, whether it has a wake, and where in ``vector`` its street
    is, or 0.
    """
    zero = position[0] * 0
    v = (tl.load(vector) + zero, tl.load(vector + 1) + zero, tl.load(vector + 2) + zero)
    EFFECTS: tl.constexpr = OPTIONS[4]
    for m in tl.static_range(EFFECTS):
        head = space + HEADER * m
        if OPTIONS[5 + 5 * m] == LOG:
            above = tl.maximum(position[2] - tl.load(head), tl.load(head + 1))
            factor = tl.log(above / tl.load(head + 1)) * tl.load(head + 2)
            v = (v[0] * factor, v[1] * factor, v[2] * factor)
        elif OPTIONS[5 + 5 * m] == POWER:
            above = (position[2] - tl.load(head)) * tl.load(head + 1)
            factor = tl.exp(tl.load(head + 2) * tl.log(tl.where(above > 0, above, 1.0)))
            factor = tl.where(above > 0, factor, 0.0)
            v = (v[0] * factor, v[1] * factor, v[2] * factor)
        elif OPTIONS[5 + 5 * m] == CARRIED:
            p = _turned(head, position)
            p = (p[0] + tl.load(vector + 3), p[1] + tl.load(vector + 4), p[2] + tl.load(vector + 5))
            found = _look_up(
                space + OPTIONS[6 + 5 * m], head + 18, p, OPTIONS[7 + 5 * m], OPTIONS[8 + 5 * m], OPTIONS[9 + 5 * m], 3
            )
            strength = tl.load(vector + 6)
            found = _turned(head + 9, found)
            v = (v[0] + strength * found[0], v[1] + strength * found[1], v[2] + strength * found[2])
        elif OPTIONS[5 + 5 * m] == SPHERE:
            v = past_sphere(v, position, head, vector, OPTIONS[7 + 5 * m])
        elif OPTIONS[5 + 5 * m] == CYLINDER:
            v = past_cylinder(v, position, head, vector, OPTIONS[7 + 5 * m], OPTIONS[8 + 5 * m])
        elif OPTIONS[5 + 5 * m] == SHELTER:
            p = _turned(head, position)
            p = (p[0] + tl.load(head + 9), p[1] + tl.load(head + 10), p[2] + tl.load(head + 11))
            factor, _b, _c = _look_up(space + OPTIONS[6 + 5 * m], head + 18, p, False, False, False, 1)
            v = (v[0] * factor, v[1] * factor, v[2] * factor)
        else:
            v = past_ellipsoid(v, position, head, vector, OPTIONS[7 + 5 * m])
    return v


@triton.jit
def shaped_wind_force(F, velocity, position, patch, vector, numbers, space, OPTIONS: tl.constexpr):
    """As ``force_triton.wind_force``, in a wind with effects."""
    air = shaped_wind(position, vector, space, OPTIONS)
    return force_on_patch(F, velocity, patch, air, numbers, OPTIONS)


@triton.jit
def shaped_wind_on_groups(F, velocity, position, place, vector, numbers, space, OPTIONS: tl.constexpr):
    """As ``force_triton.wind_on_groups``, in a wind with effects."""
    air = shaped_wind(position, vector, space, OPTIONS)
    return force_on_group(F, velocity, place, air, numbers, OPTIONS)
