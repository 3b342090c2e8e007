"""What tests of the benchmarks share."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def bench():
    """The command line of tools/bench.py: a function of its arguments."""
    from bench.command import main

    return lambda *arguments: main("bench.py", [str(argument) for argument in arguments])


@contextmanager
def dataset_tool(name: str) -> Iterator[object]:
    """A program of tools/datasets with the modules beside it, which are forgotten afterwards."""
    folder = ROOT / "tools" / "datasets"
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))
        for path in folder.glob("*.py"):
            sys.modules.pop(path.stem, None)
