"""Turbulence: its spectra, a periodic box without divergence that the wind carries along, and winds by their look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.tables import CarriedField, Tabulated

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


MAX_CELLS = 1 << 27
"""Most cells of a box, which then takes 1.5 GiB."""


def turbulence_box(
    cells: Sequence[int],
    spacing: Sequence[float],
    length: float,
    spectrum: str = "von_karman",
    gamma: float = 0.0,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Tensor:
    r"""Velocities of frozen turbulence at the corners of a periodic box; their variance is one for an endless box.

    A wave with the wave vector k has the amplitude :math:`\sqrt{E(k) / (4 \pi k^4)}\; i\, k \times n`, where n is the
    Fourier transform of white noise. That is perpendicular to k, so the field has no divergence, and its spectrum is
    that of isotropic turbulence (Mann 1998, Prob. Engng. Mech. 13, section 3). Inside the band of waves that fit
    between the box and its cells the spectrum is exact; what lies outside is missing, see
    :func:`resolved_share`.

    With a ``gamma``, the mean shear has stretched each wave for the lifetime of its eddies (Mann 1994, equations 3.12
    to 3.17). The component along the wind, x, then grows, and the vertical one, z, shrinks, as near the ground.

    Args:
        spacing: Sides of a cell [m].
        length: Integral length scale of the component along the wind [m]; with a ``gamma``, without the shear.
        spectrum: ``von_karman`` or ``kaimal``.
        gamma: Mann's shear; 0 for isotropic turbulence. Only with ``von_karman``.

    Returns:
        Velocity per standard deviation, shape (*cells, 3), float32.
    """
    check_positive("gamma", gamma, allow_zero=True)
    if any(int(n) != n or n < 4 or n % 2 for n in check_vector("cells", cells)):
        raise ValueError(f"Expected `cells` to be three even numbers of at least 4, but got {list(cells)}.")
    if math.prod(cells) > MAX_CELLS:
        raise ValueError(f"A box of {math.prod(cells):,} cells is too large (at most {MAX_CELLS:,}): lower `cells`.")
    if gamma and spectrum != "von_karman":
        raise ValueError("Mann's shear (`gamma`) is one of von Karman's spectrum: leave one of the two out.")
    device = torch.device(device)
    nx, ny, nz = (int(n) for n in cells)
    generator = torch.Generator().manual_seed(int(seed))
    noise = torch.randn(3, nx, ny, nz, generator=generator).to(device)
    waves = [torch.fft.rfftn(part) for part in noise]
    del noise
    k1, k2, k3 = _wave_numbers((nx, ny, nz), spacing, device)
    flat = k1.square() + k2.square()
    square = (flat + k3.square()).clamp(min=1e-30)
    if gamma:
        beta = shear_time(square.sqrt(), length, gamma)
        turned = k3 + beta * k1
        at_first = (flat + turned.square()).clamp(min=1e-30)
    else:
        beta, turned, at_first = k3, k3, square
    volume = math.prod(2 * math.pi / (n * h) for n, h in zip((nx, ny, nz), spacing, strict=True))
    size = energy_spectrum(at_first.sqrt(), length, spectrum).sqrt_() / at_first
    size *= math.sqrt(nx * ny * nz * volume / (4 * math.pi))
    size[nx // 2], size[:, ny // 2], size[..., nz // 2] = 0, 0, 0  # waves of two cells have no direction
    size[0, 0, 0] = 0
    noisy = [(wave * size).mul_(1j) for wave in waves]
    del waves, size
    field = torch.empty(nx, ny, nz, 3, device=device)
    up = k1 * noisy[1] - k2 * noisy[0]
    along = k2 * noisy[2] - turned * noisy[1]
    across = turned * noisy[0] - k1 * noisy[2]
    del noisy
    if gamma:
        first, second = _sheared(k1, k2, turned, beta, flat, square, at_first)
        along, across, up = along + first * up, across + second * up, at_first / square * up
    for i, part in enumerate((along, across, up)):
        field[..., i] = torch.fft.irfftn(part, s=(nx, ny, nz))
    return field


def sheared_variances(gamma: float) -> tuple[float, float, float]:
    """Variances of the three components under Mann's shear, per variance without it, for an endless box.

    A sum over 160 wave numbers, 160 angles to the wind, closer together where it is small, and 48 angles about it;
    within 1 % (tested against the values of IEC 61400-1 for 3.9).
    """
    if gamma == 0:
        return 1.0, 1.0, 1.0
    double = torch.float64
    steps = 160
    k = torch.logspace(-3, 3, steps, dtype=double)
    edges = torch.logspace(-5, 0, steps // 2, dtype=double)
    edges = torch.cat([-edges.flip(0), edges])
    cosine, width = 0.5 * (edges[1:] + edges[:-1]), edges[1:] - edges[:-1]
    angle = (torch.arange(48, dtype=double) + 0.5) / 48 * 2 * math.pi
    sine = (1 - cosine.square()).sqrt()[:, None]
    k1 = (k[:, None] * cosine)[..., None]
    k2, k3 = k[:, None, None] * (sine * angle.cos()), k[:, None, None] * (sine * angle.sin())
    flat = k1.square() + k2.square()
    square = flat + k3.square()
    beta = shear_time(square.sqrt(), 1.0, gamma)
    turned = k3 + beta * k1
    at_first = flat + turned.square()
    first, second = _sheared(k1, k2, turned, beta, flat, square, at_first)
    up = flat  # of the projection of isotropic noise, as are the next ones
    along = at_first - k1.square() - 2 * first * k1 * turned + first.square() * up
    across = at_first - k2.square() - 2 * second * k2 * turned + second.square() * up
    parts = torch.stack([along, across, (at_first / square).square() * up], dim=-1)
    weight = energy_spectrum(at_first.sqrt(), 1.0) / (4 * math.pi * at_first.square()) * width[:, None]
    weight = weight * k[:, None, None].pow(3) * (math.log(1e6) / (steps - 1) * 2 * math.pi / 48)
    total = (parts * weight[..., None]).sum((0, 1, 2)).tolist()
    return total[0], total[1], total[2]


def _wave_numbers(cells: Sequence[int], spacing: Sequence[float], device: torch.device) -> tuple[Tensor, ...]:
    """Wave numbers of a half spectrum [rad/m], to be broadcast."""
    kx, ky = (2 * math.pi * torch.fft.fftfreq(cells[i], spacing[i], device=device) for i in range(2))
    kz = 2 * math.pi * torch.fft.rfftfreq(cells[2], spacing[2], device=device)
    return kx[:, None, None], ky[:, None], kz


def _sheared(
    k1: Tensor, k2: Tensor, turned: Tensor, beta: Tensor, flat: Tensor, square: Tensor, at_first: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Return the factors :math:`\zeta_1, \zeta_2` on the vertical wave in the others (Mann 1994, 3.14 to 3.17)."""
    safe = flat.clamp(min=1e-30)
    c1 = beta * k1.square() * (at_first - 2 * turned.square() + beta * k1 * turned) / (square * safe)
    angle = torch.atan2(beta * k1 * safe.sqrt(), at_first - turned * k1 * beta)
    c2 = k2 * at_first / safe.pow(1.5) * angle
    ratio = torch.where(k1 == 0, 0.0, k2 / torch.where(k1 == 0, 1.0, k1))
    return torch.where(k1 == 0, -beta, c1 - ratio * c2), torch.where(k1 == 0, 0.0, ratio * c1 + c2)


class Turbulence(CarriedField):
    """Turbulence in space and time: a box without divergence that the mean wind carries along.

    It depends on its seed alone: not on the device, the substep or the number of Gaussians. See :func:`turbulence_box`.
    A cell of a sixteenth of the length resolves 92 % of the variance of the along-wind component, and interpolation
    between its corners takes some more of the smallest waves (docs/wind.md).

    Args:
        intensity: Standard deviation of the component along the wind per speed of the mean flow.
        length: Integral length scale [m]: roughly the size of the largest gusts. Near the ground it is about the
            height above it.
        spectrum: ``von_karman``, or ``kaimal`` for a boundary layer.
        gamma: Mann's shear, which makes gusts along the wind stronger than those up and down; 3.9 near the ground, and
            0 for isotropic turbulence. It makes gusts longer than the box can contain: raise ``spacing`` to a quarter
            of ``length``.
        cells: Cells of the box along the wind, across and up.
        spacing: Side of a cell [m]; a sixteenth of ``length`` if null.
        seed: Another seed is another turbulence.
        start: How far the air has come when the run begins [m], z up: another stretch of the same turbulence.

    Example:
        >>> gusts = Turbulence(intensity=0.2, length=1.0, cells=[32, 16, 16], spacing=0.25)
        >>> gusts.table.shape
        torch.Size([32, 16, 16, 3])
    """

    device_function = Tabulated.device_function

    def __init__(
        self,
        intensity: float = 0.15,
        length: float = 1.0,
        spectrum: str = "von_karman",
        gamma: float = 0.0,
        cells: Sequence[int] = (256, 128, 128),
        spacing: float | None = None,
        seed: int = 0,
        start: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        check_positive("intensity", intensity, allow_zero=True)
        check_positive("length", length)
        check_choice("spectrum", spectrum, SPECTRA)
        if spacing is not None:
            check_positive("spacing", spacing)
        side = length / 16 if spacing is None else float(spacing)
        table = _box(tuple(cells), side, float(length), spectrum, float(gamma), int(seed)).clone()
        relative = 1 / math.sqrt(sheared_variances(float(gamma))[0])  # the component along the wind has the intensity
        # Mann's box has a direction, and so has one whose repetition is avoided by a turn
        super().__init__(table, [side] * 3, scale=float(intensity) * relative, tilted=gamma == 0)
        self.start = torch.tensor(check_vector("start", start), dtype=torch.float64)
        self.intensity, self.length, self.spectrum, self.gamma = float(intensity), float(length), spectrum, float(gamma)

    @property
    def resolved(self) -> float:
        """Share of the variance along the wind that the cells resolve; without the shear."""
        return resolved_share(self.length, self.spacing, self.spectrum)  # type: ignore[arg-type]

    def strength(self, flow: Tensor) -> Tensor:
        """Standard deviation [m/s] in a mean flow: in proportion to its speed."""
        return self.scale * torch.linalg.vector_norm(flow, dim=-1, keepdim=True)


@lru_cache(maxsize=2)
def _box(cells: tuple[int, ...], side: float, length: float, spectrum: str, gamma: float, seed: int) -> Tensor:
    """Return :func:`turbulence_box`, cached, so that the same turbulence in another wind need not be made again."""
    return turbulence_box(cells, [side] * 3, length, spectrum, gamma, seed)


CELLS = (128, 64, 64)
"""Cells of the box of turbulence, each a sixteenth of the length."""


@dataclass(frozen=True)
class Look:
    """A wind at the height of the object, in the open.

    Attributes:
        speed: Mean speed [m/s].
        intensity: Standard deviation of the component along the wind over the mean speed.
        words: What it does, on Beaufort's scale.
    """

    speed: float
    intensity: float
    words: str


LOOKS = {
    "breeze": Look(3.0, 0.30, "leaves and twigs move"),
    "gusts": Look(8.0, 0.25, "small branches and small trees move"),
    "storm": Look(15.0, 0.22, "whole trees move"),
}
"""The looks by name."""


def turbulence_length(height: float) -> float:
    """Integral length scale of the turbulence at a height above the ground [m]: 3.2 heights, and at least 1.5 m.

    That puts the peak of Kaimal's spectrum where it was measured near the ground (Kaimal et al. 1972).
    """
    return max(3.2 * height, 1.5)


def look(
    name: str,
    direction: Sequence[float] = (1.0, 0.0, 0.0),
    *,
    height: float = 0.5,
    speed: float | None = None,
    seed: int = 0,
) -> WindField:
    """A wind of a look: its mean speed, with turbulence of von Karman's spectrum that the wind carries along.

    Args:
        name: ``breeze``, ``gusts`` or ``storm``.
        height: Height of the middle of the object above the ground [m].
        speed: Another mean speed [m/s], with the intensity of the look.

    Example:
        >>> look("breeze").flows
        tensor([[3., 0., 0.]], dtype=torch.float64)
    """
    check_choice("look", name, tuple(LOOKS))
    check_positive("height", height)
    given = LOOKS[name]
    along = torch.tensor(check_vector("direction", direction), dtype=torch.float64)
    if not bool(along.any()):
        raise ValueError("Expected `direction` of the wind to have a length, but got zero: say where it blows to.")
    if speed is not None:
        check_positive("speed", speed, allow_zero=True)
    flow = (given.speed if speed is None else speed) * along / along.norm()
    gusts = Turbulence(given.intensity, turbulence_length(height), cells=CELLS, seed=seed)
    return WindField(flow, effects=[gusts], seed=seed)
