"""The numbers of components that may change between two frames: a component names them in its class."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from torch import Tensor

from gaussian_swaying._checks import check_vector, number_of, requires_grad
from gaussian_swaying._fixed import fixed
from gaussian_swaying._numbers import sense_of


@fixed
@dataclass(frozen=True)
class Live:
    """A number, or three, that may change between two frames.

    It can be changed with :meth:`~gaussian_swaying.simulation.simulation.Simulation.change`, has a control on the live
    page, and can be an unknown of a fit and an axis of a sweep. A force of your own names its numbers in its class:
    ``live = {"strength": Live(unit="N", low=0.0)}``.

    Args:
        unit: Its unit; empty for a pure number.
        low: Smallest value.
        high: Largest value.
        scale: ``log`` for sizes of any order of magnitude, else ``linear``.
        kind: ``number``, ``whole`` or ``vector`` (three numbers).
        batched: Whether simulations with different values can run together in one rollout.
        same_points: Whether it can change without remaking material points, patches or contact samples.
        differentiable: Whether a tensor that requires a gradient keeps it.
    """

    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    scale: Literal["linear", "log"] = "linear"
    kind: Literal["number", "whole", "vector"] = "number"
    batched: bool = False
    same_points: bool = True
    differentiable: bool = False

    def check(self, name: str, value: Any) -> Any:
        """A value as plain numbers, or as the tensor that it is if a gradient is required; messages have the name."""
        if requires_grad(value) and not self.differentiable:
            raise ValueError(f"`{name}` would lose its gradient: give a plain number (`tensor.detach()`).")
        if self.kind == "vector":
            plain = check_vector(name, value.detach() if isinstance(value, Tensor) else value)
            return value if isinstance(value, Tensor) and value.requires_grad else list(plain)
        if isinstance(value, bool) or not isinstance(value, int | float | Tensor):
            raise TypeError(f"Expected `{name}` to be a number, but got {value!r:.60}.")
        if self.kind == "whole" and value != int(value):
            raise TypeError(f"Expected `{name}` to be a whole number, but got {value!r:.60}.")
        plain_number = float(number_of(value))
        if not self.low <= plain_number <= self.high or not math.isfinite(plain_number):
            raise ValueError(f"Expected `{name}` to be {self.range_in_words}, but got {plain_number:g}.")
        if isinstance(value, Tensor) and value.requires_grad:
            return value
        return int(plain_number) if self.kind == "whole" else plain_number

    @property
    def range_in_words(self) -> str:
        if self.low == -math.inf:
            return "finite"
        return f"at least {self.low:g}" if self.high == math.inf else f"from {self.low:g} to {self.high:g}"


SIZE, TOGETHER = {"scale": "log"}, {"batched": True}
SAME = TOGETHER | {"differentiable": True}


def live_numbers(**numbers: Mapping[str, Any]) -> Mapping[str, Live]:
    """The ``live`` of a class: fields of :class:`Live` by the name of each number, beside its unit and range."""
    return {name: Live(*(sense_of(name) or ()), **fields) for name, fields in numbers.items()}
