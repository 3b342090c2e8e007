"""The installed program: ``gaussian-swaying`` and the name of a command."""

from __future__ import annotations

import difflib
import gc
import io
import os
import re
import signal
import sys
import threading
from collections.abc import Sequence
from importlib import import_module
from types import ModuleType
from typing import NoReturn

import gaussian_swaying
from gaussian_swaying import _program as program

COMMANDS = {
    "sim": ("gaussian_swaying.cli.simulate", "simulate a scene in the wind: splat in, video out"),
    "sweep": ("gaussian_swaying.cli.sweep", "do many runs along axes, with a table and a picture of all"),
    "fit": ("gaussian_swaying.cli.fit", "find the wind and the material from video"),
    "camera": ("gaussian_swaying.cli.camera", "find the camera of a film of a splat"),
    "live": ("gaussian_swaying.cli.live", "change the wind on a page while a scene moves"),
    "train": ("gaussian_swaying.cli.train", "train surface-aligned Gaussians from photos"),
    "preview": ("gaussian_swaying.cli.preview", "look at a splat and suggest a first configuration"),
    "eval": ("gaussian_swaying.cli.evaluate", "compare a run with a reference"),
    "export": ("gaussian_swaying.cli.export", "convert a splat, or a run's splats to USD"),
    "convert": ("gaussian_swaying.cli.convert", "turn a PhysGaussian configuration into a YAML file"),
    "warm": ("gaussian_swaying.cli.warm", "compile what the first runs on a GPU would compile"),
}
"""For each command a module with ``main(arguments)``, and a description."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: Its name and its arguments; those of the process if None.

    Raises:
        SystemExit: With code 2 if there is no such command, or none can be loaded here.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    if not given or given[0] in ("-h", "--help"):
        print(f"usage: {program.INSTALLED} COMMAND ...\n")
        for name, (_, what) in COMMANDS.items():
            print(f"  {name:<9}{what}")
        print(f"\n{program.INSTALLED} COMMAND --help lists the options of a command.")
        return 0
    if given[0] == "--version":
        print(f"{program.INSTALLED} {gaussian_swaying.__version__}")
        return 0
    if given[0] not in COMMANDS:
        close = difflib.get_close_matches(given[0], COMMANDS, 1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        _end(f"There is no command {given[0]!r}{hint}: use one of {', '.join(COMMANDS)}.")
    program.called(given[0])
    code: int = _imported(COMMANDS[given[0]][0]).main(given[1:])
    return code


def run(command: str | None = None) -> NoReturn:
    """Run a command with the arguments of the process, and end the process with its exit code.

    Args:
        command: The command of a program of the folder tools; None for the installed program, whose first argument
            names it.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without the sign for cubic metres
    try:
        sys.exit(main() if command is None else _imported(COMMANDS[command][0]).main(sys.argv[1:]))
    except KeyboardInterrupt:  # while options are read
        _stop(signal.SIGINT, None)


def _end(message: str) -> NoReturn:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


def _stop(number: int, frame: object) -> NoReturn:
    """End at once: libraries that are being loaded turn KeyboardInterrupt into errors of their own."""
    os.write(2, b"Stopped.\n")
    os._exit(128 + number)


def _imported(name: str) -> ModuleType:
    """A module; while it is imported, and later within it, Python looks for no garbage, which would take 0.3 s."""
    try:
        os.getcwd()
    except FileNotFoundError:
        _end("The working directory no longer exists: change to another one.")
    if name not in sys.modules:
        main_thread = threading.current_thread() is threading.main_thread()
        stops = main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if stops:
            signal.signal(signal.SIGINT, _stop)
        gc.disable()
        try:
            import_module(name)
            gc.freeze()
        except (ImportError, OSError, MemoryError) as error:
            if isinstance(error, MemoryError) or re.search("failed to map|allocate memory", str(error)):
                _end("There is not enough memory to load PyTorch: close other programs, or raise the limit.")
            raise
        finally:
            gc.enable()
            if stops:
                signal.signal(signal.SIGINT, signal.default_int_handler)
    return sys.modules[name]
