"""Elastic laws."""

from __future__ import annotations

import math

from gaussian_swaying.geometry.linalg_triton import (
    axpy9,
    cofactor,
    dot3,
    dot9,
    largest,
    largest_eigenvalue,
    matmul,
    polar_rotation,
    transpose,
)
from gaussian_swaying.kernels.derive import on_tensors, primitive
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.law import LOG_FLOOR, ConstitutiveLaw, DeviceLaw, log, log_slope, share_above

_TRACELESS = tl.constexpr(2 / math.sqrt(3))


@triton.jit
def neo_hookean_energy(F, mu, lam, internal, p):
    r"""Energy density :math:`\tfrac{\mu}{2} (\operatorname{tr} F^T F - 3) - \mu \, l + \tfrac{\lambda}{2} l^2` [J/m³].

    Bonet & Wood 2008, "Nonlinear continuum mechanics for finite element analysis", section 6.4.3, with l = log J
    continued by its tangent below J = 0.05.
    """
    logarithm = log(dot3(F, cofactor(F)))
    return 0.5 * mu * (dot9(F, F) - 3) - mu * logarithm + 0.5 * lam * (logarithm * logarithm)


@triton.jit
def neo_hookean_moduli(F, mu, lam, internal, p):
    r"""Bounds on the stiffness of :math:`P = \mu F + g(J) \operatorname{cof} F`.

    On the principal stretches the Hessian is :math:`\mu + g' \operatorname{diag}(c_i^2) + (g' J + g) M`, c being those
    of the cofactor matrix and M the second derivative of det, whose eigenvalues are at most
    :math:`\tfrac{2}{\sqrt 3} \lVert F \rVert` and which vanishes on :math:`m \otimes N`; off them its eigenvalues are
    :math:`\mu \pm g a_k`.
    """
    cof = cofactor(F)
    det = dot3(F, cof)
    first = log_slope(det)
    slope = (lam * log(det) - mu) * first
    curvature = lam * first * first - tl.where(det < LOG_FLOOR, 0.0, slope * first)
    compression = largest(curvature, 0.0) * largest_eigenvalue(matmul(transpose(cof), cof))
    mixed = tl.abs(curvature * det + slope) * _TRACELESS * tl.sqrt(dot9(F, F))
    stretch = tl.sqrt(largest(largest_eigenvalue(matmul(transpose(F), F)), 0.0))
    wave = largest(mu + compression, 2 * mu + lam)
    bound = mu + largest(compression + mixed, tl.abs(slope) * stretch)
    return wave, largest(bound, 2 * mu + 3 * largest(lam, 0.0))


class NeoHookean(ConstitutiveLaw):
    """Elastic solid that resists crushing without limit. It is the cheapest law: it needs no polar decomposition."""

    device = DeviceLaw(strain_energy=neo_hookean_energy, moduli=neo_hookean_moduli)
    least_nu = 0.0


@triton.jit
def fixed_corotated_energy(F, mu, lam, internal, p):
    r"""Energy density :math:`\mu \lVert F - R \rVert^2 + \tfrac{\lambda}{2} (J - 1)^2` [J/m³].

    Stomakhin et al. 2012, "Energetically consistent invertible elasticity".
    """
    d = axpy9(1.0, F, -1.0, polar_rotation(F))
    change = dot3(F, cofactor(F)) - 1
    return mu * dot9(d, d) + 0.5 * lam * (change * change)


@triton.jit
def fixed_corotated_pk1(F, mu, lam, internal, p):
    r"""First Piola-Kirchhoff stress :math:`2 \mu (F - R) + \lambda (J - 1) \operatorname{cof} F` [Pa].

    The cofactor form needs no inverse, so it is also finite for a crushed element.
    """
    cof = cofactor(F)
    pressure = lam * (dot3(F, cof) - 1)
    return axpy9(2 * mu, axpy9(1.0, F, -1.0, polar_rotation(F)), pressure, cof)


@triton.jit
def fixed_corotated_moduli(F, mu, lam, internal, p):
    r"""Bounds on the stiffness: :math:`2 \mu` of the first term, and :math:`\lambda (c \otimes c + (J - 1) M)`.

    c is the cofactor matrix, M as in :func:`neo_hookean_moduli`.
    """
    cof = cofactor(F)
    area = largest_eigenvalue(matmul(transpose(cof), cof))
    excess = tl.abs(dot3(F, cof) - 1) * tl.sqrt(dot9(F, F))
    growth = dot9(cof, cof) + _TRACELESS * excess
    return 2 * mu + lam * largest(area, 1.0), 2 * mu + largest(lam, 0.0) * largest(growth, 3.0)


class FixedCorotated(ConstitutiveLaw):
    """Elastic solid that stays defined when crushed or inverted: foliage, cloth, rubber at moderate strain."""

    device = DeviceLaw(strain_energy=fixed_corotated_energy, pk1=fixed_corotated_pk1, moduli=fixed_corotated_moduli)
    least_nu = 0.0


@triton.jit
def hencky_energy(a, mu, lam, internal, p):
    r"""Energy density :math:`\mu \sum_i l_i^2 + \tfrac{\lambda}{2} (\sum_i l_i)^2` [J/m³] with :math:`l_i = \log a_i`.

    Hencky 1928; the quadratic energy of the logarithmic principal stretches, which return maps of plasticity need
    (Klar et al. 2016, "Drucker-Prager elastoplasticity for sand animation"). Below a stretch of 0.05 the logarithm is
    continued by its tangent.
    """
    logs = (log(a[0]), log(a[1]), log(a[2]))
    total = logs[0] + logs[1] + logs[2]
    return mu * dot3(logs, logs) + 0.5 * lam * (total * total)


class StVKHencky(ConstitutiveLaw):
    """Elastic solid with an energy quadratic in the logarithmic stretches, the base of the plastic solids.

    It softens in tension beyond a stretch of about e, so do not use it for rubber.
    """

    device = DeviceLaw(energy=hencky_energy)


@triton.jit
def _length(square):
    """Square root, continued by its tangent where it is below 0.05."""
    inside = tl.maximum(square, LOG_FLOOR * LOG_FLOOR)
    root = tl.sqrt(inside)
    return root + (square - inside) / (2 * root)


@triton.jit
def _length_slope(square):
    return 0.5 / tl.sqrt(tl.maximum(square, LOG_FLOOR * LOG_FLOOR))


@triton.jit
def _length_difference(x, y):
    low = LOG_FLOOR * LOG_FLOOR
    share = share_above(x, y, low)
    return share / (tl.sqrt(tl.maximum(x, low)) + tl.sqrt(tl.maximum(y, low))) + 0.5 * (1 - share) / LOG_FLOOR


primitive(
    _length,
    vjp=lambda given, _, bar: (bar * on_tensors(_length_slope)(*given),),
    difference=on_tensors(_length_difference),
)


@triton.jit
def spring_network_energy(a, mu, lam, internal, p):
    r"""Energy density of a network of springs that are linear in their length [J/m³].

    With m the smaller of :math:`\mu` and :math:`\lambda` (0 where that is negative) and :math:`K = 15 \, m`,

    .. math::
        \Psi = \tfrac{K}{2} \langle (\lvert F e \rvert - 1)^2 \rangle_e
        + (\mu - m) \lVert S - I \rVert^2 + \tfrac{\lambda - m}{2} (\operatorname{tr} S - 3)^2 .

    The mean over all directions e is the mean over the 26 directions of Lebedev's rule of degree 7, aligned with the
    principal axes: the axes, the diagonals of their planes and the space diagonals, with weights 2/21, 16/105 and 9/35
    for each axis, for each plane and for the four space diagonals together. For small strain it is Hooke's law with
    equal Lamé parameters (Cauchy's solid); the other terms add what is missing from the given parameters. It stiffens
    in tension like a lattice of springs, the model of most cloth solvers; fixed corotated elasticity softens. Lengths
    of diagonals below 0.05 are continued by their tangent.
    """
    least = tl.maximum(tl.minimum(mu, lam), 0.0)
    s0 = a[0] * a[0]
    s1 = a[1] * a[1]
    s2 = a[2] * a[2]
    d = (a[0] - 1, a[1] - 1, a[2] - 1)
    plane = (_length((s1 + s2) / 2) - 1, _length((s0 + s2) / 2) - 1, _length((s0 + s1) / 2) - 1)
    space = _length((s0 + s1 + s2) / 3) - 1
    axes = dot3(d, d)
    mean = 2.0 / 21 * axes + 16.0 / 105 * dot3(plane, plane) + 9.0 / 35 * (space * space)
    trace = d[0] + d[1] + d[2]
    return 7.5 * least * mean + (mu - least) * axes + 0.5 * (lam - least) * (trace * trace)


class SpringNetwork(ConstitutiveLaw):
    """Elastic solid of springs that are linear in their length: cloth, as in mass-spring solvers.

    It stiffens in tension, where fixed corotated elasticity softens: they differ by a tenth and more at a stretch of
    1.2.
    """

    device = DeviceLaw(energy=spring_network_energy)
