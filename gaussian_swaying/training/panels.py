"""Panels to look at during training, and the LPIPS metric."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.colormap import colormap
from gaussian_swaying.rendering.protocol import Renderer

# the files that torchvision would download
_BACKBONES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth", "squeeze": "squeezenet1_1-b8a52dc0.pth"}
LPIPS_SIDE = 32
"""Fewest pixels on a side that the backbones of LPIPS take."""


@torch.no_grad()
def panel(
    model: GaussianSurfaceModel, renderer: Renderer, camera: Camera, photo: Tensor, image: Tensor | None = None
) -> Tensor:
    """Photo, render, normals and area side by side.

    Normals are those of the patches, flipped to the camera, in its axes: red to the right, green up, blue towards it.
    Areas are pi s1 s2 on a logarithmic scale from the 5th to the 95th percentile.

    Args:
        model: The Gaussians.
        renderer: The renderer.
        camera: The camera.
        photo: Photo, shape (H, W, 3).
        image: Render, shape (H, W, 3); rendered over black if None.

    Returns:
        Picture from 0 to 1, shape (H, 4 W, 3).
    """
    camera = camera.to(model.means.device, model.means.dtype)
    gaussians = (model.means, model.covariance(), model.opacity())
    view = model.means - camera.position
    if image is None:
        image = renderer(*gaussians, model.colors(view), camera).color
    normals = model.normals()
    normals = torch.where((normals * view).sum(-1, keepdim=True) > 0, -normals, normals)
    axes = camera.world_to_camera[:3, :3] * torch.tensor([[1.0], [-1.0], [-1.0]]).to(normals)
    normal_colors = 0.5 + 0.5 * (normals @ axes.T)
    areas = model.areas("paper").log()
    if len(areas):
        some = areas[:: len(areas) // 100_000 + 1]  # quantile is limited in size
        low, high = some.quantile(0.05), some.quantile(0.95)
        areas = (areas - low) / (high - low).clamp_min(1e-6)
    drawn = [renderer(*gaussians, colors, camera).color for colors in (normal_colors, colormap(areas))]
    return torch.cat([photo.to(image), image, *drawn], dim=1).clamp(0.0, 1.0)


def lpips_metric(net: str = "alex") -> Any | None:
    """The LPIPS metric (Zhang et al. 2018) of torchmetrics, if all that it needs is on this machine.

    Args:
        net: Backbone: ``alex``, ``vgg`` or ``squeeze``.

    Returns:
        The metric for pictures from 0 to 1, or None without torchvision or without the weights of the backbone in
        torch's folder of checkpoints. Nothing is downloaded.

    Raises:
        ValueError: If there is no such backbone.
    """
    check_choice("net", net, tuple(_BACKBONES))
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    if importlib.util.find_spec("torchvision") is None or not (folder / _BACKBONES[net]).is_file():
        return None
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=True)  # type: ignore[arg-type]
