r"""Building blocks of the laws: Lamé parameters, the continued logarithm, bounds on the stiffness, return maps.

Each law is also defined for crushed and inverted elements: a finite stress pushes them back.

The stiffness functions return two bounds [Pa] on the Hessian :math:`\partial^2 \Psi / \partial F^2`: ``wave``, on
:math:`m \otimes N : H : m \otimes N` for unit vectors m and N, which is density times the square of the speed of the
fastest plane wave, and ``bound``, on the largest eigenvalue. Neither is taken below its value at rest. With the second
derivative M of det, whose eigenvalues are at most :math:`\tfrac{2}{\sqrt 3} \lVert F \rVert` (it is traceless on the
principal stretches) and which vanishes on :math:`m \otimes N`, the laws in J are bounded without an eigenvector.

Return maps bring trial principal stretches back to the yield surface. All but those of snow and fluid work on the
logarithmic stretches :math:`\varepsilon_i = \log a_i` of the Hencky energy, where the principal Kirchhoff stresses are
:math:`\tau_i = 2 \mu \varepsilon_i + \lambda \sum \varepsilon`. The logarithm is the continued one of the energy, so
crushed and inverted trial states are defined; where they yield, they come back with stretches of 0.05 or more. They
take trial stretches (..., 3), Lamé parameters [Pa] (...), the internal variable (...) or None, their own parameters and
the substep [s], and return the new stretches and the new internal variable.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg import determinant, divided_differences, matmul3, symmetric_eigenvalues

LOG_LIMIT = 0.05
"""Stretch, or volume ratio, below which logarithms are continued by their tangent."""

ROOT = math.sqrt(2 / 3)
"""Norm of the deviator of a unit stress in uniaxial tension."""

FLUID_LIMIT = 0.5
"""Volume ratio below which the pressure of a fluid is continued by its tangent."""

SNOW_RANGE = (0.6, 20.0)
"""Plastic volume ratios between which snow hardens or softens."""


def continued_log(x: Tensor) -> Tensor:
    """Logarithm, below 0.05 continued by its tangent: it and its gradient are defined for every number."""
    inside = x.clamp(min=LOG_LIMIT)
    return inside.log() + (x - inside) / LOG_LIMIT


def log_slope(x: Tensor) -> Tensor:
    """Derivative of :func:`continued_log`."""
    return x.clamp(min=LOG_LIMIT).reciprocal()


def lame_parameters(youngs_modulus: Tensor, poisson_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """Shear modulus mu and first Lamé parameter lambda [Pa] from E [Pa] and nu, elementwise."""
    mu = youngs_modulus / (2 * (1 + poisson_ratio))
    return mu, youngs_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))


def volumetric_moduli(F: Tensor, shear: Tensor | float, slope: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor]:
    r"""Bounds for :math:`P = s F + g(J) \operatorname{cof} F`, given s, g and g'.

    On the principal stretches the Hessian is :math:`s + g' \operatorname{diag}(c_i^2) + (g' J + g) M`, c being those of
    the cofactor matrix; off them its eigenvalues are :math:`s \pm g a_k`.
    """
    squares = symmetric_eigenvalues(matmul3(F.mT, F)).clamp(min=0)
    compression = curvature.clamp(min=0) * squares[..., 0] * squares[..., 1]
    mixed = (curvature * determinant(F) + slope).abs() * (2 / math.sqrt(3)) * squares.sum(-1).sqrt()
    return shear + compression, shear + torch.maximum(compression + mixed, slope.abs() * squares[..., 0].sqrt())


def spectral_moduli(
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
    # a list of places as an index would be copied to the GPU, which a graph cannot capture
    twist, flip, mixed = (torch.stack([x[..., 0, 1], x[..., 0, 2], x[..., 1, 2]], -1) for x in (twist, flip, mixed))
    bound = torch.maximum(largest, torch.maximum(twist, flip).amax(-1))
    wave = torch.maximum(twist - mixed, flip + mixed).amax(-1)
    wave = torch.maximum(wave, own.amax(-1))
    bound = torch.maximum(bound, 2 * mu + 3 * lam.clamp(min=0))
    return torch.minimum(torch.maximum(wave, 2 * mu + lam), bound), bound


def split_strain(strain: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Trace (...), deviator (..., 3), its norm (...) and its direction (..., 3), with finite gradients at zero."""
    trace = strain.sum(-1)
    deviator = strain - trace[..., None] / 3
    squared = deviator.square().sum(-1)
    tiny = torch.finfo(strain.dtype).eps ** 2
    some = squared > tiny
    norm = torch.where(some, torch.where(some, squared, 1.0).sqrt(), 0.0)
    return trace, deviator, norm, deviator / torch.where(some, norm, 1.0)[..., None]


def stretch_of_log(strain: Tensor) -> Tensor:
    """Stretches from logarithmic ones, at least 0.05.

    Below that, the Kirchhoff stress fades and a particle would stay crushed. The limit brings strains closer together,
    so it never leads out of a von Mises cylinder.
    """
    return strain.clamp(min=math.log(LOG_LIMIT)).exp()


def von_mises(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor,
    yield_stress: float,
    hardening: float = 0.0,
    residual: float = 0.0,
    dt: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor]:
    r"""Metal: :math:`|\operatorname{dev} \tau| \le \sqrt{2/3} \max(\sigma_y + H \alpha, \sigma_r)`.

    Radial return with linear isotropic hardening (Simo & Hughes 1998, "Computational inelasticity", box 3.1). The
    internal variable is the accumulated plastic strain alpha, which grows by :math:`\sqrt{2/3}` of the flow. The state
    ends on the yield surface of the new alpha; with softening (H < 0) also where it reaches the residual stress on the
    way, and where the material softens faster than it unloads, :math:`H \le -3 \mu`.

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...); not used.
        internal: Accumulated plastic strain alpha, shape (...).
        yield_stress: Yield stress in uniaxial tension sigma_y [Pa].
        hardening: Hardening modulus H [Pa], negative for softening.
        residual: Least yield stress sigma_r [Pa].
        dt: Substep [s]; not used.

    Returns:
        Stretches (..., 3) and alpha.
    """
    trace, deviator, norm, direction = split_strain(continued_log(stretch))
    trial = 2 * mu * norm
    line = yield_stress + hardening * internal
    stiffness = 2 * mu + 2 / 3 * hardening
    # each branch of the yield stress gives a flow; the larger yield stress, hence the smaller flow, applies
    floor_flow = (trial - ROOT * residual) / (2 * mu)
    line_flow = (trial - ROOT * line) / torch.where(stiffness > 0, stiffness, 1.0)
    flow = torch.where(stiffness > 0, torch.minimum(line_flow, floor_flow), floor_flow)
    yields = trial > ROOT * line.clamp(min=residual)
    flow = torch.where(yields, flow, 0.0)
    strain = deviator - flow[..., None] * direction + trace[..., None] / 3
    return torch.where(yields[..., None], stretch_of_log(strain), stretch), internal + ROOT * flow
