"""Hencky elasticity, the base of the plastic solids."""

from gaussian_swaying.geometry.linalg_triton import dot3, svd3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.laws.triton.shared import (
    EPSILON,
    LOG_FLOOR,
    log,
    log_difference,
    share_above,
    spectral_change,
    spectral_modulus,
    to_principal,
)


@triton.jit
def principal(a, mu, lam, internal, p):
    """Principal first Piola-Kirchhoff stresses of the Hencky energy."""
    l0 = log(a[0])
    l1 = log(a[1])
    l2 = log(a[2])
    pressure = lam * (l0 + l1 + l2)
    return (
        (2 * mu * l0 + pressure) / tl.maximum(a[0], LOG_FLOOR),
        (2 * mu * l1 + pressure) / tl.maximum(a[1], LOG_FLOOR),
        (2 * mu * l2 + pressure) / tl.maximum(a[2], LOG_FLOOR),
    )


@triton.jit
def energy(F, mu, lam):
    """``stvk_hencky_energy``."""
    _u, a, _v = svd3(F)
    logs = (log(a[0]), log(a[1]), log(a[2]))
    total = logs[0] + logs[1] + logs[2]
    return mu * dot3(logs, logs) + 0.5 * lam * total * total


@triton.jit
def _pair(x, y, tau_x, tau_y, mu, lam):
    """H_ij, twist and flip of two axes, from their stretches and Kirchhoff stresses (where nothing is continued)."""
    gx = 1.0 / tl.maximum(x, LOG_FLOOR)
    gy = 1.0 / tl.maximum(y, LOG_FLOOR)
    twist = (tau_x * gx + tau_y * gy) / tl.maximum(x + y, EPSILON)
    bend = 0.5 * (tau_x + tau_y) * share_above(x, y, LOG_FLOOR) * gx * gy
    flip = mu * (gx + gy) * log_difference(x, y) - bend
    return lam * gx * gy, twist, flip


@triton.jit
def _own(x, tau, mu, lam):
    g = 1.0 / tl.maximum(x, LOG_FLOOR)
    return (2 * mu + lam - tl.where(x < LOG_FLOOR, 0.0, tau)) * g * g


@triton.jit
def _hessian(a, mu, lam):
    l0 = log(a[0])
    l1 = log(a[1])
    l2 = log(a[2])
    pressure = lam * (l0 + l1 + l2)
    t0 = 2 * mu * l0 + pressure
    t1 = 2 * mu * l1 + pressure
    t2 = 2 * mu * l2 + pressure
    own = (_own(a[0], t0, mu, lam), _own(a[1], t1, mu, lam), _own(a[2], t2, mu, lam))
    first = _pair(a[1], a[2], t1, t2, mu, lam)
    second = _pair(a[0], a[2], t0, t2, mu, lam)
    third = _pair(a[0], a[1], t0, t1, mu, lam)
    return own, first, second, third


@triton.jit
def hencky_wave_modulus(a, mu, lam):
    """``wave`` of ``stvk_hencky_moduli`` from the principal stretches."""
    own, first, second, third = _hessian(a, mu, lam)
    return spectral_modulus(own, first, second, third, mu, lam)


@triton.jit
def wave(F, mu, lam):
    """The first of ``stvk_hencky_moduli``."""
    _u, a, _v = svd3(F)
    return hencky_wave_modulus(a, mu, lam)


@triton.jit
def adjoint(F, Q, mu, lam):
    """Derivative of the stress in the direction Q, and of Q : P by mu and lam."""
    u, a, v = svd3(F)
    b = to_principal(u, Q, v)
    own, first, second, third = _hessian(a, mu, lam)
    one = mu * 0 + 1
    diagonal = (b[0], b[4], b[8])
    by_mu = dot3(diagonal, principal(a, one, mu * 0, mu, mu))
    by_lam = dot3(diagonal, principal(a, mu * 0, one, mu, mu))
    return spectral_change(u, v, b, own, first, second, third), by_mu, by_lam


FUNCTIONS = LawFunctions(principal=principal, energy=energy, wave=wave, adjoint=adjoint)
