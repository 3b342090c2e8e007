"""Sums over the members of groups."""

from __future__ import annotations

from torch import Tensor


def sums(values: Tensor, group: Tensor, count: int | None = None) -> Tensor:
    """Sum of values (N, ...) over the members of each group (N,), differentiable in the values.

    Args:
        values: Shape (N, ...).
        group: The group of each, from 0 on, shape (N,).
        count: Number of groups M; the largest group plus one if None.

    Returns:
        Shape (M, ...).
    """
    if count is None:
        count = int(group.max()) + 1 if len(group) else 0
    return values.new_zeros(count, *values.shape[1:]).index_add(0, group, values)
