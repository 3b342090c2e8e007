"""Studies: a run of one appends a line of JSON to its file of records."""

from __future__ import annotations

import inspect
import json
import subprocess
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from gaussian_swaying._provenance import describe_device, versions

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
Row = dict[str, Any]
Grid = Iterable[Row] | Callable[[str], Iterable[Row]]


@dataclass(frozen=True)
class Study:
    """A measurement.

    Attributes:
        name: Of the command and of the file of records.
        function: Makes the numbers of one run from its parameters, and from ``device`` if it has such an argument.
        grid: The parameters of each run, or a function of ``cpu`` or ``cuda`` that makes them.
    """

    name: str
    function: Callable[..., Row]
    grid: Grid


STUDIES: dict[str, Study] = {}


def study(name: str, grid: Grid) -> Callable[[Callable[..., Row]], Callable[..., Row]]:
    """A decorator that makes a study of a function."""

    def register(function: Callable[..., Row]) -> Callable[..., Row]:
        STUDIES[name] = Study(name, function, grid)
        return function

    return register


def commit() -> str:
    """The commit of the checkout, with a plus if files differ from it."""
    words = ["git", "describe", "--always", "--abbrev=7", "--exclude=*", "--dirty=+"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"


def run(name: str, device: str = "cpu", only: str = "", folder: Path = RESULTS) -> None:
    """Make the runs of a study whose parameters contain ``only``, and append a line for each.

    A run that fails is recorded with the reason, and does not stop the others.
    """
    own = STUDIES[name]
    chosen = torch.device(device)
    folder.mkdir(parents=True, exist_ok=True)
    for parameters in own.grid(chosen.type) if callable(own.grid) else own.grid:
        if only not in json.dumps(parameters):
            continue
        given = {"device": device} if "device" in inspect.signature(own.function).parameters else {}
        try:
            numbers = own.function(**parameters, **given)
        except Exception as error:
            numbers = {"failed": f"{type(error).__name__}: {error}"}
        line = {"commit": commit(), "date": time.strftime("%Y-%m-%d", time.gmtime())}
        line |= {"device": describe_device(chosen), "versions": versions()}
        with (folder / f"{name}.jsonl").open("a") as file:
            file.write(json.dumps(line | {"parameters": parameters, "numbers": numbers}) + "\n")
        print(json.dumps(parameters), json.dumps(numbers), flush=True)


def read(name: str, folder: Path = RESULTS) -> list[SimpleNamespace]:
    """The last run of each choice of parameters on each device, with its parameters and numbers as attributes."""
    latest: dict[str, SimpleNamespace] = {}
    path = folder / f"{name}.jsonl"
    for text in path.read_text().splitlines() if path.exists() else []:
        line = json.loads(text)
        parameters, numbers = line.pop("parameters"), line.pop("numbers")
        key = json.dumps([line["device"], parameters], sort_keys=True)
        latest[key] = SimpleNamespace(**line | parameters | numbers, parameters=parameters)
    return list(latest.values())
