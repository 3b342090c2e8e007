"""Settings stay as they were made, so that the record of a run says what ran: assigning to them is an error.

A class of the package refuses every public name; one of a user's own those that it has from the package. What may
change is counted (:func:`count_change`), so that a recording knows whether it is still valid.
"""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import wraps
from itertools import count
from typing import Any, NoReturn, TypeVar

import torch
from torch import nn

from gaussian_swaying._arguments import check_arguments

T = TypeVar("T")
_ABSENT = object()
_changes = count(1)


def count_change(thing: Any) -> None:
    """Count a change of an object, so that recordings of it become invalid."""
    vars(thing)["_changed"] = next(_changes)


class Fixed:
    """Base of settings: once an object is made, its public names cannot be assigned.

    Attributes:
        live_as: Where a simulation has it, for example ``wind``.
        of_a_file: Whether its annotations are what a file can say, and Python more.
    """

    __slots__ = ()
    assignable: tuple[str, ...] = ()
    live_as: str = ""
    of_a_file: bool = False

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name in ("__init__", "__post_init__"):
            if name in vars(cls):
                setattr(cls, name, _closing(name, vars(cls)[name]))

    def __post_init__(self) -> None:
        _close(self, "__post_init__", Fixed.__post_init__)

    def __repr__(self) -> str:
        return described(self)

    def __setattr__(self, name: str, value: Any) -> None:
        _check(self, name, value)
        counts = "_made" in vars(self) and name[0] != "_" and name not in ("training", *self.assignable)
        counts = counts and getattr(self, name, _ABSENT) is not value
        if _settable(self, name):  # a module would become a part of another without passing the setter
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)
        if counts:
            count_change(self)

    def __delattr__(self, name: str) -> None:
        _check(self, name)
        super().__delattr__(name)
        count_change(self)


def fixed(kind: type[T]) -> type[T]:
    """Let a dataclass without such a base refuse as well."""

    def assign_to(self: Any, name: str, value: Any) -> None:
        _check(self, name, value)
        object.__setattr__(self, name, value)

    def delete(self: Any, name: str) -> None:
        _check(self, name)
        object.__delattr__(self, name)

    if "__slots__" not in vars(kind):  # those with slots are made in loops
        kind.__init__ = _closing("__init__", kind.__init__)  # type: ignore[method-assign]
    kind.__setattr__, kind.__delattr__ = assign_to, delete  # type: ignore[method-assign]
    if hasattr(kind.__repr__, "__wrapped__"):  # that of dataclasses, which shows all numbers of tensors
        kind.__repr__ = described  # type: ignore[method-assign]
    return kind


def _closing(name: str, method: Callable[..., None]) -> Callable[..., None]:
    parameters, ours = inspect.signature(method), (method.__module__ or "").startswith("gaussian_swaying.")

    @wraps(method)
    def whole(self: Any, *args: Any, **given: Any) -> None:
        if ours and name == "__init__" and not getattr(type(self), "of_a_file", False):
            check_arguments(method, parameters.bind(self, *args, **given).arguments, _prefix(self))
        elif ours:
            check_arguments(type(self).__init__, vars(self), _prefix(self))
        method(self, *args, **given)
        if not _frozen(type(self)):
            _close(self, name, whole)

    return whole


def _prefix(thing: Any) -> str:
    place = getattr(thing, "live_as", "*")
    return type(thing).__name__ if "*" in place or not place else f"{place}."


def _close(thing: Any, name: str, method: Callable[..., None]) -> None:
    kind = type(thing)
    outer = name == "__init__" or not hasattr(kind.__init__, "__wrapped__")  # else that of a subclass goes on
    if getattr(kind, name) is method and outer:
        held = vars(thing)
        held["_made"] = True
        for own in [own for own, value in held.items() if type(value) is list and _refuses(thing, own)]:
            held[own] = tuple(held[own])


def _frozen(kind: type) -> bool:
    return is_dataclass(kind) and bool(kind.__dataclass_params__.frozen)  # type: ignore[attr-defined]


def _ours(kind: type) -> bool:
    return kind.__module__.startswith("gaussian_swaying.")


def _settable(thing: Any, name: str) -> bool:
    return getattr(getattr(type(thing), name, None), "fset", None) is not None


def _refuses(thing: Any, name: str) -> bool:
    kind = type(thing)
    if _frozen(kind):
        return True
    if name[0] == "_" or "_made" not in vars(thing) or name in ("training", *getattr(kind, "assignable", ())):
        return False
    return not _settable(thing, name) and (_ours(kind) or name in fields_of(kind))


def _check(thing: Any, name: str, *value: object) -> None:
    fresh = not value or isinstance(getattr(type(thing), name, None), property)
    if _refuses(thing, name) and (fresh or getattr(thing, name, _ABSENT) is not value[0]):
        _refuse(thing, name)


def fields_of(kind: type) -> list[str]:
    """Constructor arguments of a class; for a user's class, those of its base in the package."""
    ours = next(c for c in kind.__mro__ if _ours(c) or c is object)
    return list(inspect.signature(ours.__init__).parameters)[1:]  # type: ignore[misc]


def described(thing: Any) -> str:
    """Class name and non-default arguments of an object."""
    shown = []
    for name, argument in inspect.signature(type(thing).__init__).parameters.items():
        text = _brief(getattr(thing, name, None))
        if text not in ("None", "[]", _brief(argument.default)):
            shown.append(f"{name}={text}")
    return f"{type(thing).__name__}({', '.join(shown)})"


def _brief(value: object) -> str:
    if isinstance(value, torch.Tensor):
        return _brief(value.tolist()) if value.numel() < 5 else f"{tuple(value.shape)}"
    if isinstance(value, float):
        return f"{value:g}" if math.isfinite(value) else "None"  # which is how it was given
    if isinstance(value, list | tuple | nn.ModuleList):
        return f"[{', '.join(map(_brief, value))}]" if len(value) < 9 else f"{len(value):,} entries"
    return repr(value)


def _refuse(thing: Any, name: str) -> NoReturn:
    kind, fields = type(thing), fields_of(type(thing))
    text = f"`{name}` of {kind.__name__} cannot be assigned, as what runs would not be what is recorded"
    given = f"{name}=..." if name in fields else ", ".join(f"{field}=..." for field in fields)
    text += f": make another {kind.__name__}({given})"
    if name in getattr(kind, "live", ()):
        place = kind.live_as.replace("forces.*", f"forces.{kind.__name__}").replace("*", "0")
        number = f"{place}.{name}".lstrip(".")
        text += f", or between two frames `simulation.change({number!r}, ...)`"
    raise AttributeError(f"{text}.")


def assign(thing: Any, **values: Any) -> None:
    """Set attributes of a fixed object. The caller must keep everything that depends on them consistent."""
    made = getattr(thing, "__dict__", {}).pop("_made", None)
    try:
        for name, value in values.items():
            setattr(thing, name, value)
    finally:
        if made:
            count_change(thing)
            vars(thing)["_made"] = True


def changed(thing: T, **values: Any) -> T:
    """A copy with other attributes that shares all other parts. A number is copied into its buffer."""
    other = copy.copy(thing)
    made = getattr(other, "__dict__", {}).pop("_made", None)  # a new object, which no recording knows
    if isinstance(thing, nn.Module):
        for part in ("_parameters", "_buffers", "_modules"):
            vars(other)[part] = dict(vars(thing)[part])
        for name, old in (*thing.named_parameters(recurse=False), *thing.named_buffers(recurse=False)):
            if name in values:
                given = torch.as_tensor(values[name]).to(old)
                given = given.reshape(old.shape) if given.numel() == old.numel() else given
                kept = isinstance(old, nn.Parameter)
                values[name] = nn.Parameter(given.detach(), old.requires_grad) if kept else given
    assign(other, **values)
    if made:
        vars(other)["_made"] = True
    return other


class FixedList(Fixed, nn.ModuleList):
    """Modules in an order that stays."""

    def __init__(self, modules: Any = ()) -> None:
        super().__init__(modules)

    def add_module(self, name: str, module: nn.Module | None) -> None:
        if "_made" in vars(self):
            _refuse(self, name)
        super().add_module(name, module)

    def insert(self, index: int, module: nn.Module) -> None:
        _refuse(self, str(index))
