"""The renderer for a device."""

from __future__ import annotations

import warnings

import torch

from gaussian_swaying.rendering.protocol import SplatRenderer


def make_renderer(device: torch.device | str, packed: bool = False) -> SplatRenderer:
    """Return the renderer for a device: gsplat with CUDA, the torch renderer otherwise.

    If gsplat cannot compile its kernels (no ``nvcc``), the torch renderer draws on the GPU, with a warning.

    Args:
        device: The device.
        packed: See :class:`~gaussian_swaying.rendering.gsplat_renderer.GsplatRenderer`.
    """
    from gaussian_swaying.rendering.torch_renderer import TorchRenderer

    if torch.device(device).type != "cuda" or not torch.cuda.is_available():
        return TorchRenderer()
    from gaussian_swaying.rendering.gsplat_renderer import GsplatRenderer, gsplat_works

    if gsplat_works():
        return GsplatRenderer(packed=packed)
    warnings.warn(
        "gsplat cannot compile its CUDA kernels here (it needs nvcc of torch's CUDA version): drawing with the slower "
        "torch renderer instead.",
        stacklevel=2,
    )
    return TorchRenderer()
