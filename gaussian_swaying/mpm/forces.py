"""Forces on material points: the base class, sums of forces, and Triton twins for the fused substep."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from gaussian_swaying._checks import check_like, check_shape
from gaussian_swaying._graphs import Recordable, tensors_in
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.state import State

MOST_STEPS = 256
"""Largest number of substeps for which a :class:`ForceTwin` computes its vectors at once."""

TWIN_VALUES, TWIN_NUMBERS, TWIN_VECTOR = 4, 8, 16
"""Largest number of values per particle, of shared numbers before the table, and of those per substep and scene, in a
:class:`ForceTwin`."""

Given = Tensor | tuple[Tensor, Tensor | None]
"""A force [N], shape (..., P, 3), alone or with its resistance [kg/s], shape (..., P)."""

ForceFunction = Callable[[State], Given]


@dataclass(frozen=True)
class ForceTwin:
    """A force as a Triton function that the particle kernels call; the force in torch is its reference.

    Attributes:
        function: A ``@triton.jit`` function ``(F, velocity, values, vector, numbers, OPTIONS)`` that returns the force
            (three numbers) and the resistance of some particles. ``F`` is the total deformation gradient in nine parts,
            ``velocity`` has three, ``values`` four; ``vector`` and ``numbers`` are pointers. The force must be zero
            where all values are zero.
        options: Constants that the function is compiled for.
        implicit: Whether there is a resistance, so that the force acts at the velocity at the end of the substep; if
            not, the function returns a resistance of zero.
        sources: The tensors that the values are computed from: ``values`` is called again when one of them is replaced
            or changed in place.
        values: Returns up to four numbers for each particle, shape (..., P, n).
        numbers: Returns up to eight numbers, shape (n,); called for every rollout. If the force is ``recordable``, it
            and ``vectors`` may be recorded in a CUDA graph.
        table: Returns more numbers, shape (m,), float32, which follow eight places after the first of ``numbers``, such
            as lists that the values point to; called when ``values`` is. None for none.
        vectors: ``vectors(time, dt, steps)`` returns what depends only on time: a vector for the start of each of
            ``steps`` (at most 256) substeps of ``dt`` from ``time`` on, both scalar float64 tensors; shape (steps, 3),
            or (steps, B, 1, 3) for a batch of scenes. Up to sixteen numbers may take the place of the three.
        space: Numbers that the force reads depending on the place, float32, shape (n,), which stay at the same address
            and may change between rollouts. The function then has two more arguments: ``(F, velocity, position, values,
            vector, numbers, space, OPTIONS)``. None for a force that does not depend on the place.
        adjoint: A ``@triton.jit`` function ``(F, velocity, values, vector, numbers, a, OPTIONS)`` that returns the
            gradients of a . force, with three numbers a: by F (nine), by the velocity (three), by the first three of
            the vector and by the first three of the numbers. No other input of the force may require a gradient then.
            None for a force whose gradients need torch.
    """

    function: Any
    options: tuple[bool | int | float, ...]
    implicit: bool
    sources: tuple[Tensor, ...]
    values: Callable[[], Tensor]
    numbers: Callable[[], Tensor]
    vectors: Callable[[Tensor, Tensor, int], Tensor]
    table: Callable[[], Tensor] | None = None
    space: Tensor | None = None
    adjoint: Any = None


class Force(Recordable, nn.Module, ABC):
    """Base class of all forces: computes the force on every particle from the state, in torch.

    A custom force is a subclass with a ``forward``. It may have numbers, tensors (``register_buffer``) and parameters;
    they receive gradients. Move it to the device of the material, like any module.

    Attributes:
        recordable: Whether ``forward`` may be recorded in a CUDA graph with the substep: it must depend only on the
            position, velocity, affine, F_elastic, F_total, internal, lost and time of the state and on numbers and
            tensors of the module, and must never make the host wait (no ``float(tensor)``, no ``if tensor``, no copy
            from the host). If it is False (the default), the host calls the force in every substep, which is slow on a
            GPU; in all other cases it makes no difference.

    Example:
        >>> class Weight(Force):
        ...     recordable = True
        ...
        ...     def forward(self, state):
        ...         return 0.1 * state.position.new_tensor([0.0, 0.0, -9.8]).expand_as(state.position)
    """

    @abstractmethod
    def forward(self, state: State) -> Given:
        """The force at the start of a substep.

        Args:
            state: The state at that time.

        Returns:
            Force [N], shape (..., P, 3); or the force and its resistance: how much it decreases per unit of velocity
            gained in the substep [kg/s], shape (..., P). A force with a resistance acts at the velocity at the end of
            the substep, so it is stable for particles of any mass.
        """

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

    @property
    def has_twin(self) -> bool:
        """True if there is a :meth:`twin`."""
        return False

    def twin(self) -> ForceTwin:
        """The Triton twin of this force, for the fused substep; only if ``has_twin``."""
        raise NotImplementedError(f"The force {type(self).__name__} has no Triton twin.")


class FunctionForce(Force):
    """A function of the state as a force; the host calls it in every substep.

    Args:
        function: Returns the force [N], shape (..., P, 3), or the force and its resistance.
    """

    def __init__(self, function: ForceFunction) -> None:
        super().__init__()
        self.function = function

    def forward(self, state: State) -> Given:
        """The result of the function."""
        return self.function(state)


Forces = Force | ForceFunction | Sequence[Force | ForceFunction]
"""One force or several, each a :class:`Force` or a function of the state."""


def as_forces(forces: Forces | None) -> tuple[Force, ...]:
    """One force, several or none as a tuple.

    Raises:
        TypeError: If one of them is neither a Force nor a function.
    """
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


def split(found: Given, force: Force, state: State) -> tuple[Tensor, Tensor | None]:
    """Split the result of a force into the force and its resistance or None, in the dtype of the state.

    Raises:
        TypeError: If it returned no tensor, or one of complex numbers.
        ValueError: If its shape or its device is wrong.
    """
    value, drag = found if isinstance(found, tuple) else (found, None)
    name, like = type(force).__name__, state.position
    check_shape(f"force of {name}", value, like.shape[-2], 3)
    if drag is not None:
        check_shape(f"resistance of {name}", drag, like.shape[-2])
        drag = _converted(f"resistance of {name}", drag, like)
    return _converted(f"force of {name}", value, like), drag


def _converted(name: str, value: Tensor, like: Tensor) -> Tensor:
    """Real numbers in the dtype of the state."""
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


def divide(forces: Sequence[Force]) -> tuple[Force | None, tuple[Force, ...]]:
    """The first force that has a twin, and the others, which run in torch."""
    for k, force in enumerate(forces):
        if force.has_twin:
            return force, (*forces[:k], *forces[k + 1 :])
    return None, tuple(forces)


__all__ = ["Force", "ForceFunction", "ForceTwin", "Forces", "FunctionForce", "as_forces"]
