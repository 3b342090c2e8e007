"""Gaussians of a part, from one of them: what is connected to it, or looks like it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.groups import joined
from gaussian_swaying.geometry.neighbours import nearest_neighbours, particle_spacing
from gaussian_swaying.geometry.patches import smallest_axis_normal

NEIGHBOURS = 12  # to which a Gaussian may be connected
REACH = 4.0  # spacings of the Gaussians within which they are


def connected(cloud: GaussianCloud, seed: Sequence[float], reach: float | None = None) -> Tensor:
    """The Gaussians that are connected to a place, from neighbour to neighbour, bool, shape (N,).

    Args:
        seed: A place [scene units]; its nearest Gaussian is the first.
        reach: Twice the side of a cell [scene units]; Gaussians in the same or in touching cells are connected. Four
            spacings if None (see :func:`~gaussian_swaying.geometry.neighbours.particle_spacing`).
    """
    means = cloud.means.detach()
    part = connected_parts(means, 0.5 * _reach(means, reach))
    return part == part[_nearest(means, seed)]


def alike(
    cloud: GaussianCloud, seed: Sequence[float], color: float = 0.2, angle: float = 30.0, reach: float | None = None
) -> Tensor:
    """The Gaussians that are connected to a place and look like it, bool, shape (N,).

    Args:
        seed: A place [scene units]; its nearest Gaussian is the first.
        color: Largest difference from the mean colour there, as a distance in red, green and blue from 0 to 1.
        angle: Largest angle between the normals of two neighbours, of either sign [degrees]; 90 to ignore them.
        reach: Neighbours farther apart than this are not connected [scene units]; four spacings if None.
    """
    check_positive("color", color)
    if not 0 < angle <= 90:
        raise ValueError(f"Expected `angle` to be above 0 and at most 90 degrees, but got {angle}.")
    means = cloud.means.detach()
    first = _nearest(means, seed)
    distance, index = nearest_neighbours(means, min(NEIGHBOURS, len(means) - 1))
    close = distance <= _reach(means, reach)
    pairs = torch.stack([close.nonzero()[:, 0], index[close]])
    seen = (0.5 + SH_DC * cloud.sh.detach()[:, 0].double()).clamp(0, 1)
    around = torch.cat([pairs[1, pairs[0] == first], first[None]])
    near = (seen - seen[around].median(0).values).norm(dim=-1) <= color
    near[first] = True
    normal = smallest_axis_normal(cloud.quats, cloud.scales).detach().double()
    a, b = pairs
    along = (normal[a] * normal[b]).sum(-1).abs() >= torch.tensor(angle).deg2rad().cos() - 1e-9
    part = joined(len(cloud), pairs[:, near[a] & near[b] & along])
    return part == part[first]


def _nearest(means: Tensor, seed: Sequence[float]) -> Tensor:
    place = torch.tensor(check_vector("seed", seed), dtype=torch.float64, device=means.device)
    return (means.double() - place).square().sum(-1).argmin()


def _reach(means: Tensor, reach: float | None) -> float:
    if reach is None:
        return REACH * max(particle_spacing(means), 1e-30)
    check_positive("reach", reach)
    return reach
