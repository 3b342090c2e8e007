"""How far a standing thing leans in the wind, as a beam, and the stiffness with which it leans as far as wanted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gaussian_swaying.aero.force import aero_force
from gaussian_swaying.gaussians.ply import GaussianCloud

# what is not a sheet: a shell of soft rubber in the wind of the paper's captures
SHELL_E = 3e5  # Pa
SHELL_THICKNESS = 0.01  # of the longest side
SHELL_AERO = {"drag": 0.5, "friction": 0.4, "lift": 0.01, "law": "projected"}
LEAN = 0.08  # mean displacement that a standing thing is meant to reach in the steady flow, of the longest side
SOFTER, STIFFER = 0.1, 3.0  # how far its stiffness goes from SHELL_E, as it costs substeps; then the wind is weakened


def thinned(cloud: GaussianCloud, most: int = 20_000) -> GaussianCloud:
    """An even sample of a splat, its Gaussians enlarged so that they cover about the same surface."""
    step = math.ceil(len(cloud) / most)
    part = cloud.select(torch.arange(0, len(cloud), step))
    return replace(part, scales=part.scales + 0.5 * math.log(step))


def cantilever_lean(
    position: Tensor,
    height: Tensor,
    normal: Tensor,
    area: Tensor,
    flow: Sequence[float],
    E: float,
    thickness: float,
    dx: float,
) -> float:
    r"""Mean displacement [m] of a standing shell in a steady wind, as an Euler-Bernoulli beam of its cross-sections.

    In slices one cell high: the second moment of area I of the patches about the slice's middle, across the wind; the
    bending moment M of the wind on the patches above; and the displacement as the double integral of M / (E I). Small
    displacements are assumed, so that large values only say that it will be blown over.

    Args:
        position: Positions [m], z up, shape (P, 3).
        height: Height above where it is held [m], zero for what is held, shape (P,).
        normal: Unit normals, shape (P, 3).
        area: Patch areas [m²], shape (P,).
        flow: Air velocity [m/s].
        E: Young's modulus [Pa].
        thickness: Thickness of the shell [m].
        dx: Grid spacing [m]; nothing is thinner to the grid than a uniform bar of this side.

    Returns:
        Mean displacement over the area [m].
    """
    wind = torch.tensor(flow, dtype=torch.float64)
    along = wind / wind.norm()
    force = aero_force(wind, torch.zeros_like(position), normal, area, **SHELL_AERO) @ along  # type: ignore[arg-type]
    slice_of = (height / dx).long()
    count = int(slice_of.max()) + 1

    def total(values: Tensor) -> Tensor:
        return torch.zeros(count, dtype=torch.float64).index_add_(0, slice_of, values)

    volume = total(area * thickness).clamp(min=1e-30)
    across = position @ along
    middle = total(area * thickness * across) / volume
    moment_of_area = (total(area * thickness * (across - middle[slice_of]) ** 2) + volume * dx**2 / 12) / dx
    load, level = total(force), (torch.arange(count, dtype=torch.float64) + 0.5) * dx
    moment = torch.stack([(load * (level - z).clamp(min=0)).sum() for z in level])
    slope = (moment / (E * moment_of_area) * dx).cumsum(0)
    lean = (slope * dx).cumsum(0)
    return float((area * lean[slice_of] * (height > 0)).sum() / area.sum())


def stiffness_for(lean: float) -> tuple[float, float]:
    """Young's modulus [Pa] and factor on the wind with which a standing thing leans by ``LEAN``.

    Args:
        lean: What it leans with ``SHELL_E``, as a share of its longest side.

    Returns:
        The modulus to one digit, and the factor, at most 1.
    """
    modulus = float(f"{SHELL_E * min(max(lean / LEAN, SOFTER), STIFFER):.0e}")
    rest = lean * SHELL_E / modulus / LEAN
    return modulus, float(f"{min(1.0, rest**-0.5 if rest > 1.5 else 1.0):.2g}")
