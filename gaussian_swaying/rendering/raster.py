"""The renderer in kernels for a CPU: tiles, front to back, each until its pixels are full.

The definition is :mod:`~gaussian_swaying.rendering.torch_renderer`.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from gaussian_swaying.kernels.language import INTERPRETED, triton
from gaussian_swaying.kernels.launch import LANES, compiles, launch
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import BLUR, RenderOutput
from gaussian_swaying.rendering.raster_kernels import (
    HEIGHT,
    ROW,
    STATE,
    WIDTH,
    blend,
    count_pairs,
    list_pairs,
    project,
)

CHUNKS = 16
"""Parts of the Gaussians, from front to back, that are listed at the same time."""
PROGRAMS = 256
"""Most programs that blend; each takes every 256th tile."""
MOST_PAIRS = 1 << 28
"""Most pairs of a tile and a Gaussian that are listed: 1 GiB."""


def runs(tensors: Iterable[Tensor]) -> bool:
    """True if :func:`render` supports these tensors: float32 on a CPU, without gradients."""
    if INTERPRETED or not compiles("cpu"):
        return False
    return all(
        tensor.device.type == "cpu"
        and tensor.dtype == torch.float32
        and not (tensor.requires_grad and torch.is_grad_enabled())
        for tensor in tensors
    )


def render(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Tensor | None,
    detail: float = 0.0,
) -> RenderOutput | None:
    """Draw Gaussians as ``render_torch``, thinned if there is a detail, from float32 on a CPU, without gradients.

    The same bits for any number of threads.

    Args:
        detail: Size below which Gaussians are thinned [pixels]; 0 for none.

    Returns:
        The picture; None if there are more than :data:`MOST_PAIRS`.
    """
    count, width, height = len(means), camera.width, camera.height
    across = triton.cdiv(width, WIDTH)
    tiles = across * triton.cdiv(height, HEIGHT)
    given = [tensor.detach().contiguous() for tensor in (means, covariances, opacities, colors)]
    view = [camera.world_to_camera.reshape(-1), camera.intrinsics.reshape(-1)]
    numbers = torch.cat(
        [*(part.detach().cpu().double() for part in view), torch.tensor([camera.near, BLUR, detail**2]).double()]
    )
    rows = torch.empty(count, ROW // 2, dtype=torch.float64)
    depths, boxes = torch.empty(count, dtype=torch.float64), torch.empty(count, 4, dtype=torch.int32)
    lines = rows.view(torch.float32)
    if count > 0:
        launch(project, (triton.cdiv(count, LANES),))(
            *given, numbers, lines, rows, depths, boxes, count, width, height, BLOCK=LANES
        )
    order = torch.sort(depths.view(torch.int64), stable=True)[1]  # the bits of positive numbers rise with them
    counts = torch.zeros(CHUNKS, tiles, dtype=torch.int32)
    launch(count_pairs, (CHUNKS,))(order, boxes, counts, count, across, tiles)
    ends = counts.mT.flatten().cumsum(0)  # tile by tile, and within each from front to back
    starts = (ends.view(tiles, CHUNKS) - counts.mT).mT.contiguous()
    bounds = torch.cat([starts[0], ends[-1:]])
    if int(bounds[-1]) > MOST_PAIRS:
        return None
    pairs = torch.empty(int(bounds[-1]), dtype=torch.int32)
    launch(list_pairs, (CHUNKS,))(order, boxes, starts, pairs, count, across, tiles)
    programs = min(tiles, PROGRAMS)
    states = torch.empty(programs, HEIGHT, STATE, WIDTH)
    behind = torch.zeros(3) if background is None else background.detach().to("cpu", torch.float32).contiguous()
    color, alpha, depth = (torch.empty(height, width, n) for n in (3, 1, 1))
    launch(blend, (programs,))(
        bounds, pairs, lines, rows, states, behind, color, alpha, depth, across, tiles, width, height, LANE=WIDTH
    )
    return RenderOutput(color, alpha, depth)
