"""Level of detail: of Gaussians much smaller than a pixel, some are drawn for all.

Stochastic simplification (Cook, Halstead, Planck and Ryu 2007, "Stochastic Simplification of Aggregate Detail", ACM
Transactions on Graphics 26(3), 79), with the blur of the renderer taken into account.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import BLUR

DETAIL = 1 / 3
"""Size [pixels] below which Gaussians are thinned in previews and on the live page."""
FEWEST = 1 / 64
"""Smallest share that is kept."""
GOLDEN = 2654435769  # 2^32 by the golden ratio: its multiples, modulo 2^32, are spread evenly


def thinned(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    detail: float = DETAIL,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r"""A random subset of the Gaussians that looks like all of them.

    The projected size s of a Gaussian is the root of the Frobenius norm of its covariance, times focal length per
    depth; no standard deviation of its projection is larger, but for the perspective at the border. Of those with s
    below the detail d, the share :math:`q = (s / d)^2` is kept, chosen by the index alone, so that it is the same in
    every frame. Each of these covers for 1 / q of them. Its covariance is divided by q, so that its area is that of
    all; the blur :math:`\epsilon` of the renderer adds to both, so the area that is drawn grows only by

    .. math::
        g = \frac{\epsilon + s^2 / q}{\epsilon + s^2},

    and its opacity o becomes :math:`1 - (1 - o)^{1 / (q g)}`: the optical depth, times the area, is that of all.

    Args:
        colors: Colours, shape (N, 3).
        detail: The size d [pixels].

    Returns:
        Centres, covariances, opacities and colours of the M Gaussians to be drawn.
    """
    view, focal = camera.world_to_camera, float(camera.intrinsics.diagonal()[:2].max())
    depth = (means @ view[2, :3] + view[2, 3]).clamp_min(camera.near)
    size2 = torch.linalg.vector_norm(covariances, dim=(-2, -1)) * (focal / depth) ** 2
    share = (size2 / detail**2).clamp(FEWEST, 1.0)
    place = (torch.arange(len(means), device=means.device) * GOLDEN % 2**32).to(share) / 2**32
    index = ((place < share) | ~(share < 1)).nonzero()[:, 0]  # what is not finite is left to the renderer
    if len(index) == len(means):
        return means, covariances, opacities, colors
    share, size2, opacity = share[index], size2[index], opacities[index]
    grown = (BLUR + size2 / share + 1e-30) / (BLUR + size2 + 1e-30)
    opacity = torch.where(share < 1, 1 - (1 - opacity).clamp_min(1e-7) ** (1 / (share * grown)), opacity)
    return means[index], covariances[index] / share[:, None, None], opacity, colors[index]
