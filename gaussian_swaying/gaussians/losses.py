"""What a format cannot hold of Gaussians, counted: the one place that knows the range of each."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.compact import CHUNK
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.sog import PALETTE
from gaussian_swaying.gaussians.spz import COLOR_SCALE, fraction_bits

_ANY = math.inf
_RANGES = {
    "compressed_ply": (-20, 20, _ANY, 4),
    "splat": (-_ANY, _ANY, 0.5 / SH_DC, 0),
    "spz": (-10, 255 / 16 - 10, 0.5 / COLOR_SCALE, 1),
}
"""Logarithms of the smallest and the largest size, and the largest harmonics of degree 0 and above, where they end."""
_FAINTEST = 1 / 255  # opacity that a compressed .ply leaves out
_SLACK = 1e-4  # a number at the end of a range is in it


def losses(cloud: GaussianCloud, format: str, spz_version: int = 3) -> list[str]:
    """What a file will not hold, with the number of Gaussians: a part of a sentence for each kind.

    Args:
        cloud: The Gaussians, cleaned.
        format: As in :func:`~gaussian_swaying.gaussians.export.export_cloud`.
        spz_version: Version of SPZ.
    """
    told, count, cloud = list[str](), len(cloud), cloud.to("cpu", torch.float32)
    low, high, color, most = _RANGES.get(format, (-_ANY, _ANY, _ANY, _ANY))
    thin, wide = cloud.scales.amin(-1), cloud.scales.amax(-1)
    rest = cloud.sh.new_zeros(count, 1) if cloud.sh_degree == 0 or not most else cloud.sh[:, 1:].flatten(1).abs()
    faintest = _FAINTEST if format == "compressed_ply" else 0
    steps, factor = _steps(cloud, format, spz_version), math.exp(min(low - float(thin.min()), 700))
    for lost, what in (
        (cloud.opacities.sigmoid() <= faintest, f"are fainter than {faintest:.2g} and left out"),
        (thin < low - _SLACK, f"have a size below {math.exp(low):.2g}, which becomes that: up to {factor:.3g} times "
         "as thick (scale the scene up, or choose .glb or .sog)"),
        (wide > high + _SLACK, f"have a size above {math.exp(min(high, 700)):.3g}, which becomes that: the largest is "
         f"{math.exp(float(wide.max())):.3g}"),
        (cloud.sh[:, 0].abs().amax(-1) > color + _SLACK, "have a colour that is cut off"),
        (rest.amax(-1) > most + _SLACK,
         f"have harmonics up to ±{float(rest.max()):.3g}, which are cut off at ±{most:g}"),
        (wide.exp() < steps, f"are smaller than the steps of their centres, {float(steps.max()):.3g} and less"),
    ):  # fmt: skip
        if bool(lost.any()):
            told.append(f"{int(lost.sum()):,} of {count:,} Gaussians {what}")
    if cloud.sh_degree and not most:
        told.append("harmonics of degree 1 and above are left out")
    if format == "sog" and cloud.sh_degree and count > PALETTE:
        told.append(f"the harmonics of {count:,} Gaussians share {PALETTE:,} sets")
    if any(cloud.origin) and format not in ("ply", "glb", "usd"):
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
    if format == "compressed_ply":
        return _steps_of_chunks(cloud.means, cloud.opacities.sigmoid() > _FAINTEST)
    return torch.zeros_like(places[:, 0])


def _steps_of_chunks(means: Tensor, kept: Tensor) -> Tensor:
    """The same of a compressed .ply: a chunk holds 256 Gaussians of its order, with 10 or 11 bits for their range."""
    from gsplat.exporter import sort_centers

    (index,) = kept.nonzero(as_tuple=True)
    order = index[sort_centers(means[index], torch.arange(len(index)))]
    steps = torch.zeros_like(means[:, 0])
    for chunk in order.split(CHUNK):
        steps[chunk] = ((means[chunk].amax(0) - means[chunk].amin(0)) / 1023).max()
    return steps
