"""A network of springs."""

from gaussian_swaying.geometry.linalg_triton import dot3, svd3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.laws.triton.shared import (
    EPSILON,
    LOG_FLOOR,
    share_above,
    spectral_change,
    spectral_modulus,
    to_principal,
)


@triton.jit
def _pull(x):
    """(l - 1) / l of a spring from the square of its length; continued by its tangent when small."""
    inside = tl.maximum(x, LOG_FLOOR * LOG_FLOOR)
    root = tl.sqrt(inside)
    return 1 + (x - inside) / (2 * inside) - 1 / root


@triton.jit
def principal(a, mu, lam, internal, p):
    """``_network_slope``."""
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
def _root(x):
    inside = tl.maximum(x, LOG_FLOOR * LOG_FLOOR)
    root = tl.sqrt(inside)
    return root + (x - inside) / (2 * root)


@triton.jit
def energy(F, mu, lam):
    """``spring_network_energy``."""
    _u, a, _v = svd3(F)
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
    return 7.5 * least * mean + (mu - least) * axes + 0.5 * (lam - least) * trace * trace


@triton.jit
def _pull_difference(x, y):
    """(_pull(x) - _pull(y)) / (x - y), accurate to round-off also if x is close to y."""
    low = LOG_FLOOR * LOG_FLOOR
    share = share_above(x, y, low)
    rx = tl.sqrt(tl.maximum(x, low))
    ry = tl.sqrt(tl.maximum(y, low))
    return share / (rx * ry * (rx + ry)) + (1 - share) / (2 * low)


@triton.jit
def _pull_slope(x):
    """Derivative of ``_pull`` by half the square; zero where it is continued, as in the reference."""
    low = LOG_FLOOR * LOG_FLOOR
    inside = tl.maximum(x, low)
    return tl.where(x < low, 0.0, 1.0 / (inside * tl.sqrt(inside)))


@triton.jit
def _pair(x, y, plane_x, plane_y, plane, whole, spread, direct, network, bulk, tension):
    """H_ij, twist and flip of two axes of a network.

    The planes are named by their normal axis, and ``plane`` contains both axes. With D the divided difference of the
    pulls of the two other planes, flip and twist are equal except for (x + y)² D, which is (x - y)² D in twist, and for
    terms that do not vanish with the stretches.
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
def _hessian(a, mu, lam):
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
    first = _pair(a[1], a[2], plane1, plane2, plane0, whole, spread, direct, network, bulk, tension)
    second = _pair(a[0], a[2], plane0, plane2, plane1, whole, spread, direct, network, bulk, tension)
    third = _pair(a[0], a[1], plane0, plane1, plane2, whole, spread, direct, network, bulk, tension)
    return own, first, second, third


@triton.jit
def network_wave_modulus(a, mu, lam):
    """``wave`` of ``spring_network_moduli`` from the principal stretches."""
    own, first, second, third = _hessian(a, mu, lam)
    return spectral_modulus(own, first, second, third, mu, lam)


@triton.jit
def wave(F, mu, lam):
    """The first of ``spring_network_moduli``."""
    _u, a, _v = svd3(F)
    return network_wave_modulus(a, mu, lam)


@triton.jit
def adjoint(F, Q, mu, lam):
    """Derivative of the stress in the direction Q, and of Q : P by mu and lam."""
    u, a, v = svd3(F)
    b = to_principal(u, Q, v)
    own, first, second, third = _hessian(a, mu, lam)
    one = mu * 0 + 1
    diagonal = (b[0], b[4], b[8])
    shear = 2 * (b[0] * (a[0] - 1) + b[4] * (a[1] - 1) + b[8] * (a[2] - 1))
    bulk = (b[0] + b[4] + b[8]) * (a[0] + a[1] + a[2] - 3)
    # the modulus of the network is the smaller of mu and lam; between equal ones torch shares its gradient
    network = tl.where(tl.minimum(mu, lam) < 0, 0.0, dot3(diagonal, principal(a, one, one, mu, mu)) - shear - bulk)
    share = tl.where(mu < lam, 1.0, tl.where(mu > lam, 0.0, 0.5))
    change = spectral_change(u, v, b, own, first, second, third)
    return change, shear + share * network, bulk + (1 - share) * network


FUNCTIONS = LawFunctions(principal=principal, energy=energy, wave=wave, adjoint=adjoint)
