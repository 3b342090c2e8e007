"""Imports every file of a folder, so that a new class is found as soon as its file exists."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from inspect import isabstract
from pkgutil import iter_modules
from typing import Any


def classes_of(folder: str, path: Iterable[str], base: type) -> dict[str, Any]:
    """Import every file of a folder and find the classes that are defined there.

    Returns:
        The subclasses of ``base`` that are not abstract, by name. Subfolders are skipped.
    """
    files = [import_module(f"{folder}.{found.name}") for found in iter_modules(path) if not found.ispkg]
    return {
        name: value
        for file in files
        for name, value in vars(file).items()
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == file.__name__
        if not isabstract(value)
    }
