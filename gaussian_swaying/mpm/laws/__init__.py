"""Constitutive laws, one file each.

Every file of this folder is imported with it, so a law is known by its name (``class_path: Sand``) as soon as its file
is here. ``LAWS`` lists the classes by name.
"""

from __future__ import annotations

from importlib import import_module
from inspect import isabstract
from pkgutil import iter_modules

from gaussian_swaying.mpm.laws.law import ConstitutiveLaw

_FILES = [import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__) if not found.ispkg]

LAWS: dict[str, type[ConstitutiveLaw]] = {
    name: value
    for file in _FILES
    for name, value in vars(file).items()
    if isinstance(value, type) and issubclass(value, ConstitutiveLaw) and value.__module__ == file.__name__
    if not isabstract(value)
}
"""The laws of this package by name."""
