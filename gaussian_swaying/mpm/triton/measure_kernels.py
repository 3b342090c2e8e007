"""Kernels that measure a state: energy and wave speed."""

from gaussian_swaying.geometry.linalg_triton import dot3, load3, load9
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.triton.shared import VARIES, keep_largest, wave_speed


@triton.jit(do_not_specialize=VARIES)
def elastic_energy(F_in, mu_in, lam_in, out, count, ENERGY: tl.constexpr, BLOCK: tl.constexpr):
    """Energy density of particles [J/m³], as ``ConstitutiveLaw.energy``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    F = load9(F_in, 1, index * 9, mask)
    mu = tl.load(mu_in + index, mask, 0.0)
    lam = tl.load(lam_in + index, mask, 0.0)
    tl.store(out + index, ENERGY(F, mu, lam), mask)


@triton.jit(do_not_specialize=VARIES)
def largest_speed(
    F_in, density, mu_in, lam_in, velocity, out, count, WAVE: tl.constexpr, SPATIAL: tl.constexpr, BLOCK: tl.constexpr
):
    """Largest speed of a wave [m/s] (and of its particle, SPATIAL), into ``out``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    F = load9(F_in, 1, index * 9, mask)
    mu = tl.load(mu_in + index, mask, 0.0)
    lam = tl.load(lam_in + index, mask, 0.0)
    speed = wave_speed(F, tl.load(density + index, mask, 1.0), mu, lam, WAVE, SPATIAL)
    if SPATIAL:
        v = load3(velocity, 1, index * 3, mask)
        speed += tl.sqrt(dot3(v, v))
    keep_largest(out, speed, mask)
