"""How the commands were called, so that what is printed can be pasted: installed, or from a checkout."""

from __future__ import annotations

import sys
from pathlib import Path

INSTALLED = "gaussian-swaying"
_called: list[str] = []  # the command, if it was called through the installed program


def called(command: str) -> None:
    """Note that a command was called through the installed program."""
    _called[:] = [command]


def words(command: str) -> list[str]:
    """The words that start a command.

    Args:
        command: ``sim``, ``train``, ``preview``, ...

    Example:
        >>> words("sim")
        ['python', 'tools/sim.py']
    """
    return [INSTALLED, command] if _called else ["python", f"tools/{command}.py"]


def name(command: str) -> str:
    """What a command calls itself in its help."""
    return f"{INSTALLED} {command}" if _called else f"{command}.py"


def this() -> list[str]:
    """The words that started this process."""
    if _called:
        return [INSTALLED, *_called]
    program = sys.argv[0] or "python"
    return ["python", program] if program.endswith(".py") else [Path(program).name]
