"""Commands as the user would type them: for the installed program, or for a checkout."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

INSTALLED = "gaussian-swaying"
_called: list[str] = []  # the command, if it was started through the installed program


def called(command: str) -> None:
    """Remember that a command was started through the installed program."""
    _called[:] = [command]


def words(command: str) -> list[str]:
    """How a command is started.

    Example:
        >>> words("sim")
        ['python', 'tools/sim.py']
    """
    return [INSTALLED, command] if _called else ["python", f"tools/{command}.py"]


def command(*given: object) -> str:
    """A command line, quoted for a shell.

    Example:
        >>> command("sim", "--config", "my scan/#1.yaml")
        "python tools/sim.py --config 'my scan/#1.yaml'"
    """
    first, *more = map(str, given)
    return shlex.join([*words(first), *more])


def name(command: str) -> str:
    """The name of a command in its own help."""
    return f"{INSTALLED} {command}" if _called else f"{command}.py"


def this() -> list[str]:
    """How this process was started."""
    if _called:
        return [INSTALLED, *_called]
    program = sys.argv[0] or "python"
    return ["python", program] if program.endswith(".py") else [Path(program).name]
