"""Arguments have the types of their annotations; an error names the argument and the types."""

from __future__ import annotations

import collections.abc
import inspect
from collections.abc import Callable, Mapping
from functools import cache, wraps
from numbers import Real
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from torch import Tensor

F = TypeVar("F", bound=Callable[..., Any])
_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "text", NoneType: "None"}


def checked(function: F) -> F:
    """Check the arguments of a function."""
    parameters = inspect.signature(function)

    @wraps(function)
    def whole(*args: Any, **given: Any) -> Any:
        check_arguments(function, parameters.bind(*args, **given).arguments, function.__name__)
        return function(*args, **given)

    return whole  # type: ignore[return-value]


def check_arguments(
    function: Callable[..., Any], given: Mapping[str, Any], where: str = ".", wider: Mapping[str, Any] | None = None
) -> None:
    """Raise TypeError unless arguments have the types of a function's annotations; ValueError for an unknown word.

    Args:
        where: Its name in the message, or what comes before that of an argument, as in ``material.``.
    """
    for name, kind in (_hints(function) | dict(wider or {})).items():
        if name in given and not _fits(given[name], kind):
            error = ValueError if isinstance(given[name], str) and "one of" in _words(kind) else TypeError
            named = f"`{where}{name}`".replace("`.", "`") if where.endswith(".") else f"`{name}` of {where}"
            raise error(f"Expected {named} to be {_words(kind)}, but got {shown(given[name])}.")


@cache
def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    return get_type_hints(function)


def _fits(value: Any, kind: Any) -> bool:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str | int) and value in parts
    if origin in (list, tuple, collections.abc.Sequence):
        if isinstance(value, Tensor | np.ndarray):
            return value.ndim > 0 and all(_of_numbers(part) for part in parts)
        listed = hasattr(value, "__len__") and hasattr(value, "__iter__") and not isinstance(value, str | bytes | dict)
        return listed and (origin is tuple or all(_fits(item, parts[0]) for item in value))
    if origin in (dict, collections.abc.Mapping):
        return isinstance(value, Mapping) and all(_fits(item, parts[1]) for item in value.values())
    if origin is not None:
        return origin is not collections.abc.Callable or callable(value)
    if kind in (float, int):
        return is_number(value) and (kind is float or float(value).is_integer())
    if kind is bool:
        return isinstance(value, bool | int | np.bool_)
    known = inspect.isclass(kind) and kind is not Any and not getattr(kind, "_is_protocol", False)
    return not known or isinstance(value, kind)


def is_number(value: Any) -> bool:
    """True for a real number, and an array or tensor that holds one."""
    if isinstance(value, Tensor | np.ndarray):
        return bool(np.prod(value.shape) == 1)
    return isinstance(value, Real) and not isinstance(value, bool)


def _of_numbers(kind: Any) -> bool:
    return kind in (float, int, NoneType, ...) or (get_args(kind) != () and all(map(_of_numbers, get_args(kind))))


def _words(kind: Any) -> str:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(_words, parts)))
    if origin is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if origin is not None and parts and origin is not collections.abc.Callable:
        return f"a list of {_words(parts[-1]).removeprefix('a ')}s" if origin is not dict else "a mapping"
    return _WORDS.get(kind, f"a {getattr(kind, '__name__', kind)}")


def shown(value: Any) -> str:
    """A value as a message shows it, in one line."""
    shape = getattr(value, "shape", None)
    return f"{value!r:.80}".splitlines()[0] if shape is None else f"{type(value).__name__} of shape {tuple(shape)}"
