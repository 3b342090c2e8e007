"""Forces on material points: the base class, and sums of forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_like, check_shape
from gaussian_swaying._live import live_numbers
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.kernels.derive import Memory, on_tensors
from gaussian_swaying.kernels.graphs import Component, tensors_in
from gaussian_swaying.mpm.device_functions import Composed, DeviceFunction
from gaussian_swaying.mpm.state import State

MOST_STEPS = 256
"""Largest number of substeps for which the numbers of a device function are taken at once."""

Given = Tensor | tuple[Tensor, Tensor | None]
"""A force [N], shape (..., P, 3), alone or with its resistance [kg/s], shape (..., P)."""

ForceFunction = Callable[[State], Given]


class Force(Component, nn.Module):
    """Base class of all forces: computes the force on every particle from the state, in torch.

    A custom force is a subclass with a ``forward`` in torch, or with a ``device_function``, which also runs inside the
    kernels of the substep (:mod:`~gaussian_swaying.mpm.device_functions`). It may have numbers, tensors
    (``register_buffer``) and parameters; they receive gradients. Move it to the device of the material, like any
    module.

    Attributes:
        recordable: Whether ``forward`` may be recorded in a CUDA graph with the substep: it must depend only on the
            position, velocity, affine, F_elastic, F_total, internal, lost and time of the state and on numbers and
            tensors of the module, and must never make the host wait (no ``float(tensor)``, no ``if tensor``, no copy
            from the host). If it is False (the default), the host calls the force in every substep, which is slow on a
            GPU; in all other cases it makes no difference.
        live: The numbers that may change between two frames, each a ``Live``.

    Example:
        >>> class Weight(Force):
        ...     recordable = True
        ...
        ...     def forward(self, state):
        ...         return 0.1 * state.position.new_tensor([0.0, 0.0, -9.8]).expand_as(state.position)
    """

    live_as, live = "forces.*", live_numbers()

    def forward(self, state: State) -> Given:
        """Compute the force at the start of a substep; by default by the device function of the class.

        Args:
            state: The state at that time.

        Returns:
            Force [N], shape (..., P, 3); or the force and its resistance: how much it decreases per unit of velocity
            gained in the substep [kg/s], shape (..., P). A force with a resistance acts at the velocity at the end of
            the substep, so it is stable for particles of any mass.
        """
        device_function = self.nearest_device_function()
        if device_function is None:
            raise NotImplementedError(f"{type(self).__name__} needs a `forward(state)` or a `device_function`.")
        return computed(device_function, state)

    def in_frame(self, frame: SimFrame) -> Force:
        """The same force with its positions converted from scene units to metres, z up; itself if it has none.

        Args:
            frame: Transform from the scene to metres. For a force in a configuration, this method is called before the
                run.
        """
        return self

    def during(self, time: Tensor, dt: float, steps: int) -> Callable[[State, int], Given]:
        """The force in each of several substeps; what depends only on time can be computed here, for all at once.

        Args:
            time: Start of the first substep [s], scalar float64 tensor.
            dt: Substep [s].
            steps: Number of substeps.

        Returns:
            A function of the state at the start of a substep and of its number.
        """
        return lambda state, k: self(state)

    def on_sites(self, site: Tensor, count: int) -> Force | None:
        """Return the force on groups of points that move as one, for the ``modes`` formulation; None if there is none.

        Args:
            site: The group of each point, shape (..., P).
            count: Number of groups.

        Returns:
            A force on a state whose points are the groups.
        """
        return None


def computed(device_function: DeviceFunction, state: State) -> Given:
    """The device function of a force on tensors, as :meth:`Force.forward`."""
    like = state.position

    def scalars(given: Any) -> tuple[Tensor, ...]:
        return torch.as_tensor(given).to(like).unbind(-1)

    now = (
        device_function.per_substep.take(state.time, torch.zeros_like(state.time), 1)[0]
        if device_function.per_substep.count
        else ()
    )
    point, numbers = (scalars(values.take()) for values in (device_function.per_point, device_function.numbers))
    F, table = state.F_total.flatten(-2).unbind(-1), Memory(torch.as_tensor(device_function.table.take()).to(like))
    options = (*device_function.options, Composed(device_function.parts))
    given = (F, state.velocity.unbind(-1), like.unbind(-1), point, numbers, scalars(now), table, options)
    force, resistance = on_tensors(device_function.function)(*given)
    value = torch.stack([part.expand(like.shape[:-1]) for part in force], -1)
    return (value, resistance.expand(like.shape[:-1])) if device_function.implicit else value


class FunctionForce(Force):
    """A function of the state as a force; the host calls it in every substep.

    Args:
        function: Returns the force [N], shape (..., P, 3), or the force and its resistance.
    """

    def __init__(self, function: ForceFunction) -> None:
        super().__init__()
        self.function = function

    def forward(self, state: State) -> Given:
        return self.function(state)


Forces = Force | ForceFunction | Sequence[Force | ForceFunction]
"""One force or several, each a :class:`Force` or a function of the state."""


def as_forces(forces: Forces | None) -> tuple[Force, ...]:
    """One force, several or none as a tuple."""
    if forces is None:
        return ()
    several = list(forces) if isinstance(forces, Sequence) else [forces]
    for force in several:
        if not callable(force):
            raise TypeError(
                f"Expected `forces` to be Force objects or functions of the state, but got {type(force).__name__}: a "
                "tensor is given to `step` as `force`."
            )
    return tuple(force if isinstance(force, Force) else FunctionForce(force) for force in several)


def split(found: Any, force: Force, state: State) -> tuple[Tensor | None, Tensor | None]:
    """Split the result of a force into the force and its resistance or None, in the dtype of the state."""
    value, drag = found if isinstance(found, tuple) else (found, None)
    name, like = type(force).__name__, state.position
    if value is not None or drag is None:
        check_shape(f"force of {name}", value, like.shape[-2], 3)
        value = _converted(f"force of {name}", value, like)
    if drag is not None:
        check_shape(f"resistance of {name}", drag, like.shape[-2])
        drag = _converted(f"resistance of {name}", drag, like)
    return value, drag


def _converted(name: str, value: Tensor, like: Tensor) -> Tensor:
    value = value if value.is_complex() else value.to(like.dtype)
    check_like(name, value, like)
    return value


def added(parts: Sequence[tuple[Tensor | None, Tensor | None]]) -> tuple[Tensor | None, Tensor | None]:
    """The sum of the forces and the sum of their resistances; None if there are none."""
    value = drag = None
    for one, its_drag in parts:
        if one is not None:
            value = one if value is None else value + one
        if its_drag is not None:
            drag = its_drag if drag is None else drag + its_drag
    return value, drag


def tensors_of(forces: Sequence[Force]) -> list[Tensor]:
    """Parameters and buffers of forces, which may require gradients."""
    return tensors_in(forces)


def divide(forces: Sequence[Force]) -> tuple[tuple[Force, ...], list[DeviceFunction], tuple[Force, ...]]:
    """The forces that have a device function, their device functions, and the others, which run in torch."""
    found = [(force, force.device_function()) for force in forces]
    here = tuple(force for force, own in found if own is not None)
    asked = tuple(force for force, own in found if own is None)
    return here, [own for _, own in found if own is not None], asked
