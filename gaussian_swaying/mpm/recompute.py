"""Gradients through long rollouts with the memory of a short one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.mpm.state import MPMState

Advance = Callable[[MPMState], MPMState]
Layout = dict[str, tuple[int | None, Any]]


def leaves_of(state: MPMState) -> list[Tensor]:
    """The tensors with ``requires_grad`` that a state was computed from."""
    pending: list[Any] = [t.grad_fn for t in _flatten(state)[1] if t.grad_fn is not None]
    seen, found = set(pending), []
    while pending:
        node = pending.pop()
        if hasattr(node, "variable"):
            found.append(node.variable)
        for following, _ in node.next_functions:
            if following is not None and following not in seen:
                seen.add(following)
                pending.append(following)
    return found


def rollout(
    substep: Callable[[MPMState, int], MPMState],
    state: MPMState,
    steps: int,
    checkpoint: int,
    watch: Callable[[int], None] | None,
) -> MPMState:
    """Several substeps; ``checkpoint`` and ``watch`` as in ``MPMSolver.rollout``.

    Args:
        substep: Advances a state by one substep; called with the state and the number of the substep.
        state: The state to start from.
        steps: Number of substeps.
        checkpoint: Keep every so many-th state for the backward pass; 0 for all.
        watch: Called after each substep.

    Returns:
        The state at the end.
    """

    def advance(state: MPMState, first: int, count: int) -> MPMState:
        for k in range(first, first + count):
            state = substep(state, k)
            if watch is not None and checkpoint <= 0:
                watch(k + 1)
        return state

    if checkpoint <= 0 or not torch.is_grad_enabled():
        return advance(state, 0, steps)
    for first in range(0, steps, checkpoint):
        count = min(checkpoint, steps - first)
        state = recompute(partial(advance, first=first, count=count), state)
    return state


def recompute(advance: Advance, state: MPMState) -> MPMState:
    """Advance a state without keeping what the gradient needs: the backward pass recomputes it.

    ``torch.utils.checkpoint`` keeps the graph and frees only its tensors, but the graph of thousands of substeps is
    large. Here only the state and one node are kept. The other tensors that ``advance`` depends on are found by walking
    the graph of its first run, which is then dropped.

    Args:
        advance: Computes the later state; must give the same result each time.
        state: The state to start from.

    Returns:
        ``advance(state)``.
    """
    before, start = _flatten(state)
    own = [t.detach().requires_grad_(t.requires_grad) for t in start]
    with torch.enable_grad():
        end = advance(_unflatten(before, own))
    after, out = _flatten(end)
    leaves = [leaf for leaf in leaves_of(end) if not any(leaf is t for t in own)]

    def run(tensors: Sequence[Tensor]) -> list[Tensor]:
        return _flatten(advance(_unflatten(before, tensors)))[1]

    values = [t.detach() for t in out]
    fixed = [not t.requires_grad for t in out]
    del end, out, own
    return _unflatten(after, _Recompute.apply(run, values, fixed, len(start), *start, *leaves))


def _flatten(state: MPMState) -> tuple[Layout, list[Tensor]]:
    """The distinct tensors of a state (F_total may be F_elastic), and for each field its index or its value."""
    values = {f.name: getattr(state, f.name) for f in dataclasses.fields(MPMState)}
    unique = {id(v): v for v in values.values() if isinstance(v, Tensor)}
    place = {key: k for k, key in enumerate(unique)}
    layout: Layout = {n: (place[id(v)], None) if isinstance(v, Tensor) else (None, v) for n, v in values.items()}
    return layout, list(unique.values())


def _unflatten(layout: Layout, tensors: Sequence[Tensor]) -> MPMState:
    fields: dict[str, Any] = {n: value if k is None else tensors[k] for n, (k, value) in layout.items()}
    return MPMState(**fields)


class _Recompute(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        run: Callable[[Sequence[Tensor]], list[Tensor]],
        values: list[Tensor],
        fixed: list[bool],
        count: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.run, ctx.count, ctx.leaves = run, count, tensors[count:]
        ctx.save_for_backward(*tensors[:count])
        ctx.mark_non_differentiable(*(t for t, f in zip(values, fixed, strict=True) if f))
        return tuple(values)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[4 : 4 + ctx.count]
        start = [t.detach().requires_grad_(n) for t, n in zip(ctx.saved_tensors, needed, strict=True)]
        with torch.enable_grad():
            out = ctx.run(start)
        pairs = [(o, g) for o, g in zip(out, grads, strict=True) if g is not None and o.requires_grad]
        inputs = [*start, *ctx.leaves]
        wanted = [k for k, t in enumerate(inputs) if t.requires_grad]
        found: list[Tensor | None] = [None] * len(inputs)
        if pairs and wanted:
            # retained: all segments share the graph between the leaves and the material
            gradients = torch.autograd.grad(
                [o for o, _ in pairs],
                [inputs[k] for k in wanted],
                [g for _, g in pairs],
                retain_graph=True,
                allow_unused=True,
            )
            for k, gradient in zip(wanted, gradients, strict=True):
                found[k] = gradient
        return None, None, None, None, *found
