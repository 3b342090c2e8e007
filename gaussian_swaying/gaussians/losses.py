"""What a format cannot hold of Gaussians, counted: the one place that knows the range of each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.sog import PALETTE
from gaussian_swaying.gaussians.spz import COLOR_SCALE, fraction_bits

_ANY = math.inf


@dataclass(frozen=True, slots=True)
class Range:
    """The numbers that a format holds.

    Attributes:
        sizes: Logarithms of the smallest and the largest size.
        color: Harmonics of degree 0, up to this on both sides of zero.
        harmonics: The same of the others.
        degree: Largest degree of the harmonics.
        faintest: Opacity from which on Gaussians are kept.
        origin: Whether centres may count from an origin.
    """

    sizes: tuple[float, float] = (-_ANY, _ANY)
    color: float = _ANY
    harmonics: float = _ANY
    degree: int = 3
    faintest: float = 0.0
    origin: bool = False


RANGES: dict[str, Range] = {
    "ply": Range(origin=True),
    "compressed_ply": Range(sizes=(-20, 20), harmonics=4, faintest=1 / 255),
    "splat": Range(color=0.5 / SH_DC, degree=0),
    "spz": Range(sizes=(-10, 255 / 16 - 10), color=0.5 / COLOR_SCALE, harmonics=1),
    "sog": Range(),
    "glb": Range(origin=True),
    "usd": Range(origin=True),
}
_SLACK = 1e-4  # a number at the end of a range is in it


def losses(cloud: GaussianCloud, format: str, spz_version: int = 3) -> list[str]:
    """What a file will not hold, with the number of Gaussians: a part of a sentence for each kind.

    Args:
        cloud: The Gaussians, cleaned.
        format: A key of :data:`RANGES`.
        spz_version: Version of SPZ.
    """
    held, told, count = RANGES[format], list[str](), len(cloud)
    low, high = held.sizes
    rest = cloud.sh[:, 1 : (held.degree + 1) ** 2].flatten(1)
    opacity = cloud.opacities.sigmoid()
    thin, wide = cloud.scales.amin(-1), cloud.scales.amax(-1)
    steps = _steps(cloud, format, spz_version)
    least, most = float(thin.min()), float(wide.max())
    for lost, what in (
        (opacity <= held.faintest, f"are fainter than {held.faintest:.2g} and left out"),
        (thin < low - _SLACK, f"have a size below {math.exp(low):.2g}, which becomes that: up to "
         f"{math.exp(min(low - least, 700)):.3g} times as thick (scale the scene up, or choose .glb or .sog)"),
        (wide > high + _SLACK, f"have a size above {math.exp(min(high, 700)):.3g}, which becomes that: the largest is "
         f"{math.exp(most):.3g}"),
        (cloud.sh[:, 0].abs().amax(-1) > held.color + _SLACK, "have a colour that is cut off"),
        ((rest.abs() > held.harmonics + _SLACK).any(-1),
         f"have harmonics up to ±{float(cloud.sh.abs().max()):.3g}, which are cut off at ±{held.harmonics:g}"),
        (wide.exp() < steps, f"are smaller than the steps of their centres, {float(steps.max()):.3g} and less"),
    ):  # fmt: skip
        if bool(lost.any()):
            told.append(f"{int(lost.sum()):,} of {count:,} Gaussians {what}")
    if cloud.sh_degree > held.degree:
        told.append(f"harmonics of degree {held.degree + 1} and above are left out")
    if format == "sog" and cloud.sh_degree and count > PALETTE:
        told.append(f"the harmonics of {count:,} Gaussians share {PALETTE:,} sets")
    if any(cloud.origin) and not held.origin:
        told.append(f"centres count from {list(cloud.origin)}, which the file does not hold")
    return told


def _steps(cloud: GaussianCloud, format: str, spz_version: int) -> Tensor:
    """Distance between the places that a centre can have [scene units], shape (N,)."""
    places = cloud.means.double().abs()
    if format == "spz" and spz_version > 1:
        return torch.full_like(places[:, 0], 2.0 ** -fraction_bits(float(places.max())))
    if format == "spz":
        return places.amax(-1) * 2.0**-10
    if format == "sog":
        logs = cloud.means.double().sign() * places.log1p()
        return ((logs.amax(0) - logs.amin(0)) / 65535 * (1 + places)).amax(-1)
    return torch.zeros_like(places[:, 0])
