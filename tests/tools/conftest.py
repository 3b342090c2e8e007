"""What tests of the benchmarks share."""

import importlib
import importlib.util
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def bench():
    """The command line of tools/bench.py: a function of its arguments."""
    from bench.command import main

    return lambda *arguments: main("bench.py", [str(argument) for argument in arguments])


HEAD = {"device": "a CPU", "versions": {"torch": "2"}, "seed": 0}
"""The head of a record."""


def measure(command, *arguments, result=None):
    """What a case adds to a record, here by default to an empty one, and what was saved after each row."""
    from bench.command import CASES, build_parser

    options = build_parser("bench.py").parse_args([command, *map(str, arguments)])
    options.device, result, saved = "cpu", {} if result is None else result, []
    CASES[command].measure(options, result, lambda now: saved.append(json.loads(json.dumps(now))))
    return result, saved


def shown(slot: str, record: object, *words: str) -> list[str] | str:
    """What a slot shows of a record (or of a list of all that it is about): the lines of a table, or a text."""
    from bench import pages, slots

    assert pages
    return slots.SLOTS[slot].make(record, *words)


def cells(slot: str, record: object) -> list[list[str]]:
    """The cells of each row of the table of a slot."""
    return [line[2:-2].split(" | ") for line in shown(slot, record) if line.startswith("| ")][1:]


def tool_of(path):
    """A program of the folder tools, as a module."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / "tools" / path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tool(request):
    """The program ``TOOL`` of tools/datasets with the modules beside it, which are forgotten afterwards."""
    folder = ROOT / "tools" / "datasets"
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module(request.module.TOOL)
    finally:
        sys.path.remove(str(folder))
        for path in folder.glob("*.py"):
            sys.modules.pop(path.stem, None)


def beside(name):
    """A fixture: one of the modules beside the tool."""

    @pytest.fixture(scope="module")
    def module(tool):
        return sys.modules[name]

    return module
