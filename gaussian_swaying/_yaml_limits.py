"""Limits of a configuration: one that is too large, too deep or contains itself is refused before it is built.

With aliases, a YAML file of a few lines can repeat a part a billion times, or contain itself. So the events of the
parser are counted first, which takes little memory.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gaussian_swaying._inputs import LONGEST_NUMBER, check_regular

LARGEST = 1 << 20  # bytes; the configurations of this project have about 5,000
DEEPEST = 64  # levels
MOST = 20_000  # values, including those that aliases repeat
MOST_WORK = 10_000_000  # entries times values of all lists, as jsonargparse copies a list for each entry: about 10 s


def check_yaml(text: str) -> str:
    """Return a text if it is within the limits for YAML.

    Args:
        text: YAML, or a value from the command line.

    Raises:
        ValueError: If it is too long or too deep, has too many values, contains itself, or has a whole number of more
            than 32 digits.
        yaml.YAMLError: If it is not valid YAML.
    """
    if len(text) > LARGEST:
        raise ValueError(f"A configuration of {len(text):,} characters is too long: the limit is {LARGEST:,}.")
    if len(text) < LONGEST_NUMBER and "*" not in text:  # too short to be deep or large
        return text
    import yaml

    sizes: dict[str, int] = {}  # values within each anchor
    begun: list[_Part] = []
    values = work = 0
    for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        if isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            part = begun.pop()
            size = values - part.before
            if part.anchor:
                sizes[part.anchor] = size
            work += part.entries * size if isinstance(event, yaml.SequenceEndEvent) else 0
            if work > MOST_WORK:
                raise ValueError(f"A list of {part.entries:,} entries with {size:,} values is too long to read.")
            continue
        if isinstance(event, (yaml.ScalarEvent, yaml.AliasEvent, yaml.CollectionStartEvent)) and begun:
            begun[-1].entries += 1
        if isinstance(event, yaml.AliasEvent):
            if any(event.anchor == part.anchor for part in begun):
                raise ValueError(f"A configuration must not contain itself: remove the alias *{event.anchor}.")
            values += sizes.get(event.anchor or "", 1)
        elif isinstance(event, yaml.ScalarEvent):
            values += 1
            digits = event.value.lstrip("+-") if event.implicit[0] else ""
            if len(digits) > LONGEST_NUMBER and digits.isdigit():
                raise ValueError(
                    f"A whole number of {len(digits)} digits ({digits[:8]}...) is too large for any field."
                )
        elif isinstance(event, yaml.CollectionStartEvent):
            begun.append(_Part(event.anchor, values))
            values += 1
            if len(begun) > DEEPEST:
                raise ValueError(f"A configuration is nested too deeply: the limit is {DEEPEST} levels.")
        if values > MOST:
            raise ValueError(f"A configuration of more than {MOST:,} values, aliases included, is too large.")
    return text


@dataclass
class _Part:
    """A list or mapping that is being read."""

    anchor: str | None
    before: int  # values before it
    entries: int = 0


def limit_yaml(change: Callable[[Any], Any] | None = None) -> None:
    """Make jsonargparse apply :func:`check_yaml` to files and to values from the command line.

    Args:
        change: Returns what a configuration, or a value, stands for; None to leave it.
    """
    from jsonargparse import get_loader, set_loader

    load = get_loader("yaml")
    if not isinstance(load, _Limited):
        load = _Limited(load)
        set_loader("yaml", load, exceptions=_exceptions())
    load.change = change or load.change


class _Limited:
    """A loader that checks the text first, and may change what it finds."""

    def __init__(self, load: Callable[[str], Any]) -> None:
        self.unlimited = load
        self.change: Callable[[Any], Any] | None = None

    def __call__(self, text: str) -> Any:
        found = self.unlimited(check_yaml(text))
        return found if self.change is None else self.change(found)


def _exceptions() -> tuple[type[Exception], ...]:
    import yaml

    return (yaml.YAMLError,)


def check_config_files(arguments: Sequence[str]) -> None:
    """Check that the configuration files on a command line are regular files of allowed size with UTF-8 text.

    Args:
        arguments: The command line. The value of ``--config`` and every .yaml and .yml file on it are checked.

    Raises:
        ValueError: Naming the file and the remedy.
    """
    for before, argument in zip(["", *arguments], arguments, strict=False):
        option, equals, value = argument.partition("=")
        if option.startswith("--") and equals:
            before, argument = option, value
        if before != "--config" and not argument.endswith((".yaml", ".yml")):
            continue
        try:
            if not Path(argument).exists():
                continue  # YAML on the command line, or an error that the parser reports
        except (OSError, ValueError):
            continue
        _text(check_regular(argument, "the configuration", LARGEST))


def read_fields(path: str | os.PathLike[str], what: str, fields: Sequence[str]) -> dict[str, Any]:
    """Read a YAML file with known fields at the top; any of them may be missing.

    Args:
        path: The file.
        what: Name of the kind of file, for the message, for example "the sweep file".
        fields: Names that it may have.

    Returns:
        The given values, by name.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a regular file, too large, not YAML, or has another field.
    """
    import yaml

    file = check_regular(path, what, LARGEST)
    try:
        given = yaml.safe_load(check_yaml(_text(file)))
    except yaml.YAMLError as error:
        raise ValueError(f"{file} is not valid YAML ({' '.join(str(error).split())}): correct it.") from error
    if not isinstance(given, dict):
        raise ValueError(f"Expected {file} to have the fields {', '.join(fields)}, but got {given!r:.60}.")
    for name in given:
        if name not in fields:
            raise ValueError(f"{file} has an unknown field `{name}`: use {', '.join(fields)}.")
    return given


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text ({error.reason}): save it as UTF-8.") from error
