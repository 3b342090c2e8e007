r"""Laws that flow: elasticity with a return map, which brings trial principal stretches back to the yield surface.

All but those of snow and fluid work on the logarithmic stretches :math:`\varepsilon_i = \log a_i` of the Hencky energy,
where the principal Kirchhoff stresses are :math:`\tau_i = 2 \mu \varepsilon_i + \lambda \sum \varepsilon`. The
logarithm is the continued one of the energy, so crushed and inverted trial states are defined; where they yield, they
come back with stretches of 0.05 or more.
"""

from __future__ import annotations

import math

from gaussian_swaying._checks import check_positive
from gaussian_swaying.geometry.linalg_triton import add3, clamp, dot3, scale3, where3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.elastic import hencky_energy
from gaussian_swaying.mpm.laws.law import LOG_FLOOR, LOG_LIMIT, DeviceLaw, PlasticLaw, log

ROOT = tl.constexpr(math.sqrt(2 / 3))  # norm of the deviator of a unit stress in uniaxial tension
_LOG_OF_FLOOR = tl.constexpr(math.log(LOG_LIMIT))
_FLUID_FLOOR = tl.constexpr(0.5)  # volume ratio below which the pressure of a fluid is continued by its tangent
_SNOW_LOW, _SNOW_HIGH = tl.constexpr(0.6), tl.constexpr(20.0)  # plastic volume ratios of snow
_NO_SHEAR = tl.constexpr(2.0**-46)  # the square of float32's epsilon


@triton.jit
def split_strain(e0, e1, e2):
    """Trace, deviator, its norm and its direction, with finite gradients at zero."""
    trace = e0 + e1 + e2
    d = (e0 - trace / 3, e1 - trace / 3, e2 - trace / 3)
    squared = dot3(d, d)
    some = squared > _NO_SHEAR
    norm = tl.where(some, tl.sqrt(tl.where(some, squared, 1.0)), 0.0)
    scale = 1.0 / tl.where(some, norm, 1.0)
    return trace, d, norm, scale3(scale, d)


@triton.jit
def _stretch_of_log(x):
    """The stretch, at least 0.05.

    Below that, the Kirchhoff stress fades and a particle would stay crushed. The limit brings strains closer together,
    so it never leads out of a von Mises cylinder.
    """
    return tl.exp(tl.maximum(x, _LOG_OF_FLOOR))


@triton.jit
def _drawn_back(trace, d, direction, flow):
    mean = trace / 3
    d = add3(d, -flow, direction)
    return _stretch_of_log(d[0] + mean), _stretch_of_log(d[1] + mean), _stretch_of_log(d[2] + mean)


@triton.jit
def von_mises(a, mu, lam, internal, p, dt):
    r"""Metal: :math:`|\operatorname{dev} \tau| \le \sqrt{2/3} \max(\sigma_y + H \alpha, \sigma_r)`.

    Radial return with linear isotropic hardening (Simo & Hughes 1998, "Computational inelasticity", box 3.1). The
    internal variable is the accumulated plastic strain alpha, which grows by :math:`\sqrt{2/3}` of the flow. The state
    ends on the yield surface of the new alpha; with softening (H < 0) also where it reaches the residual stress on the
    way, and where the material softens faster than it unloads, :math:`H \le -3 \mu`. The numbers are the yield stress
    in uniaxial tension, H and the least yield stress [Pa].
    """
    yield_stress = p[0]
    hardening = p[1]
    residual = p[2]
    trace, d, norm, direction = split_strain(log(a[0]), log(a[1]), log(a[2]))
    trial = 2 * mu * norm
    line = yield_stress + hardening * internal
    stiffness = 2 * mu + 2.0 / 3.0 * hardening
    # each branch of the yield stress gives a flow; the larger yield stress, hence the smaller flow, applies
    floor_flow = (trial - ROOT * residual) / (2 * mu)
    line_flow = (trial - ROOT * line) / tl.where(stiffness > 0, stiffness, 1.0)
    amount = tl.where(stiffness > 0, tl.minimum(line_flow, floor_flow), floor_flow)
    yields = trial > tl.maximum(line, residual) * ROOT
    amount = tl.where(yields, amount, 0.0)
    return where3(yields, _drawn_back(trace, d, direction, amount), a), internal + ROOT * amount


class Metal(PlasticLaw):
    """Ductile metal: Hencky elasticity in a von Mises cylinder that grows with the plastic strain.

    Args:
        yield_stress: Yield stress in uniaxial tension [Pa].
        hardening: Increase of the yield stress with the accumulated plastic strain [Pa].
    """

    device = DeviceLaw(energy=hencky_energy, flow=von_mises)
    internal = 0.0

    def __init__(self, yield_stress: float, hardening: float = 0.0) -> None:
        super().__init__()
        check_positive("yield_stress", yield_stress)
        if hardening < 0:
            raise ValueError(
                f"Expected `hardening` not to be negative, but got {hardening}; for softening use Plasticine."
            )
        check_positive("hardening", hardening, allow_zero=True)
        self.yield_stress, self.hardening = float(yield_stress), float(hardening)

    @property
    def numbers(self) -> tuple[float, ...]:
        return self.yield_stress, self.hardening


class Plasticine(PlasticLaw):
    """Clay that weakens as it is worked: a von Mises cylinder that shrinks with the plastic strain.

    Args:
        yield_stress: Yield stress in uniaxial tension before any flow [Pa].
        softening: Decrease of the yield stress with the accumulated plastic strain [Pa].
        residual: Lowest yield stress [Pa].
    """

    device = DeviceLaw(energy=hencky_energy, flow=von_mises)
    internal = 0.0

    def __init__(self, yield_stress: float, softening: float, residual: float = 0.0) -> None:
        super().__init__()
        check_positive("yield_stress", yield_stress)
        check_positive("softening", softening, allow_zero=True)
        check_positive("residual", residual, allow_zero=True)
        if residual > yield_stress:
            raise ValueError(
                f"Expected `residual` not to exceed `yield_stress` ({yield_stress} Pa), but got {residual} Pa."
            )
        self.yield_stress, self.softening, self.residual = float(yield_stress), float(softening), float(residual)

    @property
    def numbers(self) -> tuple[float, ...]:
        return self.yield_stress, -self.softening, self.residual


@triton.jit
def viscoplastic(a, mu, lam, internal, p, dt):
    r"""Foam: shear stress above the yield stress relaxes at a rate given by a viscosity.

    Perzyna 1966, "Fundamental problems in viscoplasticity", with the linear overstress function (Simo & Hughes 1998,
    section 2.7): the overstress :math:`y = |\operatorname{dev} \tau| - \sqrt{2/3} \, \sigma_y` obeys
    :math:`\dot y = -2 \mu y / \eta`, which is integrated exactly, so two half substeps equal a full one. The numbers
    are the yield stress in uniaxial tension [Pa] and the viscosity eta [Pa s], zero for flow without delay.
    """
    yield_stress = p[0]
    viscosity = p[1]
    trace, d, norm, direction = split_strain(log(a[0]), log(a[1]), log(a[2]))
    over = 2 * mu * norm - ROOT * yield_stress
    x = -2 * mu * dt / tl.maximum(viscosity, 1e-30)
    # one minus exp(x) without loss of digits for a short substep
    series = -x * (1 + x * (1.0 / 2 + x * (1.0 / 6 + x * (1.0 / 24 + x * (1.0 / 120 + x * (1.0 / 720 + x / 5040))))))
    relaxed = tl.where(tl.abs(x) < 0.1, series, 1 - tl.exp(x))
    relaxed = tl.where(viscosity > 0, relaxed, 1.0)
    amount = tl.maximum(over, 0.0) * relaxed / (2 * mu)
    return where3(over > 0, _drawn_back(trace, d, direction, amount), a), internal


class Foam(PlasticLaw):
    """Foam, cream, dough: shear above the yield stress relaxes slowly (Perzyna's viscoplasticity).

    Args:
        yield_stress: Yield stress in uniaxial tension [Pa]; zero for a fluid that flows under any load.
        viscosity: Viscosity of the overstress [Pa s]; zero for flow without delay.
    """

    device = DeviceLaw(energy=hencky_energy, flow=viscoplastic)

    def __init__(self, yield_stress: float, viscosity: float) -> None:
        super().__init__()
        check_positive("yield_stress", yield_stress, allow_zero=True)
        check_positive("viscosity", viscosity, allow_zero=True)
        self.yield_stress, self.viscosity = float(yield_stress), float(viscosity)

    @property
    def numbers(self) -> tuple[float, ...]:
        return self.yield_stress, self.viscosity


def cone_slope(friction_angle: float) -> float:
    r"""Slope :math:`\alpha = \sqrt{2/3} \, 2 \sin \phi / (3 - \sin \phi)` of the Drucker-Prager cone.

    It meets the Mohr-Coulomb pyramid of the friction angle in triaxial compression (Klar et al. 2016); in simple shear
    the material sustains a steeper angle, 34.7 degrees for 30.

    Args:
        friction_angle: Angle phi [degrees].
    """
    sine = math.sin(math.radians(friction_angle))
    return math.sqrt(2 / 3) * 2 * sine / (3 - sine)


@triton.jit
def drucker_prager(a, mu, lam, internal, p, dt):
    r"""Sand: :math:`|\operatorname{dev} \varepsilon| + \alpha \tfrac{3 \lambda + 2 \mu}{2 \mu} \sum \varepsilon \le 0`.

    Klar et al. 2016, "Drucker-Prager elastoplasticity for sand animation", section 7.3 of the technical report: tension
    leaves no stress, shear flows without a change of volume. With a correction, the internal variable is the volume
    :math:`v_c` [logarithm of a ratio] that the particle gained in tension; :math:`v_c / 3` is added to the strains, so
    the sand must lose it before it carries load again (Tampubolon et al. 2017, "Multi-species simulation of porous sand
    and water mixtures"). The numbers are the slope of the cone, and 1 with the correction, else 0.
    """
    slope = p[0]
    corrected = p[1]
    third = internal * corrected / 3
    l0 = log(a[0])
    l1 = log(a[1])
    l2 = log(a[2])
    trace, d, norm, direction = split_strain(l0 + third, l1 + third, l2 + third)
    excess = norm + slope * (3 * lam + 2 * mu) / (2 * mu) * trace
    grown = tl.exp(third)
    flowed = _drawn_back(trace, d, direction, tl.maximum(excess, 0.0))
    # at rest, the tip of the cone, what is unchanged passes gradients
    new = where3(excess <= 0, scale3(grown, a), flowed)
    one = a[0] * 0 + 1
    new = where3(trace > 0, (one, one, one), new)
    change = l0 + l1 + l2 - log(new[0]) - log(new[1]) - log(new[2])
    return new, internal + corrected * change


class Sand(PlasticLaw):
    """Dry granular material without cohesion: Hencky elasticity in a Drucker-Prager cone.

    Args:
        friction_angle: Friction angle in triaxial compression [degrees]; a slope can be steeper, 34.7 for 30.
        volume_correction: Whether sand that was pulled apart must lose the volume it gained before it carries load
            again.
    """

    device = DeviceLaw(energy=hencky_energy, flow=drucker_prager)

    def __init__(self, friction_angle: float = 30.0, volume_correction: bool = False) -> None:
        super().__init__()
        if not 0 < friction_angle < 90:
            raise ValueError(
                f"Expected `friction_angle` between 0 and 90 degrees, but got {friction_angle}; use 30 for dry sand."
            )
        self.friction_angle = float(friction_angle)
        self.internal = 0.0 if volume_correction else None

    @property
    def numbers(self) -> tuple[float, ...]:
        return cone_slope(self.friction_angle), 0.0 if self.internal is None else 1.0


@triton.jit
def snow_energy(a, mu, lam, internal, p):
    r"""Fixed corotated energy with Lamé parameters times :math:`\exp(\xi (1 - J_p))`.

    Stomakhin et al. 2013, "A material point method for snow simulation", equation 2; plastic volume ratios J_p below
    0.6 count as 0.6. The third number is the hardening xi.
    """
    factor = tl.exp(p[2] * (1 - clamp(internal, _SNOW_LOW, _SNOW_HIGH)))
    d = (a[0] - 1, a[1] - 1, a[2] - 1)
    change = a[0] * a[1] * a[2] - 1
    return factor * (mu * dot3(d, d) + 0.5 * lam * (change * change))


@triton.jit
def snow_flow(a, mu, lam, internal, p, dt):
    r"""Snow: stretches stay in :math:`[1 - \theta_c, 1 + \theta_s]`, the rest goes into the plastic volume ratio.

    Stomakhin et al. 2013, "A material point method for snow simulation", section 7. The numbers are theta_c and
    theta_s; the internal variable is J_p, kept between 0.6 and 20.
    """
    low = 1 - p[0]
    high = 1 + p[1]
    kept = (clamp(a[0], low, high), clamp(a[1], low, high), clamp(a[2], low, high))
    lost = a[0] / kept[0] * (a[1] / kept[1]) * (a[2] / kept[2])
    return kept, clamp(internal * lost, _SNOW_LOW, _SNOW_HIGH)


class Snow(PlasticLaw):
    """Snow: fixed corotated elasticity with bounded stretches, stiffer when packed and softer when pulled apart.

    Its internal variable is the plastic volume ratio. The defaults are those of Stomakhin et al. 2013.

    Args:
        critical_compression: Compression at which a stretch becomes plastic, between 0 and 1.
        critical_stretch: Extension at which a stretch becomes plastic.
        hardening: Exponent of the stiffness in the plastic volume ratio.
    """

    device = DeviceLaw(energy=snow_energy, flow=snow_flow)
    internal = 1.0

    def __init__(
        self, critical_compression: float = 0.025, critical_stretch: float = 0.0075, hardening: float = 10.0
    ) -> None:
        super().__init__()
        if not 0 <= critical_compression < 1:
            raise ValueError(
                f"Expected `critical_compression` to lie in [0, 1), but got {critical_compression}; snow has 0.025."
            )
        check_positive("critical_stretch", critical_stretch, allow_zero=True)
        check_positive("hardening", hardening, allow_zero=True)
        self.critical_compression, self.critical_stretch = float(critical_compression), float(critical_stretch)
        self.hardening = float(hardening)

    @property
    def numbers(self) -> tuple[float, ...]:
        return self.critical_compression, self.critical_stretch, self.hardening


@triton.jit
def fluid_energy(a, mu, lam, internal, p):
    r"""Energy density [J/m³] of the pressure :math:`\tfrac{K}{\gamma} (J^{-\gamma} - 1)`; zero at J = 1.

    :math:`\tfrac{K}{\gamma} (J - 1 + (J^{1 - \gamma} - 1) / (\gamma - 1))`, below J = 0.5 continued as a parabola, with
    the bulk modulus :math:`K = \lambda + \tfrac23 \mu` (Monaghan 1994, "Simulating free surface flows with SPH", after
    Tait). The number is the exponent.
    """
    gamma = p[0]
    det = a[0] * a[1] * a[2]
    bulk = lam + 2.0 / 3.0 * mu
    inside = tl.maximum(det, _FLUID_FLOOR)
    rest = det - inside
    power = tl.exp(-gamma * tl.log(inside))
    energy = bulk / gamma * (inside - 1 + (power * inside - 1) / (gamma - 1))
    return energy - bulk / gamma * (power - 1) * rest + 0.5 * bulk * power / inside * (rest * rest)


@triton.jit
def fluid_flow(a, mu, lam, internal, p, dt):
    """Fluid: keeps the volume ratio J, at least 0.05, and discards the change of shape."""
    volume = tl.maximum(a[0] * a[1] * a[2], LOG_FLOOR)
    root = tl.exp(tl.log(volume) / 3)
    return (root, root, root), internal


class Fluid(PlasticLaw):
    """Weakly compressible fluid without viscosity; it uses only the bulk modulus lambda + 2/3 mu of the particles.

    Args:
        gamma: Exponent of the density in the pressure, above 1; 7 for water.
    """

    device = DeviceLaw(energy=fluid_energy, flow=fluid_flow)

    def __init__(self, gamma: float = 7.0) -> None:
        super().__init__()
        if not 1 < gamma < float("inf"):
            raise ValueError(f"Expected `gamma` to be finite and above 1, but got {gamma}; use 7 for water.")
        self.gamma = float(gamma)

    @property
    def numbers(self) -> tuple[float, ...]:
        return (self.gamma,)
