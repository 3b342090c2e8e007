"""Checks of a rollout: its arguments before it begins, and its state at the end.

Nothing that is checked before the substeps makes the host wait, and the end is one wait for all checks together.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from numbers import Real

import torch
from torch import Tensor

from gaussian_swaying._checks import check_like, check_positive, check_shape
from gaussian_swaying.mpm.forces import Force, split
from gaussian_swaying.mpm.formulation import Formulation
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.mpm.timestep import check_pace


def check_begin(bound: Formulation, state: MPMState, dt: float, steps: int, limit: bool = True) -> int:
    """Check the arguments of a rollout.

    Args:
        bound: The formulation, bound to its material.
        state: The state to start from.
        dt: Substep [s].
        steps: Number of substeps.
        limit: Whether to refuse a substep with which nothing is stable.

    Returns:
        The number of substeps as an integer of Python.
    """
    check_state(bound, state)
    if isinstance(dt, bool) or not isinstance(dt, Real):
        raise TypeError(f"Expected `dt` to be a number of seconds, but got {type(dt).__name__}.")
    try:
        count = operator.index(steps)
    except TypeError:
        raise TypeError(f"Expected `steps` to be a whole number, but got {steps!r}.") from None
    if count < 0:
        raise ValueError(f"Expected `steps` not to be negative, but got {count}.")
    check_positive("dt", float(dt))
    if limit and dt > bound.longest_substep:
        raise ValueError(
            f"Expected `dt` of at most {bound.longest_substep:.3g} s, as no longer substep is stable with this "
            f"material and grid, but got {float(dt):g} s: `solver.substeps(state, time)` says how many substeps a time "
            "takes."
        )
    return count


def check_state(bound: Formulation, state: MPMState) -> None:
    """Raise TypeError or ValueError unless a state is one of this body on this grid; the host does not wait."""
    if not isinstance(state, MPMState):
        raise TypeError(f"Expected `state` to be an MPMState, but got {type(state).__name__}.")
    points, nodes = bound.points, state.node_displacement
    wrong = None
    if state.position.shape != points.position.shape:
        wrong = f"it has positions {tuple(state.position.shape)} instead of {tuple(points.position.shape)}"
    elif (nodes is not None) != bound.neighbours_fixed:
        wrong = f"it is not one of the {bound.name} formulation"
    elif state.grid.dx != bound.settings.dx or (bound.neighbours_fixed and state.grid != bound.first_grid(0)):
        wrong = "it has another grid"
    elif state.impulse.shape[-2] != len(bound.kinds):
        wrong = f"it has {state.impulse.shape[-2]} boundaries instead of {len(bound.kinds)}"
    if wrong is not None:
        raise ValueError(f"Expected `state` to be one of this solver, from its `init_state` or a rollout, but {wrong}.")
    for name in ("position", "velocity"):
        check_like(f"{name} of the state", getattr(state, name), points.position)


def check_rest(points: MaterialPoints, velocity: Tensor) -> None:
    """Raise TypeError or ValueError unless there is material, and its velocity (..., P, 3) fits it and is finite."""
    if points.count == 0 or points.mass.numel() == 0:
        raise ValueError("Expected `points` with at least one point, but got none.")
    check_shape("velocity", velocity, points.count, 3)
    check_like("velocity", velocity, points.position)
    finite = torch.isfinite(velocity)
    if not bool(finite.all()):
        raise ValueError(f"Expected `velocity` to be finite, but that of particle {_first(~finite)} is not.")


def check_load(bound: Formulation, force: Tensor | None, drag: Tensor | None) -> None:
    """Raise TypeError or ValueError unless a force [N] (..., P, 3) and its resistance (..., P) fit the body."""
    points = bound.points
    if force is not None:
        check_shape("force", force, points.count, 3)
        check_like("force", force, points.position)
    if drag is not None:
        check_shape("drag", drag, points.count)
        check_like("drag", drag, points.position)


@torch.no_grad()
def check_end(
    bound: Formulation,
    before: MPMState,
    after: MPMState,
    dt: float,
    steps: int,
    forces: Sequence[Force],
) -> None:
    """Raise an error if the state after a rollout is not valid (one GPU synchronisation).

    Args:
        bound: The formulation, bound to its material.
        before: The state at the start of the rollout.
        after: The state at its end.
        dt: Substep [s].
        steps: Number of substeps.
        forces: The forces that acted; called once more, for the first substep, if something is NaN.
    """
    check_pace(dt, bound.obstacle_cells(before, steps * dt), "dt")
    fields = {"position": after.position, "velocity": after.velocity, "deformation": after.F_elastic.flatten(-2)}
    sound = torch.stack([*(torch.isfinite(field).all() for field in fields.values()), ~after.lost.any()])
    if bool(sound.all()):
        return
    finite = sound.tolist()[:3]
    if all(finite):
        raise ValueError(
            f"Particle {_first(after.lost[..., None])} left the grid ({int(after.lost.sum())} particles did), where "
            f"nothing acts on it: call `solver.fit_grid(state, {steps * dt:g})` before the rollout, with a `margin` of "
            "some cells if the wind or a boundary drives the material."
        )
    given: list[tuple[str, Tensor | None]] = [("position of particle", before.position)]
    given += [
        ("velocity of particle", before.velocity),
        ("displacement of node", before.node_displacement),
        ("velocity of node", before.node_velocity),
    ]
    given += _loads(forces, before, dt, steps)
    for name, value in given:
        if value is not None and not bool(torch.isfinite(value).all()):
            bad = ~torch.isfinite(value if value.dim() > before.lost.dim() else value[..., None])
            raise ValueError(f"Expected finite values, but the {name} {_first(bad)} is NaN or infinite.")
    name = next(name for name, fine in zip(fields, finite, strict=True) if not fine)
    raise FloatingPointError(
        f"The {name} of particle {_first(~torch.isfinite(fields[name]))} became NaN or infinite within the rollout: "
        f"lower `dt` (stable at rest: {bound.stable_substep(None):.3g} s), or check the forces and the boundaries."
    )


def _loads(forces: Sequence[Force], state: MPMState, dt: float, steps: int) -> list[tuple[str, Tensor | None]]:
    found: list[tuple[str, Tensor | None]] = []
    for force in forces:
        name = getattr(getattr(force, "function", None), "__name__", type(force).__name__)
        value, drag = split(force.during(state.time, dt, steps)(state, 0), force, state)
        found += [(f"force of {name} on particle", value), (f"resistance of {name} of particle", drag)]
    return found


def _first(bad: Tensor) -> int:
    return int(bad.flatten(0, -2).any(-1).int().argmax())
