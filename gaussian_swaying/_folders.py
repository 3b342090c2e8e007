"""Folders of which every file is imported, so that a class is known as soon as its file is there."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from inspect import isabstract
from pkgutil import iter_modules
from typing import Any


def classes_of(folder: str, path: Iterable[str], base: type) -> dict[str, Any]:
    """Import every file of a folder and find the classes that are written there.

    Args:
        folder: Name of the package that the folder is, its ``__name__``.
        path: Where it lies, its ``__path__``.
        base: Base of the classes.

    Returns:
        The subclasses of ``base`` that are not abstract, by name. Folders within the folder are left out.
    """
    files = [import_module(f"{folder}.{found.name}") for found in iter_modules(path) if not found.ispkg]
    return {
        name: value
        for file in files
        for name, value in vars(file).items()
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == file.__name__
        if not isabstract(value)
    }
