"""Panels to look at during training, and the metrics of a picture."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from einops import rearrange
from torch import Tensor

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.metrics.ssim import SSIM_TAPS
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.passes import colormap
from gaussian_swaying.rendering.protocol import Renderer


@torch.no_grad()
def panel(
    model: GaussianSurfaceModel, renderer: Renderer, camera: Camera, photo: Tensor, image: Tensor | None = None
) -> Tensor:
    """Photo, render, normals and area side by side.

    Normals are those of the patches, flipped to the camera, in its axes: red to the right, green up, blue towards it.
    Areas are pi s1 s2 on a logarithmic scale from the 5th to the 95th percentile.

    Args:
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


def write_panel(pictures: Tensor, folder: Path, name: str, step: int, loggers: Iterable[Any] = ()) -> None:
    """Write a panel as PNG with its step in its name, and show it on the boards of loggers that take pictures."""
    from imageio.v3 import imwrite

    folder.mkdir(parents=True, exist_ok=True)
    pixels = (pictures * 255.0).round().clamp(0, 255).to(torch.uint8).cpu()
    imwrite(folder / f"{name}_{step:06d}.png", pixels.numpy())
    for logger in loggers:
        board: Any = getattr(logger, "experiment", None)
        if hasattr(board, "add_image"):
            board.add_image(name, pixels.numpy(), step, dataformats="HWC")


def picture_metrics(image: Tensor, target: Tensor) -> dict[str, Tensor]:
    """PSNR [dB], and SSIM where a picture is large enough for it.

    Args:
        image: Picture from 0 to 1, shape (H, W, 3).
        target: Photo, of the same shape.
    """
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    one, two = (rearrange(picture, "h w c -> 1 c h w").float() for picture in (image, target))
    values = {"psnr": peak_signal_noise_ratio(one, two, data_range=1.0)}
    if min(image.shape[:2]) >= SSIM_TAPS:
        ssim = structural_similarity_index_measure(one, two, data_range=1.0)
        assert isinstance(ssim, Tensor)
        values["ssim"] = ssim
    return values
