"""Chamfer distance between point sets."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_shape
from gaussian_swaying.metrics.nearest import nearest_distances

DIRECTIONS = ("both", "average", "forward", "backward")
REDUCTIONS = ("mean", "sum")


def chamfer_distance(
    source: Tensor,
    target: Tensor,
    *,
    squared: bool = False,
    reduction: str = "mean",
    direction: str = "both",
    pairs: int | None = None,
) -> Tensor:
    r"""Chamfer distance between two sets of points (Fan et al. 2017).

    .. math::
        d(S, T) = \frac{1}{\lvert S \rvert} \sum_{x \in S} \min_{y \in T} \lvert x - y \rvert^k
                + \frac{1}{\lvert T \rvert} \sum_{y \in T} \min_{x \in S} \lvert x - y \rvert^k

    with k = 1, or k = 2 if ``squared``; ``reduction="sum"`` leaves out the two divisions. By default the two directions
    are added: two equal sheets at a distance h have d = 2 h. Papers use different definitions: Fan et al. add squares,
    PyTorch3D takes the mean of squares by default, and others use plain distances, as here.

    Args:
        source: Points [m], shape (..., P, 3), or any other number of coordinates.
        target: Points [m], shape (..., Q, 3), with the same leading dimensions.
        squared: Add squared distances.
        reduction: ``mean`` or ``sum`` over the points of each set.
        direction: ``both`` terms added, ``average`` of the two (half of that), or one term only: ``forward``, from each
            source point to the target, or ``backward``.
        pairs: Largest number of distances in memory at a time, see :func:`nearest_distances`.

    Returns:
        The distance [m], or [m²] if ``squared``, shape (...). It has no gradient.

    Raises:
        TypeError: If a set is not a tensor.
        ValueError: If the shapes do not fit, a set is empty, or an option is unknown.

    Example:
        >>> sheet = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0), torch.zeros(1))
        >>> chamfer_distance(sheet, sheet + torch.tensor([0.0, 0.0, 0.25]))
        tensor(0.5000)
    """
    check_choice("reduction", reduction, REDUCTIONS)
    check_choice("direction", direction, DIRECTIONS)
    check_shape("source", source, "P", "D")
    check_shape("target", target, "Q", source.shape[-1])
    if source.shape[:-2] != target.shape[:-2]:
        raise ValueError(
            f"Expected `target` to have the leading dimensions of `source`, {tuple(source.shape[:-2])}, but got "
            f"{tuple(target.shape[:-2])}."
        )
    leading = source.shape[:-2]
    sets = zip(*(points.reshape(leading.numel(), *points.shape[-2:]) for points in (source, target)), strict=True)
    values = [_combine(*nearest_distances(one, other, pairs), squared, reduction, direction) for one, other in sets]
    return torch.stack(values).reshape(leading) if values else source.new_empty(leading)


def _combine(forward: Tensor, backward: Tensor, squared: bool, reduction: str, direction: str) -> Tensor:
    terms = {"forward": [forward], "backward": [backward]}.get(direction, [forward, backward])
    if squared:
        terms = [term.square() for term in terms]
    values = torch.stack([term.mean() if reduction == "mean" else term.sum() for term in terms])
    return values.mean() if direction == "average" else values.sum()
