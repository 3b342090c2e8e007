"""Spectra of turbulence: its energy as a function of the wave number.

All are for a neutral wind of one point or of isotropic turbulence, with wave numbers in radians per metre. A frozen
field that is carried at a speed U is seen at one place with the frequency f = U k1 / (2 pi).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

SPECTRA = ("von_karman", "kaimal")

VON_KARMAN = math.gamma(1 / 3) / (math.sqrt(math.pi) * math.gamma(5 / 6))
"""Wave length of von Karman's spectrum over the integral length scale: 1.339."""

_ENERGY = 55 / (9 * math.sqrt(math.pi)) * math.gamma(5 / 6) / math.gamma(1 / 3)


def along_spectrum(k1: Tensor, length: float, spectrum: str = "von_karman") -> Tensor:
    r"""Spectrum of the component along the wind, over positive and negative wave numbers, per variance.

    .. math::
        F_{11}(k_1) = \frac{L}{\pi} \bigl(1 + (1.339 L k_1)^2\bigr)^{-5/6} \quad\text{or}\quad
        \frac{L}{\pi} \Bigl(1 + \frac{6 L |k_1|}{2 \pi}\Bigr)^{-5/3}

    The first is von Karman's (1948), the second Kaimal's as IEC 61400-1 writes it. The integral over all wave numbers
    is one, and the integral length scale, pi F11(0), is L in both.

    Args:
        k1: Wave number along the wind [rad/m], any shape.
        length: Integral length scale L [m].
        spectrum: ``von_karman`` or ``kaimal``.

    Returns:
        The spectrum [m], as ``k1``.
    """
    if spectrum == "kaimal":
        return length / math.pi * (1 + 3 / math.pi * length * k1.abs()).pow(-5 / 3)
    return length / math.pi * (1 + (VON_KARMAN * length * k1).square()).pow(-5 / 6)


def energy_spectrum(k: Tensor, length: float, spectrum: str = "von_karman") -> Tensor:
    r"""Energy of isotropic turbulence at a wave number, per variance of one component; the integral is 3/2.

    It is the only one whose component along the wind has :func:`along_spectrum` (Batchelor 1953, 3.4.16):

    .. math::
        E(k) = k^3 \frac{d}{dk} \Bigl( \frac1k \frac{dF_{11}}{dk} \Bigr)

    Args:
        k: Wave number [rad/m], not negative, any shape.
        length: Integral length scale [m].
        spectrum: As in :func:`along_spectrum`.

    Returns:
        E [m], as ``k``.
    """
    if spectrum == "kaimal":
        b = 3 / math.pi * length
        rise = 1 + b * k
        return 5 / 3 * length / math.pi * b * k * rise.pow(-11 / 3) * (rise + 8 / 3 * b * k)
    x = VON_KARMAN * length * k
    square = x * x
    return (_ENERGY * VON_KARMAN * length) * square * square * (1 + square).pow(-17 / 6)


def resolved_share(length: float, spacing: tuple[float, float, float], spectrum: str = "von_karman") -> float:
    """Share of the variance of the component along the wind that cells of this size resolve.

    That of the waves with less than half a turn per cell along each axis, by a sum over 128 x 64 directions and 512
    wave numbers in each.

    Args:
        length: Integral length scale [m].
        spacing: Sides of a cell [m].
        spectrum: As in :func:`along_spectrum`.

    Returns:
        A number between 0 and 1.
    """
    cosine = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
    angle = (torch.arange(128, dtype=torch.float64) + 0.5) / 128 * (math.pi / 2)
    sine = (1 - cosine.square()).sqrt()[:, None]
    direction = torch.stack([cosine[:, None].expand(64, 128), sine * angle.cos(), sine * angle.sin()], dim=-1)
    furthest = (math.pi / (direction * torch.tensor(spacing, dtype=torch.float64)).clamp(min=1e-300)).amin(-1)
    step = math.log(1e9) / 511  # in the logarithm of the wave number
    k = (1e-4 / length) * torch.exp(step * torch.arange(512, dtype=torch.float64))
    share = torch.cumsum(energy_spectrum(k, length, spectrum) * k, 0) * step  # of 3/2
    place = ((furthest * length / 1e-4).log() / step + 0.5).clamp(0, 511 - 1e-9)
    low = place.long()
    found = torch.lerp(share[low], share[(low + 1).clamp(max=511)], place - low)
    weight = 1 - direction[..., 0].square()  # of a wave in the component along the wind, whose mean is 2/3
    return float((weight * found).mean())


def shear_time(k: Tensor, length: float, gamma: float) -> Tensor:
    r"""Return the dimensionless life time of eddies in the mean shear, by wave number: Mann's beta.

    .. math::
        \beta(k) = \Gamma\, (k a)^{-2/3} \bigl[ {}_2F_1(\tfrac13, \tfrac{17}6; \tfrac43; -(k a)^{-2}) \bigr]^{-1/2}
        = \Gamma\, (k a)^{-1} \Bigl[ \tfrac23 \int_{k a}^\infty \frac{p^4}{(1 + p^2)^{17/6}}\, dp \Bigr]^{-1/2}

    with a = 1.339 L (Mann 1994, J. Fluid Mech. 273, equations 3.4 and 3.6). The integral is summed once for 4096
    values of k a from 1e-3 to 1e4 and interpolated.

    Args:
        k: Wave number [rad/m], positive, any shape.
        length: Integral length scale L [m] without shear.
        gamma: Mann's parameter of the shear; 0 for none, 3.9 in IEC 61400-1.

    Returns:
        As ``k``.
    """
    count = 4096
    low, high = math.log(1e-3), math.log(1e4)
    step = (high - low) / (count - 1)
    p = torch.exp(low + step * torch.arange(count, dtype=torch.float64))
    slope = p.pow(5) * (1 + p.square()).pow(-17 / 6)  # of the integral over the logarithm
    pieces = 0.5 * step * (slope[1:] + slope[:-1])
    above = torch.cat([pieces.flip(0).cumsum(0).flip(0), pieces.new_zeros(1)]) + 1.5 * float(p[-1]) ** (-2 / 3)
    table = (gamma / (p * (above / 1.5).sqrt())).log().to(k.device, k.dtype)
    place = (((VON_KARMAN * length) * k).log().sub(low) / step).clamp(0, count - 1 - 1e-3)
    left = place.long()
    return torch.lerp(table[left], table[left + 1], place - left).exp()
