"""The folder tools/ is where tests of the benchmarks import from, as ``python tools/bench.py`` does."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tools"))  # last, so that nothing that is installed is shadowed


@pytest.fixture(scope="session")
def bench():
    """The command line of tools/bench.py: a function of its arguments."""
    from bench.command import main

    return lambda *arguments: main("bench.py", [str(argument) for argument in arguments])
