"""One way to declare a device function: forces, effects of the wind and boundaries return a :class:`DeviceFunction`.

It takes and returns scalars, and is the definition of the component: torch runs it, too.
The kernel loads the numbers that the function gets, so the function itself only loads from its ``table``, as
``tl.load(table + index)``. Vectors are tuples of three scalars, matrices of nine, row by row. ``OPTIONS`` are constants
for which the function is compiled; the last of them is its parts, a :class:`Composed`.

- Force: ``(F, velocity, position, point, numbers, now, table, OPTIONS)`` returns the force (three numbers) and the
  resistance, zero for none. ``F`` is the total deformation gradient. Both must be zero where all numbers of the point
  are zero.
- Effect of the wind: ``(velocity, position, numbers, now, table, OPTIONS)`` returns the changed velocity.
- Boundary: a solid. ``(place, numbers, table, mask, OPTIONS)`` returns the signed distance from it, at rest, and its
  normal at places from its centre; ``mask`` is for loads. Motion, gap, friction and time window are those of every
  ``Obstacle`` or ``Wall``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying.kernels.graphs import recorded_key, tensors_in


@dataclass(frozen=True)
class Numbers:
    """Parameter count and getter; the getter returns a tensor or a sequence."""

    count: int
    take: Callable[..., Any]


NONE = Numbers(0, tuple)


@dataclass(frozen=True)
class DeviceFunction:
    """A device function, and the numbers that it gets.

    Attributes:
        function: A ``@triton.jit`` function; its arguments are listed at the top of this file.
        options: Constants that it is compiled for.
        per_point: Numbers of each point, shape (..., P, count); forces only.
        numbers: Numbers for all points. Those of a force are taken in every rollout, and may require a gradient.
        per_substep: Numbers of each substep. Of a force, ``take(time, dt, steps)`` returns them at the start of
            ``steps`` (at most 256) substeps of ``dt`` from ``time`` on, scalar float64 tensors; shape (steps, count),
            or (steps, B, 1, count) for a batch of scenes. Of an effect, ``take(moment)`` returns them for a ``Moment``
            of n times, shape (n, count). If the component is ``recordable``, both run in CUDA graphs, as do the
            ``numbers`` of a force.
        table: More numbers, of any count.
        sources: Tensors and modules; ``per_point``, ``table`` and, except of a force, ``numbers`` are taken again when
            one of them was replaced or written to.
        implicit: Whether a force has a resistance, so that it acts at the velocity at the end of the substep.
        adjoint: Of a force, what makes a device function ``(F, velocity, point, numbers, now, table, a)`` that returns
            the gradients of a . force, with three numbers a: by F (nine), by the velocity (three), by the first three
            numbers of the substep and by the first three of ``numbers``. No other input of the force may require a
            gradient then. None for a force whose gradients need torch.
        parts: Device functions that the function calls, such as those of the effects of a wind.
    """

    function: Any
    options: tuple[Any, ...] = ()
    per_point: Numbers = NONE
    numbers: Numbers = NONE
    per_substep: Numbers = NONE
    table: Numbers = NONE
    sources: tuple[Tensor | nn.Module, ...] = ()
    implicit: bool = False
    adjoint: Any = None
    parts: tuple[DeviceFunction, ...] = ()


class Constant:
    """Base of objects that are constants of compiled kernels: two are the same if their ``cache_key`` is.

    Attributes:
        cache_key: Changes with the source of the functions, for the caches of Triton.
    """

    cache_key: str

    def __repr__(self) -> str:
        return f"{type(self).__name__}_{self.cache_key[:16]}"  # part of the names and keys of compiled functions

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and repr(other) == repr(self)

    def __hash__(self) -> int:
        return hash(self.cache_key)


class Composed(Constant):
    """Several device functions, and where each finds its numbers, as one constant of a compiled kernel.

    Args:
        given: The device functions.

    Attributes:
        options: The options of each, and its parts.
        per_point: (offset, count) of the per-point numbers of each device function; the others likewise.
        numbers: Those of all points.
        per_substep: Those of a substep.
        tables: Where the table of each starts: that of its parts (``size`` entries), and then its own.
        parts: The parts of each.
        size: Length of all numbers and tables in one buffer, the numbers first.
        width: Length of a row of the numbers of a substep, a multiple of 16.
    """

    def __init__(self, given: Sequence[DeviceFunction]) -> None:
        self.parts = tuple(Composed(one.parts) for one in given)
        self.functions = tuple(one.function for one in given)
        self.options = tuple((*one.options, part) for one, part in zip(given, self.parts, strict=True))
        self.per_point = _places(one.per_point.count for one in given)
        self.numbers = _places(one.numbers.count for one in given)
        self.per_substep = _places(one.per_substep.count for one in given)
        lengths = [part.size + one.table.count for one, part in zip(given, self.parts, strict=True)]
        start = end_of(self.numbers)
        self.tables = tuple(start + first for first, _ in _places(lengths))
        self.size: int = start + sum(lengths)
        self.width = -(-max(end_of(self.per_substep), 1) // 16) * 16
        functions = [device_key(function) for function in self.functions]
        layout = (self.options, self.per_point, self.numbers, self.per_substep, self.tables, self.size)
        self.cache_key = hashlib.sha256(repr((functions, layout)).encode()).hexdigest()


def _places(counts: Any) -> tuple[tuple[int, int], ...]:
    found, first = [], 0
    for count in counts:
        found.append((first, count))
        first += count
    return tuple(found)


def end_of(places: Sequence[tuple[int, int]]) -> int:
    """Total count of groups of numbers."""
    return sum(places[-1]) if places else 0


def device_key(function: Any) -> str:
    """A key that identifies a device function; in the interpreter, which caches nothing, its name."""
    return str(getattr(function, "cache_key", "")) + repr(function)


def _pieces(
    given: Sequence[DeviceFunction], layout: Composed, start: int, numbers: bool
) -> Iterator[tuple[DeviceFunction, list[tuple[int, Numbers]]]]:
    for one, part, (first, _), table in zip(given, layout.parts, layout.numbers, layout.tables, strict=True):
        yield from _pieces(one.parts, part, start + table, True)
        yield (one, [(start + first, one.numbers if numbers else NONE), (start + table + part.size, one.table)])


class Packed:
    """The numbers and tables of device functions in buffers, at addresses that recordings contain.

    Args:
        batch: Shape of a field of one number for each point, (..., P); (1,) for solids, which have no points.
        like: Type and device of the numbers.
        fixed: Whether ``numbers`` change with the ``sources`` only; if not, they are taken in every rollout.

    Attributes:
        layout: Where each finds its numbers.
        buffer: Numbers and tables. Its address changes if it must grow.
        rows: The numbers of each substep and scene; as ``buffer``.
    """

    def __init__(self, batch: torch.Size, like: dict[str, Any], fixed: bool = False) -> None:
        self.batch, self.scenes, self.like, self.fixed = batch, max(1, batch[:-1].numel()), like, fixed
        self.given: Sequence[DeviceFunction] = ()
        self.layout, self.buffer, self.rows = Composed(()), torch.zeros(1, **like), torch.zeros(0, **like)
        self._seen: dict[int, tuple[object, object]] = {}

    def take(self, given: Sequence[DeviceFunction], steps: int) -> Tensor | None:
        """Bring the buffers up to date, rewriting only what changed since the last call.

        Returns:
            The per-point numbers, shape (N, n); None if they have not changed. Changes of inference-mode tensors cannot
                be detected, so these always count as changed.
        """
        layout, changed = self.layout if given is self.given else Composed(given), False
        if layout != self.layout:
            changed, self._seen = True, {}
        self.given, self.layout = given, layout
        if layout.size > len(self.buffer):
            self.buffer = self.buffer.new_zeros(layout.size)
        room = steps * self.scenes * layout.width
        if given and len(self.rows) < room:
            self.rows = torch.zeros(room, **self.like)
        for k, (one, entries) in enumerate(_pieces(given, layout, 0, self.fixed)):
            modules = [source for source in one.sources if isinstance(source, nn.Module)]
            tensors = [source for source in one.sources if isinstance(source, Tensor)] + tensors_in(modules)
            key = None
            if not any(tensor.is_inference() for tensor in tensors):
                key = (*recorded_key(modules), [(id(tensor), tensor._version) for tensor in tensors])
            if key is None or k not in self._seen or key != self._seen[k][0]:
                changed, self._seen[k] = True, (key, tensors)  # so that no new tensor gets an old id
                for first, values in entries:
                    if values.count:
                        found = values.take()
                        found = found if isinstance(found, Tensor) else torch.tensor(found, dtype=torch.float64)
                        self.buffer[first : first + values.count].copy_(found.reshape(-1))
        if not changed:
            return None
        points = [one.per_point.take() for one in given if one.per_point.count]
        rows = [value.expand(*self.batch, value.shape[-1]).flatten(0, -2) for value in points]
        return torch.cat(rows, dim=-1) if rows else None

    def begin(self, time: Tensor, dt: Tensor, steps: int) -> None:
        """Take the numbers of a rollout, from a time on [s]."""
        for k, (one, (first, many)) in enumerate(zip(self.given, self.layout.numbers, strict=True)):
            if many and not self.fixed:
                self.buffer[first : first + many].copy_(torch.as_tensor(one.numbers.take()))
            if one.per_substep.count:
                self.write(k, torch.as_tensor(one.per_substep.take(time, dt, steps)))

    def write(self, k: int, rows: Tensor) -> None:
        """Write the numbers of a device function for some substeps, shape (steps, n) or (steps, scenes, 1, n)."""
        steps, width = len(rows), self.layout.width
        first, count = self.layout.per_substep[k]
        to = self.rows[: steps * self.scenes * width].view(steps, self.scenes, width)
        to[..., first : first + count].copy_(rows.reshape(steps, -1, count).expand(-1, self.scenes, -1))
