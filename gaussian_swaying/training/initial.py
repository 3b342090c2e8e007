"""Initial Gaussians for training."""

from __future__ import annotations

import math
import os
from dataclasses import replace

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.neighbours import nearest_neighbours


def gaussians_from_points(
    points: Tensor, colors: Tensor, sh_degree: int = 3, opacity: float = 0.1, scale: float = 1.0
) -> GaussianCloud:
    """Round Gaussians at points, as large as the distance to their neighbours (Kerbl et al. 2023, section 5.2).

    Args:
        points: Centres [scene units], shape (N, 3).
        colors: RGB colours from 0 to 1, shape (N, 3).
        sh_degree: Degree of the spherical harmonics, 0 to 3; all but the constant start at zero.
        opacity: Opacity of all, between 0 and 1.

    Returns:
        The Gaussians on the CPU in float32.
    """
    points, colors = points.detach().cpu().float(), colors.detach().cpu().float()
    count = len(points)
    if count > 1:
        distance, _ = nearest_neighbours(points, min(3, count - 1))
        spread = distance.square().mean(-1).sqrt()
        positive = spread[spread > 0]
        floor = 1e-3 * float(positive.median()) if len(positive) else 1e-3
        sigma = scale * spread.clamp_min(floor)
    else:
        sigma = torch.full((1,), 0.01 * scale)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (colors - 0.5) / SH_DC
    return GaussianCloud(
        means=points,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=sigma.log()[:, None].repeat(1, 3),
        opacities=torch.full((count,), math.log(opacity / (1.0 - opacity))),
        sh=sh,
    )


def gaussians_from_file(path: str | os.PathLike[str], sh_degree: int) -> GaussianCloud:
    """The Gaussians of a splat, with harmonics of this degree: higher ones are left out, missing ones are zero.

    Args:
        sh_degree: The degree, 0 to 3.
    """
    cloud = read_gaussians(path)
    wanted = (sh_degree + 1) ** 2
    sh = cloud.sh[:, :wanted]
    missing = sh.new_zeros(len(cloud), wanted - sh.shape[1], 3)
    return replace(cloud, sh=torch.cat([sh, missing], 1))
