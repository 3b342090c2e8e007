r"""Labels of Gaussians from labelled pictures, by the weights with which they are drawn.

The colour of a pixel is linear in the colours of the Gaussians, :math:`\sum_k w_k c_k`. So the weight that a Gaussian
has in all pixels of a label, :math:`A_{kl} = \sum_{p:\, l_p = l} w_{kp}`, is a derivative, and one backward pass of a
picture gives those of three labels. The label of a Gaussian is the one with the largest weight: the closed form of
FlashSplat (arXiv 2409.08270), which needs no network and no iteration.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from gaussian_swaying._checks import check_whole
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.protocol import Renderer

SEEN = 1e-3  # weight [pixels] below which a Gaussian was not seen


def label_weights(
    cloud: GaussianCloud, views: Iterable[tuple[Camera, Tensor]], count: int, renderer: Renderer | None = None
) -> Tensor:
    """The weight of each Gaussian in the pixels of each label.

    Args:
        cloud: The splat.
        views: Cameras, and the label of each pixel as a whole number, shape (H, W) of the camera; bool for a mask.
            Labels below 0 or from ``count`` on do not count.
        count: Number of labels: 2 for masks.
        renderer: Draws with gradients; gsplat on a GPU and torch elsewhere if None.

    Returns:
        Weights [pixels], float64, shape (N, count).

    Raises:
        ValueError: If the labels of a view are not of the size of its picture, or there is no view.
    """
    check_whole("count", count, 1)
    renderer = make_renderer(cloud.means.device) if renderer is None else renderer
    means = cloud.means.detach()
    with torch.no_grad():
        shape, opacity = covariance(cloud.quats, cloud.scales), torch.sigmoid(cloud.opacities.detach())
    total = torch.zeros(len(means), count, dtype=torch.float64, device=means.device)
    seen = False
    for camera, labels in views:
        seen = True
        if tuple(labels.shape) != (camera.height, camera.width):
            raise ValueError(
                f"Expected labels of {camera.height} rows and {camera.width} columns, as the camera has pixels, but "
                f"got {tuple(labels.shape)}: resize them, without blending labels."
            )
        own = labels.to(means.device).long()
        for first in range(0, count, 3):
            channels = torch.stack([own == first + c for c in range(3)], -1)
            colours = torch.zeros_like(means).requires_grad_()
            with torch.enable_grad():
                picture = renderer(means, shape, opacity, colours, camera.to(means.device)).color
                (weight,) = torch.autograd.grad((picture * channels).sum(), colours)
            total[:, first : first + 3] += weight[:, : count - first].double()
    if not seen:
        raise ValueError("There is no view to take labels from: give at least one camera with its labels.")
    return total


def voted(weights: Tensor, bias: float = 0.0) -> Tensor:
    """The label of each Gaussian, int64, shape (N,); -1 if it was not seen.

    Args:
        weights: From :func:`label_weights`, shape (N, L).
        bias: Added to the share of label 0, from -1 to 1: above 0 the other labels must lead by as much, which removes
            the fringes of inaccurate masks.

    Raises:
        ValueError: If ``bias`` is out of range.
    """
    if not -1 <= bias <= 1:
        raise ValueError(f"Expected `bias` to be from -1 to 1, but got {bias}.")
    sum_of = weights.sum(-1, keepdim=True)
    share = weights / sum_of.clamp(min=SEEN)
    share = torch.cat([share[:, :1] + bias, share[:, 1:]], -1)
    return torch.where(sum_of[:, 0] < SEEN, -1, share.argmax(-1))
