"""The formulations of the substep, one file each.

Every file in this folder is imported automatically, so a formulation can be used by its name (``solver.formulation:
total``) as soon as its file is here. ``FORMULATIONS`` lists the classes by name.
"""

from __future__ import annotations

from importlib import import_module
from inspect import isabstract
from pkgutil import iter_modules

from gaussian_swaying.mpm.formulations.formulation import Formulation

_FILES = [import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__)]

FORMULATIONS: dict[str, type[Formulation]] = {
    value.name: value
    for file in _FILES
    for value in vars(file).values()
    if isinstance(value, type) and issubclass(value, Formulation) and value.__module__ == file.__name__
    if not isabstract(value)
}
"""The formulations of this package by name."""
