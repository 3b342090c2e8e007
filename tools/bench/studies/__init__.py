"""One file for each figure that a page shows."""

from importlib import import_module
from pkgutil import iter_modules


def load() -> None:
    """Register all studies, and the tables of the pages."""
    import_module("bench.tables")
    for package in ("bench.studies", "bench.speed"):
        for module in iter_modules(import_module(package).__path__):
            import_module(f"{package}.{module.name}")
