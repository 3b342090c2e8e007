r"""Labels of Gaussians from labelled pictures, by the weights with which they are drawn.

The colour of a pixel is linear in the colours of the Gaussians, :math:`\sum_k w_k c_k`. So the weight that a Gaussian
has in all pixels of a label, :math:`A_{kl} = \sum_{p:\, l_p = l} w_{kp}`, is a derivative, and one backward pass of a
picture gives those of three labels. The label of a Gaussian is the one with the largest weight: the closed form of
FlashSplat (arXiv 2409.08270), which needs no network and no iteration.

Scribbles label a few pixels. The Gaussians that are seen there get their labels by the same weights, and the others by
a graph cut (:mod:`~gaussian_swaying.gaussians.graph_cut`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_whole
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.graph_cut import spread_labels
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.protocol import Renderer

SEEN = 1e-3  # weight [pixels] below which a Gaussian was not seen
SCRIBBLED = 0.8  # share of the weight under a scribble that its Gaussians have, the heaviest first: not what is behind


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


def scribbled(
    cloud: GaussianCloud, views: Sequence[tuple[Camera, Tensor]], smooth: float = 1.0, renderer: Renderer | None = None
) -> Tensor:
    """The label of each Gaussian, from a few labelled pixels of one or more pictures.

    Args:
        cloud: The splat.
        views: Cameras, and the label of each pixel as a whole number, shape (H, W) of the camera: 0 where nothing is
            scribbled, and 1, 2, ... in a scribble. Each label is in at least one of the pictures.
        smooth: What a border between labels costs beside differences of colour: above 1 for smoother borders.
        renderer: As in :func:`label_weights`.

    Returns:
        Labels from 0 on, one less than in the pictures, int64, shape (N,). What no scribble is connected to has the
        label whose scribbles have its colour.

    Raises:
        ValueError: If the labels of a view are not of the size of its picture, or there is no view; if there is no
            scribble, a label is missing, or nothing of the splat is under it.
    """
    views = list(views)
    for _, labels in views:
        if labels.is_floating_point() or labels.dtype == torch.bool or int(labels.min()) < 0:
            raise ValueError(
                f"Expected scribbles of whole numbers from 0 on, 0 for pixels without one, but got {labels.dtype} "
                f"from {float(labels.min()):g}."
            )
    count = max((int(labels.max()) for _, labels in views), default=0)
    if views and count == 0:
        raise ValueError("The pictures have no scribble: draw one of 1, 2, ... on at least two things.")
    drawn = {int(label) for _, labels in views for label in labels.unique()}
    for label in range(1, count + 1):
        if label not in drawn:
            raise ValueError(
                f"The scribbles go up to {count}, but none is {label}: number them from 1 on without gaps."
            )
    weights = label_weights(cloud, views, count + 1, renderer)[:, 1:]
    seeds = torch.full((len(cloud),), -1, device=weights.device)
    best, lead = weights.max(-1)
    for label in range(count):
        own = ((lead == label) & (best > SEEN)).nonzero()[:, 0]
        order = own[best[own].argsort(descending=True, stable=True)]
        heavy = best[order].cumsum(0)
        if len(order) == 0:
            raise ValueError(f"Nothing of the splat is seen under the scribble {label + 1}: draw it on the object.")
        seeds[order[heavy - best[order] < SCRIBBLED * heavy[-1]]] = label
    return spread_labels(cloud, seeds, count, smooth)
