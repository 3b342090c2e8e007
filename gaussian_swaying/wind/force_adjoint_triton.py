"""Gradients of the force of the wind as a Triton function; the reference is torch's autograd of ``wind.force``."""

from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    axpy9,
    cofactor,
    cofactor_change,
    cross3,
    dot3,
    load3,
    matmul,
    matvec,
    outer3,
    scale3,
    transpose,
)
from gaussian_swaying.geometry.patches_triton import area_vector
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.wind.force_triton import sums_over_patches


@triton.jit
def wind_terms_adjoint(air, r, facing, across, through, tangent, a, drag, friction, lift, LAW: tl.constexpr):
    """Gradients of a . f of ``force_triton.wind_terms`` by its first six arguments and by drag, friction and lift."""
    speed = tl.sqrt(dot3(r, r))
    inverse = 1.0 / tl.maximum(speed, 1e-30)
    square = speed * speed
    af = dot3(a, facing)
    at = dot3(a, tangent)
    zero = square * 0
    by_air = (zero, zero, zero)
    by_facing = (zero, zero, zero)
    by_across = (zero, zero, zero)
    by_through = (zero, zero, zero)
    if LAW == 0:
        pressure = square * af
        by_r = scale3(2 * drag * af, r)
        by_facing = scale3(drag * square, a)
    elif LAW == 3:
        pressure = dot3(a, through)
        by_r = by_air
        by_through = scale3(drag, a)
    else:
        ac = dot3(a, across)
        if LAW == 2:
            blow = tl.sqrt(dot3(air, air))
            by_r = by_air
            by_air = scale3(drag * ac / tl.maximum(blow, 1e-30), air)
        else:
            blow = speed
            by_r = scale3(drag * ac * inverse, r)
        pressure = blow * ac
        by_across = scale3(drag * blow, a)
    shear = speed * at
    by_r = add3(by_r, friction * at * inverse, r)
    by_tangent = scale3(friction * speed, a)
    turn = cross3(facing, a)
    product = dot3(r, turn)
    side = speed * product
    by_r = add3(by_r, lift, axpy3(product * inverse, r, speed, turn))
    by_facing = add3(by_facing, lift * speed, cross3(a, r))
    return by_air, by_r, by_facing, by_across, by_through, by_tangent, (pressure, shear, side)


@triton.jit
def wind_force_adjoint(F, velocity, patch, numbers, air, table, a, OPTIONS: tl.constexpr):
    """Gradients of a . f of ``force_triton.wind_force`` by F, velocity, wind and coefficients; without effects."""
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
    drag, friction, lift, half_density, widest = numbers
    relative = add3(air, -1.0, velocity)
    along = dot3(relative, n)
    sign = tl.where(along < 0, -1.0, 1.0)
    tangent = add3(relative, -along, n)
    by_air, by_r, by_facing, by_across, by_through, by_tangent, parts = wind_terms_adjoint(
        air, relative, scale3(sign, n), scale3(along, n), scale3(sign * along * along, n), tangent, a,
        drag, friction, lift, OPTIONS[0],
    )  # fmt: skip
    by_across = add3(by_across, -1.0, by_tangent)
    by_along = dot3(by_across, n)
    by_n = axpy3(sign, by_facing, along, by_across)
    if OPTIONS[0] == 3:
        by_along += 2 * sign * along * dot3(by_through, n)
        by_n = add3(by_n, sign * along * along, by_through)
    by_r = add3(add3(by_r, 1.0, by_tangent), by_along, n)
    by_n = add3(by_n, by_along, relative)
    whole = drag * parts[0] + friction * parts[1] + lift * parts[2]
    half = half_density * patch[3]
    area = half * tl.minimum(size, widest)
    # the unit normal and the area both come from the area vector
    growth = tl.where(size < widest, half * whole, 0.0) * tl.where(det < 0, -1.0, 1.0)
    turn = area * scale
    normal_part = dot3(by_n, n)
    v = axpy3(turn, add3(by_n, -normal_part, n), growth, n)
    by_wind = scale3(area, by_r)
    by_velocity = scale3(-1.0, by_wind)
    if OPTIONS[0] == 2:
        by_wind = add3(by_wind, area, by_air)
    by_F = cofactor_change(F, outer3(v, rest))
    return by_F, by_velocity, by_wind, scale3(area, parts)


@triton.jit
def flow_adjoint(table, first, count, w, by_q):
    """Gradient by w of the last sum of ``force_triton.sums_over_patches`` times a vector."""
    zero = w[0] * 0
    by_w = (zero, zero, zero)
    for k in range(0, tl.max(count)):
        known = k < count
        b = load3(table, 1, first + 8 + 4 * k, known)
        share = 2 * tl.abs(dot3(b, w)) * dot3(b, by_q) / tl.maximum(dot3(b, b), 1.2e-38)
        by_w = add3(by_w, tl.where(known, share, 0.0), b)
    return by_w


@triton.jit
def wind_on_groups_adjoint(F, velocity, place, numbers, air, table, a, OPTIONS: tl.constexpr):
    """As :func:`wind_force_adjoint`, for ``force_triton.wind_on_groups``.

    The names are those of ``aero.force.grouped_force``; the sum over the sides that the patches show is constant.
    """
    first = 4 * place[0].to(tl.int32)
    count = place[1].to(tl.int32)
    real = count > 0
    r = add3(air, -1.0, velocity)
    drag, friction, lift, half, widest = numbers
    c = cofactor(F)
    w = matvec(transpose(c), r)
    tensor, rest, s, q = sums_over_patches(table, first, count, w, OPTIONS[0])
    turned = matmul(c, tensor)
    # a lane without patches gets an area, whose force is multiplied by zero
    whole = tl.where(real, rest, 1.0)
    grown = (
        turned[0] * c[0] + turned[1] * c[1] + turned[2] * c[2] + turned[3] * c[3] + turned[4] * c[4]
        + turned[5] * c[5] + turned[6] * c[6] + turned[7] * c[7] + turned[8] * c[8]
    )  # fmt: skip
    growth = tl.where(real, tl.sqrt(tl.maximum(grown / whole, 1.2e-38)), 1.0)
    across = matvec(turned, w)
    across = (across[0] / growth, across[1] / growth, across[2] / growth)
    facing = matvec(c, s)
    area = growth * rest
    through = across
    if OPTIONS[0] == 3:
        through = scale3(1.0 / (growth * growth), matvec(c, q))
    tangent = axpy3(area, r, -1.0, across)
    by_air, by_r, by_facing, by_across, by_through, by_tangent, parts = wind_terms_adjoint(
        air, r, facing, across, through, tangent, a, drag, friction, lift, OPTIONS[0]
    )
    by_r = add3(by_r, area, by_tangent)
    by_across = add3(by_across, -1.0, by_tangent)
    by_area = dot3(by_tangent, r)
    total = drag * parts[0] + friction * parts[1] + lift * parts[2]
    cap = tl.minimum(widest / growth, 1.0)
    by_growth = by_area * rest - dot3(by_across, across) / growth - tl.where(growth > widest, total / growth, 0.0)
    scaled = (by_across[0] / growth, by_across[1] / growth, by_across[2] / growth)
    by_w = matvec(transpose(turned), scaled)
    by_pressed = scale3(1.0 / (growth * growth), by_through)
    if OPTIONS[0] == 3:
        by_growth -= 2 * dot3(by_through, through) / growth
        by_w = add3(by_w, 1.0, flow_adjoint(table, first, count, w, matvec(transpose(c), by_pressed)))
    by_r = add3(by_r, 1.0, matvec(c, by_w))
    by_grown = by_growth / (2 * growth * whole)
    by_turned = axpy9(1.0, outer3(scaled, w), by_grown, c)
    by_c = axpy9(1.0, outer3(by_facing, s), 1.0, matmul(by_turned, tensor))
    by_c = axpy9(1.0, by_c, 1.0, outer3(r, by_w))
    if OPTIONS[0] == 3:
        by_c = axpy9(1.0, by_c, 1.0, outer3(by_pressed, q))
    by_c = axpy9(1.0, by_c, by_grown, turned)
    scale = tl.where(real, half * cap, 0.0)
    by_c = axpy9(scale, by_c, 0.0, c)
    by_wind = scale3(scale, by_r)
    by_velocity = scale3(-1.0, by_wind)
    if OPTIONS[0] == 2:
        by_wind = add3(by_wind, scale, by_air)
    return cofactor_change(F, by_c), by_velocity, by_wind, scale3(scale, parts)
