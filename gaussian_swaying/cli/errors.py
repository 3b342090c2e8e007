"""The end of a command: errors as one sentence and an exit code, suggestions for misspelt options, how to continue."""

from __future__ import annotations

import difflib
import errno
import inspect
import os
import re
import shlex
import sys
import sysconfig
import traceback
import warnings
from argparse import ArgumentError, ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying import _program as program
from gaussian_swaying._checks import first_line
from gaussian_swaying.kernels.cpu import compiled, compiled_sentence
from gaussian_swaying.runs.signals import exit_code

OK, BUG, BAD_INPUT = 0, 1, 2
DEVICE: Any = {"default": "auto", "choices": ("auto", "cpu", "cuda"), "help": "auto takes a GPU if there is one"}
PACKAGE = Path(__file__).parents[1]
LIBRARIES = {Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
"""Folders of Python and of what is installed."""

# messages of torch and numpy when an array exceeds the memory or its size cannot be counted
_MEMORY = re.compile(
    r"can't allocate memory|not enough memory|out of memory|Storage size calculation overflowed|"
    r"multiplication overflow|Unable to allocate|Maximum allowed (size|dimension)|array is too big|"
    r"Invalid buffer size|bad_alloc",
    re.IGNORECASE,
)
_NUMBER = re.compile(r"overflow|out of range|too large to convert|int too big", re.IGNORECASE)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def run_command(
    command: Callable[[], int | None],
    *,
    stopped: str = "Stopped.",
    memory: str = "fewer Gaussians or smaller pictures",
    expected: tuple[type[BaseException], ...] = (),
    arguments: Sequence[str] = (),
    advice: Callable[[BaseException], str | None] | None = None,
) -> int:
    """Run a command, and turn exceptions into a sentence on standard error and an exit code.

    Standard error says at the end how long it took to compile kernels, if there were any.

    Args:
        command: Does the work and gives an exit code; None is 0.
        arguments: Command line, for messages.
        advice: Returns an additional message after an error or stop, or None.

    Returns:
        The command's exit code; 2 for bad input or insufficient resources, 130 after Ctrl-C, 128 plus the number of
        another signal that stopped it, 1 for a bug. With the environment variable ``GAUSSIAN_SWAYING_DEBUG=1`` errors
        keep their traceback.
    """

    def tell(text: str, error: BaseException) -> None:
        for line in (text, advice and advice(error)):
            if line:
                print(line, file=sys.stderr)

    known = compiled()[0]
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _once(set())
            code = command() or OK
        told = compiled_sentence(known)
        if told is not None:
            print(f"note: {told}", file=sys.stderr)
        return code
    except KeyboardInterrupt as stop:
        tell(stopped, stop)
        return exit_code(stop)
    except Exception as error:
        if os.environ.get("GAUSSIAN_SWAYING_DEBUG") == "1":
            raise
        for_users = sentence(error, memory, expected, arguments)
        tell(f"error: {for_users or _bug(error)}", error)
        return BUG if for_users is None else BAD_INPUT


def _bug(error: Exception) -> str:
    """The message of a bug, and the line if it is in a file of the user, such as a force of their own."""
    what = f"{type(error).__name__}: {first_line(error).rstrip('.')}."
    shown = "the traceback that GAUSSIAN_SWAYING_DEBUG=1 shows."
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if Path(frame.filename).is_relative_to(PACKAGE):
            break
        if Path(frame.filename).is_file() and not any(map(Path(frame.filename).is_relative_to, LIBRARIES)):
            return f"{what} It was raised in {frame.filename}, line {frame.lineno}: correct it there, with {shown}"
    return f"{what} This is a bug in gaussian_swaying: please report it with {shown}"


def _once(shown: set[str]) -> Callable[..., None]:
    def show(message: Warning | str, *where: object, **named: object) -> None:
        text = str(message)
        if text not in shown:
            shown.add(text)
            print(f"warning: {text}", file=sys.stderr)

    return show


def sentence(
    error: BaseException,
    memory: str = "fewer Gaussians or smaller pictures",
    expected: tuple[type[BaseException], ...] = (),
    arguments: Sequence[str] = (),
) -> str | None:
    """The message of an error for users, in one line; None if it is a bug."""
    text = first_line(error)
    if isinstance(error, MemoryError | torch.OutOfMemoryError) or (
        isinstance(error, RuntimeError | ValueError) and _MEMORY.search(text)
    ):
        what = text.rstrip(".") if text.startswith("Unable") else _asked_for(text)
        return f"There is not enough memory{what and ' (' + what + ')'}. Remedy: {memory}."
    if isinstance(error, RecursionError):
        return "The input is nested too deeply: make it flatter."
    if isinstance(error, UnicodeError):
        return f"A file or an option is not UTF-8 text ({text}): save it as UTF-8."
    if isinstance(error, ArithmeticError) or (isinstance(error, RuntimeError) and _NUMBER.search(text)):
        return f"A number is too large or too small to compute with ({text}): check the given values."
    if isinstance(error, OSError):
        return _of_the_system(error)
    if isinstance(error, ArgumentError):
        return f"{parser_sentence(str(error), arguments).rstrip('.')}; --help lists the options."
    if isinstance(error, (ValueError, TypeError, *expected)):
        return parser_sentence(str(error), arguments)
    if isinstance(error, ImportError) and error.name and not error.name.startswith("gaussian_swaying"):
        return text
    return None


def parser_sentence(message: str, arguments: Sequence[str] = ()) -> str:
    """The part of a message that is useful for users, in one line.

    For the parser it is the value and the reason, or the configuration that cannot be parsed. For a worker process it
    is the last line of its traceback.
    """
    if message.startswith("Caught "):
        return message.strip().rpartition("Error: ")[2]
    noise = ("Does not validate", "Subtypes:", "Errors:", "- Expected a <class 'NoneType'>", "Given value")
    lines = [line.strip() for line in message.splitlines()]
    kept = [line.removeprefix("- ") for line in lines if line and not line.startswith(noise)]
    if "Does not validate" in message or message.startswith("Problems parsing config"):
        kept = [line.rstrip(".") for line in kept]
    if kept and message.startswith("Problems parsing config"):
        files = [b for a, b in pairwise(arguments) if a == "--config"]
        files += [a.removeprefix("--config=") for a in arguments if a.startswith("--config=")]
        kept[0] = f"{', '.join(files)} is not valid YAML{kept[0].removeprefix('Problems parsing config')}"
    text = _CHOICES.sub(lambda found: f"Expected one of {found[1].replace(chr(39), '')}", " ".join(kept))
    return _NO_CLASS.sub(r"`\1` has values but no class: put --\1 and the name of a class before them", text)


_CHOICES = re.compile(r"Expected a typing\.Literal\[([^\]]*)\]")
_NO_CLASS = re.compile(r'Parser key "([\w.]+)": Expected an instantiatable class, but [\w.]+ is abstract')


def _asked_for(text: str) -> str:
    amount = re.search(r"allocate (\d+) bytes", text)
    if amount:
        return f"{int(amount[1]) / 2**30:,.3g} GiB were requested"
    amount = re.search(r"allocate ([\d.]+ [KMGT]iB)", text)
    return f"{amount[1]} were requested" if amount else ""


def _of_the_system(error: OSError) -> str:
    if error.errno is None or error.strerror is None:
        return parser_sentence(str(error))
    where = error.filename or "A file"
    if error.errno in _FULL:
        return f"{where} could not be written ({error.strerror}): make room, or choose another place with --output."
    if isinstance(error, FileNotFoundError):
        return f"{where} does not exist: check the path."
    return f"{where} cannot be used ({error.strerror}): check the path and its permissions."


# ---- suggestions for misspelt options

# messages of argparse and jsonargparse about unknown options
_UNKNOWN = (
    re.compile(r"unrecognized arguments: (?P<name>--[\w.\-]+)"),
    re.compile(r"Group '(?P<group>[^']+)' does not accept option '(?P<name>[^']+)'"),
    re.compile(r"class_path '(?P<path>[^']+)': Option '(?P<name>[^']+)' is not accepted"),
    re.compile(r"Option '(?P<name>[^']+)' is not accepted"),
)


@contextmanager
def guessing(parser: ArgumentParser) -> Iterator[None]:
    """Inside the block, add a suggestion to the parser's messages about unknown options."""
    try:
        yield
    except ArgumentError as error:
        message = parser_sentence(str(error))
        guess = did_you_mean(message, parser)
        raise ArgumentError(None, message + guess if guess else str(error)) from error


def did_you_mean(message: str, parser: ArgumentParser) -> str:
    """A question to add to a message about an unknown option; empty if nothing comes close."""
    for pattern in _UNKNOWN:
        unknown = pattern.search(message)
        if unknown is None:
            continue
        parts, name = unknown.groupdict(), unknown["name"].lstrip("-").replace("-", "_")
        if parts.get("path"):
            near, prefix = _nearest(name, _arguments(parts["path"])), ""
        else:
            group, prefix = parts.get("group"), "--" if unknown["name"].startswith("--") else ""
            near = _nearest(f"{group}.{name}" if group else name, _options(parser))
        return "" if near in (None, name) else f" (did you mean {prefix}{near}?)"
    return ""


def _nearest(name: str, known: dict[str, str]) -> str | None:
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.75)
    return known[near[0]] if near else None


def _options(parser: Any) -> dict[str, str]:
    names: dict[str, str] = {}
    for action in parser._actions:
        for choice in (getattr(action, "_name_parser_map", None) or {}).values():
            names |= _options(choice)
        written = [option[2:] for option in action.option_strings if option.startswith("--")]
        names |= {option.replace("-", "_"): option for option in written if "help" not in option}
    return names


def _arguments(class_path: str) -> dict[str, str]:
    module, _, name = class_path.rpartition(".")
    try:
        parameters = inspect.signature(getattr(import_module(module), name)).parameters
    except (ImportError, AttributeError, TypeError, ValueError):
        return {}
    return {parameter: parameter for parameter in parameters}


# ---- how to continue


def command(arguments: Sequence[str], *more: str, without: str | None = None) -> str:
    """The command line of this program with additional arguments, ready to paste into a shell."""
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
    """A sentence that names the checkpoint of a simulation, and the command that continues it."""
    held = f"{checkpoint} contains the run up to frame {frame}"
    if diverged:
        return f"{held}; continuing from it would diverge again, so change the settings and start without --resume."
    return f"{held}; to continue:\n  {command(arguments, '--resume')}"
