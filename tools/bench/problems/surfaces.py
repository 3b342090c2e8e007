"""The force of a steady wind on surfaces made of Gaussians, compared with the integral over the true surface."""

from __future__ import annotations

import math

import torch

from bench.problems.settings import Result
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.rotations import rotation_to_quat
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.wind.force import AeroForce

RADIUS, SIDE = 0.5, 0.8  # [m]


def sphere_of_gaussians(count: int, overlap: float, radius: float = RADIUS) -> GaussianSurfaceModel:
    """Discs on a spiral over a sphere, evenly spread.

    Units: ``radius`` [m].

    Returns:
        The surface.
    """
    index = torch.arange(count, dtype=torch.float64)
    z, angle = 1 - 2 * (index + 0.5) / count, index * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).sqrt()
    normal = torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=-1)
    helper = torch.nn.functional.one_hot(normal.abs().argmin(-1), 3).to(normal)
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, normal), dim=-1)
    axes = torch.stack([first, torch.linalg.cross(normal, first), normal], dim=-1)
    sigma = overlap * radius * math.sqrt(4 * math.pi / count)
    cloud = GaussianCloud(
        means=(radius * normal).float(),
        quats=rotation_to_quat(axes).float(),
        scales=torch.tensor([sigma, sigma, 0.1 * sigma]).log().expand(count, 3).contiguous(),
        opacities=torch.full((count,), 4.6),
        sh=torch.zeros(count, 1, 3),
        normals=None,
    )
    return GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)


def surface_drag(shape: str, count: int, overlap: float, area: str, law: str) -> Result:
    """Drag on a plate across the flow or on a sphere, as a share of the exact one.

    With C_D = 1 and the dynamic pressure q the plate of side L feels q L² in either law. Both halves of a sphere of
    radius R feel the wind, as normals are flipped along the flow: the integral of abs(n.d) gives 2 pi R² q in the law
    ``paper``, that of (n.d)² gives 4 pi R² q / 3 in ``projected``.

    Returns:
        ``error`` (relative), ``share`` of the exact force and ``gaussians``.
    """
    wind = torch.tensor([0.0, 3.0, 0.0])
    pressure = 0.5 * 1.225 * 9.0
    if shape == "plate":
        spacing = SIDE / round(math.sqrt(count))
        scene = FlagScene(width=SIDE, height=SIDE, spacing=spacing, overlap=overlap, ripple=0.0)
        model = GaussianSurfaceModel.from_cloud(scene.generate(), requires_grad=False)
        exact = pressure * SIDE**2
    else:
        model = sphere_of_gaussians(count, overlap)
        exact = pressure * RADIUS**2 * (2 * math.pi if law == "paper" else 4 * math.pi / 3)
    aero = AeroForce(C_D=1.0, C_F=0.0, C_L=0.0, law=law)
    force = aero(wind, torch.zeros(len(model), 3), model.normals(), model.areas(area)).double()
    share = float(force[:, 1].sum()) / exact
    return {"error": share - 1, "share": share, "gaussians": float(len(model))}
