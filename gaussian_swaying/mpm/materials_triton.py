"""The materials as Triton functions of one particle per lane, for the fused substep.

The definitions are :mod:`~gaussian_swaying.mpm.constitutive`, :mod:`~gaussian_swaying.mpm.plasticity` and
:mod:`~gaussian_swaying.mpm.damping`; what is written here follows them line by line and is tested against them.
"""

import math
from collections.abc import Iterable

import triton
import triton.language as tl

from gaussian_swaying.mpm import materials
from gaussian_swaying.mpm.constitutive import FLUID_LIMIT, LOG_LIMIT, SNOW_RANGE
from gaussian_swaying.mpm.linalg_triton import (
    axpy9,
    clamp,
    cofactor,
    dot3,
    largest,
    largest_eigenvalue,
    matmul,
    polar_rotation,
    scale9,
    scaled_product,
    square9,
    svd3,
    transpose,
    where3,
    where9,
)
from gaussian_swaying.mpm.plasticity import cone_slope

LOG_FLOOR = tl.constexpr(LOG_LIMIT)
LOG_OF_FLOOR = tl.constexpr(math.log(LOG_LIMIT))
FLUID_FLOOR = tl.constexpr(FLUID_LIMIT)
SNOW_LOW = tl.constexpr(SNOW_RANGE[0])
SNOW_HIGH = tl.constexpr(SNOW_RANGE[1])
ROOT = tl.constexpr((2 / 3) ** 0.5)
EPSILON = tl.constexpr(2**-23)  # of float32

# kinds of law, one bit each; a body's laws are a mask of them
FIXED_COROTATED = tl.constexpr(1)
NEO_HOOKEAN = tl.constexpr(2)
HENCKY = tl.constexpr(4)
SAND = tl.constexpr(8)
VON_MISES = tl.constexpr(16)
FOAM = tl.constexpr(32)
SNOW = tl.constexpr(64)
FLUID = tl.constexpr(128)
NETWORK = tl.constexpr(256)
PLASTIC_KINDS = tl.constexpr(8 + 16 + 32 + 64 + 128)
SPECTRAL_KINDS = tl.constexpr(4 + 8 + 16 + 32 + 64 + 128 + 256)
HENCKY_KINDS = tl.constexpr(4 + 8 + 16 + 32)  # whose energy is Hencky's


def law_row(law: materials.ConstitutiveLaw) -> tuple[int, list[float]] | None:
    """Kind and four parameters of a law of this package; None for any other, which has no fused form."""
    kind, values = None, []
    if type(law) is materials.FixedCorotated:
        kind = FIXED_COROTATED
    elif type(law) is materials.NeoHookean:
        kind = NEO_HOOKEAN
    elif type(law) is materials.StVKHencky:
        kind = HENCKY
    elif type(law) is materials.SpringNetwork:
        kind = NETWORK
    elif type(law) is materials.Sand:
        kind, values = SAND, [cone_slope(law.friction_angle), 0.0 if law.internal is None else 1.0]
    elif type(law) is materials.Metal:
        kind, values = VON_MISES, [law.yield_stress, law.hardening, 0.0]
    elif type(law) is materials.Plasticine:
        kind, values = VON_MISES, [law.yield_stress, -law.softening, law.residual]
    elif type(law) is materials.Foam:
        kind, values = FOAM, [law.yield_stress, law.viscosity]
    elif type(law) is materials.Snow:
        kind, values = SNOW, [law.critical_compression, law.critical_stretch, law.hardening]
    elif type(law) is materials.Fluid:
        kind, values = FLUID, [law.gamma]
    if kind is None:
        return None
    return kind.value, [float(v) for v in values] + [0.0] * (4 - len(values))


def energy_kind(laws: Iterable[materials.ConstitutiveLaw]) -> int:
    """The ``KIND`` of :func:`wave_modulus` and :func:`energy_density` that holds for all laws of a body; 0 if none."""
    kinds = 0
    for law in laws:
        row = law_row(law)
        if row is None:
            return 0
        kinds |= HENCKY.value if row[0] & HENCKY_KINDS.value else row[0]
    return kinds if kinds in (FIXED_COROTATED.value, HENCKY.value, NETWORK.value) else 0


@triton.jit
def _log(x):
    """``constitutive.continued_log``."""
    inside = tl.maximum(x, LOG_FLOOR)
    return tl.log(inside) + (x - inside) / LOG_FLOOR


@triton.jit
def _exp(x):
    """``plasticity._stretch``."""
    return tl.exp(tl.maximum(x, LOG_OF_FLOOR))


@triton.jit
def _hencky(a, mu, lam):
    """Principal first Piola-Kirchhoff stresses of the Hencky energy."""
    l0 = _log(a[0])
    l1 = _log(a[1])
    l2 = _log(a[2])
    pressure = lam * (l0 + l1 + l2)
    return (
        (2 * mu * l0 + pressure) / tl.maximum(a[0], LOG_FLOOR),
        (2 * mu * l1 + pressure) / tl.maximum(a[1], LOG_FLOOR),
        (2 * mu * l2 + pressure) / tl.maximum(a[2], LOG_FLOOR),
    )


@triton.jit
def _corotated(a, mu, lam):
    """Principal first Piola-Kirchhoff stresses of the fixed corotated energy."""
    pressure = lam * (a[0] * a[1] * a[2] - 1)
    return (
        2 * mu * (a[0] - 1) + pressure * a[1] * a[2],
        2 * mu * (a[1] - 1) + pressure * a[2] * a[0],
        2 * mu * (a[2] - 1) + pressure * a[0] * a[1],
    )


@triton.jit
def _pull(x):
    """(l - 1) / l of a spring from the square of its length, which goes on as its tangent when small."""
    inside = tl.maximum(x, LOG_FLOOR * LOG_FLOOR)
    root = tl.sqrt(inside)
    return 1 + (x - inside) / (2 * inside) - 1 / root


@triton.jit
def _network(a, mu, lam):
    """``constitutive._network_slope``."""
    least = tl.maximum(tl.minimum(mu, lam), 0.0)
    s0 = a[0] * a[0]
    s1 = a[1] * a[1]
    s2 = a[2] * a[2]
    across0 = _pull((s1 + s2) / 2)
    across1 = _pull((s0 + s2) / 2)
    across2 = _pull((s0 + s1) / 2)
    whole = 3.0 / 35 * _pull((s0 + s1 + s2) / 3)
    pressure = (lam - least) * (a[0] + a[1] + a[2] - 3)
    direct = 10.0 / 7 * least + 2 * (mu - least)
    network = 15 * least
    return (
        direct * (a[0] - 1) + network * a[0] * (8.0 / 105 * (across1 + across2) + whole) + pressure,
        direct * (a[1] - 1) + network * a[1] * (8.0 / 105 * (across0 + across2) + whole) + pressure,
        direct * (a[2] - 1) + network * a[2] * (8.0 / 105 * (across0 + across1) + whole) + pressure,
    )


@triton.jit
def _neo_hookean_pk1(F, mu, lam):
    """``constitutive.neo_hookean_pk1``."""
    cof = cofactor(F)
    det = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]
    return axpy9(mu, F, (lam * _log(det) - mu) / tl.maximum(det, LOG_FLOOR), cof)


@triton.jit
def _fluid_kirchhoff(F, mu, lam, gamma):
    """Minus pressure times J, ``constitutive.fluid_kirchhoff``."""
    cof = cofactor(F)
    det = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]
    bulk = lam + 2.0 / 3.0 * mu
    inside = tl.maximum(det, FLUID_FLOOR)
    power = tl.exp(-gamma * tl.log(inside))
    return -det * (bulk / gamma * (power - 1) - bulk * power / inside * (det - inside))


@triton.jit
def pk1(F, mu, lam, kind, KINDS: tl.constexpr):
    """First Piola-Kirchhoff stress of the elastic laws."""
    if (HENCKY & KINDS) or (NETWORK & KINDS):
        u, a, v = svd3(F)
        y = _hencky(a, mu, lam)
        if NETWORK & KINDS:
            y = where3(kind == NETWORK, _network(a, mu, lam), y)
        if FIXED_COROTATED & KINDS:
            y = where3(kind == FIXED_COROTATED, _corotated(a, mu, lam), y)
        stress = scaled_product(u, y, v)
        if NEO_HOOKEAN & KINDS:
            stress = where9(kind == NEO_HOOKEAN, _neo_hookean_pk1(F, mu, lam), stress)
    elif NEO_HOOKEAN == KINDS:
        stress = _neo_hookean_pk1(F, mu, lam)
    else:
        cof = cofactor(F)
        pressure = lam * (F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2] - 1)
        stress = axpy9(2 * mu, axpy9(1.0, F, -1.0, polar_rotation(F)), pressure, cof)
        if NEO_HOOKEAN & KINDS:
            stress = where9(kind == NEO_HOOKEAN, _neo_hookean_pk1(F, mu, lam), stress)
    return stress


@triton.jit
def principal_kirchhoff(a, mu, lam, internal, kind, p2, KINDS: tl.constexpr):
    """Principal Kirchhoff stresses of the laws that are functions of the stretches; fluids are not among them."""
    y = _hencky(a, mu, lam)
    if NETWORK & KINDS:
        y = where3(kind == NETWORK, _network(a, mu, lam), y)
    if (FIXED_COROTATED & KINDS) or (SNOW & KINDS):
        solid = kind == FIXED_COROTATED
        if SNOW & KINDS:
            snow = kind == SNOW
            packed = tl.minimum(tl.maximum(internal, SNOW_LOW), SNOW_HIGH)
            factor = tl.where(snow, tl.exp(p2 * (1 - packed)), 1.0)
            y = where3(solid | snow, _corotated(a, mu * factor, lam * factor), y)
        else:
            y = where3(solid, _corotated(a, mu, lam), y)
    return (y[0] * a[0], y[1] * a[1], y[2] * a[2])


@triton.jit
def _deviator(e0, e1, e2):
    """Trace, deviator, its norm and its direction (``plasticity._split``)."""
    trace = e0 + e1 + e2
    d = (e0 - trace / 3, e1 - trace / 3, e2 - trace / 3)
    squared = dot3(d, d)
    some = squared > 1.4210855e-14  # the square of float32's epsilon, as in the definition
    norm = tl.where(some, tl.sqrt(tl.where(some, squared, 1.0)), 0.0)
    scale = 1.0 / tl.where(some, norm, 1.0)
    return trace, d, norm, (d[0] * scale, d[1] * scale, d[2] * scale)


@triton.jit
def _drawn_back(trace, d, direction, flow):
    """Stretches after a flow along the deviator."""
    mean = trace / 3
    return (
        _exp(d[0] - flow * direction[0] + mean),
        _exp(d[1] - flow * direction[1] + mean),
        _exp(d[2] - flow * direction[2] + mean),
    )


@triton.jit
def _sand(a, mu, lam, internal, slope, corrected):
    """``plasticity.drucker_prager``."""
    given = internal * corrected
    third = given / 3
    l0 = _log(a[0])
    l1 = _log(a[1])
    l2 = _log(a[2])
    trace, d, norm, direction = _deviator(l0 + third, l1 + third, l2 + third)
    excess = norm + slope * (3 * lam + 2 * mu) / (2 * mu) * trace
    grown = tl.exp(third)
    flowed = _drawn_back(trace, d, direction, tl.maximum(excess, 0.0))
    new = where3(excess <= 0, (a[0] * grown, a[1] * grown, a[2] * grown), flowed)
    one = a[0] * 0 + 1
    new = where3(trace > 0, (one, one, one), new)
    change = l0 + l1 + l2 - _log(new[0]) - _log(new[1]) - _log(new[2])
    return new, internal + corrected * change


@triton.jit
def _von_mises(a, mu, internal, yield_stress, hardening, residual):
    """``plasticity.von_mises``."""
    trace, d, norm, direction = _deviator(_log(a[0]), _log(a[1]), _log(a[2]))
    trial = 2 * mu * norm
    line = yield_stress + hardening * internal
    stiffness = 2 * mu + 2.0 / 3.0 * hardening
    floor_flow = (trial - ROOT * residual) / (2 * mu)
    line_flow = (trial - ROOT * line) / tl.where(stiffness > 0, stiffness, 1.0)
    flow = tl.where(stiffness > 0, tl.minimum(line_flow, floor_flow), floor_flow)
    yields = trial > tl.maximum(line, residual) * ROOT
    flow = tl.where(yields, flow, 0.0)
    return where3(yields, _drawn_back(trace, d, direction, flow), a), internal + ROOT * flow


@triton.jit
def _foam(a, mu, yield_stress, viscosity, dt):
    """``plasticity.viscoplastic``."""
    trace, d, norm, direction = _deviator(_log(a[0]), _log(a[1]), _log(a[2]))
    over = 2 * mu * norm - ROOT * yield_stress
    x = -2 * mu * dt / tl.maximum(viscosity, 1e-30)
    # one minus exp(x) without loss of digits for a short substep
    series = -x * (1 + x * (0.5 + x * (1.0 / 6 + x * (1.0 / 24 + x / 120))))
    relaxed = tl.where(tl.abs(x) < 0.1, series, 1 - tl.exp(x))
    relaxed = tl.where(viscosity > 0, relaxed, 1.0)
    flow = tl.maximum(over, 0.0) * relaxed / (2 * mu)
    return where3(over > 0, _drawn_back(trace, d, direction, flow), a)


@triton.jit
def return_map(a, mu, lam, internal, kind, p0, p1, p2, dt, KINDS: tl.constexpr):
    """Principal stretches and internal variable after plastic flow."""
    new = a
    inner = internal
    if SAND & KINDS:
        values, memory = _sand(a, mu, lam, internal, p0, p1)
        new = where3(kind == SAND, values, new)
        inner = tl.where(kind == SAND, memory, inner)
    if VON_MISES & KINDS:
        values, memory = _von_mises(a, mu, internal, p0, p1, p2)
        new = where3(kind == VON_MISES, values, new)
        inner = tl.where(kind == VON_MISES, memory, inner)
    if FOAM & KINDS:
        new = where3(kind == FOAM, _foam(a, mu, p0, p1, dt), new)
    if SNOW & KINDS:
        low = 1 - p0
        high = 1 + p1
        kept = (clamp(a[0], low, high), clamp(a[1], low, high), clamp(a[2], low, high))
        lost = a[0] / kept[0] * (a[1] / kept[1]) * (a[2] / kept[2])
        new = where3(kind == SNOW, kept, new)
        inner = tl.where(kind == SNOW, clamp(internal * lost, SNOW_LOW, SNOW_HIGH), inner)
    if FLUID & KINDS:
        volume = tl.maximum(a[0] * a[1] * a[2], LOG_FLOOR)
        root = tl.exp(tl.log(volume) / 3)
        new = where3(kind == FLUID, (root, root, root), new)
    return new, inner


@triton.jit
def kirchhoff(F, mu, lam, internal, kind, p0, p1, p2, dt, KINDS: tl.constexpr, FLOW: tl.constexpr):
    """Kirchhoff stress after the return map, from one decomposition.

    Returns the elastic F and the internal variable after plastic flow (with FLOW; else as given), and the stress.
    """
    if SPECTRAL_KINDS & KINDS:
        u, a, v = svd3(F)
        if FLOW and (PLASTIC_KINDS & KINDS):
            a, internal = return_map(a, mu, lam, internal, kind, p0, p1, p2, dt, KINDS)
            F = where9((kind > HENCKY) & (kind < NETWORK), scaled_product(u, a, v), F)
        stress = scaled_product(u, principal_kirchhoff(a, mu, lam, internal, kind, p2, KINDS), u)
        if NEO_HOOKEAN & KINDS:
            other = matmul(_neo_hookean_pk1(F, mu, lam), transpose(F))
            stress = where9(kind == NEO_HOOKEAN, other, stress)
        if FLUID & KINDS:
            value = _fluid_kirchhoff(F, mu, lam, p0)
            zero = value * 0
            diagonal = (value, zero, zero, zero, value, zero, zero, zero, value)
            stress = where9(kind == FLUID, diagonal, stress)
    else:
        stress = matmul(pk1(F, mu, lam, kind, KINDS), transpose(F))
    return F, internal, stress


@triton.jit
def _root(x):
    """``constitutive._continued_root``."""
    inside = tl.maximum(x, LOG_FLOOR * LOG_FLOOR)
    root = tl.sqrt(inside)
    return root + (x - inside) / (2 * root)


@triton.jit
def energy_density(F, mu, lam, KIND: tl.constexpr):
    """Energy density [J/m³] of fixed corotated bodies, networks of springs or Hencky's."""
    if KIND == FIXED_COROTATED:
        cof = cofactor(F)
        change = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2] - 1
        energy = mu * square9(axpy9(1.0, F, -1.0, polar_rotation(F))) + 0.5 * lam * change * change
    else:
        _u, a, _v = svd3(F)
        if KIND == NETWORK:
            least = tl.maximum(tl.minimum(mu, lam), 0.0)
            s0 = a[0] * a[0]
            s1 = a[1] * a[1]
            s2 = a[2] * a[2]
            d = (a[0] - 1, a[1] - 1, a[2] - 1)
            plane = (_root((s1 + s2) / 2) - 1, _root((s0 + s2) / 2) - 1, _root((s0 + s1) / 2) - 1)
            space = _root((s0 + s1 + s2) / 3) - 1
            axes = dot3(d, d)
            mean = 2.0 / 21 * axes + 16.0 / 105 * dot3(plane, plane) + 9.0 / 35 * space * space
            trace = d[0] + d[1] + d[2]
            energy = 7.5 * least * mean + (mu - least) * axes + 0.5 * (lam - least) * trace * trace
        else:
            log = (_log(a[0]), _log(a[1]), _log(a[2]))
            total = log[0] + log[1] + log[2]
            energy = mu * dot3(log, log) + 0.5 * lam * total * total
    return energy


@triton.jit
def _share_above(x, y, floor):
    """Share of the way from y to x that lies above a floor."""
    gap = x - y
    none = gap == 0
    above = (tl.maximum(x, floor) - tl.maximum(y, floor)) / tl.where(none, 1.0, gap)
    return tl.where(none, tl.where(x < floor, 0.0, 1.0), above)


@triton.jit
def _log_difference(x, y):
    """(log x - log y) / (x - y) of the continued logarithm, to round-off where x and y are near each other too."""
    share = _share_above(x, y, LOG_FLOOR)
    x = tl.maximum(x, LOG_FLOOR)
    y = tl.maximum(y, LOG_FLOOR)
    ratio = (x - y) / (x + y)
    w = ratio * ratio
    near = w < 0.04
    # log x - log y = 2 artanh((x - y) / (x + y))
    series = 2 * (1 + w * (1.0 / 3 + w * (1.0 / 5 + w * (1.0 / 7 + w / 9)))) / (x + y)
    slope = tl.where(near, series, tl.log(x / y) / tl.where(near, 1.0, x - y))
    return share * slope + (1 - share) / LOG_FLOOR


@triton.jit
def _pull_difference(x, y):
    """(_pull(x) - _pull(y)) / (x - y), to round-off where x and y are near each other too."""
    low = LOG_FLOOR * LOG_FLOOR
    share = _share_above(x, y, low)
    rx = tl.sqrt(tl.maximum(x, low))
    ry = tl.sqrt(tl.maximum(y, low))
    return share / (rx * ry * (rx + ry)) + (1 - share) / (2 * low)


@triton.jit
def _pull_slope(x):
    """Derivative of ``_pull`` by half the square; none where it is continued, as in the definition."""
    low = LOG_FLOOR * LOG_FLOOR
    inside = tl.maximum(x, low)
    return tl.where(x < low, 0.0, 1.0 / (inside * tl.sqrt(inside)))


@triton.jit
def _spectral_modulus(own, first, second, third, mu, lam):
    """``wave`` of ``constitutive._spectral_moduli``, from H_ii and each H_ij, twist and flip.

    The pairs of axes are (1, 2), (0, 2) and (0, 1).
    """
    rest = 2 * mu + lam
    unit = tl.maximum(rest, 1e-30)  # or the cube of a modulus would overflow
    m0 = first[0] / unit
    m1 = second[0] / unit
    m2 = third[0] / unit
    matrix = (own[0] / unit, m2, m1, m2, own[1] / unit, m0, m1, m0, own[2] / unit)
    bound = largest(unit * largest_eigenvalue(matrix), 2 * mu + 3 * tl.maximum(lam, 0.0))
    bound = largest(bound, largest(first[1], first[2]))
    bound = largest(bound, largest(second[1], second[2]))
    bound = largest(bound, largest(third[1], third[2]))
    wave = largest(largest(own[0], own[1]), largest(own[2], rest))
    wave = largest(wave, largest(first[1] - first[0], first[2] + first[0]))
    wave = largest(wave, largest(second[1] - second[0], second[2] + second[0]))
    wave = largest(wave, largest(third[1] - third[0], third[2] + third[0]))
    return tl.minimum(wave, bound, tl.PropagateNan.ALL)


@triton.jit
def _network_pair(x, y, plane_x, plane_y, plane, whole, spread, direct, network, bulk, tension):
    """H_ij, twist and flip of two axes of a network.

    The planes are named by the axis across them, and ``plane`` holds both axes. With D the divided difference of the
    pulls of the two other planes, flip and twist are the same but for (x + y)² D, which is (x - y)² D in twist, and for
    what does not vanish with the stretches.
    """
    difference = 2.0 / 105 * _pull_difference(plane_x, plane_y)
    common = direct + network * (whole + 8.0 / 105 * (_pull(plane) + 0.5 * (_pull(plane_x) + _pull(plane_y))))
    total = x + y
    gap = x - y
    twist = common + network * difference * gap * gap + 2 * tension / tl.maximum(total, EPSILON)
    flip = common + network * difference * total * total
    mixed = network * x * y * (4.0 / 105 * _pull_slope(plane) + spread / 35) + bulk
    return mixed, twist, flip


@triton.jit
def network_wave_modulus(a, mu, lam):
    """``wave`` of ``constitutive.spring_network_moduli`` from the principal stretches."""
    least = tl.maximum(tl.minimum(mu, lam), 0.0)
    direct = 10.0 / 7 * least + 2 * (mu - least)
    network = 15 * least
    bulk = lam - least
    tension = bulk * (a[0] + a[1] + a[2] - 3) - direct
    s0 = a[0] * a[0]
    s1 = a[1] * a[1]
    s2 = a[2] * a[2]
    plane0 = (s1 + s2) / 2
    plane1 = (s0 + s2) / 2
    plane2 = (s0 + s1) / 2
    space = (s0 + s1 + s2) / 3
    whole = 3.0 / 35 * _pull(space)
    spread = _pull_slope(space)
    pull0 = _pull(plane0)
    pull1 = _pull(plane1)
    pull2 = _pull(plane2)
    turn0 = 4.0 / 105 * _pull_slope(plane0)
    turn1 = 4.0 / 105 * _pull_slope(plane1)
    turn2 = 4.0 / 105 * _pull_slope(plane2)
    rest = direct + bulk
    own = (
        rest + network * (8.0 / 105 * (pull1 + pull2) + whole + s0 * (turn1 + turn2 + spread / 35)),
        rest + network * (8.0 / 105 * (pull0 + pull2) + whole + s1 * (turn0 + turn2 + spread / 35)),
        rest + network * (8.0 / 105 * (pull0 + pull1) + whole + s2 * (turn0 + turn1 + spread / 35)),
    )
    first = _network_pair(a[1], a[2], plane1, plane2, plane0, whole, spread, direct, network, bulk, tension)
    second = _network_pair(a[0], a[2], plane0, plane2, plane1, whole, spread, direct, network, bulk, tension)
    third = _network_pair(a[0], a[1], plane0, plane1, plane2, whole, spread, direct, network, bulk, tension)
    return _spectral_modulus(own, first, second, third, mu, lam)


@triton.jit
def _hencky_pair(x, y, tau_x, tau_y, mu, lam):
    """H_ij, twist and flip of two axes, from their stretches and Kirchhoff stresses (where nothing is continued)."""
    gx = 1.0 / tl.maximum(x, LOG_FLOOR)
    gy = 1.0 / tl.maximum(y, LOG_FLOOR)
    twist = (tau_x * gx + tau_y * gy) / tl.maximum(x + y, EPSILON)
    bend = 0.5 * (tau_x + tau_y) * _share_above(x, y, LOG_FLOOR) * gx * gy
    flip = mu * (gx + gy) * _log_difference(x, y) - bend
    return lam * gx * gy, twist, flip


@triton.jit
def _hencky_own(x, tau, mu, lam):
    """H_ii."""
    g = 1.0 / tl.maximum(x, LOG_FLOOR)
    return (2 * mu + lam - tl.where(x < LOG_FLOOR, 0.0, tau)) * g * g


@triton.jit
def hencky_wave_modulus(a, mu, lam):
    """``wave`` of ``constitutive.stvk_hencky_moduli`` from the principal stretches."""
    l0 = _log(a[0])
    l1 = _log(a[1])
    l2 = _log(a[2])
    pressure = lam * (l0 + l1 + l2)
    t0 = 2 * mu * l0 + pressure
    t1 = 2 * mu * l1 + pressure
    t2 = 2 * mu * l2 + pressure
    own = (_hencky_own(a[0], t0, mu, lam), _hencky_own(a[1], t1, mu, lam), _hencky_own(a[2], t2, mu, lam))
    first = _hencky_pair(a[1], a[2], t1, t2, mu, lam)
    second = _hencky_pair(a[0], a[2], t0, t2, mu, lam)
    third = _hencky_pair(a[0], a[1], t0, t1, mu, lam)
    return _spectral_modulus(own, first, second, third, mu, lam)


@triton.jit
def wave_modulus(F, mu, lam, KIND: tl.constexpr):
    """Density times the square of the speed of a wave [Pa] (``ConstitutiveLaw.moduli``), kinds as energy_density."""
    if KIND == FIXED_COROTATED:
        cof = cofactor(F)
        area = largest_eigenvalue(matmul(transpose(cof), cof))
        modulus = 2 * mu + lam * largest(area, 1.0)
    else:
        _u, a, _v = svd3(F)
        if KIND == NETWORK:
            modulus = network_wave_modulus(a, mu, lam)
        else:
            modulus = hencky_wave_modulus(a, mu, lam)
    return modulus


@triton.jit
def kelvin_voigt_pk1(F, rate, mu, lam, time):
    """``damping.kelvin_voigt_pk1``."""
    product = matmul(transpose(F), rate)
    trace = lam * (product[0] + product[4] + product[8])
    s01 = mu * (product[1] + product[3])
    s02 = mu * (product[2] + product[6])
    s12 = mu * (product[5] + product[7])
    stress = (
        2 * mu * product[0] + trace, s01, s02, s01, 2 * mu * product[4] + trace, s12, s02, s12,
        2 * mu * product[8] + trace,
    )  # fmt: skip
    return scale9(time, matmul(F, stress))
