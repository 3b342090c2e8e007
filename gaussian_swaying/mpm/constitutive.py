r"""Elastic laws as pure functions of the deformation gradient: energy, stress, stiffness.

Each law is defined for crushed and inverted elements too, with finite stress that pushes them back.

The stiffness functions return two bounds [Pa] on the Hessian :math:`\partial^2 \Psi / \partial F^2`: ``wave``, on
:math:`m \otimes N : H : m \otimes N` for unit vectors m and N, which is density times the square of the speed of the
fastest plane wave, and ``bound``, on the largest eigenvalue. Neither is taken below its value at rest. With the second
derivative M of det, whose eigenvalues are at most :math:`\tfrac{2}{\sqrt 3} \lVert F \rVert` (it is traceless on the
principal stretches) and which vanishes on :math:`m \otimes N`, the laws in J are bounded without an eigenvector.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gaussian_swaying.mpm.linalg import (
    cofactor,
    determinant,
    divided_differences,
    from_principal,
    matmul3,
    polar_rotation,
    spectrum,
    symmetric_eigenvalues,
)

LOG_LIMIT = 0.05
"""Stretch, or volume ratio, below which logarithms go on as their tangent."""

FLUID_LIMIT = 0.5
"""Volume ratio below which the pressure of a fluid goes on as its tangent."""

SNOW_RANGE = (0.6, 20.0)
"""Plastic volume ratios between which snow hardens or softens."""


def continued_log(x: Tensor) -> Tensor:
    """Logarithm, below 0.05 continued by its tangent: defined for every number, and so is its gradient."""
    inside = x.clamp(min=LOG_LIMIT)
    return inside.log() + (x - inside) / LOG_LIMIT


def _log_slope(x: Tensor) -> Tensor:
    """Derivative of :func:`continued_log`."""
    return x.clamp(min=LOG_LIMIT).reciprocal()


def lame_parameters(youngs_modulus: Tensor, poisson_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """Shear modulus mu and first Lamé parameter lambda [Pa] from E [Pa] and nu, elementwise."""
    mu = youngs_modulus / (2 * (1 + poisson_ratio))
    return mu, youngs_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))


def fixed_corotated_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Energy density :math:`\mu \lVert F - R \rVert^2 + \tfrac{\lambda}{2} (J - 1)^2` [J/m³].

    Stomakhin et al. 2012, "Energetically consistent invertible elasticity".

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (...).
    """
    return mu * (F - polar_rotation(F)).square().sum((-1, -2)) + 0.5 * lam * (determinant(F) - 1).square()


def fixed_corotated_pk1(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`2 \mu (F - R) + \lambda (J - 1) \operatorname{cof} F` [Pa].

    The cofactor form needs no inverse, so it is finite for a crushed element too.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    cof = cofactor(F)
    pressure = lam * (determinant(F, cof) - 1)
    return 2 * mu[..., None, None] * (F - polar_rotation(F)) + pressure[..., None, None] * cof


def fixed_corotated_kirchhoff(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Kirchhoff stress :math:`\tau = P F^T = 2 \mu (F - R) F^T + \lambda (J - 1) J I` [Pa].

    Paper, supplement, "Fixed Corotated Elasticity" (where the identity in the second term is missing).

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Symmetric, shape (..., 3, 3).
    """
    return matmul3(fixed_corotated_pk1(F, mu, lam), F.mT)


def fixed_corotated_moduli(F: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    r"""Bounds on the stiffness [Pa] (see the head of this file); :math:`\lambda + 2 \mu, 3 \lambda + 2 \mu` at rest.

    The term in mu adds at most :math:`2 \mu`, that in lambda is
    :math:`\lambda (\operatorname{cof} F \otimes \operatorname{cof} F + (J - 1) M)`.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        ``wave`` and ``bound``, shape (...).
    """
    cof = cofactor(F)
    area = symmetric_eigenvalues(matmul3(cof.mT, cof))[..., 0]
    excess = (determinant(F, cof) - 1).abs() * F.square().sum((-1, -2)).sqrt()
    growth = cof.square().sum((-1, -2)) + 2 / math.sqrt(3) * excess
    return 2 * mu + lam * area.clamp(min=1.0), 2 * mu + lam.clamp(min=0) * growth.clamp(min=3.0)


def _volumetric_moduli(F: Tensor, shear: Tensor | float, slope: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor]:
    r"""Bounds for :math:`P = s F + g(J) \operatorname{cof} F`, given s, g and g'.

    On the principal stretches the Hessian is :math:`s + g' \operatorname{diag}(c_i^2) + (g' J + g) M`, c being those of
    the cofactor matrix; off them its eigenvalues are :math:`s \pm g a_k`.
    """
    squares = symmetric_eigenvalues(matmul3(F.mT, F)).clamp(min=0)
    compression = curvature.clamp(min=0) * squares[..., 0] * squares[..., 1]
    mixed = (curvature * determinant(F) + slope).abs() * (2 / math.sqrt(3)) * squares.sum(-1).sqrt()
    return shear + compression, shear + torch.maximum(compression + mixed, slope.abs() * squares[..., 0].sqrt())


def neo_hookean_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Energy density :math:`\tfrac{\mu}{2} (\operatorname{tr} F^T F - 3) - \mu \, l + \tfrac{\lambda}{2} l^2` [J/m³].

    Bonet & Wood 2008, "Nonlinear continuum mechanics for finite element analysis", section 6.4.3, with l = log J
    continued by its tangent below J = 0.05 (:func:`continued_log`).

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (...).
    """
    log = continued_log(determinant(F))
    return 0.5 * mu * (F.square().sum((-1, -2)) - 3) - mu * log + 0.5 * lam * log.square()


def neo_hookean_pk1(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`\mu F + (\lambda l - \mu) \, l'(J) \operatorname{cof} F` [Pa].

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    cof = cofactor(F)
    det = determinant(F, cof)
    slope = (lam * continued_log(det) - mu) * _log_slope(det)
    return mu[..., None, None] * F + slope[..., None, None] * cof


def neo_hookean_kirchhoff(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress :math:`P F^T` [Pa] of :func:`neo_hookean_pk1`, symmetric, shape (..., 3, 3)."""
    return matmul3(neo_hookean_pk1(F, mu, lam), F.mT)


def neo_hookean_moduli(F: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds on the stiffness [Pa], as :func:`fixed_corotated_moduli`."""
    det = determinant(F)
    log, first = continued_log(det), _log_slope(det)
    second = torch.where(det < LOG_LIMIT, 0.0, -first.square())
    wave, bound = _volumetric_moduli(F, mu, (lam * log - mu) * first, lam * first.square() + (lam * log - mu) * second)
    return torch.maximum(wave, 2 * mu + lam), torch.maximum(bound, 2 * mu + 3 * lam.clamp(min=0))


def stvk_hencky_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Energy density :math:`\mu \sum_i l_i^2 + \tfrac{\lambda}{2} (\sum_i l_i)^2` [J/m³] with :math:`l_i = \log a_i`.

    Hencky 1928; the quadratic energy of the logarithmic principal stretches, which return maps of plasticity need
    (Klar et al. 2016, "Drucker-Prager elastoplasticity for sand animation"). Below a stretch of 0.05 the logarithm is
    continued by its tangent (:func:`continued_log`).

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (...).
    """
    log = continued_log(spectrum(F).stretch)
    return mu * log.square().sum(-1) + 0.5 * lam * log.sum(-1).square()


def _hencky_slope(stretch: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Derivative (..., 3) [Pa] of the Hencky energy by the principal stretches (..., 3)."""
    log = continued_log(stretch)
    tau = 2 * mu[..., None] * log + lam[..., None] * log.sum(-1, keepdim=True)
    return tau * _log_slope(stretch)


def stvk_hencky_pk1(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`R V \operatorname{diag}((2 \mu l_i + \lambda \sum l) \, l'(a_i)) V^T` [Pa].

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    return from_principal(spectrum(F), lambda a: _hencky_slope(a, mu, lam), rotated=True)


def stvk_hencky_kirchhoff(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress :math:`P F^T` [Pa] of :func:`stvk_hencky_pk1`, symmetric, shape (..., 3, 3)."""
    return matmul3(stvk_hencky_pk1(F, mu, lam), F.mT)


def stvk_hencky_moduli(F: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    r"""Bounds on the stiffness [Pa] (see the head of this file), without gradient.

    With :math:`y_i = \partial \Psi / \partial a_i` and :math:`H_{ij} = \partial y_i / \partial a_j`, the eigenvalues of
    the Hessian are those of H and, for each pair, :math:`(y_i + y_j) / (a_i + a_j)` and
    :math:`(y_i - y_j) / (a_i - a_j)`. On :math:`m \otimes N` each :math:`H_{ij}` may be shifted from the former to the
    latter, which leaves the largest of :math:`H_{ii}` and of the two quotients less and plus :math:`H_{ij}`.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        ``wave`` and ``bound``, shape (...).
    """
    with torch.no_grad():
        a = spectrum(F.detach()).stretch
        y, slope = _hencky_slope(a, mu, lam), _log_slope(a)
        own = (2 * mu[..., None] - torch.where(a < LOG_LIMIT, 0.0, y / slope)) * slope.square()
        mixed = lam[..., None, None] * slope[..., :, None] * slope[..., None, :]
        own = own + mixed.diagonal(dim1=-2, dim2=-1)
        return _spectral_moduli(a, y, lambda s: _hencky_slope(s, mu, lam), own, mixed, mu, lam)


def _spectral_moduli(
    a: Tensor,
    y: Tensor,
    function: Callable[[Tensor], Tensor],
    own: Tensor,
    mixed: Tensor,
    mu: Tensor,
    lam: Tensor,
) -> tuple[Tensor, Tensor]:
    """Bounds from principal stretches, stresses y = function(a), H_ii (..., 3), and H_ij off the diagonal."""
    hessian = mixed - mixed.diagonal(dim1=-2, dim2=-1).diag_embed() + own.diag_embed()
    total = (a[..., :, None] + a[..., None, :]).clamp(min=torch.finfo(a.dtype).eps)
    twist = (y[..., :, None] + y[..., None, :]) / total
    flip = divided_differences(a, function)
    largest = symmetric_eigenvalues(hessian)[..., 0]
    i, j = (0, 0, 1), (1, 2, 2)
    twist, flip, mixed = twist[..., i, j], flip[..., i, j], mixed[..., i, j]
    bound = torch.maximum(largest, torch.maximum(twist, flip).amax(-1))
    wave = torch.maximum(twist - mixed, flip + mixed).amax(-1)
    wave = torch.maximum(wave, own.amax(-1))
    bound = torch.maximum(bound, 2 * mu + 3 * lam.clamp(min=0))
    return torch.minimum(torch.maximum(wave, 2 * mu + lam), bound), bound


def spring_network_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Energy density of a network of springs that are linear in their length [J/m³].

    With m the smaller of :math:`\mu` and :math:`\lambda` (0 where that is negative) and :math:`K = 15 \, m`,

    .. math::
        \Psi = \tfrac{K}{2} \langle (\lvert F e \rvert - 1)^2 \rangle_e
        + (\mu - m) \lVert S - I \rVert^2 + \tfrac{\lambda - m}{2} (\operatorname{tr} S - 3)^2 .

    The mean over all directions e is that of the 26 of Lebedev's rule of degree 7, laid along the principal axes: the
    axes, the diagonals of their planes and those of space, with weights 2/21, 16/105 and 9/35 for each axis, plane and
    for the four together. For small strain it is Hooke's law with equal Lamé parameters, Cauchy's solid, and the other
    terms bring it to those given. It stiffens in tension as a lattice of springs does, which is what most cloth
    solvers move; fixed corotated elasticity softens. Lengths of diagonals below 0.05 go on as their tangent.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (...).
    """
    a = spectrum(F).stretch
    least, shear, bulk = _network_parts(mu, lam)
    plane, space = (_continued_root(x) - 1 for x in _network_squares(a))
    mean = 2 / 21 * (a - 1).square().sum(-1) + 16 / 105 * plane.square().sum(-1) + 9 / 35 * space.square()[..., 0]
    return 7.5 * least * mean + shear * (a - 1).square().sum(-1) + 0.5 * bulk * (a.sum(-1) - 3).square()


def _network_parts(mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The modulus m of the network and what is left for the two other terms [Pa]."""
    least = torch.minimum(mu, lam).clamp(min=0)
    return least, mu - least, lam - least


def _network_squares(a: Tensor) -> tuple[Tensor, Tensor]:
    """Squared lengths of the diagonals of each plane (..., 3), named by the axis across it, and of space (..., 1)."""
    squares = a.square()
    total = squares.sum(-1, keepdim=True)
    return 0.5 * (total - squares), total / 3


def _continued_root(x: Tensor) -> Tensor:
    """Square root, continued by its tangent where it is below 0.05."""
    inside = x.clamp(min=LOG_LIMIT**2)
    root = inside.sqrt()
    return root + (x - inside) / (2 * root)


def _spring_pull(square: Tensor) -> Tensor:
    """Derivative of half the square of a spring's extension by half the square of its length l: (l - 1) / l."""
    return (_continued_root(square) - 1) / square.clamp(min=LOG_LIMIT**2).sqrt()


def _network_slope(a: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Derivative (..., 3) [Pa] of the energy of a network by the principal stretches (..., 3)."""
    least, shear, bulk = (part[..., None] for part in _network_parts(mu, lam))
    plane, space = _network_squares(a)
    pull, whole = _spring_pull(plane), _spring_pull(space)
    others = pull.sum(-1, keepdim=True) - pull  # the two planes that hold an axis
    mean = 2 / 21 * (a - 1) + a * (8 / 105 * others + 3 / 35 * whole)
    return 15 * least * mean + 2 * shear * (a - 1) + bulk * (a.sum(-1, keepdim=True) - 3)


def spring_network_pk1(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`U \operatorname{diag}(\partial \Psi / \partial a_i) V^T` [Pa].

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    return from_principal(spectrum(F), lambda a: _network_slope(a, mu, lam), rotated=True)


def spring_network_kirchhoff(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress :math:`P F^T` [Pa] of :func:`spring_network_pk1`, symmetric, shape (..., 3, 3)."""
    return matmul3(spring_network_pk1(F, mu, lam), F.mT)


def spring_network_moduli(F: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds on the stiffness [Pa], as :func:`stvk_hencky_moduli`."""
    with torch.no_grad():
        a = spectrum(F.detach()).stretch
        least, shear, bulk = (part[..., None] for part in _network_parts(mu, lam))
        plane, space = _network_squares(a)
        pull, whole = _spring_pull(plane), _spring_pull(space)
        # derivative of (l - 1) / l by half the square of the length l; none where the length is continued
        turn, spread = (torch.where(x < LOG_LIMIT**2, 0.0, x.clamp(min=LOG_LIMIT**2).pow(-1.5)) for x in (plane, space))
        others, turns = (x.sum(-1, keepdim=True) - x for x in (pull, turn))
        common = 3 / 35 * (whole + spread / 3 * a.square())
        own = 15 * least * (2 / 21 + 8 / 105 * (others + 0.5 * turns * a.square()) + common) + 2 * shear + bulk
        i, j, k = (0, 0, 1), (1, 2, 2), (2, 1, 0)  # a pair of axes, and the one across their plane
        pairs = a[..., i] * a[..., j] * (4 / 105 * turn[..., k] + spread / 35)
        mixed = torch.zeros_like(F)
        mixed[..., i, j] = mixed[..., j, i] = 15 * least * pairs + bulk
        slope = _network_slope(a, mu, lam)
        return _spectral_moduli(a, slope, lambda s: _network_slope(s, mu, lam), own, mixed, mu, lam)


def bulk_modulus(mu: Tensor, lam: Tensor) -> Tensor:
    """Bulk modulus K [Pa] from the Lamé parameters, elementwise."""
    return lam + 2 / 3 * mu


def fluid_pressure(det: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> Tensor:
    r"""Pressure :math:`p = \tfrac{K}{\gamma} (J^{-\gamma} - 1)` [Pa] of a weakly compressible fluid.

    Monaghan 1994, "Simulating free surface flows with SPH", after Tait; below J = 0.5 continued by its tangent.

    Args:
        det: Volume ratio J, shape (...).
        mu: Shear modulus [Pa], shape (...); it only enters the bulk modulus.
        lam: First Lamé parameter [Pa], shape (...).
        gamma: Exponent, above one.

    Returns:
        Shape (...).
    """
    bulk, inside = bulk_modulus(mu, lam), det.clamp(min=FLUID_LIMIT)
    return bulk / gamma * (inside.pow(-gamma) - 1) - bulk * inside.pow(-gamma - 1) * (det - inside)


def fluid_energy(F: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> Tensor:
    r"""Energy density [J/m³] whose derivative by J is minus :func:`fluid_pressure`; zero at J = 1.

    :math:`\tfrac{K}{\gamma} (J - 1 + (J^{1 - \gamma} - 1) / (\gamma - 1))`, below J = 0.5 continued as a parabola.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).
        gamma: Exponent, above one.

    Returns:
        Shape (...).
    """
    det = determinant(F)
    bulk, inside = bulk_modulus(mu, lam), det.clamp(min=FLUID_LIMIT)
    rest = det - inside
    pressure = bulk / gamma * (inside.pow(-gamma) - 1)
    energy = bulk / gamma * (inside - 1 + (inside.pow(1 - gamma) - 1) / (gamma - 1))
    return energy - pressure * rest + 0.5 * bulk * inside.pow(-gamma - 1) * rest.square()


def fluid_pk1(F: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`-p \operatorname{cof} F` [Pa], arguments as :func:`fluid_energy`."""
    cof = cofactor(F)
    return -fluid_pressure(determinant(F, cof), mu, lam, gamma)[..., None, None] * cof


def fluid_kirchhoff(F: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> Tensor:
    """Kirchhoff stress -p J I [Pa], arguments as :func:`fluid_energy`; shape (..., 3, 3)."""
    det = determinant(F)
    pressure = -fluid_pressure(det, mu, lam, gamma) * det
    return pressure[..., None, None] * torch.eye(3, dtype=F.dtype, device=F.device)


def fluid_moduli(F: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> tuple[Tensor, Tensor]:
    """Bounds on the stiffness [Pa], as :func:`fixed_corotated_moduli`; K and 3 K at rest."""
    det, bulk = determinant(F), bulk_modulus(mu, lam)
    curvature = bulk * det.clamp(min=FLUID_LIMIT).pow(-gamma - 1)
    wave, bound = _volumetric_moduli(F, 0.0, -fluid_pressure(det, mu, lam, gamma), curvature)
    return torch.maximum(wave, bulk), torch.maximum(bound, 3 * bulk)


def snow_lame(mu: Tensor, lam: Tensor, plastic_volume: Tensor, hardening: float) -> tuple[Tensor, Tensor]:
    r"""Lamé parameters [Pa] of snow, multiplied by :math:`\exp(\xi (1 - J_p))`.

    Stomakhin et al. 2013, "A material point method for snow simulation", equation 2.

    Args:
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).
        plastic_volume: Plastic volume ratio J_p, shape (...); it counts as at least 0.6.
        hardening: Hardening xi.

    Returns:
        Shapes (...).
    """
    factor = (hardening * (1 - plastic_volume.clamp(*SNOW_RANGE))).exp()
    return mu * factor, lam * factor


def snow_energy(F: Tensor, mu: Tensor, lam: Tensor, plastic_volume: Tensor, hardening: float = 10.0) -> Tensor:
    """Energy density [J/m³]: fixed corotated with the parameters of :func:`snow_lame`, shape (...)."""
    return fixed_corotated_energy(F, *snow_lame(mu, lam, plastic_volume, hardening))


def snow_pk1(F: Tensor, mu: Tensor, lam: Tensor, plastic_volume: Tensor, hardening: float = 10.0) -> Tensor:
    """First Piola-Kirchhoff stress [Pa] of :func:`snow_energy`, shape (..., 3, 3)."""
    return fixed_corotated_pk1(F, *snow_lame(mu, lam, plastic_volume, hardening))


def snow_kirchhoff(F: Tensor, mu: Tensor, lam: Tensor, plastic_volume: Tensor, hardening: float = 10.0) -> Tensor:
    """Kirchhoff stress [Pa] of :func:`snow_energy`, symmetric, shape (..., 3, 3)."""
    return fixed_corotated_kirchhoff(F, *snow_lame(mu, lam, plastic_volume, hardening))
