"""The force of the wind as a Triton function, for the fused substep. The reference is ``wind.force``."""

from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    chosen,
    cofactor,
    cross3,
    dot3,
    load3,
    matvec,
    read,
    scale3,
    transpose,
)
from gaussian_swaying.geometry.patches_triton import deform_patch
from gaussian_swaying.kernels.language import tl, triton


@triton.jit
def wind_terms(air, relative, facing, across, through, tangent, drag, friction, lift, LAW: tl.constexpr):
    """``force.wind_terms``: force per half density, and the resistance per half density and area.

    ``through`` is ``pressed`` there.
    """
    speed = tl.sqrt(dot3(relative, relative))
    blow = tl.sqrt(dot3(air, air)) if LAW == 2 else speed
    pressed = across
    pressure = drag * blow
    if LAW == 3:
        pressed = through
        pressure = drag
    if LAW == 0:
        pressed = facing
        pressure = drag * speed * speed
    shear = friction * speed
    side = cross3(relative, facing)
    lifting = lift * speed
    force = add3(axpy3(pressure, pressed, shear, tangent), lifting, side)
    return force, drag * blow + (friction + tl.abs(lift)) * speed


@triton.jit
def _changed_wind(m: tl.constexpr, EFFECTS: tl.constexpr, v, position, now, table):
    OPTIONS: tl.constexpr = EFFECTS.options[m]
    numbers = read(table, EFFECTS.numbers[m][0], EFFECTS.numbers[m][1])
    own = chosen(now, 3 + EFFECTS.per_substep[m][0], EFFECTS.per_substep[m][1])
    return EFFECTS.functions[m](v, position, numbers, own, table + EFFECTS.tables[m], OPTIONS)


@triton.jit
def shaped_wind(position, now, table, EFFECTS: tl.constexpr):
    """``WindField.shaped``: the wind with its effects, of which ``now`` has the velocity without them first."""
    v = (now[0], now[1], now[2])
    if len(EFFECTS.functions) > 0:
        zero = position[0] * 0
        v = (v[0] + zero, v[1] + zero, v[2] + zero)
    for m in tl.static_range(len(EFFECTS.functions)):
        v = _changed_wind(m, EFFECTS, v, position, now, table)
    return v


@triton.jit
def wind_force(F, velocity, position, patch, numbers, now, table, OPTIONS: tl.constexpr):
    """``WindForce`` on patches (normal and area at rest): force and resistance [kg/s].

    ``numbers``: C_D, C_F, C_L, half the density of the air, largest ratio of areas. ``now``: velocity without effects,
    and the numbers of each effect. ``OPTIONS``: place of the law in ``force.LAWS``, semi-implicit drag, effects.
    """
    EFFECTS: tl.constexpr = OPTIONS[2]
    air = shaped_wind(position, now, table, EFFECTS)
    normal, area = deform_patch(F, (patch[0], patch[1], patch[2]), patch[3], numbers[4])
    relative = add3(air, -1.0, velocity)
    along = dot3(relative, normal)
    sign = tl.where(along < 0, -1.0, 1.0)
    tangent = add3(relative, -along, normal)
    force, yielding = wind_terms(
        air, relative, scale3(sign, normal), scale3(along, normal), scale3(sign * along * along, normal), tangent,
        numbers[0], numbers[1], numbers[2], OPTIONS[0],
    )  # fmt: skip
    scale = numbers[3] * area
    resistance = area * 0
    if OPTIONS[1]:
        resistance = scale * yielding
    return scale3(scale, force), resistance


@triton.jit
def add_direction(s, q, b, w, LAW: tl.constexpr):
    """Add the area vector b to two sums.

    They are those of signed vectors, and (LAW 3) of b times the flow through it per
    area, times the size of that flow.
    """
    along = dot3(b, w)
    sign = tl.where(along < 0, -1.0, 1.0)
    s = (s[0] + sign * b[0], s[1] + sign * b[1], s[2] + sign * b[2])
    if LAW == 3:
        flow = sign * along * along / tl.maximum(dot3(b, b), 1.2e-38)
        q = (q[0] + flow * b[0], q[1] + flow * b[1], q[2] + flow * b[2])
    return s, q


@triton.jit
def sums_over_patches(table, first, count, w, LAW: tl.constexpr):
    """The rows of ``PatchSums`` of each point: tensor and its trace, and the sums of :func:`add_direction`."""
    real = count > 0
    t0 = tl.load(table + first, real, 0.0)
    t1 = tl.load(table + first + 1, real, 0.0)
    t2 = tl.load(table + first + 2, real, 0.0)
    t3 = tl.load(table + first + 3, real, 0.0)
    t4 = tl.load(table + first + 4, real, 0.0)
    t5 = tl.load(table + first + 5, real, 0.0)
    tensor = (t0, t1, t2, t1, t3, t4, t2, t4, t5)
    rest = t0 + t3 + t5
    zero = rest * 0
    s = (zero, zero, zero)
    q = (zero, zero, zero)
    for k in range(0, tl.max(count), 4):  # four rows at once
        row = first + 8 + 4 * k
        b0 = load3(table, 1, row, k < count)
        b1 = load3(table, 1, row + 4, k + 1 < count)
        b2 = load3(table, 1, row + 8, k + 2 < count)
        b3 = load3(table, 1, row + 12, k + 3 < count)
        s, q = add_direction(s, q, b0, w, LAW)
        s, q = add_direction(s, q, b1, w, LAW)
        s, q = add_direction(s, q, b2, w, LAW)
        s, q = add_direction(s, q, b3, w, LAW)
    return tensor, rest, s, q


@triton.jit
def wind_on_groups(F, velocity, position, place, numbers, now, table, OPTIONS: tl.constexpr):
    """``WindForce`` on groups of patches; the reference is ``aero.force.grouped_force``.

    ``place``: first row in the table of ``PatchSums``, which follows that of the effects, and number of vectors there.
    The rest is as in :func:`wind_force`.
    """
    EFFECTS: tl.constexpr = OPTIONS[2]
    air = shaped_wind(position, now, table, EFFECTS)
    first = EFFECTS.size + 4 * place[0].to(tl.int32)
    count = place[1].to(tl.int32)
    real = count > 0
    relative = add3(air, -1.0, velocity)
    drag, friction, lift, half_density, widest = numbers
    c = cofactor(F)
    w = matvec(transpose(c), relative)
    tensor, rest, s, q = sums_over_patches(table, first, count, w, OPTIONS[0])
    r0 = matvec(tensor, (c[0], c[1], c[2]))
    r1 = matvec(tensor, (c[3], c[4], c[5]))
    r2 = matvec(tensor, (c[6], c[7], c[8]))
    grown = c[0] * r0[0] + c[1] * r0[1] + c[2] * r0[2]
    grown += c[3] * r1[0] + c[4] * r1[1] + c[5] * r1[2]
    grown += c[6] * r2[0] + c[7] * r2[1] + c[8] * r2[2]
    growth = tl.sqrt(tl.maximum(grown / tl.maximum(rest, 1.2e-38), 1.2e-38))
    across = matvec(c, matvec(tensor, w))
    across = (across[0] / growth, across[1] / growth, across[2] / growth)
    facing = matvec(c, s)
    area = growth * rest
    through = across
    if OPTIONS[0] == 3:
        through = scale3(1.0 / (growth * growth), matvec(c, q))
    tangent = axpy3(area, relative, -1.0, across)
    force, yielding = wind_terms(air, relative, facing, across, through, tangent, drag, friction, lift, OPTIONS[0])
    scale = tl.where(real, half_density * tl.minimum(widest / growth, 1.0), 0.0)
    resistance = scale * 0
    if OPTIONS[1]:
        resistance = scale * area * yielding
    return scale3(scale, force), resistance


@triton.jit
def steady_force(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):
    """``added_mass.AirLift``: the numbers of a point are its force; no resistance."""
    return (point[0], point[1], point[2]), point[0] * 0
