"""The commands that the cases are for, imported before any of them is tried."""

from __future__ import annotations

from collections.abc import Callable


def commands() -> dict[str, Callable[[list[str]], int | None]]:
    """Each command by its name, as a function of its arguments that gives the exit code."""
    import torch

    from gaussian_swaying.captures.capture import read_capture
    from gaussian_swaying.cli import convert, evaluate, export, train
    from gaussian_swaying.cli import preview as preview_cli
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

    tools = {"eval": evaluate.main, "export": export.main, "convert_physgaussian": convert.main}
    return {"sim": main, "preview": preview_cli.main, "train": train.main, "look": look, **tools}
