"""The commands that the cases are for, imported before any of them is tried."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]


def load(path: Path) -> ModuleType:
    """A file as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def commands() -> dict[str, Callable[[list[str]], int | None]]:
    """Each command by its name, as a function of its arguments that gives the exit code."""
    import torch

    from gaussian_swaying.captures.capture import read_capture
    from gaussian_swaying.cli import preview as preview_cli
    from gaussian_swaying.cli import train as training
    from gaussian_swaying.cli.errors import run_command
    from gaussian_swaying.cli.simulate import main
    from gaussian_swaying.simulation.simulation import Simulation

    torch.set_num_threads(1)
    Simulation.parser()  # imports what it needs

    def look(arguments: list[str]) -> int:
        """Read a capture with all its pictures, as a training does first."""

        def read() -> None:
            for view in read_capture(arguments[0]).views:
                view.load()

        return run_command(read)

    tools = {name: load(ROOT / f"tools/{name}.py").main for name in ("eval", "export", "convert_physgaussian")}
    return {"sim": main, "preview": preview_cli.main, "train": training.main, "look": look, **tools}
