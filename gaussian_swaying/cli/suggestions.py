"""Suggestions for misspelt options."""

from __future__ import annotations

import difflib
import re
from argparse import ArgumentError
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from gaussian_swaying.cli.errors import parser_sentence

if TYPE_CHECKING:
    from argparse import ArgumentParser

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
    """A question to add to a message about an unknown option; empty if nothing comes close.

    Args:
        message: The parser's message.
        parser: The parser, for the names of its options.
    """
    for pattern in _UNKNOWN:
        found = pattern.search(message)
        if found is None:
            continue
        parts, name = found.groupdict(), found["name"].lstrip("-").replace("-", "_")
        if parts.get("path"):
            near, prefix = _nearest(name, _arguments(parts["path"])), ""
        else:
            group, prefix = parts.get("group"), "--" if found["name"].startswith("--") else ""
            near = _nearest(f"{group}.{name}" if group else name, _options(parser))
        return "" if near in (None, name) else f" (did you mean {prefix}{near}?)"
    return ""


def _nearest(name: str, known: dict[str, str]) -> str | None:
    """The spelling of the most similar known name; None if none is similar."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.75)
    return known[near[0]] if near else None


def _options(parser: Any) -> dict[str, str]:
    """Names of all options of a parser and its commands: the form used to compare, and the spelling."""
    names: dict[str, str] = {}
    for action in parser._actions:
        for choice in (getattr(action, "_name_parser_map", None) or {}).values():
            names |= _options(choice)
        written = [option[2:] for option in action.option_strings if option.startswith("--")]
        names |= {option.replace("-", "_"): option for option in written if "help" not in option}
    return names


def _arguments(class_path: str) -> dict[str, str]:
    """Names of the arguments of a class."""
    import inspect
    from importlib import import_module

    module, _, name = class_path.rpartition(".")
    try:
        parameters = inspect.signature(getattr(import_module(module), name)).parameters
    except (ImportError, AttributeError, TypeError, ValueError):
        return {}
    return {parameter: parameter for parameter in parameters}
