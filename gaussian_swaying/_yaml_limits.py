"""Limits of a configuration, and files of known fields."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from gaussian_swaying._inputs import check_regular

LARGEST = 1 << 20  # bytes; the configurations of this project have about 5,000
DEEPEST = 64  # levels
MOST = 20_000  # values, including those that aliases repeat


def check_yaml(text: str) -> str:
    """Return a text if it is within the limits: aliases make a few lines a billion values, or a list its own entry."""
    import yaml

    if len(text) > LARGEST:
        raise ValueError(f"A configuration of {len(text):,} characters is too long: the limit is {LARGEST:,}.")
    sizes: dict[str | None, int] = {}  # values within each anchor
    begun: list[tuple[str | None, int]] = []  # anchor, and the values before it
    values = 0
    for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = begun.pop()
            sizes[anchor] = values - before
        elif isinstance(event, yaml.NodeEvent):
            if isinstance(event, yaml.CollectionStartEvent):
                begun.append((event.anchor, values))
                sizes[event.anchor] = MOST  # within itself
            values += sizes.get(event.anchor, 1) if isinstance(event, yaml.AliasEvent) else 1
        if values > MOST or len(begun) > DEEPEST:
            raise ValueError(
                f"A configuration is too large: the limits are {MOST:,} values, aliases included, and {DEEPEST} levels."
            )
    return text


def limit_yaml(change: Callable[[Any], Any]) -> None:
    """Make jsonargparse apply :func:`check_yaml` to files and to values from the command line."""
    import yaml
    from jsonargparse import set_loader

    load = _loader()
    set_loader("yaml", lambda text: change(load(check_yaml(text))), exceptions=(yaml.YAMLError,))


@cache
def _loader() -> Callable[[str], Any]:
    from jsonargparse import get_loader

    return get_loader("yaml")


def read_fields(
    path: str | os.PathLike[str], what: str, fields: Sequence[str], change: Callable[[Any], Any] = lambda given: given
) -> dict[str, Any]:
    """Read a YAML file with known fields at the top; any of them may be missing.

    Args:
        what: Name of the kind of file, for the message, for example "the sweep file".
    """
    import yaml

    file = check_regular(path, what, LARGEST)
    try:
        given = change(yaml.safe_load(check_yaml(file.read_text(encoding="utf-8"))))
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not UTF-8 text ({error.reason}): save it as UTF-8.") from error
    except yaml.YAMLError as error:
        raise ValueError(f"{file} is not valid YAML ({' '.join(str(error).split())}): correct it.") from error
    if not isinstance(given, dict):
        raise ValueError(f"Expected {file} to have the fields {', '.join(fields)}, but got {given!r:.60}.")
    for name in given:
        if name not in fields:
            raise ValueError(f"{file} has an unknown field `{name}`: use {', '.join(fields)}.")
    return given
