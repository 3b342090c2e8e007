"""Chamfer distance between point sets."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying.metrics.nearest import nearest_distances


def chamfer_distance(source: Tensor, target: Tensor) -> Tensor:
    r"""Chamfer distance between two sets of points (Fan et al. 2017).

    .. math::
        d(S, T) = \frac{1}{\lvert S \rvert} \sum_{x \in S} \min_{y \in T} \lvert x - y \rvert
                + \frac{1}{\lvert T \rvert} \sum_{y \in T} \min_{x \in S} \lvert x - y \rvert

    The two directions are added: two equal sheets at a distance h have d = 2 h. Papers use different definitions: Fan
    et al. add squares, PyTorch3D takes the mean of squares, and others use plain distances, as here.

    Args:
        source: Points [m], shape (..., P, 3), or any other number of coordinates.
        target: Points [m], shape (..., Q, 3), with the same leading dimensions.

    Returns:
        The distance [m], shape (...). It has no gradient.

    Raises:
        TypeError: If a set is not a tensor.
        ValueError: If the shapes do not fit, or a set is empty.

    Example:
        >>> sheet = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0), torch.zeros(1))
        >>> chamfer_distance(sheet, sheet + torch.tensor([0.0, 0.0, 0.25]))
        tensor(0.5000)
    """
    check_shape("source", source, "P", "D")
    leading = source.shape[:-2]
    check_shape("target", target, *leading, "Q", source.shape[-1], batches=False)
    for name, points in (("source", source), ("target", target)):
        if points.shape[-2] == 0:
            raise ValueError(f"Expected `{name}` to hold at least one point, but it is empty.")
    sets = zip(*(points.reshape(-1, *points.shape[-2:]) for points in (source, target)), strict=True)
    both = (nearest_distances(one, other) for one, other in sets)
    values = [forward.mean() + backward.mean() for forward, backward in both]
    return torch.stack(values).reshape(leading) if values else source.new_empty(leading)
