r"""Return maps: trial principal stretches brought back to the yield surface.

All but snow and fluid work on the logarithmic stretches :math:`\varepsilon_i = \log a_i` of the Hencky energy, where
the principal Kirchhoff stresses are :math:`\tau_i = 2 \mu \varepsilon_i + \lambda \sum \varepsilon`. The logarithm is
the continued one of the constitutive law, so crushed and inverted trial states are defined; where they yield, they
come back with stretches of 0.05 or more.

Every function takes trial stretches (..., 3), Lamé parameters [Pa] (...), the internal variable (...) or None, its own
parameters and the substep [s], and returns the new stretches and the new internal variable.
"""

import math

import torch
from torch import Tensor

from gaussian_swaying.mpm.constitutive import LOG_LIMIT, SNOW_RANGE, continued_log

_ROOT = math.sqrt(2 / 3)


def _split(strain: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Trace (...), deviator (..., 3), its norm (...) and its direction (..., 3), with finite gradients at zero."""
    trace = strain.sum(-1)
    deviator = strain - trace[..., None] / 3
    squared = deviator.square().sum(-1)
    tiny = torch.finfo(strain.dtype).eps ** 2
    some = squared > tiny
    norm = torch.where(some, torch.where(some, squared, 1.0).sqrt(), 0.0)
    return trace, deviator, norm, deviator / torch.where(some, norm, 1.0)[..., None]


def _stretch(strain: Tensor) -> Tensor:
    """Stretches from logarithmic ones, at least 0.05.

    Further below the Kirchhoff stress fades, and a particle would stay crushed. The limit draws strains together, so it
    never leads out of a von Mises cylinder.
    """
    return strain.clamp(min=math.log(LOG_LIMIT)).exp()


def cone_slope(friction_angle: float) -> float:
    r"""Slope :math:`\alpha = \sqrt{2/3} \, 2 \sin \phi / (3 - \sin \phi)` of the Drucker-Prager cone.

    It meets the Mohr-Coulomb pyramid of the friction angle in triaxial compression (Klar et al. 2016); in simple shear
    the material stands at a steeper angle, 34.7 degrees for 30.

    Args:
        friction_angle: Angle phi [degrees].
    """
    sine = math.sin(math.radians(friction_angle))
    return _ROOT * 2 * sine / (3 - sine)


def drucker_prager(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor | None,
    friction_angle: float,
    dt: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor | None]:
    r"""Sand: :math:`|\operatorname{dev} \varepsilon| + \alpha \tfrac{3 \lambda + 2 \mu}{2 \mu} \sum \varepsilon \le 0`.

    Klar et al. 2016, "Drucker-Prager elastoplasticity for sand animation", section 7.3 of the technical report: tension
    leaves no stress, shear flows without a change of volume. The internal variable, if there is one, is the volume
    :math:`v_c` [logarithm of a ratio] that the particle gained by the former; :math:`v_c / 3` is added to the strains,
    so that the sand must lose it before it carries load again (Tampubolon et al. 2017, "Multi-species simulation of
    porous sand and water mixtures").

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).
        internal: Volume v_c, shape (...), or None for no correction.
        friction_angle: Friction angle phi [degrees].
        dt: Substep [s]; not used.

    Returns:
        Stretches (..., 3) and v_c.
    """
    logs = continued_log(stretch)
    strain = logs if internal is None else logs + internal[..., None] / 3
    trace, _, norm, direction = _split(strain)
    excess = norm + cone_slope(friction_angle) * (3 * lam + 2 * mu) / (2 * mu) * trace
    kept = stretch if internal is None else stretch * (internal / 3).exp()[..., None]
    flowed = _stretch(strain - excess.clamp(min=0)[..., None] * direction)
    new = torch.where((excess <= 0)[..., None], kept, flowed)
    # at rest, the tip of the cone, "kept" lets gradients pass
    new = torch.where((trace > 0)[..., None], torch.ones_like(new), new)
    if internal is None:
        return new, None
    return new, internal + logs.sum(-1) - continued_log(new).sum(-1)


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
    trace, deviator, norm, direction = _split(continued_log(stretch))
    trial = 2 * mu * norm
    line = yield_stress + hardening * internal
    stiffness = 2 * mu + 2 / 3 * hardening
    # both branches of the yield stress ask for a flow; the larger yield stress, hence the smaller flow, counts
    floor_flow = (trial - _ROOT * residual) / (2 * mu)
    line_flow = (trial - _ROOT * line) / torch.where(stiffness > 0, stiffness, 1.0)
    flow = torch.where(stiffness > 0, torch.minimum(line_flow, floor_flow), floor_flow)
    yields = trial > _ROOT * line.clamp(min=residual)
    flow = torch.where(yields, flow, 0.0)
    strain = deviator - flow[..., None] * direction + trace[..., None] / 3
    return torch.where(yields[..., None], _stretch(strain), stretch), internal + _ROOT * flow


def viscoplastic(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor | None,
    yield_stress: float,
    viscosity: float,
    dt: float | Tensor,
) -> tuple[Tensor, Tensor | None]:
    r"""Foam: shear stress above the yield stress relaxes at a rate given by a viscosity.

    Perzyna 1966, "Fundamental problems in viscoplasticity", with the linear overstress function (Simo & Hughes 1998,
    section 2.7): the overstress :math:`y = |\operatorname{dev} \tau| - \sqrt{2/3} \, \sigma_y` obeys
    :math:`\dot y = -2 \mu y / \eta`, which is integrated exactly: two half substeps give what one does.

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...); not used.
        internal: Passed on.
        yield_stress: Yield stress in uniaxial tension [Pa].
        viscosity: Viscosity eta [Pa s]; zero for plastic flow without delay.
        dt: Substep [s].

    Returns:
        Stretches (..., 3) and ``internal``.
    """
    trace, deviator, norm, direction = _split(continued_log(stretch))
    over = 2 * mu * norm - _ROOT * yield_stress
    # one minus the factor that is left, without loss of digits for a short substep
    relaxed = -torch.expm1(-2 * mu * dt / viscosity) if viscosity > 0 else torch.ones_like(mu)
    flow = over.clamp(min=0) * relaxed / (2 * mu)
    strain = deviator - flow[..., None] * direction + trace[..., None] / 3
    return torch.where((over > 0)[..., None], _stretch(strain), stretch), internal


def snow_plasticity(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor,
    critical_compression: float,
    critical_stretch: float,
    dt: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor]:
    r"""Snow: stretches stay in :math:`[1 - \theta_c, 1 + \theta_s]`, what they lose goes to the plastic volume ratio.

    Stomakhin et al. 2013, "A material point method for snow simulation", section 7.

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...); not used.
        lam: First Lamé parameter [Pa], shape (...); not used.
        internal: Plastic volume ratio J_p, shape (...); kept between 0.6 and 20.
        critical_compression: theta_c.
        critical_stretch: theta_s.
        dt: Substep [s]; not used.

    Returns:
        Stretches (..., 3) and J_p.
    """
    new = stretch.clamp(1 - critical_compression, 1 + critical_stretch)
    lost = stretch / new
    return new, (internal * lost[..., 0] * lost[..., 1] * lost[..., 2]).clamp(*SNOW_RANGE)


def fluid(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor | None,
    dt: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor | None]:
    """Fluid: keeps the volume ratio J, at least 0.05, and forgets the shape.

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...); not used.
        lam: First Lamé parameter [Pa], shape (...); not used.
        internal: Passed on.
        dt: Substep [s]; not used.

    Returns:
        Stretches (..., 3), all the cube root of J, and ``internal``.
    """
    volume = (stretch[..., 0] * stretch[..., 1] * stretch[..., 2]).clamp(min=LOG_LIMIT)
    return volume.pow(1 / 3)[..., None].expand_as(stretch), internal
