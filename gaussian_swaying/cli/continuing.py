"""The message when a run ends early: its last checkpoint, and the command that continues from it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying import _program as program


def command(arguments: Sequence[str], *more: str, without: str | None = None) -> str:
    """The command line of this program with additional arguments, ready to paste into a shell.

    Args:
        arguments: The arguments with which it was started.
        more: Arguments to add at the end, unless they are already there.
        without: An option to remove with its value, because ``more`` sets it again.
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
        diverged: Whether the run diverged, so that the same settings would diverge again.
    """
    held = f"{checkpoint} contains the run up to frame {frame}"
    if diverged:
        return f"{held}; continuing from it would diverge again, so change the settings and start without --resume."
    return f"{held}; to continue:\n  {command(arguments, '--resume')}"
