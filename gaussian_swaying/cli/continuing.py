"""What is said when a run ends early: which checkpoint is there, and the command that goes on from it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying import _program as program


def command(arguments: Sequence[str], *more: str, without: str | None = None) -> str:
    """The command line of this program with some arguments added, ready to be pasted into a shell.

    Args:
        arguments: Those that it was started with.
        more: To be added at the end, unless they are there already.
        without: An option that is left out with its value, as ``more`` gives it anew.
    """
    kept, skip = [], False
    for argument in arguments:
        if skip or (without and argument.startswith(f"{without}=")):
            skip = False
        elif argument == without:
            skip = True
        else:
            kept.append(argument)
    return shlex.join([*program.this(), *kept, *(argument for argument in more if argument not in kept)])


def how_to_resume(checkpoint: Path, frame: int, arguments: Sequence[str], diverged: bool = False) -> str:
    """A sentence that names the checkpoint of a simulation, and the command that continues it.

    Args:
        checkpoint: The file.
        frame: Its frame.
        arguments: Command line of the run.
        diverged: The run diverged, so that the same settings would do so again.
    """
    held = f"{checkpoint} holds the run up to frame {frame}"
    if diverged:
        return f"{held}; going on from it would diverge again, so change the settings and start without --resume."
    return f"{held}; to go on:\n  {command(arguments, '--resume')}"
