"""Gradients of the force of the wind as a Triton function; the reference is torch's autograd of ``aero.wind_force``."""

import triton
import triton.language as tl

from gaussian_swaying.geometry.linalg_triton import cofactor_change, cross3, dot3
from gaussian_swaying.geometry.patches_triton import area_vector


@triton.jit
def _sum3(s, a, t, b):
    """S a + t b for vectors."""
    return (s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2])


@triton.jit
def force_adjoint(
    r, n, a, drag, friction, lift, PROJECTED: tl.constexpr, LIFT: tl.constexpr, UNIT: tl.constexpr
):  # fmt: skip
    """Gradients of a . f by relative wind, normal and coefficients, and a . f; f is per half density and area."""
    speed = tl.sqrt(dot3(r, r))
    inverse = 1.0 / tl.maximum(speed, 1e-30)
    square = speed * speed
    along = dot3(r, n)
    sign = tl.where(along < 0, -1.0, 1.0)
    g = dot3(a, n)
    # drag
    if PROJECTED:
        pressure = speed * along * g
        by_r = _sum3(drag * g * along * inverse, r, drag * g * speed, n)
        by_n = _sum3(drag * g * speed, r, drag * speed * along, a)
    else:
        pressure = square * sign * g
        by_r = (2 * drag * sign * g * r[0], 2 * drag * sign * g * r[1], 2 * drag * sign * g * r[2])
        by_n = (drag * square * sign * a[0], drag * square * sign * a[1], drag * square * sign * a[2])
    # friction
    t = _sum3(1.0, r, -along, n)
    if UNIT:
        size = tl.maximum(tl.sqrt(dot3(t, t)), 1e-18)  # finite where there is no tangent
        b = (t[0] / size, t[1] / size, t[2] / size)
        shear = dot3(a, b)
        w = ((a[0] - shear * b[0]) / size, (a[1] - shear * b[1]) / size, (a[2] - shear * b[2]) / size)
        wn = dot3(w, n)
        more = _sum3(2 * shear, r, square, _sum3(1.0, w, -wn, n))
        turn = _sum3(-square * wn, r, -square * along, w)
        shear = square * shear
    else:
        shear = dot3(a, t)
        more = _sum3(shear * inverse, r, speed, _sum3(1.0, a, -g, n))
        turn = _sum3(-speed * g, r, -speed * along, a)
        shear = speed * shear
    by_r = _sum3(1.0, by_r, friction, more)
    by_n = _sum3(1.0, by_n, friction, turn)
    # lift
    if LIFT:
        ar = dot3(a, r)
        side = sign * (square * g - along * ar)
        more = _sum3(1.0, _sum3(2 * g, r, -along, a), -ar, n)
        turn = _sum3(square, a, -ar, r)
    else:
        across = cross3(n, a)
        product = dot3(r, across)
        side = sign * speed * product
        more = _sum3(product * inverse, r, speed, across)
        turn = cross3(a, r)
        turn = (speed * turn[0], speed * turn[1], speed * turn[2])
    by_r = _sum3(1.0, by_r, sign * lift, more)
    by_n = _sum3(1.0, by_n, sign * lift, turn)
    return by_r, by_n, (pressure, shear, side), drag * pressure + friction * shear + lift * side


@triton.jit
def wind_force_adjoint(F, velocity, patch, wind, numbers, a, OPTIONS: tl.constexpr):
    """Gradients of a . f of ``force_triton.wind_force`` by F, by the velocity, by the wind and by the coefficients."""
    rest = (patch[0], patch[1], patch[2])
    vector, det = area_vector(F, rest)
    size = tl.sqrt(dot3(vector, vector))
    flat = size == 0
    scale = tl.where(det < 0, -1.0, 1.0) / tl.where(flat, 1.0, size)
    n = (
        tl.where(flat, rest[0], vector[0] * scale),
        tl.where(flat, rest[1], vector[1] * scale),
        tl.where(flat, rest[2], vector[2] * scale),
    )
    widest = tl.load(numbers + 4)
    relative = (
        tl.load(wind) - velocity[0],
        tl.load(wind + 1) - velocity[1],
        tl.load(wind + 2) - velocity[2],
    )
    drag = tl.load(numbers)
    friction = tl.load(numbers + 1)
    lift = tl.load(numbers + 2)
    by_r, by_n, parts, whole = force_adjoint(relative, n, a, drag, friction, lift, OPTIONS[0], OPTIONS[1], OPTIONS[2])
    half = tl.load(numbers + 3) * patch[3]
    area = half * tl.minimum(size, widest)
    # the unit normal and the area both come from the area vector
    growth = tl.where(size < widest, half * whole, 0.0) * tl.where(det < 0, -1.0, 1.0)
    turn = area * scale
    normal_part = dot3(by_n, n)
    v0 = turn * (by_n[0] - normal_part * n[0]) + growth * n[0]
    v1 = turn * (by_n[1] - normal_part * n[1]) + growth * n[1]
    v2 = turn * (by_n[2] - normal_part * n[2]) + growth * n[2]
    outer = (
        v0 * rest[0], v0 * rest[1], v0 * rest[2], v1 * rest[0], v1 * rest[1], v1 * rest[2],
        v2 * rest[0], v2 * rest[1], v2 * rest[2],
    )  # fmt: skip
    by_wind = (area * by_r[0], area * by_r[1], area * by_r[2])
    by_velocity = (-by_wind[0], -by_wind[1], -by_wind[2])
    return cofactor_change(F, outer), by_velocity, by_wind, (area * parts[0], area * parts[1], area * parts[2])
