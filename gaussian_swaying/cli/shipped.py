"""Configurations shipped with the package, by name: ``--config flag`` for ``configs/sim/flag.yaml``."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

import gaussian_swaying


def folder() -> Path | None:
    """The folder of the configurations: in the installed package, or beside it in a checkout; None if missing."""
    package = Path(gaussian_swaying.__file__).parent
    places = [path for path in (package / "configs", package.parent / "configs") if (path / "sim").is_dir()]
    return places[0] if places else None


def names(kind: str) -> list[str]:
    """Names of the configurations of a kind, ``sim`` or ``train``."""
    root = folder()
    return [] if root is None else sorted(path.stem for path in (root / kind).glob("*.yaml"))


def with_shipped(arguments: Sequence[str], kind: str) -> list[str]:
    """The command line with ``--config NAME`` replaced by the shipped file, unless there is a file NAME.

    Args:
        kind: ``sim`` or ``train``.
    """
    words: list[str] = []
    for argument in arguments:
        option, equals, value = argument.partition("=")
        if words and words[-1] == "--config" and not argument.startswith("-"):
            words.append(_file(argument, kind))
        elif option == "--config" and equals:
            words.append(f"--config={_file(value, kind)}")
        else:
            words.append(argument)
    return words


def _file(given: str, kind: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", given) or Path(given).exists():
        return given
    known, root = names(kind), folder()
    if root is not None and given in known:
        return str(root / kind / f"{given}.yaml")
    close = difflib.get_close_matches(given, known, 1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    raise ValueError(
        f"There is no file and no configuration {given!r}{hint}: set `--config` to a YAML file, or to one of "
        f"{', '.join(known) or 'those of a checkout'}."
    )
