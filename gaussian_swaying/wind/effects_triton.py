"""Effects of the wind as Triton functions; the references are in ``aero.effects``, ``carried`` and ``shelter``."""

from gaussian_swaying.geometry.linalg_triton import add3, chosen, matvec
from gaussian_swaying.kernels.language import tl, triton


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
def _look_up(table, sizes, place, X: tl.constexpr, Y: tl.constexpr, Z: tl.constexpr, WIDTH: tl.constexpr):
    """Three values (or one and two zeros, for a WIDTH of one) of a table.

    X, Y, Z: whether it repeats along each axis.
    """
    x0, x1, fx = _corners(place[0], sizes[0], X)
    y0, y1, fy = _corners(place[1], sizes[1], Y)
    z0, z1, fz = _corners(place[2], sizes[2], Z)
    my = sizes[1].to(tl.int32)
    mz = sizes[2].to(tl.int32)
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
def log_profile(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``LogProfile``; ``numbers``: height of the ground, roughness, one over the logarithm."""
    above = tl.maximum(x[2] - numbers[0], numbers[1])
    factor = tl.log(above / numbers[1]) * numbers[2]
    return v[0] * factor, v[1] * factor, v[2] * factor


@triton.jit
def power_profile(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``PowerProfile``; ``numbers``: height of the ground, one over the height, exponent."""
    above = (x[2] - numbers[0]) * numbers[1]
    factor = tl.exp(numbers[2] * tl.log(tl.where(above > 0, above, 1.0)))
    factor = tl.where(above > 0, factor, 0.0)
    return v[0] * factor, v[1] * factor, v[2] * factor


@triton.jit
def plume(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``Plume``; ``numbers``: its source (3), height of the source above the point, speed, spread."""
    a = x[0] - numbers[0]
    b = x[1] - numbers[1]
    above = x[2] - numbers[2]
    height = tl.maximum(above, 0.0) + numbers[3]
    off = numbers[5] * (a * a + b * b) / (height * height)
    fall = tl.exp(-off)
    share = tl.where(off < 1e-2, 1 - off / 2 + off * off / 6, (1 - fall) / tl.maximum(off, 1e-2))
    up = numbers[4] * tl.exp(-tl.log(height) / 3)
    up = tl.where(above >= 0, up, 0.0)
    drawn = up / height * (fall - 5 / 6 * share)
    return v[0] + drawn * a, v[1] + drawn * b, v[2] + up * fall


@triton.jit
def carried_field(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``CarriedField``; ``numbers``: from places to cells (9), from its axes (9), its sizes (3).

    ``now``: place of the object's centre [cells] (3), strength. ``OPTIONS``: whether it repeats along each axis.
    """
    p = add3(matvec(numbers, x), 1.0, now)
    found = _look_up(table, chosen(numbers, 18, 3), p, OPTIONS[0], OPTIONS[1], OPTIONS[2], 3)
    found = matvec(chosen(numbers, 9, 9), found)
    return add3(v, now[3], found)


@triton.jit
def sheltered(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``Shelter``; ``numbers``: from places to cells (9), shift (3), sizes (3)."""
    p = matvec(numbers, x)
    p = (p[0] + numbers[9], p[1] + numbers[10], p[2] + numbers[11])
    factor, _b, _c = _look_up(table, chosen(numbers, 12, 3), p, False, False, False, 1)
    return v[0] * factor, v[1] * factor, v[2] * factor
