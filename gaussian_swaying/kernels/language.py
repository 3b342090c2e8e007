"""Triton and its language for the kernel files; a stand-in that only declares where no GPU would run it.

On a machine without a GPU, kernels are compiled by :mod:`~gaussian_swaying.kernels.translator`, which reads their
source, so Triton need not be installed. Its interpreter (``TRITON_INTERPRET=1``) needs the real one.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import os
from collections.abc import Callable
from functools import cached_property
from types import ModuleType
from typing import Any

import torch

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
"""True if Triton's interpreter runs the kernels."""


class Constant:
    """As ``tl.constexpr``: a number that kernels use by its name."""

    def __init__(self, value: Any) -> None:
        self.value = value


class Name:
    """A name of Triton's language, such as ``load``, that only the translator understands."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Name) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)

    def __getattr__(self, name: str) -> Name:
        if name.startswith("__"):
            raise AttributeError(name)
        return Name(f"{self.name}.{name}")


class Function:
    """A kernel or a device function: its Python function is its source."""

    def __init__(self, fn: Callable[..., Any]) -> None:
        self.fn = fn
        self.__name__, self.__doc__, self.__module__ = fn.__name__, fn.__doc__, fn.__module__

    @cached_property
    def cache_key(self) -> str:
        """Changes with the source of the function and of those that it calls, and with the constants that it names."""
        found: dict[str, str] = {}
        _note(self, found)
        return hashlib.sha256(repr(sorted(found.items())).encode()).hexdigest()

    def __repr__(self) -> str:
        return f"{self.__module__}.{self.__name__}"


def _note(function: Function, found: dict[str, str]) -> None:
    found[repr(function)] = inspect.getsource(function.fn)
    names = function.fn.__code__.co_names
    homes = [function.fn.__globals__]
    homes += [vars(value) for name in names if isinstance(value := homes[0].get(name), ModuleType)]
    for home in homes:
        for name in names:
            value = home.get(name)
            if isinstance(value, Function) and repr(value) not in found:
                _note(value, found)
            elif isinstance(value, (Constant, bool, int, float, str, tuple)):
                found[f"{function!r} {name}"] = repr(getattr(value, "value", value))


class Language:
    """As ``triton.language``."""

    constexpr = Constant

    def __getattr__(self, name: str) -> Name:
        if name.startswith("__"):
            raise AttributeError(name)
        return Name(name)


class Compiler:
    """Stand-in for ``triton``, as far as this package needs it."""

    language = Language()

    @staticmethod
    def jit(fn: Callable[..., Any] | None = None, **_: Any) -> Any:
        return Function if fn is None else Function(fn)

    @staticmethod
    def cdiv(x: int, y: int) -> int:
        return -(-x // y)

    @staticmethod
    def next_power_of_2(n: int) -> int:
        """The smallest power of two that is not less than n."""
        return 1 << max(n - 1, 0).bit_length()


triton: Any
tl: Any
ON_GPU = (torch.cuda.is_available() or INTERPRETED) and importlib.util.find_spec("triton") is not None
"""True if kernels are Triton's: there is a GPU, or its interpreter stands for one."""

if ON_GPU:
    import triton  # type: ignore[no-redef]
    import triton.language as tl  # type: ignore[no-redef]

    from gaussian_swaying.kernels.triton_key import remember_key

    remember_key()
else:
    triton = Compiler()
    tl = triton.language
